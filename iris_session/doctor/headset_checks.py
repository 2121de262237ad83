"""Checks of a `StatusReport`: alignments of headsets that have one. Pure."""

from __future__ import annotations

import math
from typing import Final

from iris_session.doctor.findings import FAILED, WARNING, Finding, ok, report_problems, warning
from iris_session.protocol.common import Nanoseconds
from iris_session.protocol.names import AlarmKind, AlignmentKind
from iris_session.protocol.status import CrossCheckReport, ParticipantReport, StatusReport, UnverifiedReport

#: Tracking frames drift by millimetres a minute: after this time without a sheet the stated error is no longer true.
STALE_NS: Final = 600_000_000_000
#: Half of the default bound of the stated error at the robot: above it a glance is due.
GLANCE_ERROR_M: Final = 0.025
GLANCE_NS: Final = 60_000_000_000
#: An error above the 95 % bound by this factor is not chance, as in `anchors.cross_check`.
MAX_ERROR_RATIO: Final = 2.0
#: Older cross-checks say nothing about the present.
MAX_CROSS_CHECK_AGE_NS: Final = 600_000_000_000
ALARMS: Final = {
    AlarmKind.JUMP: "the tracking frame jumped",
    AlarmKind.CHANGED: "a sheet was seen elsewhere than seconds before",
    AlarmKind.DIFFERS: "a sheet was seen elsewhere than the alignment says",
    AlarmKind.TWO_PLACES: "a sheet was seen in two places: print each id once",
}


def check_headsets(people: tuple[ParticipantReport, ...], report: StatusReport) -> list[Finding]:
    """Return the findings about existing alignments. `people`: the participants without the doctor."""
    here = tuple(p for p in people if p.connected and p.alignment != AlignmentKind.NOT_NEEDED)
    return [
        check_alarms(here),
        check_staleness(here),
        check_runs(here),
        check_corrections(here),
        check_agreement(people, report.cross_checks),
        check_pairs(people, report.unverified),
    ]


def check_alarms(people: tuple[ParticipantReport, ...]) -> Finding:
    """Report alarms that no new alignment has answered."""
    texts, state = [], WARNING
    for p in people:
        r = p.alignment_report
        if r is None or not r.alarm:
            continue
        what = ALARMS.get(r.alarm, r.alarm)
        texts.append(f"{p.name}: {what}, by {r.alarm_size_m * 1e3:.0f} mm, {format_age(r.alarm_ns)} ago")
        if r.alarm == AlarmKind.JUMP:
            state = FAILED  # it has voided the alignment: no robot that `p` holds moves
    why = "the headset was bumped, recentred or lost its tracking, or a sheet was moved"
    advice = (
        "bring a sheet into view that was not moved; if one was moved, put it back or use `iris-session anchors move`"
    )
    return report_problems("alarm", texts, "no alignment was found wrong", why, advice, state)


def check_staleness(people: tuple[ParticipantReport, ...]) -> Finding:
    """Report alignments that are unconfirmed, or so old that half of the bound is used up by their age."""
    texts = []
    for p in people:
        r = p.alignment_report
        if r is None or p.alignment != AlignmentKind.MEASURED:
            continue
        seen_ns = min((one.age_ns for one in r.seen if one.age_ns >= 0), default=p.alignment_age_ns)
        if r.doubt:
            texts.append(f"the alignment of {p.name} is unconfirmed ({r.doubt}): its robots hold at the next clutch")
        elif r.confirmed_ns > GLANCE_NS and r.error_at_robot_m > GLANCE_ERROR_M:
            error = f"{r.error_at_robot_m * 1e3:.0f} mm at the robot"
            texts.append(f"{p.name} has confirmed its alignment {format_age(r.confirmed_ns)} ago: {error}")
        elif seen_ns > STALE_NS:
            texts.append(f"{p.name} has seen no sheet for {format_age(seen_ns)}")
    fine = "measured alignments were confirmed recently"
    why = "tracking frames drift by millimetres a minute, and a later look may contradict an alignment"
    return report_problems("stale", texts, fine, why, "glance at a sheet now and then")


def check_runs(people: tuple[ParticipantReport, ...]) -> Finding:
    """Report alignments whose measurement a director stopped."""
    stopped = [p.name for p in people if p.alignment_report is not None and not p.alignment_report.running]
    if not stopped:
        return ok("align_run", "every headset may correct its alignment")
    text = f"stopped for {', '.join(stopped)}: observations of sheets do not correct the alignment"
    return warning("align_run", text, "a director stopped the run", "start it: `iris-session anchors align start`")


def check_corrections(people: tuple[ParticipantReport, ...]) -> Finding:
    """Report corrections that are not in force yet."""
    reports = [(p.name, p.alignment_report) for p in people]
    texts = [
        f"{name}: {r.pending_m * 1e3:.0f} mm, {math.degrees(r.pending_rad):.1f} deg to go"
        for name, r in reports
        if r is not None and (r.pending_m > 0.0 or r.pending_rad > 0.0)
    ]
    fine = "no correction of an alignment is pending"
    why = "corrections are applied gradually, are announced, or wait until the clutch is open"
    return report_problems("correction", texts, fine, why, "open the clutch for some seconds")


def is_consistent(check: CrossCheckReport) -> bool:
    """Return whether chance explains the difference between two headsets in a cross-check."""
    return check.error_m <= MAX_ERROR_RATIO * check.expected_p95_m


def check_agreement(people: tuple[ParticipantReport, ...], checks: tuple[CrossCheckReport, ...]) -> Finding:
    """Report pairs of headsets whose difference exceeds their stated errors."""
    names = {p.id: p.name for p in people}
    recent = [one for one in checks if one.age_ns <= MAX_CROSS_CHECK_AGE_NS and not one.outdated]
    texts = [
        f"{names.get(one.a, one.a)} and {names.get(one.b, one.b)} put '{one.anchor_id}' {one.error_m * 1e3:.0f} mm "
        f"apart, 95 % of such pairs are below {one.expected_p95_m * 1e3:.0f} mm"
        for one in recent
        if not is_consistent(one)
    ]
    fine = "no two headsets have observed the same anchor in the last ten minutes"
    if recent:
        worst_mm = 1e3 * max(one.error_m for one in recent)
        pairs = len({(one.a, one.b) for one in recent})
        bound = f"within {MAX_ERROR_RATIO:g} times what 95 % have"
        fine = f"{pairs} pairs compared, at most {worst_mm:.0f} mm apart, {bound}"
    why = "one of the two is aligned wrongly, or a sheet is not at the configured place"
    return report_problems("agreement", texts, fine, why, "let both headsets observe the same sheet from two sides")


def check_pairs(people: tuple[ParticipantReport, ...], pairs: tuple[UnverifiedReport, ...]) -> Finding:
    """Report pairs of headsets of which one has aligned by an anchor since the other last saw it."""
    names = {p.id: p.name for p in people}
    texts = [
        f"{names.get(one.other, one.other)} has aligned by '{one.anchor_id}' since "
        f"{names.get(one.participant, one.participant)} last saw it"
        for one in pairs
    ]
    why = "if the sheet was moved in between, the two have different worlds"
    return report_problems(
        "pairs", texts, "no pair of headsets is unverified", why, "glance at the sheet, each of them"
    )


def format_age(duration_ns: Nanoseconds) -> str:
    """Return a duration as seconds or minutes."""
    seconds = duration_ns * 1e-9
    return f"{seconds:.1f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"
