"""One case of `tools/suites.py`, in the virtual environment of its suite.

python -m tools.suites_worker MAKER ENVIRONMENT DRIVE       prints one JSON object

- `shared`: `share(env)` returned a session. `robots`, `notes`: what it says.
- `identical`: the trajectory with a session and an observer has the bits of that without.
- `poses_mm`: farthest distance of a body at the observer from where the simulation has it, after the last step.
- `follows_reset`: after a reset and a few steps the observer is at the world's time and bodies.
- `driven_mm_off`: what is left of 5 cm when an agent has driven the first arm, in the best of six directions; `null`
  without an arm, and for arms of a body that nothing holds. `gripper`: the fingers moved when it closed, `null`
  without one.
- `verified`: the recording verifies.
- `ms_per_step_p50`: what sharing adds to a step, and `alone_ms_per_step_p50`.
"""

from __future__ import annotations

import contextlib
import copy
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

import iris_session
from iris_session import AuthorityConfig, Client, HoldReason, SessionConfig
from iris_session.physics.names import list_body_names
from iris_session.physics.tip import Tip
from iris_session.session.simulation import copy_state, require_simulation
from iris_session.session.verification import verify_recording

STEPS: Final = 60
MAX_POSES_MM: Final = 0.1
MAX_OFF_MM: Final = 5.0
MAX_ADDED_MS: Final = 0.5
DISTANCE_M: Final = 0.05
#: Steps of the environment take at least so long while someone drives: samples have real times.
DRIVEN_STEP_S: Final = 0.01
#: Simulated time for a motion of 5 cm, and to come to rest after it [s].
MOVE_S: Final = 1.0
REST_S: Final = 2.0
#: Program of an observer in a process of its own: watches until its input ends.
OBSERVER: Final = """
import select, sys
from iris_session import Client
with Client(sys.argv[1], role="observer", name="watcher") as client:
    client.wait_for(lambda one: one.scene.poses is not None)
    print("here", flush=True)
    while not select.select([sys.stdin], [], [], 0)[0]:
        client.sleep(0.01)
"""
#: Holds that end only when the clutch is opened and closed again.
OPEN_CLUTCH: Final = frozenset(
    {HoldReason.REARM, HoldReason.REJECTED, HoldReason.STALE, HoldReason.GAP, HoldReason.SCENE_CHANGED}
)
AXES: Final = ((0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))


class Case:
    """An environment by one interface: `reset(seed)`, `step(action)`, and actions."""

    drives = True

    def __init__(self, environment: Any, actions: Any, *, seeds: bool = True) -> None:
        self.environment, self._actions, self._seeds = environment, actions, seeds
        self.rng = np.random.default_rng(0)

    def reset(self) -> None:
        """Begin an episode, always the same one where the environment takes a seed."""
        self.rng = np.random.default_rng(0)
        np.random.seed(0)  # OGBench and robosuite draw from it whatever seed they are given
        if self._seeds:
            self.environment.reset(seed=0)
        else:
            self.environment.reset()

    def draw_action(self) -> Any:
        """Return a small random action."""
        low, high = self._actions
        return (low + high) / 2 + 0.2 * (high - low) * (self.rng.random(np.shape(low)) - 0.5)

    def hold_action(self) -> Any:
        """Return the action in the middle of the range, in which most environments stand still."""
        low, high = self._actions
        return (low + high) / 2

    def step(self, action: Any) -> None:
        """Take a step."""
        self.environment.step(action)

    def find_simulation(self) -> Any:
        """Return the model and the data now."""
        return require_simulation(self.environment)

    def follow(self, session: Any) -> None:
        """Note the session that shares the environment."""

    def read(self) -> Any:
        """Return the bits of the state."""
        _, data = self.find_simulation()
        return np.concatenate(([data.time], data.qpos, data.qvel))


def _box(space: Any) -> Any:
    return np.nan_to_num(space.low, neginf=-1.0), np.nan_to_num(space.high, posinf=1.0)


def make_gymnasium(name: str) -> Case:
    """Gymnasium's own environments."""
    import gymnasium

    environment = gymnasium.make(name)
    return Case(environment, _box(environment.action_space))


def make_robotics(name: str) -> Case:
    """Gymnasium-Robotics."""
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    return make_gymnasium(name)


