"""`iris-session recording` with its actions `inspect` (what a recording, or each of a folder, holds), `verify`
and `repair`. The other actions have modules of their own. `view` and `verify` are commands, too."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from iris_session.cli import recording_episodes, recording_export, recording_render, view
from iris_session.cli.common import (
    Commands,
    add_actions,
    add_command,
    ending_as_interrupts,
    list_first,
    print_error,
    print_json,
    print_result,
    to_printable,
)
from iris_session.cli.progress import ReadingProgress

if TYPE_CHECKING:
    from iris_session.recording.repair import RepairReport
    from iris_session.recording.summary import (
        EpisodeSummary,
        PersonSummary,
        RecordingSummary,
        StopSummary,
        StreamSummary,
    )
    from iris_session.rrd.assets import AssetsSummary

_CLASSES: Final = {
    "closed": "closed: `verify` re-simulates authority, control and physics",
    "open": "open: `verify` re-simulates authority and control, physics is taken from the file",
}


def register(commands: Commands) -> None:
    _register_verify(commands)
    actions = add_actions(
        commands,
        "recording",
        help="inspect, view, verify, export, render or repair recordings",
        description="Show what a recording holds, view and verify it, export it as tables, make a film or a picture of "
        "it, or repair it. `iris-session view` and `iris-session verify` are short for the actions of that name.",
    )
    inspect = add_command(
        actions,
        "inspect",
        run_inspect,
        help="who took part, what happened, how long, what is damaged",
        description="Show what a recording holds: scene, people, robots that they held, episodes, handovers, e-stops, "
        "clouds and pictures, alignment, drops, damage. Of a folder: every recording below it, one line each. "
        "Exit status 1 if something is damaged or missing inside.",
        examples="""
            iris-session recording inspect sessions/20261121T093000.000000Z-handover/session.rrd
            iris-session recording inspect session.rrd --json
            iris-session recording inspect sessions    a line for every recording
        """,
    )
    inspect.add_argument("path", type=Path, metavar="RECORDING", help="a .rrd, or a folder with recordings below it")
    recording_episodes.register(actions)
    view.register(actions)
    _register_verify(actions)
    recording_export.register(actions)
    recording_render.register(actions)
    repair = add_command(
        actions,
        "repair",
        run_repair,
        help="everything that can be read of a damaged recording, in a new file",
        description="Write everything that can be read of a recording, its parts included, into one new file that "
        "Rerun's viewer opens at once, and say what is lost. The recording itself is not changed. Exit status 1 if "
        "something inside is damaged or missing, as with `inspect`; 2 if nothing could be written.",
        examples="""
            iris-session recording repair sessions/20261121T093000.000000Z-handover -o repaired.rrd
            iris-session recording repair session.rrd -o repaired.rrd --force --json
        """,
    )
    repair.add_argument("path", type=Path, metavar="RECORDING", help="a .rrd, or the folder of one session")
    repair.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="the file to write")
    repair.add_argument("--force", action="store_true", help="replace FILE if it exists")


def run_inspect(arguments: argparse.Namespace) -> int:
    """Print the summary of a recording, or a line for each of a folder. One that is unreadable hides no other."""
    import msgspec

    from iris_session.dataset.episodes import list_files
    from iris_session.recording import Recording, RecordingError
    from iris_session.recording.summary import summarise

    def summarise_file(path: Path) -> RecordingSummary:
        with ReadingProgress(path) as progress, Recording.open(path, warn=False) as recording:
            return summarise(recording, progress.show_steps)

    rows: list[dict[str, object]] = []

    def refuse(path: str, why: str) -> None:
        rows.append({"path": path, "ok": False, "error": why})
        print_error(why)

    files = list_files([arguments.path], lambda error: refuse(str(error.filename), str(error)))
    with ending_as_interrupts():
        if not arguments.path.is_dir():
            summary = summarise_file(arguments.path)
            return print_result(arguments, summary, format_summary(summary), ok=summary.ok)
        for file in files:
            try:
                summary = summarise_file(file)
            except RecordingError as error:
                refuse(str(file), str(error))
                continue
            rows.append(msgspec.to_builtins(summary))
            if not arguments.json:
                print(to_printable(format_line(summary)), flush=True)
    ok = all(row["ok"] for row in rows)
    if arguments.json:
        print_json({"ok": ok, "recordings": rows})
    return 0 if ok else 1


def format_line(summary: RecordingSummary) -> str:
    """Return a recording as one line."""
    people = [person.name for person in summary.people if person.held_s] or [one.name for one in summary.people]
    parts = [
        summary.path,
        _format_day(summary),
        _format_duration(summary.duration_s),
        summary.session_name,
        _join(people) if people else "no people",
    ]
    if summary.episodes:
        verdicts = Counter(episode.verdict for episode in summary.episodes)
        parts.append(f"{_count(len(summary.episodes), 'episode')} ({_format_counts(verdicts)})")
    if summary.handovers:
        parts.append(_count(len(summary.handovers), "handover"))
    if summary.stops:
        parts.append(_count(len(summary.stops), "e-stop"))
    if summary.ending:
        parts.append(summary.ending.partition(":")[0])
    if summary.damage:
        parts.append(f"DAMAGED: {summary.damage[0]}")
    return "  ".join(parts)


def format_summary(summary: RecordingSummary) -> Iterator[str]:
    """Yield a recording as lines."""
    yield f"{summary.session_name}  {_format_day(summary)}  {_format_duration(summary.duration_s)}"
    files = f", {len(summary.files)} parts: {_join(summary.files)}" if len(summary.files) > 1 else ""
    yield f"  file       {summary.path}, {summary.bytes / 1e6:.1f} MB, format {summary.format}{files}"
    yield f"  class      {_CLASSES.get(summary.recording_class, summary.recording_class)}"
    if summary.continues:
        yield f"  continues  {summary.continues}, {_format_duration(summary.drops.down_s)} later"
    yield f"  end        {summary.ending or 'finished'}; {summary.steps:,} steps from {summary.begin_s:.2f} s"
    yield f"  robots     {_join(summary.robots)}"
    yield f"  objects    {_join(summary.objects)}"
    if summary.deformables:
        yield f"  deforming  {_join(summary.deformables)}"
    handovers = [
        f"{one.object}: {_format_hand(one.giver, one.giver_name)} to {_format_hand(one.receiver, one.receiver_name)} "
        f"at {one.at_s:.2f} s, both held it for {one.both_held_s:.2f} s"
        for one in summary.handovers
    ]
    lists: dict[str, Sequence[str]] = {
        "people": [*map(_format_person, summary.people)],
        "alignment": [*_format_alignments(summary.people)],
        "episodes": [*map(_format_episode, summary.episodes)],
        "handovers": handovers,
        "e-stops": [*map(_format_stop, summary.stops)],
        "pauses": [*map(_format_stop, summary.pauses)],
        "scene": [f"{one.cause} at {one.at_s:.2f} s" for one in summary.scene_changes],
        "streams": [*map(_format_stream, summary.streams)],
        "assets": _format_assets(summary.assets),
        "drops": [*_format_drops(summary)],
        "damage": summary.damage,
        "notes": summary.notes,
    }
    for title, lines in lists.items():
        if lines or title not in ("pauses", "scene", "streams", "notes"):
            for i, line in enumerate(list_first(lines or ["none"])):
                yield f"  {title if i == 0 else '':9s}  {line}"


def _format_episode(one: EpisodeSummary) -> str:
    label = f" {one.label!r}" if one.label else ""
    parts = [f"{one.number} {one.verdict}{label} at {one.at_s:.2f} s, {_format_duration(one.duration_s)}, by {one.by}"]
    parts += [f"started by {one.started_by}"] if one.started_by not in ("", one.by) else []
    parts += [f"task {one.task}"] if one.task else []
    parts += [f"with {', '.join(one.robots)}"] if one.robots else []
    return ", ".join(parts)


def _format_person(person: PersonSummary) -> str:
    held = ", ".join(f"{robot} for {_format_duration(seconds)}" for robot, seconds in person.held_s.items())
    joins = f", joined {person.joins} times" if person.joins > 1 else ""
    devices = f", {_join(person.devices)}" if person.devices else ""
    left = ", there at the end" if person.stayed else ""
    rejected = f"; {_format_counts(person.rejected)} rejected samples" if person.rejected else ""
    return (
        f"{person.name} ({person.role or 'joined before the recording'}{devices}): "
        f"{_format_duration(person.present_s)}{joins}{left}; {f'held {held}' if held else 'held no robot'}{rejected}"
    )


def _format_alignments(people: Sequence[PersonSummary]) -> Iterator[str]:
    for person in people:
        one = person.alignment
        if not one.changes and not one.alarms:
            continue
        stated = "no stated error"
        if one.error_at_robot_m > 0.0:
            stated = (
                f"stated error {one.error_at_anchor_m * 1e3:.1f} mm at the anchor, {one.error_at_robot_m * 1e3:.1f} mm "
                f"at the robot (worst {one.worst_error_at_robot_m * 1e3:.1f} mm), 95 %"
            )
        alarms = f"; alarms: {_format_counts(one.alarms)}" if one.alarms else ""
        yield f"{person.name}: {one.kind}, {stated}; {_count(one.changes, 'change')}{alarms}"


def _format_hand(robot: str, name: str) -> str:
    return f"{robot} ({name})" if name and name != robot else robot


def _format_stop(stop: StopSummary) -> str:
    who = stop.by or "a connection that had not joined"
    reason = f" ({stop.reason})" if stop.reason else ""
    lasted = f"for {_format_duration(stop.duration_s)}" if stop.ended else "to the end"
    return f"at {stop.at_s:.2f} s by {who}{reason}, {lasted}"


def _format_stream(stream: StreamSummary) -> str:
    title = f" ({stream.title})" if stream.title else ""
    fault = f"; FAULT {stream.fault}" if stream.fault else ""
    frames = _count(stream.frames, "frame")
    lasted = _format_duration(stream.duration_s)
    return f"{stream.name}{title}: {stream.encoding}, {frames} in {lasted}, {stream.hz:.1f} Hz{fault}"


def _format_assets(assets: AssetsSummary) -> list[str]:
    if not assets.recorded:
        return ["none: made by an earlier version, or the session shared no scene"]
    if assets.recorded == "none":
        return [f"none (--record-assets none), hashes of {_count(assets.scenes, 'scene')}"]
    head = f"{assets.recorded}: {assets.present:,} of {assets.expected:,} of {_count(assets.scenes, 'scene')}"
    return [f"{head}, {assets.bytes / 1e6:.1f} MB", *(f"left out: {line}" for line in assets.left_out)]


def _format_drops(summary: RecordingSummary) -> Iterator[str]:
    drops = summary.drops
    if drops.rejected_samples:
        yield f"rejected samples: {_format_counts(drops.rejected_samples)}"
    if drops.denials:
        yield f"denied requests: {_format_counts(drops.denials)}"
    if drops.lost_steps:
        yield f"{_count(drops.lost_steps, 'step')} did not fit into the recording"
    if drops.samples_left_out:
        what = _count(drops.samples_left_out, "raw sample")
        yield f"{what} not recorded (disk slow or nearly full, or the budget); the journal is whole"
    if drops.stalls:
        yield f"no step {_count(drops.stalls, 'time')}, for {_format_duration(drops.stalled_s)} in all"


def _format_day(summary: RecordingSummary) -> str:
    day = summary.created_utc
    return f"{day[:10]} {day[11:19]} UTC" if len(day) >= 19 else "an unknown day"


def _format_duration(seconds: float) -> str:
    if seconds < 100.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


def _format_counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{n} {name}" for name, n in sorted(counts.items(), key=lambda item: -item[1]))


def _count(n: int, noun: str) -> str:
    return f"{n:,} {noun}{'' if n == 1 else 's'}"


def _join(names: Sequence[str]) -> str:
    return ", ".join(list_first(names)) or "none"


# --- repair -----------------------------------------------------------------------------------------------------------


def run_repair(arguments: argparse.Namespace) -> int:
    """Repair a recording, and print what is in the new file and what is lost."""
    from iris_session.recording.repair import repair

    path: Path = arguments.path
    with ending_as_interrupts(), ReadingProgress(path) as progress:
        report = repair(path, arguments.out, overwrite=arguments.force, progress=progress.show_bytes)
    return print_result(arguments, report, format_repair(report), ok=report.ok)


def format_repair(report: RepairReport) -> Iterator[str]:
    """Yield a report as lines."""
    yield (
        f"{report.output}: {report.steps:,} steps, {report.duration_s:.1f} s, {report.bytes / 1e6:.1f} MB, of "
        f"{', '.join(report.files)}"
    )
    lost = []
    if report.lost_bytes:
        lost.append(f"{report.lost_bytes:,} bytes that cannot be read")
    if report.lost_steps:
        span = f" in {report.lost_s:.2f} s" if report.lost_s else ""
        lost.append(f"{report.lost_steps:,} steps{span}")
    if not report.finished:
        lost.append("what may have followed the last step: the recording was not closed")
    yield f"  lost    {'; '.join(lost) or 'nothing'}"
    for i, line in enumerate(list_first((*report.damage, *report.cuts, *report.notes))):
        yield f"  {'found' if i == 0 else '':7s} {line}"


# --- verify -----------------------------------------------------------------------------------------------------------


def _register_verify(commands: Commands) -> None:
    parser = add_command(
        commands,
        "verify",
        run_verify,
        help="re-simulate a recording and compare it bit for bit",
        description="Re-simulate recordings. Exit status 0 only if every step of every file is identical.",
        examples="""
            iris-session verify sessions/*/session.rrd
            iris-session verify sessions             every recording in a folder and below it
        """,
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="RECORDING", help="a .rrd, or a folder with recordings")


def run_verify(arguments: argparse.Namespace) -> int:
    """Verify each file; the first problem of each is named with its step and entry."""
    from iris_session.dataset.episodes import list_files
    from iris_session.recording import Problem, RecordingError, VerifyReport
    from iris_session.session.verification import verify_recording

    reports: list[VerifyReport] = []

    def refuse(path: str, why: str) -> None:
        reports.append(VerifyReport(path, problems=[Problem(-1, "unreadable", "file", why)]))
        print_error(why)

    for path in list_files(arguments.files, lambda error: refuse(str(error.filename), str(error))):
        try:
            with ending_as_interrupts(), ReadingProgress(path) as progress:
                report = verify_recording(path, progress.show_steps)
        except RecordingError as error:  # it hides no other
            refuse(str(path), str(error))
            continue
        if not arguments.json:
            print(to_printable(f"{path}: {report.line()}"))
        reports.append(report)
    ok = all(report.ok for report in reports)
    if arguments.json:
        print_json({"ok": ok, "files": [report.as_dict() for report in reports]})
    unreadable = all(p.kind == "unreadable" and p.step < 0 for report in reports for p in report.problems)
    return 0 if ok else 2 if unreadable else 1
