"""`iris-session policy`: a policy of LeRobot drives robots of a live session, beside people.

LeRobot is no extra of this package: it pins its own torch and numpy. The command runs in an environment that has both.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotReadyError
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from iris_session.cli.common import (
    CommandError,
    Commands,
    add_address_options,
    add_command,
    check_session_reachable,
    ending_as_interrupts,
    make_client,
    make_number_type,
    parse_seconds,
    print_json,
)
from iris_session.protocol.names import Role

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from iris_session.client.robot_env import RobotEnv

HZ: Final = 30.0
#: A policy that computes is waited for so long; then the command before is repeated, else the robot would hold [s].
PATIENCE_S: Final = 0.1
#: After so long without a decision it commands nothing: robots hold, as for everything that has stopped [s].
STUCK_S: Final = 1.0
NO_LEROBOT: Final = (
    "LeRobot is not installed here: make an environment with both, pip install lerobot 'iris-session[env,files]'"
)
#: States of a robot. At a change a policy must not go on with what it had planned.
DRIVEN, INTERVENTION, WAITING = "driven", "intervention", "waiting"
Observation = Mapping[str, Any]


def register(commands: Commands) -> None:
    parser = add_command(
        commands,
        "policy",
        run,
        help="drive robots by a policy of LeRobot",
        description="Run a trained policy of LeRobot in a live session, beside people, until Ctrl-C. Robots and "
        "cameras are those of the data set that it was trained on, in the same order.",
        examples="""
            iris-session policy --repo outputs/train/act/checkpoints/last/pretrained_model --robot left --camera top
            iris-session policy --repo me/act_handover --robot left --robot right --address 192.168.0.10 --seconds 60
        """,
    )
    parser.add_argument("--repo", required=True, metavar="PATH", help="folder of a checkpoint, or its name on the hub")
    parser.add_argument("--robot", action="append", required=True, metavar="NAME", help="a robot, repeatable")
    text = "a camera of the session, repeatable (default: those that the policy needs)"
    parser.add_argument("--camera", action="append", default=[], metavar="NAME", help=text)
    rate = make_number_type(float, "a rate: give 1 to 240 steps a second, for example 30", 1.0, 240.0)
    parser.add_argument("--hz", type=rate, default=HZ, help="steps a second, as in the data set (%(default)g)")
    parser.add_argument("--device", default="cpu", help="cpu, cuda, cuda:1, ... (%(default)s)")
    parser.add_argument("--task", default="", help="task in words, for policies that read it")
    parser.add_argument("--seconds", type=parse_seconds, help="stop after this many seconds")
    add_address_options(parser, option=True)


class LeRobotPolicy:
    """A checkpoint of LeRobot, a folder or a name on the hub, with its normalisation. Raises `CommandError`.

    Attributes:
        inputs: Shapes of the observations that it needs, by their name in the data set; pictures (3, h, w).
        n_actions: Numbers of an action.
    """

    def __init__(self, repo: str, device: str = "cpu", task: str = "") -> None:
        try:
            import torch
            from lerobot.configs.policies import PreTrainedConfig
            from lerobot.policies.factory import get_policy_class, make_pre_post_processors
            from lerobot.policies.utils import prepare_observation_for_inference
        except ImportError as error:
            if (error.name or "").partition(".")[0] not in ("torch", "lerobot"):
                raise CommandError(f"LeRobot cannot be imported: {error}") from error
            raise CommandError(NO_LEROBOT) from error
        if repo.startswith(("/", ".", "~")) and not Path(repo).is_dir():
            raise CommandError(f"--repo {repo:.200}: there is no such folder")
        try:
            with redirect_stdout(sys.stderr):  # it prints
                config = PreTrainedConfig.from_pretrained(repo)
                config.device = device
                self._policy: Any = get_policy_class(config.type).from_pretrained(repo, config=config)
                self._before, self._after = make_pre_post_processors(
                    config, pretrained_path=repo, preprocessor_overrides={"device_processor": {"device": device}}
                )
                self._device = torch.device(device)
        except Exception as error:  # of its many packages
            reason = " ".join(str(error).split()) or type(error).__name__
            raise CommandError(f"{repo!r:.200} is no policy that LeRobot can load: {reason:.300}") from error
        self._torch, self._prepare, self._task = torch, prepare_observation_for_inference, task
        self.inputs = {name: tuple(one.shape) for name, one in config.input_features.items()}
        self.n_actions = int(config.output_features["action"].shape[0])

    def reset(self) -> None:
        """Forget planned actions and past observations."""
        self._policy.reset()

    def act(self, observation: Observation) -> NDArray[np.float32]:
        """Return the action for an observation of `RobotEnv`."""
        import numpy as np

        arrays = {name: np.array(one) for name, one in name_inputs(observation).items() if name in self.inputs}
        with self._torch.inference_mode():
            batch = self._before(self._prepare(arrays, self._device, self._task))
            action = self._after(self._policy.select_action(batch))
        result: NDArray[np.float32] = action.squeeze(0).to("cpu").numpy()
        return result


def name_inputs(observation: Observation) -> dict[str, Any]:
    """Return the arrays of an observation, or their spaces, by their names in data sets of LeRobot."""
    found = {
        "observation.state": observation["agent_pos"],
        "observation.environment_state": observation["environment_state"],
    }
    pixels = observation.get("pixels", {})
    return found | {f"observation.images.{camera}": pixels[camera] for camera in pixels}


def find_spaces(env: RobotEnv) -> dict[str, Any]:
    """Return the space of each observation."""
    spaces: Any = env.observation_space
    return dict(spaces.spaces)


def check_fit(policy: LeRobotPolicy, env: RobotEnv) -> None:
    """Raise `CommandError` where the policy needs other observations, or commands another number of actuators."""
    offered = {name: space.shape for name, space in name_inputs(find_spaces(env)).items()}
    for name, shape in policy.inputs.items():
        if name not in offered:
            kind, _, camera = name.rpartition(".")
            hint = f"give --camera {camera}" if kind.endswith("images") else f"there are {', '.join(offered)}"
            raise CommandError(f"the policy needs {name}: {hint}")
        here = offered[name]
        if len(here) == 3:
            here = (here[2], here[0], here[1])
        if here != shape:
            hint = (
                "give the camera its size, serve --picture CAMERA:WIDTHxHEIGHT" if len(here) == 3 else "other robots?"
            )
            raise CommandError(f"the policy needs {name} of shape {shape}, here it is {here}: {hint}")
    if (policy.n_actions,) != env.action_space.shape:
        raise CommandError(
            f"the policy has actions of {policy.n_actions} numbers, robots {', '.join(env.robots)} have "
            f"{env.action_space.shape}: give those of its data set"
        )


def run(arguments: argparse.Namespace) -> int:
    """Drive until Ctrl-C or `--seconds`. Exit status 0, or 1 when the session has ended."""
    from iris_session.client.robot_env import RobotEnv

    check_session_reachable(arguments)
    policy = LeRobotPolicy(arguments.repo, arguments.device, arguments.task)
    images = "observation.images."
    needed = [name.removeprefix(images) for name in policy.inputs if name.startswith(images)]
    if arguments.code:  # it is good once, and robots join one by one
        make_client(arguments, Role.AGENT, "policy").connect().close()
    log = RunLog(arguments.robot, sys.stderr if arguments.json else sys.stdout)
    env = RobotEnv(
        arguments.address,
        arguments.robot,
        hz=arguments.hz,
        cameras=arguments.camera or needed,
        session=arguments.session,
    )
    lost = False
    try:
        check_fit(policy, env)
        policy.act(make_blank(env))  # the first one takes long: before a robot waits for it
        with ending_as_interrupts():
            lost = drive(env, policy, log, arguments.seconds)
    except KeyboardInterrupt:
        pass
    finally:
        env.close()
    log.end()
    if arguments.json:
        print_json({"ok": not lost, **log.summarise()})
    if lost:
        raise CommandError("the connection to the session was lost", status=1)
    return 0


def make_blank(env: RobotEnv) -> Observation:
    """Return an observation of the right shapes, all 0."""
    import numpy as np

    spaces = find_spaces(env)
    pixels = spaces.get("pixels", {})
    blank = {name: np.zeros(spaces[name].shape, np.float32) for name in ("agent_pos", "environment_state")}
    return {**blank, "pixels": {camera: np.zeros(pixels[camera].shape, np.uint8) for camera in pixels}}


def drive(env: RobotEnv, policy: LeRobotPolicy, log: RunLog, seconds: float | None) -> bool:
    """Take steps until `seconds` are over. Return whether the session was lost."""
    observation, info = env.reset()
    action = info["ctrl"].copy()
    end_s = None if seconds is None else time.monotonic() + seconds
    states, is_stale = log.note(info), True
    future: Future[NDArray[np.float32]] | None = None
    with ThreadPoolExecutor(1, "iris-policy") as pool:
        while end_s is None or time.monotonic() < end_s:
            if future is None:
                if is_stale:
                    policy.reset()  # what it has planned is of another state
                    is_stale = False
                future, began_s = pool.submit(policy.act, observation), time.monotonic()
            with suppress(NotReadyError):  # then the command before is repeated
                found = future.result(PATIENCE_S)
                future, action = None, action if is_stale else found
                log.note_policy(time.monotonic() - began_s)
            if future is not None and time.monotonic() - began_s > STUCK_S:
                continue
            observation, _, _, lost, info = env.step(action)
            if lost:
                return True
            before, states = states, log.note(info)
            is_stale = is_stale or states != before
    return False


class RunLog:
    """Says once a second what happens, and counts it. `out`: where to."""

    def __init__(self, robots: list[str], out: Any) -> None:
        self._robots, self._out = robots, out
        self._began_s = self._reported_s = time.monotonic()
        self._steps = self._reported_steps = 0
        self._longest_s = 0.0
        self._shares: dict[str, Counter[str]] = {robot: Counter() for robot in robots}
        self._interventions: Counter[str] = Counter()
        self._states: dict[str, str] = {}

    def note_policy(self, policy_s: float) -> None:
        """Take the time that an action was computed for [s]."""
        self._longest_s = max(self._longest_s, policy_s)

    def note(self, info: Mapping[str, Any]) -> dict[str, str]:
        """Take a step. Return the state of each robot: driven, intervention, waiting."""
        now_s = time.monotonic()
        if not self._steps:
            self._began_s, self._reported_s, self._reported_steps = now_s, now_s, 1
        self._steps += 1
        states = {}
        for robot in self._robots:
            state = INTERVENTION if info["intervention"][robot] else DRIVEN if info["driven"][robot] else WAITING
            self._shares[robot][state] += 1
            self._interventions[robot] += state == INTERVENTION != self._states.get(robot)
            states[robot] = state
        self._states = states
        if now_s - self._reported_s >= 1.0:
            self._report(info, now_s)
        return states

    def _report(self, info: Mapping[str, Any], now_s: float) -> None:
        hz = (self._steps - self._reported_steps) / (now_s - self._reported_s)
        parts = []
        for robot, state in self._states.items():
            why = info["hold_reason"][robot]
            parts.append(f"{robot}: {state}{f' ({why})' if why and state != DRIVEN else ''}")
        times = f"{hz:.1f} steps/s, policy at most {self._longest_s * 1e3:.0f} ms"
        ages_ms = [(info["session_time_ns"] - ns) * 1e-6 for ns in info.get("capture_ns", {}).values()]
        if ages_ms:
            times += f", pictures {max(ages_ms):.0f} ms old"
        print(f"{now_s - self._began_s:6.0f} s  {'  '.join(parts)}  ({times})", file=self._out, flush=True)
        self._reported_s, self._reported_steps, self._longest_s = now_s, self._steps, 0.0

    def summarise(self) -> dict[str, Any]:
        """Return steps, seconds, and by robot the share of steps in each state and the number of interventions."""
        n = max(1, self._steps)
        shares = {robot: {state: round(k / n, 3) for state, k in one.items()} for robot, one in self._shares.items()}
        seconds = round(time.monotonic() - self._began_s, 1)
        counts = {robot: self._interventions[robot] for robot in self._robots}
        return {"steps": self._steps, "seconds": seconds, "shares": shares, "interventions": counts}

    def end(self) -> None:
        """Print the summary."""
        found = self.summarise()
        texts = [
            f"{robot} driven in {100 * found['shares'][robot].get(DRIVEN, 0.0):.0f} % of them, "
            f"{found['interventions'][robot]} interventions"
            for robot in self._robots
        ]
        print(f"{found['steps']} steps in {found['seconds']} s: {'; '.join(texts)}", file=self._out, flush=True)
