"""Scene of `bench record`, and a session of it in a process of its own, which the benchmark kills.

    python -m iris_session.bench.record_session

Reads its job from standard input, prints one JSON line when it listens, then `written` whenever a new recorder has
written the rows that waited for it, and runs until SIGTERM or the end of its parent.
"""

from __future__ import annotations

import signal
import sys
from io import RawIOBase
from pathlib import Path
from typing import Any, Final

import msgspec

from iris_session.bench.harness import make_session_config
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
from iris_session.system.process import die_with_parent, take_stdout

#: Moving bodies: those that fly, and ten of each of the two arms.
BODIES: Final = 50
OPERATORS: Final = 2
POLL_NS: Final = 20_000_000
#: Age of the newest row at its write [ns] from which on a recorder has caught up.
CURRENT_NS: Final = 250_000_000
_FREE: Final = BODIES - 10 * OPERATORS


class SessionJob(msgspec.Struct, frozen=True):
    """Job of the process. `path`: first file of the recording."""

    path: str
    seed: int


class BenchSession(msgspec.Struct, frozen=True):
    """A session that listens. `origin_ns`: session time zero on CLOCK_MONOTONIC."""

    address: str
    origin_ns: int


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


class _Reporter:
    """Says when a recorder has caught up."""

    def __init__(self, session: Session, out: RawIOBase) -> None:
        self._session, self._out = session, out
        self._due_ns = 0
        self._known = 0

    def poll(self) -> bool:
        """Report a recorder that is new, now and then. Return False, for `Session.run(until=...)`."""
        feed, now_ns = self._session.processes.feed, self._session.clock()
        if now_ns < self._due_ns or feed is None:
            return False
        self._due_ns = now_ns + POLL_NS
        last = feed.stats.recorder
        if last is not None and last.instance != self._known and last.written >= 0 and 0 < last.lag_ns < CURRENT_NS:
            self._known = last.instance
            self._out.write(b"written\n")
        return False


def main() -> None:
    """Run the session."""
    die_with_parent(signal.SIGTERM)
    with open(take_stdout(), "wb", buffering=0) as out:
        job = msgspec.json.decode(sys.stdin.readline(), type=SessionJob)
        with Session(
            make_record_scene(job.seed).compile(), config=make_session_config(record=Path(job.path))
        ) as session:
            out.write(msgspec.json.encode(BenchSession(session.address, session.origin_ns)) + b"\n")
            session.run(until=_Reporter(session, out).poll)


if __name__ == "__main__":
    main()
