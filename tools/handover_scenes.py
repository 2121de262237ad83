"""Generated scenes of two arms and a box, and how many handovers in them succeed, in simulated time.

    python -m tools.handover_scenes 10 0 --save DIR    # ten seeds from the first one on, also as files

Arms are drawn from primitives with six or seven joints and a gripper of two fingers, links and fingers of random
length, 0.6 to 1.1 m apart, turned to each other by up to 35 degrees. A box of 3 to 5 cm lies on the table. The plan
of its handover is made from the model alone.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from anchors.pose import quat_from_yaw
from iris_session.control.arm_model import ArmModel, read_joint_ranges
from iris_session.control.config import SOLVER_NUMPY, ControlConfig
from iris_session.control.solvers import make_solver
from iris_session.demo.handover_plan import plan_handover
from iris_session.emulator.behaviours import PlannedGiver, PlannedReceiver
from iris_session.physics.robots import find_objects, find_robots
from iris_session.session.errors import ConfigError
from tools.handover_rig import Rig

DOWN = (0.0, 1.0, 0.0, 0.0)
BOX, CAPSULE, CYLINDER = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER


def make_scene(seed: int, apart_m: float | None = None, half_m: float | None = None) -> mujoco.MjSpec:
    """Return the scene of a seed; where given, with arms this far apart and a cube of this half length [m]."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = 0.002
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.noslip_iterations = 3
    apart = rng.uniform(0.6, 1.1)
    apart = apart if apart_m is None else apart_m
    spec.worldbody.add_geom(name="table", type=BOX, size=[0.5 * apart + 0.5, 0.7, 0.02], pos=[0, 0, -0.02])
    yaws = []
    for side, name in ((-1.0, "left"), (1.0, "right")):
        yaw = (0.0 if side < 0 else math.pi) + rng.uniform(-0.6, 0.6)
        yaws.append(yaw)
        _add_arm(spec, name, side * 0.5 * apart, yaw, rng)
    half = rng.uniform(0.015, 0.025, 3)
    half = half if half_m is None else np.full(3, half_m)
    reach, aside = rng.uniform(0.30, 0.42), yaws[0] + rng.uniform(-0.7, 0.7)
    box = spec.worldbody.add_body(
        name="cube",
        pos=[-0.5 * apart + reach * math.cos(aside), reach * math.sin(aside), half[2]],
        quat=quat_from_yaw(rng.uniform(-math.pi, math.pi)),
    )
    box.add_freejoint(name="cube")
    box.add_geom(type=BOX, size=half, mass=rng.uniform(0.03, 0.12), condim=4, friction=[0.8, 0.005, 0.0001])
    nearest = 0.5 * apart - 0.06
    _bend_arms(spec, [min(rng.uniform(0.26, 0.34), nearest) for _ in range(2)], rng.uniform(0.28, 0.36))
    spec.compile()
    return spec


def _add_arm(spec: Any, name: str, x: float, yaw: float, rng: np.random.Generator) -> None:
    """Add an arm with six joints (as of industrial arms) or seven (roll and pitch in turn) and a gripper."""
    upper, lower, wrist = rng.uniform(0.30, 0.40), rng.uniform(0.28, 0.38), rng.uniform(0.07, 0.10)
    joints = int(rng.integers(6, 8))
    roll, pitch = [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]
    axes = [roll, pitch, roll, pitch, roll, pitch, roll] if joints == 7 else [roll, pitch, pitch, roll, pitch, roll]
    lengths = (
        [0.12, 0.5 * upper, 0.5 * upper, 0.5 * lower, 0.5 * lower, wrist, 0.0]
        if joints == 7
        else [0.12, upper, 0.5 * lower, 0.5 * lower, wrist, 0.0]
    )
    ranges = {True: 2.9, False: 2.2}
    parent = spec.worldbody.add_body(name=f"{name}/base", pos=[x, 0.0, 0.0], quat=quat_from_yaw(yaw))
    parent.add_geom(type=CYLINDER, size=[0.07, 0.06, 0], pos=[0, 0, 0.06])
    offset, radius = 0.14, 0.05
    for k, (axis, length) in enumerate(zip(axes, lengths, strict=True)):
        parent = parent.add_body(name=f"{name}/link{k + 1}", pos=[0, 0, offset], gravcomp=1.0)
        limit = ranges[axis is roll]
        joint = parent.add_joint(
            name=f"{name}/joint{k + 1}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, range=[-limit, limit]
        )
        joint.damping[0], joint.armature, joint.frictionloss = 1.0, 0.1, 0.1
        radius = 0.92 * radius
        if length > 0.12:
            parent.add_geom(type=CAPSULE, fromto=[0, 0, 0.03, 0, 0, length - 0.03], size=[radius, 0, 0], mass=1.5)
        else:
            parent.add_geom(
                type=CAPSULE, fromto=[0, 0, 0.01, 0, 0, max(length - 0.03, 0.02)], size=[0.035, 0, 0], mass=0.6
            )
        kp = [4000, 4000, 3000, 3000, 2000, 1500, 1000][k]
        _add_servo(spec, f"{name}/joint{k + 1}", kp, (-limit, limit), 180.0 if k < 4 else 60.0)
        offset = length
    _add_gripper(spec, name, parent, rng)


