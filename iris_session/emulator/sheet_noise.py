"""Noise of sheet detections, as specified in docs/anchors.md, for emulated headsets and for
`bench alignment`. Random numbers are the caller's; arrays are of one or more observations from one viewpoint.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from anchors.lie import Array, quat_exp, quat_multiply


class SheetNoise(msgspec.Struct, frozen=True):
    """Standard deviations. After OpenCV's QR detector on a 16 cm sheet at 640x480 (docs/anchors.md, "Noise").

    `along_m` and `along_m_per_m2 * d^2`: of the position along the view from `d` metres; `across`: share of that across
    it. `turn_rad`: about each axis from 0.5 m, growing with the distance. Half of the variance of both is the same for
    all observations from one viewpoint, and so is the whole error of scale (`scale`, share of the distance).
    `wrong_share`: of wrong detections, half of them mirrored along the view, half of something else (`wrong_m`,
    `wrong_rad` per axis).
    """

    along_m: float = 0.0004
    along_m_per_m2: float = 0.0044
    across: float = 1.0 / 3.0
    turn_rad: float = math.radians(0.3)
    scale: float = 0.003
    wrong_share: float = 0.05
    wrong_m: float = 0.25
    wrong_rad: float = 0.5

    def observe(
        self, p: Array, q: Array, axes: Array, d: float, units: Array, scale_unit: float
    ) -> tuple[Array, Array]:
        """Return the sheet (`p`, `q`) as observed from `d` metres. Shapes (n, 3), (n, 4).

        `axes`: rows (3, 3), the first along the view, away from the viewer. `units`: unit normals (n, 6), position
        along `axes` and turn about the axes of the frame. `scale_unit`: a unit normal of the viewpoint.
        """
        along = self.along_m + self.along_m_per_m2 * d * d
        sigma = np.array([along, along * self.across, along * self.across])
        turns = self.turn_rad * d / 0.5 * units[:, 3:]
        seen_p = p + (units[:, :3] * sigma) @ axes + scale_unit * self.scale * d * axes[0]
        return seen_p, quat_multiply(quat_exp(turns), np.broadcast_to(q, (len(units), 4)))

    def make_wrong_detection(self, p: Array, q: Array, view: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return a wrong detection (3), (4): mirrored along `view`, or of something else."""
        if rng.random() < 0.5:
            v = np.append(0.0, view)
            return p, quat_multiply(quat_multiply(v, q), np.array([0.0, 0.0, 0.0, 1.0]))
        off = rng.normal(0.0, self.wrong_m, 3)
        return p + off, quat_multiply(quat_exp(rng.normal(0.0, self.wrong_rad, 3)), q)


def mix_viewpoint_noise(common: Array, each: Array) -> Array:
    """Return unit normals half of whose variance is common to the viewpoint."""
    half = math.sqrt(0.5)
    return np.asarray(half * common + half * each)
