"""`Authority` as a whole: urgent lane, quotas, snapshots for late joiners, construction, time, snapshot and restore."""

from __future__ import annotations

import math
from typing import Any

import pytest

from iris_session.authority import Authority, AuthorityConfig
from iris_session.authority.config import SpeedLimit
from iris_session.protocol.client_messages import Acquire, Bye, Heartbeat, Marker, Release
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import Audit, Entry, ExternalReset, Lost, PhysicsDiverged, RecordingGap, SceneLoaded
from iris_session.protocol.server_messages import MarkerAdded, SamplesRejected, Snapshot
from iris_session.protocol.specs import ObjectSpec

from .table import Table, make_view, proposal, robot


def test_release_and_lost_act_in_the_step_they_arrive_in_behind_any_flood() -> None:
    t = Table()
    anna, bert, carl = t.operator("left"), t.operator("right"), t.operator()
    anna.engage("left")
    bert.engage("right")
    flood = [carl.says(Heartbeat()) for _ in range(2000)]
    t.step(*flood, anna.says(Release()), bert.says(Lost()))
    assert (t.hold("left"), t.hold("right")) == ("no_lease", "disconnected")


def test_excess_over_the_quota_is_counted_denied_and_holds() -> None:
    t = Table(AuthorityConfig(quota=4))
    anna, bert = t.operator("left"), t.operator("right")
    bert.engage("right")
    anna.engage("left")
    batch = [anna.says(anna.sample("left", clutch=True)) for _ in range(6)]
    t.step(*batch, bert.says(bert.sample("right", clutch=True)))
    assert t.since(SamplesRejected) == [SamplesRejected(anna.id, "controller/right", "quota", 1)]
    assert t.hold("left") == "rejected"
    assert t.command("right").sources[0].new
    t.step(*(anna.says(Marker(i, "x")) for i in range(6)))
    assert [(r.request_id, r.ok) for r in anna.replies()] == [(4, False), (5, False)] + [(i, True) for i in range(4)]
    t.step(*(Entry(50, 50, t.now_ns, Heartbeat()) for _ in range(6)))
    assert t.since(SamplesRejected)[0].participant == ""


def test_host_has_no_quota_and_the_rights_of_a_director() -> None:
    t = Table(AuthorityConfig(quota=1))
    t.step(*(t.host(Marker(i, "x")) for i in range(3)))
    assert len(t.since(MarkerAdded)) == 3
    assert t.since(MarkerAdded)[0].participant == "host"


def test_what_only_the_host_may_say_does_nothing_from_others() -> None:
    t = Table()
    boss = t.join("director")
    loaded = SceneLoaded("0" * 32, (), ())
    for message in (ExternalReset(), PhysicsDiverged(1, "NaN"), RecordingGap(3), Audit("flood"), loaded):
        t.step(boss.says(message))
        assert t.decision.events == ()


def test_strangers_and_wrong_envelopes_are_answered() -> None:
    t = Table()
    anna = t.join()
    t.step(Entry(9, 9, t.now_ns, Acquire(3, ("left",))))
    (out,) = t.decision.outgoing
    assert (out.connection, out.message.denial.reason) == (9, "not_joined")
    t.step(Entry(anna.connection, 9, t.now_ns, Acquire(3, ("left",))), Entry(9, 9, t.now_ns, Release(4)))
    assert anna.replies()[0].denial.reason == "not_joined"
    assert [o.message.denial.reason for o in t.decision.outgoing if o.connection == 9] == ["not_joined"]
    t.step(Entry(anna.connection, 9, t.now_ns, Bye()))
    assert t.decision.dropped == ()


def snapshots(t: Table) -> list[Snapshot]:
    return [o.message for o in t.decision.outgoing if isinstance(o.message, Snapshot)]


def test_presence_is_in_the_world_and_only_of_the_aligned() -> None:
    t = Table()
    anna, watcher = t.operator("left"), t.join("observer")
    watcher.sends(device="head")
    assert t.decision.presence == ()
    t.step(watcher.says(proposal()))
    t.step(
        watcher.says(watcher.sample(device="head")),
        watcher.says(watcher.sample(device="head", p=(0.01, 0.0, 1.0))),
        anna.says(anna.sample("left")),
    )
    shown = {(i.participant, i.device): i.pose for i in t.decision.presence}
    assert shown[(watcher.id, "head")] == Pose((1.01, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
    assert shown.keys() == {(watcher.id, "head"), (anna.id, "controller/right")}
    t.step()
    assert t.decision.presence == ()


@pytest.mark.parametrize(
    ("config", "robots", "objects", "text"),
    [
        ({}, (robot("a"), robot("a")), (), "robot names must differ"),
        ({}, (), (ObjectSpec("o", "o"), ObjectSpec("o", "p")), "object names must differ"),
        ({}, (robot("a", "anarchy"),), (), "unknown lease mode 'anarchy'"),
        ({"default_mode": "anarchy"}, (), (), "unknown lease mode 'anarchy'"),
        ({"policy": "luck"}, (), (), "unknown assignment policy 'luck'"),
        ({"assignments": {"anna": ("b",)}}, (robot("a"),), (), "unknown robots"),
        ({"leader_apart": "jump"}, (), (), "must be 'ramp' or 'refuse'"),
        ({"speed_limits": {"head": SpeedLimit(1.0, 1.0)}}, (), (), "speed_limits lacks controller/left, "),
        ({"contact_step_n": 0.0}, (), (), "contact_step_n is 0.0; it must be positive"),
        ({"max_anchor_move_m": 0.0}, (), (), "max_anchor_move_m is 0"),
        ({"anchors": {"x": Pose((math.nan, 0.0, 0.0), IDENTITY.q)}}, (), (), "anchor 'x'"),
        ({"min_scale": 0.0}, (), (), "min_scale"),
        ({"min_scale": 2.0, "max_scale": 1.0}, (), (), "min_scale"),
        ({"max_scale": math.inf}, (), (), "min_scale"),
        ({"min_scale": math.nan}, (), (), "min_scale"),
    ],
)
def test_construction_says_what_would_be_right(config: dict[str, Any], robots: Any, objects: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Authority(AuthorityConfig(**config), robots, objects)


def test_time_does_not_go_back() -> None:
    t = Table()
    t.step()
    for now_ns, n_ticks in ((t.now_ns - 1, 1), (t.now_ns, -1)):
        with pytest.raises(ValueError, match="must be >= 0"):
            t.authority.step(now_ns, (), n_ticks, make_view())


def test_restore_needs_the_same_robots_and_objects() -> None:
    snapshot = Table().authority.snapshot()
    with pytest.raises(ValueError, match="the snapshot has robots"):
        Table(robots=(robot("other"),)).authority.restore(snapshot)