def _add_gripper(spec: Any, name: str, link: Any, rng: np.random.Generator) -> None:
    """Add a gripper of two fingers that slide."""
    travel, long, wide = rng.uniform(0.032, 0.045), rng.uniform(0.045, 0.065), rng.uniform(0.008, 0.011)
    hand = link.add_body(name=f"{name}/hand", pos=[0, 0, 0.05], gravcomp=1.0)
    hand.add_geom(type=BOX, size=[0.024, travel + 0.022, 0.02], pos=[0, 0, 0.02], mass=0.4)
    hand.add_site(name=f"{name}/tcp", pos=[0, 0, 0.04 + long - 0.012])
    for side, finger in ((1.0, "a"), (-1.0, "b")):
        body = hand.add_body(
            name=f"{name}/finger_{finger}",
            pos=[0, 0, 0.04],
            quat=[1, 0, 0, 0] if side > 0 else [0, 0, 0, 1],
            gravcomp=1.0,
        )
        slide = body.add_joint(
            name=f"{name}/finger_{finger}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0], range=[0, travel]
        )
        slide.damping[0], slide.armature = 6.0, 0.05
        body.add_geom(
            type=BOX, size=[wide, 0.006, 0.5 * long], pos=[0, 0.006, 0.5 * long], mass=0.04, condim=4, priority=1,
            friction=[1.2, 0.008, 0.0001], solref=[0.005, 1], solimp=[0.95, 0.99, 0.001, 0.5, 2],
        )  # fmt: skip
        actuator = _add_servo(spec, f"{name}/finger_{finger}", 5000, (0.0, travel), 70.0)
        actuator.biasprm[2] = -60.0


def _add_servo(spec: Any, joint: str, kp: float, limits: tuple[float, float], force: float) -> Any:
    actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.gainprm[0], actuator.biasprm[1], actuator.biasprm[2] = kp, -kp, -2.0 * math.sqrt(0.3 * kp)
    actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    actuator.ctrlrange, actuator.ctrllimited = limits, mujoco.mjtLimited.mjLIMITED_TRUE
    actuator.forcerange, actuator.forcelimited = [-force, force], mujoco.mjtLimited.mjLIMITED_TRUE
    return actuator


def _bend_arms(spec: Any, reaches: list[float], height: float) -> None:
    """Let the arms begin, in keyframe `home`, with their grippers open and pointing down in front of them."""
    model = spec.compile()
    qpos, ctrl = model.qpos0.copy(), np.zeros(model.nu)
    for robot, reach in zip(find_robots(model).robots, reaches, strict=True):
        arm = ArmModel(model, robot)
        (lower, upper), solver = read_joint_ranges(model, [arm]), make_solver(arm, ControlConfig(solver=SOLVER_NUMPY))
        bent = np.array([0, 0.3, 0, 1.8, 0, 1.0, 0] if len(robot.joints) == 7 else [0, 0.3, 1.8, 0, 1.0, 0])
        q = bent
        for _ in range(200):
            q = solver.step(q, bent, ((reach, 0.0, height), DOWN), lower - q, upper - q).q
        qpos[[model.jnt_qposadr[j] for j in arm.joint_ids]] = q
        ctrl[[model.actuator(name).id for name in robot.actuators]] = q
    for actuator in range(model.nu):
        joint = int(model.actuator_trnid[actuator, 0])
        if int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE):
            qpos[model.jnt_qposadr[joint]] = ctrl[actuator] = model.jnt_range[joint, 1]
    spec.add_key(name="home", qpos=qpos, ctrl=ctrl)


def make_rig(model: mujoco.MjModel, seed: int) -> Rig:
    """Return people who hand the cube of a scene over. Raises `ConfigError` without a plan."""
    plan = plan_handover(model, find_robots(model).robots, find_objects(model), "cube")
    behaviours = {plan.giver.robot: PlannedGiver(plan), plan.receiver.robot: PlannedReceiver(plan)}
    return Rig(behaviours, seed, "cube", model=model, shift=False)


def main() -> None:
    """Print a line for each scene, and how many handovers succeeded."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=int)
    parser.add_argument("first", type=int, nargs="?", default=0)
    parser.add_argument("--save", type=Path, metavar="DIR", help="also write the scenes")
    arguments = parser.parse_args()
    good = 0
    for seed in range(arguments.first, arguments.first + arguments.scenes):
        spec = make_scene(seed)
        model = spec.compile()
        if arguments.save is not None:
            (arguments.save / f"scene{seed}.xml").write_text(spec.to_xml())
        began = time.monotonic()
        try:
            rig = make_rig(model, seed)
        except ConfigError as error:
            print(f"seed {seed}: refused: {error} ({time.monotonic() - began:.1f} s)", flush=True)
            continue
        planned_s = time.monotonic() - began
        rig.run(60.0, until=Rig.over)
        wrong = rig.verdict()
        good += not wrong
        print(f"seed {seed}: {wrong or 'ok'}, {rig.now_s:.1f} s, planned in {planned_s:.1f} s", flush=True)
    print(f"{good} of {arguments.scenes} succeeded")


if __name__ == "__main__":
    main()
