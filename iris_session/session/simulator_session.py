"""`SimulatorSession`: a session over a simulation of another simulator, which its program steps as before.

    session = iris_session.share(scene)  # a Genesis scene, for example
    while ...:
        scene.step()  # is seen by participants

Every step of the simulation is followed: its poses are read and published at the rate of the state, and robots that
participants drive are moved to their targets by the simulator's own control before the next step. A robot that is no
longer driven gets one more target, where it is: the drives of a simulator would hold the last one, which lies ahead.
"""

from __future__ import annotations

import atexit
import logging
import os
from collections.abc import Sequence
from typing import Any

from iris_session.protocol.common import Pose
from iris_session.protocol.specs import RobotSpec
from iris_session.scene.builder import SceneBuilder
from iris_session.scene.errors import SceneBuildError
from iris_session.session.config import SessionConfig
from iris_session.session.errors import ConfigError, OwnershipError
from iris_session.session.robots import AUTO, NONE
from iris_session.session.scene_publisher import ScenePublisher
from iris_session.simulators.adapter import Adapter, SimulationState, TipTarget
from iris_session.simulators.wrapping import AlreadyWrappedError

_log = logging.getLogger(__name__)


class SimulatorSession(ScenePublisher):
    """A session over a simulation of another simulator; `iris_session.share` makes and starts it.

    Args:
        adapter: Reads the simulation; see `iris_session.simulators`.
        config: As of `ScenePublisher`.
        robots: `auto`, `none`, or names of the robots that are found, as a sequence or separated by commas.
        drives: Move robots that participants drive. Otherwise your program does it, with `targets()`.

    Raises:
        ConfigError: The scene cannot be composed, or an argument cannot be used.
    """

    def __init__(
        self, adapter: Adapter, config: SessionConfig | None = None, *, robots: Any = AUTO, drives: bool = True
    ) -> None:
        scene = SceneBuilder(adapter.name)
        try:
            adapter.build(scene)
        except SceneBuildError as error:
            raise ConfigError(f"this simulation cannot be shown: {error}") from None
        super().__init__(scene, config, robots=_choose_robots(adapter, robots))
        self._adapter = adapter
        self._drives = drives and adapter.drives
        self._unwrap: Any = None
        self._driven: tuple[str, ...] = ()  # by the newest step
        self._due_ns = 0
        self._fault = ""

    def _list_world_notes(self) -> Sequence[str]:
        return self._adapter.notes

    def start(self) -> None:
        """Start the session, publish the present state, and follow the simulation from here on.

        Raises:
            OwnershipError: A session follows this simulation already, or this one is closed.
            ConfigError, StartError, SimulatorError, PublishError: As of `ScenePublisher.start` and `sync`.
        """
        if self._processes is not None:
            return
        self._process = os.getpid()
        try:  # first: nothing is opened for a simulation that another session follows
            self._unwrap = self._adapter.wrap_step(self._before_step, self._after_step)
        except AlreadyWrappedError as error:
            raise OwnershipError(str(error)) from None
        try:
            super().start()
            self._require_started().reporter.warning_sources.append(self._list_faults)
            self.sync()
        except BaseException:
            self._end_steps()
            if self._loop is not None:
                self.close()
            raise

    def close(self) -> bool:
        """End the session; the step of the simulation is its own again. As `ScenePublisher.close`.

        Robots that participants drive stop where they are. In a process that was forked from that of the session it
        does nothing.
        """
        if self._is_forked:
            return True
        atexit.unregister(self.close)
        self._end_steps()
        return super().close()

    def _end_steps(self) -> None:
        if self._unwrap is not None:
            self._unwrap()
            self._unwrap = None
        self._drive(())

    def sync(self, *at: Any) -> None:
        """Publish the state of the simulation as it is now.

        Needed where the simulation has no step that is followed, and before a program that was stepping fast stops to
        wait: of steps that follow one another faster than the rate of the state not every one is read.

        Args:
            at: Of a USD stage, the time code of its animation; of Newton, the state.

        Raises:
            OwnershipError: The session is closed.
            SimulatorError: The simulation cannot be read.
            PublishError: Its state has numbers that are not finite.
        """
        self._publish_state(self._adapter.read_state(*at))

    def _publish_state(self, state: SimulationState) -> None:
        if len(self._adapter.bodies):
            self.set_poses(self._adapter.bodies, state.positions, state.quaternions)
        for name, vertices in state.vertices.items():
            self.set_vertices(name, vertices)
        self.publish(state.time_s)

    # --- the step of the simulation -----------------------------------------------------------------------------------

    def _before_step(self) -> None:
        if self._drives and self.robots and self._loop is not None:
            self._drive(() if self.stopping or self._loop.has_ended else self.driven_robots())

    def _drive(self, driven: tuple[str, ...]) -> None:
        """Move robots to their targets, and stop those that were driven until now."""
        left, self._driven = [name for name in self._driven if name not in driven], driven
        if not driven and not left:
            return
        try:
            poses, grippers = (self.targets(), self.grippers()) if driven else ({}, {})
            targets = {name: TipTarget(poses[name], grippers.get(name)) for name in driven}
            self._adapter.apply_targets((self._measure_tips(left) if left else {}) | targets)
        except Exception as error:  # of the simulator: its program goes on as without a session
            self._driven = (*driven, *left)  # the next step stops them
            self._note_fault(error)

    def _measure_tips(self, names: Sequence[str]) -> dict[str, TipTarget]:
        """Return targets at which robots stay where they are."""
        state, rows = self._adapter.read_state(), {name: row for row, name in enumerate(self._adapter.bodies)}
        at = {robot.name: rows[robot.tip_body] for robot in self.robots if robot.name in names}
        p, q = state.positions, state.quaternions
        return {
            name: TipTarget(Pose(tuple(p[row].tolist()), tuple(q[row].tolist())), stops=True)
            for name, row in at.items()
        }

    def _after_step(self) -> None:
        now_ns = self.clock()
        if now_ns < self._due_ns or self._is_closed or self._loop is None:
            return
        self._due_ns = max(self._due_ns + int(1e9 / self.config.state_hz), now_ns)
        try:
            self._publish_state(self._adapter.read_state())
            self._fault = ""
        except Exception as error:  # of the simulator: its program goes on as without a session
            self._note_fault(error)

    def _note_fault(self, error: Exception) -> None:
        reason = next(iter(str(error).splitlines()), "")
        text = f"the simulation is not followed: {type(error).__name__}: {reason}"
        if not self._fault:
            _log.warning("%s; share it again when it was built anew", text)
        self._fault = text

    def _list_faults(self) -> tuple[str, ...]:
        return (self._fault,) if self._fault else ()


def _choose_robots(adapter: Adapter, choice: Any) -> tuple[RobotSpec, ...]:
    """Return the robots of an adapter that are chosen by name."""
    if choice is None or choice == AUTO:
        return adapter.robots
    given = choice.split(",") if isinstance(choice, str) else choice
    names = [] if choice == NONE else [name.strip() if isinstance(name, str) else name for name in given]
    found = {robot.name: robot for robot in adapter.robots}
    for name in names:
        if not isinstance(name, str) or name not in found:
            known = ", ".join(found) or "none"
            raise ConfigError(f"robots: {name!r} is none of the robots of this simulation: {known}; or 'auto', 'none'")
    return tuple(found[name] for name in names)
