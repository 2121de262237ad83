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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

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
_F_SCALE: Final = 3.0  # whitened residuals beyond it count less (soft L1)


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
    lost = sorted(set(names) - find_reachable(edges, reference))
    if lost:
        raise ConstellationError(
            f"sheets not tied to '{reference}': {', '.join(lost)}; look at one of them and at one that is tied, one "
            "after the other, with the same headset"
        )
    graph = ObservationGraph(edges, [n for n in names if n != reference], reference, T_world_reference)
    weights = np.ones(len(edges))
    x = initial_guess(graph)
    covariance = np.zeros((0, 0))
    for _ in range(3):  # outliers are left out for good, otherwise they would still pull
        x, covariance, distance2 = _least_squares(graph, x, weights, tilt_sigma_rad)
        now = (distance2 <= 30.0).astype(np.float64)  # chi-square of 6 degrees at 4e-5
        if bool(np.all(now == weights)):
            break
        weights = now
    kept = [e for e, weight in zip(edges, weights.tolist(), strict=True) if weight > 0.0]
    unconnected = sorted(set(names) - find_reachable(kept, reference))
    if unconnected:  # their poses are undetermined, so no error could be stated
        raise ConstellationError(
            f"what was seen of {', '.join(unconnected)} contradicts itself or the other sheets: were sheets moved "
            "meanwhile? look at each of them again"
        )
    return _to_solution(graph, x, covariance, weights, sizes or {})


def _least_squares(
    graph: ObservationGraph, x0: tuple[Array, Array], weights: Array, tilt_sigma_rad: float
) -> tuple[tuple[Array, Array], Array, Array]:
    """Run robust least squares over increments of all poses; return poses, covariance of the increments, and squared
    distances of all edges."""
    from scipy.optimize import least_squares

    p0, q0 = x0
    n = len(p0)

    def poses(step: Array) -> tuple[Array, Array]:
        d = step.reshape(n, 6)
        return p0 + d[:, :3], quat_multiply(quat_exp(d[:, 3:]), q0)

    def residuals(step: Array) -> Array:
        p, q = poses(step)
        whitened = _whiten_residuals(graph, p, q) * weights[:, None]
        tilt = swing(q[graph.n_anchors :]) / tilt_sigma_rad
        return np.concatenate([whitened.ravel(), tilt.ravel()])

    got = least_squares(
        residuals, np.zeros(6 * n), loss="soft_l1", f_scale=_F_SCALE, x_scale="jac", method="trf",
        jac_sparsity=graph.sparsity() if n > 12 else None, max_nfev=60,
    )  # fmt: skip
    J = got.jac.toarray() if hasattr(got.jac, "toarray") else got.jac
    p, q = poses(got.x)
    covariance = np.linalg.pinv(J.T @ J, hermitian=True)
    return (p, q), covariance, np.sum(_whiten_residuals(graph, p, q) ** 2, axis=1)


def _whiten_residuals(graph: ObservationGraph, p: Array, q: Array) -> Array:
    """Return observed minus predicted `T_tracking_anchor` in units of their noise, shape (edges, 6)."""
    pa, qa = graph.anchor_poses(p, q)
    ph, qh = p[graph.headset_index], q[graph.headset_index]
    R = quat_to_matrix(quat_conjugate(qh))
    r_p = graph.p - np.einsum("eij,ej->ei", R, pa - ph)
    r_q = quat_log(quat_multiply(graph.q, quat_conjugate(quat_multiply(quat_conjugate(qh), qa))))
    return np.asarray(np.einsum("eij,ej->ei", graph.whitening, np.concatenate([r_p, r_q], axis=1)))


def _to_solution(
    graph: ObservationGraph, x: tuple[Array, Array], covariance: Array, weights: Array, sizes: Mapping[str, float]
) -> ConstellationSolution:
    p, q = x
    anchors = {graph.reference: graph.T_world_reference}
    error = {graph.reference: 0.0}
    for i, name in enumerate(graph.unknown):
        anchors[name] = (to_vec3(p[i]), to_quat(q[i]))
        error[name] = length_p95(covariance[6 * i : 6 * i + 3, 6 * i : 6 * i + 3])
    headsets = {
        key: (to_vec3(p[graph.n_anchors + i]), to_quat(q[graph.n_anchors + i])) for i, key in enumerate(graph.headsets)
    }
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
    return ConstellationSolution(Constellation(graph.reference, anchors, error, known), headsets, rms, tuple(rejected))


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
    p0, q0 = _relative_to_pose(saved, a, b)
    p1, q1 = _relative_to_pose(now, a, b)
    lever = math.dist(p0, (0.0, 0.0, 0.0))
    far, turn = math.dist(p0, p1), quat_angle(q0, q1)
    errors = (saved.error_m.get(a, 0.0), saved.error_m.get(b, 0.0), now.error_m.get(a, 0.0), now.error_m.get(b, 0.0))
    slack = math.sqrt(sum(e * e for e in errors)) + 0.25 * min_rad * lever
    return MovedSheet(b, far, turn) if far > min_m + slack or turn > min_rad else None


def _relative_to_pose(c: Constellation, a: str, b: str) -> PoseTuple:
    return compose(inverse(c.anchors[a]), c.anchors[b])


# --- graph of observations --------------------------------------------------------------------------------------------
HeadsetKey = tuple[str, int]


