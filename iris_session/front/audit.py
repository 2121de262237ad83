"""The audit trail: security events of the front, sent to the authority at most once a second per kind and address."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import msgspec

from iris_session.link.config import SECOND
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.entries import HOST, Audit, Entry

PERIOD_NS: Final = SECOND
#: Kinds and addresses kept apart; beyond it, events of many addresses are sent as one per kind.
MAX_PENDING: Final = 32
MANY_ADDRESSES: Final = "many addresses"
_NAME: Final = 64


@dataclass(slots=True)
class _PendingAudit:
    """The newest unsent event of one kind and address, and how many there were."""

    due_ns: int
    newest: Audit | None = None
    count: int = 0


class AuditTrail:
    """Collect security events. A `Service`. `offer` queues entries for the authority."""

    def __init__(self, offer: Callable[[Entry], bool]) -> None:
        self._offer = offer
        self._pending: dict[tuple[str, str], _PendingAudit] = {}

    def record(
        self, kind: str, now_ns: int, *, subject: str = "", name: str = "", address: str = "", detail: str = ""
    ) -> None:
        """Send the first event of a kind and address at once, those that follow within a second as one with a count."""
        if (kind, address) not in self._pending and len(self._pending) >= MAX_PENDING:
            address = MANY_ADDRESSES
        audit = Audit(kind, subject[:_NAME], name[:_NAME], address[:_NAME], detail[:MAX_TEXT])
        line = self._pending.get((kind, address))
        if line is None:
            self._pending[kind, address] = _PendingAudit(now_ns + PERIOD_NS)
            self._send(audit, now_ns)
            return
        line.newest = audit
        line.count += 1

    def tick(self, now_ns: int) -> None:
        """Send events that were collected for a second, and forget those that did not repeat."""
        for key in [key for key, line in self._pending.items() if now_ns >= line.due_ns]:
            line = self._pending[key]
            if line.newest is None:
                del self._pending[key]
                continue
            self._send(msgspec.structs.replace(line.newest, count=line.count), now_ns)
            line.newest, line.count, line.due_ns = None, 0, now_ns + PERIOD_NS

    def _send(self, audit: Audit, now_ns: int) -> None:
        self._offer(Entry(HOST, HOST, now_ns, audit))
