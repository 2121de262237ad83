"""The world of `bench alignment`: headsets with tilted, drifting tracking frames look at sheets, as docs/anchors.md
fixes it.

It knows the truth; estimators get only what a headset reports (`Reported`). One generator, seeded: the same seed gives
the same observations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from anchors.lie import Array, quat_conjugate, quat_exp, quat_matrix, quat_multiply
from anchors.pose import PoseTuple, Quat, Vec3
from iris_session.emulator.sheet_noise import SheetNoise, of_viewpoint

PER_VIEWPOINT: Final = 20  # 2 s at 10 Hz
PERIOD_S: Final = 0.1
WALK_S: Final = 3.0  # from one viewpoint to the next
DISTANCE_M: Final = (0.4, 1.2)
ELEVATION_DEG: Final = (40.0, 80.0)
NOISE: Final = SheetNoise()
TILT_SIGMA_RAD: Final = math.radians(0.2)
DRIFT_M_PER_S: Final = 0.003 / 60.0
HEAD_SIGMA_M: Final = 0.0005  # a headset's tracking of its own head from frame to frame; our assumption
TIP_SIGMA_M: Final = 0.0015
HOLDER_SIGMA_RAD: Final = math.radians(
    0.3
)  # our assumption: a tracked controller is turned as well as a sheet at 0.5 m


@dataclass(frozen=True)
class Reported:
    """One observation as a headset reports it."""

    anchor_id: str
    pose: PoseTuple
    p_head: Vec3
    capture_ns: int
    viewpoint_id: int


@dataclass
class Headset:
    """The truth about one headset, and what it has reported. `now_s` is where its run has come to."""

    rng: np.random.Generator
    now_s: float = 0.0
    viewpoints: int = 0
    q0: Array = field(init=False)
    p0: Array = field(init=False)
    velocity: Array = field(init=False)

    def __post_init__(self) -> None:
        yaw = quat_exp(np.array([0.0, 0.0, self.rng.uniform(-math.pi, math.pi)]))
        tilt = quat_exp(np.append(self.rng.normal(0.0, TILT_SIGMA_RAD, 2), 0.0))
        self.q0 = quat_multiply(tilt, yaw)
        self.p0 = np.append(self.rng.uniform(-3.0, 3.0, 2), self.rng.uniform(-1.5, 0.5))
        way = self.rng.normal(size=3)
        self.velocity = DRIFT_M_PER_S * way / np.linalg.norm(way)

    def T_world_tracking(self, at_s: float) -> tuple[Array, Array]:
        """The truth at a time."""
        return self.p0 + at_s * self.velocity, self.q0

    def look(self, anchor_id: str, p_anchor: Array, q_anchor: Array) -> list[Reported]:
        """2 s of observations from a new viewpoint: somewhere around the sheet, 0.4 to 1.2 m away."""
        rng, n = self.rng, PER_VIEWPOINT
        d = rng.uniform(*DISTANCE_M)
        elevation, azimuth = math.radians(rng.uniform(*ELEVATION_DEG)), rng.uniform(-math.pi, math.pi)
        e1 = -np.array(
            [
                math.cos(elevation) * math.cos(azimuth),
                math.cos(elevation) * math.sin(azimuth),
                math.sin(elevation),
            ]
        )
        e2 = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        axes = np.stack([e1, e2, np.cross(e1, e2)])
        noise = of_viewpoint(rng.normal(size=3), rng.normal(size=(n, 3)))
        turns = of_viewpoint(rng.normal(size=3), rng.normal(size=(n, 3)))
        p, q = NOISE.seen(p_anchor, q_anchor, axes, d, np.hstack([noise, turns]), rng.normal())
        for i in np.flatnonzero(rng.random(n) < NOISE.wrong_share):
            p[i], q[i] = NOISE.wrong(p[i], q[i], e1, rng)
        heads = p_anchor - d * e1 + rng.normal(0.0, HEAD_SIGMA_M, (n, 3))
        return self._report(anchor_id, p, q, heads)

    def hold(self, anchor_id: str, p_anchor: Array, q_anchor: Array) -> list[Reported]:
        """2 s of a tracked controller in its holder."""
        rng, n = self.rng, PER_VIEWPOINT
        noise = TIP_SIGMA_M * of_viewpoint(rng.normal(size=3), rng.normal(size=(n, 3)))
        turns = HOLDER_SIGMA_RAD * of_viewpoint(rng.normal(size=3), rng.normal(size=(n, 3)))
        q = quat_multiply(quat_exp(turns), np.broadcast_to(q_anchor, (n, 4)))
        return self._report(anchor_id, p_anchor + noise, q, np.broadcast_to(p_anchor, (n, 3)))

    def touch(self, p_mark: Array, sigma_m: float) -> list[Vec3]:
        """The tip of a controller on a mark, once."""
        p = p_mark + self.rng.normal(0.0, sigma_m, (1, 3))
        origin, q = self.T_world_tracking(self.now_s)
        return [_vec3(v) for v in ((p - origin) @ quat_matrix(q)).tolist()]

    def _report(self, anchor_id: str, p: Array, q: Array, heads: Array) -> list[Reported]:
        """World to tracking at the time of each, then on to the next place."""
        times = self.now_s + PERIOD_S * np.arange(len(p))
        q_inv = quat_conjugate(self.q0)
        R = quat_matrix(q_inv)
        origin = self.p0 + times[:, None] * self.velocity
        p_tracking, head_tracking = (p - origin) @ R.T, (heads - origin) @ R.T
        q_tracking = quat_multiply(q_inv, q)
        out = [
            Reported(anchor_id, (_vec3(a), _quat(b)), _vec3(h), round(t * 1e9), self.viewpoints)
            for a, b, h, t in zip(
                p_tracking.tolist(), q_tracking.tolist(), head_tracking.tolist(), times.tolist(), strict=True
            )
        ]
        self.viewpoints += 1
        self.now_s = float(times[-1]) + PERIOD_S
        return out

    def walk(self) -> None:
        self.now_s += WALK_S


def _vec3(v: list[float]) -> Vec3:
    return (v[0], v[1], v[2])


def _quat(v: list[float]) -> Quat:
    return (v[0], v[1], v[2], v[3])
