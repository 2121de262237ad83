"""Operators of `tools/soak.py`: emulated headsets in one process, each of which logs every event it receives.

    python tools/soak_worker.py < job.json        {"address": ..., "specs": [HeadsetSpec, ...], "log": "folder/worker3"}

One log per operator: `<log>-<name>.events`, records of (connection generation, notifications of missed events so far,
event_seq, CRC-32 of the event), and one `<log>-<name>.json` with the operator's report, written every second. Ends at
SIGTERM.
"""

from __future__ import annotations

import os
import signal
import struct
import sys
import time
import zlib
from typing import Final

import msgspec

from iris_session.client import RefusedError, wait_any
from iris_session.emulator.operator import EmulatedOperator
from iris_session.emulator.specs import HeadsetSpec
from iris_session.protocol.server_messages import Event

RECORD: Final = struct.Struct("<IIQI")
REPORT_NS: Final = 1_000_000_000


class Job(msgspec.Struct, frozen=True):
    address: str
    specs: tuple[HeadsetSpec, ...]
    log: str


def fingerprint(event: Event) -> int:
    """Return the CRC-32 of an encoded event: equal for all clients that received the same event."""
    return zlib.crc32(msgspec.msgpack.encode(event))


class Witness:
    """One person whose events go to a file as they come."""

    def __init__(self, job: Job, spec: HeadsetSpec, start_ns: int) -> None:
        self.person = EmulatedOperator(job.address, spec, start_ns)
        self._prefix = f"{job.log}-{spec.name}"
        self._file = os.open(f"{self._prefix}.events", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        self._next_report_ns = 0
        self._pass_on = self.person.client.on_event
        self.person.client.on_event = self._note
        self._missed = 0
        self.person.client.on_missed = self._miss

    def step(self, ready: bool) -> None:
        """Run one iteration of the loop."""
        now_ns = time.monotonic_ns()
        if ready:
            try:
                self.person.client.poll(0.0)
            except RefusedError as error:
                if not self.person.finished:
                    self.person.fail(str(error), now_ns)
                return
        self.person.step(time.monotonic_ns())
        if now_ns >= self._next_report_ns:
            self._next_report_ns = now_ns + REPORT_NS
            self.report()

    def report(self) -> None:
        """Write the report to a file, replaced atomically."""
        path = f"{self._prefix}.json"
        with open(f"{path}.new", "wb") as file:
            file.write(msgspec.json.encode(self.person.finish_report()))
        os.replace(f"{path}.new", path)

    def _miss(self, _first: int, _last: int) -> None:
        self._missed += 1

    def _note(self, event: Event) -> None:
        connection = self.person.client.connection
        record = RECORD.pack(connection.generation, self._missed, event.event_seq, fingerprint(event))
        os.write(self._file, record)
        if self._pass_on is not None:
            self._pass_on(event)


def main() -> int:
    job = msgspec.json.decode(sys.stdin.buffer.read(), type=Job)
    stopped: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _frame: stopped.append(number))
    start_ns = time.monotonic_ns()
    witnesses = [Witness(job, spec, start_ns) for spec in job.specs]
    clients = [witness.person.client for witness in witnesses]
    ready = list(clients)
    while not stopped:
        for witness in witnesses:
            witness.step(witness.person.client in ready)
        wake_ns = min(witness.person.next_step_ns for witness in witnesses)
        ready = wait_any(clients, max(0.0, (wake_ns - time.monotonic_ns()) * 1e-9))
    for witness in witnesses:
        witness.report()
        witness.person.client.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
