"""Checks of a status report: one fault at a time, each reported by its check, with advice."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import msgspec
import pytest

from iris_session.doctor import session_checks
from iris_session.doctor.drop_explanations import EXPLANATIONS, explain_drops
from iris_session.doctor.findings import Finding
from iris_session.doctor.session_checks import FULL_DISK, HOLD_ADVICE, LATE_CAUSES, check_session_report
from iris_session.protocol.common import Pose
from iris_session.protocol.names import HoldReason, LateCause
from iris_session.protocol.status import (
    AlignmentReport,
    AnchorReport,
    AnchorSeen,
    ParticipantReport,
    Quantiles,
    RecorderReport,
    RobotReport,
    StatusReport,
    StopReport,
)

S = 1_000_000_000
ORIGIN = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
DOCTOR = ParticipantReport("p9", "doctor", "observer", True, alignment="not_needed")
ANN = ParticipantReport(
    "p1",
    "ann",
    "operator",
    True,
    heard_ns=50_000_000,
    alignment="measured",
    alignment_age_ns=60 * S,
    alignment_error_m=0.004,
    holds=("left",),
    samples_per_s=72.0,
    capture_to_receive=Quantiles(8.0, 20.0),
    state_age=Quantiles(3.0, 9.0),
    reported=True,
)
LEFT = RobotReport("left", "exclusive", "p1", "ann", "pose", "", Quantiles(1.0, 3.0))
RIGHT = RobotReport("right", "exclusive", state="hold", hold_reason="no_lease")
WELL = StatusReport(
    1,
    "s1",
    "lab",
    600 * S,
    tick=300_000,
    tick_period_ns=2_000_000,
    scheduling="realtime",
    lateness=Quantiles(0.3, 0.6),
    step_to_publish=Quantiles(0.4, 1.0),
    load=0.5,
    cpus=8,
    participants=(ANN, DOCTOR),
    robots=(LEFT, RIGHT),
    recorder=RecorderReport("running", "/data/session.rrd", 50_000_000, 400_000_000_000),
    authority_silent_ns=2_000_000,
)


def change(value: Any, **fields: object) -> Any:
    return msgspec.structs.replace(value, **fields)


def with_ann(**fields: object) -> StatusReport:
    report: StatusReport = change(WELL, participants=(change(ANN, **fields), DOCTOR))
    return report


def problems(report: StatusReport) -> dict[str, Finding]:
    return {one.check: one for one in check_session_report(report, "p9") if one.state != "ok"}


def assert_only(report: StatusReport, check: str, state: str, *texts: str) -> None:
    """Assert that exactly this check is not ok."""
    found = problems(report)
    assert list(found) == [check]
    one = found[check]
    assert one.state == state
    assert all(text in f"{one.text} {one.why} {one.advice}" for text in texts), one


def test_healthy_session_has_no_problems() -> None:
    assert problems(WELL) == {}
    assert problems(change(WELL, stalled=True, authority_silent_ns=S // 5)) == {}, "a late step is not a stall"
    unwell = change(DOCTOR, role="operator", alignment="none", heard_ns=5 * S)
    assert problems(change(WELL, participants=(ANN, unwell))) == {}, "the doctor itself does not count"


@pytest.mark.parametrize(
    ("fields", "state", "text"),
    [
        ({"stalled": True, "authority_silent_ns": 3 * S}, "failed", "3.0 s"),
        ({"authority_silent_ns": 2 * S}, "failed", "2.0 s"),
        ({"authority_silent_ns": -1}, "failed", "step yet"),
        ({"estop": True}, "failed", "emergency stop"),
        ({"estop": True, "stops": (StopReport(4, "p2", "bob", "smoke", 2 * S),)}, "failed", "bob"),
        ({"paused": True}, "warning", "paused"),
        ({"paused": True, "pause_reason": "NaN in QPOS"}, "failed", "NaN in QPOS"),
    ],
)
def test_state_of_the_session_is_reported(fields: dict[str, object], state: str, text: str) -> None:
    assert_only(change(WELL, **fields), "session", state, text)


def test_stalled_session_has_no_client_findings() -> None:
    """The state of its clients and ticks before the stall has no meaning now."""
    blind = with_ann(state_age=None, missed_share=1.0, capture_to_receive=Quantiles(900.0, 900.0))
    assert_only(change(blind, stalled=True, authority_silent_ns=3 * S), "session", "failed")


def test_advice_lists_sheets_of_the_session() -> None:
    elsewhere = with_ann(alignment="none", alignment_report=AlignmentReport(unusable=12))
    report = change(elsewhere, anchors=(AnchorReport("table", ORIGIN), AnchorReport("shelf", ORIGIN)))
    assert_only(
        report, "alignment", "failed", "12 observations, none usable of a sheet of this", "session: table, shelf"
    )
    seen = AlignmentReport(unusable=12, seen=(AnchorSeen("table", 3, S),))
    assert "none usable" not in problems(with_ann(alignment="none", alignment_report=seen))["alignment"].text


def test_observer_without_alignment_is_a_warning() -> None:
    looking = change(ANN, alignment="none", role="observer", holds=())
    report = change(WELL, participants=(looking,), robots=(RIGHT,))
    assert_only(report, "alignment", "warning", "ann has no alignment")


def test_screen_needs_no_alignment_without_robots() -> None:
    screen = change(ANN, alignment="none", role="observer", holds=(), alignment_report=AlignmentReport())
    shown = change(WELL, participants=(screen,), robots=())
    assert "alignment" not in problems(shown)
    assert "alignment" not in problems(change(shown, participants=(change(screen, role="operator"),)))
    headset = change(screen, role="operator", alignment_report=AlignmentReport(unusable=3))
    assert_only(change(shown, participants=(headset,)), "alignment", "warning", "ann has no alignment (3 observations")


def test_free_robot_is_suggested() -> None:
    bob = change(ANN, id="p2", name="bob", holds=())
    assert_only(change(WELL, participants=(ANN, bob)), "leases", "warning", "bob has no robot", "right is free")


def test_robot_kept_for_disconnected_holder() -> None:
    disconnected = change(ANN, connected=False, lost="silent")
    bob = change(ANN, id="p2", name="bob", holds=())
    found = problems(change(WELL, participants=(disconnected, bob), robots=(LEFT,)))
    assert "ann is disconnected" in found["leases"].why


def test_directors_need_no_robot() -> None:
    director = change(ANN, id="p2", name="dora", role="director", holds=())
    assert problems(change(WELL, participants=(ANN, director))) == {}


@pytest.mark.parametrize("reason", sorted(HOLD_ADVICE))
def test_unintentionally_holding_robots_are_reported(reason: str) -> None:
    held = change(LEFT, state="hold", hold_reason=reason)
    report = change(WELL, robots=(held, RIGHT), participants=(change(ANN, rejected={"stale": 7}),))
    assert_only(report, "robots", "warning", f"left (ann) holds: {reason}, rejected: stale 7", HOLD_ADVICE[reason])


def test_open_clutch_is_not_a_problem() -> None:
    held = change(LEFT, state="hold", hold_reason=HoldReason.CLUTCH_OPEN)
    assert problems(change(WELL, robots=(held, RIGHT))) == {}


@pytest.mark.parametrize(
    ("fields", "state", "text"),
    [
        ({"connected": False, "lost": "silent"}, "failed", "disconnected (silent)"),
        ({"heard_ns": 3 * S // 2}, "failed", "silent for 1.5 s"),
        ({"missed_share": 0.5}, "warning", "50%"),
        ({"state_age": None}, "warning", "receives no state"),
    ],
)
def test_slow_clients_are_reported(fields: dict[str, object], state: str, text: str) -> None:
    assert_only(with_ann(**fields), "clients", state, "ann: ", text)


def test_a_closed_page_is_no_failed_headset() -> None:
    page = change(ANN, id="p2", name="Web", role="director", alignment="not_needed", connected=False, lost="closed")
    assert problems(change(WELL, participants=(ANN, change(page, holds=())))) == {}
    kept = change(WELL, participants=(ANN, change(page, holds=("right",))))
    assert_only(kept, "clients", "warning", "Web: ", "right is kept for it")
    assert problems(kept)["clients"].advice == session_checks.SCREEN_ADVICE


def test_data_age_names_slow_stage() -> None:
    assert_only(
        with_ann(capture_to_receive=Quantiles(50.0, 90.0)), "age", "warning", "device -> front is slow", "90.0 ms (ann)"
    )
    slow = change(WELL, robots=(change(LEFT, receive_to_step=Quantiles(10.0, 60.0)), RIGHT))
    assert_only(slow, "age", "warning", "front -> authority is slow", "60.0 ms (left)")
    assert_only(change(WELL, step_to_publish=Quantiles(9.0, 40.0)), "age", "warning", "authority -> state is slow")
    assert_only(with_ann(state_age=Quantiles(90.0, 400.0)), "age", "warning", "state -> client is slow")
    assert_only(with_ann(shown_age_ms=1000.0), "age", "warning", "client -> picture is slow", "997.0 ms (ann)")


@pytest.mark.parametrize("cause", sorted(LATE_CAUSES))
def test_late_ticks_name_their_cause(cause: str) -> None:
    report = change(WELL, late_share=0.01, late_causes={LateCause.SCHEDULER: 1, cause: 40})
    assert_only(report, "ticks", "warning", f"{cause}: {LATE_CAUSES[cause][0]}", LATE_CAUSES[cause][1])
    assert_only(change(report, late_share=0.2), "ticks", "failed", "20.00% late")


@pytest.mark.parametrize(
    ("fields", "state", "text"),
    [
        ({"state": "hangs"}, "failed", "does not answer"),
        ({"state": "dead", "text": "no space left"}, "failed", "no space left"),
        ({"state": "ended", "text": "recording ended: budget of 16 MB"}, "warning", "recording ended: budget"),
        ({"text": "the picture is not recorded"}, "warning", "the picture is not recorded"),
        ({"lost_rows": 12}, "warning", "12 rows lost"),
    ],
)
def test_state_of_the_recorder_is_reported(fields: dict[str, object], state: str, text: str) -> None:
    assert_only(change(WELL, recorder=change(WELL.recorder, **fields)), "recorder", state, text)
    assert problems(change(WELL, recorder=RecorderReport())) == problems(change(WELL, recorder=None)) == {}


def test_disk_space_is_checked() -> None:
    full = change(WELL.recorder, disk_free_bytes=FULL_DISK - 1)
    assert_only(change(WELL, recorder=full), "disk", "failed", "full")
    # 50 MB in ten minutes: 83 kB/s. 10 GB last for more than a day, at 100 times the rate for 20 minutes.
    assert problems(change(WELL, recorder=change(WELL.recorder, disk_free_bytes=10_000_000_000))) == {}
    soon = change(WELL.recorder, bytes_written=5_000_000_000, disk_free_bytes=10_000_000_000)
    assert_only(change(WELL, recorder=soon), "disk", "warning", "about 20 minutes")


def test_restarts_and_warnings_are_reported() -> None:
    assert_only(change(WELL, restarts={"front": 2, "recorder": 0}), "drops", "warning", "front 2 times")
    assert_only(change(WELL, warnings=("physics diverged",)), "warnings", "warning", "physics diverged")


def test_drops_are_explained() -> None:
    report = change(WELL, drops={"send_queue_full": 2, "odd": 1})
    (found,) = (one for one in check_session_report(report, "p9") if one.check == "drops")
    assert re.search(r"send_queue_full 2 \(.+\), odd 1$", found.text)
    meaning = "refused requests for assets"
    assert explain_drops({"assets_unknown_asset": 3}) == f"assets_unknown_asset 3 ({meaning})"


def test_every_drop_reason_of_the_front_is_explained() -> None:
    rooms = Path(session_checks.__file__).parents[1]
    counted: set[str] = set()
    for path in (
        *(rooms / "front").rglob("*.py"),
        *(rooms / "alignment").glob("*.py"),
        *(rooms / "link").glob("*.py"),
        *(rooms / "security").glob("*.py"),
        rooms / "session" / "processes.py",
    ):
        counted |= set(re.findall(r"""drops(?:\.count\(|\[)\s*"([a-z_]+)\"""", path.read_text()))
    assert {"send_queue_full", "journal_rows", "unknown_key"} <= counted
    unexplained = counted - set(EXPLANATIONS)
    assert {reason for reason in unexplained if not reason.startswith("assets_")} == set(), "of assets by their prefix"


@pytest.mark.parametrize(("tick", "text"), [(0, "no tick"), (7, "tick 7")])
def test_tick_rate_of_user_loop_is_not_reported(tick: int, text: str) -> None:
    """The carrier of a scene without physics has a tick of a millisecond, but is not stepped at 1000 Hz."""
    report = change(WELL, lateness=None, tick=tick, tick_period_ns=1_000_000)
    found = check_session_report(report, "p9")[0]
    assert (found.check, found.state) == ("session", "ok")
    assert text in found.text
