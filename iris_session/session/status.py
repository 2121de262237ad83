"""Status of a session: `SessionStatus` for its owner, and the authority's half of a `StatusReport` for clients.

Rows of participants, robots and the recorder are the protocol's reports in both. A `StatusReport` is built about once a
second between two ticks, when there is time to spare; the front adds what it sees. Everything reads counters and asks
no disk, because a disk that hangs must not stop physics: the recorder reports the free space of its disk.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import msgspec
import psutil

from iris_session.physics import Pacer
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.status import (
    AnchorReport,
    ParticipantReport,
    RecorderReport,
    RobotReport,
    StatusReport,
    StopReport,
)
from iris_session.recording import RecorderFeed, RecorderProcess
from iris_session.session.session_view import HandoverStatus
from iris_session.session.stepper import Stepper
from iris_session.session.tick_times import TickTimes

PERIOD_NS: Final = 1_000_000_000
#: A loop that is behind gets this long to catch up before a report is built all the same.
PATIENCE_NS: Final = 1_000_000_000
#: Why a recording that goes on has no picture.
NO_PICTURE: Final = "the picture is not recorded: an error in drawing has ended the recorder before"


class DataFault(msgspec.Struct, frozen=True):
    """Numbers in the owner's `MjData` that are not finite. While they last the session takes no tick.

    Attributes:
        arrays: Names of the arrays of the data that hold them.
        since_s: Session time at which they were first seen [s].
    """

    arrays: tuple[str, ...]
    since_s: float

    @property
    def text(self) -> str:
        """One line for people."""
        return f"data.{', data.'.join(self.arrays)}: numbers that are not finite; robots hold until the next reset"


class SessionStatus(msgspec.Struct, frozen=True):
    """State of a session for its owner, from `Session.status()`.

    Attributes:
        session_time_s: Session time [s].
        tick: Ticks of physics since the scene began.
        sim_time: Time of the simulation or of the published world [s].
        paused: Physics is paused by a director or the owner.
        estop: The e-stop is latched.
        participants: One row each, as in a `StatusReport`; fields that only the front knows have their defaults.
            `alignment_error_m` [m, 95 %] means something only where `alignment` is `measured`.
        handovers: The newest handovers, at most 1000; the recording has all.
        lateness: Of the ticks of `run()`: `ticks`, `late`, `late_share`, `p50_ms`, `p99_ms`, `max_ms`. Empty in a loop
            of the owner's.
        input_to_ctrl_ms: By robot, from the capture of the newest applied sample to the step that applied it [ms].
        drops: By reason, everything that was not delivered.
        restarts: Of `front` and `recorder`.
        scheduling: `realtime` or `normal`.
        data_fault: What is not finite in the data of a user loop now; `None` while all is well.
        stops: The e-stops in force, newest first, the newest of each participant.
        pause_reason: Why physics stands still until a reset (`reset()` or `resume()`), empty otherwise.
    """

    session_time_s: float = 0.0
    tick: int = 0
    sim_time: float = 0.0
    paused: bool = False
    estop: bool = False
    participants: tuple[ParticipantReport, ...] = ()
    handovers: tuple[HandoverStatus, ...] = ()
    lateness: dict[str, float] = {}
    input_to_ctrl_ms: dict[str, float] = {}
    drops: dict[str, int] = {}
    restarts: dict[str, int] = {}
    scheduling: str = "normal"
    data_fault: DataFault | None = None
    stops: tuple[StopReport, ...] = ()
    pause_reason: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the status as plain values for JSON."""
        return dict(msgspec.to_builtins(self))


def list_shared_fields(stepper: Stepper, now_ns: int) -> dict[str, Any]:
    """Return the fields that a `SessionStatus` and a `StatusReport` share, from the session itself."""
    core, last = stepper.core, stepper.last
    return {
        "tick": core.world.view().tick,
        "paused": stepper.paused,
        "estop": last is not None and last.decision.estop,
        "participants": stepper.view.make_participant_reports(now_ns, core.authority.build_alignment_reports()),
        "stops": core.authority.build_stop_reports(),
        "pause_reason": core.authority.pause_reason,
    }


def make_session_status(stepper: Stepper, pacer: Pacer | None, **given: Any) -> SessionStatus:
    """Return the status of a session that has taken a step; `given`: fields that the stepper does not know."""
    now_ns, lateness = stepper.clock(), {}
    if pacer is not None:
        stats = pacer.get_stats(now_ns)
        lateness = {
            "ticks": stats.ticks,
            "late": stats.late,
            "late_share": stats.late_share,
            "p50_ms": stats.p50_ns * 1e-6,
            "p99_ms": stats.p99_ns * 1e-6,
            "max_ms": stats.max_ns * 1e-6,
        }
    return SessionStatus(
        **list_shared_fields(stepper, now_ns),
        **given,
        session_time_s=now_ns * 1e-9,
        sim_time=stepper.core.world.view().sim_time,
        handovers=tuple(stepper.view.handovers),
        lateness=lateness,
        input_to_ctrl_ms=stepper.view.compute_input_to_ctrl_ms(),
    )


