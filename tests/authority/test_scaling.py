"""Motion scaling: who may set it, for how long it lasts, and that everybody sees the one that commands carry."""

from __future__ import annotations

import math

import pytest

from iris_session.authority import Authority, AuthorityConfig
from iris_session.protocol.client_messages import Acquire, Assign, GetSnapshot, Release, SetMode, SetScale
from iris_session.protocol.entries import Lost
from iris_session.protocol.server_messages import LeaseChanged, ScaleChanged, Snapshot

from .table import MS, Person, Table, robot


def lease_scale(t: Table, name: str = "left") -> float:
    """What a late joiner is told."""
    late = t.join("observer")
    t.step(late.says(GetSnapshot(1)))
    (seen,) = [o.message for o in t.decision.outgoing if isinstance(o.message, Snapshot)]
    return next(lease.scale for lease in seen.leases if lease.target == name)


def commanded(t: Table, anna: Person, name: str = "left") -> float:
    """What control is told while `anna` drives."""
    anna.sends(name, clutch=True)
    assert t.command(name).kind == "pose"
    return t.command(name).scale


def test_a_holder_sets_the_scale_of_its_robot_and_everybody_sees_it() -> None:
    t = Table()
    anna = t.operator("left")
    anna.engage("left")
    t.step()
    t.step()
    assert t.command().scale == 1.0
    reply = anna.asks(SetScale(5, ("left",), 0.25))
    assert (reply.ok, reply.leases[0].target, reply.leases[0].scale) == (True, "left", 0.25)
    assert t.since(ScaleChanged) == [ScaleChanged("left", 0.25, anna.id)]
    assert t.command().scale == 0.25, "in the very step, without a new sample"
    engagement = t.command().sources[0].engagement
    assert commanded(t, anna) == 0.25
    assert t.command().sources[0].engagement == engagement, "it ends no engagement"
    assert lease_scale(t) == 0.25
    assert t.command("right").scale == 1.0


def test_the_same_scale_again_is_no_news() -> None:
    t = Table()
    anna = t.operator("left")
    assert anna.asks(SetScale(1, ("left",), 2)).ok
    assert t.last(ScaleChanged) == ScaleChanged("left", 2.0, anna.id)
    assert anna.asks(SetScale(1, ("left",), 2.0)).ok
    assert t.since(ScaleChanged) == []


def test_without_names_every_robot_of_the_sender_is_meant() -> None:
    t = Table(robots=(robot("left"), robot("right"), robot("third")))
    anna, bert = t.operator("left", "right"), t.operator("third")
    assert [lease.target for lease in anna.asks(SetScale(1, scale=0.5)).leases] == ["left", "right"]
    assert (lease_scale(t, "left"), lease_scale(t, "third")) == (0.5, 1.0)
    bert.does(Release())
    assert bert.denied(SetScale(1, scale=0.5)) == "not_holder"


@pytest.mark.parametrize("scale", [math.nan, math.inf, -math.inf, 0.0, -1.0, 0.049, 5.001, 1e308])
def test_a_scale_out_of_range_is_denied_with_the_range(scale: float) -> None:
    t = Table()
    anna = t.operator("left")
    denial = anna.asks(SetScale(1, ("left",), scale)).denial
    assert denial is not None
    assert denial.reason == "invalid"
    assert "0.05" in denial.advice
    assert "5" in denial.advice
    assert lease_scale(t) == 1.0


def test_the_range_is_that_of_the_configuration() -> None:
    t = Table(AuthorityConfig(min_scale=0.1, max_scale=0.5))
    anna = t.operator("left")
    anna.engage("left")
    assert t.command().scale == lease_scale(t) == 0.5, "where 1 is not allowed, the nearest is where everyone begins"
    assert anna.asks(SetScale(1, ("left",), 0.1)).ok
    assert anna.denied(SetScale(1, ("left",), 0.6)) == "invalid"


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-1.0, 1.0), (2.0, 1.0), (0.1, math.inf), (math.nan, 1.0)])
def test_a_range_that_cannot_work_is_refused(low: float, high: float) -> None:
    with pytest.raises(ValueError, match="min_scale"):
        Authority(AuthorityConfig(min_scale=low, max_scale=high), (robot("left"),), ())


def test_only_holder_and_directors_may_set_it() -> None:
    t = Table()
    anna, bert, boss = t.operator("left"), t.operator("right"), t.join("director")
    denial = bert.asks(SetScale(1, ("right", "left"), 0.5)).denial
    assert denial is not None
    assert (denial.reason, denial.target, denial.holder, denial.holder_name) == (
        "not_holder", "left", anna.id, anna.name
    )  # fmt: skip
    assert lease_scale(t, "right") == 1.0, "all or none"
    assert t.join("observer").denied(SetScale(1, ("left",), 0.5)) == "not_holder"
    assert bert.denied(SetScale(1, ("elbow",), 0.5)) == "unknown_target"
    assert bert.denied(SetScale(1, ("hammer",), 0.5)) == "unknown_target"
    assert boss.asks(SetScale(1, ("left",), 0.5)).ok
    assert t.since(ScaleChanged) == [ScaleChanged("left", 0.5, boss.id)]
    anna.engage("left")
    assert t.command().scale == 0.5
    t.step(t.host(SetScale(0, ("left",), 0.75)))
    assert t.since(ScaleChanged) == [ScaleChanged("left", 0.75, "host")]
    anna.does(Release())
    assert boss.denied(SetScale(1, ("left",), 0.5)) == "not_holder", "there is nobody to set it for"


