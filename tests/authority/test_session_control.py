"""E-stop, pause, reset, gaps and scene epochs."""

from __future__ import annotations

import msgspec
import pytest

from iris_session.authority import Authority, AuthorityConfig
from iris_session.protocol.client_messages import Acquire, ClearEStop, Control, EStop, Grasp, Release
from iris_session.protocol.entries import (
    Entry,
    ExternalReset,
    Join,
    Lost,
    OwnerListens,
    PhysicsDiverged,
    RecordingGap,
    SceneLoaded,
    StalledGap,
)
from iris_session.protocol.server_messages import (
    EStopChanged,
    Gap,
    LeaseChanged,
    ParticipantLeft,
    PauseChanged,
    Reply,
    SceneChanged,
)
from iris_session.protocol.specs import ObjectSpec

from .table import MS, SECOND, Person, Table, robot


def playing() -> tuple[Table, Person, Person]:
    t = Table()
    op, boss = t.operator("left"), t.join("director")
    op.engage("left")
    return t, op, boss


def test_anyone_stops_everything_in_the_same_step_however_long_the_batch() -> None:
    t, op, _ = playing()
    watcher = t.join("observer")
    flood = [op.says(op.sample("left", clutch=True)) for _ in range(500)]
    t.step(*flood, watcher.says(EStop("fire")))
    assert t.decision.estop
    assert t.hold() == "estop"
    assert t.since(EStopChanged) == [EStopChanged(True, watcher.id, "fire", 1)]
    op.engage("left")
    assert t.hold() == "estop"


def test_an_estop_with_an_old_envelope_still_stops() -> None:
    t, op, _ = playing()
    t.step(Entry(op.connection, 99, t.now_ns, EStop()))
    assert t.hold() == "estop"


def test_clearing_needs_a_director_and_a_new_clutch() -> None:
    t, op, boss = playing()
    op.does(EStop())
    assert op.denied(ClearEStop(1, 1)) == "role"
    op.engage("left")
    assert boss.asks(ClearEStop(1, 1)).ok
    assert t.since(EStopChanged) == [EStopChanged(False, boss.id, "", 1)]
    assert boss.asks(ClearEStop(1, 1)).ok
    assert t.since(EStopChanged) == []
    assert t.hold() == "estop"
    op.sends("left", clutch=True)
    assert t.hold() == "estop"
    op.engage("left")
    assert t.command().kind == "pose"


def test_every_stop_is_counted_and_announced_also_while_stopped() -> None:
    t, op, boss = playing()
    watcher = t.join("observer")
    op.does(EStop("sparks"))
    t.step(watcher.says(EStop("smoke")), boss.says(EStop("fire")), watcher.says(EStop("still smoke")))
    assert t.since(EStopChanged) == [EStopChanged(True, watcher.id, "smoke", 2), EStopChanged(True, boss.id, "fire", 3)]
    assert t.authority.stop_seq == 3
    stops = t.authority.build_stop_reports()
    assert [(s.stop_seq, s.participant, s.name, s.reason) for s in stops] == [
        (3, boss.id, boss.name, "fire"),
        (2, watcher.id, watcher.name, "smoke"),
        (1, op.id, op.name, "sparks"),
    ]
    t.wait(SECOND)
    assert stops[0].age_ns == 0
    assert t.authority.build_stop_reports()[0].age_ns == SECOND


def test_a_clear_lifts_no_stop_that_its_sender_has_not_seen() -> None:
    t, op, boss = playing()
    watcher = t.join("observer")
    op.does(EStop("sparks"))
    watcher.does(EStop("a hand is in the cell"))
    for seen in (0, 1):
        reply = boss.asks(ClearEStop(1, seen))
        assert reply.denial is not None
        assert (reply.denial.reason, reply.denial.holder, reply.denial.holder_name) == (
            "estop", watcher.id, watcher.name,
        )  # fmt: skip
        assert "a hand is in the cell" in reply.denial.message
        assert "2" in reply.denial.advice
        assert t.decision.estop
    assert boss.denied(ClearEStop(1, 3)) == "invalid", "nobody has seen a stop that has not come"
    assert t.decision.estop
    assert boss.asks(ClearEStop(1, 2)).ok
    assert not t.decision.estop
    assert t.authority.build_stop_reports() == ()
    op.does(EStop("again"))
    assert t.since(EStopChanged) == [EStopChanged(True, op.id, "again", 3)], "numbers go on"


