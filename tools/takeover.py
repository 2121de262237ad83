"""Let a person take over a scripted policy in an environment of a suite, through its own action, and give it back.

In an environment that has the suite, and what iris-session and its recordings need:

python tools/takeover.py lift --json

Also lift-world, lift-absolute, lift-position, lift-ik, lift-joints, two-arm; aloha, metaworld, fetch, ogbench.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import iris_session
from iris_session import AuthorityConfig, Client, HoldReason, Recording, Session, SessionConfig
from iris_session.physics.tip import Tip
from iris_session.session.verification import verify_recording

#: Joint speed and gripper strokes per second of `ControlConfig`, which bound how fast absolute entries change.
JOINT_SPEED, GRIPPER_SPEED = 2.5, 4.0
#: How far the person moves the end effector up [m], and how fast [m/s].
MOVE, SPEED = 0.05, 0.1
#: Holds that end when the clutch was opened: a busy machine may cause them.
OPEN_CLUTCH = (HoldReason.REARM, HoldReason.STALE, HoldReason.GAP, HoldReason.REJECTED)
#: Controllers of robosuite's arms, as changes to the one that it comes with.
ROBOSUITE: dict[str, dict[str, Any]] = {
    "lift": {},
    "lift-world": {"input_ref_frame": "world"},
    "lift-absolute": {"input_type": "absolute"},
    "lift-position": {"type": "OSC_POSITION", "output_max": [0.05] * 3, "output_min": [-0.05] * 3},
    "lift-ik": {"input_type": "absolute"},  # of the joints; with 1.5.2's own settings no action holds
    "lift-joints": {"type": "JOINT_POSITION", "output_max": 0.05, "output_min": -0.05, "kp": 100},
    "two-arm": {},
}


def make_robosuite(name: str) -> Any:
    import robosuite
    from robosuite import controllers

    is_old = not hasattr(controllers, "load_composite_controller_config")  # 1.4, in LIBERO
    if is_old:
        controller = controllers.load_controller_config(default_controller="OSC_POSE")
    else:
        controller = controllers.load_composite_controller_config(robot="Panda")
    arm = controller if is_old else controller["body_parts"]["right"]
    if name == "lift-ik":
        part = controllers.load_part_controller_config(default_controller="IK_POSE")
        arm = controller["body_parts"]["right"] = {**part, "gripper": arm["gripper"]}
    arm.update(ROBOSUITE[name])
    task, robots = ("TwoArmLift", ["Panda", "Panda"]) if name == "two-arm" else ("Lift", ["Panda"])
    kinds = {"has_renderer": False, "has_offscreen_renderer": False, "use_camera_obs": False, "horizon": 100_000}
    return robosuite.make(task, robots=robots, controller_configs=controller, **kinds)


def make_environment(name: str) -> Any:
    if name in ROBOSUITE:
        return make_robosuite(name)
    import gymnasium

    kinds: dict[str, Any] = {"max_episode_steps": 100_000, "disable_env_checker": True}
    if name == "aloha":
        import gym_aloha  # noqa: F401

        env = gymnasium.make("gym_aloha/AlohaTransferCube-v0", obs_type="pixels_agent_pos", **kinds)
        # Its pictures take longer than its physics.
        env.unwrapped._env.physics.render = lambda **_: np.zeros((480, 640, 3), np.uint8)
        return env
    if name == "metaworld":
        import metaworld  # noqa: F401

        env = gymnasium.make("Meta-World/MT1", env_name="pick-place-v3", seed=1, disable_env_checker=True)
        env.unwrapped.max_path_length = 100_000
        return env
    if name == "fetch":
        import gymnasium_robotics

        gymnasium.register_envs(gymnasium_robotics)
        return gymnasium.make("FetchPickAndPlace-v4", **kinds)
    import ogbench.manipspace  # noqa: F401

    return gymnasium.make("cube-single-v0", **kinds)


def make_policy(name: str, env: Any) -> Callable[[float], np.ndarray]:
    """Return a policy: the action at a time [s]. It waves."""
    if name == "aloha":
        from gym_aloha.constants import START_ARM_POSE

        rest = np.concatenate([START_ARM_POSE[:6], [0.3], START_ARM_POSE[8:14], [0.3]])
        wave = np.tile([0.2, 0.1, 0.1, 0.2, 0.1, 0.3, 0.2], 2)
        return lambda t: (rest + wave * math.sin(2.0 * t)).astype(np.float32)
    if name == "lift-absolute":
        composite = env.robots[0].composite_controller
        composite.update_state()
        goal = composite.part_controllers["right"].goal_origin_to_eef_pose()
        turn = np.empty(3)
        mujoco.mju_mat2Quat(q := np.empty(4), np.ravel(goal[:3, :3]))
        mujoco.mju_quat2Vel(turn, q, 1.0)
        return lambda t: np.array([*goal[:3, 3], *turn, -1.0])
    size = env.action_dim if name in ROBOSUITE else env.action_space.shape[0]
    wave = np.zeros(size)
    wave[:2] = 0.2
    return lambda t: np.cos(2.0 * t) * wave


class Demonstration:
    """One environment, its session, the policy, and a person who may drive."""

    def __init__(self, name: str, session: Session, env: Any, client: Client) -> None:
        self.session, self.env, self.client = session, env, client
        self.policy = make_policy(name, env)
        self.robot = session.robots[0].name
        self.pose: Any = None  # where the person leads the robot, None while the clutch is open
        self.clutch: bool | None = None  # None: no samples
        self.gripper = 0.0
        self.theirs: list[np.ndarray] = []
        self.mine: list[np.ndarray] = []
        self.interventions: list[bool] = []
        self.periods: list[float] = []
        self.wall_ms: list[float] = []

    def step(self) -> None:
        """One step of the environment, in real time."""
        data = self.session.data
        began, time_s = time.monotonic(), data.time
        if self.clutch is not None:
            pose = self.pose or self.tip
            feedback = self.client.feedback.get(self.robot)
            must_open = feedback is not None and feedback.hold_reason in OPEN_CLUTCH
            more = {"gripper": self.gripper, "clutch": self.clutch and not must_open}
            self.client.send_sample("target", pose, robots=[self.robot], **more)
        theirs = self.policy(data.time)
        mine = self.session.action(theirs)
        assert type(mine) is type(theirs)
        assert mine.dtype == theirs.dtype
        self.theirs.append(np.array(theirs, float))
        self.mine.append(np.array(mine, float))
        info = self.env.step(mine)[-1]
        self.interventions.append(self.robot in info["intervention"])
        self.periods.append(data.time - time_s)
        self.wall_ms.append(1e3 * (time.monotonic() - began))
        self.client.poll(max(0.0, began + data.time - time_s - time.monotonic()))

    def run(self, seconds: float) -> None:
        end = self.session.data.time + seconds
        while self.session.data.time < end:
            self.step()

    @property
    def tip(self) -> tuple[Any, Any]:
        """`T_world_tip` as it is now."""
        spec = next(one for one in self.session.robots if one.name == self.robot)
        return Tip(self.session.model, spec).read_pose(self.session.data)

    def move_to(self, p: Any, speed: float = SPEED) -> None:
        (start, q), end = self.pose, np.array(p, float)
        n = max(1, round(float(np.linalg.norm(end - start)) / speed / float(np.median(self.periods))))
        for i in range(n):
            self.pose = (tuple((np.array(start) + (i + 1) / n * (end - start)).tolist()), q)
            self.step()

    def arrive(self) -> None:
        """Wait until the end effector is where it is led, 5 s at most."""
        end = self.session.data.time + 5.0
        while self.miss_mm() > 2.0 and self.session.data.time < end:
            self.step()

    def miss_mm(self) -> float:
        return 1e3 * math.dist(self.tip[0], self.pose[0])

    def take_over(self) -> None:
        self.client.acquire([self.robot])
        self.clutch = False
        self.run(0.3)
        self.pose, self.clutch = self.tip, True
        self.run(0.5)

    def give_back(self) -> None:
        self.clutch = None
        self.client.release(self.robot)


def find_jump(shown: Demonstration, name: str, steps: slice) -> dict[str, float]:
    """Return the largest change from step to step as a share of what one step allows, and what that is."""
    mine, period = np.array(shown.mine), float(np.median(shown.periods))
    change = np.abs(np.diff(mine, axis=0))[steps]
    if name == "aloha":
        limit = np.tile([JOINT_SPEED * period] * 6 + [GRIPPER_SPEED * period], 2)
    else:
        limit = np.full(mine.shape[1], 2.0)  # ways: from one end of the action space to the other
    share = change / limit
    return {
        "largest_change": round(float(change[:, :6].max()), 4),
        "limit": round(float(limit[0]), 4),
        "share_of_limit": round(float(share.max()), 3),
        "largest_entry": round(float(np.abs(mine[1:][steps]).max()), 3),
    }


def lift_cube(shown: Demonstration) -> float:
    """Grasp robosuite's cube; return how far it rose [m]."""
    cube = shown.session.data.body("cube_main")
    start = cube.xpos.copy()
    x, y, z = start
    for height in (0.1, 0.0):
        shown.move_to((x, y, z + height))
        shown.arrive()
    shown.gripper = 1.0
    shown.run(0.8)
    shown.move_to((x, y, z + 0.15))
    shown.arrive()
    return float(cube.xpos[2] - start[2])


