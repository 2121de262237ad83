"""The authority's half of the status: participants from events, when a report is due, state of the recorder."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from iris_session.journal.feed import FeedStats
from iris_session.journal.messages import RecorderStatus
from iris_session.physics import Pacer
from iris_session.protocol.client_messages import MoveAnchor, PlaceAlignment, TrackingEpoch
from iris_session.protocol.common import IDENTITY, MAX_TEXT, Pose
from iris_session.protocol.entries import Entry, Join
from iris_session.protocol.names import Role
from iris_session.protocol.status import ParticipantReport, RecorderReport
from iris_session.session.config import SessionConfig
from iris_session.session.processes import SessionProcesses
from iris_session.session.status import (
    NO_PICTURE,
    PATIENCE_NS,
    PERIOD_NS,
    StatusReporter,
    collect_warnings,
    make_recorder_report,
    make_robot_reports,
)
from iris_session.session.stepper import Stepper
from tests.session.play import TICK_NS, entries, host, make_core
from tests.session.test_stepper import Front, Rig

BOB = 2


class Session(Rig):
    def people(self) -> dict[str, ParticipantReport]:
        return {row.name: row for row in self.stepper.view.make_participant_reports(self.now_ns, {})}


@pytest.fixture
def session() -> Session:
    return Session()


def bob(now_ns: int) -> Entry:
    return Entry(BOB, BOB, now_ns, Join("key2", Role.OPERATOR, "bob", devices=("head",), alignment="measured"))


def test_alignment_has_an_age_and_can_be_void(session: Session) -> None:
    session.step(bob(TICK_NS))
    row = session.people()["bob"]
    assert (row.alignment, row.alignment_age_ns, row.alignment_void_ns) == ("none", -1, -1)
    session.step(host(session.now_ns, PlaceAlignment(0, row.id, IDENTITY)))
    for _ in range(10):
        session.step()
    row = session.people()["bob"]
    assert (row.alignment, row.alignment_age_ns, row.alignment_void_ns) == ("placed", 10 * TICK_NS, -1)
    session.step(Entry(BOB, BOB, session.now_ns, TrackingEpoch(1)))
    for _ in range(5):
        session.step()
    row = session.people()["bob"]
    assert (row.alignment, row.alignment_age_ns, row.alignment_void_ns) == ("none", -1, 5 * TICK_NS)
    assert row.tracking_epoch == 1
    session.step(host(session.now_ns, PlaceAlignment(0, row.id, IDENTITY)))
    assert session.people()["bob"].alignment_void_ns == -1


def test_report_lists_robots_and_holders(session: Session) -> None:
    session.step()
    before = {row.name: row for row in make_robot_reports(session.stepper)}
    assert {row.mode for row in before.values()} == {"exclusive"}
    assert {(row.state, row.hold_reason) for row in before.values()} == {("hold", "no_lease")}
    for step in range(150):
        session.step(*entries(step))
    after = {row.name: row for row in make_robot_reports(session.stepper)}
    left = after["left"]
    assert (left.holder_name, left.state) == ("ann", "pose")
    assert left.receive_to_step is not None
    assert left.receive_to_step.p99 < 20.0
    assert after["right"].receive_to_step is None
    assert session.people()["ann"].holds == ("left",)


def test_report_waits_for_idle_time_up_to_a_limit() -> None:
    reporter = StatusReporter()
    assert reporter.is_due(0)
    assert not reporter.is_due(PERIOD_NS - 1)
    reporter.pacer = Pacer(TICK_NS, 0)  # its first tick was due long ago
    assert not reporter.is_due(PERIOD_NS)
    assert reporter.is_due(PERIOD_NS + PATIENCE_NS)
    reporter.pacer = Pacer(TICK_NS, 3 * PERIOD_NS)
    assert reporter.is_due(3 * PERIOD_NS)


def test_warnings_of_other_sources_are_reported(session: Session) -> None:
    assert collect_warnings(session.stepper, RecorderReport(), "") == []
    assert collect_warnings(session.stepper, RecorderReport(), "", ["x" * 5000]) == ["x" * MAX_TEXT]


def test_new_front_gets_the_current_anchors() -> None:
    core = make_core(anchors={"table": IDENTITY})
    moved = Pose((1.0, 0.0, 0.0), IDENTITY.q)
    core.step(TICK_NS, [host(TICK_NS, MoveAnchor(0, "table", moved))], 0)
    session_processes = SessionProcesses(SessionConfig(record=False), core, 0)
    front: Any = SimpleNamespace(poll=lambda _: ["it was replaced"], link=Front())
    session_processes.front = front
    session_processes.reporter = SimpleNamespace(is_due=lambda now_ns: False)  # type: ignore[assignment]
    session_processes.supervise(Stepper(core, Front(), None, lambda: 10**12, 10**9, 10**9))
    assert front.anchors == {"table": moved}


def processes(fault: str = "", **state: Any) -> Any:
    """Return feed and recorder."""
    said = RecorderStatus(1, 0, 0, bytes=1000, fault=fault, disk_free=5000)
    well = {"alive": True, "hangs": False, "failure": "", "is_used_up": False, "budget_text": "", "journal_only": False}
    return (
        SimpleNamespace(stats=FeedStats(dropped_rows=2, waiting_bytes=30, recorder=said)),
        SimpleNamespace(path="/data/session.rrd", **{**well, **state}),
    )


@pytest.mark.parametrize(
    ("fields", "state", "text"),
    [
        ({}, "running", ""),
        ({"hangs": True}, "hangs", ""),
        ({"alive": False}, "dead", ""),
        ({"alive": False, "failure": "no space left"}, "failed", "no space left"),
        ({"fault": "cannot be written"}, "failed", "cannot be written"),
        (
            {"alive": False, "budget_text": "recording ended: budget", "is_used_up": True},
            "ended",
            "recording ended: budget",
        ),
        ({"journal_only": True}, "running", NO_PICTURE),
        ({"hangs": True, "failure": "no space left"}, "failed", "no space left"),  # dies again and again
    ],
)
def test_recorder(fields: dict[str, Any], state: str, text: str) -> None:
    report = make_recorder_report(*processes(**fields))
    assert (report.state, report.text) == (state, text)
    assert (report.bytes_written, report.disk_free_bytes, report.lost_rows, report.spilled_bytes) == (1000, 5000, 2, 30)


def test_without_recorder() -> None:
    assert make_recorder_report(None, None).state == "off"
