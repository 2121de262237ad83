"""`RobotEnv`: a Gymnasium environment over a live session, for policies that run beside people.

Observations and actions have the order of exported data sets: a policy that was trained on one runs here. Rewards are
0: a session knows episodes and their verdicts, not rewards.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.client.arguments import to_names
from iris_session.client.client import Client
from iris_session.client.errors import ClientError, NotConnectedError
from iris_session.protocol.names import CommandKind, ControlAction, Device, LeaseMode, Role
from iris_session.protocol.server_messages import ActuatorInfo, RobotInfo, RobotState
from iris_session.system.extras import require_package

require_package("gymnasium", "RobotEnv")
import gymnasium  # noqa: E402  (a missing package is an error that names the extra)

Floats = NDArray[np.float32]
Observation = dict[str, Any]

#: Samples are repeated at least this often: after 150 ms without one a robot holds [s].
SAMPLE_PERIOD_S: Final = 1.0 / 30.0
#: Longest wait for the first state, for a reset, and for robots that may be driven [s].
WAIT_S: Final = 10.0


class RobotEnv(gymnasium.Env[Observation, NDArray[Any]]):
    """Robots of a live session as a Gymnasium environment, in real time.

        env = RobotEnv("127.0.0.1:7721", ["left"], hz=30)
        observation, info = env.reset()
        observation, reward, terminated, truncated, info = env.step(policy(observation))

    It joins as one participant (role `agent`) for each robot. In lease mode `priority` a person who closes the clutch
    of a robot drives it at once: `info["intervention"]` says so, actions for it are ignored, and the policy drives
    again when that person stands by.

    Observations: `agent_pos`: joints [rad or m] of each robot, then its gripper (0 open, 1 closed) if it has one;
    `environment_state`: `x y z qw qx qy qz` [m] of each object, world frame; with `cameras`, `pixels`: the newest
    picture of each, uint8 (h, w, 3), RGB. Actions: `ctrl` of the actuators of each robot, in the units of the model.
    These are `observation.state`, `observation.images` and `action` of exported data sets.

    Args:
        address: As of `Client`.
        robots: Names of the robots.
        hz: Steps a second [Hz].
        cameras: Cameras whose pictures are observed, of those that the session offers (`Client.camera`). They have the
            names that exported data sets give them: `/` is `_`.
        name: Name that people see; of several robots, followed by that of the robot.
        resets: Join as director, too (`NAME director`), so that `reset` resets the scene. Without it `reset` only takes
            the robots: people, or their episodes, reset the scene.

    Attributes:
        robots: Names of the robots.
        objects: Names of the objects, in the order of `environment_state`.
        cameras: Feeds of the cameras, by name.

    Raises:
        ClientError: No session; it has no such robot or camera; or a robot is not controlled by position, joint by
            joint.
        MissingExtraError: Gymnasium is not installed.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (declared so by Gymnasium)

    def __init__(
        self,
        address: str = "",
        robots: str | Iterable[str] = (),
        *,
        hz: float = 30.0,
        cameras: str | Iterable[str] = (),
        name: str = "policy",
        resets: bool = False,
        **options: Any,
    ) -> None:
        self.robots = to_names("robots", robots)
        if not self.robots:
            raise ClientError("RobotEnv needs the name of at least one robot")
        if not 1.0 <= hz <= 240.0:
            raise ClientError(f"hz={hz:g}: 1 to 240 steps a second are possible")
        self._period_ns = round(1e9 / hz)
        self._due_ns = 0
        self._director: Client | None = None
        self._clients: dict[str, Client] = {}
        try:
            for robot in self.robots:
                title = name if len(self.robots) == 1 else f"{name} {robot}"
                client = Client(
                    address,
                    role=Role.AGENT,
                    name=title,
                    devices=Device.JOINTS,
                    robot_states=not self._clients,
                    **options,
                )
                self._clients[robot] = client
                client.connect()
            if resets:
                self._director = Client(
                    address, role=Role.DIRECTOR, name=f"{name} director", alignment="not_needed", **options
                )
                self._director.connect()
            self._viewer = self._clients[self.robots[0]]
            self._infos = {robot: self._find_info(robot) for robot in self.robots}
            for client in self._list_clients():
                client.start()
            feeds = [self._viewer.camera(camera, WAIT_S) for camera in to_names("cameras", cameras)]
            self.cameras = {feed.feed.stream: feed for feed in feeds}
            shapes = {camera: feed.wait(WAIT_S).shape for camera, feed in self.cameras.items()}
        except BaseException:
            self.close()
            raise
        self.objects = self._list_objects()
        actuators = [one for robot in self.robots for one in self._infos[robot].actuators]
        low, high = ([getattr(one, side) for one in actuators] for side in ("low", "high"))
        n_state = sum(len(info.joints) + info.gripper for info in self._infos.values())
        self.action_space = gymnasium.spaces.Box(np.array(low, np.float32), np.array(high, np.float32))
        seen: dict[str, gymnasium.Space[Any]] = {
            "agent_pos": gymnasium.spaces.Box(-math.inf, math.inf, (n_state,)),
            "environment_state": gymnasium.spaces.Box(-math.inf, math.inf, (7 * len(self.objects),)),
        }
        if shapes:
            pixels: dict[str, gymnasium.Space[Any]] = {
                camera: gymnasium.spaces.Box(0, 255, shape, np.uint8) for camera, shape in shapes.items()
            }
            seen["pixels"] = gymnasium.spaces.Dict(pixels)
        self.observation_space = gymnasium.spaces.Dict(seen)

    def _list_clients(self) -> list[Client]:
        return [*self._clients.values(), *([self._director] if self._director is not None else [])]

    def _find_info(self, robot: str) -> RobotInfo:
        known = self._viewer.mirror.robots
        info = known.get(robot)
        if info is None:
            raise ClientError(f"the session has no robot {robot!r}; it has {', '.join(known) or 'none'}")
        arm = info.actuators[: len(info.joints)]
        if len(arm) < len(info.joints) or any(one.scale == 0.0 for one in arm):
            raise ClientError(f"robot {robot!r} is not controlled by position, joint by joint: use Client.send_target")
        return info

    def _list_objects(self) -> tuple[str, ...]:
        return tuple(body.name for body in self._viewer.mirror.bodies if body.object)

    # --- Gymnasium ----------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Reset the scene (with `resets`), take the robots, and wait until they may be driven.

        Args:
            seed: Of `np_random`; the session does not use it.
            options: None are known.

        Returns:
            The observation, and information as of `step`.

        Raises:
            DeniedError: A robot is not to be had, or the scene may not be reset; the text says why. Robots that this
                call took are released.
            NotConnectedError: There is no session any more, or no state came.
            ClientError: The session has another scene, whose robots or objects differ.
        """
        super().reset(seed=seed)
        if self._director is not None:
            before = self._viewer.mirror.scene_epoch
            self._director.control(ControlAction.RESET)
            self._wait_for(lambda: self._viewer.mirror.scene_epoch > before, "the scene was not reset")
        self._wait_for_states()
        taken: list[str] = []
        try:
            for robot, client in self._clients.items():
                if client.lease_version(robot) is None:
                    client.acquire(robot)
                    taken.append(robot)
        except BaseException:
            for robot in taken:  # all or none: others may wait for these
                self._clients[robot].release(robot)
            raise
        begun_ns = self._viewer.session_now_ns()
        self._wait_for(
            lambda: all((feed.capture_ns or 0) >= begun_ns for feed in self.cameras.values()), "no new pictures came"
        )
        end_ns = self._viewer.session_now_ns() + int(WAIT_S * 1e9)
        while not all(map(self._may_drive, self.robots)) and self._viewer.session_now_ns() < end_ns:
            for robot, client in self._clients.items():  # the session has to see the clutch open
                if client.lease_version(robot) is not None:
                    client.send_sample(Device.JOINTS, q=self._get_state(robot).q, robots=robot)
            self._viewer.sleep(SAMPLE_PERIOD_S)
        self._due_ns = self._viewer.session_now_ns()
        return self._observe()

    def step(self, action: NDArray[Any]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Command the robots for one period, and return what is then.

        Args:
            action: `ctrl` of all actuators; what is outside of `action_space` is clipped.

        Returns:
            Observation; 0; False; whether a connection to the session is lost; and information: by robot
            `intervention` (a person drives it), `driven` (this policy does), `hold_reason`, `end_effector`
            (`x y z qw qx qy qz` [m], world frame); `ctrl` in force, shape of the action: in an intervention, that of
            the person; `session_time_ns`, `sim_time_s`, `tick` of the state; with cameras, `capture_ns` by camera:
            session time of the state that its picture shows, which is older.

        Raises:
            ValueError: The action has another shape, or a value that is not finite.
            NotConnectedError: The session has ended.
            ClientError: The session has another scene, whose robots or objects differ.
        """
        values = np.asarray(action, np.float64)
        if values.shape != self.action_space.shape:
            raise ValueError(f"action has shape {values.shape}: {self.action_space.shape} is needed")
        if not np.isfinite(values).all():
            raise ValueError(f"action has values that are not finite: {values}")
        commands, at = {}, 0
        for robot in self.robots:
            known = self._infos[robot]
            own, at = values[at : at + len(known.actuators)], at + len(known.actuators)
            commands[robot] = _to_command(known, own)
        self._due_ns += self._period_ns
        now_ns = self._viewer.session_now_ns()
        if now_ns > self._due_ns + self._period_ns:  # the policy is slower than `hz`
            self._due_ns = now_ns
        while True:
            self._send(commands)
            left_s = (self._due_ns - self._viewer.session_now_ns()) * 1e-9
            if left_s <= 0.0:
                break
            self._viewer.sleep(min(left_s, SAMPLE_PERIOD_S))
        observation, info = self._observe()
        return observation, 0.0, False, not all(client.ready for client in self._clients.values()), info

    def close(self) -> None:
        """Leave the session; the robots are released."""
        for client in self._list_clients():
            client.close()

    # --- inside -------------------------------------------------------------------------------------------------------

    def _may_drive(self, robot: str) -> bool:
        return self._is_intervened(robot) or self._clients[robot].is_armed(robot)

    def _is_intervened(self, robot: str) -> bool:
        """Return whether a person drives a robot of ours: read off its lease, which is right after a reconnect, too."""
        client = self._clients[robot]
        lease, us = client.mirror.leases.get(robot), client.participant_id
        return lease is not None and lease.mode == LeaseMode.PRIORITY and us in lease.sub_holders and lease.holder != us

    def _send(self, commands: dict[str, tuple[Any, float | None]]) -> None:
        for robot, (q, gripper) in commands.items():
            client = self._clients[robot]
            if client.lease_version(robot) is not None:
                more: dict[str, Any] = {} if gripper is None else {"gripper": gripper}
                client.send_sample(Device.JOINTS, q=q, robots=robot, clutch=client.is_armed(robot), **more)

    def _get_state(self, robot: str) -> RobotState:
        state = self._viewer.scene.robot_state(robot)
        if state is None:
            raise NotConnectedError(f"no state of robot {robot!r}: {self._viewer.connection.describe()}")
        return state

    def _wait_for(self, condition: Callable[[], bool], what: str) -> None:
        if not self._viewer.wait_for(lambda _: condition(), WAIT_S):
            raise NotConnectedError(f"{what} within {WAIT_S:g} s")

    def _wait_for_states(self) -> None:
        """Wait for states of the present scene: just after a reset there are none."""

        def is_other() -> bool:
            known = self._viewer.mirror.robots
            return self._list_objects() != self.objects or any(known.get(r) != info for r, info in self._infos.items())

        self._wait_for(
            lambda: is_other() or all(self._viewer.scene.robot_state(robot) is not None for robot in self.robots),
            "no state of the robots came",
        )
        if is_other():
            raise ClientError("the session has another scene, whose robots or objects differ: make a new RobotEnv")

    def _observe(self) -> tuple[Observation, dict[str, Any]]:
        self._wait_for_states()
        states = [self._get_state(robot) for robot in self.robots]
        joints: list[float] = []
        for state in states:
            joints += state.q
            if self._infos[state.robot].gripper:
                joints.append(math.nan if state.gripper is None else state.gripper)
        poses = [self._viewer.scene.body_pose(name) for name in self.objects]
        objects = [x for pose in poses for x in ((*pose[0], *pose[1]) if pose is not None else (math.nan,) * 7)]
        observation: Observation = {
            "agent_pos": np.array(joints, np.float32),
            "environment_state": np.array(objects, np.float32),
        }
        if self.cameras:
            observation["pixels"] = {camera: feed.read() for camera, feed in self.cameras.items()}
        feedback = {robot: client.feedback.get(robot) for robot, client in self._clients.items()}
        header = self._viewer.scene.state.header if self._viewer.scene.state is not None else None
        info = {
            "intervention": {robot: self._is_intervened(robot) for robot in self.robots},
            "driven": {robot: one is not None and one.state == CommandKind.JOINTS for robot, one in feedback.items()},
            "hold_reason": {robot: one.hold_reason if one else "" for robot, one in feedback.items()},
            "end_effector": {one.robot: np.array((*one.tip.p, *one.tip.q)) for one in states},
            "ctrl": np.array([x for state in states for x in state.ctrl], np.float32),
            "session_time_ns": header.session_time if header else 0,
            "sim_time_s": header.sim_time if header else 0.0,
            "tick": header.tick if header else 0,
        }
        if self.cameras:
            info["capture_ns"] = {camera: feed.capture_ns for camera, feed in self.cameras.items()}
        return observation, info


def _to_command(info: RobotInfo, ctrl: NDArray[np.float64]) -> tuple[list[float], float | None]:
    """Return joint positions [rad or m] and closing of the gripper (0 to 1) that `ctrl` of a robot asks for."""
    targets = [_to_position(one, x) for one, x in zip(info.actuators, ctrl.tolist(), strict=True)]
    n = len(info.joints)
    gripper = min(1.0, max(0.0, targets[n])) if len(targets) > n else None
    return targets[:n], gripper


def _to_position(actuator: ActuatorInfo, ctrl: float) -> float:
    return (min(actuator.high, max(actuator.low, ctrl)) - actuator.offset) / actuator.scale