def demonstrate(name: str, shown: Demonstration) -> dict[str, Any]:
    grip = shown.session.grippers
    shown.run(1.0)
    report: dict[str, Any] = {"env": name, "robot": shown.robot}
    report["untouched"] = bool(np.array_equal(shown.mine, shown.theirs))
    taken = len(shown.mine)
    shown.take_over()
    report["takeover"] = find_jump(shown, name, slice(taken - 1, len(shown.mine)))
    driven = len(shown.mine)
    before, (p, q) = shown.tip[0], shown.pose
    shown.move_to((p[0], p[1], p[2] + MOVE))
    report["mm_left_at_once"] = round(shown.miss_mm(), 2)
    shown.arrive()
    shown.run(2.0)
    report["mm_moved"] = round(1e3 * math.dist(before, shown.tip[0]), 1)
    report["mm_left"] = round(shown.miss_mm(), 2)
    report["deg_left"] = round(math.degrees(2 * math.acos(min(1.0, abs(float(np.dot(q, shown.tip[1])))))), 2)
    shown.clutch = False
    here = shown.tip[0]
    shown.run(1.0)
    report["mm_drift_clutch_open"] = round(1e3 * math.dist(here, shown.tip[0]), 2)
    shown.pose, shown.clutch = shown.tip, True
    shown.run(0.3)
    for closed in (1.0, 0.0):
        shown.gripper = closed
        shown.run(1.0)
        report["closed" if closed else "open"] = [round(grip().get(shown.robot, math.nan), 2), *measure_fingers(shown)]
    if name.startswith("lift"):
        report["cube_rose_mm"] = round(1e3 * lift_cube(shown), 1) + 0.0
    report["while_driven"] = find_jump(shown, name, slice(driven - 1, len(shown.mine)))
    given = len(shown.mine)
    shown.give_back()
    shown.run(2.0)
    report["give_back"] = find_jump(shown, name, slice(given - 1, len(shown.mine)))
    same = [bool(np.array_equal(a, b)) for a, b in zip(shown.mine, shown.theirs, strict=True)]
    report["steps_until_policy"] = len(same) - given - list(reversed(same)).index(False) if False in same else 0
    report["ms_per_step"] = np.percentile(shown.wall_ms, [50, 99]).round(1).tolist()
    report["intervention_steps"] = [sum(shown.interventions), len(shown.interventions)]
    return report


