"""Two robots do not run into each other; they separate freely; grippers may meet."""

from __future__ import annotations

import math

import msgspec
import mujoco
import numpy as np
import pytest

from anchors.pose import PoseTuple
from iris_session.control import ControlConfig
from iris_session.control.proximity import Motion, ProximityLimiter, compute_box_bounds
from iris_session.demo.scenes import scene_path
from iris_session.physics import find_robots
from iris_session.protocol.specs import RobotSpec
from iris_session.protocol.steps import Command
from tests.control.rigs import PANDA_HOME, Rig, apart, decision, hold_command, panda_arms, pose_command

FACING = ([(0.0, 0.0, 0.0), (1.3, 0.0, 0.0)], [0.0, math.pi])


def gap(rig: Rig, proximity: ProximityLimiter) -> float:
    a, b = proximity._geoms
    distance = mujoco.mj_geomDistance
    return min(distance(rig.model, rig.data, int(i), int(j), 1.0, None) for i in a for j in b)


def push(rig: Rig, towards: float, steps: int) -> list[tuple[tuple[str, ...], ...]]:
    """Both hands move `towards` each other at 0.4 m/s (negative: apart)."""
    seen = []
    for k in range(steps):
        x = math.copysign(min(0.4 * k * 0.002, abs(towards)), towards)
        a = rig.source((x, 0.0, 0.0), new=k % 7 == 0)
        b = rig.source((-x, 0.0, 0.0), new=k % 7 == 0)
        rig.step(decision([pose_command("r0", a), pose_command("r1", b)]))
        seen.append(tuple(s.limits for s in rig.controller.get_status()))
    return seen


def test_closing_robots_are_slowed_and_stop_apart_and_retreat_freely() -> None:
    model, robots = panda_arms(*FACING)
    config = ControlConfig()
    proximity = ProximityLimiter(model, robots, config)
    rig = Rig(model, robots, config, home=PANDA_HOME)
    rig.hold(200)
    smallest = 1.0
    for _ in range(8):
        seen = push(rig, 0.2, 100)
        smallest = min(smallest, gap(rig, proximity))
        rig.hold(1)
    assert all("proximity" in limits for limits in seen[-1])
    assert 0.005 < smallest < 0.04
    rig.hold(200)
    # Hold lifts the report and stays apart.
    assert gap(rig, proximity) > 0.005
    assert rig.controller.get_status()[0].limits == ()
    away = push(rig, -0.15, 400)
    assert gap(rig, proximity) > 0.12
    assert not any("proximity" in limits for both in away[20:] for limits in both)


def lean(rig: Rig, steps: int) -> float:
    """Leader robots that send at 500 Hz lean both arms towards each other at 1 rad/s; returns the smallest gap."""
    proximity, smallest = ProximityLimiter(rig.model, rig.robots, ControlConfig()), 1.0
    for k in range(steps):
        q = np.add(PANDA_HOME, (0.0, min(0.002 * k, 0.7), 0.0, min(0.002 * k, 0.7), 0.0, 0.0, 0.0))
        rows = [rig.source((0.0, 0.0, 0.0), pose_world=None, q=tuple(q.tolist()), device="joints") for _ in range(2)]
        rig.step(decision(Command(f"r{i}", "joints", sources=(row,)) for i, row in enumerate(rows)))
        if k % 5 == 0:
            smallest = min(smallest, gap(rig, proximity))
    return smallest


def test_leaders_that_send_at_every_step_do_not_lift_the_bound() -> None:
    model, robots = panda_arms(*FACING)
    rig = Rig(model, robots, home=PANDA_HOME)
    rig.hold(200)
    assert 0.005 < lean(rig, 700) < 0.04
    assert all("proximity" in status.limits for status in rig.controller.get_status())
    free = Rig(model, robots, ControlConfig(proximity_margin=0.0), home=PANDA_HOME)
    free.hold(200)
    assert lean(free, 700) < 0.0, "without the bound they would have collided"


def send(rig: Rig, goal: PoseTuple, seconds: float) -> float:
    """A program sends the first robot to a pose; returns the smallest gap."""
    proximity, smallest = rig.controller._proximity, 1.0
    for k in range(round(seconds / rig.model.opt.timestep)):
        source = rig.source(*goal, absolute=True, device="target", new=k % 4 == 0)
        rig.step(decision([pose_command(rig.robots[0].name, source), hold_command(rig.robots[1].name)]))
        smallest = min([smallest, *(pair[0] for pair in proximity._near_geoms(rig.data, 0, 1)[:1])])
    return smallest


