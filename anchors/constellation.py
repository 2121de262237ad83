"""Constellations: poses of several sheets relative to each other, solved from observations of any number of headsets.

Unknown are the world pose of every sheet but the reference, and `T_world_tracking` of every headset (and of each of its
tracking epochs). Observations of one sheet from one viewpoint are merged first (`anchors.viewpoints`); then all are
solved together on SE(3) with a robust loss. A saved constellation is compared with a new solution to name the sheets
that were moved. Pure: text in, text out; files are the caller's.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from anchors.lie import (
    Array,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_to_matrix,
    swing,
    to_quat,
    to_vec3,
)
from anchors.pose import IDENTITY_POSE, PoseTuple, Vec3, apply, compose, inverse, is_rigid, quat_angle, quat_normalize
from anchors.uncertainty import NoiseModel, isotropic_covariance, length_p95
from anchors.viewpoints import AnchorObservation, ViewpointGroup

FORMAT: Final = 1
_F_SCALE: Final = 3.0  # whitened residuals beyond it count less
#: Above so many poses the Jacobian is found by its pattern: of 50 poses in a twentieth of the time.
_FEW_POSES: Final = 12


class ConstellationError(ValueError):
    """Observations or a file that determine no constellation."""


@dataclass(frozen=True)
class SheetObservation:
    """One observation `T_tracking_anchor` of a sheet by a headset (any name) in one of its tracking epochs."""

    headset: str
    tracking_epoch: int
    viewpoint_id: int
    anchor_id: str
    T_tracking_anchor: PoseTuple
    p_tracking_head: Vec3 | None = None


@dataclass(frozen=True)
class Constellation:
    """`T_world_anchor` of each sheet. `error_m`: p95 of its position relative to the reference; sizes [m] where
    known; `marks`: positions of its marks by id, in the frame of the sheet [m], where it has any."""

    reference: str
    anchors: dict[str, PoseTuple]
    error_m: dict[str, float]
    sizes: dict[str, float]
    marks: dict[str, dict[str, Vec3]] = field(default_factory=dict)

    def to_toml(self) -> str:
        """Return the TOML text of an anchors file, for people to read and edit."""
        lines = [f"format = {FORMAT}", f"reference = {_quote(self.reference)}", ""]
        for name in sorted(self.anchors):
            p, q = self.anchors[name]
            lines.append(f"[anchors.{_quote(name)}]")
            lines.append(f"position_m = [{', '.join(repr(float(c)) for c in p)}]")
            lines.append(f"quaternion_wxyz = [{', '.join(repr(float(c)) for c in q)}]")
            lines.append(f"error_m = {float(self.error_m.get(name, 0.0))!r}")
            if name in self.sizes:
                lines.append(f"size_m = {float(self.sizes[name])!r}")
            if self.marks.get(name):
                lines.append(f"[anchors.{_quote(name)}.marks_m]")
                lines += [
                    f"{_quote(mark)} = [{', '.join(repr(float(c)) for c in at)}]"
                    for mark, at in self.marks[name].items()
                ]
            lines.append("")
        return "\n".join(lines)

    @staticmethod
    def from_toml(text: str) -> Constellation:
        """Parse the text of an anchors file.

        Raises:
            ConstellationError: The text is not one; the message names the key and what is wrong with it.
        """
        try:
            data = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise ConstellationError(f"not a TOML file: {error}") from error
        if data.get("format") != FORMAT:
            raise ConstellationError(f"format = {data.get('format')!r}: this version reads format = {FORMAT}")
        tables, reference = data.get("anchors"), data.get("reference")
        if not isinstance(tables, dict) or not isinstance(reference, str) or reference not in tables:
            raise ConstellationError("it needs [anchors.NAME] tables, and reference = one of their names")
        read = {name: _read_anchor(name, table) for name, table in tables.items()}
        return Constellation(
            reference,
            {name: pose for name, (pose, _, _) in read.items()},
            {name: error for name, (_, error, _) in read.items()},
            {name: size for name, (_, _, size) in read.items() if size > 0.0},
            {name: _read_marks(name, table["marks_m"]) for name, table in tables.items() if "marks_m" in table},
        )


def _quote(name: str) -> str:
    """Return a TOML string: printable names need the escapes of JSON and no others."""
    return json.dumps(name, ensure_ascii=False)


_KEYS: Final = ("position_m", "quaternion_wxyz", "error_m", "size_m", "marks_m")


def _read_anchor(name: str, table: Any) -> tuple[PoseTuple, float, float]:
    p, q = _read_numbers(name, table, "position_m", 3), _read_numbers(name, table, "quaternion_wxyz", 4)
    if abs(math.sqrt(sum(c * c for c in q)) - 1.0) > 1e-3:
        raise ConstellationError(f"anchors.{name}.quaternion_wxyz is no unit quaternion: {q}")
    pose: PoseTuple = ((p[0], p[1], p[2]), quat_normalize((q[0], q[1], q[2], q[3])))
    unknown = sorted(set(table) - set(_KEYS))
    if unknown:
        raise ConstellationError(f"anchors.{name}.{unknown[0]} is not known; known: {', '.join(_KEYS)}")
    extra = []
    for key in ("error_m", "size_m"):
        value = table.get(key, 0.0)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
            raise ConstellationError(f"anchors.{name}.{key} must be a length in metres")
        extra.append(float(value))
    return pose, extra[0], extra[1]


def _read_marks(name: str, table: Any) -> dict[str, Vec3]:
    if not isinstance(table, dict):
        raise ConstellationError(f"anchors.{name}.marks_m must be a table of positions by id of the mark")
    marks = {}
    for mark in table:
        x, y, z = _read_numbers(f"{name}.marks_m", table, mark, 3)
        marks[mark] = (x, y, z)
    return marks


def _read_numbers(name: str, table: Any, key: str, n: int) -> list[float]:
    values = table.get(key) if isinstance(table, dict) else None
    if not isinstance(values, list) or len(values) != n:
        raise ConstellationError(f"anchors.{name}.{key} must be a list of {n} numbers")
    if any(isinstance(v, bool) or not isinstance(v, int | float) or not math.isfinite(v) for v in values):
        raise ConstellationError(f"anchors.{name}.{key} must be finite numbers")
    return [float(v) for v in values]


@dataclass(frozen=True)
class ConstellationSolution:
    """A constellation, the headsets' alignments (by name and epoch) and residuals.

    `residuals_m`: per sheet, the root mean square distance of its observations. `rejected`: outliers as (headset,
    epoch, viewpoint, sheet).
    """

    constellation: Constellation
    T_world_tracking: dict[tuple[str, int], PoseTuple]
    residuals_m: dict[str, float]
    rejected: tuple[tuple[str, int, int, str], ...]


def solve_constellation(
    observations: Sequence[SheetObservation],
    reference: str,
    T_world_reference: PoseTuple = IDENTITY_POSE,
    noise: NoiseModel | None = None,
    sizes: Mapping[str, float] | None = None,
    tilt_sigma_rad: float = math.radians(0.2),
) -> ConstellationSolution:
    """Solve the poses of all observed sheets relative to `reference`.

    Two sheets are connected by a headset that observed both without losing its tracking in between.

    Args:
        observations: Observations of any number of headsets.
        reference: Sheet whose pose is given.
        T_world_reference: Its pose.
        noise: Noise model of the observations.
        sizes: Edge lengths [m] to include in the constellation.
        tilt_sigma_rad: Standard deviation of a headset's vertical.

    Raises:
        ConstellationError: The reference was not observed, or a sheet is not connected with it.
    """
    edges = merge_edges(observations, noise or NoiseModel(), isotropic_covariance(0.005, math.radians(0.6)))
    names = sorted({e.anchor_id for e in edges})
    if reference not in names:
        raise ConstellationError(f"sheet '{reference}' was not seen; seen: {', '.join(names) or 'none'}")
    lost = sorted(set(names) - find_reachable(edges, [reference]))
    if lost:
        raise ConstellationError(
            f"sheets not tied to '{reference}': {', '.join(lost)}; look at one of them and at one that is tied, one "
            "after the other, with the same headset"
        )
    graph = ObservationGraph(edges, {reference: T_world_reference})
    weights, x = np.ones(len(edges)), initial_guess(graph)
    for _ in range(3):  # outliers are left out for good, otherwise they would still pull
        solved = solve_graph(graph, x, weights, tilt_sigma_rad)
        x = solved.p, solved.q
        now = (solved.distance2 <= 30.0).astype(np.float64)  # chi-square of 6 degrees at 4e-5
        if bool(np.all(now == weights)):
            break
        weights = now
    kept = [e for e, weight in zip(edges, weights.tolist(), strict=True) if weight > 0.0]
    unconnected = sorted(set(names) - find_reachable(kept, [reference]))
    if unconnected:  # their poses are undetermined, so no error could be stated
        raise ConstellationError(
            f"what was seen of {', '.join(unconnected)} contradicts itself or the other sheets: were sheets moved "
            "meanwhile? look at each of them again"
        )
    return _to_solution(graph, solved, reference, weights, sizes or {})


def _to_solution(
    graph: ObservationGraph, solved: GraphSolution, reference: str, weights: Array, sizes: Mapping[str, float]
) -> ConstellationSolution:
    poses = [(to_vec3(p), to_quat(q)) for p, q in zip(solved.p, solved.q, strict=True)]
    n = len(graph.unknown)
    anchors = {**graph.known, **dict(zip(graph.unknown, poses[:n], strict=True))}
    headsets = dict(zip(graph.headsets, poses[n:], strict=True))
    error = {reference: 0.0}
    for i, name in enumerate(graph.unknown):
        error[name] = length_p95(solved.covariance[6 * i : 6 * i + 3, 6 * i : 6 * i + 3])
    off: dict[str, list[float]] = {}
    rejected = []
    for e, weight in zip(graph.edges, weights.tolist(), strict=True):
        if weight == 0.0:
            rejected.append((e.headset, e.tracking_epoch, e.viewpoint_id, e.anchor_id))
            continue
        seen = apply(headsets[e.headset, e.tracking_epoch], to_vec3(e.p))
        off.setdefault(e.anchor_id, []).append(math.dist(seen, anchors[e.anchor_id][0]))
    rms = {name: math.sqrt(sum(d * d for d in ds) / len(ds)) for name, ds in off.items()}
    known = {name: size for name, size in sizes.items() if name in anchors}
    return ConstellationSolution(Constellation(reference, anchors, error, known), headsets, rms, tuple(rejected))


@dataclass(frozen=True)
class MovedSheet:
    """A sheet that was moved relative to the others, and by how much."""

    anchor_id: str
    distance_m: float
    angle_rad: float


def find_moved(
    saved: Constellation, now: Constellation, min_m: float = 0.005, min_rad: float = math.radians(1.5)
) -> tuple[MovedSheet, ...]:
    """Return the sheets that moved relative to the largest set that stayed.

    Raises:
        ConstellationError: That set is no majority; of two sheets either may have moved.
    """
    names = sorted(set(saved.anchors) & set(now.anchors))
    if len(names) < 2:
        raise ConstellationError(f"{len(names)} sheets in common with the saved constellation: 2 are needed to compare")
    agreeing = {a: [b for b in names if _measure_move(saved, now, a, b, min_m, min_rad) is None] for a in names}
    base = max(names, key=lambda a: (len(agreeing[a]), a == saved.reference))
    stayed = agreeing[base]
    if len(stayed) == len(names):
        return ()
    if 2 * len(stayed) <= len(names):
        raise ConstellationError(
            f"sheets {', '.join(names)} no longer lie as they did, and no majority of them agrees: save them anew"
        )
    moved = [
        m for b in names if b not in stayed and (m := _measure_move(saved, now, base, b, min_m, min_rad)) is not None
    ]
    return tuple(sorted(moved, key=lambda m: -m.distance_m))


def _measure_move(
    saved: Constellation, now: Constellation, a: str, b: str, min_m: float, min_rad: float
) -> MovedSheet | None:
    """Return how far `b` moved relative to `a`, `None` if stated errors and the rotation of `a` explain it."""
    (p0, q0), (p1, q1) = (compose(inverse(c.anchors[a]), c.anchors[b]) for c in (saved, now))
    lever = math.dist(p0, (0.0, 0.0, 0.0))
    far, turn = math.dist(p0, p1), quat_angle(q0, q1)
    errors = (saved.error_m.get(a, 0.0), saved.error_m.get(b, 0.0), now.error_m.get(a, 0.0), now.error_m.get(b, 0.0))
    slack = math.sqrt(sum(e * e for e in errors)) + 0.25 * min_rad * lever
    return MovedSheet(b, far, turn) if far > min_m + slack or turn > min_rad else None


# --- graph of observations --------------------------------------------------------------------------------------------
HeadsetKey = tuple[str, int]


@dataclass(frozen=True)
class Edge:
    """Merged observation of one sheet by one headset (or camera) from one viewpoint: `T_tracking_anchor` and its
    covariance (6, 6)."""

    headset: str
    tracking_epoch: int
    viewpoint_id: int
    anchor_id: str
    p: Array
    q: Array
    covariance: Array


def merge_edges(observations: Sequence[SheetObservation], noise: NoiseModel, fallback: Array) -> list[Edge]:
    """Return one edge per viewpoint and sheet, without invalid poses and viewpoints whose observations disagree."""
    groups: dict[tuple[str, int, int, str], ViewpointGroup] = {}
    for o in observations:
        if is_rigid(o.T_tracking_anchor):
            p, q = o.T_tracking_anchor
            sighting = AnchorObservation(0, p, quat_normalize(q), o.p_tracking_head, (), 1.0, 0.0)
            key = (o.headset, o.tracking_epoch, o.viewpoint_id, o.anchor_id)
            groups.setdefault(key, ViewpointGroup()).observations.append(sighting)
    merged = [(key, group.merge(noise, fallback, 0.6)) for key, group in sorted(groups.items())]
    return [Edge(*key, one.p, one.q, one.covariance) for key, one in merged if one is not None]


def find_reachable(edges: Sequence[Edge], known: Collection[str]) -> set[str]:
    """Return the sheets that are connected with known ones by observations."""
    by_headset: dict[HeadsetKey, set[str]] = {}
    for e in edges:
        by_headset.setdefault((e.headset, e.tracking_epoch), set()).add(e.anchor_id)
    reached, grown = set(known), True
    while grown:
        grown = False
        for sheets in by_headset.values():
            if sheets & reached and not sheets <= reached:
                reached |= sheets
                grown = True
    return reached


class ObservationGraph:
    """Edges between headsets and sheets as arrays. Poses are ordered: unknown sheets, headsets, known sheets."""

    def __init__(self, edges: Sequence[Edge], known: Mapping[str, PoseTuple]) -> None:
        """Create a graph.

        Args:
            edges: Observations.
            known: Poses of the sheets that fix the frame.
        """
        self.edges, self.known = edges, known
        self.unknown = sorted({e.anchor_id for e in edges} - set(known))
        self.headsets = sorted({(e.headset, e.tracking_epoch) for e in edges})
        names: list[Any] = [*self.unknown, *self.headsets, *known]
        at = {name: i for i, name in enumerate(names)}
        #: Index of each edge's sheet and headset among all poses.
        self.sheet_index = np.array([at[e.anchor_id] for e in edges])
        self.headset_index = np.array([at[e.headset, e.tracking_epoch] for e in edges])
        self.p, self.q = np.array([e.p for e in edges]), np.array([e.q for e in edges])
        information = np.linalg.inv(np.array([e.covariance for e in edges]))
        self.whitening = np.swapaxes(np.linalg.cholesky(information), 1, 2)
        self._p_known = np.array([p for p, _ in known.values()])
        self._q_known = np.array([q for _, q in known.values()])

    def compute_residuals(self, p: Array, q: Array) -> Array:
        """Return observed minus predicted `T_tracking_anchor` in units of their noise, shape (edges, 6).

        Args:
            p: Positions of unknown sheets, then headsets, shape (n, 3) [m].
            q: Their rotations, shape (n, 4).
        """
        pa, qa = np.vstack([p, self._p_known])[self.sheet_index], np.vstack([q, self._q_known])[self.sheet_index]
        ph, qh = p[self.headset_index], q[self.headset_index]
        R = quat_to_matrix(quat_conjugate(qh))
        r_p = self.p - np.einsum("eij,ej->ei", R, pa - ph)
        r_q = quat_log(quat_multiply(self.q, quat_conjugate(quat_multiply(quat_conjugate(qh), qa))))
        return np.asarray(np.einsum("eij,ej->ei", self.whitening, np.concatenate([r_p, r_q], axis=1)))

    def find_jacobian_pattern(self) -> Any:
        """Return where the Jacobian of `solve_graph` is not zero, as a sparse matrix: residuals by increments."""
        from scipy.sparse import lil_matrix

        n_edges, n_sheets, n = len(self.edges), len(self.unknown), len(self.unknown) + len(self.headsets)
        pattern = lil_matrix((6 * n_edges + 2 * len(self.headsets), 6 * n), dtype=np.int8)
        for i in range(n_edges):
            for k in (self.sheet_index[i], self.headset_index[i]):
                if k < n:
                    pattern[6 * i : 6 * i + 6, 6 * k : 6 * k + 6] = 1
        for j in range(len(self.headsets)):
            row, k = 6 * n_edges + 2 * j, n_sheets + j
            pattern[row : row + 2, 6 * k : 6 * k + 6] = 1
        return pattern


def initial_guess(graph: ObservationGraph) -> tuple[Array, Array]:
    """Return an initial guess: outwards from the known sheets, each pose by its most certain edge."""
    poses: dict[Any, tuple[Array, Array]] = {name: (np.array(p), np.array(q)) for name, (p, q) in graph.known.items()}
    by_certainty = sorted(graph.edges, key=lambda e: float(np.trace(e.covariance[:3, :3])))
    wanted = [*graph.unknown, *graph.headsets]
    while not poses.keys() >= set(wanted):
        for e in by_certainty:
            key = (e.headset, e.tracking_epoch)
            if e.anchor_id in poses and key not in poses:
                p, q = poses[e.anchor_id]
                q_h = quat_multiply(q, quat_conjugate(e.q))
                poses[key] = (p - quat_to_matrix(q_h) @ e.p, q_h)
                break
            if key in poses and e.anchor_id not in poses:
                p, q = poses[key]
                poses[e.anchor_id] = (p + quat_to_matrix(q) @ e.p, quat_multiply(q, e.q))
                break
        else:
            raise ConstellationError("some sheets are not connected with a known one")
    return np.array([poses[name][0] for name in wanted]), np.array([poses[name][1] for name in wanted])


class GraphSolution(NamedTuple):
    """Poses `p` (n, 3) [m], `q` (n, 4) of unknown sheets and headsets, covariance (6n, 6n) of their increments
    (position, rotation on the left), squared distances of all edges in units of their noise, and half the sum of the
    robust ones."""

    p: Array
    q: Array
    covariance: Array
    distance2: Array
    cost: float


def solve_graph(
    graph: ObservationGraph,
    x0: tuple[Array, Array],
    weights: Array,
    tilt_sigma_rad: float = math.inf,
    loss: Literal["soft_l1", "huber"] = "soft_l1",
) -> GraphSolution:
    """Run robust least squares over increments of all poses.

    Args:
        graph: Observations; all its poses must be connected with a known sheet.
        x0: Initial guess, positions and rotations.
        weights: Of the edges, shape (edges,).
        tilt_sigma_rad: Standard deviation of a headset's vertical; infinite: nothing is known of it.
        loss: How residuals beyond three standard deviations count.

    Returns:
        The poses.
    """
    from scipy.optimize import least_squares

    p0, q0 = x0

    def move(step: Array) -> tuple[Array, Array]:
        d = step.reshape(-1, 6)
        return p0 + d[:, :3], quat_multiply(quat_exp(d[:, 3:]), q0)

    def residuals(step: Array) -> Array:
        p, q = move(step)
        tilt = swing(q[len(graph.unknown) :]) / tilt_sigma_rad
        return np.concatenate([(graph.compute_residuals(p, q) * weights[:, None]).ravel(), tilt.ravel()])

    got = least_squares(
        residuals,
        np.zeros(6 * len(p0)),
        loss=loss,
        f_scale=_F_SCALE,
        x_scale="jac",
        method="trf",
        jac_sparsity=graph.find_jacobian_pattern() if len(p0) > _FEW_POSES else None,
    )
    p, q = move(got.x)
    jacobian = got.jac if len(p0) <= _FEW_POSES else got.jac.toarray()
    covariance = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    return GraphSolution(p, q, covariance, np.sum(graph.compute_residuals(p, q) ** 2, axis=1), float(got.cost))
