"""Learn to reach from recorded episodes: `python tools/learn_reach.py`. The loop from the room to training, and back.

1. A scripted operator shows how to reach: the gripper of an arm goes 12 cm above a box, which lies elsewhere in each
   episode (a task of the session). A few of these episodes train a first policy.
2. That policy runs through `RobotEnv` in mode `priority`. Where it does not get there, the operator closes the clutch
   and corrects it. `iris-session export` marks these frames as interventions.
3. Demonstrations and corrections, exported as a LeRobot data set, train the policy anew: behaviour cloning with a
   network of two layers in numpy. It is tried at new places, through `RobotEnv`, in a session of its own.
4. The same with the actions of the episodes exchanged: it must fail, or the trial proves nothing.

A place counts as reached when the tip is within 3 cm of the goal at the end. All of it takes a quarter of an hour.
Needs `iris-session[all,env]`.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import multiprocessing
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

ROBOT: Final = "arm1"
BOX: Final = "box"
#: Where the box lies [m]: the arm stands at x = -0.6 and reaches all of it.
X_RANGE: Final = (-0.30, 0.00)
Y_RANGE: Final = (-0.22, 0.22)
ABOVE_M: Final = 0.12
REACHED_M: Final = 0.03
#: Rate of the policy, and frames a second of the data set: a demonstration takes half a second.
HZ: Final = 20
FPS: Final = 50
#: A network says the action of so many frames later: half a second of motion.
AHEAD: Final = 25
#: Longest time of a trial [s]; a person corrects a policy that is not there after the second one.
TRIAL_S: Final = 4.0
PATIENCE_S: Final = 2.0


def make_scene() -> Any:
    """Return the model of the scene: an arm on a table, and a box."""
    import mujoco

    from iris_session import n_arms_scene

    spec = n_arms_scene(1, objects=0)
    body = spec.worldbody.add_body(name=BOX, pos=[-0.15, 0.0, 0.02])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02, 0.02, 0.02], rgba=[0.9, 0.4, 0.1, 1.0], mass=0.05)
    key = spec.keys[0]
    key.qpos = [*key.qpos, -0.15, 0.0, 0.02, 1.0, 0.0, 0.0, 0.0]
    return spec.compile()


def serve(port: int, record: str, seed: int, ready: Any, ending: Any) -> None:
    """Run a session until `ending` is set: a process of its own, as a lab has it."""
    from iris_session import Session, SessionConfig
    from iris_session.protocol.specs import ObjectRange, TaskSpec

    task = TaskSpec(
        "reach", "Reach above the box.", robots=(ROBOT,), objects=(ObjectRange(BOX, X_RANGE, Y_RANGE),), seed=seed
    )
    config = SessionConfig(
        name="reach", control_port=port, state_port=0, web=False, beacon_port=0, assets=False,
        record=record or False, task=task,
    )  # fmt: skip
    with Session(make_scene(), config=config) as session:
        ready.set()
        while not ending.is_set():
            session.run(seconds=0.5)


@contextmanager
def running_session(port: int, seed: int, record: Path | None = None) -> Iterator[str]:
    """A session with the task, in a process of its own. Yields its address."""
    context = multiprocessing.get_context("spawn")
    ready, ending = context.Event(), context.Event()
    process = context.Process(target=serve, args=(port, str(record or ""), seed, ready, ending))
    process.start()
    try:
        if not ready.wait(60.0):
            raise SystemExit("the session has not started within 60 s")
        yield f"127.0.0.1:{port}"
    finally:
        ending.set()
        process.join(60.0)


def find_goal(client: Any) -> tuple[float, float, float]:
    """Return the goal of the present episode: above the box [m], world frame."""
    (x, y, z), _ = client.scene.body_pose(BOX)
    return x, y, z + ABOVE_M


# --- people -----------------------------------------------------------------------------------------------------------


class Operator:
    """A scripted person: leads the episodes, shows how to reach, and corrects a policy."""

    def __init__(self, address: str, role: str = "director") -> None:
        from iris_session import Client

        self.client = Client(address, role=role, name="ann", devices="target", alignment="not_needed")
        self.client.connect()
        self.client.start()
        self._down: Any = None

    def begin_episode(self) -> None:
        """Start an episode; the box lies where the task has it."""
        self.client.start_episode(countdown_s=0.2)
        self.client.sleep(0.2)
        if self._down is None:
            self.client.wait_for(lambda c: c.scene.tip_pose(ROBOT) is not None)
            self._down = self.client.scene.tip_pose(ROBOT)[1]

    def reach(self) -> None:
        """Take the arm, move it to the goal, and give it back."""
        self.client.acquire(ROBOT)
        self.client.move_to(ROBOT, (find_goal(self.client), self._down), settle_s=0.3, timeout_s=10.0)

    def end_episode(self, success: bool) -> None:
        """Give the verdict."""
        self.client.end_episode("success" if success else "failure")

    def measure_distance(self) -> float:
        """Return how far the tip is from the goal [m]."""
        return math.dist(self.client.scene.tip_pose(ROBOT)[0], find_goal(self.client))


def record_demonstrations(address: str, n: int) -> None:
    """Let the operator show `n` episodes."""
    ann = Operator(address)
    for i in range(n):
        ann.begin_episode()
        ann.reach()
        ann.end_episode(True)
        say(f"demonstration {i + 1} of {n}")
    ann.client.close()


def record_corrections(address: str, policy: Policy, n: int) -> int:
    """Run a policy in `n` episodes; the operator corrects it where it does not get there. Return how often."""
    from iris_session import Client, RobotEnv

    with Client(address, role="director", name="lab", alignment="not_needed") as lab:
        lab.set_mode(ROBOT, "priority")
    ann, corrected = Operator(address), 0
    env = RobotEnv(address, [ROBOT], hz=HZ)
    for i in range(n):
        ann.begin_episode()
        observation, _ = env.reset()
        hand: threading.Thread | None = None
        for step in range(round((PATIENCE_S + 12.0) * HZ)):
            observation, *_ = env.step(policy.act(observation))
            if step == round(PATIENCE_S * HZ):
                if ann.measure_distance() <= REACHED_M:
                    break
                hand, corrected = threading.Thread(target=ann.reach), corrected + 1
                hand.start()
            if hand is not None and not hand.is_alive():
                break
        if hand is not None:
            hand.join()
        ann.end_episode(ann.measure_distance() <= REACHED_M)
        ann.client.release()
        say(f"episode {i + 1} of {n} of the first policy: {'corrected' if hand else 'reached'}")
    env.close()
    ann.client.close()
    return corrected


def try_policy(address: str, policy: Policy, n: int) -> int:
    """Return how many of `n` new places a policy reaches."""
    from iris_session import RobotEnv

    ann, reached = Operator(address), 0
    env = RobotEnv(address, [ROBOT], hz=HZ)
    for i in range(n):
        ann.begin_episode()
        observation, info = env.reset()
        for _ in range(round(TRIAL_S * HZ)):
            observation, _, _, _, info = env.step(policy.act(observation))
        x, y, z = observation["environment_state"][:3].tolist()
        distance = math.dist(info["end_effector"][ROBOT][:3], (x, y, z + ABOVE_M))
        reached += distance <= REACHED_M
        ann.end_episode(distance <= REACHED_M)
        say(f"place {i + 1} of {n}: {1e3 * distance:.0f} mm off, {reached} reached")
    env.close()
    ann.client.close()
    return reached


# --- data and learning ------------------------------------------------------------------------------------------------


class Episodes:
    """Frames of an exported set: joints and box, actions, whether each is to be learned, one array per episode."""

    def __init__(self, folder: Path) -> None:
        from pyarrow import parquet

        self.inputs: list[Floats] = []
        self.actions: list[Floats] = []
        self.interventions = self.frames = 0
        for path in sorted((folder / "data").rglob("*.parquet")):
            table = parquet.read_table(path)
            columns = {name: np.array(table[name].to_pylist()) for name in table.column_names if name != "timestamp"}
            is_corrected = columns[f"robots.{ROBOT}.intervention"].astype(bool).reshape(-1)
            is_person = columns[f"robots.{ROBOT}.engaged"].astype(bool).reshape(-1)
            if is_corrected.any():  # before it, the policy drove
                is_person &= is_corrected
            chosen = np.flatnonzero(is_person)
            later = np.minimum(chosen + AHEAD, len(is_person) - 1)
            box = columns[f"objects.{BOX}.pose"][:, :3]
            self.inputs.append(np.concatenate((columns["observation.state"], box), axis=1)[chosen])
            self.actions.append(columns["action"][later])
            self.interventions += int(is_corrected.sum())
            self.frames += len(is_person)

    def shuffle(self, rng: np.random.Generator) -> None:
        """Give each episode the actions of another one."""
        order = np.roll(rng.permutation(len(self.actions)), 1)
        pairs = [(self.inputs[i], self.actions[j]) for i, j in zip(np.roll(order, 1), order, strict=True)]
        n = [min(len(a), len(b)) for a, b in pairs]
        self.inputs = [a[:k] for (a, _), k in zip(pairs, n, strict=True)]
        self.actions = [b[:k] for (_, b), k in zip(pairs, n, strict=True)]


class Policy:
    """A network of two hidden layers from joints and place of the box to `ctrl`, trained by Adam on squared errors."""

    def __init__(self, episodes: Episodes, rng: np.random.Generator, steps: int = 6000, width: int = 128) -> None:
        x, y = np.concatenate(episodes.inputs), np.concatenate(episodes.actions)
        self._x_mean, self._x_std = x.mean(0), x.std(0) + 1e-3
        self._y_mean, self._y_std = y.mean(0), y.std(0) + 1e-3
        x, y = (x - self._x_mean) / self._x_std, (y - self._y_mean) / self._y_std
        sizes = (x.shape[1], width, width, y.shape[1])
        self._layers = [rng.normal(0.0, 1.0 / math.sqrt(a), (a + 1, b)) for a, b in itertools.pairwise(sizes)]
        first = [np.zeros_like(w) for w in self._layers]
        second = [np.zeros_like(w) for w in self._layers]
        for step in range(1, steps + 1):
            rows = rng.integers(len(x), size=256)
            noisy = x[rows] + rng.normal(0.0, 0.03, (256, x.shape[1]))  # joints are never exactly those of before
            rate = 2e-3 * 0.5 * (1.0 + math.cos(math.pi * step / steps))
            for i, slope in enumerate(self._differentiate(noisy, y[rows])):
                first[i] += 0.1 * (slope - first[i])
                second[i] += 0.001 * (slope**2 - second[i])
                scale = math.sqrt(1.0 - 0.999**step) / (1.0 - 0.9**step)
                self._layers[i] -= rate * scale * first[i] / (np.sqrt(second[i]) + 1e-8)

    def _run(self, x: Floats) -> list[Floats]:
        values = [_add_one(x)]
        for weights in self._layers[:-1]:
            values.append(_add_one(np.tanh(values[-1] @ weights)))
        return [*values, values[-1] @ self._layers[-1]]

    def _differentiate(self, x: Floats, y: Floats) -> list[Floats]:
        values = self._run(x)
        slope = 2.0 * (values[-1] - y) / y.size
        slopes: list[Floats] = []
        for weights, value in zip(self._layers[::-1], values[-2::-1], strict=True):
            slopes.append(value.T @ slope)
            slope = (slope @ weights.T)[:, :-1] * (1.0 - value[:, :-1] ** 2)
        return slopes[::-1]

    def act(self, observation: dict[str, Any]) -> Floats:
        """Return the `ctrl` for an observation of `RobotEnv`."""
        x = np.concatenate((observation["agent_pos"], observation["environment_state"][:3]))
        y: Floats = self._run(((x - self._x_mean) / self._x_std)[None])[-1][0]
        return y * self._y_std + self._y_mean


def _add_one(x: Floats) -> Floats:
    return np.concatenate((x, np.ones((len(x), 1))), axis=1)


def export(recordings: list[Path], folder: Path) -> Episodes:
    """Export recordings as a data set by the command, and read it."""
    shutil.rmtree(folder, ignore_errors=True)
    command = [sys.executable, "-m", "iris_session.cli.main", "export", *map(str, recordings), "--fps", str(FPS)]
    subprocess.run([*command, "--to", "lerobot", "--out", str(folder)], check=True, stdout=sys.stderr)
    return Episodes(folder)


def say(text: str) -> None:
    """Tell the progress."""
    print(text, file=sys.stderr, flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--demonstrations", type=int, default=120, help="episodes that are shown (default %(default)s)")
    parser.add_argument("--first", type=int, default=8, help="of these, for the first policy (default %(default)s)")
    parser.add_argument(
        "--corrections", type=int, default=15, help="episodes of the first policy (default %(default)s)"
    )
    parser.add_argument("--places", type=int, default=50, help="new places that are tried (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--port", type=int, default=9470)
    parser.add_argument("--folder", type=Path, help="keep recordings and data sets here")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    began_s = time.monotonic()
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="learn-reach-"))
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(arguments.seed)
    shown, corrected = folder / "shown" / "session.rrd", folder / "corrected" / "session.rrd"
    with running_session(arguments.port, arguments.seed, shown) as address:
        record_demonstrations(address, arguments.demonstrations)
    episodes = export([shown], folder / "first")
    del episodes.inputs[arguments.first :], episodes.actions[arguments.first :]
    first = Policy(episodes, rng, steps=500)
    with running_session(arguments.port, arguments.seed + 1000, corrected) as address:
        n_corrected = record_corrections(address, first, arguments.corrections)
    episodes = export([shown, corrected], folder / "all")
    policies = {"reached": Policy(episodes, rng)}
    n_interventions, n_frames = episodes.interventions, episodes.frames
    episodes.shuffle(rng)
    policies["reached_with_shuffled_actions"] = Policy(episodes, rng)
    results: dict[str, Any] = {}
    for name, policy in policies.items():
        with running_session(arguments.port, arguments.seed + 2000) as address:
            results[name] = try_policy(address, policy, arguments.places) / arguments.places
    results |= {
        "places": arguments.places,
        "demonstrations": arguments.demonstrations,
        "corrected_episodes": n_corrected,
        "frames": n_frames,
        "intervention_frames": n_interventions,
        "seed": arguments.seed,
        "minutes": round((time.monotonic() - began_s) / 60.0, 1),
    }
    ok = results["reached"] >= 0.6 and results["reached_with_shuffled_actions"] <= 0.15 and n_interventions > 0
    if arguments.folder is None:
        shutil.rmtree(folder)
    print(json.dumps(results | {"ok": ok}) if arguments.json else "\n".join(f"{k}: {v}" for k, v in results.items()))
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main())
