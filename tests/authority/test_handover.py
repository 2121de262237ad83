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


def test_handing_back_is_a_second_one() -> None:
    t = Table()
    contact(t, 200, "left")
    contact(t, 50, "left", "left right")
    contact(t, 50, "left right")
    contact(t, 50, "right", "left right")
    contact(t, 200, "right")
    contact(t, 50, "left right")
    contact(t, 200, "left")
    assert [(h.giver, h.receiver) for h in handovers(t)] == [("left", "right"), ("right", "left")]
    assert handovers(t)[0].duration_ns == 140 * MS


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


def test_receiver_that_only_tried_is_forgotten() -> None:
    t = Table(robots=(robot("left"), robot("right"), robot("third")))
    contact(t, 200, "left")
    contact(t, 50, "left", "left right")
    contact(t, 100, "left")
    contact(t, 50, "left third")
    contact(t, 200, "third")
    assert [(h.giver, h.receiver, h.duration_ns) for h in handovers(t)] == [("left", "third", 40 * MS)]


def test_unknown_objects_and_paused_physics_change_nothing() -> None:
    t = Table()
    t.view = msgspec.structs.replace(t.view, contacts=(ObjectContact("ghost", ("left",), ("left",), ()),))
    t.step()
    t.step(n_ticks=0)
    t.step()
    assert t.authority.snapshot().count(b"ghost") == 0
