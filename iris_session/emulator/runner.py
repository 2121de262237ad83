"""Run emulated headsets against a session: many in one process and one polling loop.

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
    join_code: str = "",
) -> list[HeadsetReport]:
    """Run all `specs` until every task has finished, `seconds` have passed, or `stop()` is true.

    `address`: as for `Client`. `join_code`: used when the session refuses this user's key as not paired. `report`:
    called with each headset's report at every change of phase and once a second. `orders`: polled for disturbances
    (kind for `EmulatedOperator.disturb_tracking`, name). Returns the final reports, in the order of `specs`.
    A headset that fails (for example cannot join within `join_timeout_s`, or has no session at the end) raises nothing:
    `HeadsetReport.failed` gives the reason.
    """
    start = time.monotonic_ns()
    end = None if seconds is None else start + int(seconds * 1e9)
    operators = [EmulatedOperator(address, spec, start, join_code) for spec in specs]
    reported: dict[str, tuple[str, int]] = {}
    ready = [operator.client for operator in operators]
    try:
        while not stop():
            now = time.monotonic_ns()
            if (end is not None and now >= end) or _are_all_finished(operators):
                _fail_late_joins(operators, 0.0, now)
                break
            for operator in operators:
                _step_operator(operator, operator.client in ready)
            for kind, name in orders():
                for operator in operators:
                    if operator.spec.name == name and operator.client.ready:
                        operator.disturb_tracking(kind, now)
            _fail_late_joins(operators, join_timeout_s, now)
            for operator in operators:
                if report is not None:
                    _report_changes(operator, reported, report, now)
            wake = min(operator.next_step_ns for operator in operators)
            if end is not None:
                wake = min(wake, end)
            ready = wait_any([operator.client for operator in operators], max(0.0, (wake - time.monotonic_ns()) / 1e9))
        for operator in operators:
            operator.check_session(time.monotonic_ns())
        return [operator.finish_report() for operator in operators]
    finally:
        for operator in operators:
            operator.client.close()


def _step_operator(operator: EmulatedOperator, ready: bool) -> None:
    try:
        if ready:
            operator.client.poll(0.0)
    except ClientError as error:
        if not operator.finished:
            operator.fail(str(error), time.monotonic_ns())
        return
    operator.step(time.monotonic_ns())
    mirror = operator.client.mirror
    if operator.report.phase == "acquire" and mirror.synced and not mirror.robots:
        operator.fail("this session has no robots to drive: use behaviour=observer", time.monotonic_ns())


def _fail_late_joins(operators: Sequence[EmulatedOperator], timeout_s: float, now_ns: int) -> None:
    for operator in operators:
        waited_s = (now_ns - operator.started_ns) * 1e-9
        if operator.report.phase == "join" and waited_s >= timeout_s:
            text = operator.client.describe_failure(f"within {waited_s:.1f} s")
            operator.fail(f"no session let us in at {text}", now_ns)


def _are_all_finished(operators: Sequence[EmulatedOperator]) -> bool:
    """Return True when every task has finished, and no one stays. Observers have none; only observers run for ever."""
    working = [operator for operator in operators if not operator.observer]
    return all(operator.finished and not operator.spec.stays for operator in (working or operators))


def _report_changes(
    operator: EmulatedOperator, reported: dict[str, tuple[str, int]], report: Report, now_ns: int
) -> None:
    phase, at = reported.get(operator.spec.name, ("", 0))
    now_phase = next(reversed(operator.report.phases), "join")
    if now_phase != phase or now_ns - at >= REPORT_PERIOD_NS:
        reported[operator.spec.name] = (now_phase, now_ns)
        report(operator.finish_report())


#: Disturbances of a tracking frame: see `EmulatedOperator.disturb_tracking`.
KINDS: Final = ("bump", "drift", "recentre", "steady")
MAX_LINE: Final = 256  # bytes; a longer line is rejected


class DisturbanceReader:
    """Reads lines `KIND NAME` from a file descriptor. A call returns the new ones as (kind, name) and never waits."""

    def __init__(self, fd: int, names: Sequence[str]) -> None:
        self._fd = fd
        self._ready = select.poll()  # works with files and pipes, and with descriptors above 1023
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
        """Parse one line. An invalid one is reported on standard error."""
        kind, _, name = line[:MAX_LINE].decode(errors="replace").strip().partition(" ")
        if kind in KINDS and name in self._names:
            return [(kind, name)]
        known = f"{', '.join(KINDS[:-1])} or {KINDS[-1]}, then one of {', '.join(self._names)}"
        print(f"invalid order: {kind} {name}".rstrip() + f"; expected {known}", file=sys.stderr, flush=True)
        return []
