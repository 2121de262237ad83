"""How `tools/planted_faults.py` judges: a doctor that does not name a fault fails.

Planting needs root and minutes: results are in docs/evidence/doctor.md.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from planted_faults import FAULTS, Fault, judge

from iris_session.doctor.findings import Finding, failed, ok, warning
from iris_session.doctor.runner import ORDER

ROOT = Path(__file__).parents[2]
REVOKED = next(one for one in FAULTS if one.name == "revoked")
BLOCKED = next(one for one in FAULTS if one.name == "broadcasts-blocked")
FULL = next(one for one in FAULTS if one.name == "full-disk")


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


@pytest.mark.parametrize(
    ("one", "findings", "status", "why"),
    [
        (REVOKED, [], 1, "missing"),
        (REVOKED, [failed("key", "this machine's key is not on the list", "", "pair")], 1, "lacks"),
        (REVOKED, [failed("key", "; ".join(REVOKED.expected))], 1, "advice"),
        (REVOKED, [matching_finding(REVOKED), failed("clients", "doctor: connection lost")], 1, "failed too: clients"),
        (REVOKED, [matching_finding(REVOKED)], 0, "exit status 0"),
        (REVOKED, [matching_finding(REVOKED), ok("age", "x" * 120 * 50)], 1, "screen"),
        (BLOCKED, [matching_finding(BLOCKED)], 1, "exit status 1"),
        (BLOCKED, [matching_finding(BLOCKED), warning("age", "old")], 0, ""),
        (FULL, [matching_finding(FULL), failed("recorder", "ended")], 1, ""),
    ],
)
def test_judge_rejects_unnamed_faults(one: Fault, findings: list[Finding], status: int, why: str) -> None:
    verdict = judge(one, findings, status)
    assert why in verdict if why else verdict == ""
