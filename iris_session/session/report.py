"""The authority's half of a `StatusReport`: ticks, roster, robots, recorder, machine. The front adds what it sees.

Built about once a second between two ticks, when there is time to spare; it reads counters and asks no disk, because a
disk that hangs must not stop physics. What the recorder's disk has left is said by the recorder.
"""

from __future__ import annotations

import os
import resource
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from iris_session.physics import Pacer
from iris_session.protocol.common import MAX_TEXT, Pose
from iris_session.protocol.status import AnchorReport, RecorderReport, RobotReport, StatusReport
from iris_session.session.tick_times import TickTimes

if TYPE_CHECKING:
    from iris_session.session.processes import SessionProcesses
    from iris_session.session.stepper import Stepper

PERIOD_NS: Final = 1_000_000_000
#: A loop that is behind gets this long to catch up before a report is built all the same.
PATIENCE_NS: Final = 1_000_000_000
PAGE_BYTES: Final = resource.getpagesize()


class Reporter:
    """One per session. The pacing loop, if it is ours, sets `pacer`, `times` and `scheduling`."""

    def __init__(self) -> None:
        self.pacer: Pacer | None = None
        self.times: TickTimes | None = None
        self.scheduling = ""
        #: What else somebody should know now, though nothing has failed: asked for every report.
        self.notices: list[Callable[[], Sequence[str]]] = []
        self._next_ns = 0
        self._cpu_ns = time.process_time_ns()
        self._cpu_at_ns = time.monotonic_ns()

    def due(self, now_ns: int) -> bool:
        """Whether a report is to be built now."""
        if now_ns < self._next_ns:
            return False
        pacer = self.pacer
        late = pacer is not None and not pacer.paused and pacer.next_deadline_ns <= now_ns
        if late and now_ns < self._next_ns + PATIENCE_NS:
            return False
        self._next_ns = now_ns + PERIOD_NS
        return True

    def report(self, stepper: Stepper, processes: SessionProcesses) -> StatusReport:
        """The session now. Fields of the front are left at their defaults."""
        now_ns = stepper.clock()
        pacer, times = self.pacer, self.times
        stats = None if pacer is None else pacer.stats(now_ns)
        if times is not None and stats is not None:
            times.mark(stats)
        last, core = stepper.last, stepper.core
        recorder = recorder_report(processes)
        return StatusReport(
            0,
            "",
            "",
            now_ns,
            tick=core.world.view().tick,
            tick_period_ns=core.world.tick_period_ns,
            paused=stepper.paused,
            estop=last is not None and last.decision.estop,
            scheduling=self.scheduling,
            late_share=0.0 if times is None else times.late_share(),
            late_share_total=0.0 if stats is None else stats.late_share,
            lateness=None if times is None else times.lateness(),
            late_causes={} if times is None else times.late_causes(),
            cpu_share=self._cpu_share(),
            load=os.getloadavg()[0],
            cpus=os.cpu_count() or 1,
            memory_bytes=memory_bytes(),
            participants=stepper.ledger.participant_reports(now_ns, core.authority.build_alignment_reports()),
            robots=robots(stepper),
            recorder=recorder,
            drops=processes.own_drops(),
            restarts=processes.restarts(),
            warnings=tuple(warnings(stepper, recorder, self.scheduling, self._noticed())),
            anchors=anchors(core.authority.anchors, processes.sheet_sizes),
            cross_checks=core.authority.build_cross_check_reports(),
        )

    def _noticed(self) -> list[str]:
        return [text for ask in self.notices for text in ask()]

    def _cpu_share(self) -> float:
        """Processor time of this process since the last report, 1 for a whole processor."""
        cpu_ns, at_ns = time.process_time_ns(), time.monotonic_ns()
        share = (cpu_ns - self._cpu_ns) / max(1, at_ns - self._cpu_at_ns)
        self._cpu_ns, self._cpu_at_ns = cpu_ns, at_ns
        return share


def anchors(poses: Mapping[str, Pose], sizes: Mapping[str, float]) -> tuple[AnchorReport, ...]:
    """Where every anchor is now; `sizes`: edges of the printed sheets [m], where known."""
    return tuple(AnchorReport(name, T, sizes.get(name, 0.0)) for name, T in poses.items())


def robots(stepper: Stepper) -> tuple[RobotReport, ...]:
    """Who has each robot, what it does, and how long its samples waited for their step."""
    ledger = stepper.ledger
    names = ledger.names()
    commands = {c.robot: c for c in stepper.last.decision.commands} if stepper.last is not None else {}
    rows = []
    for spec in stepper.core.scene.robots:
        lease, command = ledger.mirror.leases.get(spec.name), commands.get(spec.name)
        holder = "" if lease is None else lease.holder
        rows.append(
            RobotReport(
                spec.name,
                stepper.core.config.authority.default_mode or spec.mode if lease is None else lease.mode,
                holder,
                names.get(holder, ""),
                "" if command is None else command.kind,
                "" if command is None else command.hold_reason,
                ledger.receive_to_step(spec.name),
                () if lease is None else lease.queue,
            )
        )
    return tuple(rows)


def recorder_report(processes: SessionProcesses) -> RecorderReport:
    """How the recording does, by what its process said last."""
    feed, process, seen = processes.feed, processes.recorder, processes.supervisor
    if feed is None or process is None or seen is None:
        return RecorderReport()
    stats = feed.stats
    said = stats.recorder
    fault = seen.failure or ("" if said is None else said.fault)
    state = "running"
    if fault:
        state = "failed"
    elif not seen.alive:
        state = "dead"
    elif seen.hangs:
        state = "hangs"
    fault = fault or stats.spill_fault
    return RecorderReport(
        state,
        process.path[-MAX_TEXT:],
        0 if said is None else said.bytes,
        0 if said is None else said.disk_free,
        stats.dropped_rows,
        stats.spilled_bytes,
        fault[:MAX_TEXT],
    )


def warnings(stepper: Stepper, recorder: RecorderReport, scheduling: str, notices: Sequence[str] = ()) -> list[str]:
    """What somebody should know though nothing has failed yet."""
    found = list(notices)
    if stepper.last is not None and stepper.last.diverged:
        found.append(f"physics stands still until a reset: {stepper.last.diverged}"[:MAX_TEXT])
    if scheduling == "normal":
        found.append("the tick loop runs without real-time priority: other programs can make its ticks late")
    if recorder.lost_rows:
        found.append(f"{recorder.lost_rows} rows of the recording are lost: {recorder.text or 'no room for them'}")
    return [text[:MAX_TEXT] for text in found]


def memory_bytes() -> int:
    """Resident memory of this process; where the system does not tell, the most it ever had."""
    try:
        with open("/proc/self/statm", "rb") as file:
            return int(file.read().split()[1]) * PAGE_BYTES
    except (OSError, ValueError, IndexError):
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most if sys.platform == "darwin" else most * 1024
