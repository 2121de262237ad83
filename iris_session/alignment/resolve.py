"""Solve alignments and constellations again from a recording: the calculation behind `iris-session anchors solve`.

An alignment of the live session uses the observations until then. Here later observations count too (see `smoother`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from anchors.alignment import AlignmentConfig, AlignmentEstimate
from anchors.constellation import (
    Constellation,
    ConstellationError,
    ConstellationSolution,
    MovedSheet,
    SheetObservation,
    find_moved,
    solve_constellation,
)
from anchors.pose import IDENTITY_POSE, PoseTuple, apply, compose, distance, inverse, is_rigid, quat_angle
from anchors.uncertainty import NoiseModel, isotropic_covariance, length_p95, validate_covariance
from iris_session.alignment.smoother import (
    MAX_IN_GROUP,
    AlignmentSmoother,
    AnchorHistory,
    observed_covariance,
    observed_pose,
)
from iris_session.protocol.names import AlignmentKind, AnchorKind
from iris_session.recording import AlignmentHistory, AlignmentPeriod, RecordedObservation, TrackingFrame

#: Differences above the stated 95 % bound times this factor are not attributed to chance.
BEYOND: Final = 2.0
SHEETS: Final = (AnchorKind.QR, AnchorKind.BOARD)


@dataclass(frozen=True)
class Outlier:
    """Viewpoint whose observations of a sheet differ from the solution by more than noise, at session time `at_ns`."""

    anchor_id: str
    viewpoint_id: int
    looks: int
    off_m: float
    off_rad: float
    expected_p95_m: float
    at_ns: int


@dataclass(frozen=True)
class LiveComparison:
    """Difference of a live alignment from the solution at the same moment; values are `None` if that is refused.

    `off_m`, `off_rad`: when it came into force, at the sheet [m], [rad]. `off_end_m`: when it ended [m]. `stated_m`,
    `solved_m`: the stated p95 at the sheet of the live alignment and of the solution [m].
    """

    live: AlignmentPeriod
    off_m: float | None = None
    off_rad: float | None = None
    off_end_m: float | None = None
    solved_m: float | None = None

    @property
    def stated_m(self) -> float | None:
        """Stated p95 [m]; None for an alignment that was set or moved by hand: it states no error."""
        a = self.live.alignment
        return a.error_at_anchor_m if a.kind == AlignmentKind.MEASURED and not a.offset else None

    @property
    def is_beyond_stated(self) -> bool:
        """True if the difference exceeds what both stated errors explain."""
        if self.off_m is None or self.solved_m is None or self.stated_m is None:
            return False
        return self.off_m > BEYOND * math.hypot(self.stated_m, self.solved_m)


@dataclass
class FrameResult:
    """Results of one tracking frame. `last`: the solution at its last observation. `looks`: number of observations."""

    frame: TrackingFrame
    looks: int
    viewpoints: int
    sheets: dict[str, int]
    first_ns: int
    last_ns: int
    last: AlignmentEstimate
    unused: dict[str, int]
    compared: list[LiveComparison] = field(default_factory=list)
    outliers: list[Outlier] = field(default_factory=list)


def resolve_frame(
    frame: TrackingFrame,
    looks: Sequence[RecordedObservation],
    in_force: Iterable[AlignmentPeriod],
    anchors: AnchorHistory,
    sizes: Mapping[str, float],
    on_progress: Callable[[], None] = lambda: None,
) -> FrameResult:
    """Solve one tracking frame. `on_progress`: called after each live alignment that was compared."""
    resolver = AlignmentSmoother(looks, anchors, sizes)
    first_ns, last_ns = looks[0].observation.capture_ns, looks[-1].observation.capture_ns
    sheets: dict[str, int] = {}
    for look in looks:
        sheets[look.observation.anchor_id] = sheets.get(look.observation.anchor_id, 0) + 1
    viewpoints = len({look.observation.viewpoint_id for look in looks})
    result = FrameResult(
        frame, len(looks), viewpoints, sheets, first_ns, last_ns, resolver.estimate_at(last_ns), resolver.count_unused()
    )
    for live in in_force:
        result.compared.append(compare_live(live, resolver, last_ns))
        on_progress()
    result.outliers = find_outliers(looks, resolver, anchors)
    return result


def compare_live(live: AlignmentPeriod, resolver: AlignmentSmoother, last_ns: int) -> LiveComparison:
    """Compare a live alignment with the solution when it came into force and when it ended."""
    begin = resolver.estimate_at(live.since_ns)
    end_ns = live.until_ns if live.until_ns >= 0 else max(last_ns, live.since_ns)
    off = _measure_difference(live, begin)
    end = _measure_difference(
        live, resolver.estimate_at(max(live.since_ns, end_ns - 1))
    )  # the event that ended it may have moved an anchor
    return LiveComparison(
        live,
        None if off is None else off[0],
        None if off is None else off[1],
        None if end is None else end[0],
        None if off is None else begin.error_at_anchor_m,
    )


def _measure_difference(live: AlignmentPeriod, solved: AlignmentEstimate) -> tuple[float, float] | None:
    """Return distance at the sheet [m] and angle [rad] between a live alignment and a solution."""
    if solved.refused:
        return None
    T: PoseTuple = (live.alignment.T_world_tracking.p, live.alignment.T_world_tracking.q)
    p_tracking = apply(inverse(solved.T_world_tracking), solved.pivot_world)
    return distance(apply(T, p_tracking), solved.pivot_world), quat_angle(T[1], solved.T_world_tracking[1])


def find_outliers(
    looks: Sequence[RecordedObservation], resolver: AlignmentSmoother, anchors: AnchorHistory
) -> list[Outlier]:
    """Return viewpoints that contradict the solution of their time, the worst first."""
    groups: dict[tuple[str, int], list[RecordedObservation]] = {}
    for look in looks:
        if look.observation.kind not in AnchorKind.NOT_SEEN:
            groups.setdefault((look.observation.anchor_id, look.observation.viewpoint_id), []).append(look)
    found = []
    for (anchor_id, viewpoint_id), group in groups.items():
        at_ns = group[len(group) // 2].observation.capture_ns
        place = anchors.get_poses(anchors.find_period(at_ns)).get(anchor_id)
        solved = resolver.estimate_at(at_ns)
        if place is None or solved.refused:
            continue
        seen = [
            compose(solved.T_world_tracking, observed_pose(look.observation))
            for look in group
            if is_rigid(observed_pose(look.observation))
        ]
        if not seen:
            continue
        middle = np.median(np.array([p for p, _ in seen]), axis=0)
        off_m = float(np.linalg.norm(middle - np.array(place[0])))
        off_rad = float(np.median([quat_angle(q, place[1]) for _, q in seen]))
        expected = math.hypot(solved.error_at(place[0]), noise_p95(group[len(group) // 2]))
        if off_m > BEYOND * expected:
            found.append(Outlier(anchor_id, viewpoint_id, len(group), off_m, off_rad, expected, at_ns))
    return sorted(found, key=lambda one: -one.off_m)


def noise_p95(look: RecordedObservation) -> float:
    """Return the 95 % bound [m] of the position error of a single observation like this one."""
    given = validate_covariance(observed_covariance(look.observation))
    if given:
        return length_p95(np.reshape(given, (6, 6))[:3, :3])
    config = AlignmentConfig()
    if look.p_tracking_head is None:
        return length_p95(isotropic_covariance(config.position_sigma_m, config.rotation_sigma_rad)[:3, :3])
    common, each = NoiseModel().compute_covariances(
        np.array(look.p_tracking_head), np.array(look.observation.T_tracking_anchor.p)
    )
    return length_p95((common + each)[:3, :3])


# --- constellations ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RelativePoses:
    """Poses of sheets relative to each other from all observations, or the reason why they are unknown (`advice`).

    `moved`: sheets that are no longer at their pose in the session (or the file); `moved_advice`: the reason if that is
    unknown.
    """

    solved: ConstellationSolution | None
    advice: str = ""
    moved: tuple[MovedSheet, ...] = ()
    moved_advice: str = ""


def solve_relative_poses(looks: AlignmentHistory, saved: Constellation) -> RelativePoses:
    """Solve the poses of all observed sheets, configured or not. `saved`: their expected poses and the reference."""
    seen = list(_list_sheet_observations(looks))
    names = {one.anchor_id for one in seen}
    if len(names) < 2:
        were = "sheet was" if len(names) == 1 else "sheets were"
        return RelativePoses(None, f"{len(names)} {were} seen: 2 are needed to say where they lie to each other")
    known = [name for name in (saved.reference, *saved.anchors) if name in names]
    reference = known[0] if known else min(names)
    try:
        solved = solve_constellation(
            seen, reference, saved.anchors.get(reference, IDENTITY_POSE), sizes=_sizes(looks, saved)
        )
    except ConstellationError as error:
        return RelativePoses(None, str(error))
    try:
        return RelativePoses(solved, moved=find_moved(saved, solved.constellation))
    except ConstellationError as error:
        return RelativePoses(solved, moved_advice=str(error))


def _list_sheet_observations(looks: AlignmentHistory) -> Iterable[SheetObservation]:
    for frame, every in looks.observations.items():
        groups: dict[tuple[str, int], int] = {}
        for look in every:
            o = look.observation
            key = (o.anchor_id, o.viewpoint_id)
            groups[key] = groups.get(key, 0) + 1
            if o.kind in SHEETS and groups[key] <= MAX_IN_GROUP and is_rigid(observed_pose(o)):
                headset = f"{frame.participant} {frame.run} {frame.jumps}"  # each jump begins another tracking frame
                yield SheetObservation(
                    headset, o.tracking_epoch, o.viewpoint_id, o.anchor_id, observed_pose(o), look.p_tracking_head
                )


def _sizes(looks: AlignmentHistory, saved: Constellation) -> dict[str, float]:
    """Return the size [m] of each sheet: as configured, else the median of the headsets' measurements."""
    measured: dict[str, list[float]] = {}
    for every in looks.observations.values():
        for look in every:
            if look.observation.size_m > 0.0 and math.isfinite(look.observation.size_m):
                measured.setdefault(look.observation.anchor_id, []).append(look.observation.size_m)
    return {name: float(np.median(values)) for name, values in measured.items()} | saved.sizes