def make_metaworld(name: str) -> Case:
    """Meta-World."""
    import gymnasium
    import metaworld  # noqa: F401

    environment = gymnasium.make("Meta-World/MT1", env_name=name, seed=0)
    return Case(environment, _box(environment.action_space))


def make_robosuite(name: str) -> Case:
    """robosuite, `TASK:ROBOT+ROBOT`; before 1.5 its default are joint velocities."""
    import robosuite

    task, _, robots = name.partition(":")
    chosen: dict[str, Any] = {"seed": 0}
    if robosuite.__version__.startswith("1.4"):
        chosen = {"controller_configs": robosuite.load_controller_config(default_controller="OSC_POSE")}
    environment = robosuite.make(
        task,
        robots=robots.split("+"),
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        ignore_done=True,
        **chosen,
    )
    return Case(environment, environment.action_spec, seeds=False)


def make_ogbench(name: str) -> Case:
    """OGBench."""
    import gymnasium
    import ogbench  # noqa: F401

    environment = gymnasium.make(name)
    return Case(environment, _box(environment.action_space))


def make_aloha(name: str) -> Case:
    """gym-aloha; the middle of the range is no pose of its arms: actions stay near the first pose."""
    import gym_aloha  # noqa: F401
    import gymnasium
    from gym_aloha.constants import START_ARM_POSE

    environment = gymnasium.make(
        f"gym_aloha/{name}", obs_type="pixels_agent_pos", observation_width=64, observation_height=48
    )
    start = np.array([*START_ARM_POSE[:6], 0.0, *START_ARM_POSE[8:14], 0.0])
    return Case(environment, (start - 0.02, start + 0.02))


def make_gym(name: str) -> Case:
    """MyoSuite."""
    import myosuite  # noqa: F401
    from myosuite.utils import gym

    environment = gym.make(name)
    return Case(environment, _box(environment.action_space))


class DmCase(Case):
    """An environment of dm_control. Made anew it begins with the same episode."""

    def __init__(self, environment: Any) -> None:
        spec = environment.action_spec()
        super().__init__(environment, (spec.minimum, spec.maximum), seeds=False)

    def reset(self) -> None:
        """Begin the next episode."""
        self.rng = np.random.default_rng(0)
        self.environment.reset()


def make_dm_control(name: str) -> Case:
    """dm_control's suite, `DOMAIN:TASK`."""
    from dm_control import suite

    domain, _, task = name.partition(":")
    return DmCase(suite.load(domain, task, task_kwargs={"random": 0}))


def make_manipulation(name: str) -> Case:
    """dm_control's manipulation, which builds its model anew at every reset."""
    from dm_control import manipulation

    return DmCase(manipulation.load(name, seed=0))


class PlaygroundCase(Case):
    """An environment of MuJoCo Playground, which steps in JAX: its states are given to `session.sync`."""

    drives = False  # by `session.targets()`, for a controller of one's own

    def __init__(self, environment: Any) -> None:
        import jax

        ones = np.ones(environment.action_size)
        super().__init__(environment, (-ones, ones))
        self._key, self._reset, self._step = (
            jax.random.PRNGKey(0),
            jax.jit(environment.reset),
            jax.jit(environment.step),
        )
        self._state: Any = None
        self._session: Any = None

    def reset(self) -> None:
        """Begin an episode."""
        self.rng = np.random.default_rng(0)
        self._state = self._reset(self._key)
        self._sync()

    def step(self, action: Any) -> None:
        """Take a step."""
        self._state = self._step(self._state, action)
        self._sync()

    def _sync(self) -> None:
        np.asarray(self._state.data.qpos)  # JAX computes when it is asked
        if self._session is not None:
            self._session.sync(self._state)

    def follow(self, session: Any) -> None:
        """Give the states to a session."""
        self._session = session

    def find_simulation(self) -> Any:
        """Return the model and a copy of the data."""
        data = mujoco.MjData(self.environment.mj_model)
        copy_state(self._state, data)
        return self.environment.mj_model, data


def make_playground(name: str) -> Case:
    """MuJoCo Playground."""
    from mujoco_playground import registry

    return PlaygroundCase(registry.load(name))


# --- measuring --------------------------------------------------------------------------------------------------------


