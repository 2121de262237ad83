"""Runs emulated people against a session: k headsets in one process and one polling loop.

    python -m iris_session.emulator --address 127.0.0.1:7721 \
        --headset name=ann,behaviour=giver,robot=left --headset name=bob,behaviour=receiver,robot=right
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from iris_session.client import ClientError, wait_any
from iris_session.emulator.person import Person
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
    people = [Person(address, spec, start) for spec in specs]
    told: dict[str, tuple[str, int]] = {}
    ready = [person.client for person in people]
    try:
        while not stop():
            now = time.monotonic_ns()
            if (end is not None and now >= end) or _all_finished(people):
                _give_up_joining(people, 0.0, now)
                break
            for person in people:
                _drive(person, person.client in ready)
            for kind, name in orders():
                for person in people:
                    if person.spec.name == name and person.client.ready:
                        person.disturb(kind, now)
            _give_up_joining(people, join_timeout_s, now)
            for person in people:
                if report is not None:
                    _tell(person, told, report, now)
            wake = min(person.next_ns for person in people)
            if end is not None:
                wake = min(wake, end)
            ready = wait_any([person.client for person in people], max(0.0, (wake - time.monotonic_ns()) / 1e9))
        return [person.finish_report() for person in people]
    finally:
        for person in people:
            person.client.close()


def _drive(person: Person, ready: bool) -> None:
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


def _give_up_joining(people: Sequence[Person], timeout_s: float, now_ns: int) -> None:
    for person in people:
        waited_s = (now_ns - person.started_ns) * 1e-9
        if person.report.phase == "join" and waited_s >= timeout_s:
            text = person.client.describe_failure(f"within {waited_s:.1f} s")
            person.fail(f"no session let us in at {text}", now_ns)


def _all_finished(people: Sequence[Person]) -> bool:
    """Everyone with a task has finished; observers have none, and only observers go on for ever."""
    working = [person for person in people if not person.observer]
    return all(person.finished for person in (working or people))


def _tell(person: Person, told: dict[str, tuple[str, int]], report: Report, now_ns: int) -> None:
    phase, at = told.get(person.spec.name, ("", 0))
    now_phase = next(reversed(person.report.phases), "join")
    if now_phase != phase or now_ns - at >= REPORT_PERIOD_NS:
        told[person.spec.name] = (now_phase, now_ns)
        report(person.finish_report())