def test_pause_and_resume_rearm() -> None:
    t, op, boss = playing()
    assert op.denied(Control(1, "pause")) == "role"
    assert boss.denied(Control(1, "fly")) == "unknown_value"
    assert boss.denied(Control(1, "step")) == "invalid"
    assert boss.asks(Control(1, "pause")).ok
    assert t.decision.paused
    assert t.hold() == "gap"
    op.engage("left")
    assert t.command().kind == "hold"
    boss.asks(Control(1, "step", 5))
    assert t.decision.step_ticks == 5
    t.step(boss.says(Control(1, "step", 5)), boss.says(Control(2, "step", 7)))
    assert t.decision.step_ticks == 12
    t.step(boss.says(Control(1, "step", 10_000)), boss.says(Control(2, "step", 7)))
    assert t.decision.step_ticks == 10_000
    boss.asks(Control(1, "pause"))
    assert t.since(PauseChanged) == []
    boss.asks(Control(1, "resume"))
    assert t.since(PauseChanged) == [PauseChanged(False, boss.id)]
    assert t.decision.step_ticks == 0
    op.sends("left", clutch=True)
    assert t.command().kind == "hold"
    op.engage("left")
    assert t.command().kind == "pose"


def diverged() -> tuple[Table, Person, Person]:
    t, op, boss = playing()
    t.step(t.host(PhysicsDiverged(1, "NaN in QPOS at DOF 3")))
    assert t.decision.paused
    assert [(e.paused, e.participant) for e in t.since(PauseChanged)] == [(True, "host")]
    assert "NaN in QPOS" in t.last(PauseChanged).reason
    assert "NaN in QPOS" in t.authority.pause_reason
    return t, op, boss


@pytest.mark.parametrize("action", ["reset", "resume"])
def test_one_command_mends_physics_that_diverged(action: str) -> None:
    t, op, boss = diverged()
    assert boss.asks(Control(1, action)).ok
    assert (t.decision.reset, t.decision.paused, t.decision.scene_epoch) == (True, False, 2)
    assert t.since(PauseChanged) == [PauseChanged(False, boss.id)]
    assert t.authority.pause_reason == ""
    op.scene_epoch = 2
    op.engage("left")
    assert t.command().kind == "pose"


def test_physics_that_diverged_takes_no_ticks_and_stays_paused_when_a_director_wants_it() -> None:
    t, _, boss = diverged()
    denial = boss.asks(Control(1, "step", 1)).denial
    assert denial is not None
    assert "NaN in QPOS" in denial.message
    assert "reset" in denial.advice
    boss.asks(Control(2, "pause"))
    boss.asks(Control(3, "reset"))
    assert (t.decision.reset, t.decision.paused, t.authority.pause_reason) == (True, True, "")
    boss.asks(Control(4, "resume"))
    assert (t.decision.reset, t.decision.paused) == (False, False)


def test_what_diverged_before_a_reset_is_over() -> None:
    t, _, boss = playing()
    boss.asks(Control(1, "reset"))
    t.step(t.host(PhysicsDiverged(1, "NaN")))
    assert not t.decision.paused


