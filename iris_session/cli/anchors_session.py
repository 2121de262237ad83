"""`iris-session anchors status`, `align`, `place`, `move` and `solve`: alignment in running and recorded sessions."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from iris_session.cli.common import (
    CommandError,
    add_address_options,
    add_command,
    add_json_option,
    add_pose_option,
    check_session_reachable,
    find_participant,
    pose_to_dict,
    print_json,
    to_printable,
    write_file,
)
from iris_session.cli.progress import ProgressLine
from iris_session.cli.status import add_watch_options, open_status, watch_status
from iris_session.doctor.headset_checks import is_consistent
from iris_session.protocol.names import AlignAction, AlignmentKind

if TYPE_CHECKING:
    from anchors.constellation import Constellation
    from anchors.pose import PoseTuple
    from iris_session.alignment.resolve import FrameResult, LiveComparison, RelativePoses
    from iris_session.client import Client
    from iris_session.protocol.server_messages import ParticipantInfo
    from iris_session.protocol.status import AlignmentReport, CrossCheckReport, ParticipantReport, StatusReport
    from iris_session.recording import AlignmentHistory, RecordedParticipant, Recording


ALL_PARTICIPANTS: Final = "all"
#: Sheets listed per headset, most recently observed first.
MAX_LISTED_SHEETS: Final = 8


def register_status(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action `status`."""
    one = add_command(
        actions,
        "status",
        run_status,
        help="how well the headsets of a running session are aligned",
        description="Join as an observer and print for every headset the basis of its alignment, then the anchors, and "
        "the cross-checks between pairs of headsets.",
        examples="""
            iris-session anchors status
            iris-session anchors status 192.168.1.20 --watch
            iris-session anchors status --json
        """,
    )
    add_address_options(one)
    add_watch_options(one, one)
    add_json_option(one)


