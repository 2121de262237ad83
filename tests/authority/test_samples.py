"""Every reason for which a sample does not count, and what a rejection may and may not do."""

from __future__ import annotations

import math
from typing import Any

import pytest

from iris_session.authority import AuthorityConfig
from iris_session.protocol.client_messages import Grasp
from iris_session.protocol.common import IDENTITY, Pose, Target
from iris_session.protocol.entries import Entry
from iris_session.protocol.server_messages import Notice, SamplesRejected

from .table import MS, SECOND, Person, Table, make_view

TURNED = (0.0, 1.0, 0.0, 0.0)
NAN = math.nan


def engaged() -> tuple[Table, Person]:
    t = Table(objects=("hammer",))
    op = t.operator("left")
    op.engage("left")
    assert t.command().kind == "pose"
    return t, op


@pytest.mark.parametrize("device", ["controller/right", "hand/left", "head"])
@pytest.mark.parametrize("role", ["operator", "director"])
def test_whoever_says_that_it_needs_no_alignment_moves_nothing_with_a_headset(role: str, device: str) -> None:
    t = Table()
    anna = t.join(role, alignment="not_needed")
    assert anna.acquire("left").ok
    anna.engage("left", device=device)
    assert t.hold() == "unaligned"
    assert t.last(SamplesRejected).reason == "unaligned"
    notice = t.last(Notice)
    assert (notice.level, notice.participant) == ("warning", anna.id)
    assert device in notice.text
    assert "measured" in notice.text
    assert anna.denied(Grasp(2, "hammer", "hand/left")) == "unaligned"
    twist = {"kind": "twist", "pose": None, "twist": (0.1, 0.0, 0.0, 0.0, 0.0, 0.0)}
    anna.engage("left", device=device, **twist)
    assert t.hold() == "unaligned"


@pytest.mark.parametrize("entry", ["operator", "controller/right", "key:key1"])
def test_the_configuration_decides_who_may_be_unaligned(entry: str) -> None:
    t = Table(AuthorityConfig(unaligned=(entry,)))
    anna = t.join(alignment="not_needed", devices=("controller/right",))
    anna.acquire("left")
    anna.engage("left")
    assert t.command().kind == "pose"
    bert = t.join(alignment="not_needed")
    bert.acquire("right")
    bert.engage("right", device="desktop" if entry == "controller/right" else "controller/right")
    assert (t.command("right").kind == "pose") == (entry == "operator")


CASES: list[tuple[str, dict[str, Any]]] = [
    ("scene_epoch", {"scene_epoch": 2}),
    ("tracking_epoch", {"tracking_epoch": 1}),
    ("alignment_version", {"alignment_version": 2}),
    ("stale", {"age_ns": 149 * MS}),  # the step itself comes 2 ms later
    ("future", {"age_ns": -8 * MS}),
    ("unknown_value", {"kind": "telepathy"}),
    ("device", {"kind": "joints", "q": (0.0,) * 7}),
    ("not_finite", {"p": (0.0, NAN, 1.0)}),
    ("not_finite", {"p": (0.0, 2000.0, 1.0)}),
    ("not_finite", {"pose": Pose((0.0, 0.0, 1.0), (math.inf, 0.0, 0.0, 0.0))}),
    ("not_finite", {"gripper": NAN}),
    ("not_finite", {"twist": (0.0, 0.0, NAN, 0.0, 0.0, 0.0)}),
    ("not_finite", {"hand_joints": (NAN,) * 7}),
    ("not_unit", {"pose": Pose((0.0, 0.0, 1.0), (1.002, 0.0, 0.0, 0.0))}),
    ("not_unit", {"pose": Pose((0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 0.0))}),
    ("jump", {"p": (0.5, 0.0, 1.0)}),
    ("jump", {"pose": Pose((0.0, 0.0, 1.0), TURNED)}),
    ("zero_pose", {"pose": IDENTITY}),
    ("zero_pose", {"pose": Pose((1e-7, 0.0, -1e-7), (-1.0, 0.0, 0.0, 1e-7))}),
    ("emulated", {"emulated": True}),
    ("shape", {"pose": None}),
    ("shape", {"kind": "twist"}),
    ("too_fast", {"kind": "twist", "twist": (11.0, 0.0, 0.0, 0.0, 0.0, 0.0)}),
    ("lease_version", {"targets": (Target("left", 0),)}),
    ("lease_version", {"targets": (Target("left", 2),)}),
]


