"""`iris-session anchors`: print a sheet, an anchors file to edit, and where a camera stands.

What concerns sessions lies in `anchors_live` (one that runs) and `anchors_solve` (a recorded one).
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from contextlib import contextmanager
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from iris_session.cli.anchors_offline import register_calibrate, register_solve
from iris_session.cli.common import (
    CommandError,
    add_address_options,
    add_json_option,
    add_pose_option,
    check_session_reachable,
    open_scene,
    parse_length,
    print_json,
    to_printable,
)
from iris_session.cli.status import add_watch_options, open_status, watch_status
from iris_session.doctor.headset_checks import is_consistent
from iris_session.protocol.names import AlignAction, AlignmentKind

if TYPE_CHECKING:
    from iris_session.client import Client
    from iris_session.protocol.server_messages import ParticipantInfo
    from iris_session.protocol.status import AlignmentReport, CrossCheckReport, ParticipantReport, StatusReport


# --- anchors ---


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "anchors",
        help="print anchor sheets, align headsets, calibrate cameras",
        description="Sheets that headsets and cameras find in the room, how well headsets are aligned to them, and "
        "where cameras stand.",
        epilog="examples:\n"
        "  iris-session anchors print --size 160mm --id table --out table.pdf\n"
        "  iris-session anchors example > anchors.toml\n"
        "  iris-session anchors status --watch\n"
        "  iris-session anchors align start ann\n"
        "  iris-session anchors solve sessions/20261121T093000.000000Z-lab/session.rrd --out anchors.toml\n"
        "  iris-session anchors calibrate-camera pictures --sheet table=160mm --poses poses.csv\n"
        "  iris-session anchors calibrate-camera pictures --sheet table=160mm --at table=0,-0.45,0,1,0,0,0",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    _register_print(actions)
    _register_example(actions)
    _register_status(actions)
    _register_align(actions)
    _register_place(actions)
    _register_move(actions)
    register_solve(actions)
    register_calibrate(actions)


def _register_print(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    one = actions.add_parser(
        "print",
        help="write a sheet as PDF or SVG",
        description="Writes a sheet of exact size: a QR code with the anchor's id between four markers that cameras "
        "find from afar, and a ruler that shows whether the printer kept the size.",
    )
    one.add_argument("--size", type=parse_length, default=0.160, metavar="LENGTH", help="edge of the QR code (160mm)")
    one.add_argument("--id", default="table", metavar="NAME", help="id of the anchor (%(default)s)")
    one.add_argument("--paper", default="a4", metavar="PAPER", help="a5, a4, a3, a2, letter or tabloid (%(default)s)")
    one.add_argument("--out", type=Path, metavar="FILE", help="*.pdf or *.svg (default: NAME.pdf)")
    add_json_option(one)
    one.set_defaults(run=run_print)


def _register_example(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    one = actions.add_parser(
        "example",
        help="an anchors file to edit, for `serve --anchors`",
        description="Prints the anchors of a scene as a file ready to edit. Pass it as `serve --anchors FILE`.",
        epilog="examples:\n  iris-session anchors example > anchors.toml\n  iris-session anchors example handover",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    one.add_argument(
        "scene",
        nargs="?",
        default="",
        help="name of a scene (see `iris-session serve --help`); default: the usual sheet",
    )
    add_json_option(one)
    one.set_defaults(run=run_example)


def run_print(arguments: argparse.Namespace) -> int:
    from anchors.sheet import Sheet, SheetError
    from anchors.sheet_print import to_pdf, to_svg

    out: Path = arguments.out or Path(re.sub(r"[^\w.-]+", "_", arguments.id) + ".pdf" if arguments.id else "sheet.pdf")
    if out.suffix.lower() not in (".pdf", ".svg"):
        raise CommandError(f"{out}: the file must end in .pdf or .svg")
    try:
        sheet = Sheet(arguments.id, arguments.size)
        drawn = to_pdf(sheet, arguments.paper) if out.suffix.lower() == ".pdf" else to_svg(sheet, arguments.paper)
    except SheetError as error:
        raise CommandError(str(error)) from error
    try:
        out.write_bytes(drawn if isinstance(drawn, bytes) else drawn.encode())
    except OSError as error:
        raise CommandError(f"{out} cannot be written: {error.strerror}") from error
    if arguments.json:
        print_json(
            {
                "file": str(out),
                "id": sheet.anchor_id,
                "size_m": sheet.edge_m,
                "paper": arguments.paper,
                "markers": list(sheet.marker_ids),
                "marker_edge_m": sheet.marker_edge_m,
            }
        )
        return 0
    print(f"{out}: anchor {sheet.anchor_id!r}, code {1e3 * sheet.edge_m:g} mm, for {arguments.paper}")
    print(f"print at 100 % (not 'fit to page'), then measure the code: {1e3 * sheet.edge_m:g} mm from edge to edge")
    return 0


def run_example(arguments: argparse.Namespace) -> int:
    """Prints what the scene has, in the form that `serve --anchors` reads."""
    from iris_session.session.anchors_file import dump_anchors
    from iris_session.session.config import SessionConfig

    config = SessionConfig()
    anchors, sizes = config.anchors, config.sheet_sizes()
    if arguments.scene:
        scene = open_scene(arguments.scene)
        anchors, sizes = scene.anchors, scene.anchor_sizes
    text = dump_anchors(anchors, sizes)
    if arguments.json:
        print_json({"toml": text})
    else:
        print(text, end="")
    return 0


# --- anchors_live ---


ALL_PARTICIPANTS: Final = "all"
#: Sheets that are told of per headset, those seen last first.
MAX_LISTED_SHEETS: Final = 8


def _register_status(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    one = actions.add_parser(
        "status",
        help="how well the headsets of a running session are aligned",
        description="Joins as an observer, asks, and prints for every headset what its alignment rests on, then the "
        "anchors, and how far apart pairs of headsets put the same thing.",
        epilog="examples:\n"
        "  iris-session anchors status\n"
        "  iris-session anchors status 192.168.1.20 --watch\n"
        "  iris-session anchors status --json",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_address_options(one)
    add_watch_options(one, one)
    add_json_option(one)
    one.set_defaults(run=run_status)


def _register_align(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    one = actions.add_parser(
        "align",
        help="start or stop measuring the alignment of headsets",
        description="`start` measures anew, from nothing; `stop` keeps what is in force, whatever is seen from then "
        "on. Until there is a better one the present alignment stays. Joins as a director.",
        epilog="examples:\n"
        "  iris-session anchors align start                   everybody with a headset\n"
        "  iris-session anchors align start ann\n"
        "  iris-session anchors align stop p3 --address 192.168.1.20",
        formatter_class=argparse.RawDescriptionHelpFormatter,
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
    one.set_defaults(run=run_align)


def _register_place(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    one = actions.add_parser(
        "place",
        help="align a headset by hand",
        description="Says where the tracking frame of a headset is, T_world_tracking, or with --offset by how much the "
        "measured one is to be moved, which voids its stated error. Joins as a director.",
        epilog="examples:\n"
        "  iris-session anchors place ann --pose 0.4,0,0,1,0,0,0\n"
        "  iris-session anchors place ann --offset --pose -0.01,0,0,1,0,0,0",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    one.add_argument("participant", metavar="PARTICIPANT", help="name or id")
    add_pose_option(one, "T_world_tracking, or the offset in the world")
    one.add_argument("--offset", action="store_true", help="on top of the measured alignment")
    add_address_options(one, option=True)
    add_json_option(one)
    one.set_defaults(run=run_place)


def _register_move(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    one = actions.add_parser(
        "move",
        help="say where an anchor of the session is",
        description="Changes T_world_anchor: the shared scene moves for everybody who is aligned to that anchor by "
        "what is measured. Further than 5 m only with --force. Joins as a director.",
        epilog="examples:\n"
        "  iris-session anchors move table --pose 0,-0.45,0,1,0,0,0\n"
        "  iris-session anchors move table --pose -0.2,0.1,0,0.7071068,0,0,0.7071068",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    one.add_argument("anchor", metavar="ANCHOR", help="id of the anchor, see `anchors status`")
    add_pose_option(one, "T_world_anchor")
    one.add_argument("--force", action="store_true", help="also further than 5 m from where it is")
    add_address_options(one, option=True)
    add_json_option(one)
    one.set_defaults(run=run_move)


# --- what a director says ---------------------------------------------------------------------------------------------


@contextmanager
def join_as_director(arguments: argparse.Namespace) -> Iterator[Client]:
    """A director in the session that is meant."""
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
    """Exit status 1 when it was denied for one of several."""
    from iris_session.client import DeniedError

    done: list[dict[str, Any]] = []
    with join_as_director(arguments) as client:
        people = select_participants(client, arguments.participant)
        for person in people:
            denied = ""
            try:
                client.align(arguments.what, person.id)
            except DeniedError as error:
                if len(people) == 1:
                    raise
                denied = str(error)
            done.append({"id": person.id, "name": person.name, "denied": denied})
    ok = not any(one["denied"] for one in done)
    if arguments.json:
        print_json({"ok": ok, "action": arguments.what, "participants": done})
        return 0 if ok else 1
    word = "started: look at the sheets" if arguments.what == AlignAction.START else "stopped: the alignment stays"
    for one in done:
        print(to_printable(f"{one['name']} ({one['id']}): {one['denied'] or word}"))
    return 0 if ok else 1


def run_place(arguments: argparse.Namespace) -> int:
    with join_as_director(arguments) as client:
        (one,) = select_participants(client, arguments.participant, allow_all=False)
        client.place_alignment(one.id, arguments.pose, offset=arguments.offset)
    if arguments.json:
        print_json({"ok": True, "participant": {"id": one.id, "name": one.name}, "offset": arguments.offset})
    else:
        print(to_printable(f"{one.name} ({one.id}) is {'moved by the offset' if arguments.offset else 'placed'}"))
    return 0


def run_move(arguments: argparse.Namespace) -> int:
    """Whoever is not measured, or no more, is told of: their alignments stay."""
    from anchors.pose import distance

    with join_as_director(arguments) as client:
        report = client.status()
        was = next((one.T_world_anchor.p for one in report.anchors if one.anchor_id == arguments.anchor), None)
        away_m = 0.0 if was is None else distance(was, arguments.pose[0])  # one that is not known is denied
        client.move_anchor(arguments.anchor, arguments.pose, force=arguments.force)
    aligned = [p for p in list_headsets(report) if p.alignment in (AlignmentKind.MEASURED, AlignmentKind.PLACED)]
    stay = {
        p.id: f"{p.name} ({p.id}): {why}" for p in aligned if (why := explain_unaffected_alignment(p, arguments.anchor))
    }
    follow = [p for p in aligned if p.id not in stay]
    if arguments.json:
        ids = {"follow": [p.id for p in follow], "stay": list(stay)}
        print_json({"ok": True, "anchor": arguments.anchor, "moved_m": away_m, **ids})
        return 0
    by = "turned" if away_m == 0.0 else f"moved by {away_m * 1e3:.0f} mm"
    print(to_printable(f"anchor '{arguments.anchor}' {by}: alignments that are measured to it follow ({len(follow)})"))
    for line in stay.values():
        print(to_printable(f"    not that of {line}"))
    return 0


def explain_unaffected_alignment(p: ParticipantReport, anchor: str) -> str:
    """Why an alignment does not follow an anchor that is moved; empty: it does."""
    r = p.alignment_report
    if r is not None and not r.running:
        return f"its run is stopped; `iris-session anchors align start {p.id}`"
    if p.alignment == AlignmentKind.PLACED:
        return f"a director placed it; `iris-session anchors align start {p.id}` measures it"
    if r is None or not p.connected or anchor not in {one.anchor_id for one in r.seen}:
        return f"it has not looked at '{anchor}' since it came; it follows when it does"
    return ""


def select_participants(client: Client, name: str, *, allow_all: bool = True) -> list[ParticipantInfo]:
    """Who is meant by an id, a name, or `all`. Raises `CommandError` that lists who could be."""
    people = sorted(client.mirror.participants.values(), key=lambda one: (len(one.id), one.id))
    headsets = [one for one in people if one.alignment is None or one.alignment.kind != AlignmentKind.NOT_NEEDED]
    there = ", ".join(f"{one.name} ({one.id})" for one in headsets) or "nobody"
    found = [one for one in people if one.id == name] or [one for one in people if one.name == name]
    if not found and name == ALL_PARTICIPANTS and allow_all:
        found = [one for one in headsets if one.connected]
        if not found:
            raise CommandError("nobody in this session has a headset that is aligned", status=1)
        return found
    if not found:
        raise CommandError(to_printable(f"no participant is called '{name}'; with a headset: {there}"))
    if len(found) > 1:
        ids = ", ".join(f"{one.id} ({one.role}{'' if one.connected else ', lost'})" for one in found)
        raise CommandError(to_printable(f"{len(found)} participants are called '{name}', give an id: {ids}"))
    return found


# --- how it stands ----------------------------------------------------------------------------------------------------


def run_status(arguments: argparse.Namespace) -> int:
    """Prints the alignment of everybody; with --watch until Ctrl-C."""
    with open_status(arguments) as (client, report):
        if arguments.watch:
            return watch_status(client, arguments.period, print_alignment_status, as_json=arguments.json)
        print_alignment_status(report, as_json=arguments.json)
    return 0


def print_alignment_status(report: StatusReport, *, as_json: bool) -> None:
    if as_json:
        print_json(to_dict(report))
    else:
        print("\n".join(format_alignment_status(report)), flush=True)


def list_headsets(report: StatusReport) -> list[ParticipantReport]:
    """Those who are, or are to be, aligned."""
    return [p for p in report.participants if p.alignment != AlignmentKind.NOT_NEEDED]


def to_dict(report: StatusReport) -> dict[str, Any]:
    """For `--json`: fields as in `StatusReport`."""
    import msgspec

    kept = ("id", "name", "role", "connected", "tracking_epoch", "alignment", "alignment_age_ns", "alignment_void_ns")
    people = [
        {**{name: getattr(p, name) for name in kept}, "alignment_report": msgspec.to_builtins(p.alignment_report)}
        for p in list_headsets(report)
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
    """One screen of printable lines."""
    return [to_printable(line) for line in _format_lines(report)]


def _format_lines(report: StatusReport) -> Iterator[str]:
    people = list_headsets(report)
    still = f"  STANDS STILL since {report.authority_silent_ns * 1e-9:.1f} s" if report.stalled else ""
    yield f"session '{report.session_name}'  {len(people)} headsets  {len(report.anchors)} anchors{still}"
    yield ""
    yield (
        f"{'headset':20s} {'alignment':16s} {'version':>7s} {'age':>6s} {'at sheet':>9s} {'at robot':>9s} "
        f"{'looks':>6s} {'places':>6s} {'tilt':>8s}  correction"
    )
    for p in people:
        yield from _format_headset(p)
    yield ""
    for anchor in report.anchors:
        x, y, z = anchor.T_world_anchor.p
        q = ",".join(f"{c:.5g}" for c in anchor.T_world_anchor.q)
        size = f", {anchor.size_m * 1e3:.0f} mm" if anchor.size_m > 0.0 else ""
        yield f"anchor '{anchor.anchor_id}': at {x:.4f}, {y:.4f}, {z:.4f} m, turned {q}{size}"
    if not report.anchors:
        yield "this session has no anchors"
    names = {p.id: p.name for p in report.participants}
    for check in report.cross_checks:
        yield _format_cross_check(check, names)


def _format_headset(p: ParticipantReport) -> Iterator[str]:
    r = p.alignment_report
    name = f"{p.name} ({p.id})" if p.connected else f"{p.name} LOST {p.lost}"
    if r is None:
        yield f"{name:20.20s} {p.alignment:16.16s}"
        return
    kind = p.alignment + (" + offset" if r.offset else "") + ("" if r.running else " STOPPED")
    aligned = p.alignment in (AlignmentKind.MEASURED, AlignmentKind.PLACED)
    stated = aligned and p.alignment == AlignmentKind.MEASURED and not r.offset
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
        told = [
            f"{one.anchor_id} {one.observations} times, {format_duration(one.age_ns)} ago"
            for one in seen[:MAX_LISTED_SHEETS]
        ]
        more = f"; {len(seen) - MAX_LISTED_SHEETS} more" if len(seen) > MAX_LISTED_SHEETS else ""
        unusable = f"; {r.unusable} of no use" if r.unusable else ""
        yield f"    saw {'; '.join(told)}{more}{unusable}"
    elif r.unusable:
        yield f"    saw nothing of use, {r.unusable} times"
    if r.alarm:
        yield f"    ALARM {r.alarm}: off by {r.alarm_size_m * 1e3:.0f} mm, {format_duration(r.alarm_ns)} ago"
    if r.advice:
        yield f"    advice: {r.advice}"


def format_pending_correction(r: AlignmentReport) -> str:
    """A correction that waits or slides in."""
    if not (r.pending_m > 0.0 or r.pending_rad > 0.0):
        return "-"
    return f"{r.pending_m * 1e3:.1f} mm, {degrees(r.pending_rad):.2f} deg to go"


def _format_cross_check(check: CrossCheckReport, names: dict[str, str]) -> str:
    a, b = (f"{names[one]} ({one})" if one in names else one for one in (check.a, check.b))
    verdict = "" if is_consistent(check) else "  TOO FAR APART"
    return (
        f"{a} - {b}: {check.error_m * 1e3:.1f} mm, {degrees(check.error_rad):.2f} deg apart at '{check.anchor_id}', "
        f"95 % expected below {check.expected_p95_m * 1e3:.1f} mm; {check.n} looks, "
        f"{format_duration(check.age_ns)} ago{verdict}"
    )


def format_duration(duration_ns: int) -> str:
    """How long ago, as people say it."""
    seconds = duration_ns * 1e-9
    if seconds < 0.0:
        return "never"
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"