def run_steps(case: Case, n: int, each: Callable[[], object] = lambda: None) -> tuple[list[Any], list[float]]:
    """Reset and take steps. Returns the states and how long each step took [ms]; `each` is called after it."""
    case.reset()
    states, took = [case.read()], []
    for _ in range(n):
        action = case.draw_action()
        began = time.perf_counter()
        case.step(action)
        took.append(1e3 * (time.perf_counter() - began))
        states.append(case.read())
        each()
    return states, took


@contextlib.contextmanager
def watch_from_elsewhere(address: str) -> Iterator[None]:
    """Let an observer in a process of its own watch, so that its work costs the environment nothing."""
    command = [sys.executable, "-c", OBSERVER, address]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        if process.stdout.readline() != "here\n":
            raise RuntimeError("the observer did not join")
        try:
            yield
        finally:
            process.stdin.close()


def find_pose_error_mm(client: Client, case: Case, timeout_s: float = 5.0) -> float:
    """Return the largest distance [mm] between bodies at the observer and in the simulation, which stands still; a
    large number when its time does not come.
    """
    model, data = case.find_simulation()
    names = list_body_names(model)[1:]  # without the world

    def is_there(client: Client) -> bool:
        state = client.scene.state
        is_now = state is not None and abs(state.header.sim_time - data.time) < 1e-9 and client.scene.poses is not None
        return is_now and [body.name for body in client.mirror.bodies] == list(names)

    if not client.wait_for(is_there, timeout_s=timeout_s):
        return 1e6
    now = copy.copy(data)  # after `mj_step` its bodies are where the step began
    mujoco.mj_kinematics(model, now)
    assert client.scene.poses is not None
    return float(1e3 * np.linalg.norm(client.scene.poses[:, :3] - now.xpos[1:], axis=1).max())


def drive(case: Case, session: Any, is_action: bool) -> dict[str, Any]:
    """Move the first arm by 5 cm, then close its gripper."""
    arms = [robot for robot in session.robots if robot.kind != "hand"]
    if not arms or not case.drives or has_free_base(case, arms[0]):
        return {"driven_mm_off": None, "gripper": None}
    robot = arms[0]
    best, fingers = 1e6, None
    with Client(session.address, role="agent", name="agent", devices=("target",)) as client:
        acquire(case, session, is_action, client, robot.name)
        for axis in AXES:
            best = min(best, move(case, session, is_action, client, robot, np.array(axis, float)))
            if best <= MAX_OFF_MM:
                break
        if robot.gripper_actuators:
            fingers = close_gripper(case, session, is_action, client, robot)
    return {"driven_mm_off": round(best, 2), "gripper": fingers}


def has_free_base(case: Case, robot: Any) -> bool:
    """Return true for an arm of a body that falls or walks, where a place in the world cannot be kept."""
    model, _ = case.find_simulation()
    body = list_body_names(model).index(robot.base_body)
    while body:
        joints = range(int(model.body_jntadr[body]), int(model.body_jntadr[body] + model.body_jntnum[body]))
        if int(model.body_jntnum[body]) and any(int(model.jnt_type[j]) == 0 for j in joints):
            return True
        body = int(model.body_parentid[body])
    return False


def step_case(case: Case, session: Any, is_action: bool, client: Client) -> None:
    """Take a step of the environment, paced, and receive."""
    began = time.perf_counter()
    action = case.hold_action()
    case.step(session.action(action) if is_action else action)
    client.poll()
    client.sleep(max(0.0, began + DRIVEN_STEP_S - time.perf_counter()))


def may_close(client: Client, robot: str) -> bool:
    """Return whether to close the clutch: after a disturbance it must be opened first, see the guide."""
    feedback = client.feedback.get(robot)
    return feedback is not None and feedback.hold_reason not in OPEN_CLUTCH


def acquire(case: Case, session: Any, is_action: bool, client: Client, robot: str) -> None:
    """Acquire a robot while the environment goes on."""
    from iris_session.protocol.client_messages import Acquire

    client.submit(Acquire(0, (robot,)))
    for _ in range(200):
        step_case(case, session, is_action, client)
        if client.lease_version(robot) is not None:
            return
    raise RuntimeError(f"no lease for {robot}")


