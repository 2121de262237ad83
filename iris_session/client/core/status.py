"""Phase and counters of a client connection."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

MAX_CODES = 64


class ConnectionPhase(enum.Enum):
    """Phase of a connection; `connection` draws the transitions."""

    IDLE = "idle"
    JOINING = "joining"
    SYNCING = "syncing"
    READY = "ready"
    WAITING = "waiting"
    REFUSED = "refused"
    CLOSED = "closed"


@dataclass(slots=True)
class ConnectionCounters:
    """Counters of the control channel, since the client was made."""

    sent: int = 0
    received: int = 0
    samples_not_sent: int = 0  # no connection, or the socket was full: late samples are worthless, they are not kept
    samples_without_lease: int = 0  # named a robot or object that is not ours: sent as mere presence, without it
    grippers_clipped: int = 0  # gripper values out of range, which the session clips to 0 to 1
    outgoing_dropped: int = 0  # the bounded queue of control messages was full
    malformed: int = 0  # frames that do not fit the protocol
    other_connection: int = 0  # addressed to an earlier connection of ours
    unexpected_replies: int = 0
    unasked_denials: int = 0  # of messages that expect no reply; passed to `on_denial`
    identity_unwritten: int = 0  # the identity file took no new resume token: after a kill it cannot resume
    inbox_dropped: int = 0  # events, feedback and replies that the application did not fetch
    snapshots: int = 0
    reconnects: int = 0
    faults: dict[str, int] = field(default_factory=dict)  # by `ProtocolFault.code`, beyond `MAX_CODES` as "other"

    def count_fault(self, code: str) -> None:
        """Count a `ProtocolFault`."""
        code = code if code in self.faults or len(self.faults) < MAX_CODES else "other"
        self.faults[code] = self.faults.get(code, 0) + 1
