"""`bench alignment --worlds`: worlds in which an alignment can go wrong, one per row of the table in docs/anchors.md,
and mixes of what real laboratories have.

A world is a list of what happens in a `Room` (`alignment_room`), and of probes. A world with several variants gives
each of its rooms one of them, in turn. Figures are over all probes, points (the sheet, 1 m and 2 m beside it) and
headsets or pairs:

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
    DRIFT_M_PER_MIN,
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


# --- what happens -----------------------------------------------------------------------------------------------------

#: Something that happens in a room, or that its wearers do beside each other.
Step = Callable[[Room], None]


def everybody(act: Callable[[Wearer], Iterator[int]]) -> Step:
    """Let all wearers do the same."""
    return lambda room: room.run(act(p) for p in room.people)


def survey(viewpoints: int = 3, names: str = "a") -> Step:
    return everybody(lambda p: p.survey(names, viewpoints))


def look(seconds: float = 0.0) -> Step:
    return everybody(lambda p: p.look("a", seconds))


def pause(seconds: float, *, heeds: bool = False) -> Step:
    return everybody(lambda p: p.pause(seconds, heeds=heeds))


CAUSE: Final[Step] = Room.mark_cause
PROBE: Final[Step] = Room.probe
PROBE_AFTER: Final[Step] = lambda room: room.probe("after")  # noqa: E731
#: Everybody looks at the sheet once more, and waits until what comes of it is in force.
GLANCE: Final = (look(), pause(10.0, heeds=True), PROBE_AFTER)
SURVEY_THREE: Final = (CAUSE, survey(2, "abc"), PROBE, pause(20.0, heeds=True), PROBE)


def move_sheet(name: str) -> Step:
    """Move a sheet by 50 mm."""

    def move(room: Room) -> None:
        at, turn = room.sheets[name]
        room.sheets[name] = (at + draw_level(room.rng, 0.05), turn)

    return move


def swap_sheets(room: Room) -> None:
    room.sheets["b"], room.sheets["c"] = room.sheets["c"], room.sheets["b"]


def jump(room: Room) -> None:
    """Move tracking frames by 50 mm without a word."""
    for p in room.people:
        p.motion.shift_frame(draw_level(room.rng, 0.05))


def drift(m_per_min: float) -> Step:
    """Let tracking frames drift so fast from now on, each in its direction."""

    def change(room: Room) -> None:
        for p in room.people:
            p.motion.velocity *= m_per_min / 60.0 / np.linalg.norm(p.motion.velocity)

    return change


def turn_frames(room: Room) -> None:
    """Let tracking frames turn by 0.5 degrees a minute."""
    for p in room.people:
        rate = math.radians(0.5) / 60.0 * room.rng.choice([-1.0, 1.0])
        p.motion.turn_frame(rate, room.now_s, room.sheets["a"][0])


def enlarge_print(room: Room) -> None:
    """Print the sheet 2 % too large; the source reports the nominal size."""
    room.print_scale["a"] = 0.02


def bump_between(room: Room) -> None:
    """Bump the only sheet by 50 mm after one person's alignment and before the next one's."""
    room.is_absolute = False
    first, *others = room.people
    room.run([first.survey("a")])
    move_sheet("a")(room)
    room.mark_cause()
    room.run([first.pause(60.0, heeds=True), *(p.survey("a") for p in others)])


def look_at_two_prints(room: Room) -> None:
    """Let everybody look at the nearest of two prints of one id, 0.3 to 2 m apart."""
    room.is_absolute = False
    first, *others = room.people
    at, turn = room.sheets["a"]
    for p in others:
        p.sheets["a"] = (at + draw_level(room.rng, room.rng.uniform(0.3, 2.0)), turn)
    room.run([first.survey("a")])
    room.mark_cause()
    room.run([first.pause(60.0, heeds=True), *(p.survey("a") for p in others)])


def walk_round_sheet(p: Wearer) -> Iterator[int]:
    return p.look("a", 6.0, walk_m_per_s=p.room.rng.uniform(0.3, 0.8))


def report_holder(p: Wearer) -> Iterator[int]:
    """Report a controller in a holder whose pose its maker defines otherwise, by 3 mm and 1 degree."""
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


def touch_marks(p: Wearer) -> Iterator[int]:
    """Touch four marks once each with a tip that is known to 3 mm."""
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


def report_zero_poses(p: Wearer) -> Iterator[int]:
    """Report twelve identical observations of the sheet at the origin, before the runtime has a pose. The origin is
    near the head: where it was when the app began."""
    room = p.room
    p.motion.begin_at(np.append(room.rng.uniform(-1.5, 1.5, 2), 1.6), room.now_s)
    away = draw_vector(room.rng, room.rng.uniform(0.3, 0.5))
    for _ in range(12):
        yield room.now_ns + SECOND // 10
        p.report_head((away, IDENTITY_POSE[1]), to_authority=True)
        p.report_sheet("a", IDENTITY_POSE)


def look_from_near_by(room: Room) -> None:
    """Look from near by, then from elsewhere."""
    way = room.rng.uniform(-math.pi, math.pi)
    everybody(lambda p: p.survey("a", 2, distance_m=(0.4, 0.6), azimuth=way))(room)
    room.probe()
    for turn in (math.pi, 0.5 * math.pi):
        everybody(lambda p, turn=turn: p.look("a", distance_m=(0.9, 1.2), azimuth=way + turn))(room)  # type: ignore[misc]


def survey_anchors(p: Wearer) -> Iterator[int]:
    return p.survey(p.room.anchors, 3 if len(p.room.anchors) == 1 else 1)


def glance_at_first(p: Wearer) -> Iterator[int]:
    return p.look(next(iter(p.room.anchors)), max(3.0, 3.0 / p.motion.source.hz))


# --- worlds -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Variant:
    """One variant of a world: what happens, the sheets, and the source. `print_max`: of the size of each print."""

    name: str
    steps: Sequence[Step]
    source: SheetSource = field(default_factory=SheetSource)
    anchors: dict[str, PoseTuple] = field(default_factory=lambda: ONE)
    drift_m_per_min: float = DRIFT_M_PER_MIN
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
        for step in self.steps:
            step(room)
        return room


#: An ordinary two minutes, with a glance every half minute. Nothing happens.
WORK: Final = (
    *(everybody(survey_anchors), PROBE),
    *(pause(25.0, heeds=True), everybody(glance_at_first)) * 4,
    *(pause(5.0, heeds=True), PROBE),
)
_OWN: Final = SheetSource(late_s=(0.05, 0.05), corner_px=0.35)
_QR_SYSTEM: Final = ObservationSource.QR_SYSTEM
#: "Smoothed 20 %": a new pose counts for a fifth. The largest errors are taken as two sigma.
_MRUK: Final = SheetSource(hz=1.0, weight=0.2, size_sigma=0.0035, reported_as=_QR_SYSTEM)
_HOLOLENS: Final = SheetSource(hz=3.0, weight=0.2, size_sigma=0.005, remembers=True, reported_as=_QR_SYSTEM)
MIXES: Final[dict[str, tuple[Variant, ...]]] = {
    "lab_own_detector": (Variant("", WORK, _OWN, print_max=0.005),),
    "lab_system_qr": (Variant("", WORK, _MRUK),),
    "lab_hololens": (Variant("", WORK, _HOLOLENS),),
    # Surveyed with a tape measure that is read with care: 1 mm per axis, assumed.
    "lab_three_sheets": (Variant("", WORK, _OWN, TRIANGLE, print_max=0.005, survey_sigma_m=0.001),),
}


def _jump_at(hz: float) -> Variant:
    """The tracking frame jumps; the source is slow: 1 Hz are MRUK and spatial markers."""
    steps = (survey(), CAUSE, jump, look(12.0 / hz), pause(3.0), PROBE, pause(15.0, heeds=True), PROBE_AFTER)
    return Variant(f"{hz:g}hz", steps, SheetSource(hz=hz))


def _turn(name: str, minute: Sequence[Step]) -> Variant:
    """The tracking frame turns for nine minutes."""
    return Variant(name, (survey(), CAUSE, turn_frames, *[*minute] * 9, pause(5.0), PROBE, *GLANCE))


ROWS: Final[dict[str, tuple[Variant, ...]]] = {
    "W1": (  # one of three sheets is moved and looked at last; the last two are swapped
        Variant("moved", (move_sheet("c"), *SURVEY_THREE), anchors=TRIANGLE),
        Variant("swapped", (swap_sheets, *SURVEY_THREE), anchors=TRIANGLE),
    ),
    "W2": (  # no look for half an hour, while the tracking frame drifts; it drifts fast
        Variant("pause", (survey(), CAUSE, pause(300.0), PROBE, pause(1500.0), PROBE, *GLANCE)),
        Variant("fast", (survey(), CAUSE, pause(110.0), PROBE, *GLANCE), drift_m_per_min=0.02),
    ),
    "W3": (_jump_at(5.0), _jump_at(1.0)),
    "W4": (Variant("bumped", (bump_between, PROBE)), Variant("prints", (look_at_two_prints, PROBE))),
    "W5": (  # a source smooths its poses and repeats each; one repeats its last pose, while the frame drifts by 20 mm
        Variant("smoothed", (survey(), pause(5.0), PROBE), SheetSource(hz=1.0, repeats=5, weight=0.2)),
        Variant(
            "frozen",
            (
                *(survey(), CAUSE, drift(0.02), everybody(lambda p: p.repeat_last("a", 60.0, 5.0)), PROBE),
                *(drift(DRIFT_M_PER_MIN), look(1.2), *GLANCE),
            ),
            SheetSource(hz=5.0),
        ),
    ),
    "W6": tuple(  # every look has a viewpoint of its own, or all have number 0
        Variant(name, (survey(), PROBE, survey(2), PROBE), SheetSource(viewpoints=name)) for name in ("each", "zero")
    ),
    "W7": (
        Variant("", (CAUSE, everybody(walk_round_sheet), pause(3.0), PROBE, *GLANCE), SheetSource(late_s=(0.0, 0.06))),
    ),
    "W8": (_turn("unseen", [pause(58.0)]), _turn("seen", [pause(58.0), look(2.0)])),
    "W9": (Variant("", (enlarge_print, CAUSE, survey(1), PROBE, survey(2), pause(5.0), PROBE)),),
    "W10": (
        Variant("holder", (CAUSE, everybody(report_holder), pause(3.0), PROBE)),
        Variant("touch", (CAUSE, everybody(touch_marks), pause(3.0), PROBE), has_marks=True),
    ),
    "W11": (Variant("", (CAUSE, everybody(report_zero_poses), pause(2.0), PROBE, survey(), PROBE_AFTER)),),
    "W12": (Variant("", (CAUSE, look_from_near_by, pause(20.0, heeds=True), PROBE), SheetSource(focal=0.05)),),
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
    names: Sequence[str], headsets: int, seed: int, progress: Callable[[str], None]
) -> dict[str, dict[str, float]]:
    """Run worlds with rooms of two headsets each, on all processors. Of `headsets` per world an odd one is left out."""
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
