"""Objects held by hands: latched offsets, several hands, no jump when the leading one lets go."""

from __future__ import annotations

import math
from typing import Any

import pytest

from iris_session.authority import AuthorityConfig
from iris_session.protocol.client_messages import Acquire, Control, Grasp, Release
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import Lost
from iris_session.protocol.server_messages import LeaseChanged, ObjectGrasped

from .table import MS, Person, Table, make_view

LEFT: dict[str, Any] = {"device": "hand/left", "p": (-1.0, 0.0, 0.0)}
RIGHT: dict[str, Any] = {"device": "hand/right", "p": (-0.5, 0.0, 0.0)}


def holding() -> tuple[Table, Person]:
    t = Table()
    anna = t.operator()
    assert anna.asks(Grasp(1, "hammer", "hand/left")).ok
    anna.engage("hammer", **LEFT)
    return t, anna


def move(anna: Person, hand: dict[str, Any], dx: float, *names: str, clutch: bool = True) -> None:
    x, y, z = hand["p"]
    anna.sends(*names, device=hand["device"], p=(x + dx, y, z), clutch=clutch)


def at(t: Table) -> float:
    return t.decision.objects[0].T_world_object.p[0]


def test_the_object_follows_the_hand_from_where_it_lay() -> None:
    t, anna = holding()
    (command,) = t.decision.objects
    assert command.T_world_object == Pose((0.0, 0.0, 0.2), (1.0, 0.0, 0.0, 0.0))
    assert t.since(ObjectGrasped) == [ObjectGrasped("hammer", anna.id, "hand/left", True)]
    move(anna, LEFT, 0.01, "hammer")
    assert at(t) == pytest.approx(0.01)
    move(anna, LEFT, 0.01, "hammer", clutch=False)
    assert t.decision.objects == ()
    assert not t.last(ObjectGrasped).grasped


def test_the_second_hand_takes_over_without_a_jump() -> None:
    t, anna = holding()
    bert = t.operator()
    assert bert.asks(Grasp(1, "hammer", "hand/right")).leases[0].sub_holders == (anna.id, bert.id)
    bert.engage("hammer", **RIGHT)
    first = t.decision.objects[0].grasp
    move(bert, RIGHT, 0.01, "hammer")
    assert at(t) == pytest.approx(0.0)
    move(anna, LEFT, 0.01, "hammer")
    before = at(t)
    anna.does(Release())
    assert at(t) == pytest.approx(before, abs=1e-12)
    assert t.decision.objects[0].grasp != first
    move(bert, RIGHT, 0.02, "hammer")
    assert at(t) == pytest.approx(before + 0.01)
    t.step(bert.says(Lost()))
    assert t.decision.objects == ()


def test_both_hands_of_one_person() -> None:
    t, anna = holding()
    anna.asks(Grasp(1, "hammer", "hand/right"))
    anna.engage("hammer", **RIGHT)
    move(anna, LEFT, 0.0, "hammer", clutch=False)
    assert len(t.decision.objects) == 1
    anna.sends("hammer", device="controller/left")
    assert anna.told == {}
    assert anna.asks(Grasp(1, "hammer", "hand/left")).ok  # again: nothing changes
    assert t.since(LeaseChanged) == []


def test_a_hand_without_samples_lets_go() -> None:
    t, _ = holding()
    t.step(dt_ns=149 * MS)
    t.step()
    assert t.decision.objects == ()


def test_acquired_objects_take_any_hand_and_a_reset_drops_them() -> None:
    t = Table(AuthorityConfig(max_sub_holders=1))
    anna, bert, boss = t.operator(), t.operator(), t.join("director")
    assert anna.asks(Acquire(1, (), ("hammer", "board"))).ok
    assert bert.denied(Acquire(1, (), ("hammer",))) == "held"
    assert bert.denied(Grasp(1, "hammer", "hand/left")) == "held"
    anna.engage("hammer", "board", **LEFT)
    assert [c.object for c in t.decision.objects] == ["hammer", "board"]
    boss.does(Control(1, "reset"))
    assert t.decision.objects == ()


def test_an_object_that_everyone_let_go_is_taken_from_where_it_lies() -> None:
    t, anna = holding()
    move(anna, LEFT, 0.01, "hammer")
    bert = t.operator()
    anna.does(Release())
    version = t.last(LeaseChanged).lease.lease_version + 1
    t.view = make_view(objects={"hammer": Pose((0.0, 0.3, 0.0), (1.0, 0.0, 0.0, 0.0))})
    bert.versions["hammer"] = version
    hand = {"device": "hand/right", "p": (-0.5, 0.0, 0.0)}
    bert_opens = bert.says(bert.sample("hammer", **hand))
    t.step(
        bert.says(Grasp(1, "hammer", "hand/right")), bert_opens, bert.says(bert.sample("hammer", clutch=True, **hand))
    )
    assert t.decision.objects[0].T_world_object.p == pytest.approx((0.0, 0.3, 0.0))


def test_nothing_is_taken_hold_of_in_the_step_of_a_reset() -> None:
    """What is seen of the world in that step is gone a moment later."""
    t, anna = holding()
    boss = t.join("director")
    anna.does(anna.sample("hammer", **LEFT))
    anna.scene_epoch = 2
    opens, closes = (anna.says(anna.sample("hammer", clutch=c, **LEFT)) for c in (False, True))
    t.step(boss.says(Control(1, "reset")), opens, closes)
    assert t.decision.reset
    assert t.decision.objects == ()
    anna.engage("hammer", **LEFT)
    assert t.decision.objects != ()


@pytest.mark.parametrize(
    "pose",
    [
        Pose((math.nan, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
        Pose((1e300, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
        Pose((0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 0.0)),
        Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_an_object_that_is_nowhere_is_not_held_and_needs_a_new_clutch(pose: Pose) -> None:
    t = Table()
    anna = t.operator()
    anna.asks(Grasp(1, "hammer", "hand/left"))
    t.view = make_view(objects={"hammer": pose})
    anna.engage("hammer", **LEFT)
    assert t.decision.objects == ()
    assert not t.last(ObjectGrasped).grasped
    t.view = make_view()
    move(anna, LEFT, 0.0, "hammer")
    assert t.decision.objects == ()
    anna.engage("hammer", **LEFT)
    assert t.decision.objects[0].T_world_object.p == pytest.approx((0.0, 0.0, 0.2))
