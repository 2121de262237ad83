"""`iris-session anchors`: print anchor sheets; show and set the alignment of headsets in a running session.

`anchors_solve` reads recordings, `calibrate` calibrates cameras.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from iris_session.cli import anchors_solve, calibrate
from iris_session.cli.common import (
    CommandError,
    Commands,
    add_actions,
    add_address_options,
    add_command,
    add_pose_option,
    find_participant,
    list_first,
    make_client,
    open_scene,
    parse_length,
    pick_attributes,
    print_json,
    print_result,
    write_file,
)
from iris_session.cli.status import add_watch_options, run_status_command
from iris_session.doctor.headset_checks import format_age, is_consistent
from iris_session.protocol.names import AlignAction, AlignmentKind, Role

if TYPE_CHECKING:
    from anchors.sheet import Sheet
    from iris_session.client import Client
    from iris_session.protocol.server_messages import ParticipantInfo
    from iris_session.protocol.status import CrossCheckReport, ParticipantReport, StatusReport

#: Edge of the code with marks where none is given: it must be smaller than the default sheet to fit on A4.
MARKED_SHEET_M: Final = 0.140
ALL_PARTICIPANTS: Final = "all"


def register(commands: Commands) -> None:
    actions = add_actions(
        commands,
        "anchors",
        help="print anchor sheets, align headsets, calibrate cameras",
        description="Print sheets that headsets and cameras detect, align headsets to them, and calibrate cameras.",
    )
    _register_print(actions)
    _register_example(actions)
    _register_status(actions)
    _register_align(actions)
    _register_place(actions)
    _register_move(actions)
    anchors_solve.register(actions)
    calibrate.register_camera(actions)


def _register_print(actions: Commands) -> None:
    one = add_command(
        actions,
        "print",
        run_print,
        help="write a sheet as PDF or SVG",
        description="Write a sheet of exact size: a QR code with the anchor's id between four markers that cameras "
        "detect from a distance, and a ruler to check the printed size. With --marks also four crosses, to be "
        "pricked and touched with a controller by devices that cannot read the code.",
        examples="""
            iris-session anchors print --size 150mm --id table --out table.pdf
            iris-session anchors print --id shelf --paper a3 --size 200mm
            iris-session anchors print --marks --out table.pdf
            iris-session anchors print --id table --measured 149.2mm
        """,
    )
    one.add_argument("--size", type=parse_length, metavar="LENGTH", help="edge of the QR code (150mm; --marks: 140mm)")
    one.add_argument("--marks", action="store_true", help="four crosses around the frame; a4 holds sizes up to 142mm")
    text = "edge of the printed code by a ruler: print the lines for the anchors file, write no sheet"
    one.add_argument("--measured", type=parse_length, metavar="LENGTH", help=text)
    _add_layout_option(one)
    one.add_argument("--id", default="table", metavar="NAME", help="id of the anchor (%(default)s)")
    one.add_argument("--paper", default="a4", metavar="PAPER", help="a5, a4, a3, a2, letter or tabloid (%(default)s)")
    one.add_argument("-o", "--out", type=Path, metavar="FILE", help="*.pdf or *.svg (default: NAME.pdf)")


def _register_example(actions: Commands) -> None:
    one = add_command(
        actions,
        "example",
        run_example,
        help="an anchors file to edit, for `serve --anchors`",
        description="Print the anchors of a scene as a file to edit. Pass it as `serve --anchors FILE`.",
        examples="""
            iris-session anchors example > anchors.toml
            iris-session anchors example handover
            iris-session anchors example --marks > anchors.toml
        """,
    )
    one.add_argument("scene", nargs="?", default="", help="a scene of `serve --help` (default: one sheet, `table`)")
    one.add_argument("--marks", action="store_true", help="of sheets with marks, as `print --marks` writes them")
    _add_layout_option(one)


def _add_layout_option(parser: argparse.ArgumentParser) -> None:
    text = "2: with the white around the code that headsets ask for; 1: as printed before"
    parser.add_argument("--layout", type=int, choices=(1, 2), default=2, help=text)


def _register_status(actions: Commands) -> None:
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


def _register_align(actions: Commands) -> None:
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
    text = "name or id, or `all` (%(default)s)"
    one.add_argument("participant", nargs="?", default=ALL_PARTICIPANTS, metavar="PARTICIPANT", help=text)
    add_address_options(one, option=True)


def _register_place(actions: Commands) -> None:
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


def _register_move(actions: Commands) -> None:
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


def run_print(arguments: argparse.Namespace) -> int:
    """Write the sheet, and print its size."""
    from anchors.sheet import HEADSET_MIN_EDGE_M, Sheet, SheetError
    from anchors.sheet_print import to_pdf, to_svg
    from iris_session.session.config import DEFAULT_SHEET_M

    out: Path = arguments.out or Path(re.sub(r"[^\w.-]+", "_", arguments.id) + ".pdf" if arguments.id else "sheet.pdf")
    if out.suffix.lower() not in (".pdf", ".svg"):
        raise CommandError(f"{out}: the file must end in .pdf or .svg")
    try:
        size_m = arguments.size or (MARKED_SHEET_M if arguments.marks else DEFAULT_SHEET_M)
        sheet = Sheet(arguments.id, arguments.measured or size_m, arguments.marks, arguments.layout)
        if arguments.measured:
            return _print_measured(arguments, sheet, size_m)
        drawn = to_pdf(sheet, arguments.paper) if out.suffix.lower() == ".pdf" else to_svg(sheet, arguments.paper)
    except SheetError as error:
        raise CommandError(str(error)) from error
    write_file(out, drawn)
    mm = f"{1e3 * sheet.edge_m:g} mm"
    lines = [
        f"{out}: anchor {sheet.anchor_id!r}, code {mm}, for {arguments.paper}",
        f"print at 100 % (not 'fit to page'). UNVERIFIED until you measure the code with a ruler: {mm} from edge to "
        "edge; what you measure: `anchors print --measured LENGTH`, or `size_m` in the anchors file",
        "tape the sheet down and draw its corners; a second sheet, 1 m away or more, shows when one has moved",
    ]
    if sheet.edge_m < HEADSET_MIN_EDGE_M:
        lines.append(f"for cameras: headsets read codes of {1e3 * HEADSET_MIN_EDGE_M:g} mm and more")
    if sheet.has_marks:
        lines += ["prick the crosses with a needle; the session must know them: lines for the anchors file", ""]
        lines += _list_file_lines(sheet)
    result = {"file": str(out), "id": sheet.anchor_id, "size_m": sheet.edge_m, "paper": arguments.paper}
    result |= {"layout": sheet.layout, "for_headsets": sheet.edge_m >= HEADSET_MIN_EDGE_M}
    result |= {"markers": sheet.marker_ids, "marker_edge_m": sheet.marker_edge_m, "marks_m": sheet.marks}
    return print_result(arguments, result, lines)


def _print_measured(arguments: argparse.Namespace, sheet: Sheet, size_m: float) -> int:
    """Print the lines of the anchors file for a sheet as it was measured. Raises `CommandError` for a misprint."""
    scale = sheet.edge_m / size_m - 1.0
    if abs(scale) > 0.05:  # it is no print of that sheet at 100 %
        raise CommandError(
            f"{1e3 * sheet.edge_m:g} mm is {scale:+.1%} off {1e3 * size_m:g} mm: print at 100 % again, or give the "
            "size that it was printed for by --size"
        )
    result = {"id": sheet.anchor_id, "size_m": sheet.edge_m, "printed_for_m": size_m, "marks_m": sheet.marks}
    return print_result(arguments, result, [f"[anchors.{json.dumps(sheet.anchor_id)}]", *_list_file_lines(sheet)])


def _list_file_lines(sheet: Sheet) -> list[str]:
    """Return the lines of the anchors file with size and marks of a sheet."""
    lines = [f"size_m = {sheet.edge_m:.6g}"]
    if sheet.has_marks:
        lines.append(f"[anchors.{json.dumps(sheet.anchor_id)}.marks_m]")
        lines += [f'"{name}" = [{", ".join(f"{c:.6g}" for c in p)}]' for name, p in sheet.marks.items()]
    return lines


def run_example(arguments: argparse.Namespace) -> int:
    """Print the anchors of a scene in the format of `serve --anchors`."""
    from anchors.sheet import compute_marks
    from iris_session.session.config import SessionConfig, dump_anchors

    config = SessionConfig()
    anchors, sizes = config.anchors, config.sheet_sizes()
    if arguments.scene:
        scene = open_scene(arguments.scene)
        anchors, sizes = scene.anchors, scene.anchor_sizes
    marks = {name: compute_marks(MARKED_SHEET_M, arguments.layout) for name in anchors if arguments.marks}
    text = dump_anchors(anchors, sizes | dict.fromkeys(marks, MARKED_SHEET_M), marks)
    if arguments.json:
        print_json({"toml": text})
    else:
        print(text, end="", flush=True)  # a file: names as they are
    return 0


# --- align, place, move -----------------------------------------------------------------------------------------------


def run_align(arguments: argparse.Namespace) -> int:
    """Start or stop runs. Exit status 1 if one of several participants was denied."""
    from iris_session.client import DeniedError

    done: list[dict[str, Any]] = []
    with make_client(arguments, Role.DIRECTOR, "anchors") as client:
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
    started = arguments.what == AlignAction.START
    outcome = "started: bring the sheets into view" if started else "stopped: alignment kept"
    lines = (f"{one['name']} ({one['id']}): {one['denied'] or outcome}" for one in done)
    return print_result(arguments, {"ok": ok, "action": arguments.what, "participants": done}, lines, ok=ok)


def run_place(arguments: argparse.Namespace) -> int:
    """Place the alignment of one participant."""
    with make_client(arguments, Role.DIRECTOR, "anchors") as client:
        one = find_participant(client, arguments.participant)
        client.alignment.place(one.id, arguments.pose, offset=arguments.offset)
    line = f"{one.name} ({one.id}) is {'moved by the offset' if arguments.offset else 'placed'}"
    result = {"ok": True, "participant": {"id": one.id, "name": one.name}, "offset": arguments.offset}
    return print_result(arguments, result, [line])


def run_move(arguments: argparse.Namespace) -> int:
    """Move an anchor, and list the alignments that follow it and those that do not."""
    from anchors.pose import distance

    with make_client(arguments, Role.DIRECTOR, "anchors") as client:
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
    by = "rotated" if moved_m == 0.0 else f"moved by {moved_m * 1e3:.0f} mm"
    first = f"anchor '{arguments.anchor}' {by}: {len(follow)} alignments measured to it follow"
    ids = {"follow": [p.id for p in follow], "stay": list(stay)}
    result = {"ok": True, "anchor": arguments.anchor, "moved_m": moved_m, **ids}
    return print_result(arguments, result, [first, *(f"    unchanged: {line}" for line in stay.values())])


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
    """Return the participant with an id or name, or all with a headset for `all`. Raises `CommandError`."""
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
    return run_status_command(arguments, to_dict, format_alignment_status)


def list_headsets(report: StatusReport) -> list[ParticipantReport]:
    """Return the participants that are aligned, or can be."""
    return [p for p in report.participants if p.alignment != AlignmentKind.NOT_NEEDED]


def to_dict(report: StatusReport) -> dict[str, Any]:
    """Return the object that `--json` prints; fields as in `StatusReport`."""
    kept = ("id", "name", "role", "connected", "tracking_epoch", "alignment", "alignment_age_ns", "alignment_void_ns")
    import msgspec

    people = [{**pick_attributes(p, *kept), "alignment_report": p.alignment_report} for p in list_headsets(report)]
    checks = [{**msgspec.to_builtins(one), "as_expected": is_consistent(one)} for one in report.cross_checks]
    return {
        "session": report.session_name,
        "session_time": report.session_time,
        "participants": people,
        "anchors": report.anchors,
        "cross_checks": checks,
        "unverified": report.unverified,
    }


def format_alignment_status(report: StatusReport) -> Iterator[str]:
    """Yield one screen of lines."""
    people = list_headsets(report)
    still = f"  STALLED for {report.authority_silent_ns * 1e-9:.1f} s" if report.stalled else ""
    yield f"session '{report.session_name}'  {len(people)} headsets  {len(report.anchors)} anchors{still}"
    yield ""
    yield (
        f"{'headset':20s} {'alignment':16s} {'version':>7s} {'age':>7s} {'at sheet':>9s} {'at robot':>9s} "
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
    for pair in report.unverified:
        who, other = names.get(pair.participant, pair.participant), names.get(pair.other, pair.other)
        yield f"{who} - {other}: UNVERIFIED: {other} has aligned by '{pair.anchor_id}' since {who} last saw it"


def _format_headset(p: ParticipantReport) -> Iterator[str]:
    r = p.alignment_report
    name = f"{p.name} ({p.id})" if p.connected else f"{p.name} OFFLINE {p.lost}"
    if r is None:
        yield f"{name:20.20s} {p.alignment:16.16s}"
        return
    kind = p.alignment + (" + offset" if r.offset else "") + ("" if r.running else " STOPPED")
    aligned = p.alignment in (AlignmentKind.MEASURED, AlignmentKind.PLACED, *AlignmentKind.VIEW_ONLY)
    stated = aligned and p.alignment != AlignmentKind.PLACED and not r.offset
    is_pending = r.pending_m > 0.0 or r.pending_rad > 0.0  # not yet in force
    correction = f"{r.pending_m * 1e3:.1f} mm, {degrees(r.pending_rad):.2f} deg to go" if is_pending else "-"
    at = [f"{m * 1e3:.1f} mm" if stated else "-" for m in (r.error_at_anchor_m, r.error_at_robot_m)]
    yield (
        f"{name:20.20s} {kind:16.16s} {r.version:7d} {format_age(p.alignment_age_ns) if aligned else '-':>7s} "
        f"{at[0]:>9s} {at[1]:>9s} {r.observations:6d} {r.viewpoints:6d} {degrees(r.residual_tilt_rad):4.1f} deg  "
        f"{correction}"
    )
    if r.doubt:
        yield f"    UNCONFIRMED ({r.doubt}): begins no engagement until a look at a sheet"
    if aligned and r.confirmed_ns >= 0:
        yield f"    confirmed {format_age(r.confirmed_ns)} ago"
    if not aligned and p.alignment_void_ns >= 0:
        yield f"    void for {format_age(p.alignment_void_ns)}: the tracking frame jumped"
    seen = sorted(r.seen, key=lambda one: one.age_ns)
    if seen:
        sheets = [f"{one.anchor_id} {one.observations} times, {format_age(one.age_ns)} ago" for one in seen]
        unusable = f"; {r.unusable} unusable" if r.unusable else ""
        yield f"    saw {'; '.join(list_first(sheets, most=8))}{unusable}"
    elif r.unusable:
        yield f"    observed nothing usable, {r.unusable} times"
    if r.alarm:
        yield f"    ALARM {r.alarm}: off by {r.alarm_size_m * 1e3:.0f} mm, {format_age(r.alarm_ns)} ago"
    if r.advice:
        yield f"    advice: {r.advice}"


def _format_cross_check(check: CrossCheckReport, names: dict[str, str]) -> str:
    a, b = (f"{names[one]} ({one})" if one in names else one for one in (check.a, check.b))
    verdict = "" if is_consistent(check) else "  TOO FAR APART"
    verdict = "  BEFORE ONE OF THEM WAS ALIGNED ELSEWHERE" if check.outdated else verdict
    turn = "" if check.touched else f", {degrees(check.error_rad):.2f} deg"
    how = "touched by both" if check.touched else f"{check.n} observations"
    return (
        f"{a} - {b}: {check.error_m * 1e3:.1f} mm{turn} apart at '{check.anchor_id}', "
        f"95 % expected below {check.expected_p95_m * 1e3:.1f} mm; {how}, {format_age(check.age_ns)} ago{verdict}"
    )