@dataclass(frozen=True)
class Edge:
    """Merged observation of one sheet by one headset from one viewpoint: `T_tracking_anchor` and its covariance (6,
    6)."""

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
        if not is_rigid(o.T_tracking_anchor):
            continue
        p, q = o.T_tracking_anchor
        sighting = AnchorObservation(0, p, quat_normalize(q), o.p_tracking_head, (), 1.0, 0.0)
        groups.setdefault(
            (o.headset, o.tracking_epoch, o.viewpoint_id, o.anchor_id), ViewpointGroup()
        ).observations.append(sighting)
    edges = []
    for (headset, epoch, viewpoint, anchor_id), group in sorted(groups.items()):
        merged = group.merge(noise, fallback, 0.6)
        if merged is not None:
            edges.append(Edge(headset, epoch, viewpoint, anchor_id, merged.p, merged.q, merged.covariance))
    return edges


def find_reachable(edges: Sequence[Edge], reference: str) -> set[str]:
    """Return the sheets that are connected with the reference by observations."""
    by_headset: dict[HeadsetKey, set[str]] = {}
    for e in edges:
        by_headset.setdefault((e.headset, e.tracking_epoch), set()).add(e.anchor_id)
    known, grown = {reference}, True
    while grown:
        grown = False
        for sheets in by_headset.values():
            if sheets & known and not sheets <= known:
                known |= sheets
                grown = True
    return known


@dataclass(frozen=True)
class ObservationGraph:
    """Edges between headsets and sheets as arrays. Poses are ordered: sheets other than the reference, then
    headsets."""

    edges: list[Edge]
    unknown: list[str]
    reference: str
    T_world_reference: PoseTuple

    @property
    def n_anchors(self) -> int:
        return len(self.unknown)

    @cached_property
    def headsets(self) -> list[HeadsetKey]:
        return sorted({(e.headset, e.tracking_epoch) for e in self.edges})

    @cached_property
    def headset_index(self) -> np.ndarray[Any, np.dtype[np.intp]]:
        """Index of each edge's headset among all poses."""
        at = {key: i + self.n_anchors for i, key in enumerate(self.headsets)}
        return np.array([at[e.headset, e.tracking_epoch] for e in self.edges], dtype=np.intp)

    @cached_property
    def anchor_index(self) -> np.ndarray[Any, np.dtype[np.intp]]:
        """Index of each edge's sheet among all poses followed by the reference."""
        at = {name: i for i, name in enumerate(self.unknown)}
        last = self.n_anchors + len(self.headsets)
        return np.array([at.get(e.anchor_id, last) for e in self.edges], dtype=np.intp)

    @cached_property
    def p(self) -> Array:
        return np.array([e.p for e in self.edges])

    @cached_property
    def q(self) -> Array:
        return np.array([e.q for e in self.edges])

    @cached_property
    def whitening(self) -> Array:
        covariance = np.array([e.covariance for e in self.edges])
        return np.asarray(np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), 1, 2))

    def anchor_poses(self, p: Array, q: Array) -> tuple[Array, Array]:
        """Return the pose of each edge's sheet: positions (edges, 3), quaternions (edges, 4)."""
        p_ref, q_ref = self.T_world_reference
        return np.vstack([p, p_ref])[self.anchor_index], np.vstack([q, q_ref])[self.anchor_index]

    def sparsity(self) -> Any:
        """Return the sparsity pattern of the Jacobian: residuals by increments."""
        from scipy.sparse import lil_matrix

        n = self.n_anchors + len(self.headsets)
        S = lil_matrix((6 * len(self.edges) + 2 * len(self.headsets), 6 * n), dtype=np.int8)
        for i, (a, h) in enumerate(zip(self.anchor_index.tolist(), self.headset_index.tolist(), strict=True)):
            for k in (a, h):
                if k < n:
                    S[6 * i : 6 * i + 6, 6 * k : 6 * k + 6] = 1
        for j in range(len(self.headsets)):
            k = self.n_anchors + j
            S[6 * len(self.edges) + 2 * j : 6 * len(self.edges) + 2 * j + 2, 6 * k : 6 * k + 6] = 1
        return S


def initial_guess(graph: ObservationGraph) -> tuple[Array, Array]:
    """Return an initial guess: outwards from the reference, each pose by its most certain edge."""
    p_ref, q_ref = (np.array(part) for part in graph.T_world_reference)
    sheets: dict[str, tuple[Array, Array]] = {graph.reference: (p_ref, q_ref)}
    headsets: dict[HeadsetKey, tuple[Array, Array]] = {}
    by_certainty = sorted(graph.edges, key=lambda e: float(np.trace(e.covariance[:3, :3])))
    while len(headsets) < len(graph.headsets) or len(sheets) <= graph.n_anchors:
        for e in by_certainty:
            key = (e.headset, e.tracking_epoch)
            if e.anchor_id in sheets and key not in headsets:
                p, q = sheets[e.anchor_id]
                q_h = quat_multiply(q, quat_conjugate(e.q))
                headsets[key] = (p - quat_to_matrix(q_h) @ e.p, q_h)
                break
            if key in headsets and e.anchor_id not in sheets:
                p, q = headsets[key]
                sheets[e.anchor_id] = (p + quat_to_matrix(q) @ e.p, quat_multiply(q, e.q))
                break
        else:
            break
    rows = [sheets[name] for name in graph.unknown] + [headsets[key] for key in graph.headsets]
    return np.array([r[0] for r in rows]), np.array([r[1] for r in rows])
