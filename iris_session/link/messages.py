"""Messages between authority and front: one ZeroMQ PAIR over ipc, messages of `[kind, payload, ...]` frames.

Both ends are processes of the same session. The front has checked messages of clients before it sends them here.

Flow control: the front does not number batches but counts them. Each `ENTRIES` batch uses one credit, which an `ACK`
returns; without credits the front waits and coalesces. Batches with urgent entries have credits of their own.
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
HANDBACK: Final = b"H"  # TokenState, sent before an entry that depends on it
STATUS: Final = b"S"  # FrontStatus
BEAT: Final = b"B"  # empty: the front works but has nothing to send; not sent while the authority stands still

# authority -> front
DECIDED: Final = b"D"  # Decided
STATE: Final = b"P"  # StateHeader, float64 poses; tuple[RobotState, ...] if a client reads them
PRESENCE: Final = b"I"  # list[PresenceItem]
ACK: Final = b"A"  # one byte: number of batches received
ALIVE: Final = b"K"  # empty: the authority works but has nothing to send
SCENE: Final = b"N"  # SceneInfo
END: Final = b"Q"  # the session ends
REPORT: Final = b"T"  # StatusReport, the authority's half; about once a second

#: The authority sends something at least this often; must be well below `FrontConfig.stall_ns`.
KEEPALIVE_NS: Final = 20_000_000
#: The front sends something at least this often while it receives from the authority.
BEAT_NS: Final = 200_000_000


class Decided(msgspec.Struct, frozen=True, array_like=True):
    """The part of a `Decision` that leaves the authority's process."""

    step: int
    admitted: tuple[Admitted, ...] = ()
    outgoing: tuple[OutgoingMessage, ...] = ()
    events: tuple[Event, ...] = ()
    dropped: tuple[Dropped, ...] = ()


class TokenState(msgspec.Struct, frozen=True, array_like=True):
    """State of the front for its successor. `state`: opaque bytes. `step`: that of the newest `Decided` before it."""

    step: int
    state: bytes


class FrontStatus(msgspec.Struct, frozen=True):
    """Counters of the front since its start, sent on change, at most twice a second.

    Attributes:
        drops: Dropped messages by reason, of all connections.
        dropped_by: Dropped messages by connection number, of connections with drops only.
    """

    connections: int
    drops: dict[str, int]
    dropped_by: dict[int, int]
    stalls: int = 0
    state_frames: int = 0
    entries: int = 0


def add_status(before: FrontStatus, status: FrontStatus) -> FrontStatus:
    """Return the counters of a front added to those of the fronts before it, so that totals survive a restart."""
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
decode_token_state: Final = make_decoder(TokenState)
decode_status: Final = make_decoder(FrontStatus)
decode_ports: Final = make_decoder(Ports)
decode_scene: Final = make_decoder(SceneInfo)