class StatusReporter:
    """Builds the authority's half of the `StatusReport`s of one session.

    The pacing loop of `run()` sets `pacer`, `times` and `scheduling`. `warning_sources` are called for every report;
    each returns warnings for the user about conditions that are no failure yet.
    """

    def __init__(self) -> None:
        self.pacer: Pacer | None = None
        self.times: TickTimes | None = None
        self.scheduling = ""
        self.warning_sources: list[Callable[[], Sequence[str]]] = []
        self._next_ns = 0
        self._cpu_ns = time.process_time_ns()
        self._cpu_at_ns = time.monotonic_ns()

    def is_due(self, now_ns: int) -> bool:
        """Return whether a report is due now; if so, start the period of the next one."""
        if now_ns < self._next_ns:
            return False
        pacer = self.pacer
        is_late = pacer is not None and not pacer.paused and pacer.next_deadline_ns <= now_ns
        if is_late and now_ns < self._next_ns + PATIENCE_NS:
            return False
        self._next_ns = now_ns + PERIOD_NS
        return True

    def make_report(
        self, stepper: Stepper, recorder: RecorderReport, sizes: Mapping[str, float], **given: Any
    ) -> StatusReport:
        """Return the authority's half of a report, once a second; fields of the front keep their defaults.

        `sizes`: edges of the printed sheets [m], where known; `given`: other fields.
        """
        pacer, times, core, now_ns = self.pacer, self.times, stepper.core, stepper.clock()
        stats = None if pacer is None else pacer.get_stats(now_ns)
        if times is not None and stats is not None:
            times.mark(stats)
        warnings = [text for source in self.warning_sources for text in source()]
        return StatusReport(
            0,
            "",
            "",
            now_ns,
            **list_shared_fields(stepper, now_ns),
            **given,
            scheduling=self.scheduling,
            recorder=recorder,
            paused_by=stepper.view.paused_by,
            tick_period_ns=core.world.tick_period_ns,
            late_share=0.0 if times is None else times.compute_late_share(),
            late_share_total=0.0 if stats is None else stats.late_share,
            lateness=None if times is None else times.compute_lateness(),
            late_causes={} if times is None else times.count_late_causes(),
            cpu_share=self._measure_cpu_share(),
            load=os.getloadavg()[0],
            cpus=os.cpu_count() or 1,
            memory_bytes=measure_memory_bytes(),
            robots=make_robot_reports(stepper),
            warnings=tuple(collect_warnings(stepper, recorder, self.scheduling, warnings)),
            anchors=tuple(AnchorReport(name, T, sizes.get(name, 0.0)) for name, T in core.authority.anchors.items()),
            cross_checks=core.authority.build_cross_check_reports(),
            unverified=core.authority.build_unverified_reports(),
        )

    def _measure_cpu_share(self) -> float:
        """Return the processor time of this process since the last report, 1 for a whole processor."""
        cpu_ns, at_ns = time.process_time_ns(), time.monotonic_ns()
        share = (cpu_ns - self._cpu_ns) / max(1, at_ns - self._cpu_at_ns)
        self._cpu_ns, self._cpu_at_ns = cpu_ns, at_ns
        return share


def make_recorder_report(feed: RecorderFeed | None, recorder: RecorderProcess | None) -> RecorderReport:
    """Return how the recording does, from the recorder's last report and its supervision; `off` without a recorder."""
    if feed is None or recorder is None:
        return RecorderReport()
    stats = feed.stats
    last = stats.recorder
    fault = recorder.failure or ("" if last is None else last.fault)
    state = "running"
    if recorder.is_used_up:
        state, fault = "ended", recorder.budget_text
    elif fault:
        state = "failed"
    elif not recorder.alive:
        state = "dead"
    elif recorder.hangs:
        state = "hangs"
    fault = fault or stats.drop_reason or (NO_PICTURE if recorder.journal_only else "")
    return RecorderReport(
        state,
        recorder.path[-MAX_TEXT:],
        0 if last is None else last.bytes,
        0 if last is None else last.disk_free,
        stats.dropped_rows,
        stats.waiting_bytes,
        fault[:MAX_TEXT],
        stats.bytes_per_hour,
    )


def make_robot_reports(stepper: Stepper) -> tuple[RobotReport, ...]:
    """Return for each robot its holder, its state, and the time that its samples waited for their step."""
    view = stepper.view
    names = view.names_by_id()
    commands = {c.robot: c for c in stepper.last.decision.commands} if stepper.last is not None else {}
    rows = []
    for spec in stepper.core.scene.robots:
        lease, command = view.mirror.leases.get(spec.name), commands.get(spec.name)
        holder = "" if lease is None else lease.holder
        rows.append(
            RobotReport(
                spec.name,
                stepper.core.config.authority.default_mode or spec.mode if lease is None else lease.mode,
                holder,
                names.get(holder, ""),
                "" if command is None else command.kind,
                "" if command is None else command.hold_reason,
                view.receive_to_step_quantiles(spec.name),
                () if lease is None else lease.queue,
            )
        )
    return tuple(rows)


def collect_warnings(
    stepper: Stepper, recorder: RecorderReport, scheduling: str, warnings: Sequence[str] = ()
) -> list[str]:
    """Return warnings for the user about conditions that are no failure yet, one line each; `warnings` come first."""
    found = list(warnings)
    if stepper.last is not None and stepper.last.diverged:
        found.append(f"physics stands still until a reset: {stepper.last.diverged}"[:MAX_TEXT])
    if scheduling == "normal":
        found.append("the tick loop runs without real-time priority: other programs can make its ticks late")
    if recorder.lost_rows:
        found.append(f"{recorder.lost_rows} rows of the recording are lost: {recorder.text or 'no room for them'}")
    return [text[:MAX_TEXT] for text in found]


def measure_memory_bytes() -> int:
    """Return the resident memory of this process, 0 where the system does not say: it may have no descriptor left."""
    try:
        return int(psutil.Process().memory_info().rss)
    except (OSError, psutil.Error):
        return 0