@pytest.mark.parametrize(("reason", "fields"), CASES)
def test_rejection_has_its_reason_is_counted_and_rearms_the_senders_own_robot(
    reason: str, fields: dict[str, Any]
) -> None:
    t, op = engaged()
    op.sends("left", clutch=True, **fields)
    (event,) = t.since(SamplesRejected)
    assert (event.participant, event.reason, event.count) == (op.id, reason, 1)
    hold = reason if reason in ("jump", "zero_pose", "emulated") else "rejected"
    assert t.hold() == hold
    op.sends("left", clutch=True)
    assert t.hold() == hold
    op.engage("left")
    assert t.command().kind == "pose"


@pytest.mark.parametrize("fields", [{"device": "controller/third"}, {"targets": (Target("left", 1, "planet"),)}])
def test_unknown_words_are_rejected_and_touch_no_other_device_or_target(fields: dict[str, Any]) -> None:
    t, op = engaged()
    op.sends("left", clutch=True, **fields)
    assert t.since(SamplesRejected)[0].reason == "unknown_value"
    assert t.command().kind == "pose"


def test_old_seq_is_only_counted() -> None:
    t, op = engaged()
    op.seq -= 1
    op.sends("left", clutch=True)
    assert t.since(SamplesRejected)[0].reason == "seq"
    assert t.command().kind == "pose"


def test_old_or_future_receive_time() -> None:
    for shift, reason in ((-160 * MS, "stale"), (10 * MS, "future")):
        t, op = engaged()
        s = op.sample("left", clutch=True)
        t.step(Entry(op.connection, op.connection, t.now_ns + shift, s))
        assert t.since(SamplesRejected)[0].reason == reason


def test_capture_after_receipt_is_from_the_future() -> None:
    t, op = engaged()
    t.step(dt_ns=20 * MS)
    s = op.sample("left", clutch=True)
    t.step(Entry(op.connection, op.connection, t.now_ns - 6 * MS, s))
    assert t.since(SamplesRejected)[0].reason == "future"


def test_another_connection_cannot_speak_for_a_participant() -> None:
    t, op = engaged()
    s = op.sample("left", scene_epoch=9)
    t.step(Entry(77, op.connection, t.now_ns, s))
    assert t.since(SamplesRejected)[0] == SamplesRejected("", "controller/right", "connection_epoch", 1)
    assert t.command().kind == "pose"
    t.step(Entry(op.connection, 77, t.now_ns, op.sample("left", clutch=True)))
    assert t.since(SamplesRejected)[0].reason == "connection_epoch"
    assert t.hold() == "rejected"


def test_unknown_target_and_role() -> None:
    t, op = engaged()
    op.sends("nothing")
    assert t.since(SamplesRejected)[0].reason == "unknown_target"
    watcher = t.join("observer")
    watcher.sends("left")
    assert t.since(SamplesRejected)[0].reason == "role"
    assert t.command().kind == "pose"


def test_undeclared_device() -> None:
    t = Table()
    op = t.operator("left", devices=("head",))
    op.sends("left")
    assert t.since(SamplesRejected)[0].reason == "device"


def test_unaligned_holder_holds_unaligned() -> None:
    t = Table()
    op = t.join()
    op.acquire("left")
    op.sends("left")
    assert t.hold() == "unaligned"
    assert t.since(SamplesRejected)[0].reason == "unaligned"
    for _ in range(5):
        op.sends("left")
    told = [e.text for e in t.events if isinstance(e, Notice) and e.participant == op.id]
    assert told == ["person1 is not aligned and moves nothing: look at an anchor sheet"], "once, not with every sample"


