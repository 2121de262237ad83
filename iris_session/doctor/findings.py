"""Results of the doctor's checks: plain values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import msgspec

OK: Final = "ok"
WARNING: Final = "warning"
FAILED: Final = "failed"
#: Not checked, because an earlier check failed.
SKIPPED: Final = "skipped"


class Finding(msgspec.Struct, frozen=True):
    """Result of one check.

    Attributes:
        check: Id of the check. Scripts can rely on it.
        state: `OK`, `WARNING`, `FAILED` or `SKIPPED`.
        text: What was found, in one line.
        why: The cause; empty when all is well.
        advice: What to do; empty when all is well.
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
    """Return a finding in state `OK`."""
    return Finding(check, OK, text)


def warning(check: str, text: str, why: str = "", advice: str = "") -> Finding:
    """Return a finding in state `WARNING`."""
    return Finding(check, WARNING, text, why, advice)


def failed(check: str, text: str, why: str = "", advice: str = "") -> Finding:
    """Return a finding in state `FAILED`."""
    return Finding(check, FAILED, text, why, advice)


def report_problems(
    check: str, problems: Sequence[str], fine: str, why: str = "", advice: str = "", state: str = WARNING
) -> Finding:
    """Return one finding about all problems; in state `OK`, with the text `fine`, where there are none."""
    return Finding(check, state, "; ".join(problems), why, advice) if problems else ok(check, fine)


class Findings:
    """All findings of one run, in order. At most one per check: a later finding replaces an earlier one."""

    def __init__(self) -> None:
        self._by_check: dict[str, Finding] = {}

    def add(self, *findings: Finding) -> None:
        """Append findings."""
        for finding in findings:
            self._by_check.pop(finding.check, None)
            self._by_check[finding.check] = finding

    def skip(self, *checks: str) -> None:
        """Mark checks that have no finding yet as skipped."""
        for check in checks:
            if check not in self._by_check:
                self.add(Finding(check, SKIPPED, "not checked: an earlier check failed"))

    def sort(self, order: Sequence[str]) -> None:
        """Sort by `order`; checks that are not in it come last."""
        rank = {check: i for i, check in enumerate(order)}
        self._by_check = dict(sorted(self._by_check.items(), key=lambda item: rank.get(item[0], len(rank))))

    def __getitem__(self, check: str) -> Finding:
        return self._by_check[check]

    def __iter__(self) -> Iterator[Finding]:
        return iter(self._by_check.values())

    @property
    def ok(self) -> bool:
        """True if no check failed. Warnings may exist."""
        return not any(finding.failed for finding in self._by_check.values())
