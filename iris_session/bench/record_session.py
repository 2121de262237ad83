"""Scene of `bench record`, and a session of it in a process of its own, which the benchmark kills."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import msgspec

from iris_session.bench.harness import make_session_config
from iris_session.bench.plugins import Plugin
from iris_session.demo.scenes import free_bodies_scene
from iris_session.demo.scenes.generators import (
    ARM_FILE,
    ARM_HOME,
    FINGER_OPEN,
    arm_names,
    compute_bearing,
    compute_circle_radius,
    place_arm,
)
from iris_session.session.session import Session

#: Moving bodies: those that fly, and ten of each of the two arms.
BODIES: Final = 50
OPERATORS: Final = 2
POLL_NS: Final = 20_000_000
#: How long the session runs between two looks for a call [s].
RUN_S: Final = 0.1
#: Age of the newest row at its write [ns] from which on a recorder has caught up.
CURRENT_NS: Final = 250_000_000
_FREE: Final = BODIES - 10 * OPERATORS


class SessionJob(msgspec.Struct, frozen=True):
    """Job of the process. `path`: first file of the recording."""

    path: str
    seed: int


def make_record_scene(seed: int) -> Any:
    """Return an `mujoco.MjSpec` with two arms and as many flying bodies as make `BODIES` that move."""
    import mujoco

    spec = free_bodies_scene(_FREE, seed)
    home = spec.key("home")
    qpos, qvel = list(home.qpos), list(home.qvel)
    spec.delete(home)
    for i, name in enumerate(arm_names(OPERATORS)):
        arm = mujoco.MjSpec.from_file(str(ARM_FILE))
        frame = place_arm(spec, compute_circle_radius(OPERATORS), compute_bearing(i, OPERATORS))
        frame.attach_body(arm.body("base"), f"{name}/", "")
        qpos += [*ARM_HOME, FINGER_OPEN, FINGER_OPEN]
        qvel += [0.0] * (len(ARM_HOME) + 2)
    spec.add_key(name="home", qpos=qpos, qvel=qvel, ctrl=[*ARM_HOME, FINGER_OPEN] * OPERATORS)
    return spec


class RecordedSession(Plugin):
    """Plug-in that runs a recorded session of the scene."""

    job_type = SessionJob

    def __init__(self, job: SessionJob) -> None:
        super().__init__(job)
        model = make_record_scene(job.seed).compile()
        self._session = Session(model, config=make_session_config(record=Path(job.path)))
        self._session.start()
        self._known = 0

    def poll(self) -> None:
        """Run the session for a moment."""
        self._session.run(seconds=RUN_S)

    def describe(self) -> tuple[str, int]:
        """Return the address of the session, and its origin: session time zero on CLOCK_MONOTONIC [ns]."""
        return self._session.address, self._session.origin_ns

    def wait_until_written(self, timeout_s: float) -> bool:
        """Run until a recorder that is new has written the rows that waited for it; return whether it has."""
        due_ns = 0

        def is_written() -> bool:
            nonlocal due_ns
            feed, now_ns = self._session.processes.feed, self._session.clock()
            if now_ns < due_ns or feed is None:
                return False
            due_ns = now_ns + POLL_NS
            last = feed.stats.recorder
            if last is None or last.instance == self._known or last.written < 0 or not 0 < last.lag_ns < CURRENT_NS:
                return False
            self._known = last.instance
            return True

        before = self._known
        self._session.run(seconds=timeout_s, until=is_written)
        return self._known != before

    def close(self) -> None:
        """Close the session."""
        self._session.close()
