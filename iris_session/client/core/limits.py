"""Times and bounds of a client's connection, and which answers of a session end it or not."""

from __future__ import annotations

from typing import Final

from iris_session.protocol.names import DenialReason, FaultCode, RefusalCode
from iris_session.protocol.server_messages import ProtocolFault, Refused, Welcome

#: How long an answer is waited for, at first and at most: a handshake takes five ways there and back, so over a slow
#: link the first tries are too short.
HELLO_TIMEOUT_NS: Final = 1_000_000_000
HELLO_TIMEOUT_MAX_NS: Final = 4_000_000_000
BACKOFF_MIN_NS: Final = 100_000_000
BACKOFF_MAX_NS: Final = 2_000_000_000
STEADY_NS: Final = 1_000_000_000
SNAPSHOT_RETRY_NS: Final = 500_000_000
#: What a session may ask for: else a client would never rest, or never notice that it is gone.
HEARTBEAT_MIN_NS: Final = 20_000_000
HEARTBEAT_MAX_NS: Final = 10_000_000_000
SILENT_HEARTBEATS: Final = 4  # this many heartbeat periods without a word from the front: the connection is gone
MAX_INBOX: Final = 1024
MAX_PENDING: Final = 64
MAX_GRANTED: Final = 4096  # targets of which an answer spoke

#: Refusals that pass: somebody who was in before keeps trying (after `rate` everybody does).
RETRYABLE_REFUSALS: Final = frozenset({RefusalCode.RATE, RefusalCode.FULL, DenialReason.SESSION_FULL})
#: Faults about a message of ours that the session could not read: whoever waits for its answer waits in vain.
UNREAD_MESSAGE_FAULTS: Final = frozenset({FaultCode.MALFORMED, FaultCode.TOO_LARGE})
#: Why the session let a connection go that another one resumed. Joining again would only take it back in turn.
REPLACED: Final = "replaced"


def bounded_heartbeat_ns(welcome: Welcome) -> int:
    """What the session asks for [ns], within reason."""
    return min(max(welcome.heartbeat_ns, HEARTBEAT_MIN_NS), HEARTBEAT_MAX_NS)


def final_refusal(fault: ProtocolFault) -> Refused | None:
    """What a fault means after which a client does not join again by itself, `None` for any other fault."""
    if fault.code == FaultCode.DROPPED and fault.reason == REPLACED:
        advice = "give every client that runs at the same time an identity of its own"
        return Refused(REPLACED, "another client took over with this identity", advice)
    if fault.code == FaultCode.REVOKED:
        return Refused(fault.code, fault.message, "ask whoever runs the session")
    return None
