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
MAX_LINES: Final = 32
MANY: Final = "many addresses"
_NAME: Final = 64


class _Line:
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
        self._lines: dict[tuple[str, str], _Line] = {}

    def note(
        self, kind: str, now_ns: int, *, subject: str = "", name: str = "", address: str = "", detail: str = ""
    ) -> None:
        """Tells the first of a kind and address at once, those that follow within a second as one with a count."""
        audit = Audit(kind, subject[:_NAME], name[:_NAME], address[:_NAME], detail[:MAX_TEXT])
        line = self._lines.get((kind, address))
        if line is None and len(self._lines) >= MAX_LINES:
            audit = msgspec.structs.replace(audit, address=MANY)
            line = self._lines.get((kind, MANY))
        if line is None:
            self._lines[(kind, audit.address if audit.address == MANY else address)] = _Line(now_ns + PERIOD_NS)
            self._tell(audit, now_ns)
            return
        line.audit = audit
        line.count += 1

    def turn(self, now_ns: int) -> None:
        """Tells what has gathered for a second; forgets what did not come again."""
        for key in [key for key, line in self._lines.items() if now_ns >= line.due_ns]:
            line = self._lines[key]
            if line.audit is None:
                del self._lines[key]
                continue
            self._tell(msgspec.structs.replace(line.audit, count=line.count), now_ns)
            line.audit, line.count, line.due_ns = None, 0, now_ns + PERIOD_NS

    def close(self) -> None:
        """Nothing was opened."""

    def _tell(self, audit: Audit, now_ns: int) -> None:
        self._offer(Entry(HOST, HOST, now_ns, audit))