def read_tip(case: Case, robot: Any) -> Any:
    """Return where the tip is [m], and its orientation."""
    model, data = case.find_simulation()
    return Tip(model, robot).read_pose(data)


def move(case: Case, session: Any, is_action: bool, client: Client, robot: Any, axis: Any) -> float:
    """Return what is left [mm] of 5 cm along `axis`, from where the tip is at engagement."""
    _, data = case.find_simulation()
    for _ in range(20):
        p, q = read_tip(case, robot)
        client.send_sample("target", (p, q), robots=robot.name, clutch=False)
        step_case(case, session, is_action, client)
    p, q = read_tip(case, robot)
    begun = float(data.time)
    goal = np.array(p) + DISTANCE_M * axis
    for _ in range(2000):
        share = min(1.0, (float(data.time) - begun) / MOVE_S)
        target = np.array(p) + share * DISTANCE_M * axis
        closed = may_close(client, robot.name)
        client.send_sample("target", (tuple(target.tolist()), q), robots=robot.name, clutch=closed)
        step_case(case, session, is_action, client)
        if data.time - begun > MOVE_S + REST_S:
            break
    return float(1e3 * np.linalg.norm(goal - np.array(read_tip(case, robot)[0])))


def close_gripper(case: Case, session: Any, is_action: bool, client: Client, robot: Any) -> bool:
    """Return whether the fingers came nearer to each other, or moved, between open and closed."""
    model, data = case.find_simulation()
    names = list_body_names(model)
    fingers = [names.index(name) for name in robot.finger_bodies if name in names]
    p, q = read_tip(case, robot)
    seen = []
    for gripper in (0.0, 1.0):
        for _ in range(60):
            closed = may_close(client, robot.name)
            client.send_sample("target", (p, q), robots=robot.name, clutch=closed, gripper=gripper)
            step_case(case, session, is_action, client)
        seen.append(np.array([data.xpos[i] - np.array(read_tip(case, robot)[0]) for i in fingers] or [data.qpos]))
    return bool(np.abs(seen[1] - seen[0]).max() > 2e-3)


def run_case(maker: str, name: str, drive_by: str) -> dict[str, Any]:
    """Return the results of one environment."""
    row: dict[str, Any] = {"mujoco": mujoco.__version__, "shared": False}
    make = globals()[maker]
    case = make(name)
    case.reset()  # as the shared one
    expected, alone = run_steps(case, STEPS)
    case = make(name)
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "session.rrd"
        config = SessionConfig(
            name="suite",
            control_port=0,
            state_port=0,
            record=recording,
            web=False,
            authority=AuthorityConfig(),
        )
        case.reset()
        session = iris_session.share(case.environment, config=config, drive=drive_by)
        case.follow(session)
        row |= {"shared": True, "robots": [robot.name for robot in session.robots], "notes": list(session.notes)[:3]}
        try:
            with watch_from_elsewhere(session.address):
                found, took = run_steps(case, STEPS)
            row["identical"] = len(found) == len(expected) and all(
                np.array_equal(a, b) for a, b in zip(found, expected, strict=True)
            )
            with Client(session.address, role="observer", name="observer") as observer:
                observer.wait_for(lambda client: client.scene.poses is not None)
                case.step(case.draw_action())
                row["poses_mm"] = round(find_pose_error_mm(observer, case), 4)
                row["ms_per_step_p50"] = round(float(np.median(took) - np.median(alone)), 3)
                row["alone_ms_per_step_p50"] = round(float(np.median(alone)), 3)
                run_steps(case, 5, observer.poll)
                row["follows_reset"] = find_pose_error_mm(observer, case) < MAX_POSES_MM
            case.reset()
            row |= drive(case, session, drive_by == "action")
        finally:
            session.close()
        verdict = verify_recording(recording)
        row["verified"] = bool(verdict.ok)
    off = row["driven_mm_off"]
    row["passed"] = bool(
        row["identical"]
        and row["poses_mm"] <= MAX_POSES_MM
        and row["follows_reset"]
        and (off is None or off <= MAX_OFF_MM)
        and row["gripper"] is not False
        and row["verified"]
        and row["ms_per_step_p50"] <= MAX_ADDED_MS
    )
    return row


if __name__ == "__main__":
    print(json.dumps(run_case(*sys.argv[1:4])))