def test_objects_take_poses_only_and_leaders_the_right_number_of_joints() -> None:
    t = Table(objects=("hammer",))
    leader = t.join("leader", alignment="not_needed")
    leader.acquire("left", objects=("hammer",))
    joints: dict[str, Any] = {"device": "joints", "kind": "joints", "pose": None}
    leader.engage("left", **joints, q=(0.0,) * 6)
    assert t.last(SamplesRejected).reason == "shape"
    leader.engage("left", **joints, q=(0.1,) * 7, qd=(0.2,) * 7)
    source = t.command().sources[0]
    assert (t.command().kind, source.q, source.qd) == ("joints", (0.1,) * 7, (0.2,) * 7)
    leader.sends("left", **joints, q=(1.0,) * 7, clutch=True)
    assert t.since(SamplesRejected)[0].reason == "too_fast"
    leader.sends("left", **joints, q=(0.1,) * 7, qd=(0.2,) * 3)
    leader.sends("hammer", **joints, q=(0.1,) * 7)
    leader.sends("hammer", **joints, q=(0.1,) * 7, clutch=True)
    t.wait(100 * MS)
    assert leader.told["left"].rejected == {"shape": 3, "too_fast": 1}


def test_leader_apart_is_refused_when_the_configuration_says_so() -> None:
    t = Table(AuthorityConfig(leader_apart="refuse"))
    leader = t.join("leader", alignment="not_needed")
    leader.acquire("left")
    joints: dict[str, Any] = {"device": "joints", "kind": "joints", "pose": None, "q": (0.3,) * 7}
    for q in (0.0, NAN):
        t.view = make_view(q={"left": (q,) * 7})
        leader.engage("left", **joints)
        assert t.since(SamplesRejected)[-1].reason == "leader_apart"
        t.wait(SECOND)  # a reason is reported once a second
    t.view = make_view(q={"left": (0.25,) * 7})
    leader.engage("left", **joints)
    assert t.command().kind == "joints"


def test_rejections_are_reported_at_most_once_per_second() -> None:
    t, op = engaged()
    for _ in range(600):
        op.sends("left", scene_epoch=5)
    reports = [e for e in t.events if isinstance(e, SamplesRejected)]
    assert [r.count for r in reports] == [1, 501]


def test_untracked_and_unworn_samples_need_no_payload() -> None:
    for fields, reason in (({"tracked": False}, "untracked"), ({"worn": False}, "not_worn")):
        t, op = engaged()
        op.sends("left", clutch=True, pose=None, **fields)
        assert t.hold() == reason
        op.sends("left", clutch=True)
        assert t.command().kind == "hold"


def test_a_pose_that_is_not_measured_drives_nothing_and_is_not_shown() -> None:
    t, op = engaged()
    op.sends("left", emulated=True)
    assert t.hold() == "emulated", "said also while the clutch is open"
    op.engage("left")
    assert t.command().kind == "pose"
    op.sends(emulated=True)
    assert t.decision.presence == ()
    op.sends()
    assert len(t.decision.presence) == 1


def test_capture_times_that_go_back_and_forth_make_no_time_for_a_jump() -> None:
    t = Table()
    anna = t.operator("left")
    anna.engage("left")
    anna.sends("left", clutch=True, age_ns=100 * MS)
    assert t.command().kind == "pose"
    anna.sends("left", clutch=True, p=(0.9, 0.0, 1.0))
    assert t.hold() == "jump"


@pytest.mark.parametrize(
    "between",
    [
        {"kind": "twist", "pose": None, "twist": (0.0,) * 6},
        {"tracked": False},
        {"worn": False},
        {"tracked": False, "pose": None},
    ],
)
def test_nothing_sent_in_between_makes_a_jump_possible(between: dict[str, Any]) -> None:
    t, op = engaged()
    op.sends(**between)
    op.sends("left", clutch=True, p=(0.9, 0.0, 1.0))
    assert t.command().kind == "hold"
    op.engage("left")
    assert t.command().kind == "pose"


def test_a_hand_that_was_not_tracked_for_a_while_may_be_elsewhere() -> None:
    """The time that counts is that since the pose it is compared with."""
    t, op = engaged()
    for _ in range(10):
        op.sends(tracked=False)
        t.step(dt_ns=20 * MS)
    op.engage("left", p=(0.9, 0.0, 1.0))
    assert t.command().kind == "pose"