def make_handover(**settings: object) -> tuple[Rig, PoseTuple]:
    """The two arms of the scene `handover`, and where the first one begins."""
    model = mujoco.MjModel.from_xml_path(str(scene_path("handover")))
    model.opt.timestep = 0.004
    rig = Rig(model, list(find_robots(model).robots), ControlConfig(**settings))  # type: ignore[arg-type]
    rig.hold(5)
    return rig, rig.tip()


def test_an_arm_stretched_towards_another_comes_back_without_coming_nearer() -> None:
    rig, home = make_handover()
    (x, y, z), q = home
    smallest = send(rig, ((x + 3.0, y, z), q), 4.0)
    assert "proximity" in rig.controller.get_status()[0].limits
    assert apart(rig.tip(), home)[0] > 0.4
    assert min(smallest, send(rig, home, 3.0)) > 0.015
    assert apart(rig.tip(), home)[0] < 0.005
    jammed, _ = make_handover(proximity_per_joint=False)
    send(jammed, ((x + 3.0, y, z), q), 4.0)
    send(jammed, home, 3.0)
    assert apart(jammed.tip(), home)[0] > 0.4, "recordings made before are verified with the law of then"


def roam(seed: int, seconds: float, **settings: object) -> float:
    """Both arms are sent to other random poses between them every 0.4 s; returns the smallest gap."""
    rig, _ = make_handover(**settings)
    rng, proximity, smallest = np.random.default_rng(seed), rig.controller._proximity, 1.0
    goals: list[PoseTuple] = []
    for k in range(round(seconds / rig.model.opt.timestep)):
        if k % 100 == 0:
            places = rng.uniform((-0.45, -0.4, 0.0), (0.45, 0.4, 0.7), (2, 3))
            turns = rng.normal(size=(2, 4))
            turns /= np.linalg.norm(turns, axis=1, keepdims=True)
            goals = [(tuple(p), tuple(q)) for p, q in zip(places.tolist(), turns.tolist(), strict=True)]
        rows = [rig.source(*goal, absolute=True, device="target", new=k % 2 == 0) for goal in goals]
        rig.step(decision(pose_command(robot.name, row) for robot, row in zip(rig.robots, rows, strict=True)))
        smallest = min([smallest, *(pair[0] for pair in proximity._near_geoms(rig.data, 0, 1)[:1])])
    return smallest


def test_arms_at_full_speed_stop_apart() -> None:
    assert roam(9, 8.0) > 0.02
    assert roam(9, 8.0, proximity_stopped=False) < 0.0, "the law of earlier recordings lets servos run on"
    # Brakes that take half a second: where the arms are commanded is not yet where they stop.
    assert roam(2, 5.0, joint_acceleration=4.0, joint_velocity=3.0) > 0.05


def test_two_arms_that_carry_something_between_them_stay_together() -> None:
    model, robots = panda_arms([(0.0, 0.0, 0.0), (1.1, 0.0, 0.0)], [0.0, math.pi])
    rig, apart_m = Rig(model, robots, home=PANDA_HOME), []
    turns = [rig.tip(i)[1] for i in range(2)]
    for k in range(2500):
        x = 0.55 + (0.1 * math.sin(2.0 * math.pi * 0.7 * 0.002 * (k - 1000)) if k > 1000 else 0.0)
        rows = [
            rig.source((x + side, 0.0, 0.45), turn, absolute=True, device="target", new=k % 5 == 0)
            for side, turn in zip((-0.055, 0.055), turns, strict=True)
        ]
        rig.step(decision(pose_command(robot.name, row) for robot, row in zip(robots, rows, strict=True)))
        apart_m += [apart(rig.tip(0), rig.tip(1))[0]] * (k > 1000)
    assert max(apart_m) - min(apart_m) < 0.005


def test_samples_between_two_checks_do_not_lift_the_bound() -> None:
    model, robots = panda_arms(*FACING)
    rig, smallest = Rig(model, robots, home=PANDA_HOME), 1.0
    rig.hold(5)
    towards = np.array([0.0, 0.19, 0.0, 0.19, 0.0, 0.0, 0.0])
    for k in range(1000):
        # Leaders that retreat whenever they are looked at, and come nearer else.
        step = towards if rig.controller._tick % 5 else -0.05 * np.sign(towards)
        goals = rig.controller._joints.get_position(slice(None)).reshape(2, -1) + step
        rows = [rig.source((0.0, 0.0, 0.0), pose_world=None, q=tuple(q), device="joints") for q in goals.tolist()]
        rig.step(decision(Command(r.name, "joints", sources=(row,)) for r, row in zip(robots, rows, strict=True)))
        if k % 5 == 0:
            smallest = min([smallest, *(pair[0] for pair in rig.controller._proximity._near_geoms(rig.data, 0, 1)[:1])])
    assert smallest > 0.05


