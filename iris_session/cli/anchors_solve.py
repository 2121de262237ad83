"""`iris-session anchors solve`: the alignments of a recording solved again, and the poses of its sheets."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from anchors.pose import pose_to_dict
from iris_session.cli.common import (
    CommandError,
    Commands,
    add_command,
    list_first,
    pick_attributes,
    print_result,
    write_file,
)
from iris_session.cli.progress import ProgressLine

if TYPE_CHECKING:
    from anchors.constellation import Constellation
    from anchors.pose import PoseTuple
    from iris_session.alignment.resolve import FrameResult, LiveComparison, RelativePoses
    from iris_session.recording import AlignmentHistory, RecordedParticipant, Recording


def register(actions: Commands) -> None:
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
    one.add_argument("recording", type=Path, metavar="RECORDING", help="a .rrd file; its later parts are found, too")
    one.add_argument("--anchors", type=Path, metavar="TOML", help="true poses of anchors (default: the session's)")
    one.add_argument("--out", type=Path, metavar="FILE", help="write the poses of the sheets, for `serve --anchors`")


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
    written = ""
    if arguments.out is not None and relative.solved is not None:
        write_file(arguments.out, relative.solved.constellation.to_toml())
        written = str(arguments.out)
    lines = [*format_solution(looks, results, relative, damage)]
    if written:
        lines.append(f"written: {written}    use it: iris-session serve SCENE --anchors {written}")
    print_result(arguments, solution_to_dict(str(path), looks, results, relative, damage, written), lines)
    if arguments.out is not None and not written:  # the results are printed nevertheless
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


# --- text -------------------------------------------------------------------------------------------------------------


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
    worst_first = sorted(r.compared, key=lambda one: -max(one.off_m or 0.0, one.off_end_m or 0.0))
    compared = [_format_comparison(one) for one in worst_first]
    outliers = [
        f"outlier: '{o.anchor_id}' from place {o.viewpoint_id} at {o.at_ns * 1e-9:.1f} s, {o.looks} observations: "
        f"{_format_mm(o.off_m)}, {math.degrees(o.off_rad):.1f} deg off, "
        f"95 % expected below {_format_mm(o.expected_p95_m)}"
        for o in r.outliers
    ]
    yield from (f"    {line}" for lines in (compared, outliers) for line in list_first(lines, most=12))


def _format_comparison(one: LiveComparison) -> str:
    a, until = one.live.alignment, one.live.until_ns
    end = "the end" if until < 0 else f"{until * 1e-9:.1f} s"
    kind = a.kind + (" with offset" if a.offset else "")
    head = f"version {a.version} ({kind}), {one.live.since_ns * 1e-9:.1f} s to {end}"
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


# --- JSON -------------------------------------------------------------------------------------------------------------


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
            **pick_attributes(one, "id", "name", "role"),
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
        **pick_attributes(r.frame, "run", "tracking_epoch", "jumps"),
        **pick_attributes(r, "looks", "viewpoints", "sheets", "unused"),
        "first_s": r.first_ns * 1e-9,
        "last_s": r.last_ns * 1e-9,
        **pick_attributes(last, "refused", "advice", "residual_tilt_rad"),
        "T_world_tracking": None if last.refused else pose_to_dict(last.T_world_tracking),
        "error_at_anchor_m": None if last.refused else last.error_at_anchor_m,
        "alignments": [_alignment_to_dict(one) for one in r.compared],
        "outliers": [
            {
                **pick_attributes(one, "anchor_id", "viewpoint_id", "looks", "off_m", "off_rad", "expected_p95_m"),
                "at_s": one.at_ns * 1e-9,
            }
            for one in r.outliers
        ],
    }


def _alignment_to_dict(one: LiveComparison) -> dict[str, Any]:
    until_ns = one.live.until_ns
    return {
        **pick_attributes(one.live.alignment, "version", "kind", "offset"),
        "since_s": one.live.since_ns * 1e-9,
        "until_s": None if until_ns < 0 else until_ns * 1e-9,
        **pick_attributes(one, "off_m", "off_rad", "off_end_m", "stated_m", "solved_m"),
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
        "moved": [pick_attributes(one, "anchor_id", "distance_m", "angle_rad") for one in relative.moved],
        "advice": relative.moved_advice,
    }
