"""`bench share`: what a session with an observer and a recording costs the program that it shares, while no participant
drives.

A program of 30 bodies steps alone and shared in turn, as environments with few and many `mj_step` in their step, in
real time and as fast as they can. `added`: median of the shared steps less that of the steps alone, in the same round.
"""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from iris_session.bench.harness import make_session_config
from iris_session.bench.plugins import POLL_S, Plugin, PluginProcess
from iris_session.bench.report import BenchReport, make_bar
from iris_session.client import Client
from iris_session.demo.scenes import free_bodies_scene
from iris_session.session.share import share

BODIES: Final = 30
#: Steps of MuJoCo in one step of the environment; 20 are 25 Hz at 2 ms, as in Gymnasium-Robotics and robosuite.
SUBSTEPS: Final = (1, 5, 20, 50)
ROUNDS: Final = 3


class Observer(Plugin):
    """A client that watches."""

    def __init__(self, address: str) -> None:
        self._client = Client(address, role="observer", name="observer")
        self._client.start()

    def poll(self) -> None:
        """Receive."""
        self._client.sleep(POLL_S)

    def close(self) -> None:
        """Leave."""
        self._client.close()


class SharedProgram:
    """An environment of `substeps` steps of MuJoCo."""

    def __init__(self, substeps: int) -> None:
        self.substeps = substeps
        self.model = free_bodies_scene(BODIES).compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)

    def step(self) -> None:
        """Advance."""
        for _ in range(self.substeps):
            mujoco.mj_step(self.model, self.data)


def measure_steps(environment: SharedProgram, seconds: float, *, paced: bool) -> list[float]:
    """Return how long each step took [ms] in `seconds`, `paced`: begun at the times of the simulation."""
    took = []
    period_s = environment.substeps * float(environment.model.opt.timestep)
    begun = time.perf_counter()
    while (now := time.perf_counter()) < begun + seconds:
        environment.step()
        took.append(1e3 * (time.perf_counter() - now))
        if paced:
            time.sleep(max(0.0, begun + len(took) * period_s - time.perf_counter()))
    return took


def run_share(seconds: float = 100.0, progress: Callable[[str], None] = lambda _: None) -> BenchReport:
    """Measure what sharing adds to a step."""
    slot_s = seconds / (ROUNDS * len(SUBSTEPS) * 4)
    added, alone, added_p99 = defaultdict(list), defaultdict(list), defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        for index in range(ROUNDS):
            for substeps in SUBSTEPS:
                progress(f"round {index + 1} of {ROUNDS}, {substeps} steps of MuJoCo in one of the environment")
                config = make_session_config(record=Path(folder) / f"{index}-{substeps}.rrd")
                environment = SharedProgram(substeps)
                before = {paced: measure_steps(environment, slot_s, paced=paced) for paced in (True, False)}
                with share(environment, config=config) as session:
                    environment.step()
                    with PluginProcess("iris_session.bench.share:Observer", session.address) as observer:
                        while not observer.has_answered():
                            environment.step()
                        for paced in (True, False):
                            shared = measure_steps(environment, slot_s, paced=paced)
                            key = f"{substeps}_{'paced' if paced else 'unpaced'}"
                            median, p99 = np.percentile(shared, (50, 99)) - np.percentile(before[paced], (50, 99))
                            added[key].append(median)
                            added_p99[key].append(p99)
                            alone[key].append(np.median(before[paced]))
    typical = {key: round(float(np.median(values)), 4) for key, values in added.items()}
    results: dict[str, Any] = {
        "mj_step_added_ms_p50": max(value for key, value in typical.items() if key.startswith("1_")),
        "env_step_added_ms_p50": max(typical.values()),
        "added_ms_p50": typical,
        "added_ms_p99_worst": {key: round(max(0.0, *map(float, values)), 3) for key, values in added_p99.items()},
        "alone_ms_p50": {key: round(float(np.median(values)), 4) for key, values in alone.items()},
    }
    bars = (
        make_bar(results, "mj_step_added_ms_p50", "<=", 0.1),
        make_bar(results, "env_step_added_ms_p50", "<=", 0.5),
    )
    return BenchReport(results, bars, params={"bodies": BODIES})
