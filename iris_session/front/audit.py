"""What concerns security and was seen by the front, to the authority: at most once a second per kind and address."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import msgspec

from iris_session.link.config import SECOND
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.entries import HOST, Audit, Entry

PERIOD_NS: Final = SECOND
#: Lines kept apart; beyond it, those of many addresses are told as one per kind.
MAX_PENDING: Final = 32
MANY_ADDRESSES: Final = "many addresses"
_NAME: Final = 64


class _PendingAudit:
    """The newest of one kind from one address that was not told yet, and how many there were."""

    __slots__ = ("audit", "count", "due_ns")

    def __init__(self, due_ns: int) -> None:
        self.audit: Audit | None = None
        self.count = 0
        self.due_ns = due_ns


class AuditTrail:
    """A `Service`. `offer` takes entries for the authority."""

    def __init__(self, offer: Callable[[Entry], bool]) -> None:
        self._offer = offer
        self._pending: dict[tuple[str, str], _PendingAudit] = {}

    def record(
        self, kind: str, now_ns: int, *, subject: str = "", name: str = "", address: str = "", detail: str = ""
    ) -> None:
        """Tells the first of a kind and address at once, those that follow within a second as one with a count."""
        audit = Audit(kind, subject[:_NAME], name[:_NAME], address[:_NAME], detail[:MAX_TEXT])
        line = self._pending.get((kind, address))
        if line is None and len(self._pending) >= MAX_PENDING:
            audit = msgspec.structs.replace(audit, address=MANY_ADDRESSES)
            line = self._pending.get((kind, MANY_ADDRESSES))
        if line is None:
            self._pending[(kind, audit.address if audit.address == MANY_ADDRESSES else address)] = _PendingAudit(
                now_ns + PERIOD_NS
            )
            self._send(audit, now_ns)
            return
        line.audit = audit
        line.count += 1

    def tick(self, now_ns: int) -> None:
        """Tells what has gathered for a second; forgets what did not come again."""
        for key in [key for key, line in self._pending.items() if now_ns >= line.due_ns]:
            line = self._pending[key]
            if line.audit is None:
                del self._pending[key]
                continue
            self._send(msgspec.structs.replace(line.audit, count=line.count), now_ns)
            line.audit, line.count, line.due_ns = None, 0, now_ns + PERIOD_NS

    def close(self) -> None:
        """Nothing was opened."""

    def _send(self, audit: Audit, now_ns: int) -> None:
        self._offer(Entry(HOST, HOST, now_ns, audit))
