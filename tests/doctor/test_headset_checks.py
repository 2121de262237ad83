"""Checks of alignments: one fault at a time."""

from __future__ import annotations

from typing import Any

import pytest

from iris_session.doctor.headset_checks import ALARMS, STALE_NS, is_consistent
from iris_session.doctor.runner import SESSION_CHECKS
from iris_session.doctor.session_checks import check_session_report
from iris_session.protocol.names import AlarmKind
from iris_session.protocol.status import AlignmentReport, AnchorSeen, CrossCheckReport, StatusReport, UnverifiedReport
from tests.doctor.test_session_checks import ANN, DOCTOR, LEFT, WELL, S, assert_only, change

ALIGNED = AlignmentReport(3, observations=200, viewpoints=3, seen=(AnchorSeen("table", 120, 4 * S),))
BOB = change(ANN, id="p2", name="bob", role="observer", holds=())
AGREES = CrossCheckReport("p1", "p2", "table", 0.003, 0.001, 0.008, 4 * S, 40)


def with_ann(**fields: object) -> StatusReport:
    """Return a session with ann, whose alignment has a report, and bob."""
    ann = change(ANN, alignment_report=change(ALIGNED, **fields))
    report: StatusReport = change(WELL, participants=(ann, BOB, DOCTOR), robots=(LEFT,))
    return report


def test_healthy_headsets_have_no_problems() -> None:
    assert [one for one in check_session_report(with_ann(), "p9") if one.state != "ok"] == []
    checks = {one.check for one in check_session_report(with_ann(), "p9")}
    assert checks == set(SESSION_CHECKS), "every check is reported, in the known order"


@pytest.mark.parametrize(("kind", "state"), [("jump", "failed"), ("differs", "warning"), ("changed", "warning")])
def test_alarms_are_reported(kind: str, state: str) -> None:
    report = with_ann(alarm=kind, alarm_size_m=0.12, alarm_ns=4 * S)
    assert_only(report, "alarm", state, f"ann: {ALARMS[kind]}, by 120 mm, 4.0 s ago", "bring a sheet into view")


def test_every_alarm_is_explained() -> None:
    assert set(ALARMS) == AlarmKind.ALL
    assert_only(with_ann(alarm="of_tomorrow", alarm_ns=S), "alarm", "warning", "ann: of_tomorrow")


def test_unconfirmed_alignment_is_stale() -> None:
    long_ago = (AnchorSeen("table", 9, STALE_NS + 60 * S), AnchorSeen("door", 9, STALE_NS + 120 * S))
    assert_only(with_ann(seen=long_ago), "stale", "warning", "ann has seen no sheet for 11 min", "glance")
    recent = (*long_ago, AnchorSeen("shelf", 9, S))
    assert all(one.state == "ok" for one in check_session_report(with_ann(seen=recent), "p9"))


def test_stopped_run_is_reported() -> None:
    assert_only(with_ann(running=False), "align_run", "warning", "stopped for ann", "anchors align start")


@pytest.mark.parametrize("fields", [{"pending_m": 0.025}, {"pending_rad": 0.02}])
def test_pending_corrections_are_reported(fields: dict[str, float]) -> None:
    mm, deg = fields.get("pending_m", 0.0) * 1e3, fields.get("pending_rad", 0.0) * 57.3
    assert_only(with_ann(**fields), "correction", "warning", f"{mm:.0f} mm, {deg:.1f} deg", "open the clutch")


def test_cross_check_differences_are_reported() -> None:
    apart = change(AGREES, error_m=0.03)
    assert_only(
        change(with_ann(), cross_checks=(AGREES, apart)),
        "agreement",
        "warning",
        "ann and bob put 'table' 30 mm apart, 95 % of such pairs are below 8 mm",
    )


def test_unverified_pairs_are_reported() -> None:
    report = change(with_ann(), unverified=(UnverifiedReport("p1", "p2", "table"),))
    assert_only(report, "pairs", "warning", "bob has aligned by 'table' since ann last saw it")


def test_expected_and_old_differences_are_ok() -> None:
    assert is_consistent(change(AGREES, error_m=0.016))
    assert not is_consistent(change(AGREES, error_m=0.0161))
    old = change(AGREES, error_m=0.5, age_ns=601 * S)
    found = {one.check: one for one in check_session_report(change(with_ann(), cross_checks=(old, AGREES)), "p9")}
    assert found["agreement"].state == "ok"
    assert "at most 3 mm" in found["agreement"].text


def test_disconnected_and_unaligned_roles_are_excluded() -> None:
    bad: Any = change(ALIGNED, alarm="jump", running=False, pending_m=1.0)
    agent = change(ANN, alignment="not_needed", alignment_report=bad)
    assert all(one.state == "ok" for one in check_session_report(change(WELL, participants=(agent, DOCTOR)), "p9"))
