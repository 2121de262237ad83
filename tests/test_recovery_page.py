"""docs/recovery.md names a test for every row of its table, and the tests exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def rows() -> list[str]:
    """Return the rows of the failure table."""
    page = (ROOT / "docs" / "recovery.md").read_text(encoding="utf-8")
    table = page.split("## What fails", 1)[1]
    return [line for line in table.splitlines() if line.startswith("| ") and not line.startswith("| what fails")]


def test_every_failure_has_a_test() -> None:
    there = {
        name
        for path in (ROOT / "tests").rglob("test_*.py")
        for name in re.findall(r"^def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert len(rows()) > 15
    for row in rows():
        named = re.findall(r"`(test_\w+)`", row)
        assert named, f"no test is named: {row}"
        missing = set(named) - there
        assert not missing, f"no such test: {missing}"