def measure_fingers(shown: Demonstration) -> list[float]:
    """Return the largest distance of two finger bodies [mm]."""
    spec = next(one for one in shown.session.robots if one.name == shown.robot)
    p = [shown.session.data.body(name).xpos for name in spec.finger_bodies]
    return [round(1e3 * max((math.dist(a, b) for a in p for b in p), default=0.0), 1)]


def read_recording(path: Path, robot: str) -> Iterator[tuple[str, Any]]:
    """Return when people drove, as the recording says."""
    with Recording.open(path) as recording:
        events = [event for event in recording.event_records() if event["event"] == "engagement_changed"]
        yield (
            "engagements",
            [[round(e["time_s"], 2), e["participant_name"], e["engaged"] or e["reason"]] for e in events],
        )
        commands = recording.robot(robot).commands(hz=20)
        kinds, counts = np.unique(commands.kinds, return_counts=True)
        yield "commands_at_20_hz", dict(zip(map(str, kinds), counts.tolist(), strict=True))
        yield "damage", list(recording.damage)
    yield "verified", verify_recording(path).ok


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("env", choices=(*ROBOSUITE, "aloha", "metaworld", "fetch", "ogbench"))
    parser.add_argument("--json", action="store_true", help="print one line of JSON")
    given = parser.parse_args()
    logging.disable(logging.INFO)
    env = make_environment(given.env)
    env.reset(**({} if given.env in ROBOSUITE else {"seed": 0}))
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "session.rrd"
        # Samples come once a step of the environment, which a busy machine may make late.
        authority = AuthorityConfig(freshness_ns=2_000_000_000)
        config = SessionConfig(
            control_port=0, state_port=0, beacon_port=0, web=False, assets=False, record=record, authority=authority
        )
        with iris_session.share(env, config=config, drive="action") as session:
            keys: dict[str, Any] = {
                "role": "operator",
                "name": "ann",
                "devices": ("target",),
                "alignment": "not_needed",
            }
            session.action(make_policy(given.env, env)(0.0))
            with Client(session.address, **keys) as client:
                report = demonstrate(given.env, Demonstration(given.env, session, env, client))
                robot = report["robot"]
        report |= dict(read_recording(record, robot))
    if given.json:
        print(json.dumps(report))
    else:
        for key, value in report.items():
            print(f"{key:22s} {value}")


if __name__ == "__main__":
    main()