def test_reset_starts_a_scene_epoch_and_keeps_leases() -> None:
    t, op, boss = playing()
    t.step(boss.says(Control(1, "reset")), boss.says(Control(2, "reset")))
    assert (t.decision.reset, t.decision.scene_epoch) == (True, 2)
    assert t.since(SceneChanged) == [SceneChanged(2, 0, "reset")]
    assert t.hold() == "scene_changed"
    op.engage("left")
    assert t.hold() == "scene_changed"
    op.scene_epoch = 2
    op.engage("left")
    assert t.command().kind == "pose"
    t.step(t.host(ExternalReset()))
    assert (t.decision.reset, t.decision.scene_epoch, t.hold()) == (False, 3, "scene_changed")


def test_a_loop_of_the_user_is_not_paused_or_reset() -> None:
    t = Table(AuthorityConfig(user_owned_loop=True))
    boss = t.join("director")
    for action in ("pause", "resume", "step", "reset"):
        assert boss.denied(Control(1, action)) == "user_owned"


def test_an_owner_that_listens_is_asked_to_reset() -> None:
    t = Table(AuthorityConfig(user_owned_loop=True))
    boss = t.join("director")
    t.step(t.host(OwnerListens()))
    assert boss.denied(Control(1, "pause")) == "user_owned"
    assert boss.asks(Control(2, "reset")).ok
    assert not t.decision.reset


def test_a_gap_between_steps_holds_until_clutched_again() -> None:
    t, op, _ = playing()
    t.step(op.says(op.sample("left", clutch=True)), t.host(StalledGap(SECOND)), dt_ns=151 * MS)
    assert t.since(Gap) == [Gap("stalled", 151 * MS)]
    assert t.hold() == "gap"
    op.engage("left")
    t.step(t.host(StalledGap(40 * MS)))
    assert t.since(Gap) == [Gap("stalled", 40 * MS)]
    assert t.hold() == "gap"


def test_nobody_expires_in_a_gap_before_the_waiting_entries_came() -> None:
    t, op, _ = playing()
    lost = t.operator("right")
    t.step(lost.says(Lost()))
    t.step(dt_ns=40 * SECOND)
    assert (t.hold("left"), t.hold("right")) == ("gap", "gap")
    assert t.last(LeaseChanged).lease.expires_ns == t.now_ns + 250 * MS
    t.step(op.says(op.sample("left")), dt_ns=100 * MS)
    t.wait(200 * MS)
    assert (t.hold("left"), t.hold("right")) == ("clutch_open", "no_lease")


def test_where_every_step_is_a_gap_the_silent_and_the_lost_expire_all_the_same() -> None:
    t, op, _ = playing()
    lost = t.operator("right")
    t.step(lost.says(Lost()))
    left = []
    for _ in range(170):
        t.step(dt_ns=200 * MS)
        assert t.since(Gap) != []
        left += [(e.participant, e.grace, t.now_ns) for e in t.since(ParticipantLeft)]
    start = t.now_ns - 34 * SECOND
    gone = {(who, grace): (when - start) * 1e-9 for who, grace, when in left}
    assert gone[(op.id, True)] == pytest.approx(3.3, abs=0.3)
    assert gone[(lost.id, False)] == pytest.approx(30.2, abs=0.5)
    assert gone[(op.id, False)] == pytest.approx(33.3, abs=0.5)


def test_recording_gap_is_announced() -> None:
    t, *_ = playing()
    t.step(t.host(RecordingGap(3)))
    assert t.since(Gap) == [Gap("recording", 0, 3)]


def test_release_acts_before_an_acquire_that_was_sent_earlier() -> None:
    t = Table()
    other = t.join()
    t.step(other.says(Acquire(1, ("right",))), other.says(Release(2)))
    assert [(r.request_id, r.ok) for r in other.replies()] == [(2, True), (1, False)]
    t.step(other.says(Release(3)), other.says(Acquire(4, ("right",))))
    assert [(r.request_id, r.ok) for r in other.replies()] == [(3, True), (4, True)]


