"""Head poses that observations are paired with: the nearest in time, of the same tracking frame, and a pose at all."""

from __future__ import annotations

import math

import pytest

from anchors.pose import IDENTITY_QUAT, PoseTuple
from iris_session.alignment.monitor import MAX_HEAD_OFFSET_NS, MAX_HEAD_POSES, HeadHistory

MS = 1_000_000


def at(x: float) -> PoseTuple:
    return (x, 0.0, 1.6), IDENTITY_QUAT


def ring(*times_ms: int, epoch: int = 1) -> HeadHistory:
    heads = HeadHistory()
    for ms in times_ms:
        heads.append(ms * MS, epoch, at(float(ms)))
    return heads


@pytest.mark.parametrize(
    ("asked_ms", "found_ms"), [(100, 100), (104, 100), (107, 111), (122, 122), (172, 122), (173, None), (49, None)]
)
def test_the_nearest_within_50_ms(asked_ms: int, found_ms: int | None) -> None:
    got = ring(100, 111, 122).find_nearest(asked_ms * MS, 1)
    assert (None if got is None else got[0][0]) == found_ms


def test_heads_of_another_tracking_frame_are_nowhere() -> None:
    heads = ring(100, 111)
    heads.append(112 * MS, 2, at(5.0))
    assert heads.find_nearest(112 * MS, 1) == at(111.0)
    assert heads.find_nearest(112 * MS, 2) == at(5.0)
    assert heads.find_nearest(112 * MS, 3) is None


def test_samples_out_of_order_are_found_too() -> None:
    heads = ring(100, 120, 110)
    assert heads.find_nearest(119 * MS, 1) == at(120.0)


@pytest.mark.parametrize("pose", [((math.nan, 0.0, 0.0), IDENTITY_QUAT), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.5))])
def test_what_is_no_pose_says_nothing(pose: PoseTuple) -> None:
    heads = ring()
    heads.append(-(2**63), 1, pose)
    assert heads.find_nearest(-(2**63), 1) is None


def test_memory_is_bounded_and_the_oldest_go() -> None:
    heads = ring(*range(0, 20 * (MAX_HEAD_POSES + 10), 20))
    assert len(heads) == MAX_HEAD_POSES
    assert heads.find_nearest(0, 1) is None
    assert heads.find_nearest(20 * (MAX_HEAD_POSES + 9) * MS + MAX_HEAD_OFFSET_NS + 1, 1) is None
