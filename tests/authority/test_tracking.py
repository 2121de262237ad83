"""Tracking that jumps, freezes or is not there moves nothing; people who move fast are not stopped."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import pytest

from iris_session.authority import AuthorityConfig, is_same_snapshot
from iris_session.authority.config import SPEED_LIMITS
from iris_session.authority.tracking import JUMP, OUTLIER, STEADY, SURPRISE, Track, follow_pose
from iris_session.protocol.common import Pose
from iris_session.protocol.server_messages import EngagementChanged, SamplesRejected

from .table import MS, SECOND, Table, proposal

HAND = SPEED_LIMITS["hand/right"]
RATES_HZ = (30, 60, 72, 90)


def follow(points: Sequence[tuple[float, ...]], turn: float = 0.0) -> list[str]:
    """Return the verdicts on positions [m], along one or two axes, at times [s]; `turn`: radians per metre."""
    track: Track | None = None
    verdicts = []
    for seconds, x, *aside in points:
        pose = Pose((x, sum(aside), 1.0), (math.cos(turn * x / 2), 0.0, 0.0, math.sin(turn * x / 2)))
        if track is None:
            track = Track(pose, round(seconds * 1e9), round(seconds * 1e9))
        else:
            verdicts.append(follow_pose(track, HAND, pose, round(seconds * 1e9)))
    return verdicts


def stroke(seconds: float) -> float:
    """Position in a stroke of minimum jerk that reaches 8 m/s and 100 m/s^2, and back after it [m]."""
    length, duration = 1.0507, 0.24627
    s = min(1.0, abs(seconds - duration) / duration)
    return length * (1.0 - s**3 * (10.0 + s * (6.0 * s - 15.0)))


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_a_stroke_of_table_tennis_is_no_jump_wherever_it_is_sampled(rate_hz: int) -> None:
    for phase in range(20):
        times = [(k + phase / 20) / rate_hz for k in range(-8, rate_hz)]
        verdicts = follow([(t, stroke(t)) for t in times], turn=1.0)
        assert JUMP not in verdicts
        assert all(a != SURPRISE or b != SURPRISE for a, b in itertools.pairwise(verdicts))


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.parametrize("speed", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("size", [0.03, 0.06, 0.15, 0.73, -0.03, -0.3])
@pytest.mark.parametrize("silence_s", [0.0, 0.05, 0.1])
def test_a_jump_never_drives(rate_hz: int, speed: float, size: float, silence_s: float) -> None:
    times = [k / rate_hz for k in range(8)]
    later = [silence_s + k / rate_hz for k in range(8, 12)]
    for along, aside in ((size, 0.0), (0.0, size)):
        points = [(t, speed * t, 0.0) for t in times] + [(t, speed * t + along, aside) for t in later]
        verdicts = follow([(t, x + 1e-7 * k, y) for k, (t, x, y) in enumerate(points)])
        assert verdicts[2:7] == [STEADY] * 5
        first = verdicts.index(JUMP)
        assert verdicts[7:first] in ([], [SURPRISE])


@pytest.mark.parametrize(("silence_s", "jumps"), [(0.0, False), (0.05, True), (0.1, True)])
def test_after_a_silence_less_is_a_jump(silence_s: float, jumps: bool) -> None:
    """20 mm aside: at 30 Hz a turn of a fast hand; but nothing is known of the way in a silence."""
    times = [k / 30 for k in range(8)]
    later = [silence_s + k / 30 for k in range(8, 12)]
    assert (JUMP in follow([(t, t, 0.0) for t in times] + [(t, t, 0.02) for t in later])) == jumps


@pytest.mark.parametrize("tick_s", [0.0157, 0.020])
def test_a_coarse_clock_makes_no_room_for_jumps(tick_s: float) -> None:
    """72 Hz, two poses with one time of capture now and then, 0.5 m/s, 30 mm aside."""
    for phase in range(20):
        times = [k / 72 + phase / 1000 for k in range(72)]
        points = [(t // tick_s * tick_s, 0.5 * t, 0.03 if k > 60 else 0.0) for k, t in enumerate(times)]
        verdicts = follow(points)
        assert JUMP in verdicts[60:]
        assert JUMP not in verdicts[:60]


def test_an_outlier_of_one_sample_waits_and_is_dropped() -> None:
    verdicts = follow([(k / 72, 0.001 * k + (0.03 if k == 6 else 0.0)) for k in range(10)])
    assert verdicts == [STEADY] * 5 + [SURPRISE, OUTLIER] + [STEADY] * 2


def test_poses_that_come_slower_than_samples_are_no_jumps() -> None:
    """Hands that are tracked at 30 Hz by an app of 90 Hz: every pose three times."""
    points = [(k / 90, 0.033 * (k // 3)) for k in range(60)]
    assert set(follow(points)[6:]) == {STEADY}


def drive(**config: Any) -> Any:
    """Return a table whose operator drives `left` by the right controller at 72 Hz."""
    t = Table(AuthorityConfig(**config), frozen_ns=500 * MS)
    op = t.operator("left")
    move(t, op, 1, clutch=False)
    move(t, op, 8)
    assert t.command().kind == "pose"
    return t, op


def move(t: Table, op: Any, n: int, x: float = 0.0, **fields: Any) -> None:
    for _ in range(n):
        t.step(dt_ns=SECOND // 72)
        op.sends("left", **{"clutch": True, "p": (x + 1e-7 * op.seq, 0.0, 1.0), **fields})


@pytest.mark.parametrize("size", [0.03, 0.2, 1.0])
def test_a_jump_of_the_hand_moves_no_target_and_holds_until_the_clutch_was_open(size: float) -> None:
    t, op = drive()
    target = t.command().sources[0].pose_world.p
    for _ in range(4):
        move(t, op, 1, x=size)
        if t.command().kind == "pose":
            assert math.dist(t.command().sources[0].pose_world.p, target) < 1e-5
    assert t.hold() == "jump"
    assert t.last(SamplesRejected).reason == "jump"
    assert t.last(EngagementChanged).reason == "jump"
    move(t, op, 1, x=size, clutch=False)
    move(t, op, 2, x=size)
    assert t.command().kind == "pose"


def test_a_surprise_does_not_engage_and_an_open_clutch_counts_at_once() -> None:
    t, op = drive()
    move(t, op, 1, clutch=False)
    move(t, op, 1, x=0.03)
    assert t.command().kind == "hold"
    move(t, op, 1)
    assert t.command().kind == "pose"
    move(t, op, 1, x=0.03, clutch=False)
    assert t.hold() == "clutch_open"


def test_a_jump_in_a_sample_that_names_no_robot_ends_the_engagement_too() -> None:
    t, op = drive()
    t.step(dt_ns=SECOND // 72)
    op.sends(p=(0.5, 0.0, 1.0), clutch=True)
    assert t.hold() == "jump"


@pytest.mark.parametrize("frozen", ["controller/right", "head"])
def test_a_device_that_freezes_holds_after_half_a_second(frozen: str) -> None:
    t, op = drive()
    pose = Pose((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
    for k in range(60):
        if frozen == "head":
            op.sends(device="head", pose=Pose((0.0, 0.2, 1.5), pose.q))
            move(t, op, 1)
        else:
            move(t, op, 1, pose=pose)
        if k < 24:
            assert t.command().kind == "pose"
    assert t.hold() == "frozen"
    assert t.last(SamplesRejected).reason == "frozen"
    if frozen == "head":
        op.sends(device="head", pose=Pose((0.0, 0.2, 1.500001), pose.q))
    move(t, op, 1)
    assert t.hold() == "frozen"
    move(t, op, 1, clutch=False)
    move(t, op, 2)
    assert t.command().kind == "pose"


@pytest.mark.parametrize(("alignment", "hold"), [("not_needed", ""), ("measured", "frozen")])
def test_what_an_agent_computes_may_stand_still_unless_it_wears_a_headset(alignment: str, hold: str) -> None:
    t = Table(frozen_ns=500 * MS)
    agent = t.join("agent", alignment=alignment, devices=("hand/left",))
    agent.acquire("left")
    if hold:
        t.step(agent.says(proposal()))
        agent.alignment_version = t.authority.build_alignment_reports()[agent.id].version
    p = (0.1, 0.0, 0.0) if hold else (0.0, 0.0, 0.0)  # zero of what measures is none
    agent.engage("left", device="hand/left", p=p)
    assert t.command().kind == "pose"
    for _ in range(60):
        move(t, agent, 1, device="hand/left", p=p)
    assert t.hold() == hold


def test_limits_of_earlier_recordings_only_bound_the_speed() -> None:
    limits = {name: type(one)(one.linear, one.angular) for name, one in SPEED_LIMITS.items()}
    t, op = drive(speed_limits=limits)
    move(t, op, 3, x=0.1)
    assert t.command().kind == "pose"
    move(t, op, 60, pose=Pose((0.1, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)))
    assert t.command().kind == "pose"
    t.step(op.says(proposal()))
    assert is_same_snapshot(t.authority.snapshot(), t.authority.snapshot())
