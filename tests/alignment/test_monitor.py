"""Head poses to pair observations with: nearest in time, same tracking frame, valid."""

from __future__ import annotations

import math

import pytest

from anchors.pose import IDENTITY_QUAT, PoseTuple
from iris_session.alignment.monitor import MAX_HEAD_OFFSET_NS, MAX_HEAD_POSES, HeadHistory

MS = 1_000_000


def pose_at(x: float) -> PoseTuple:
    return (x, 0.0, 1.6), IDENTITY_QUAT


def history_of(*times_ms: int, epoch: int = 1) -> HeadHistory:
    heads = HeadHistory()
    for ms in times_ms:
        heads.append(ms * MS, epoch, pose_at(float(ms)))
    return heads


@pytest.mark.parametrize(
    ("asked_ms", "found_ms"), [(100, 100), (104, 100), (107, 111), (122, 122), (172, 122), (173, None), (49, None)]
)
def test_nearest_pose_within_50_ms_is_returned(asked_ms: int, found_ms: int | None) -> None:
    got = history_of(100, 111, 122).find_nearest(asked_ms * MS, 1)
    assert (None if got is None else got[0][0]) == found_ms


def test_poses_of_another_tracking_frame_are_not_returned() -> None:
    heads = history_of(100, 111)
    heads.append(112 * MS, 2, pose_at(5.0))
    assert heads.find_nearest(112 * MS, 1) == pose_at(111.0)
    assert heads.find_nearest(112 * MS, 2) == pose_at(5.0)
    assert heads.find_nearest(112 * MS, 3) is None


@pytest.mark.parametrize("pose", [((math.nan, 0.0, 0.0), IDENTITY_QUAT), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.5))])
def test_invalid_poses_are_ignored(pose: PoseTuple) -> None:
    heads = history_of()
    heads.append(-(2**63), 1, pose)
    assert heads.find_nearest(-(2**63), 1) is None


def test_memory_is_bounded_and_oldest_poses_are_dropped() -> None:
    heads = history_of(*range(0, 20 * (MAX_HEAD_POSES + 10), 20))
    assert len(heads) == MAX_HEAD_POSES
    assert heads.find_nearest(0, 1) is None
    assert heads.find_nearest(20 * (MAX_HEAD_POSES + 9) * MS + MAX_HEAD_OFFSET_NS + 1, 1) is None
