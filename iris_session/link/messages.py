"""The link between authority and front: one ZeroMQ PAIR over ipc, messages of `[kind, payload, ...]` frames.

Both ends are processes of the same session; what clients send has been checked before it comes here.

Flow control: the front numbers nothing but counts batches. Each `ENTRIES` batch uses one credit and comes back with
one `ACK`; with all credits used the front waits and coalesces. Batches with urgent entries have credits of their own.
"""

from __future__ import annotations

from typing import Final

import msgspec

from iris_session.link.config import Ports, SceneInfo
from iris_session.protocol.codec import make_decoder
from iris_session.protocol.server_messages import Event
from iris_session.protocol.steps import Admitted, Dropped, OutgoingMessage

# front -> authority
READY: Final = b"R"  # Ports
FAILED: Final = b"F"  # utf-8, one line
ENTRIES: Final = b"E"  # list[Entry]
HANDBACK: Final = b"H"  # opaque bytes for the next front, sent before an entry that depends on it
STATUS: Final = b"S"  # FrontStatus
BEAT: Final = b"B"  # nothing to say, still there; not while the authority stands still

# authority -> front
DECIDED: Final = b"D"  # Decided
STATE: Final = b"P"  # StateHeader, float64 poses
PRESENCE: Final = b"I"  # list[PresenceItem]
ACK: Final = b"A"  # one byte: how many batches were taken
ALIVE: Final = b"K"  # nothing to say, still there
SCENE: Final = b"N"  # SceneInfo
END: Final = b"Q"  # the session ends
REPORT: Final = b"T"  # StatusReport, the authority's half; about once a second

#: The authority says something at least this often; must be well below `FrontConfig.stall_ns`.
KEEPALIVE_NS: Final = 20_000_000
#: The front says something at least this often while it hears the authority.
BEAT_NS: Final = 200_000_000


class Decided(msgspec.Struct, frozen=True, array_like=True):
    """The part of a `Decision` that leaves the authority's process."""

    step: int
    admitted: tuple[Admitted, ...] = ()
    outgoing: tuple[OutgoingMessage, ...] = ()
    events: tuple[Event, ...] = ()
    dropped: tuple[Dropped, ...] = ()


class FrontStatus(msgspec.Struct, frozen=True):
    """Counters of the front since its start, sent on change, at most twice a second.

    `drops`: by reason, over all connections. `dropped_by`: by connection number, those with drops only.
    """

    connections: int
    drops: dict[str, int]
    dropped_by: dict[int, int]
    stalls: int = 0
    state_frames: int = 0
    entries: int = 0


def add_status(before: FrontStatus, status: FrontStatus) -> FrontStatus:
    """The counters of a front and of those before it: what was dropped does not come back with a new process."""
    return FrontStatus(
        status.connections,
        {
            reason: before.drops.get(reason, 0) + status.drops.get(reason, 0)
            for reason in {**before.drops, **status.drops}
        },
        status.dropped_by,
        before.stalls + status.stalls,
        before.state_frames + status.state_frames,
        before.entries + status.entries,
    )


encoder: Final = msgspec.msgpack.Encoder()
decode_decided: Final = make_decoder(Decided)
decode_status: Final = make_decoder(FrontStatus)
decode_ports: Final = make_decoder(Ports)
decode_scene: Final = make_decoder(SceneInfo)
