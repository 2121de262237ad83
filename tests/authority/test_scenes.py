"""Another scene in a running session: who keeps what, who is answered, what no longer counts."""

from __future__ import annotations

import msgspec
import pytest

from iris_session.authority import Authority, AuthorityConfig
from iris_session.protocol.client_messages import Acquire, Grasp
from iris_session.protocol.entries import SceneLoaded
from iris_session.protocol.server_messages import LeaseChanged, Reply, SceneChanged
from iris_session.protocol.specs import ObjectSpec

from .table import Person, Table, robot

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


def test_who_asked_for_consent_to_a_robot_that_is_gone_is_answered() -> None:
    t = Table(robots=(robot("left", "request"), robot("right")))
    t.operator("left")
    bob = t.operator()
    bob.does(Acquire(9, ("left",)))
    assert not bob.replies()
    load(t, other("right"))
    assert [r.denial.reason for r in bob.replies() if r.denial] == ["unknown_target"]


def test_a_robot_that_the_configuration_assigns_may_be_missing() -> None:
    t = Table(AuthorityConfig(policy="config", assignments={"ann": ("left", "right")}))
    ann = t.operator(name="ann")
    load(t, other("left"))
    reply = ann.asks(Acquire(1))
    assert [lease.target for lease in reply.leases] == ["left"]


def test_nobody_but_the_owner_of_the_session_loads_a_scene() -> None:
    t = Table()
    boss = t.join("director")
    t.step(boss.says(other("left")))
    assert not t.since(SceneChanged)
    assert t.hold("right") == "no_lease"


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
