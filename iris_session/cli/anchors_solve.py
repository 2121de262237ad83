"""`iris-session anchors solve`: alignments of a recorded session solved again with everything that was seen, and where
its sheets lie relative to each other."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from iris_session.cli.common import CommandError, add_json, print_json
from iris_session.cli.live import printable

if TYPE_CHECKING:
    from anchors.constellation import Constellation
    from anchors.pose import PoseTuple
    from iris_session.alignment.resolve import Compared, Relative, Result
    from iris_session.recording import Looks, Person, Recording

#: Lines about alignments and outliers per tracking frame; `--json` has all.
MAX_SHOWN: Final = 12


def register_solve(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    one = actions.add_parser(
        "solve",
        help="solve the alignments of a recording again, and where its sheets lie",
        description="Reads every observation of a recording and solves alignments again, with what was seen before and "
        "after each moment: how far off was each alignment that was in force, which looks contradict it, which sheets "
        "were moved. With two or more sheets also where they lie to each other, as a file for `serve --anchors`.",
        epilog="examples:\n"
        "  iris-session anchors solve sessions/20261121T093000.000000Z-lab/session.rrd\n"
        "  iris-session anchors solve session.rrd --anchors anchors.toml --json\n"
        "  iris-session anchors solve session.rrd --out anchors.toml",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    one.add_argument(
        "recording", type=Path, metavar="RECORDING", help="a .rrd file; later parts are found by their names"
    )
    one.add_argument(
        "--anchors", type=Path, metavar="TOML", help="where the anchors really were (default: as the session had them)"
    )
    one.add_argument("--out", type=Path, metavar="FILE", help="write where the sheets lie, for `serve --anchors`")
    add_json(one)
    one.set_defaults(run=run_solve)


def run_solve(arguments: argparse.Namespace) -> int:
    """Exit status 1 when `--out` was asked for and nothing can be written."""
    from iris_session.alignment.resolve import constellation
    from iris_session.alignment.smoother import Anchors
    from iris_session.recording import Recording, read_looks
    from iris_session.session.anchors_file import load_anchors

    given = None if arguments.anchors is None else load_anchors(arguments.anchors)
    with Recording.open(arguments.recording, warn=False) as recording:
        looks = read_looks(recording, progress("reading"))
        saved = _saved(recording, given)
        anchors = Anchors(looks, dict(saved.anchors), given)
        results = _resolved(looks, anchors, saved.sizes)
        relative = constellation(looks, _with(saved, anchors.last))
        damage = recording.damage + recording.missing
    wanted = arguments.out is not None
    written = _write(arguments.out, relative) if wanted and relative.solved is not None else ""
    if arguments.json:
        print_json(as_dict(str(arguments.recording), looks, results, relative, damage, written))
    else:
        for line in lines(looks, results, relative, damage):
            print(printable(line))
        if written:
            print(f"written: {written}    use it: iris-session serve SCENE --anchors {written}")
    if wanted and not written:  # after what was found out all the same
        raise CommandError(f"{arguments.out} is not written: {relative.advice}", status=1)
    return 0


def progress(what: str) -> Callable[[int, int], None] | None:
    """Shows how far it is, on a terminal."""
    if not sys.stderr.isatty():
        return None

    def show(done: int, total: int) -> None:
        end = "" if done < total else "\n"
        print(f"\r{what}: {done} of {total}", end=end, file=sys.stderr, flush=True)

    return show


def _saved(recording: Recording, given: Constellation | None) -> Constellation:
    """Where the anchors ought to be: the file, else as the session had them when it began."""
    from anchors.constellation import Constellation

    if given is not None:
        return given
    header = recording.header
    places: dict[str, PoseTuple] = {name: (pose.p, pose.q) for name, pose in header.anchors.items()}
    sizes = {} if header.settings is None else dict(header.settings.anchor_sizes)
    return Constellation(next(iter(places), ""), places, {}, sizes)


def _with(saved: Constellation, anchors: dict[str, PoseTuple]) -> Constellation:
    from anchors.constellation import Constellation

    return Constellation(saved.reference, anchors, saved.error_m, saved.sizes)


def _resolved(looks: Looks, anchors: Any, sizes: dict[str, float]) -> list[Result]:
    from iris_session.alignment.resolve import resolve

    by_frame = {frame: [one for one in looks.in_force if one.frame == frame] for frame in looks.looks}
    total = sum(map(len, by_frame.values()))
    show, done = progress("solving"), 0
    results = []

    def told() -> None:
        nonlocal done
        done += 1
        if show is not None:
            show(done, total)

    for frame, every in looks.looks.items():
        results.append(resolve(frame, every, by_frame[frame], anchors, sizes, told))
    return results


def _write(path: Path, relative: Relative) -> str:
    """The constellation as a file for `serve --anchors`."""
    assert relative.solved is not None
    try:
        path.write_text(relative.solved.constellation.to_toml(), encoding="utf-8")
    except OSError as error:
        raise CommandError(f"{path} cannot be written: {error.strerror}") from error
    return str(path)


# --- as text ----------------------------------------------------------------------------------------------------------


def lines(looks: Looks, results: list[Result], relative: Relative, damage: list[str]) -> Iterator[str]:
    """Everybody who was to be aligned, then the sheets, then what could not be read."""
    wearers = [one for one in looks.people.values() if one.aligned]
    if not wearers:
        yield "nobody in this recording had a headset to be aligned"
    for person in wearers:
        own = [one for one in results if one.frame.participant == person.id]
        if not own:
            yield f"{person.name} ({person.id}): no observations"
        for result in own:
            yield from _result(person, result)
    yield from _relative(relative)
    if looks.unowned:
        yield f"{looks.unowned} observations over connections whose join is not in this recording"
    if looks.unreadable:
        yield f"{looks.unreadable} recorded messages do not decode"
    yield from (f"damaged: {line}" for line in damage)


def _result(person: Person, r: Result) -> Iterator[str]:
    run = f", run {r.frame.run}" if len(person.runs) > 1 else ""
    run += f", after jump {r.frame.jumps}" if r.frame.jumps else ""
    sheets = ", ".join(f"{name} {n}" for name, n in sorted(r.sheets.items()))
    unused = "".join(f"; {n} {why}" for why, n in r.unused.items())
    yield (
        f"{person.name} ({person.id}), tracking epoch {r.frame.tracking_epoch}{run}: {r.looks} looks from "
        f"{r.viewpoints} places, {r.first_ns * 1e-9:.1f} to {r.last_ns * 1e-9:.1f} s ({sheets}){unused}"
    )
    if r.last.refused:
        yield f"    solved again: refused, {r.last.advice}"
    else:
        tilt = math.degrees(r.last.residual_tilt_rad)
        advice = f"; {r.last.advice}" if r.last.advice else ""
        yield f"    solved again: {_mm(r.last.error_at_anchor_m)} at the sheet (95 %), tilt {tilt:.1f} deg{advice}"
    if 2 * r.unused.get("against gravity", 0) > r.looks:
        yield "    most looks contradict the vertical: the sheet does not lie as configured (on the table, on a wall?)"
    yield from _shown([_compared(one) for one in _worst(r.compared)], len(r.compared), "alignments")
    told = [
        f"    outlier: '{o.anchor_id}' from place {o.viewpoint_id} at {o.at_ns * 1e-9:.1f} s, {o.looks} looks: "
        f"{_mm(o.off_m)}, {math.degrees(o.off_rad):.1f} deg off, 95 % expected below {_mm(o.expected_p95_m)}"
        for o in r.outliers
    ]
    yield from _shown(told[:MAX_SHOWN], len(told), "outliers")


def _worst(compared: list[Compared]) -> list[Compared]:
    """The worst of them, in order of time."""
    kept = sorted(compared, key=lambda one: -max(one.off_m or 0.0, one.off_end_m or 0.0))[:MAX_SHOWN]
    return sorted(kept, key=lambda one: one.live.since_ns)


def _shown(shown: list[str], of: int, what: str) -> Iterator[str]:
    yield from shown
    if of > len(shown):
        yield f"    ... {of - len(shown)} more {what}, which --json lists"


def _compared(one: Compared) -> str:
    a, until = one.live.alignment, one.live.until_ns
    end = "the end" if until < 0 else f"{until * 1e-9:.1f} s"
    kind = a.kind + (" with offset" if a.offset else "")
    head = f"    version {a.version} ({kind}), {one.live.since_ns * 1e-9:.1f} s to {end}"
    if one.off_m is None or one.off_rad is None:
        return f"{head}: nothing to compare with"
    stated = "nothing stated" if one.stated_m is None else f"stated {_mm(one.stated_m)}"
    at_end = "" if one.off_end_m is None else f", {_mm(one.off_end_m)} at its end"
    solved = "" if one.solved_m is None else f", solved again {_mm(one.solved_m)}"
    beyond = "  BEYOND WHAT WAS STATED" if one.beyond else ""
    return f"{head}: {_mm(one.off_m)}, {math.degrees(one.off_rad):.2f} deg off{at_end}; {stated}{solved}{beyond}"


def _relative(relative: Relative) -> Iterator[str]:
    if relative.solved is None:
        yield f"sheets to each other: {relative.advice}"
        return
    c = relative.solved.constellation
    for name in sorted(c.anchors):
        (x, y, z), q = c.anchors[name]
        what = "reference" if name == c.reference else f"known to {_mm(c.error_m[name])} (95 %)"
        residual = relative.solved.residuals_m.get(name, 0.0)
        turned = ",".join(f"{v:.5g}" for v in q)
        yield f"sheet '{name}': at {x:.4f}, {y:.4f}, {z:.4f} m, turned {turned}; {what}, looks scatter {_mm(residual)}"
    for headset, epoch, viewpoint, name in relative.solved.rejected:
        participant = headset.split(" ")[0]
        yield f"left out: '{name}' as {participant} saw it from place {viewpoint} in epoch {epoch}, it fits nowhere"
    for moved in relative.moved:
        yield (
            f"MOVED: sheet '{moved.anchor_id}' lies {_mm(moved.distance_m)}, {math.degrees(moved.angle_rad):.1f} deg "
            "from where it ought to, as seen from the others"
        )
    if relative.unsaid:
        yield f"moved sheets: {relative.unsaid}"


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.1f} mm"


# --- as JSON ----------------------------------------------------------------------------------------------------------


def as_dict(
    path: str, looks: Looks, results: list[Result], relative: Relative, damage: list[str], written: str
) -> dict[str, Any]:
    """For `--json`."""
    people = [
        {
            "id": one.id,
            "name": one.name,
            "role": one.role,
            "frames": [_frame(r) for r in results if r.frame.participant == one.id],
        }
        for one in looks.people.values()
        if one.aligned
    ]
    return {
        "recording": path,
        "participants": people,
        "constellation": _constellation(relative),
        "unowned": looks.unowned,
        "unreadable": looks.unreadable,
        "damage": damage,
        "out": written,
    }


def _frame(r: Result) -> dict[str, Any]:
    return {
        "run": r.frame.run,
        "tracking_epoch": r.frame.tracking_epoch,
        "jumps": r.frame.jumps,
        "looks": r.looks,
        "viewpoints": r.viewpoints,
        "sheets": r.sheets,
        "first_s": r.first_ns * 1e-9,
        "last_s": r.last_ns * 1e-9,
        "unused": r.unused,
        "refused": r.last.refused,
        "advice": r.last.advice,
        "T_world_tracking": None if r.last.refused else _pose(r.last.T_world_tracking),
        "error_at_anchor_m": None if r.last.refused else r.last.error_at_anchor_m,
        "residual_tilt_rad": r.last.residual_tilt_rad,
        "alignments": [_alignment(one) for one in r.compared],
        "outliers": [
            {
                "anchor_id": o.anchor_id,
                "viewpoint_id": o.viewpoint_id,
                "looks": o.looks,
                "off_m": o.off_m,
                "off_rad": o.off_rad,
                "expected_p95_m": o.expected_p95_m,
                "at_s": o.at_ns * 1e-9,
            }
            for o in r.outliers
        ],
    }


def _alignment(one: Compared) -> dict[str, Any]:
    a, until = one.live.alignment, one.live.until_ns
    return {
        "version": a.version,
        "kind": a.kind,
        "offset": a.offset,
        "since_s": one.live.since_ns * 1e-9,
        "until_s": None if until < 0 else until * 1e-9,
        "off_m": one.off_m,
        "off_rad": one.off_rad,
        "off_end_m": one.off_end_m,
        "stated_m": one.stated_m,
        "solved_m": one.solved_m,
        "beyond": one.beyond,
    }


def _constellation(relative: Relative) -> dict[str, Any]:
    if relative.solved is None:
        return {"advice": relative.advice}
    c = relative.solved.constellation
    sheets = {
        name: {**_pose(pose), "error_m": c.error_m[name], "residual_m": relative.solved.residuals_m.get(name)}
        for name, pose in c.anchors.items()
    }
    moved = [{"anchor_id": m.anchor_id, "distance_m": m.distance_m, "angle_rad": m.angle_rad} for m in relative.moved]
    return {
        "reference": c.reference,
        "anchors": sheets,
        "rejected": [list(one) for one in relative.solved.rejected],
        "moved": moved,
        "advice": relative.unsaid,
    }


def _pose(pose: PoseTuple) -> dict[str, list[float]]:
    return {"position_m": list(pose[0]), "quaternion_wxyz": list(pose[1])}
