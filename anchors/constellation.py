"""Constellations: where several sheets lie relative to each other, solved from what any number of headsets saw of them.

Unknown are the world pose of every sheet but the reference, and `T_world_tracking` of every headset (and of each of its
tracking epochs). Observations of one sheet from one viewpoint are merged first (`anchors.robust`); then all are solved
together on SE(3) with a robust loss. A saved constellation is compared with a new solution to name the sheets that were
moved. Pure: text in, text out; files are the caller's.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from anchors.graph import ObservationGraph, merge_edges, find_reachable, initial_guess
from anchors.lie import Array, quat_conjugate, quat_exp, quat_log, quat_to_matrix, quat_multiply, swing
from anchors.noise import NoiseModel, isotropic_covariance
from anchors.pose import IDENTITY_POSE, PoseTuple, Vec3, apply, compose, inverse, quat_angle, quat_normalize
from anchors.uncertainty import length_p95

FORMAT: Final = 1
_F_SCALE: Final = 3.0  # whitened residuals beyond it count less (soft L1)


class ConstellationError(ValueError):
    """Observations or a file from which no constellation can be made. The text says what would help."""


@dataclass(frozen=True)
class SheetObservation:
    """One observation `T_tracking_anchor` by a headset (any name) in one of its tracking epochs."""

    headset: str
    tracking_epoch: int
    viewpoint_id: int
    anchor_id: str
    T_tracking_anchor: PoseTuple
    p_tracking_head: Vec3 | None = None


@dataclass(frozen=True)
class Constellation:
    """`T_world_anchor` of each sheet. `error_m`: p95 of its position relative to the reference; sizes [m] where
    known."""

    reference: str
    anchors: dict[str, PoseTuple]
    error_m: dict[str, float]
    sizes: dict[str, float]

    def to_toml(self) -> str:
        """As a person reads and edits it."""
        lines = [f"format = {FORMAT}", f"reference = {_quoted(self.reference)}", ""]
        for name in sorted(self.anchors):
            p, q = self.anchors[name]
            lines.append(f"[anchors.{_quoted(name)}]")
            lines.append(f"position_m = [{', '.join(repr(float(c)) for c in p)}]")
            lines.append(f"quaternion_wxyz = [{', '.join(repr(float(c)) for c in q)}]")
            lines.append(f"error_m = {float(self.error_m.get(name, 0.0))!r}")
            if name in self.sizes:
                lines.append(f"size_m = {float(self.sizes[name])!r}")
            lines.append("")
        return "\n".join(lines)

    @staticmethod
    def from_toml(text: str) -> Constellation:
        """Reads what `to_toml` wrote. Raises `ConstellationError` that says what is wrong and where."""
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
        )


def _quoted(name: str) -> str:
    """A string of TOML: printable names need the escapes of JSON and no others."""
    return json.dumps(name, ensure_ascii=False)


_KEYS: Final = ("position_m", "quaternion_wxyz", "error_m", "size_m")


def _read_anchor(name: str, table: Any) -> tuple[PoseTuple, float, float]:
    p, q = _numbers(name, table, "position_m", 3), _numbers(name, table, "quaternion_wxyz", 4)
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


def _numbers(name: str, table: Any, key: str, n: int) -> list[float]:
    values = table.get(key) if isinstance(table, dict) else None
    if not isinstance(values, list) or len(values) != n:
        raise ConstellationError(f"anchors.{name}.{key} must be a list of {n} numbers")
    if any(isinstance(v, bool) or not isinstance(v, int | float) or not math.isfinite(v) for v in values):
        raise ConstellationError(f"anchors.{name}.{key} must be finite numbers")
    return [float(v) for v in values]


@dataclass(frozen=True)
class ConstellationSolution:
    """A constellation, the headsets' alignments (by name and epoch) and how well each look fits.

    `residuals_m`: per sheet, the root mean square of how far looks put it off. `rejected`: looks that fit nowhere, as
    (headset, epoch, viewpoint, sheet).
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
    """All sheets that were seen, relative to `reference`. Raises `ConstellationError` where sheets hang together by no
    look: two sheets are tied by a headset that saw both without losing its tracking in between."""
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
    for _ in range(3):  # what fits nowhere is left out for good, else it would still pull
        x, covariance, distance2 = _least_squares(graph, x, weights, tilt_sigma_rad)
        now = (distance2 <= 30.0).astype(np.float64)  # chi-square of 6 degrees at 4e-5
        if bool(np.all(now == weights)):
            break
        weights = now
    kept = [e for e, weight in zip(edges, weights.tolist(), strict=True) if weight > 0.0]
    adrift = sorted(set(names) - find_reachable(kept, reference))
    if adrift:  # nothing holds them in place any more, so no error could be stated
        raise ConstellationError(
            f"what was seen of {', '.join(adrift)} contradicts itself or the other sheets: were sheets moved "
            "meanwhile? look at each of them again"
        )
    return _solved(graph, x, covariance, weights, sizes or {})


