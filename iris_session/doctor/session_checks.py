"""Checks of a `StatusReport`: the session, its participants, its robots and its recording. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from iris_session.doctor import headset_checks, stream_checks
from iris_session.doctor.drop_explanations import explain_drops
from iris_session.doctor.findings import FAILED, WARNING, Finding, failed, ok, report_problems, warning
from iris_session.protocol.common import Nanoseconds
from iris_session.protocol.names import AlignmentKind, CommandKind, HoldReason, LateCause, Role
from iris_session.protocol.status import ParticipantReport, RobotReport, StatusReport

#: Roles that need a robot, and an alignment if they have a headset. Directors need neither.
DRIVERS: Final = Role.DRIVING - {Role.DIRECTOR}
#: Roles of programs without a headset.
PROGRAMS: Final = frozenset({Role.AGENT, Role.GATEWAY, Role.RECORDER, Role.CAMERA, Role.SOURCE})
SILENT_NS: Final = 1_000_000_000
#: The front calls a session stalled after a fifth of this, which a busy machine can cause.
STALLED_NS: Final = 500_000_000
MISSED_SHARE: Final = 0.2
OLD_MS: Final = 150.0
#: Interpolation waits for the next state, and a picture for the display.
SHOWN_MS: Final = 300.0
LATE_SHARE: Final = 0.001
VERY_LATE_SHARE: Final = 0.05
LOW_DISK: Final = 2 << 30
FULL_DISK: Final = 200 << 20
LOW_DISK_S: Final = 1800.0
#: Stages of the data path with the limit of their 99th percentile [ms] and the cause of a longer one.
STAGES: Final = {
    "device -> front": (60.0, "the network between the headset and the session, or the headset's clock"),
    "front -> authority": (20.0, "the session's steps come late: see the check `ticks`"),
    "authority -> state": (15.0, "the front has too little processor time: see load, and other programs"),
    "state -> client": (OLD_MS, "the network to that client, or the client itself is too slow"),
    "client -> picture": (SHOWN_MS, "its page is in the background, draws rarely, or waits for states that come late"),
}
LATE_CAUSES: Final = {
    LateCause.SCHEDULER: (
        "the session did not get the processor when it was ready",
        "end other programs, or permit real-time priority (docs/network.md)",
    ),
    LateCause.PHYSICS: ("physics takes longer than a tick", "a larger time step, or a simpler model"),
    LateCause.CONTROL: ("inverse kinematics and control take too long", "fewer robots per session, or a longer tick"),
    LateCause.AUTHORITY: ("leases and samples take too long", "fewer participants, or a lower sample rate"),
    LateCause.OUTPUT: ("sending state or recording takes too long", "a faster disk, fewer bodies, or --no-record"),
    LateCause.SUPERVISION: ("a process was restarted", "see restarts, and the messages of the session"),
    LateCause.OWNER: ("the program that owns the session takes the time", "less work in the loop of that program"),
    "skipped": ("the session stood still for more than a second", "check the program that owns it"),
}
#: Advice by reason why a robot holds still although its holder does not want that.
HOLD_ADVICE: Final = {
    HoldReason.NO_SAMPLE: "let the app send samples that name this robot, with the clutch open first",
    HoldReason.STALE: "bring the app to the front, check its network, then open and close the clutch",
    HoldReason.UNTRACKED: "bring the device into view of the headset's cameras",
    HoldReason.UNALIGNED: "bring the sheet into view, nearer or from a second place",
    HoldReason.VIEW_ONLY: "touch marks with a calibrated tip: a fingertip or a kept anchor is enough to look only",
    HoldReason.EMULATED: "bring the device into view of the headset's cameras: its position is an estimate",
    HoldReason.ZERO_POSE: "wait until the device is tracked: it reports the origin of its tracking frame",
    HoldReason.FROZEN: "move the device, or wake it: it reports one pose again and again",
    HoldReason.JUMP: "open and close the clutch: the tracking of the device jumped",
    HoldReason.UNCONFIRMED: "glance at a sheet, then open and close the clutch",
    HoldReason.REJECTED: "see `rejected` for the reason, then open and close the clutch",
    HoldReason.DISCONNECTED: "wait until its holder is back or its lease ends, or let a director assign the robot",
}

HEADSET_ADVICE: Final = (
    "bring the app of that headset to the front and put the headset on; if that does not help, move it nearer to the "
    "access point"
)
PROGRAM_ADVICE: Final = "start that program again, or end other programs on its machine"
SCREEN_ADVICE: Final = "open that page again, or wait until its leases end"


def check_session_report(report: StatusReport, own_id: str = "") -> list[Finding]:
    """Return all findings of a report, in the order of a user's questions.

    A session that does not step is checked only for what does not change meanwhile: no client keeps up with it.

    Args:
        report: As the session sent it.
        own_id: Participant id of the doctor itself, which is left out.
    """
    people = tuple(p for p in report.participants if p.id != own_id)
    stepping = [
        check_robots(report.robots, people),
        check_clients(people),
        check_data_age(people, report),
        check_ticks(report),
        stream_checks.check_streams(report.media),
        stream_checks.check_media(people),
    ]
    first = check_stepping(report)
    return [
        first,
        check_alignment(people, ", ".join(one.anchor_id for one in report.anchors), driven=bool(report.robots)),
        *headset_checks.check_headsets(people, report),
        check_leases(people, report.robots),
        *([] if first.failed and not report.estop else stepping),
        check_recorder(report),
        check_disk(report),
        check_drops(report),
        *([warning("warnings", "; ".join(report.warnings))] if report.warnings else []),
    ]


def check_stepping(report: StatusReport) -> Finding:
    """Check whether the session steps, is paused, or is stopped."""
    silent_s = report.authority_silent_ns * 1e-9
    if report.authority_silent_ns < 0:
        return failed(
            "session",
            "the session has not taken a step yet",
            "the program that owns the session opened it, but does not run it",
            "call run(), or begin_tick() and end_tick()",
        )
    if report.authority_silent_ns > STALLED_NS:
        return failed(
            "session",
            f"the session has not taken a step for {silent_s:.1f} s: robots hold",
            "the program that owns it does not step: it is stopped, in a debugger, or busy with something else",
            "check that program; if it does not recover, end it and restart the session",
        )
    if report.estop:
        stops = "; ".join(f"{s.name or 'a connection'}{f' ({s.reason})' if s.reason else ''}" for s in report.stops[:4])
        why = f"stopped by {stops}" if stops else ""
        return failed(
            "session", "the emergency stop is active", why, "check that it is safe, then let a director clear it"
        )
    if report.pause_reason:
        return failed("session", "physics stands still", report.pause_reason, "reset it: `iris-session reset`")
    if report.paused:
        return warning("session", "physics is paused", "", "a director resumes it")
    if report.lateness is not None:
        return ok("session", f"steps: tick {report.tick}, {1e9 / max(1, report.tick_period_ns):.0f} Hz")
    if not report.tick:
        return ok("session", "steps, but no tick was taken and no pose published yet")
    return ok("session", f"steps: tick {report.tick}, paced by the program that owns the session")


def check_alignment(people: tuple[ParticipantReport, ...], sheets: str = "", *, driven: bool = True) -> Finding:
    """Report participants that cannot drive, or see the scene at the wrong place, because they have no alignment.

    Args:
        people: Participants without the doctor.
        sheets: Ids of the anchors of the session, for the advice.
        driven: True if the session has robots. Without robots, only headsets that have observed a sheet, or have lost
            their alignment, need one.
    """
    void = [p for p in people if p.connected and p.alignment == AlignmentKind.NONE and (driven or _has_seen_sheet(p))]
    texts = [f"{p.name} has no alignment{_explain_unaligned(p)}" for p in void]
    measured = [p for p in people if p.alignment == AlignmentKind.MEASURED]
    errors = ", ".join(f"{p.name} {p.alignment_error_m * 1e3:.0f} mm" for p in measured)
    fine = f"stated error at the robot: {errors}" if errors else "no participant needs one, or all have one"
    why = "the headset has not observed an anchor well enough since it joined or since its tracking frame jumped"
    advice = "bring the sheet into view, nearer or from a second place" + (
        f"; sheets of this session: {sheets}" if sheets else ""
    )
    state = FAILED if driven and any(p.role in DRIVERS for p in void) else WARNING
    return report_problems("alignment", texts, fine, why, advice, state)


def _has_seen_sheet(p: ParticipantReport) -> bool:
    """Return whether the participant has observed a sheet, or something like one. A desktop client observes none."""
    seen = p.alignment_report
    return p.alignment_void_ns >= 0 or (seen is not None and bool(seen.seen or seen.unusable))


def _explain_unaligned(p: ParticipantReport) -> str:
    """Return why a participant has no alignment, as far as the report shows it."""
    seen = p.alignment_report
    if p.alignment_void_ns >= 0:
        return f" (lost {_format_seconds(p.alignment_void_ns)} ago: its tracking frame jumped)"
    if seen is None or seen.seen:
        return ""
    return f" ({seen.unusable} observations, none usable of a sheet of this session)" if seen.unusable else ""


def check_leases(people: tuple[ParticipantReport, ...], all_robots: tuple[RobotReport, ...]) -> Finding:
    """Report the holder of each robot, and participants without one."""
    held = ", ".join(f"{r.name}: {r.holder_name or r.holder or 'free'}" for r in all_robots) or "no robots here"
    without = [p for p in people if p.connected and p.role in DRIVERS and not p.holds]
    if not without or not all_robots:
        return ok("leases", held)
    waits = [f", waits for {', '.join(p.waits_for)}" if p.waits_for else "" for p in without]
    text = "; ".join(f"{p.name} has no robot{waiting}" for p, waiting in zip(without, waits, strict=True))
    free = [r.name for r in all_robots if not r.holder]
    disconnected = {p.id: p.name for p in people if not p.connected}
    kept = [
        f"{disconnected[r.holder]} is disconnected, {r.name} is kept for a grace period"
        for r in all_robots
        if r.holder in disconnected
    ]
    why = "; ".join([held, *kept])
    advice = "ask the holder, wait for it (acquire with `wait`), or let a director assign it"
    return warning("leases", text, why, f"acquire one: {', '.join(free)} is free" if free else advice)


def check_robots(all_robots: tuple[RobotReport, ...], people: tuple[ParticipantReport, ...]) -> Finding:
    """Report robots that have a holder and hold still for another reason than an open clutch."""
    rejected = {p.id: p.rejected for p in people}
    texts, reasons = [], []
    for r in all_robots:
        if r.holder and r.state == CommandKind.HOLD and r.hold_reason in HOLD_ADVICE:
            counts = rejected.get(r.holder) or {}
            top = ", ".join(f"{reason} {n}" for reason, n in sorted(counts.items(), key=lambda item: -item[1])[:3])
            texts.append(f"{r.name} ({r.holder_name}) holds: {r.hold_reason}" + (f", rejected: {top}" if top else ""))
            reasons.append(HOLD_ADVICE[r.hold_reason])
    states = ", ".join(f"{r.name} {r.hold_reason or r.state}" for r in all_robots)
    return report_problems("robots", texts, states or "none", "", "; ".join(dict.fromkeys(reasons)))


def check_clients(people: tuple[ParticipantReport, ...]) -> Finding:
    """Report clients that do not keep up or are disconnected."""
    bad: list[str] = []
    worst: list[str] = []
    advice: dict[str, None] = {}
    for p in people:
        problems = list(_list_client_problems(p))
        is_screen = p.alignment == AlignmentKind.NOT_NEEDED and p.role not in PROGRAMS
        if not p.connected and is_screen:
            problems = [f"has closed its page, or lost it; {', '.join(p.holds)} is kept for it"] if p.holds else []
        if problems:
            advice[SCREEN_ADVICE if is_screen else PROGRAM_ADVICE if p.role in PROGRAMS else HEADSET_ADVICE] = None
            is_lost = (not p.connected or p.heard_ns > SILENT_NS) and not is_screen
            (worst if is_lost else bad).append(f"{p.name}: {', '.join(problems)}")
    connected = sum(p.connected for p in people)
    fine = f"{connected} connected, all keep up" if connected else "no other participants"
    why = "the application is stopped or too slow, or its network is"
    return report_problems("clients", worst + bad, fine, why, "; ".join(advice), FAILED if worst else WARNING)


def _list_client_problems(p: ParticipantReport) -> Iterator[str]:
    if not p.connected:
        yield f"disconnected ({p.lost or 'unknown'})"
        return
    if p.heard_ns > SILENT_NS:
        yield f"silent for {_format_seconds(p.heard_ns)}"
    if p.reported and p.state_age is None:
        yield "receives no state: is its state port open?"
    if p.missed_share > MISSED_SHARE:
        yield f"misses {p.missed_share:.0%} of the frames"
    if p.state_age is not None and p.state_age.p50 > OLD_MS:
        yield f"sees data that is {p.state_age.p50:.0f} ms old"


def check_data_age(people: tuple[ParticipantReport, ...], report: StatusReport) -> Finding:
    """Check the age of data by stage of its path, and name the slow stage."""
    took = measure_stages(people, report)
    if not took:
        return ok("age", "no data is on its way")
    text = ", ".join(f"{stage} {ms:.1f} ms" + (f" ({who})" if who else "") for stage, (ms, who) in took.items())
    over = {stage: ms / STAGES[stage][0] for stage, (ms, _) in took.items()}
    slowest = max(over, key=over.__getitem__)
    if over[slowest] <= 1.0:
        return ok("age", f"p99: {text}")
    return warning(
        "age", f"{slowest} is slow; p99: {text}", STAGES[slowest][1], "see docs/troubleshooting.md, Old data"
    )


def measure_stages(people: tuple[ParticipantReport, ...], report: StatusReport) -> dict[str, tuple[float, str]]:
    """Return, per measured stage, the 99th percentile [ms] of the slowest participant or robot, and its name."""
    took: dict[str, tuple[float, str]] = {}
    devices = [(p.capture_to_receive.p99, p.name) for p in people if p.capture_to_receive is not None]
    waits = [(r.receive_to_step.p99, r.name) for r in report.robots if r.receive_to_step is not None]
    if devices:
        took["device -> front"] = max(devices)
    if waits:
        took["front -> authority"] = max(waits)
    publish = report.step_to_publish
    if publish is not None:
        took["authority -> state"] = (publish.p99, "")
    shown = [(p.state_age.p99, p.name) for p in people if p.state_age is not None]
    if shown:
        ms, who = max(shown)
        took["state -> client"] = (max(0.0, ms - (0.0 if publish is None else publish.p50)), who)
    drawn = [(stages["render"], p.name) for p in people if "render" in (stages := measure_client_stages(p, report))]
    if drawn:
        took["client -> picture"] = max(drawn)
    return took


def measure_client_stages(p: ParticipantReport, report: StatusReport) -> dict[str, float]:
    """Return where the age of what a participant sees arises, medians [ms]: `tick` until the session has sent it,
    `network` until its application has it, `render` until it is shown. Only what was measured.
    """
    if p.state_age is None:
        return {}
    tick = 0.0 if report.step_to_publish is None else min(report.step_to_publish.p50, p.state_age.p50)
    stages = {"tick": tick, "network": p.state_age.p50 - tick}
    if p.shown_age_ms > 0.0:
        stages["render"] = max(0.0, p.shown_age_ms - p.state_age.p50)
    return stages


def check_ticks(report: StatusReport) -> Finding:
    """Check for late ticks, and name their main cause."""
    if report.lateness is None:
        return ok("ticks", "the user loop sets the pace: no tick is late")
    text = (
        f"{report.late_share:.2%} late in the last ten seconds, {report.late_share_total:.2%} in all; "
        f"lateness p99 {report.lateness.p99:.2f} ms; scheduling {report.scheduling}, "
        f"load {report.load:.1f} of {report.cpus}"
    )
    if report.late_share <= LATE_SHARE:
        return ok("ticks", text)
    if not report.late_causes:
        return warning("ticks", text)
    counts = ", ".join(f"{cause} {n}" for cause, n in sorted(report.late_causes.items(), key=lambda item: -item[1]))
    main = max(sorted(report.late_causes), key=report.late_causes.__getitem__)
    why, advice = LATE_CAUSES.get(main, (main, ""))
    say = failed if report.late_share > VERY_LATE_SHARE else warning
    return say("ticks", f"{text}; causes: {counts}", f"{main}: {why}", advice)


def check_recorder(report: StatusReport) -> Finding:
    """Check that the recorder runs and has lost nothing."""
    one = report.recorder
    if one is None or one.state == "off":
        return ok("recorder", "nothing is recorded")
    text = f"{one.path}: {one.bytes_written / 1e6:.1f} MB"
    lost = f", {one.lost_rows} rows lost" if one.lost_rows else ""
    waiting = f", {one.spilled_bytes / 1e6:.1f} MB wait in memory" if one.spilled_bytes else ""
    if one.state == "hangs":
        why = "it has accepted nothing for five seconds: its disk or network drive does not answer"
        return failed("recorder", f"the recorder hangs; {text}{waiting}{lost}", why, "check that disk")
    if one.state == "ended":
        return warning(
            "recorder", f"{one.text}; {one.path}", "", "record with a larger --record-budget, or without one"
        )
    if one.state in ("dead", "failed"):
        text = f"the recorder ended, nothing is written now; {text}{waiting}{lost}"
        return failed("recorder", text, one.text, "fix the cause; the recorder restarts by itself")
    if one.lost_rows:
        return warning("recorder", f"{text}{lost}", one.text, "verification goes on after the gap")
    if one.text:
        advice = "the journal goes on, and verifies; the session's log and the recording's markers have the cause"
        return warning("recorder", f"{text}{waiting}", one.text, advice)
    return ok("recorder", f"{text}{waiting}")


def check_disk(report: StatusReport) -> Finding:
    """Check that the disk has room for the recording."""
    one = report.recorder
    if one is None or one.state == "off" or not one.disk_free_bytes:
        return ok("disk", "nothing is recorded, or the free space is not known")
    free = one.disk_free_bytes
    rate = one.bytes_per_hour / 3600.0 or one.bytes_written / max(1.0, report.session_time * 1e-9)
    left_s = free / rate if rate > 0.0 else float("inf")
    text = f"{free / 1e9:.2f} GB left for the recording"
    if free < FULL_DISK:
        advice = "make room, or record elsewhere (--record)"
        return failed("disk", text, "the disk is full, or nearly so", advice)
    if free < LOW_DISK or left_s < LOW_DISK_S:
        return warning("disk", f"{text}, about {left_s / 60:.0f} minutes", "", "make room")
    return ok("disk", text)


def check_drops(report: StatusReport) -> Finding:
    """Report drops, and restarts of front and recorder."""
    restarts = ", ".join(f"{name} {n} times" for name, n in sorted(report.restarts.items()) if n)
    text = explain_drops(report.drops)
    if restarts:
        return warning(
            "drops", f"restarted: {restarts}; dropped: {text or 'nothing'}", "", "see the session's terminal"
        )
    return ok("drops", f"dropped so far: {text or 'nothing'}")


def _format_seconds(duration_ns: Nanoseconds) -> str:
    return f"{duration_ns * 1e-9:.1f} s"
