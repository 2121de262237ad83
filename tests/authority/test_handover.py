"""Handovers by contact: giver alone, both, receiver alone, and nothing else in between."""

from __future__ import annotations

import msgspec
import pytest

from iris_session.protocol.client_messages import Grasp
from iris_session.protocol.server_messages import Handover
from iris_session.protocol.steps import ObjectContact

from .table import MS, Table, robot


def contact(t: Table, duration_ms: int, grippers: str = "", touching: str = "", *others: str) -> None:
    """Steps of 10 ms in which `grippers` hold the hammer; `touching` defaults to the same robots."""
    held = tuple(grippers.split())
    now = ObjectContact("hammer", held, tuple(touching.split()) or held, others)
    seen = (now,) if held or now.touching or others else ()
    t.view = msgspec.structs.replace(t.view, contacts=seen)
    for _ in range(duration_ms // 10):
        t.step(dt_ns=10 * MS)


def handovers(t: Table) -> list[Handover]:
    return [e for e in t.events if isinstance(e, Handover)]


def test_giver_both_receiver_is_a_handover_with_the_time_both_touched() -> None:
    t = Table()
    anna, bert = t.operator("left"), t.operator("right")
    t.step()
    contact(t, 100, "left", "left", "table")
    contact(t, 200, "left")
    contact(t, 300, "left right")
    contact(t, 90, "right")
    assert handovers(t) == []
    contact(t, 20, "right")
    (h,) = handovers(t)
    assert (h.object, h.giver, h.receiver) == ("hammer", "left", "right")
    assert (h.giver_participant, h.receiver_participant) == (anna.id, bert.id)
    assert h.duration_ns == 290 * MS
    contact(t, 100, "right", "right", "table")
    assert len(handovers(t)) == 1


def test_single_ticks_without_contact_are_flicker() -> None:
    t = Table()
    contact(t, 200, "left")
    contact(t, 30)
    contact(t, 50, "left right")
    contact(t, 30, "", "left right")
    contact(t, 50, "left right")
    contact(t, 20)
    contact(t, 20, "", "right")
    contact(t, 200, "right")
    assert len(handovers(t)) == 1


@pytest.mark.parametrize("between", ["table", "third", "fall", "short", "hand", "dropped", "let_go", "loose"])
def test_what_is_no_handover(between: str) -> None:
    t = Table(robots=(robot("left"), robot("right"), robot("third")))
    anna = t.operator()
    contact(t, 50 if between == "short" else 200, "left")
    if between == "short":
        contact(t, 30, "left right")
        contact(t, 200, "right")
    elif between == "fall":
        contact(t, 100)
    elif between == "dropped":
        contact(t, 100, "left right")
        contact(t, 100)
    elif between == "loose":
        contact(t, 100, "", "left")
    elif between == "let_go":
        contact(t, 100, "left right")
        contact(t, 100, "left")
        contact(t, 100)
    else:
        contact(t, 100, "left right")
        if between == "table":
            contact(t, 10, "left right", "", "table")
        elif between == "third":
            contact(t, 10, "left right", "left right third")
        else:
            anna.asks(Grasp(1, "hammer", "hand/left"))
            anna.engage("hammer", device="hand/left")
            t.step()
        contact(t, 30, "left right")
    contact(t, 200, "right")
    assert handovers(t) == []


ARMS = ("a1", "a2", "b1", "b2")


def two_arms_each() -> tuple[Table, str, str]:
    """anna has a1 and a2, bert b1 and b2."""
    t = Table(robots=tuple(robot(name) for name in ARMS))
    t.view = msgspec.structs.replace(
        t.view, tips=dict.fromkeys(ARMS, t.view.tip_pose("left")), q=dict.fromkeys(ARMS, (0.0,) * 7)
    )
    anna, bert = t.operator("a1", "a2"), t.operator("b1", "b2")
    return t, anna.id, bert.id


@pytest.mark.parametrize(
    ("course", "arms"),
    [
        (["a1", "a1 b1", "a1 a2 b1", "a1 b1", "b1"], ("a1", "b1")),  # the giver steadies it with the other arm
        (["a1", "a1 b1", "a1 b1 b2", "b1 b2"], ("a1", "b1")),  # taken with both arms
        (["a1 a2", "a1 a2 b1", "a2 b1", "b1"], ("a2", "b1")),  # carried with both, the second arm lets go last
        (["a1", "a1 b1", "a1 b1 b2", "a1 b2", "b2"], ("a1", "b2")),
        (["a1", "a1 a2", "a2", "a2 b1", "b1"], ("a2", "b1")),  # from hand to hand first
    ],
)
def test_two_arms_of_one_person_are_one_giver_and_one_receiver(course: list[str], arms: tuple[str, str]) -> None:
    t, anna, bert = two_arms_each()
    for grippers in course:
        contact(t, 200, grippers)
    between = [h for h in handovers(t) if h.giver_participant != h.receiver_participant]
    assert [(h.giver, h.receiver, h.giver_participant, h.receiver_participant) for h in between] == [
        (*arms, anna, bert)
    ]