def test_no_pair_closes_faster_than_allowed_and_joints_that_open_all_of_them_are_not_slowed() -> None:
    model, robots = panda_arms([(0.0, 0.0, 0.0), (0.75, 0.0, 0.0), (0.4, 0.5, 0.0)], [0.0, math.pi, -math.pi / 2])
    rig, rng, slowed, kept = Rig(model, robots, home=PANDA_HOME), np.random.default_rng(2), 0, 0
    proximity, home = rig.controller._proximity, rig.data.qpos.copy()
    for _ in range(60):
        rig.data.qpos[:] = home + rng.normal(0.0, 0.3, len(home))
        mujoco.mj_forward(model, rig.data)
        wanted = [rng.normal(0.0, 1.0, 7) for _ in robots]
        factors = proximity.compute_speed_factors(rig.data, wanted).robots
        approaches = proximity._list_approaches(rig.data, wanted)
        for allowed, sides in approaches:
            assert sum(float(speeds @ factors[i]) for i, speeds in sides) <= allowed * (1.0 + 1e-6) + 1e-12
        for i, factor in enumerate(factors):
            mine = [speeds for approach in approaches for k, speeds in approach.robots if k == i]
            opens = np.all([speeds <= 0.0 for speeds in mine], axis=0) if mine else np.ones(7, dtype=bool)
            assert (factor[opens] == 1.0).all()
            slowed += int((factor < 1.0).sum())
            kept += int(opens.sum()) if factor.min() < 1.0 else 0
    assert min(slowed, kept) > 50


SLIDERS = """<mujoco><worldbody><geom type="plane" size="5 5 .1"/>
<body name="a"><body><joint name="a" type="slide" axis="1 0 0"/>
  <geom size=".1" pos="0 0 1"/><site name="a" pos="0 0 1"/>
  <body name="finger" pos="{finger} 0 1"><geom size=".01"/>
    <body name="pad"><geom size=".01"/></body></body></body></body>
<body name="b"><body><joint name="b" type="slide" axis="1 0 0"/>
  <geom size=".1" pos="{apart} 0 1"/><site name="b" pos="{apart} 0 1"/></body></body>
<body name="c"><body><joint name="c" type="slide"/>
  <geom size=".1" contype="0" conaffinity="0"/><site name="c"/></body></body></worldbody></mujoco>"""


def sliders(apart: float, finger: float = 0.0) -> tuple[mujoco.MjModel, mujoco.MjData, list[RobotSpec]]:
    """Two balls on rails, the first with a finger; a third robot without collision geoms."""
    model = mujoco.MjModel.from_xml_string(SLIDERS.format(apart=apart, finger=finger))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    fingers = {"a": ("finger",), "b": (), "c": ()}
    return model, data, [RobotSpec(n, (n,), (n,), n, n, finger_bodies=f) for n, f in fingers.items()]


def factors(apart: float, va: float, vb: float, finger: float = 0.0) -> list[float]:
    model, data, robots = sliders(apart, finger)
    found = ProximityLimiter(model, robots, ControlConfig()).compute_speed_factors(
        data, [np.array([va]), np.array([vb]), np.array([0.0])]
    )
    return [float(factor.item()) for factor in found.robots]


@pytest.mark.parametrize(
    ("apart", "va", "vb", "expected"),
    [
        (0.25, 1.0, 0.0, [0.12, 1.0]),  # 5 cm apart: 4 * (0.05 - 0.02) = 0.12 m/s may close
        (0.25, 1.0, -1.0, [0.06, 0.06]),
        (0.25, 1.0, 0.5, [0.62, 1.0]),  # b retreats: a may follow it
        (0.25, -1.0, 1.0, [1.0, 1.0]),
        (0.25, 0.05, -0.05, [1.0, 1.0]),
        (0.215, 1.0, 0.0, [0.0, 1.0]),
        (0.19, 1.0, 0.0, [0.0, 1.0]),  # in contact: no further
        (0.19, -1.0, 0.0, [1.0, 1.0]),  # but out
        (0.5, 1.0, -1.0, [1.0, 1.0]),
    ],
)
def test_closing_speed_is_bounded_by_distance(apart: float, va: float, vb: float, expected: list[float]) -> None:
    assert factors(apart, va, vb)[:2] == pytest.approx(expected, abs=1e-9)


