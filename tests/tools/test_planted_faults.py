"""How `tools/planted_faults.py` judges: a doctor that does not name a fault fails.

Planting needs root and minutes: results are in docs/evidence/doctor.md.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from planted_faults import FAULTS, Fault, judge

from iris_session.doctor.findings import Finding, ok
from iris_session.doctor.runner import ORDER

ROOT = Path(__file__).parents[2]


def matching_finding(one: Fault) -> Finding:
    """Return a finding that names the fault."""
    return Finding(one.check, one.state, "; ".join(one.expected), advice="do")


@pytest.mark.parametrize("one", FAULTS, ids=lambda one: one.name)
def test_every_fault_has_a_check_and_can_be_named_or_missed(one: Fault) -> None:
    assert one.check in ORDER
    assert one.expected
    status = int(one.state == "failed")
    assert judge(one, [matching_finding(one)], status) == ""
    assert judge(one, [ok(one.check, "; ".join(one.expected))], 0)
    assert f"| {one.planted} |" in (ROOT / "docs" / "evidence" / "doctor.md").read_text()