def test_it_ends_with_the_lease() -> None:
    t = Table(robots=(robot("left", "takeover"), robot("right")))
    anna, bert, boss = t.operator("left"), t.operator(), t.join("director")
    for take in (
        lambda: bert.acquire("left"),
        lambda: boss.does(Assign(1, ("left",), anna.id)),
        lambda: anna.does(Release()),
    ):
        holder = next(p for p in (anna, bert) if p.id == t.last(LeaseChanged).lease.holder)
        assert holder.asks(SetScale(1, ("left",), 0.2)).ok
        take()
        assert t.last(LeaseChanged).lease.scale == lease_scale(t) == 1.0
    anna.acquire("left")
    anna.engage("left")
    assert t.command().scale == 1.0, "nor does it come back to whoever had set it"


def test_it_outlives_a_lost_connection_with_the_lease() -> None:
    t = Table()
    anna = t.operator("left", devices=("controller/right",))
    anna.does(SetScale(1, ("left",), 0.2))
    t.step(anna.says(Lost("silent")))
    assert t.last(LeaseChanged).lease.scale == 0.2
    t.join(key_id="key1", resume_of=anna.id)
    assert t.last(LeaseChanged).lease.holder == anna.id
    assert lease_scale(t) == 0.2


def test_sharers_have_one_scale() -> None:
    t = Table(robots=(robot("left", "shared"), robot("right")))
    anna, bert = t.operator("left"), t.operator("left")
    bert.does(SetScale(1, ("left",), 0.5))
    carl = t.operator("left")
    anna.engage("left")
    bert.engage("left")
    assert (len(t.command().sources), t.command().scale) == (2, 0.5)
    anna.does(Release())
    assert lease_scale(t) == 0.5, "nobody's motion changes because another one leaves"
    carl.does(SetScale(1, ("left",), 0.25))
    assert commanded(t, bert) == 0.25


def test_a_human_who_preempts_an_agent_has_a_scale_of_its_own() -> None:
    t = Table(robots=(robot("left", "priority"), robot("right")))
    agent = t.join("agent", alignment="not_needed")
    agent.acquire("left")
    agent.does(SetScale(1, ("left",), 2.0))
    agent.engage("left")
    assert t.command().scale == 2.0
    human = t.operator("left")
    assert human.asks(SetScale(1, ("left",), 0.1)).ok
    assert t.since(ScaleChanged) == [], "it stands by: nothing has changed yet"
    agent.learn((t.last(LeaseChanged).lease,))
    human.engage("left")
    assert (t.command().scale, lease_scale(t)) == (0.1, 0.1)
    human.sends("left", clutch=False)
    assert lease_scale(t) == 2.0
    human.does(Release())
    assert lease_scale(t) == 2.0


def test_a_mode_change_keeps_the_scale_of_the_one_in_charge() -> None:
    t = Table(robots=(robot("left", "shared"), robot("right")))
    boss = t.join("director")
    anna = t.operator("left")
    t.operator("left")
    anna.does(SetScale(1, ("left",), 0.5))
    boss.does(SetMode(1, "left", "exclusive"))
    assert lease_scale(t) == 0.5


def test_a_snapshot_holds_it() -> None:
    t = Table()
    anna = t.operator("left")
    anna.does(SetScale(1, ("left",), 0.3))
    anna.engage("left")
    other = Authority(t.config, t.robots, t.objects)
    other.restore(t.authority.snapshot())
    entry = anna.says(anna.sample("left", clutch=True))
    now_ns = t.now_ns + 2 * MS
    one = t.authority.step(now_ns, (entry,), 1, t.view)
    two = other.step(now_ns, (entry,), 1, t.view)
    assert one == two
    assert two.commands[0].scale == 0.3


def test_a_new_participant_of_the_same_name_begins_at_one() -> None:
    t = Table()
    anna = t.operator("left", name="anna")
    anna.does(SetScale(1, ("left",), 0.3))
    t.step(anna.says(Lost("silent")))
    t.wait(t.config.grace_ns + 100 * MS)
    again = t.join(name="anna")
    t.step(again.says(Acquire(1, ("left",))))
    assert t.last(LeaseChanged).lease.holder == again.id
    assert t.last(LeaseChanged).lease.scale == 1.0
