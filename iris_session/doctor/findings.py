"""What the checks of a doctor say. Plain values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import msgspec

OK: Final = "ok"
WARNING: Final = "warning"
FAILED: Final = "failed"
#: Could not be looked at, because an earlier check failed.
SKIPPED: Final = "skipped"


class Finding(msgspec.Struct, frozen=True):
    """Result of one check. `check`: its id, which scripts can rely on. `text`: what is so, in one line.

    `why`: where that comes from; `advice`: what to do. Both are empty when all is well.
    """

    check: str
    state: str
    text: str
    why: str = ""
    advice: str = ""

    @property
    def failed(self) -> bool:
        return self.state == FAILED


def ok(check: str, text: str) -> Finding:
    return Finding(check, OK, text)


def warning(check: str, text: str, why: str = "", advice: str = "") -> Finding:
    return Finding(check, WARNING, text, why, advice)


def failed(check: str, text: str, why: str = "", advice: str = "") -> Finding:
    return Finding(check, FAILED, text, why, advice)


class Findings:
    """All findings of one examination, in order. At most one per check: a later one replaces an earlier one."""

    def __init__(self) -> None:
        self._by_check: dict[str, Finding] = {}

    def add(self, *findings: Finding) -> None:
        for finding in findings:
            self._by_check.pop(finding.check, None)
            self._by_check[finding.check] = finding

    def skip(self, *checks: str) -> None:
        """Those that nothing can be said about."""
        for check in checks:
            if check not in self._by_check:
                self.add(Finding(check, SKIPPED, "not looked at: an earlier check failed"))

    def sort(self, order: Sequence[str]) -> None:
        """In the order of `order`; what is not in it comes last."""
        rank = {check: i for i, check in enumerate(order)}
        self._by_check = dict(sorted(self._by_check.items(), key=lambda item: rank.get(item[0], len(rank))))

    def __getitem__(self, check: str) -> Finding:
        return self._by_check[check]

    def __iter__(self) -> Iterator[Finding]:
        return iter(self._by_check.values())

    @property
    def ok(self) -> bool:
        """No check failed; warnings may be there."""
        return not any(finding.failed for finding in self._by_check.values())

    def as_list(self) -> list[dict[str, Any]]:
        return [msgspec.to_builtins(finding) for finding in self._by_check.values()]
