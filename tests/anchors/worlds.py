"""Headsets that observe sheets, with the noise of docs/anchors.md, seeded."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from anchors.alignment import AlignmentEstimate, AlignmentEstimator
from anchors.lie import Array, quat_exp, quat_multiply, quat_to_matrix, to_vec3
from anchors.pose import PoseTuple, Vec3, apply, compose, inverse
from anchors.uncertainty import NoiseModel

NOISE = NoiseModel()


@dataclass
class Viewpoint:
    """A viewpoint on a sheet; `common` is its constant error, `new()` draws one more observation."""

    rng: np.random.Generator
    T_world_anchor: PoseTuple
    p_head_world: Vec3
    noise: float = 1.0  # 0: exact

    def __post_init__(self) -> None:
        head, p = np.array(self.p_head_world), np.array(self.T_world_anchor[0])
        self._common, self._each = NOISE.compute_covariances(head, p)
        self.common = self._draw(self._common)

    def observe(self, T_world_tracking: PoseTuple, T_world_anchor: PoseTuple | None = None) -> PoseTuple:
        """`T_tracking_anchor` as detected."""
        error = self.common + self._draw(self._each)
        p, q = T_world_anchor or self.T_world_anchor
        turned = quat_multiply(quat_exp(error[3:]), np.array(q)).tolist()
        seen: PoseTuple = (to_vec3(np.array(p) + error[:3]), (turned[0], turned[1], turned[2], turned[3]))
        return compose(inverse(T_world_tracking), seen)

    def head_pose(self, T_world_tracking: PoseTuple) -> Vec3:
        return apply(inverse(T_world_tracking), self.p_head_world)

    def _draw(self, C: Array) -> Array:
        return self.noise * (np.linalg.cholesky(C) @ self.rng.normal(size=6))


def viewpoint_around(rng: np.random.Generator, p: Vec3, d: float) -> Vec3:
    """Return a pose about `d` metres from a point, 40 to 80 degrees up."""
    up, way = math.radians(rng.uniform(40.0, 80.0)), rng.uniform(-math.pi, math.pi)
    return to_vec3(
        np.array(p) + d * np.array([math.cos(up) * math.cos(way), math.cos(up) * math.sin(way), math.sin(up)])
    )


def align_to_sheet(rng: np.random.Generator, sheet: PoseTuple, T_world_tracking: PoseTuple) -> AlignmentEstimate:
    """Return the estimate from 20 detections of one sheet at each of three viewpoints."""
    estimator = AlignmentEstimator({"sheet": sheet})
    for viewpoint in range(3):
        view = Viewpoint(rng, sheet, viewpoint_around(rng, sheet[0], rng.uniform(0.4, 1.0)))
        for _ in range(20):
            pose, head = view.observe(T_world_tracking), view.head_pose(T_world_tracking)
            estimator.add("sheet", pose, 0, 0, viewpoint, p_tracking_head=head)
    return estimator.estimate()


def tracking_frame(rng: np.random.Generator, tilt_deg: float = 0.2) -> PoseTuple:
    """Return a random, nearly level `T_world_tracking`."""
    tilt = quat_exp(np.append(rng.normal(0.0, math.radians(tilt_deg), 2), 0.0))
    q = quat_multiply(tilt, quat_exp(np.array([0.0, 0.0, rng.uniform(-3.0, 3.0)]))).tolist()
    return to_vec3(rng.uniform(-2.0, 2.0, 3)), (q[0], q[1], q[2], q[3])


def shifted(T: PoseTuple, by: Vec3) -> PoseTuple:
    (x, y, z), q = T
    return (x + by[0], y + by[1], z + by[2]), q


def axis(q: tuple[float, ...], i: int) -> Array:
    return np.asarray(quat_to_matrix(np.array(q))[:, i])
