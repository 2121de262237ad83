"""Robots that go home when their lease ends: when they begin, and what ends it."""

from __future__ import annotations

import msgspec
import pytest

from iris_session.authority.arbitration import HOME_AFTER_NS, HOME_WITHIN_NS
from iris_session.protocol.client_messages import ClearEStop, Control, EStop, Release
from iris_session.protocol.entries import Lost

from .table import SECOND, Person, Table, make_view, robot

AWAY = {"left": (0.5,) * 7, "right": (0.0,) * 7, "third": (0.0,) * 7}


def make_table() -> tuple[Table, Person]:
    """Return a table whose robot `left` goes home, and who has moved it away."""
    t = Table(robots=(msgspec.structs.replace(robot("left"), on_release="home"), robot("right")))
    t.step()
    anna = t.operator("left", "right")
    t.view = make_view(q=AWAY, tick=t.view.tick)
    t.step()
    return t, anna


def test_a_released_robot_goes_home_until_it_is_there() -> None:
    t, anna = make_table()
    assert t.hold("left") == "no_sample", "it stays while it is held"
    anna.does(Release())
    assert t.hold("left") == "no_lease"
    t.wait(HOME_AFTER_NS)
    first = t.command("left")
    assert (first.kind, first.sources[0].q) == ("joints", (0.0,) * 7)
    assert t.hold("right") == "no_lease", "its specification says nothing"
    t.wait(SECOND)
    assert t.command("left").sources[0].engagement == first.sources[0].engagement
    t.view = make_view(tick=t.view.tick)
    t.step()
    assert t.hold("left") == "no_lease"
    t.view = make_view(q=AWAY, tick=t.view.tick)
    t.wait(SECOND)
    assert t.hold("left") == "no_lease", "what pushes it away afterwards moves nothing"


def test_a_robot_goes_home_when_its_holder_does_not_come_back_and_gives_up_after_a_while() -> None:
    t, anna = make_table()
    t.step(anna.says(Lost("silent")))
    t.wait(t.config.grace_ns - SECOND)
    assert t.hold("left") == "disconnected"
    t.wait(2 * SECOND)
    assert t.command("left").kind == "joints"
    t.wait(HOME_WITHIN_NS)
    assert t.hold("left") == "no_lease"


@pytest.mark.parametrize("what", ["estop", "pause", "gap", "holder"])
def test_what_ends_the_way_home_ends_it_for_good(what: str) -> None:
    t, anna = make_table()
    dora = t.join("director")
    anna.does(Release())
    t.wait(SECOND)
    assert t.command("left").kind == "joints"
    if what == "estop":
        dora.does(EStop("test"))
        assert t.hold("left") == "estop"
        dora.does(ClearEStop(1, 1))
    elif what == "pause":
        dora.does(Control(1, "pause"))
        dora.does(Control(2, "resume"))
    elif what == "gap":
        t.step(dt_ns=SECOND)
    else:
        bert = t.operator("left")
        assert t.hold("left") == "no_sample"
        t.step(bert.says(EStop("test")))
        bert.does(Release())
        dora.does(ClearEStop(1, 1))
    t.wait(SECOND)
    assert t.hold("left") == "no_lease"
