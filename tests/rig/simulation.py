"""The clock of the rig: events in order of time, and the modules that read it instead of those of the system."""

from __future__ import annotations

import heapq
import itertools
import random
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, Final

import pytest

SECOND: Final = 1_000_000_000
#: The monotonic clock of the machine at the start: no session begins at zero.
START_NS: Final = 1_000 * SECOND


class Simulation:
    """Events in order of time. `now_ns` is what every clock of the package shows [ns]."""

    def __init__(self, seed: int) -> None:
        self.now_ns = START_NS
        self.seed = seed
        self.random = random.Random(seed)
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._is_running = False

    def call_at(self, at_ns: int, event: Callable[[], None]) -> None:
        """Call `event` at a time; events of one time run in the order of these calls."""
        heapq.heappush(self._events, (max(at_ns, self.now_ns), next(self._order), event))

    def run(self, until_ns: int, condition: Callable[[], object] = lambda: False) -> bool:
        """Run events until `until_ns`, or until `condition` holds after one of them. Return whether it holds."""
        assert not self._is_running, "an event must not wait: it would run the events after it"
        self._is_running = True
        try:
            while self._events and self._events[0][0] <= until_ns:
                self.now_ns, _, event = heapq.heappop(self._events)
                event()
                if condition():
                    return True
            self.now_ns = max(self.now_ns, until_ns)
        finally:
            self._is_running = False
        return bool(condition())

    def sleep(self, seconds: float) -> None:
        """Sleep as a program does: what is due meanwhile happens. An event that sleeps does so in no time."""
        if not self._is_running:
            self.run(self.now_ns + round(seconds * SECOND))


class SimulatedTime:
    """In place of the module `time`."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._asked_ns = self._asked = 0
        self.sleep = simulation.sleep

    def monotonic_ns(self) -> int:
        return self._simulation.now_ns

    def monotonic(self) -> float:
        # A nanosecond later at every call: a loop that waits for less than one would never end.
        now_ns = self._simulation.now_ns
        self._asked = self._asked + 1 if now_ns == self._asked_ns else 0
        self._asked_ns = now_ns
        return (now_ns + self._asked) / SECOND

    perf_counter_ns, perf_counter = monotonic_ns, monotonic

    def __getattr__(self, name: str) -> Any:
        return getattr(time, name)


class SimulatedSecrets:
    """In place of the module `secrets`: the same in every run."""

    def __init__(self, simulation: Simulation) -> None:
        self._random = simulation.random

    def token_bytes(self, n: int = 32) -> bytes:
        return self._random.randbytes(n)

    def token_hex(self, n: int = 32) -> str:
        return self._random.randbytes(n).hex()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._random, name)


class SimulatedThreading:
    """In place of the module `threading`: a thread does its work at once; the helpers of loops are events."""

    def __init__(self, simulation: Simulation) -> None:
        simulation_ = simulation

        class Thread:
            """Periodic work of the helper of a user loop, or one piece of work, done by `start`."""

            def __init__(self, target: Callable[..., None], name: str = "", **_: Any) -> None:
                self._target = target
                self.name = name

            def start(self) -> None:
                owner = getattr(self._target, "__self__", None)
                if getattr(self._target, "__name__", "") != "_run_helper":
                    self._target()
                    return
                step = getattr(owner, "_take_helper_step", None) or owner.poll  # type: ignore[union-attr]
                if hasattr(owner, "_wake_helper"):
                    owner._wake_helper = step

                def poll() -> None:
                    if owner._closed.is_set():  # type: ignore[union-attr]
                        return
                    try:
                        step()
                    except BaseException as error:
                        if not hasattr(owner, "_fail"):
                            raise
                        owner._fail(error)
                        return
                    simulation_.call_at(simulation_.now_ns + 10_000_000, poll)

                simulation_.call_at(simulation_.now_ns + 10_000_000, poll)

            def join(self, timeout: float | None = None) -> None:
                """Return: the work is done."""

            def is_alive(self) -> bool:
                return False

        class Event(threading.Event):
            """Waits in simulated time."""

            def wait(self, timeout: float | None = None) -> bool:
                if not self.is_set() and timeout is not None:
                    simulation_.sleep(timeout)
                return super().wait(0.0 if timeout is not None else None)

        self.Thread, self.Event = Thread, Event

    def __getattr__(self, name: str) -> Any:
        return getattr(threading, name)


def simulate_modules(simulation: Simulation, patch: pytest.MonkeyPatch) -> None:
    """Give every module of the package that is loaded the simulated `time`, `secrets` and `threading`."""
    stand_ins = {
        "time": (time, SimulatedTime(simulation)),
        "secrets": (sys.modules["secrets"], SimulatedSecrets(simulation)),
        "threading": (threading, SimulatedThreading(simulation)),
    }
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in ("iris_session", "anchors"):
            for attribute, (real, simulated) in stand_ins.items():
                if getattr(module, attribute, None) is real:
                    patch.setattr(module, attribute, simulated)