def _least_squares(
    graph: ObservationGraph, x0: tuple[Array, Array], weights: Array, tilt_sigma_rad: float
) -> tuple[tuple[Array, Array], Array, Array]:
    """Robust least squares over increments of all poses; returns poses, covariance of the increments, and distances."""
    from scipy.optimize import least_squares

    p0, q0 = x0
    n = len(p0)

    def poses(step: Array) -> tuple[Array, Array]:
        d = step.reshape(n, 6)
        return p0 + d[:, :3], quat_multiply(quat_exp(d[:, 3:]), q0)

    def residuals(step: Array) -> Array:
        p, q = poses(step)
        whitened = _whitened(graph, p, q) * weights[:, None]
        tilt = swing(q[graph.n_anchors :]) / tilt_sigma_rad
        return np.concatenate([whitened.ravel(), tilt.ravel()])

    got = least_squares(
        residuals, np.zeros(6 * n), loss="soft_l1", f_scale=_F_SCALE, x_scale="jac", method="trf",
        jac_sparsity=graph.sparsity() if n > 12 else None, max_nfev=60,
    )  # fmt: skip
    J = got.jac.toarray() if hasattr(got.jac, "toarray") else got.jac
    p, q = poses(got.x)
    covariance = np.linalg.pinv(J.T @ J, hermitian=True)
    return (p, q), covariance, np.sum(_whitened(graph, p, q) ** 2, axis=1)


def _whitened(graph: ObservationGraph, p: Array, q: Array) -> Array:
    """(edges, 6): seen minus predicted `T_tracking_anchor`, in units of their noise."""
    pa, qa = graph.anchor_poses(p, q)
    ph, qh = p[graph.headset_index], q[graph.headset_index]
    R = quat_to_matrix(quat_conjugate(qh))
    r_p = graph.p - np.einsum("eij,ej->ei", R, pa - ph)
    r_q = quat_log(quat_multiply(graph.q, quat_conjugate(quat_multiply(quat_conjugate(qh), qa))))
    return np.asarray(np.einsum("eij,ej->ei", graph.whitening, np.concatenate([r_p, r_q], axis=1)))


def _solved(
    graph: ObservationGraph, x: tuple[Array, Array], covariance: Array, weights: Array, sizes: Mapping[str, float]
) -> ConstellationSolution:
    p, q = x
    anchors = {graph.reference: graph.T_world_reference}
    error = {graph.reference: 0.0}
    for i, name in enumerate(graph.unknown):
        anchors[name] = _pose(p[i], q[i])
        error[name] = length_p95(covariance[6 * i : 6 * i + 3, 6 * i : 6 * i + 3])
    headsets = {key: _pose(p[graph.n_anchors + i], q[graph.n_anchors + i]) for i, key in enumerate(graph.headsets)}
    off: dict[str, list[float]] = {}
    rejected = []
    for e, weight in zip(graph.edges, weights.tolist(), strict=True):
        if weight == 0.0:
            rejected.append((e.headset, e.tracking_epoch, e.viewpoint_id, e.anchor_id))
            continue
        seen = apply(headsets[e.headset, e.tracking_epoch], (float(e.p[0]), float(e.p[1]), float(e.p[2])))
        off.setdefault(e.anchor_id, []).append(math.dist(seen, anchors[e.anchor_id][0]))
    rms = {name: math.sqrt(sum(d * d for d in ds) / len(ds)) for name, ds in off.items()}
    known = {name: size for name, size in sizes.items() if name in anchors}
    return ConstellationSolution(Constellation(graph.reference, anchors, error, known), headsets, rms, tuple(rejected))


def _pose(p: Array, q: Array) -> PoseTuple:
    return (float(p[0]), float(p[1]), float(p[2])), quat_normalize((float(q[0]), float(q[1]), float(q[2]), float(q[3])))


@dataclass(frozen=True)
class MovedSheet:
    """A sheet that no longer lies where it did relative to the others, and by how much."""

    anchor_id: str
    distance_m: float
    angle_rad: float


def find_moved(
    saved: Constellation, now: Constellation, min_m: float = 0.005, min_rad: float = math.radians(1.5)
) -> tuple[MovedSheet, ...]:
    """Sheets that moved relative to those that stayed, which are the largest set that agrees. Raises
    `ConstellationError` when that is no majority: of two sheets nobody can say which one moved."""
    names = sorted(set(saved.anchors) & set(now.anchors))
    if len(names) < 2:
        raise ConstellationError(f"{len(names)} sheets in common with the saved constellation: 2 are needed to compare")
    agreeing = {a: [b for b in names if _moves(saved, now, a, b, min_m, min_rad) is None] for a in names}
    base = max(names, key=lambda a: (len(agreeing[a]), a == saved.reference))
    stayed = agreeing[base]
    if len(stayed) == len(names):
        return ()
    if 2 * len(stayed) <= len(names):
        raise ConstellationError(
            f"sheets {', '.join(names)} no longer lie as they did, and no majority of them agrees: save them anew"
        )
    moved = [m for b in names if b not in stayed and (m := _moves(saved, now, base, b, min_m, min_rad)) is not None]
    return tuple(sorted(moved, key=lambda m: -m.distance_m))


def _moves(saved: Constellation, now: Constellation, a: str, b: str, min_m: float, min_rad: float) -> MovedSheet | None:
    """How far `b` moved as seen from `a`; what the stated errors and the turn of `a` explain is no move."""
    p0, q0 = _relative(saved, a, b)
    p1, q1 = _relative(now, a, b)
    lever = math.dist(p0, (0.0, 0.0, 0.0))
    far, turn = math.dist(p0, p1), quat_angle(q0, q1)
    errors = (saved.error_m.get(a, 0.0), saved.error_m.get(b, 0.0), now.error_m.get(a, 0.0), now.error_m.get(b, 0.0))
    slack = math.sqrt(sum(e * e for e in errors)) + 0.25 * min_rad * lever
    return MovedSheet(b, far, turn) if far > min_m + slack or turn > min_rad else None


def _relative(c: Constellation, a: str, b: str) -> PoseTuple:
    return compose(inverse(c.anchors[a]), c.anchors[b])
