"""Errors of scale: prints of another size, and focal lengths that are wrong."""

from __future__ import annotations

import numpy as np
import pytest

from anchors.alignment import AlignmentEstimate, AlignmentEstimator
from anchors.pose import PoseTuple, apply, distance, inverse, quat_from_yaw
from tests.anchors.worlds import Viewpoint, tracking_frame, viewpoint_around

SHEETS: dict[str, PoseTuple] = {
    "a": ((0.0, 0.0, 0.7), quat_from_yaw(0.1)),
    "b": ((1.5, 0.0, 0.7), quat_from_yaw(2.0)),
    "c": ((0.75, 1.3, 0.7), quat_from_yaw(-1.0)),
}


def estimate(names: str, wrong: dict[str, float], seed: int) -> tuple[AlignmentEstimate, PoseTuple]:
    """Look at sheets from new places; what is seen of a sheet is too far by a share."""
    rng = np.random.default_rng(seed)
    T = tracking_frame(rng)
    estimator = AlignmentEstimator(SHEETS, sizes=dict.fromkeys(SHEETS, 0.16))
    for viewpoint, name in enumerate(names):
        view = Viewpoint(rng, SHEETS[name], viewpoint_around(rng, SHEETS[name][0], 0.4 if viewpoint % 2 else 1.1))
        head = view.head_pose(T)
        for i in range(20):
            p, q = view.observe(T)
            far = 1.0 + wrong.get(name, 0.0)
            seen = (
                head[0] + far * (p[0] - head[0]),
                head[1] + far * (p[1] - head[1]),
                head[2] + far * (p[2] - head[2]),
            )
            estimator.add(name, (seen, q), viewpoint * 3_000_000_000 + i, 0, viewpoint, p_tracking_head=head)
    return estimator.estimate(), T


@pytest.mark.parametrize(
    ("names", "wrong", "sheet", "camera"),
    [
        ("aaaa", {"a": -0.02}, "a", True),  # a print of 163 mm; one sheet cannot exclude the camera
        ("aaaa", {"a": 0.05}, "a", True),
        ("abcabcabc", dict.fromkeys("abc", 0.05), "", True),
        ("abcabcabc", {"b": -0.025}, "b", False),
        ("aaaa", {}, "", False),
        ("abcabcabc", {}, "", False),
    ],
)
def test_error_of_scale_is_followed_and_said(names: str, wrong: dict[str, float], sheet: str, camera: bool) -> None:
    for seed in range(3):
        got, T = estimate(names, wrong, seed)
        assert not got.refused, got.advice
        assert (f"'{sheet}'" in got.advice) is bool(sheet)
        assert ("camera" in got.advice) is camera
        at = SHEETS["a"][0]
        off = distance(apply(got.T_world_tracking, apply(inverse(T), at)), at)
        assert off < 1.5 * got.error_at(at) < 0.02
