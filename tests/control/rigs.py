"""Real robots for the tests of control: models with each actuator type, a physics loop, and ways to make decisions."""

from __future__ import annotations

import copy
import math
from functools import cache

import msgspec
import mujoco
import numpy as np

from anchors.pose import PoseTuple, Quat, Vec3, quat_angle
from iris_session.control import ControlConfig, Controller
from iris_session.control.arm_model import read_site_pose
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.steps import Command, CommandSource, Decision, FixedView, ObjectCommand
from tests.models import ALOHA, PANDA

STEP_NS = 2_000_000
IDENTITY: Quat = (1.0, 0.0, 0.0, 0.0)
#: The flange points down, 0.50 m in front of the base and 0.45 m above it.
PANDA_HOME = (0.0, -0.16, 0.0, -2.19, 0.0, 2.03, math.pi / 4)


def set_actuators(spec: mujoco.MjSpec, kind: str) -> None:
    """Replaces the arm's position actuators by velocity servos or motors."""
    for actuator in spec.actuators:
        actuator.ctrllimited = int(mujoco.mjtLimited.mjLIMITED_FALSE)
        if kind == "velocity":
            actuator.set_to_velocity(kv=400.0)
        elif kind == "intvelocity":
            actuator.set_to_intvelocity(kp=4000.0, inheritrange=1.0)
        elif kind == "torque":
            actuator.set_to_motor()


def panda_spec(prefix: str = "", kind: str = "position") -> RobotSpec:
    return RobotSpec(
        prefix.rstrip("/") or "panda",
        tuple(f"{prefix}joint{i}" for i in range(1, 8)),
        tuple(f"{prefix}actuator{i}" for i in range(1, 8)),
        f"{prefix}attachment_site",
        f"{prefix}link0",
        hold="gravity_pd" if kind == "torque" else "",
    )


@cache
def _compile_panda(kind: str, timestep: float) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_file(str(PANDA))
    spec.option.timestep = timestep
    for key in list(spec.keys):
        spec.delete(key)
    if kind != "position":
        set_actuators(spec, kind)
    return spec.compile()


def panda_model(kind: str = "position", timestep: float = 0.002) -> mujoco.MjModel:
    return copy.copy(_compile_panda(kind, timestep))


def panda_arms(places: list[Vec3], yaws: list[float] | None = None) -> tuple[mujoco.MjModel, list[RobotSpec]]:
    """Several position-controlled panda arms in one scene, at `places` turned by `yaws` [rad]."""
    model = copy.copy(_compile_arms(tuple(places), tuple(yaws or [0.0] * len(places))))
    return model, [panda_spec(f"r{i}/") for i in range(len(places))]


@cache
def _compile_arms(places: tuple[Vec3, ...], yaws: tuple[float, ...]) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.002
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10  # as of the arm
    for i, (place, yaw) in enumerate(zip(places, yaws, strict=True)):
        arm = mujoco.MjSpec.from_file(str(PANDA))
        for key in list(arm.keys):
            arm.delete(key)
        for mesh in arm.meshes:
            mesh.file = str(PANDA.parent / "assets" / mesh.file)
        frame = spec.worldbody.add_frame(pos=place, quat=[math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)])
        spec.attach(arm, prefix=f"r{i}/", frame=frame)
    return spec.compile()


@cache
def _compile_aloha() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(ALOHA))


def aloha_model() -> mujoco.MjModel:
    return copy.copy(_compile_aloha())


def aloha_robots() -> list[RobotSpec]:
    joints = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
    return [
        RobotSpec(
            side,
            tuple(f"{side}/{j}" for j in joints),
            tuple(f"{side}/{j}" for j in joints),
            f"{side}/gripper",
            f"{side}/base_link",
            gripper_actuator=f"{side}/gripper",
            gripper_open=0.037,
            gripper_closed=0.002,
            finger_bodies=(f"{side}/left_finger_link", f"{side}/right_finger_link"),
        )
        for side in ("left", "right")
    ]


class Rig:
    """A model, its controller and a physics loop of one tick per step."""

    def __init__(
        self,
        model: mujoco.MjModel,
        robots: list[RobotSpec],
        config: ControlConfig | None = None,
        objects: list[ObjectSpec] | None = None,
        home: tuple[float, ...] = (),
    ) -> None:
        self.model, self.robots, self.data = model, robots, mujoco.MjData(model)
        if model.nkey:
            mujoco.mj_resetDataKeyframe(model, self.data, 0)
        for robot in robots if home else []:
            for joint, value in zip(robot.joints, home, strict=True):
                self.data.joint(joint).qpos[:] = value
        mujoco.mj_forward(model, self.data)
        self.controller = Controller(model, robots, objects or [], config)
        self.controller.reset(self.data)
        self.steps = 0
        self.seq = 0

    def step(self, decision: Decision, n_ticks: int = 1) -> None:
        self.steps += 1
        self.controller.begin(self.steps * STEP_NS, n_ticks, decision, FixedView())
        for _ in range(n_ticks):
            self.controller.tick(self.data)
            mujoco.mj_step2(self.model, self.data)
            mujoco.mj_step1(self.model, self.data)

    def hold(self, steps: int) -> None:
        for _ in range(steps):
            self.step(decision(hold_command(r.name) for r in self.robots))

    def source(self, p: Vec3, rotation: Quat = IDENTITY, *, engagement: int = 1, **more: object) -> CommandSource:
        self.seq += 1
        fields: dict[str, object] = {
            "participant": "p1",
            "device": "controller/right",
            "engagement": engagement,
            "seq": self.seq,
            "capture_ns": self.steps * STEP_NS,
            "receive_ns": self.steps * STEP_NS + 1000,
            "pose_world": Pose(p, rotation),
        }
        return CommandSource(**{**fields, **more})  # type: ignore[arg-type]

    def tip(self, robot: int = 0) -> PoseTuple:
        """Measured `T_world_tip`."""
        return read_site_pose(self.data, self.model.site(self.robots[robot].site).id)

    def target(self, robot: int = 0) -> PoseTuple:
        pose = self.controller.get_targets()[self.robots[robot].name]
        return (pose.p, pose.q)


def decision(commands: object, objects: tuple[ObjectCommand, ...] = ()) -> Decision:
    return Decision(tuple(commands), objects)  # type: ignore[arg-type]


def hold_command(robot: str) -> Command:
    return Command(robot, "hold", "clutch_open")


def pose_command(robot: str, *sources: CommandSource, **more: object) -> Command:
    return Command(robot, "pose", sources=sources, **more)  # type: ignore[arg-type]


def old(source: CommandSource) -> CommandSource:
    """The same sample in a later step, when it is no longer new."""
    return msgspec.structs.replace(source, new=False)


def apart(a: PoseTuple, b: PoseTuple) -> tuple[float, float]:
    """Distance [m] and angle [deg] between two poses."""
    return float(np.linalg.norm(np.subtract(a[0], b[0]))), math.degrees(quat_angle(a[1], b[1]))
