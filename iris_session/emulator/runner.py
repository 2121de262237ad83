"""Runs emulated people against a session: k headsets in one process and one polling loop.

    python -m iris_session.emulator --address 127.0.0.1:7721 \
        --headset name=ann,behaviour=giver,robot=left --headset name=bob,behaviour=receiver,robot=right
"""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from iris_session.client import ClientError, wait_any
from iris_session.emulator.operator import EmulatedOperator
from iris_session.emulator.specs import HeadsetReport, HeadsetSpec

REPORT_PERIOD_NS: Final = 1_000_000_000
JOIN_TIMEOUT_S: Final = 15.0

Report = Callable[[HeadsetReport], None]


def run_headsets(
    address: str,
    specs: Sequence[HeadsetSpec],
    seconds: float | None = None,
    report: Report | None = None,
    stop: Callable[[], bool] = lambda: False,
    join_timeout_s: float = JOIN_TIMEOUT_S,
    orders: Callable[[], Iterable[tuple[str, str]]] = tuple,
) -> list[HeadsetReport]:
    """Runs all `specs` until everyone with a task has finished, `seconds` have passed, or `stop()` is true.

    `report`: called with each person's report at every change of phase and once a second. `orders`: asked in every
    round for what is done to whom (of `Person.disturb`, name). Returns the final reports, in the order of `specs`.
    Raises nothing for a person who fails (whom no session let in within `join_timeout_s`, for example):
    `HeadsetReport.failed` says why.
    """
    start = time.monotonic_ns()
    end = None if seconds is None else start + int(seconds * 1e9)
    people = [EmulatedOperator(address, spec, start) for spec in specs]
    told: dict[str, tuple[str, int]] = {}
    ready = [person.client for person in people]
    try:
        while not stop():
            now = time.monotonic_ns()
            if (end is not None and now >= end) or _are_all_finished(people):
                _fail_late_joins(people, 0.0, now)
                break
            for person in people:
                _step_operator(person, person.client in ready)
            for kind, name in orders():
                for person in people:
                    if person.spec.name == name and person.client.ready:
                        person.disturb_tracking(kind, now)
            _fail_late_joins(people, join_timeout_s, now)
            for person in people:
                if report is not None:
                    _report_changes(person, told, report, now)
            wake = min(person.next_step_ns for person in people)
            if end is not None:
                wake = min(wake, end)
            ready = wait_any([person.client for person in people], max(0.0, (wake - time.monotonic_ns()) / 1e9))
        return [person.finish_report() for person in people]
    finally:
        for person in people:
            person.client.close()


def _step_operator(person: EmulatedOperator, ready: bool) -> None:
    try:
        if ready:
            person.client.poll(0.0)
    except ClientError as error:
        if not person.finished:
            person.fail(str(error), time.monotonic_ns())
        return
    person.step(time.monotonic_ns())
    mirror = person.client.mirror
    if person.report.phase == "acquire" and mirror.synced and not mirror.robots:
        person.fail("this session has no robots to drive: behaviour=observer looks only", time.monotonic_ns())


def _fail_late_joins(people: Sequence[EmulatedOperator], timeout_s: float, now_ns: int) -> None:
    for person in people:
        waited_s = (now_ns - person.started_ns) * 1e-9
        if person.report.phase == "join" and waited_s >= timeout_s:
            text = person.client.describe_failure(f"within {waited_s:.1f} s")
            person.fail(f"no session let us in at {text}", now_ns)


def _are_all_finished(people: Sequence[EmulatedOperator]) -> bool:
    """Everyone with a task has finished; observers have none, and only observers go on for ever."""
    working = [person for person in people if not person.observer]
    return all(person.finished for person in (working or people))


def _report_changes(person: EmulatedOperator, told: dict[str, tuple[str, int]], report: Report, now_ns: int) -> None:
    phase, at = told.get(person.spec.name, ("", 0))
    now_phase = next(reversed(person.report.phases), "join")
    if now_phase != phase or now_ns - at >= REPORT_PERIOD_NS:
        told[person.spec.name] = (now_phase, now_ns)
        report(person.finish_report())


#: What can be done to the tracking frame of a headset: `Person.disturb`.
KINDS: Final = ("bump", "drift", "recentre", "steady")
MAX_LINE: Final = 256  # bytes; a longer line is no order


class DisturbanceReader:
    """Calling it gives the orders that have come since, as (kind, name); it never waits. `names`: of the people."""

    def __init__(self, fd: int, names: Sequence[str]) -> None:
        self._fd = fd
        self._ready = select.poll()  # takes files as well as pipes, and descriptors above 1023
        self._ready.register(fd, select.POLLIN)
        self._names = tuple(names)
        self._rest = b""
        self._open = True

    def __call__(self) -> list[tuple[str, str]]:
        while self._open and self._ready.poll(0):
            data = os.read(self._fd, 4096)
            self._open = bool(data)
            self._rest += data
            if self._open and b"\n" not in data and len(self._rest) > MAX_LINE:
                self._rest = self._rest[-MAX_LINE:]
        *lines, self._rest = self._rest.split(b"\n")
        return [order for line in lines if line.strip() for order in self._parse_line(line)]

    def _parse_line(self, line: bytes) -> list[tuple[str, str]]:
        """One order, or a word on standard error about what is none."""
        kind, _, name = line[:MAX_LINE].decode(errors="replace").strip().partition(" ")
        if kind in KINDS and name in self._names:
            return [(kind, name)]
        known = f"{', '.join(KINDS[:-1])} or {KINDS[-1]}, then one of {', '.join(self._names)}"
        print(f"no order: {kind} {name}".rstrip() + f"; it is {known}", file=sys.stderr, flush=True)
        return []
