"""`bench alignment --worlds`: worlds in which an alignment can go wrong, one per row of the table in docs/anchors.md,
and mixes of what real laboratories have.

A world is a function of a `Room` (`alignment_room`): it says what the wearers do and what happens, and probes. A world
with several variants gives each of its rooms one of them, in turn. Figures are over all probes, points (the sheet, 1 m
and 2 m beside it) and headsets or pairs:

- `sheet_mm_p95`, `at_1m_mm_p95`, `at_2m_mm_p95`: distance between the places at which two headsets display a point.
- `stated_..._mm_p50`: median of the p95 that is stated for such a pair.
- `stated_over_true`: that median over the p95 of the true error, where it is largest.
- `coverage_share`: pairs and points whose error is within the stated p95.
- `wrong_and_confident_share`: headsets and pairs off by more than three times what is stated at one of the points,
  while the hands of these wearers would move a robot.
- `told_share`: those that were warned since there was a reason, or whose hand would not move a robot.
- `engaged_share`: headsets whose hand would move a robot. Without it, a session in which no robot moves would pass.
- `false_alarm_share`: headsets with an alarm before there was a reason; `false_alarms_per_hour`: per headset.

The same figures after the glance that was advised have the prefix `after_`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import Any, Final, NamedTuple

import numpy as np

from anchors.lie import quat_exp, quat_multiply, quat_to_matrix, to_quat, to_vec3
from anchors.pose import IDENTITY_POSE, PoseTuple
from iris_session.bench.alignment_room import SECOND, ProbeResult, Room, Wearer
from iris_session.bench.alignment_sources import (
    MARKS,
    ONE,
    TIP_SIGMA_M,
    TRIANGLE,
    SheetSource,
    draw_held_poses,
    draw_level,
    draw_vector,
    to_poses,
)
from iris_session.bench.report import Bar, BenchError, make_bar
from iris_session.protocol.names import AnchorKind, Device, ObservationSource

TOUCH_COVARIANCE: Final = tuple(TIP_SIGMA_M**2 if i % 7 == 0 else 0.0 for i in range(36))

PLAIN: Final = SheetSource()
#: MRUK and spatial markers: about one pose a second.
SLOW: Final = SheetSource(hz=1.0)
QR_5HZ: Final = SheetSource(hz=5.0)


def run_all(room: Room, what: Callable[[Wearer], Iterator[int]]) -> None:
    """Let all wearers do the same, beside each other."""
    room.run(what(p) for p in room.people)


# --- worlds -----------------------------------------------------------------------------------------------------------


def look_at_moved_sheet(room: Room) -> None:
    """W1: one of three sheets lies 50 mm elsewhere, and is looked at last."""
    at, turn = room.sheets["c"]
    room.sheets["c"] = (at + draw_level(room.rng, 0.05), turn)
    _survey_three(room)


def look_at_swapped_sheets(room: Room) -> None:
    """W1: the last two of three sheets are swapped."""
    room.sheets["b"], room.sheets["c"] = room.sheets["c"], room.sheets["b"]
    _survey_three(room)


def _survey_three(room: Room) -> None:
    room.mark_cause()
    run_all(room, lambda p: p.survey("abc", 2))
    room.probe()
    run_all(room, lambda p: p.pause(20.0, heeds=True))
    room.probe()


def pause_half_hour(room: Room) -> None:
    """W2: no sheet is looked at for half an hour, while the tracking frame drifts."""
    run_all(room, lambda p: p.survey("a"))
    room.mark_cause()
    for minutes in (5.0, 25.0):
        run_all(room, lambda p, s=60.0 * minutes: p.pause(s))  # type: ignore[misc]
        room.probe()
    _glance(room)


def drift_fast(room: Room) -> None:
    """W2: a tracking frame that drifts by 20 mm a minute, for 110 s."""
    run_all(room, lambda p: p.survey("a"))
    room.mark_cause()
    run_all(room, lambda p: p.pause(110.0))
    room.probe()
    _glance(room)


def _glance(room: Room, seconds: float = 0.0) -> None:
    """Let everybody look at the sheet once more, and wait until what comes of it is in force."""
    run_all(room, lambda p: p.look("a", seconds))
    run_all(room, lambda p: p.pause(10.0, heeds=True))
    room.probe("after")


def jump_silently(room: Room) -> None:
    """W3: the tracking frame jumps by 50 mm without a word; the source is slow."""
    run_all(room, lambda p: p.survey("a"))
    room.mark_cause()
    for p in room.people:
        p.motion.shift_frame(draw_level(room.rng, 0.05))
    hz = room.people[0].motion.source.hz
    run_all(room, lambda p: p.look("a", 12.0 / hz))
    run_all(room, lambda p: p.pause(3.0))
    room.probe()
    run_all(room, lambda p: p.pause(15.0, heeds=True))
    room.probe("after")


def bump_between(room: Room) -> None:
    """W4: the only sheet is bumped by 50 mm after one person's alignment and before the next one's."""
    room.is_absolute = False
    first, *others = room.people
    room.run([first.survey("a")])
    at, turn = room.sheets["a"]
    room.sheets["a"] = (at + draw_level(room.rng, 0.05), turn)
    room.mark_cause()
    room.run([first.pause(60.0, heeds=True), *(p.survey("a") for p in others)])
    room.probe()


def look_at_two_prints(room: Room) -> None:
    """W4: two prints of one id lie 0.3 to 2 m apart, and everybody looks at the nearest."""
    room.is_absolute = False
    first, *others = room.people
    at, turn = room.sheets["a"]
    for p in others:
        p.sheets["a"] = (at + draw_level(room.rng, room.rng.uniform(0.3, 2.0)), turn)
    room.run([first.survey("a")])
    room.mark_cause()
    room.run([first.pause(60.0, heeds=True), *(p.survey("a") for p in others)])
    room.probe()


def smooth_poses(room: Room) -> None:
    """W5: a source smooths its poses and repeats each of them."""
    run_all(room, lambda p: p.survey("a"))
    run_all(room, lambda p: p.pause(5.0))
    room.probe()


def freeze_poses(room: Room) -> None:
    """W5: the last pose is repeated at 5 Hz for a minute, in which the tracking frame drifts by 20 mm."""
    run_all(room, lambda p: p.survey("a"))
    room.mark_cause()
    for p in room.people:
        p.motion.velocity *= 0.02 / 60.0 / np.linalg.norm(p.motion.velocity)
    run_all(room, lambda p: p.repeat_last("a", 60.0, 5.0))
    room.probe()
    for p in room.people:
        p.motion.velocity *= 0.003 / 0.02
    run_all(room, lambda p: p.look("a", 1.2))
    _glance(room)


def number_badly(room: Room) -> None:
    """W6: every look has a viewpoint of its own, or all have number 0."""
    run_all(room, lambda p: p.survey("a"))
    room.probe()
    run_all(room, lambda p: p.survey("a", 2))
    room.probe()


def look_walking(room: Room) -> None:
    """W7: wearers look while they walk round the sheet, with pictures 0 to 60 ms late."""
    room.mark_cause()
    run_all(room, lambda p: p.look("a", 6.0, walk_m_per_s=room.rng.uniform(0.3, 0.8)))
    run_all(room, lambda p: p.pause(3.0))
    room.probe()
    _glance(room)


def drift_yaw(room: Room, *, glances: bool) -> None:
    """W8: the tracking frame turns by 0.5 degrees a minute, for nine minutes."""
    run_all(room, lambda p: p.survey("a"))
    room.mark_cause()
    for p in room.people:
        rate = math.radians(0.5) / 60.0 * room.rng.choice([-1.0, 1.0])
        p.motion.turn_frame(rate, room.now_s, room.sheets["a"][0])
    for _ in range(9):
        run_all(room, lambda p: p.pause(58.0))
        if glances:
            run_all(room, lambda p: p.look("a", 2.0))
    run_all(room, lambda p: p.pause(5.0))
    room.probe()
    _glance(room)


def print_too_large(room: Room) -> None:
    """W9: the print is 2 % too large, and the source reports the nominal size."""
    room.print_scale["a"] = 0.02
    room.mark_cause()
    run_all(room, lambda p: p.survey("a", 1))
    room.probe()
    run_all(room, lambda p: p.survey("a", 2))
    run_all(room, lambda p: p.pause(5.0))
    room.probe()


def mix_makers(room: Room) -> None:
    """W10: controllers in holders whose pose their makers define otherwise, by 3 mm and 1 degree."""
    room.mark_cause()
    run_all(room, _report_holder)
    run_all(room, lambda p: p.pause(3.0))
    room.probe()


def _report_holder(p: Wearer) -> Iterator[int]:
    rng, room = p.motion.rng, p.room
    off_p, off_q = np.array(draw_vector(rng, 0.003)), quat_exp(np.array(draw_vector(rng, math.radians(1.0))))
    at, turn = room.sheets["a"]
    for _ in range(3):
        p.viewpoint += 1
        for pose in to_poses(*draw_held_poses(rng, (at + off_p, quat_multiply(turn, off_q)), 20)):
            yield room.now_ns + SECOND // 10
            T = p.motion.place(room.now_s, pose)
            p.report_sheet("a", T, AnchorKind.CONTROLLER, device=Device.CONTROLLER_RIGHT)
        yield from p.pause(3.0)


def touch_with_rough_tip(room: Room) -> None:
    """W10: four marks are touched once each with a tip that is known to 3 mm."""
    room.mark_cause()
    run_all(room, _touch_marks)
    run_all(room, lambda p: p.pause(3.0))
    room.probe()


def _touch_marks(p: Wearer) -> Iterator[int]:
    rng, room = p.motion.rng, p.room
    off = rng.normal(0.0, 0.003 / math.sqrt(3.0), 3)
    heading = rng.uniform(-math.pi, math.pi)
    for mark, at in MARKS.items():
        yield room.now_ns + 2 * SECOND
        # Held alike, within 20 degrees; assumed.
        q = quat_multiply(quat_exp(np.array([0.0, 0.0, heading])), quat_exp(rng.normal(0.0, math.radians(20.0), 3)))
        tip = np.array(at) + quat_to_matrix(q) @ off + rng.normal(0.0, TIP_SIGMA_M, 3)
        T = p.motion.place(room.now_s, (to_vec3(tip), to_quat(q)))
        p.report_sheet("a", T, AnchorKind.TOUCH, mark=mark, device=Device.CONTROLLER_RIGHT, covariance=TOUCH_COVARIANCE)


def report_zero_poses(room: Room) -> None:
    """W11: twelve identical observations of the sheet at the origin, before the runtime has a pose. The origin is near
    the head: where it was when the app began."""
    room.mark_cause()

    def report(p: Wearer) -> Iterator[int]:
        p.motion.begin_at(np.append(room.rng.uniform(-1.5, 1.5, 2), 1.6), room.now_s)
        away = draw_vector(room.rng, room.rng.uniform(0.3, 0.5))
        for _ in range(12):
            yield room.now_ns + SECOND // 10
            p.report_head((away, IDENTITY_POSE[1]), to_authority=True)
            p.report_sheet("a", IDENTITY_POSE)

    run_all(room, report)
    run_all(room, lambda p: p.pause(2.0))
    room.probe()
    run_all(room, lambda p: p.survey("a"))
    room.probe("after")


def look_with_wrong_focal(room: Room) -> None:
    """W12: the focal length is 5 % wrong; the first looks are from near by, the later ones from elsewhere."""
    room.mark_cause()
    way = room.rng.uniform(-math.pi, math.pi)
    run_all(room, lambda p: p.survey("a", 2, distance_m=(0.4, 0.6), azimuth=way))
    room.probe()
    run_all(room, lambda p: p.look("a", distance_m=(0.9, 1.2), azimuth=way + math.pi))
    run_all(room, lambda p: p.look("a", distance_m=(0.9, 1.2), azimuth=way + 0.5 * math.pi))
    run_all(room, lambda p: p.pause(20.0, heeds=True))
    room.probe()


def work_in_laboratory(room: Room) -> None:
    """A mix: an ordinary two minutes, with a glance every half minute. Nothing happens."""
    run_all(room, lambda p: p.survey(room.anchors, 3 if len(room.anchors) == 1 else 1))
    room.probe()
    for _ in range(4):
        run_all(room, lambda p: p.pause(25.0, heeds=True))
        run_all(room, lambda p: p.look(next(iter(room.anchors)), max(3.0, 3.0 / p.motion.source.hz)))
    run_all(room, lambda p: p.pause(5.0, heeds=True))
    room.probe()


@dataclass(frozen=True)
class Variant:
    """One variant of a world: what happens, the sheets, and the source. `print_sigma`: of the size of each print."""

    name: str
    happen: Callable[[Room], None]
    source: SheetSource = PLAIN
    anchors: dict[str, PoseTuple] = field(default_factory=lambda: ONE)
    drift_m_per_min: float | None = None
    print_max: float = 0.0
    survey_sigma_m: float = 0.0
    has_marks: bool = False

    def run(self, rng: np.random.Generator) -> Room:
        """Run one room of two headsets."""
        marks = {"a": MARKS} if self.has_marks else {}
        room = Room(rng, self.anchors, self.source, drift_m_per_min=self.drift_m_per_min, marks=marks)
        for name, (at, turn) in room.sheets.items():
            room.print_scale[name] = rng.uniform(-self.print_max, self.print_max)
            if name != next(iter(room.sheets)):  # the first one is the world
                off = rng.normal(0.0, self.survey_sigma_m, 3)
                room.sheets[name] = (at + off, turn)
        self.happen(room)
        return room


_QR_SYSTEM: Final = ObservationSource.QR_SYSTEM
_MRUK: Final = SheetSource(hz=1.0, weight=0.2, size_sigma=0.0035, reported_as=_QR_SYSTEM)
_HOLOLENS: Final = SheetSource(hz=3.0, weight=0.2, size_sigma=0.005, remembers=True, reported_as=_QR_SYSTEM)
#: "Smoothed 20 %": a new pose counts for a fifth. The largest errors are taken as two sigma.
MIXES: Final[dict[str, tuple[Variant, ...]]] = {
    "lab_own_detector": (
        Variant("", work_in_laboratory, SheetSource(late_s=(0.05, 0.05), corner_px=0.35), print_max=0.005),
    ),
    "lab_system_qr": (Variant("", work_in_laboratory, _MRUK),),
    "lab_hololens": (Variant("", work_in_laboratory, _HOLOLENS),),
    "lab_three_sheets": (
        Variant(
            "",
            work_in_laboratory,
            SheetSource(late_s=(0.05, 0.05), corner_px=0.35),
            TRIANGLE,
            print_max=0.005,
            survey_sigma_m=0.001,  # of a tape measure that is read with care, per axis; assumed
        ),
    ),
}
ROWS: Final[dict[str, tuple[Variant, ...]]] = {
    "W1": (
        Variant("moved", look_at_moved_sheet, anchors=TRIANGLE),
        Variant("swapped", look_at_swapped_sheets, anchors=TRIANGLE),
    ),
    "W2": (Variant("pause", pause_half_hour), Variant("fast", drift_fast, drift_m_per_min=0.02)),
    "W3": (Variant("5hz", jump_silently, QR_5HZ), Variant("1hz", jump_silently, SLOW)),
    "W4": (Variant("bumped", bump_between), Variant("prints", look_at_two_prints)),
    "W5": (
        Variant("smoothed", smooth_poses, SheetSource(hz=1.0, repeats=5, weight=0.2)),
        Variant("frozen", freeze_poses, QR_5HZ),
    ),
    "W6": (
        Variant("each", number_badly, SheetSource(viewpoints="each")),
        Variant("zero", number_badly, SheetSource(viewpoints="zero")),
    ),
    "W7": (Variant("", look_walking, SheetSource(late_s=(0.0, 0.06))),),
    "W8": (
        Variant("unseen", lambda room: drift_yaw(room, glances=False)),
        Variant("seen", lambda room: drift_yaw(room, glances=True)),
    ),
    "W9": (Variant("", print_too_large),),
    "W10": (Variant("holder", mix_makers), Variant("touch", touch_with_rough_tip, has_marks=True)),
    "W11": (Variant("", report_zero_poses),),
    "W12": (Variant("", look_with_wrong_focal, SheetSource(focal=0.05)),),
}
WORLDS: Final = ROWS | MIXES


# --- running ----------------------------------------------------------------------------------------------------------


class RoomResult(NamedTuple):
    """Results of a room: variant, findings by label, false alarms by headset, hours without a cause."""

    variant: str
    findings: list[tuple[str, ProbeResult]]
    false_alarms: list[int]
    quiet_hours: float


def select_worlds(text: str) -> tuple[str, ...]:
    """Return the names of worlds that `--worlds` selects.

    Raises:
        BenchError: A name is unknown.
    """
    groups = {"all": tuple(WORLDS), "none": (), "mixes": tuple(MIXES), "rows": tuple(ROWS)}
    names: dict[str, None] = {}
    for name in filter(None, text.split(",")):
        if name not in WORLDS and name not in groups:
            raise BenchError(f"world '{name}' is unknown; known: {', '.join([*groups, *WORLDS])}")
        names |= dict.fromkeys(groups.get(name, (name,)))
    return tuple(names)


def run_worlds(
    names: Sequence[str], headsets: int, seed: int, progress: Callable[[str], None] = lambda _: None
) -> dict[str, dict[str, float]]:
    """Run worlds with rooms of two headsets each, on all processors.

    Args:
        names: Worlds.
        headsets: Headsets per world; an odd one is left out.
        seed: Random seed.
        progress: Called with a short text before each world.
    """
    rooms = max(1, headsets // 2)
    workers = min(os.cpu_count() or 1, rooms)
    results = {}
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        waiting = {}
        for name in names:
            seeds = np.random.SeedSequence((seed, list(WORLDS).index(name))).spawn(rooms)
            parts = [(name, tuple(range(k, rooms, 2 * workers)), seeds[k :: 2 * workers]) for k in range(2 * workers)]
            waiting[name] = [pool.submit(_run_rooms, *part) for part in parts if part[1]]
        for name, futures in waiting.items():
            progress(f"{name}, {2 * rooms} headsets")
            results[name] = summarize([one for future in futures for one in future.result()])
    return results


def _run_rooms(name: str, numbers: Sequence[int], seeds: Sequence[np.random.SeedSequence]) -> list[RoomResult]:
    out = []
    for number, seed in zip(numbers, seeds, strict=True):
        variant = WORLDS[name][number % len(WORLDS[name])]
        room = variant.run(np.random.default_rng(seed))
        alarms = [p.false_alarms for p in room.people]
        out.append(RoomResult(variant.name, room.findings, alarms, room.quiet_hours))
    return out


def summarize(rooms: Sequence[RoomResult]) -> dict[str, float]:
    """Return the figures of one world."""
    out = _summarize_findings([f for room in rooms for label, f in room.findings if not label])
    after = [f for room in rooms for label, f in room.findings if label]
    out |= {f"after_{key}": value for key, value in (_summarize_findings(after) if after else {}).items()}
    variants = sorted({room.variant for room in rooms} - {""})
    for variant in variants:
        found = [f for room in rooms if room.variant == variant for label, f in room.findings if not label]
        out[f"{variant}_wrong_and_confident_share"] = _share(_is_wrong_and_confident(f) for f in found)
        out[f"{variant}_told_share"] = _share(f.is_told for f in found)
    alarms = [n for room in rooms for n in room.false_alarms]
    hours = sum(room.quiet_hours for room in rooms)
    out["false_alarm_share"] = _share(n > 0 for n in alarms)
    out["false_alarms_per_hour"] = round(sum(alarms) / hours, 3) if hours > 0.0 else 0.0
    return out


def make_world_bars(names: Sequence[str], results: dict[str, Any]) -> list[Bar]:
    """Return the bars of worlds: nowhere wrong and confident, no false alarms; in the mixes, honest and usable."""
    bars = []
    for name in names:
        keys = [key for key in results[name] if key in ("wrong_and_confident_share", "after_wrong_and_confident_share")]
        bars += [make_bar(results, f"{name}.{key}", "<=", 0.02) for key in keys]
        bars.append(make_bar(results, f"{name}.false_alarms_per_hour", "<=", 1.0))
        if name in MIXES:
            bars.append(make_bar(results, f"{name}.coverage_share", ">=", 0.90))
            bars.append(make_bar(results, f"{name}.coverage_share", "<=", 0.99))
            bars.append(make_bar(results, f"{name}.stated_over_true", "<=", 2.5))
            bars.append(make_bar(results, f"{name}.engaged_share", ">=", 0.9))
    return bars


def _summarize_findings(findings: Sequence[ProbeResult]) -> dict[str, float]:
    pairs = [f for f in findings if len(f.who) == 2 and f.errors]
    out: dict[str, float] = {}
    ratios = []
    for k, name in enumerate(("sheet", "at_1m", "at_2m")):
        errors = [f.errors[k] for f in pairs]
        stated = [f.stated[k] for f in pairs]
        out[f"{name}_mm_p95"] = round(1e3 * float(np.quantile(errors, 0.95)), 2) if pairs else math.inf
        out[f"stated_{name}_mm_p50"] = round(1e3 * float(np.median(stated)), 2) if pairs else math.inf
        ratios.append(out[f"stated_{name}_mm_p50"] / out[f"{name}_mm_p95"] if pairs else math.nan)
    out["stated_over_true"] = round(max(ratios), 3)
    out["coverage_share"] = _share(e <= s for f in pairs for e, s in zip(f.errors, f.stated, strict=True))
    out["wrong_and_confident_share"] = _share(_is_wrong_and_confident(f) for f in findings)
    out["told_share"] = _share(f.is_told for f in findings)
    out["engaged_share"] = _share(f.is_allowed for f in findings)
    return out


def _is_wrong_and_confident(f: ProbeResult) -> bool:
    return f.is_allowed and f.ratio > 3.0


def _share(values: Iterable[bool]) -> float:
    seen = list(values)
    return round(float(np.mean(seen)), 4) if seen else math.nan
