"""Interpolation of poses for a display, at a fixed delay behind session time. Pure.

Positions are interpolated linearly, orientations by slerp. Nothing is extrapolated: without a newer frame the newest
pose stays, and its age grows.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Poses = NDArray[np.float64]


class ShownPoses(NamedTuple):
    """Poses (n, 7) `x y z qw qx qy qz` at `session_time_ns`; `age_ns` = now - that time; `starved`: no newer frame."""

    poses: Poses
    session_time_ns: int
    age_ns: int
    starved: bool


def interpolate(a: Poses, b: Poses, fraction: float) -> Poses:
    """Return poses (n, 7) between `a` (fraction 0) and `b` (1): linear positions, shortest-arc slerp."""
    out = np.empty_like(a)
    out[:, :3] = a[:, :3] + fraction * (b[:, :3] - a[:, :3])
    qa, qb = a[:, 3:], b[:, 3:]
    dot = np.einsum("ij,ij->i", qa, qb)
    qb = np.where(dot[:, None] < 0.0, -qb, qb)
    angle = np.arccos(np.minimum(np.abs(dot), 1.0))
    sine = np.sin(angle)
    near = sine < 1e-6  # below a microradian slerp and lerp agree to rounding
    safe = np.where(near, 1.0, sine)
    wa = np.where(near, 1.0 - fraction, np.sin((1.0 - fraction) * angle) / safe)
    wb = np.where(near, fraction, np.sin(fraction * angle) / safe)
    q = wa[:, None] * qa + wb[:, None] * qb
    out[:, 3:] = q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-12)
    return out


class PoseBuffer:
    """History of the last frames of poses, from which `poses_at` interpolates.

    Args:
        delay_ns: Time by which the shown poses are behind session time [ns]. Two frame periods hide one lost frame.
        capacity: Number of frames kept.

    Attributes:
        late: Number of frames dropped because they came out of order.
        starvations: Number of calls of `poses_at` that found no frame new enough.
    """

    def __init__(self, delay_ns: int = 33_000_000, capacity: int = 16) -> None:
        self.delay_ns = delay_ns
        self.late = 0
        self.starvations = 0
        self._frames: deque[tuple[int, Poses]] = deque(maxlen=capacity)
        self._shown_ns = 0

    def clear(self) -> None:
        """Remove all frames: after a jump of the scene (new `scene_epoch`) nothing may be interpolated across it."""
        self._frames.clear()
        self._shown_ns = 0

    def add(self, session_time_ns: int, poses: Poses) -> None:
        """Add a frame.

        Args:
            session_time_ns: Session time of the frame [ns].
            poses: Poses (n, 7) `x y z qw qx qy qz` in the world frame; must not be changed afterwards.
        """
        if self._frames and (session_time_ns < self._frames[-1][0] or poses.shape != self._frames[-1][1].shape):
            self.late += 1
        elif self._frames and session_time_ns == self._frames[-1][0]:
            self._frames[-1] = (session_time_ns, poses)
        else:
            self._frames.append((session_time_ns, poses))

    def poses_at(self, now_ns: int) -> ShownPoses | None:
        """Return the poses at `now_ns - delay_ns`; the shown time never goes back.

        Args:
            now_ns: Present session time [ns].

        Returns:
            Interpolated poses, or the nearest frame; `None` before the first frame.
        """
        if not self._frames:
            return None
        wanted = max(now_ns - self.delay_ns, self._shown_ns)
        newest_ns, newest = self._frames[-1]
        if wanted >= newest_ns:
            starved = wanted > newest_ns
            self.starvations += starved
            self._shown_ns = newest_ns
            return ShownPoses(newest, newest_ns, now_ns - newest_ns, starved)
        after_ns, after = newest_ns, newest
        for at_ns, poses in reversed(self._frames):
            if at_ns <= wanted:
                self._shown_ns = wanted
                fraction = (wanted - at_ns) / (after_ns - at_ns)
                return ShownPoses(interpolate(poses, after, fraction), wanted, now_ns - wanted, False)
            after_ns, after = at_ns, poses
        self._shown_ns = after_ns
        return ShownPoses(after, after_ns, now_ns - after_ns, False)
