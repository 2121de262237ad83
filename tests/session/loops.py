"""What the tests of user loops share: a loop without processes, and people in it. Tests take the steps of the helper
thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from iris_session.control import ControlConfig
from iris_session.demo.scenes import scene_path
from iris_session.physics import load_model
from iris_session.protocol.client_messages import Acquire, EStop, Release, Sample
from iris_session.protocol.common import Pose, Target
from iris_session.protocol.entries import Entry, EntryMessage, ExternalReset, Join
from iris_session.protocol.names import Role
from iris_session.session.stepper import Stepper
from iris_session.session.user_loop import UserLoop
from tests.session.play import TICK_NS, make_core
from tests.session.test_stepper import MS, Front, Recorder


class Watch:
    """In place of the processes, which these tests do not need."""

    def supervise(self, stepper: Stepper) -> None:
        pass


class IdleThread:
    """In place of the helper thread: tests take its steps."""

    def __init__(self, **_: object) -> None: ...

    def start(self) -> None: ...

    def join(self, timeout: float = 0.0) -> None: ...


class Rig:
    """A user's loop over the demo scene whose clock the test moves, without its helper thread: see `idle`.

    `policy`: writes the owner's `ctrl` before every tick. `applied`: the `ctrl` of every tick, as physics had it.
    """

    def __init__(self, model: mujoco.MjModel | None = None, control: ControlConfig | None = None) -> None:
        self.now_ns = 0
        self.model = model or load_model(scene_path("handover"))
        self.data = mujoco.MjData(self.model)
        if self.model.nkey:
            mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        core = make_core(self.model, control, user_owned_loop=True)
        self.front, self.recorder = Front(), Recorder(core)
        self.stepper = Stepper(core, self.front, self.recorder, lambda: self.now_ns, MS, 1000 * MS, b"root")
        self.read: list[tuple[int, Entry, bytes]] = []  # step, entry and the plant of that step
        self.stepper.on_entries = self._note
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(threading, "Thread", IdleThread)
            self.loop = UserLoop(self.model, self.data, self.stepper, Watch())  # type: ignore[arg-type]
        self.loop._wake_helper = self.loop._take_helper_step  # type: ignore[method-assign]
        self.policy: Callable[[mujoco.MjData], None] = lambda data: None
        self.applied: list[NDArray[np.float64]] = []

    def _note(self, entries: Sequence[Entry]) -> None:
        plant = self.stepper.core.world.save_state()
        self.read += [(self.stepper.step_count, entry, plant) for entry in entries]

    def resets(self) -> list[bytes]:
        return [plant for _, entry, plant in self.read if isinstance(entry.message, ExternalReset)]

    def actuators(self, robot: int = 0) -> list[int]:
        spec = self.stepper.core.config.robots[robot]
        return [int(self.model.actuator(name).id) for name in (*spec.actuators, spec.gripper_actuator) if name]

    def joints(self, robot: int = 0) -> list[int]:
        return [int(self.model.joint(name).qposadr[0]) for name in self.stepper.core.config.robots[robot].joints]

    def round(self, steps: int = 1) -> None:
        self.now_ns += TICK_NS
        self.policy(self.data)
        self.loop.begin_tick()
        self.applied.append(self.data.ctrl.copy())
        for _ in range(steps):
            mujoco.mj_step(self.model, self.data)
        self.loop.end_tick()

    def rounds(self, n: int, steps: int = 1) -> None:
        for _ in range(n):
            self.round(steps)

    def idle(self) -> None:
        """The user's loop is silent until the helper takes a step."""
        steps = self.stepper.step_count
        self.now_ns += 40 * MS
        self.loop._take_helper_step()
        assert self.stepper.step_count == steps + 1


class Agent:
    """A participant that drives one robot by end-effector targets, a sample every `EVERY` rounds."""

    EVERY = 7

    def __init__(self, rig: Rig, connection: int = 1, robot: str = "left", role: str = Role.AGENT) -> None:
        self.rig, self.connection, self.robot = rig, connection, robot
        self.version = self.seq = 0
        self.gripper: float | None = None
        self.say(Join(f"key{connection}", role, f"p{connection}", devices=("target",), alignment="not_needed"))

    def say(self, message: EntryMessage) -> None:
        entry = Entry(self.connection, self.connection, self.rig.now_ns + TICK_NS, message)
        self.rig.front.waiting.append(entry)

    def acquire(self) -> None:
        self.say(Acquire(1, (self.robot,)))
        self.rig.round()
        leases = self.rig.stepper.core.authority._ctx.state.robots
        self.version = leases[self.robot].version
        self.rig.rounds(2)

    def release(self) -> None:
        self.say(Release(2))

    def estop(self) -> None:
        self.say(EStop("now"))

    def sample(self, pose: Pose, *, clutch: bool) -> None:
        self.seq += 1
        self.say(
            Sample(
                device="target",
                kind="pose",
                seq=self.seq,
                capture_ns=self.rig.now_ns + TICK_NS,
                scene_epoch=self.rig.stepper.core.authority._ctx.state.scene_epoch,
                tracking_epoch=0,
                alignment_version=1,
                targets=(Target(self.robot, self.version),),
                clutch=clutch,
                pose=pose,
                gripper=self.gripper,
            )
        )

    def tip(self) -> Pose:
        return self.rig.stepper.core.controller.get_targets()[self.robot]

    def engage(self, seconds: float = 0.02) -> None:
        """Open the clutch, then close it where the robot is."""
        here = self.tip()
        self.sample(here, clutch=False)
        self.rig.round()
        self.drive(lambda t: self.tip() if t == 0.0 else here, seconds)

    def drive(self, pose: Callable[[float], Pose], seconds: float, *, clutch: bool = True) -> None:
        for i in range(round(seconds * 500)):
            if i % self.EVERY == 0:
                self.sample(pose(i / 500), clutch=clutch)
            self.rig.round()


def take_over(rig: Rig, robot: str = "left") -> Agent:
    """Return a participant that has engaged a robot."""
    agent = Agent(rig, robot=robot)
    rig.round()
    agent.acquire()
    agent.engage()
    return agent


def largest_step(applied: Sequence[NDArray[np.float64]], actuators: Sequence[int]) -> float:
    """The largest change of the `ctrl` of some actuators from one tick to the next."""
    return float(np.abs(np.diff(np.array(applied)[:, list(actuators)], axis=0)).max(initial=0.0))