def test_where_they_stop_counts_too_and_a_retreat_as_far_as_it_has_begun() -> None:
    model, data, robots = sliders(0.4)
    proximity = ProximityLimiter(model, robots, ControlConfig())
    still, ahead = np.array([0.0]), np.array([1.0])

    def slow(wanted_b: float, now_b: float, stop_a: float) -> list[float]:
        b = [np.array([v]) for v in (now_b, float(np.clip(wanted_b, now_b - 0.1, now_b + 0.1)))]
        motions = [Motion(ahead, ahead), Motion(*b), Motion(still, still)]
        stops = np.array([stop_a, 0.0, 0.0])
        found = proximity.compute_speed_factors(data, [ahead, np.array([wanted_b]), still], motions, stops)
        assert found.near == ({0, 1} if stop_a else frozenset())
        return [float(factor.item()) for factor in found.robots[:2]]

    assert slow(0.5, 0.5, 0.0) == [1.0, 1.0]
    assert slow(0.5, 0.5, 0.15) == pytest.approx([0.62, 1.0])  # 5 cm apart when they stop
    assert slow(0.5, 0.2, 0.15) == pytest.approx([0.42, 1.0])
    assert slow(0.5, -0.2, 0.15) == pytest.approx([0.1, 0.1])


def test_fingers_are_exempt() -> None:
    assert factors(0.6, 1.0, 0.0, finger=0.48) == [1.0, 1.0, 1.0]
    model, _, robots = sliders(0.6, 0.48)
    guarded = ProximityLimiter(model, [msgspec.structs.replace(r, finger_bodies=()) for r in robots], ControlConfig())
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert guarded.compute_speed_factors(data, [np.array([1.0]), np.array([0.0]), np.array([0.0])]).robots[0] == [0.0]


def test_nothing_to_check_for_one_robot_or_without_geoms() -> None:
    model, _, robots = sliders(0.5)
    assert not ProximityLimiter(model, robots[:1], ControlConfig()).active
    assert not ProximityLimiter(model, [robots[0], robots[2]], ControlConfig()).active
    assert not ProximityLimiter(model, robots, ControlConfig(proximity_margin=0.0)).active
    assert not ProximityLimiter(model, [], ControlConfig()).active
    assert ProximityLimiter(model, robots, ControlConfig()).active


def hidden_pair(gap_m: float) -> tuple[mujoco.MjModel, list[RobotSpec]]:
    """Two sliding robots: 7 long plates each, half a metre apart, whose bounding spheres all overlap, and one small
    ball each, `gap_m` apart, whose spheres do not.
    """

    def body(name: str, x: float, side: float) -> str:
        plates = "".join(
            f'<geom type="box" size="0.002 0.6 0.6" pos="{-side * 0.25:g} {0.01 * k:g} 0"/>' for k in range(7)
        )
        ball = f'<geom type="sphere" size="0.01" pos="{side * 0.01:g} 0 0.9"/>'
        joint = f'<joint name="{name}/x" type="slide" axis="1 0 0" range="-1 1"/>'
        return f'<body name="{name}" pos="{x:g} 0 1">{joint}{plates}{ball}<site name="{name}/tip"/></body>'

    bodies = body("a", 0.0, 1.0) + body("b", 0.04 + gap_m, -1.0)
    actuators = "".join(f'<position name="{n}/x" joint="{n}/x" kp="100" ctrlrange="-1 1"/>' for n in ("a", "b"))
    xml = f"<mujoco><worldbody>{bodies}</worldbody><actuator>{actuators}</actuator></mujoco>"
    robots = [RobotSpec(n, (f"{n}/x",), (f"{n}/x",), f"{n}/tip", n) for n in ("a", "b")]
    return mujoco.MjModel.from_xml_string(xml), robots


def test_the_nearest_pair_cannot_hide_behind_49_others() -> None:
    model, robots = hidden_pair(0.03)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    proximity = ProximityLimiter(model, robots, ControlConfig())
    assert len(proximity._geoms[0]) == 8
    towards = [np.array([0.4]), np.array([-0.4])]
    # 30 mm apart, 20 mm are kept: the closing speed is at most 4 * 10 mm/s of 0.8 m/s.
    assert np.concatenate(proximity.compute_speed_factors(data, towards).robots) == pytest.approx([0.05, 0.05])


def test_box_bounds_are_no_greater_than_the_distance() -> None:
    rng = np.random.default_rng(0)
    shapes = ("sphere", "capsule", "ellipsoid", "cylinder", "box")
    for _ in range(60):
        geoms = ""
        for name in ("a", "b"):
            p, q = rng.uniform(-0.3, 0.3, 3), rng.normal(size=4)
            size = " ".join(f"{v:.4f}" for v in rng.uniform(0.02, 0.3, 3))
            pose = f'pos="{p[0]:.4f} {p[1]:.4f} {p[2]:.4f}" quat="{q[0]:.4f} {q[1]:.4f} {q[2]:.4f} {q[3]:.4f}"'
            geoms += f'<geom name="{name}" type="{shapes[rng.integers(5)]}" size="{size}" {pose}/>'
        model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        distance = mujoco.mj_geomDistance(model, data, 0, 1, 5.0, None)
        (bound,) = compute_box_bounds(model, data, np.array([0]), np.array([1]))
        if distance > 0.0:
            assert bound <= distance + 1e-6