def register_align(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action `align`."""
    one = add_command(
        actions,
        "align",
        run_align,
        help="start or stop measuring the alignment of headsets",
        description="`start` discards earlier observations and measures again; `stop` keeps the alignment in force and "
        "ignores later observations. The present alignment stays until there is a better one. Joins as a director.",
        examples="""
            iris-session anchors align start                   every participant with a headset
            iris-session anchors align start ann
            iris-session anchors align stop p3 --address 192.168.1.20
        """,
    )
    one.add_argument("what", choices=sorted(AlignAction.ALL))
    one.add_argument(
        "participant",
        nargs="?",
        default=ALL_PARTICIPANTS,
        metavar="PARTICIPANT",
        help="name or id, or `all` (%(default)s)",
    )
    add_address_options(one, option=True)
    add_json_option(one)


def register_place(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action `place`."""
    one = add_command(
        actions,
        "place",
        run_place,
        help="align a headset by hand",
        description="Set the pose of the tracking frame of a headset, T_world_tracking, or with --offset an offset to "
        "the measured alignment, which voids its stated error. Joins as a director.",
        examples="""
            iris-session anchors place ann --pose 0.4,0,0,1,0,0,0
            iris-session anchors place ann --offset --pose -0.01,0,0,1,0,0,0
        """,
    )
    one.add_argument("participant", metavar="PARTICIPANT", help="name or id")
    add_pose_option(one, "T_world_tracking, or the offset in the world")
    one.add_argument("--offset", action="store_true", help="the pose is an offset to the measured alignment")
    add_address_options(one, option=True)
    add_json_option(one)


def register_move(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action `move`."""
    one = add_command(
        actions,
        "move",
        run_move,
        help="set the pose of an anchor of the session",
        description="Change T_world_anchor: the shared scene moves for every headset whose measured alignment uses "
        "that anchor. Further than 5 m only with --force. Joins as a director.",
        examples="""
            iris-session anchors move table --pose 0,-0.45,0,1,0,0,0
            iris-session anchors move table --pose -0.2,0.1,0,0.7071068,0,0,0.7071068
        """,
    )
    one.add_argument("anchor", metavar="ANCHOR", help="id of the anchor, see `anchors status`")
    add_pose_option(one, "T_world_anchor")
    one.add_argument("--force", action="store_true", help="allow more than 5 m from the present position")
    add_address_options(one, option=True)
    add_json_option(one)


# --- align, place, move -----------------------------------------------------------------------------------------------


@contextmanager
def join_as_director(arguments: argparse.Namespace) -> Iterator[Client]:
    """Join the session as a director."""
    from iris_session.client import Client

    check_session_reachable(arguments)
    with Client(
        arguments.address,
        session=arguments.session,
        join_code=arguments.code,
        role="director",
        name="anchors",
        alignment=AlignmentKind.NOT_NEEDED,
    ) as client:
        yield client


def run_align(arguments: argparse.Namespace) -> int:
    """Start or stop runs. Exit status 1 if one of several participants was denied."""
    from iris_session.client import DeniedError

    done: list[dict[str, Any]] = []
    with join_as_director(arguments) as client:
        people = select_participants(client, arguments.participant)
        for person in people:
            denied = ""
            try:
                if arguments.what == AlignAction.START:
                    client.alignment.start_run(person.id)
                else:
                    client.alignment.stop_run(person.id)
            except DeniedError as error:
                if len(people) == 1:
                    raise
                denied = str(error)
            done.append({"id": person.id, "name": person.name, "denied": denied})
    ok = not any(one["denied"] for one in done)
    if arguments.json:
        print_json({"ok": ok, "action": arguments.what, "participants": done})
        return 0 if ok else 1
    outcome = (
        "started: bring the sheets into view" if arguments.what == AlignAction.START else "stopped: alignment kept"
    )
    for one in done:
        print(to_printable(f"{one['name']} ({one['id']}): {one['denied'] or outcome}"))
    return 0 if ok else 1


def run_place(arguments: argparse.Namespace) -> int:
    """Place the alignment of one participant."""
    with join_as_director(arguments) as client:
        one = find_participant(client, arguments.participant)
        client.alignment.place(one.id, arguments.pose, offset=arguments.offset)
    if arguments.json:
        print_json({"ok": True, "participant": {"id": one.id, "name": one.name}, "offset": arguments.offset})
    else:
        print(to_printable(f"{one.name} ({one.id}) is {'moved by the offset' if arguments.offset else 'placed'}"))
    return 0


def run_move(arguments: argparse.Namespace) -> int:
    """Move an anchor, and list the alignments that follow it and those that do not."""
    from anchors.pose import distance

    with join_as_director(arguments) as client:
        report = client.status()
        was = next((one.T_world_anchor.p for one in report.anchors if one.anchor_id == arguments.anchor), None)
        moved_m = 0.0 if was is None else distance(was, arguments.pose[0])  # the session denies an unknown anchor
        client.alignment.move_anchor(arguments.anchor, arguments.pose, force=arguments.force)
    kinds = {AlignmentKind.MEASURED, AlignmentKind.PLACED, *AlignmentKind.VIEW_ONLY}
    aligned = [p for p in list_headsets(report) if p.alignment in kinds]
    stay = {
        p.id: f"{p.name} ({p.id}): {why}" for p in aligned if (why := explain_unaffected_alignment(p, arguments.anchor))
    }
    follow = [p for p in aligned if p.id not in stay]
    if arguments.json:
        ids = {"follow": [p.id for p in follow], "stay": list(stay)}
        print_json({"ok": True, "anchor": arguments.anchor, "moved_m": moved_m, **ids})
        return 0
    by = "rotated" if moved_m == 0.0 else f"moved by {moved_m * 1e3:.0f} mm"
    print(to_printable(f"anchor '{arguments.anchor}' {by}: {len(follow)} alignments measured to it follow"))
    for line in stay.values():
        print(to_printable(f"    unchanged: {line}"))
    return 0


def explain_unaffected_alignment(p: ParticipantReport, anchor: str) -> str:
    """Return why an alignment does not follow a moved anchor; empty if it does."""
    r = p.alignment_report
    if r is not None and not r.running:
        return f"its run is stopped; start it with `iris-session anchors align start {p.id}`"
    if p.alignment == AlignmentKind.PLACED:
        return f"a director placed it; measure it with `iris-session anchors align start {p.id}`"
    if r is None or not p.connected or anchor not in {one.anchor_id for one in r.seen}:
        return f"it has not observed '{anchor}' since it joined; it follows when it does"
    return ""


def select_participants(client: Client, name: str) -> list[ParticipantInfo]:
    """Return the participant with an id or name, or all with a headset for `all`.

    Raises:
        CommandError: There is none, or several have the name.
    """
    people = list(client.mirror.participants.values())
    if name != ALL_PARTICIPANTS or any(name in (one.id, one.name) for one in people):
        return [find_participant(client, name)]
    headsets = [one for one in people if one.alignment is None or one.alignment.kind != AlignmentKind.NOT_NEEDED]
    found = sorted((one for one in headsets if one.connected), key=lambda one: (len(one.id), one.id))
    if not found:
        raise CommandError("no participant of this session has a headset that is aligned", status=1)
    return found


# --- status -----------------------------------------------------------------------------------------------------------


def run_status(arguments: argparse.Namespace) -> int:
    """Print the alignment of every headset; with --watch until Ctrl-C."""
    with open_status(arguments) as (client, report):
        if arguments.watch:
            return watch_status(client, arguments.period, print_alignment_status, as_json=arguments.json)
        print_alignment_status(report, as_json=arguments.json)
    return 0


def print_alignment_status(report: StatusReport, *, as_json: bool) -> None:
    """Print one report as text or JSON."""
    if as_json:
        print_json(to_dict(report))
    else:
        print("\n".join(format_alignment_status(report)), flush=True)


def list_headsets(report: StatusReport) -> list[ParticipantReport]:
    """Return the participants that are aligned, or can be."""
    return [p for p in report.participants if p.alignment != AlignmentKind.NOT_NEEDED]


def to_dict(report: StatusReport) -> dict[str, Any]:
    """Return the object that `--json` prints; fields as in `StatusReport`."""
    import msgspec

    kept = ("id", "name", "role", "connected", "tracking_epoch", "alignment", "alignment_age_ns", "alignment_void_ns")
    people = [
        {**_pick(p, *kept), "alignment_report": msgspec.to_builtins(p.alignment_report)} for p in list_headsets(report)
    ]
    checks = [{**msgspec.to_builtins(one), "as_expected": is_consistent(one)} for one in report.cross_checks]
    return {
        "session": report.session_name,
        "session_time": report.session_time,
        "participants": people,
        "anchors": msgspec.to_builtins(report.anchors),
        "cross_checks": checks,
    }


def format_alignment_status(report: StatusReport) -> list[str]:
    """Return one screen of printable lines."""
    return [to_printable(line) for line in _format_lines(report)]


def _format_lines(report: StatusReport) -> Iterator[str]:
    people = list_headsets(report)
    still = f"  STALLED for {report.authority_silent_ns * 1e-9:.1f} s" if report.stalled else ""
    yield f"session '{report.session_name}'  {len(people)} headsets  {len(report.anchors)} anchors{still}"
    yield ""
    yield (
        f"{'headset':20s} {'alignment':16s} {'version':>7s} {'age':>6s} {'at sheet':>9s} {'at robot':>9s} "
        f"{'obs.':>6s} {'places':>6s} {'tilt':>8s}  correction"
    )
    for p in people:
        yield from _format_headset(p)
    yield ""
    for anchor in report.anchors:
        x, y, z = anchor.T_world_anchor.p
        q = ",".join(f"{c:.5g}" for c in anchor.T_world_anchor.q)
        size = f", {anchor.size_m * 1e3:.0f} mm" if anchor.size_m > 0.0 else ""
        yield f"anchor '{anchor.anchor_id}': at {x:.4f}, {y:.4f}, {z:.4f} m, rotation {q}{size}"
    if not report.anchors:
        yield "this session has no anchors"
    names = {p.id: p.name for p in report.participants}
    for check in report.cross_checks:
        yield _format_cross_check(check, names)


def _format_headset(p: ParticipantReport) -> Iterator[str]:
    r = p.alignment_report
    name = f"{p.name} ({p.id})" if p.connected else f"{p.name} OFFLINE {p.lost}"
    if r is None:
        yield f"{name:20.20s} {p.alignment:16.16s}"
        return
    kind = p.alignment + (" + offset" if r.offset else "") + ("" if r.running else " STOPPED")
    aligned = p.alignment in (AlignmentKind.MEASURED, AlignmentKind.PLACED, *AlignmentKind.VIEW_ONLY)
    stated = aligned and p.alignment != AlignmentKind.PLACED and not r.offset
    at = [f"{m * 1e3:.1f} mm" if stated else "-" for m in (r.error_at_anchor_m, r.error_at_robot_m)]
    yield (
        f"{name:20.20s} {kind:16.16s} {r.version:7d} {format_duration(p.alignment_age_ns) if aligned else '-':>6s} "
        f"{at[0]:>9s} {at[1]:>9s} {r.observations:6d} {r.viewpoints:6d} {degrees(r.residual_tilt_rad):4.1f} deg  "
        f"{format_pending_correction(r)}"
    )
    if not aligned and p.alignment_void_ns >= 0:
        yield f"    void for {format_duration(p.alignment_void_ns)}: the tracking frame jumped"
    seen = sorted(r.seen, key=lambda one: one.age_ns)
    if seen:
        sheets = [
            f"{one.anchor_id} {one.observations} times, {format_duration(one.age_ns)} ago"
            for one in seen[:MAX_LISTED_SHEETS]
        ]
        more = f"; {len(seen) - MAX_LISTED_SHEETS} more" if len(seen) > MAX_LISTED_SHEETS else ""
        unusable = f"; {r.unusable} unusable" if r.unusable else ""
        yield f"    saw {'; '.join(sheets)}{more}{unusable}"
    elif r.unusable:
        yield f"    observed nothing usable, {r.unusable} times"
    if r.alarm:
        yield f"    ALARM {r.alarm}: off by {r.alarm_size_m * 1e3:.0f} mm, {format_duration(r.alarm_ns)} ago"
    if r.advice:
        yield f"    advice: {r.advice}"


def format_pending_correction(r: AlignmentReport) -> str:
    """Return the rest of a correction that is not yet in force."""
    if not (r.pending_m > 0.0 or r.pending_rad > 0.0):
        return "-"
    return f"{r.pending_m * 1e3:.1f} mm, {degrees(r.pending_rad):.2f} deg to go"


def _format_cross_check(check: CrossCheckReport, names: dict[str, str]) -> str:
    a, b = (f"{names[one]} ({one})" if one in names else one for one in (check.a, check.b))
    verdict = "" if is_consistent(check) else "  TOO FAR APART"
    return (
        f"{a} - {b}: {check.error_m * 1e3:.1f} mm, {degrees(check.error_rad):.2f} deg apart at '{check.anchor_id}', "
        f"95 % expected below {check.expected_p95_m * 1e3:.1f} mm; {check.n} observations, "
        f"{format_duration(check.age_ns)} ago{verdict}"
    )


def format_duration(duration_ns: int) -> str:
    """Return a duration as seconds or minutes."""
    seconds = duration_ns * 1e-9
    if seconds < 0.0:
        return "never"
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"


# --- solve ------------------------------------------------------------------------------------------------------------


#: Printed alignments and outliers per tracking frame; `--json` has all.
MAX_LISTED: Final = 12


def register_solve(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action `solve`."""
    one = add_command(
        actions,
        "solve",
        run_solve,
        help="solve the alignments of a recording again, and the poses of its sheets",
        description="Read every observation of a recording and solve alignments again, with the observations before "
        "and after each moment. Prints the error of each alignment that was in force, observations that contradict it, "
        "and sheets that were moved. With two or more sheets it also solves their relative poses, as a file for "
        "`serve --anchors`.",
        examples="""
            iris-session anchors solve sessions/20261121T093000.000000Z-lab/session.rrd
            iris-session anchors solve session.rrd --anchors anchors.toml --json
            iris-session anchors solve session.rrd --out anchors.toml
        """,
    )
    one.add_argument(
        "recording", type=Path, metavar="RECORDING", help="a .rrd file; later parts are found by their names"
    )
    one.add_argument(
        "--anchors", type=Path, metavar="TOML", help="true poses of the anchors (default: those of the session)"
    )
    one.add_argument("--out", type=Path, metavar="FILE", help="write the poses of the sheets, for `serve --anchors`")
    add_json_option(one)


def run_solve(arguments: argparse.Namespace) -> int:
    """Solve a recording and print the result. Exit status 1 if `--out` is given and there is nothing to write."""
    from iris_session.alignment.resolve import solve_relative_poses
    from iris_session.alignment.smoother import AnchorHistory
    from iris_session.recording import Recording, read_alignment_history
    from iris_session.session.config import load_anchors

    given = None if arguments.anchors is None else load_anchors(arguments.anchors)
    path: Path = arguments.recording
    with Recording.open(path, warn=False) as recording, ProgressLine(path) as progress:
        looks = read_alignment_history(recording, lambda done, total: progress.show(f"reading: {done} of {total}"))
        saved = _load_reference_anchors(recording, given)
        anchors = AnchorHistory(looks, dict(saved.anchors), given)
        results = _resolve_frames(looks, anchors, saved.sizes, progress)
        relative = solve_relative_poses(looks, replace(saved, anchors=anchors.last_poses))
        damage = recording.damage + recording.missing
    wanted = arguments.out is not None
    written = _write_constellation(arguments.out, relative) if wanted and relative.solved is not None else ""
    if arguments.json:
        print_json(solution_to_dict(str(path), looks, results, relative, damage, written))
    else:
        for line in format_solution(looks, results, relative, damage):
            print(to_printable(line))
        if written:
            print(f"written: {written}    use it: iris-session serve SCENE --anchors {written}")
    if wanted and not written:  # the results are printed nevertheless
        raise CommandError(f"{arguments.out} is not written: {relative.advice}", status=1)
    return 0


def _load_reference_anchors(recording: Recording, given: Constellation | None) -> Constellation:
    """Return the expected poses of the anchors: from the file, or else those at the start of the session."""
    from anchors.constellation import Constellation

    if given is not None:
        return given
    header = recording.header
    places: dict[str, PoseTuple] = {name: (pose.p, pose.q) for name, pose in header.anchors.items()}
    sizes = {} if header.settings is None else dict(header.settings.anchor_sizes)
    marks = {} if header.settings is None else dict(header.settings.anchor_marks)
    return Constellation(next(iter(places), ""), places, {}, sizes, marks)


def _resolve_frames(
    looks: AlignmentHistory, anchors: Any, sizes: dict[str, float], progress: ProgressLine
) -> list[FrameResult]:
    from iris_session.alignment.resolve import resolve_frame

    by_frame = {frame: [one for one in looks.in_force if one.frame == frame] for frame in looks.observations}
    done, total = count(1), sum(map(len, by_frame.values()))

    def advance() -> None:
        progress.show(f"solving: {next(done)} of {total}")

    return [
        resolve_frame(frame, every, by_frame[frame], anchors, sizes, advance)
        for frame, every in looks.observations.items()
    ]


def _write_constellation(path: Path, relative: RelativePoses) -> str:
    """Write the constellation as a file for `serve --anchors`. Return its path."""
    assert relative.solved is not None
    write_file(path, relative.solved.constellation.to_toml())
    return str(path)


# --- solve: text ------------------------------------------------------------------------------------------------------


def format_solution(
    looks: AlignmentHistory, results: list[FrameResult], relative: RelativePoses, damage: list[str]
) -> Iterator[str]:
    """Return lines about every headset, then the sheets, then damage."""
    wearers = [one for one in looks.participants.values() if one.aligned]
    if not wearers:
        yield "no participant of this recording had a headset to align"
    for person in wearers:
        own = [one for one in results if one.frame.participant == person.id]
        if not own:
            yield f"{person.name} ({person.id}): no observations"
        for result in own:
            yield from _format_frame(person, result)
    yield from _format_sheets(relative)
    if looks.unowned:
        yield f"{looks.unowned} observations of connections whose join is not in this recording"
    if looks.unreadable:
        yield f"{looks.unreadable} recorded messages cannot be decoded"
    yield from (f"damaged: {line}" for line in damage)


def _format_frame(person: RecordedParticipant, r: FrameResult) -> Iterator[str]:
    run = f", run {r.frame.run}" if len(person.runs) > 1 else ""
    run += f", after jump {r.frame.jumps}" if r.frame.jumps else ""
    sheets = ", ".join(f"{name} {n}" for name, n in sorted(r.sheets.items()))
    unused = "".join(f"; {n} {why}" for why, n in r.unused.items())
    yield (
        f"{person.name} ({person.id}), tracking epoch {r.frame.tracking_epoch}{run}: {r.looks} observations "
        f"from {r.viewpoints} places, {r.first_ns * 1e-9:.1f} to {r.last_ns * 1e-9:.1f} s ({sheets}){unused}"
    )
    if r.last.refused:
        yield f"    re-solved: refused, {r.last.advice}"
    else:
        tilt = math.degrees(r.last.residual_tilt_rad)
        advice = f"; {r.last.advice}" if r.last.advice else ""
        yield (
            f"    re-solved: {_format_mm(r.last.error_at_anchor_m)} at the sheet (95 %), tilt {tilt:.1f} deg{advice}"
        )
    if 2 * r.unused.get("against gravity", 0) > r.looks:
        yield "    most observations contradict gravity: the sheet is not oriented as configured (table or wall?)"
    yield from _limit_lines(
        [_format_comparison(one) for one in _select_worst(r.compared)], len(r.compared), "alignments"
    )
    outliers = [
        f"    outlier: '{o.anchor_id}' from place {o.viewpoint_id} at {o.at_ns * 1e-9:.1f} s, {o.looks} observations: "
        f"{_format_mm(o.off_m)}, {math.degrees(o.off_rad):.1f} deg off, "
        f"95 % expected below {_format_mm(o.expected_p95_m)}"
        for o in r.outliers
    ]
    yield from _limit_lines(outliers[:MAX_LISTED], len(outliers), "outliers")


def _select_worst(compared: list[LiveComparison]) -> list[LiveComparison]:
    """Return the alignments with the largest errors, in order of time."""
    kept = sorted(compared, key=lambda one: -max(one.off_m or 0.0, one.off_end_m or 0.0))[:MAX_LISTED]
    return sorted(kept, key=lambda one: one.live.since_ns)


def _limit_lines(shown: list[str], of: int, what: str) -> Iterator[str]:
    yield from shown
    if of > len(shown):
        yield f"    ... {of - len(shown)} more {what}, listed by --json"


def _format_comparison(one: LiveComparison) -> str:
    a, until = one.live.alignment, one.live.until_ns
    end = "the end" if until < 0 else f"{until * 1e-9:.1f} s"
    kind = a.kind + (" with offset" if a.offset else "")
    head = f"    version {a.version} ({kind}), {one.live.since_ns * 1e-9:.1f} s to {end}"
    if one.off_m is None or one.off_rad is None:
        return f"{head}: no observations to compare with"
    stated = "no error stated" if one.stated_m is None else f"stated {_format_mm(one.stated_m)}"
    at_end = "" if one.off_end_m is None else f", {_format_mm(one.off_end_m)} at its end"
    solved = "" if one.solved_m is None else f", re-solved {_format_mm(one.solved_m)}"
    beyond = "  EXCEEDS THE STATED ERROR" if one.is_beyond_stated else ""
    return f"{head}: {_format_mm(one.off_m)}, {math.degrees(one.off_rad):.2f} deg off{at_end}; {stated}{solved}{beyond}"


def _format_sheets(relative: RelativePoses) -> Iterator[str]:
    if relative.solved is None:
        yield f"relative poses of sheets: {relative.advice}"
        return
    c = relative.solved.constellation
    for name in sorted(c.anchors):
        (x, y, z), q = c.anchors[name]
        what = "reference" if name == c.reference else f"known to {_format_mm(c.error_m[name])} (95 %)"
        residual = relative.solved.residuals_m.get(name, 0.0)
        turned = ",".join(f"{v:.5g}" for v in q)
        yield (
            f"sheet '{name}': at {x:.4f}, {y:.4f}, {z:.4f} m, rotation {turned}; {what}, "
            f"observations scatter {_format_mm(residual)}"
        )
    for headset, epoch, viewpoint, name in relative.solved.rejected:
        participant = headset.split(" ")[0]
        yield f"excluded: '{name}' as observed by {participant} from place {viewpoint} in epoch {epoch}: inconsistent"
    for moved in relative.moved:
        yield (
            f"MOVED: sheet '{moved.anchor_id}' lies {_format_mm(moved.distance_m)}, "
            f"{math.degrees(moved.angle_rad):.1f} deg "
            "from its expected pose, relative to the others"
        )
    if relative.moved_advice:
        yield f"moved sheets: {relative.moved_advice}"


def _format_mm(metres: float) -> str:
    return f"{metres * 1e3:.1f} mm"


# --- solve: JSON ------------------------------------------------------------------------------------------------------


def solution_to_dict(
    path: str,
    looks: AlignmentHistory,
    results: list[FrameResult],
    relative: RelativePoses,
    damage: list[str],
    written: str,
) -> dict[str, Any]:
    """Return the object that `--json` prints."""
    people = [
        {
            **_pick(one, "id", "name", "role"),
            "frames": [_frame_to_dict(r) for r in results if r.frame.participant == one.id],
        }
        for one in looks.participants.values()
        if one.aligned
    ]
    return {
        "recording": path,
        "participants": people,
        "constellation": _constellation_to_dict(relative),
        "unowned": looks.unowned,
        "unreadable": looks.unreadable,
        "damage": damage,
        "out": written,
    }


def _frame_to_dict(r: FrameResult) -> dict[str, Any]:
    last = r.last
    return {
        **_pick(r.frame, "run", "tracking_epoch", "jumps"),
        **_pick(r, "looks", "viewpoints", "sheets", "unused"),
        "first_s": r.first_ns * 1e-9,
        "last_s": r.last_ns * 1e-9,
        **_pick(last, "refused", "advice", "residual_tilt_rad"),
        "T_world_tracking": None if last.refused else pose_to_dict(last.T_world_tracking),
        "error_at_anchor_m": None if last.refused else last.error_at_anchor_m,
        "alignments": [_alignment_to_dict(one) for one in r.compared],
        "outliers": [
            {
                **_pick(one, "anchor_id", "viewpoint_id", "looks", "off_m", "off_rad", "expected_p95_m"),
                "at_s": one.at_ns * 1e-9,
            }
            for one in r.outliers
        ],
    }


def _alignment_to_dict(one: LiveComparison) -> dict[str, Any]:
    until_ns = one.live.until_ns
    return {
        **_pick(one.live.alignment, "version", "kind", "offset"),
        "since_s": one.live.since_ns * 1e-9,
        "until_s": None if until_ns < 0 else until_ns * 1e-9,
        **_pick(one, "off_m", "off_rad", "off_end_m", "stated_m", "solved_m"),
        "beyond": one.is_beyond_stated,
    }


def _constellation_to_dict(relative: RelativePoses) -> dict[str, Any]:
    if relative.solved is None:
        return {"advice": relative.advice}
    c = relative.solved.constellation
    sheets = {
        name: {**pose_to_dict(pose), "error_m": c.error_m[name], "residual_m": relative.solved.residuals_m.get(name)}
        for name, pose in c.anchors.items()
    }
    return {
        "reference": c.reference,
        "anchors": sheets,
        "rejected": [list(one) for one in relative.solved.rejected],
        "moved": [_pick(one, "anchor_id", "distance_m", "angle_rad") for one in relative.moved],
        "advice": relative.moved_advice,
    }


def _pick(value: object, *names: str) -> dict[str, Any]:
    """Return some attributes of an object by their names."""
    return {name: getattr(value, name) for name in names}