def test_a_stop_that_comes_with_its_senders_hello_or_before_it_stops() -> None:
    t = Table()
    t.step(Entry(7, 0, t.now_ns, EStop()), Entry(7, 7, t.now_ns, Join("key", "operator", "anna")))
    assert [a.connection for a in t.decision.admitted] == [7]
    assert t.decision.estop
    t = Table()
    t.step(Entry(7, 0, t.now_ns, EStop()))
    t.step(Entry(7, 7, t.now_ns, Join("key", "operator", "anna")))
    assert t.decision.estop
    assert [a.connection for a in t.decision.admitted] == [7]


# --- another scene in a running session ---


HASH = "0123456789abcdef" * 2


def other(*robots: str) -> SceneLoaded:
    return SceneLoaded(HASH, tuple(map(robot, robots)), (ObjectSpec("cup", "cup"),))


def load(t: Table, scene: SceneLoaded) -> None:
    t.step(t.host(scene))


def test_who_holds_a_robot_that_the_new_scene_has_keeps_it_and_must_clutch_again() -> None:
    t = Table()
    ann = t.operator("left")
    ann.engage("left")
    version = t.authority._ctx.state.robots["left"].version
    t.view = msgspec.structs.replace(t.view, tick_period_ns=1_000_000)
    load(t, other("third", "left"))
    assert t.since(SceneChanged) == [SceneChanged(2, 0, "new_scene", tick_period_ns=1_000_000)]
    assert [c.robot for c in t.decision.commands] == ["third", "left"]
    assert (t.hold("left"), t.hold("third")) == ("scene_changed", "no_lease")
    ann.engage("left")
    assert t.hold("left") == "scene_changed", "what was sent for the old scene does not count"
    ann.scene_epoch = 2
    ann.engage("left")
    assert t.command("left").kind == "pose"
    assert t.authority._ctx.state.robots["left"].version == version


def test_what_the_new_scene_has_not_is_taken_from_its_holders() -> None:
    t = Table()
    ann, bob = t.operator("right"), t.operator()
    bob.does(Grasp(1, "hammer", "controller/right"))
    load(t, other("left"))
    ended = {e.lease.target: (e.lease.holder, e.cause, e.previous_holder) for e in t.since(LeaseChanged)}
    assert ended == {"right": ("", "scene_changed", ann.id), "hammer": ("", "scene_changed", bob.id)}
    assert ann.denied(Acquire(2, ("right",))) == "unknown_target"
    assert ann.asks(Acquire(3, ("left",))).ok
    assert bob.asks(Acquire(4, (), ("cup",))).ok


def waiting(t: Table, *robots: str) -> Person:
    person = t.operator()
    person.does(Acquire(7, robots, wait=True))
    assert not person.replies()
    return person


def test_who_waits_for_what_is_no_more_is_answered_and_the_others_wait_on() -> None:
    t = Table()
    t.operator("left", "right")
    gone, stays, any_robot = waiting(t, "right"), waiting(t, "left"), waiting(t)
    load(t, other("left", "third"))
    answers = {o.connection: o.message for o in t.decision.outgoing if isinstance(o.message, Reply)}
    denial = answers[gone.connection].denial
    assert denial is not None
    assert (denial.reason, "right" in denial.message) == ("unknown_target", True)
    assert stays.connection not in answers
    assert answers[any_robot.connection].ok, "a robot has become free"
    assert answers[any_robot.connection].leases[0].target == "third"


def test_a_snapshot_knows_the_scene_it_is_of() -> None:
    t = Table()
    ann = t.operator("left")
    before = t.authority.snapshot()
    load(t, other("third", "left"))
    after = t.authority.snapshot()
    again = Authority(t.config, t.robots, t.objects)
    again.restore(after)
    assert again.snapshot() == after
    entry = ann.says(Acquire(2, ("third",)))
    assert again.step(t.now_ns + 1, (entry,), 1, t.view) == t.authority.step(t.now_ns + 1, (entry,), 1, t.view)
    again.restore(before)
    assert again.scene is None
    with pytest.raises(ValueError, match="this session has \\['left', 'right'\\]"):
        again.restore(before.replace(b"right", b"wrong"))
