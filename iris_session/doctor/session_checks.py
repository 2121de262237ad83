"""What a `StatusReport` says about the session, its people, its robots and its recording. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from iris_session.doctor import headset_checks
from iris_session.doctor.drop_explanations import explain_drops
from iris_session.doctor.findings import Finding, failed, ok, warning
from iris_session.protocol.common import Nanoseconds
from iris_session.protocol.names import AlignmentKind, CommandKind, HoldReason, LateCause, Role
from iris_session.protocol.status import ParticipantReport, RobotReport, StatusReport

#: Who wants a robot, and an alignment if they have a headset. A director may do without.
DRIVERS: Final = Role.DRIVING - {Role.DIRECTOR}
SILENT_NS: Final = 1_000_000_000
#: The front calls a session stalled after a fifth of it, which a busy machine can make happen.
STALLED_NS: Final = 500_000_000
MISSED_SHARE: Final = 0.2
OLD_MS: Final = 150.0
LATE_SHARE: Final = 0.001
VERY_LATE_SHARE: Final = 0.05
LOW_DISK: Final = 2 << 30
FULL_DISK: Final = 200 << 20
LOW_DISK_S: Final = 1800.0
#: Stages of the data's way and how long each may take (99th percentile) [ms].
STAGES: Final = {
    "device -> front": (60.0, "the network between the headset and the session, or the headset's clock"),
    "front -> authority": (20.0, "the session's steps come late: see the check `ticks`"),
    "authority -> state": (15.0, "the front has too little processor time: see load, and other programs"),
    "state -> client": (OLD_MS, "the network to that client, or the client itself is too slow"),
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
    LateCause.SUPERVISION: ("a process was started anew", "see restarts, and the messages of the session"),
    LateCause.OWNER: ("the program that owns the session spends its time", "less work in the loop of that program"),
    "skipped": ("the session stood still for more than a second", "look at the program that owns it"),
}
#: Why a robot that somebody has holds still without them wanting it.
HOLD_ADVICE: Final = {
    HoldReason.NO_SAMPLE: "no sample has counted yet: does the app send samples that name this robot?",
    HoldReason.STALE: "no counted sample for 150 ms: a slow network, or the app stopped sending",
    HoldReason.UNTRACKED: "the device is not tracked: bring it into view",
    HoldReason.UNALIGNED: "no alignment, or its error here is too large: look at the sheet",
    HoldReason.REJECTED: "a sample was rejected: see `rejected`; open and close the clutch",
    HoldReason.DISCONNECTED: "its holder's connection is lost; the lease waits for them",
}


def check_session_report(report: StatusReport, own_id: str = "") -> list[Finding]:
    """All findings of a report, in the order of a person's questions. `own_id`: the doctor itself, left out.

    Of a session that stands still only what does not change meanwhile: nobody keeps up with it.
    """
    people = tuple(p for p in report.participants if p.id != own_id)
    stepping = [
        check_robots(report.robots, people),
        check_clients(people),
        check_data_age(people, report),
        check_ticks(report),
        headset_checks.check_media(people),
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
    """Whether it steps, is paused, or stopped."""
    silent_s = report.authority_silent_ns * 1e-9
    if report.authority_silent_ns < 0:
        return failed(
            "session",
            "the session has not taken a step yet",
            "the program that owns it opened it, but does not run it",
            "call run(), or begin_tick() and end_tick()",
        )
    if report.authority_silent_ns > STALLED_NS:
        return failed(
            "session",
            f"the session stands still, for {silent_s:.1f} s now: robots hold",
            "the process that owns it does not step: stopped, in a debugger, or busy with something else",
            "look at that program; if it is gone for good, end it and start the session again",
        )
    if report.estop:
        return failed("session", "somebody stopped everything (e-stop)", "", "look, then let a director clear it")
    if report.paused:
        return warning("session", "physics is paused", "", "a director resumes it")
    if report.lateness is not None:
        return ok("session", f"steps: tick {report.tick}, {1e9 / max(1, report.tick_period_ns):.0f} Hz")
    if not report.tick:
        return ok("session", "steps, and nothing has moved so far: no tick was taken, no pose published")
    return ok("session", f"steps: tick {report.tick}, at the pace of the program that owns it")


def check_alignment(people: tuple[ParticipantReport, ...], sheets: str = "", *, driven: bool = True) -> Finding:
    """Who cannot drive, or sees the scene in the wrong place, for want of an alignment. `sheets`: of the session.
    `driven`: there are robots; where none is, only headsets that look for a sheet, or have lost it, want one."""
    void = [p for p in people if p.connected and p.alignment == AlignmentKind.NONE and (driven or _has_seen_sheet(p))]
    texts = [f"{p.name} has no alignment{_explain_unaligned(p)}" for p in void]
    measured = [p for p in people if p.alignment == AlignmentKind.MEASURED]
    fine = ", ".join(f"{p.name} {p.alignment_error_m * 1e3:.0f} mm" for p in measured)
    if not texts:
        return ok(
            "alignment", f"stated error at the robot: {fine}" if fine else "nobody here needs one, or all have it"
        )
    why = "the headset has not seen an anchor well enough since it joined or since its tracking frame jumped"
    advice = "look at the sheet, nearer or from a second place" + (
        f"; sheets of this session: {sheets}" if sheets else ""
    )
    say = failed if driven and any(p.role in DRIVERS for p in void) else warning
    return say("alignment", "; ".join(texts), why, advice)


def _has_seen_sheet(p: ParticipantReport) -> bool:
    """Whether it has seen a sheet, or what may be one: a screen sees none."""
    seen = p.alignment_report
    return p.alignment_void_ns >= 0 or (seen is not None and bool(seen.seen or seen.unusable))


def _explain_unaligned(p: ParticipantReport) -> str:
    """Why it has none, as far as can be told."""
    seen = p.alignment_report
    if p.alignment_void_ns >= 0:
        return f" (lost {_format_seconds(p.alignment_void_ns)} ago: its tracking frame jumped)"
    if seen is None or seen.seen:
        return ""
    return (
        f" ({seen.unusable} observations, none of a sheet of this session that could be used)" if seen.unusable else ""
    )


def check_leases(people: tuple[ParticipantReport, ...], all_robots: tuple[RobotReport, ...]) -> Finding:
    """Who has which robot, and who has none."""
    held = ", ".join(f"{r.name}: {r.holder_name or r.holder or 'free'}" for r in all_robots) or "no robots here"
    without = [p for p in people if p.connected and p.role in DRIVERS and not p.holds]
    if not without or not all_robots:
        return ok("leases", held)
    texts = []
    for p in without:
        waits = f", waits for {', '.join(p.waits_for)}" if p.waits_for else ""
        texts.append(f"{p.name} has no robot{waits}")
    free = [r.name for r in all_robots if not r.holder]
    gone = {p.id: p.name for p in people if not p.connected}
    kept = [f"{gone[r.holder]} is gone, {r.name} is kept for them" for r in all_robots if r.holder in gone]
    why = "; ".join([held, *kept])
    if free:
        return warning("leases", "; ".join(texts), why, f"acquire one: {', '.join(free)} is free")
    return warning(
        "leases", "; ".join(texts), why, "ask the holder, wait for it (acquire with `wait`), or a director assigns"
    )


def check_robots(all_robots: tuple[RobotReport, ...], people: tuple[ParticipantReport, ...]) -> Finding:
    """Robots that somebody has and that hold still unwillingly."""
    rejected = {p.id: p.rejected for p in people}
    texts, reasons = [], []
    for r in all_robots:
        if r.holder and r.state == CommandKind.HOLD and r.hold_reason in HOLD_ADVICE:
            counts = rejected.get(r.holder) or {}
            some = ", ".join(f"{reason} {n}" for reason, n in sorted(counts.items(), key=lambda item: -item[1])[:3])
            texts.append(f"{r.name} ({r.holder_name}) holds: {r.hold_reason}" + (f", rejected: {some}" if some else ""))
            reasons.append(HOLD_ADVICE[r.hold_reason])
    if texts:
        return warning("robots", "; ".join(texts), "", "; ".join(dict.fromkeys(reasons)))
    states = ", ".join(f"{r.name} {r.hold_reason or r.state}" for r in all_robots)
    return ok("robots", states or "none")


def check_clients(people: tuple[ParticipantReport, ...]) -> Finding:
    """Who does not keep up, or has gone."""
    bad: list[str] = []
    worst: list[str] = []
    for p in people:
        trouble = list(_list_client_problems(p))
        if trouble:
            (worst if not p.connected or p.heard_ns > SILENT_NS else bad).append(f"{p.name}: {', '.join(trouble)}")
    if not bad and not worst:
        return ok("clients", f"{len(people)} here, all keep up" if people else "nobody else is here")
    why = "their application stands still or is too slow, or their network is"
    advice = "look at that headset: is the app in front, is it worn, how good is its Wi-Fi?"
    return (failed if worst else warning)("clients", "; ".join(worst + bad), why, advice)


def _list_client_problems(p: ParticipantReport) -> Iterator[str]:
    if not p.connected:
        yield f"connection lost ({p.lost or 'unknown'})"
        return
    if p.heard_ns > SILENT_NS:
        yield f"silent for {_format_seconds(p.heard_ns)}"
    if p.reported and p.state_age is None:
        yield "gets no state: is its state port open?"
    if p.missed_share > MISSED_SHARE:
        yield f"misses {p.missed_share:.0%} of the frames"
    if p.state_age is not None and p.state_age.p50 > OLD_MS:
        yield f"sees data of {p.state_age.p50:.0f} ms ago"


def check_data_age(people: tuple[ParticipantReport, ...], report: StatusReport) -> Finding:
    """How old the data is by stage of its way, and which stage is to blame."""
    took = measure_stages(people, report)
    if not took:
        return ok("age", "nothing moves along its way now")
    text = ", ".join(f"{stage} {ms:.1f} ms" + (f" ({who})" if who else "") for stage, (ms, who) in took.items())
    over = {stage: ms / STAGES[stage][0] for stage, (ms, _) in took.items()}
    guilty = max(over, key=over.__getitem__)
    if over[guilty] <= 1.0:
        return ok("age", f"p99: {text}")
    return warning("age", f"{guilty} is slow; p99: {text}", STAGES[guilty][1], "see docs/troubleshooting.md, Old data")


def measure_stages(people: tuple[ParticipantReport, ...], report: StatusReport) -> dict[str, tuple[float, str]]:
    """99th percentile [ms] of the worst one, and who that is, per stage that was measured."""
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
    return took


def check_ticks(report: StatusReport) -> Finding:
    """Late ticks, and what they are late for."""
    if report.lateness is None:
        return ok("ticks", "the owner's loop sets the pace: nothing is late")
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
    """Whether the recording goes on."""
    one = report.recorder
    if one is None or one.state == "off":
        return ok("recorder", "nothing is recorded")
    text = f"{one.path}: {one.bytes_written / 1e6:.1f} MB"
    lost = f", {one.lost_rows} rows lost" if one.lost_rows else ""
    waiting = f", {one.spilled_bytes / 1e6:.1f} MB wait on the disk" if one.spilled_bytes else ""
    if one.state == "hangs":
        why = "it has taken nothing for five seconds: its disk or network drive does not answer"
        return failed("recorder", f"the recorder hangs; {text}{waiting}{lost}", why, "look at that disk")
    if one.state in ("dead", "failed"):
        text = f"the recorder ended, nothing is written now; {text}{waiting}{lost}"
        return failed("recorder", text, one.text, "mend that; it is started again by itself")
    if one.lost_rows:
        return warning("recorder", f"{text}{lost}", one.text, "verification goes on after the gap")
    return ok("recorder", f"{text}{waiting}")


def check_disk(report: StatusReport) -> Finding:
    """Room for the recording."""
    one = report.recorder
    if one is None or one.state == "off" or not one.disk_free_bytes:
        return ok("disk", "nothing is recorded, or its room is not known")
    free = one.disk_free_bytes
    rate = one.bytes_written / max(1.0, report.session_time * 1e-9)
    left_s = free / rate if rate > 0.0 else float("inf")
    text = f"{free / 1e9:.2f} GB left for the recording"
    if free < FULL_DISK:
        advice = "make room, or record elsewhere (--record)"
        return failed("disk", text, "the disk is full, or nearly so", advice)
    if free < LOW_DISK or left_s < LOW_DISK_S:
        return warning("disk", f"{text}, about {left_s / 60:.0f} minutes", "", "make room")
    return ok("disk", text)


def check_drops(report: StatusReport) -> Finding:
    """What was thrown away, and front or recorder that had to be started again."""
    restarts = ", ".join(f"{name} {n} times" for name, n in sorted(report.restarts.items()) if n)
    text = explain_drops(report.drops)
    if restarts:
        return warning(
            "drops", f"started again: {restarts}; dropped: {text or 'nothing'}", "", "see the session's terminal"
        )
    return ok("drops", f"dropped so far: {text or 'nothing'}")


def _format_seconds(duration_ns: Nanoseconds) -> str:
    return f"{duration_ns * 1e-9:.1f} s"
