"""Rigid-state stream: error bounds over loss, drift, late joiners and extreme poses; hostile payloads."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.streams.errors import StreamError
from iris_session.streams.quantise import POSITION_QUANTUM_ERROR_M, ROTATION_QUANTUM_ERROR_RAD, Floats
from iris_session.streams.rigid import (
    DRIFT_ALLOWANCE_M,
    DRIFT_ALLOWANCE_RAD,
    MAX_POSITION_ERROR_M,
    MAX_ROTATION_ERROR_RAD,
    REFRESH_FRAMES,
    WINDOW,
    EncodedFrame,
    RigidDecoder,
    RigidEncoder,
)
from tests.streams.poses import moved, position_errors, random_poses, rotation_errors

HEADER, BODY, WIDE_BODY, ESCAPE = 20, 12, 18, 58


def assert_within_bound(decoded: Floats, truth: Floats) -> None:
    assert position_errors(decoded, truth).max(initial=0.0) <= MAX_POSITION_ERROR_M
    assert rotation_errors(decoded, truth).max(initial=0.0) <= MAX_ROTATION_ERROR_RAD


def test_document_states_these_bounds() -> None:
    text = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text()
    drift_um, drift_deg = DRIFT_ALLOWANCE_M * 1e6, math.degrees(DRIFT_ALLOWANCE_RAD)
    code_mm, code_deg = POSITION_QUANTUM_ERROR_M * 1e3, math.degrees(ROTATION_QUANTUM_ERROR_RAD)
    assert f"when it has left it by {drift_um:.1f} um or {drift_deg:.4f} deg" in text
    assert f"an anchor is within {code_mm:.4f} mm and {code_deg:.4f} deg of it" in text
    assert f"the sums are {code_mm + drift_um * 1e-3:.4f} mm and {code_deg + drift_deg:.4f} deg" in text
    assert f"B is at most {WINDOW} frames behind" in text
    assert f"bodies are repeated every {REFRESH_FRAMES} frames" in text


def test_three_hundred_moving_bodies_are_small_and_within_the_bound() -> None:
    rng = np.random.default_rng(0)
    poses = random_poses(rng, 300)
    encoder, decoder = RigidEncoder(300), RigidDecoder(300)
    for _ in range(100):
        poses = moved(rng, poses, 0.3 / 60, 0.5 / 60)
        poses[:, :3] = np.clip(poses[:, :3], 0.0, (10.0, 10.0, 3.0))
        frame = encoder.encode(poses, 1)
        assert len(frame.payload) == HEADER + 300 * BODY
        assert frame.base_seq == 0  # complete in itself: no snapshot needed
        assert decoder.apply(*frame)
        assert_within_bound(decoder.poses, poses)


def test_resting_bodies_cost_one_bit_and_the_refresh() -> None:
    poses = random_poses(np.random.default_rng(0), 300)
    encoder = RigidEncoder(300)
    frames = [encoder.encode(poses, 1) for _ in range(WINDOW + 2)]
    assert len(frames[0].payload) == HEADER + 300 * BODY
    assert len(frames[-1].payload) <= HEADER + 38 + BODY
    assert frames[-1].base_seq == frames[-1].state_seq - WINDOW


def test_creeping_bodies_stay_within_the_bound_despite_loss() -> None:
    """0.6 um and 0.6 mdeg a frame: far below the drift allowance in one frame, far above it in a second."""
    rng = np.random.default_rng(5)
    poses = random_poses(rng, 40)
    heading = random_poses(rng, 40)[:, :3] - 5.0
    heading *= 6e-7 / np.linalg.norm(heading, axis=1)[:, None]
    encoder, decoder = RigidEncoder(40), RigidDecoder(40)
    frame = encoder.encode(poses, 1)
    assert decoder.apply(*frame)
    delivered = 0
    for k in range(600):
        poses[:, :3] += heading
        poses = moved(rng, poses, 0.0, math.radians(6e-4))
        frame = encoder.encode(poses, 1)
        if rng.random() < 0.15 or k - delivered == WINDOW - 1:
            assert decoder.apply(*frame)
            assert_within_bound(decoder.poses, poses)
            delivered = k


def test_creeping_rotations_stay_within_the_bound_in_the_worst_case() -> None:
    """Rotations half a step beside their codes, moving away from them by a tenth of the allowance per frame."""
    m = (np.arange(1, 20)[:, None] + 0.499) / 8191 * np.ones(3)
    squares = np.einsum("ij,ij->i", m, m)[:, None]
    q = np.hstack(((1.0 - squares) / (1.0 + squares), 2.0 * m / (1.0 + squares)))
    poses = np.hstack((np.zeros((19, 3)), q))
    encoder, decoder = RigidEncoder(19), RigidDecoder(19)
    assert decoder.apply(*encoder.encode(poses, 1))
    assert rotation_errors(decoder.poses, poses).max() > math.radians(0.024)
    away = poses[:, 3:] - decoder.poses[:, 3:]
    axis = away / np.linalg.norm(away, axis=1)[:, None]
    for _ in range(40):
        poses[:, 3:] += axis * (0.05 * DRIFT_ALLOWANCE_RAD)
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
        assert decoder.apply(*encoder.encode(poses, 1))
        assert_within_bound(decoder.poses, poses)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 40),
    size=st.sampled_from((1e-3, 1.0, 30.0, 3e3, 3e5)),
    step=st.sampled_from((0.0, 1e-6, 1e-5, 1e-3, 1.0)),
    lost=st.lists(st.booleans(), min_size=1, max_size=100),
)
def test_every_delivered_frame_is_within_the_bound(
    seed: int, n: int, size: float, step: float, lost: list[bool]
) -> None:
    """At any loss a complete client is within the bound; one that missed too much reports it."""
    rng = np.random.default_rng(seed)
    poses = random_poses(rng, n, (size, size, size))
    encoder, decoder = RigidEncoder(n), RigidDecoder(n)
    away = 0
    for k, is_lost in enumerate(lost):
        active = rng.random(n) < 0.3
        poses[active] = moved(rng, poses[active], step, min(step, 0.1))
        frame = encoder.encode(poses, 1 + k // 60)
        if is_lost:
            away += 1
            continue
        complete = decoder.apply(*frame)
        valid = decoder.valid
        assert complete == valid.all()
        assert complete or away >= WINDOW
        assert_within_bound(decoder.poses[valid], poses[valid])
        if complete:
            away = 0


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 30), frames=st.integers(1, 20))
def test_extreme_poses_are_sent_exactly(seed: int, n: int, frames: int) -> None:
    rng = np.random.default_rng(seed)
    wild = np.array([np.nan, np.inf, -np.inf, 0.0, 1e300, -1e9, 1e-320, 1e5])
    encoder, decoder = RigidEncoder(n), RigidDecoder(n)
    poses = random_poses(rng, n)
    for _ in range(frames):
        hit = rng.random((n, 7)) < 0.05
        poses[hit] = wild[rng.integers(len(wild), size=(n, 7))][hit]
        assert decoder.apply(*encoder.encode(poses, 1))
        norms = np.array([math.hypot(*q) for q in poses[:, 3:]])
        sane = np.isfinite(poses).all(axis=1) & (np.abs(norms - 1.0) < 1e-9)
        assert_within_bound(decoder.poses[sane], poses[sane])
        strange = ~np.isfinite(poses).all(axis=1)
        np.testing.assert_array_equal(decoder.poses[strange], poses[strange])


def test_large_room_selects_the_wide_layout() -> None:
    poses = random_poses(np.random.default_rng(7), 300, (90.0, 90.0, 10.0))
    frame = RigidEncoder(300).encode(poses, 1)
    assert len(frame.payload) == HEADER + 300 * WIDE_BODY
    decoder = RigidDecoder(300)
    assert decoder.apply(*frame)
    assert_within_bound(decoder.poses, poses)


def resting_stream(n: int = 50, frames: int = 100) -> tuple[Floats, RigidEncoder, list[EncodedFrame]]:
    rng = np.random.default_rng(8)
    poses = random_poses(rng, n)
    encoder = RigidEncoder(n)
    sent = []
    for _ in range(frames):
        poses[0] = moved(rng, poses[:1], 0.01, 0.01)[0]
        sent.append(encoder.encode(poses, 1))
    return poses, encoder, sent


@pytest.mark.parametrize(("lost", "complete"), [(WINDOW - 1, True), (WINDOW, False)])
def test_loss_of_one_window_is_tolerated_and_not_more(lost: int, complete: bool) -> None:
    poses, encoder, frames = resting_stream()
    decoder = RigidDecoder(50)
    for frame in frames:
        decoder.apply(*frame)
    poses[49, 0] += 0.01  # in the first lost frame
    for _ in range(lost):
        encoder.encode(poses, 1)
    assert decoder.apply(*encoder.encode(poses, 1)) is complete
    assert_within_bound(decoder.poses[decoder.valid], poses[decoder.valid])


def test_late_joiner_is_complete_after_a_snapshot() -> None:
    poses, encoder, frames = resting_stream()
    decoder = RigidDecoder(50)
    assert not decoder.complete
    assert not decoder.apply(*frames[-1])
    assert decoder.valid[0]
    assert_within_bound(decoder.poses[:1], poses[:1])
    assert decoder.load_keyframe(*encoder.keyframe())
    assert_within_bound(decoder.poses, poses)


def test_keyframe_older_than_the_stream_keeps_newer_poses() -> None:
    rng = np.random.default_rng(9)
    poses, encoder, _ = resting_stream()
    keyframe = encoder.keyframe()
    decoder = RigidDecoder(50)
    for _ in range(WINDOW):
        poses[0] = moved(rng, poses[:1], 0.01, 0.01)[0]
        frame = encoder.encode(poses, 1)
        decoder.apply(*frame)
    assert decoder.load_keyframe(*keyframe)
    assert_within_bound(decoder.poses, poses)
    assert decoder.state_seq == frame.state_seq


def test_refresh_completes_a_client_without_snapshot() -> None:
    poses, encoder, _ = resting_stream()
    decoder = RigidDecoder(50)
    done = [decoder.apply(*encoder.encode(poses, 1)) for _ in range(REFRESH_FRAMES)]
    assert done[-1]
    assert not done[0]
    assert_within_bound(decoder.poses, poses)


def test_replacing_encoder_continues_the_sequence() -> None:
    frames = resting_stream()[2]
    decoder = RigidDecoder(50)
    for frame in frames:
        decoder.apply(*frame)
    other = random_poses(np.random.default_rng(10), 50)
    replacement = RigidEncoder(50, first_seq=frames[-1].state_seq + 1)
    for _ in range(WINDOW + 5):
        frame = replacement.encode(other, 1)
    assert not decoder.apply(*frame)  # lost everything from the replacement: must not count as complete
    assert decoder.apply(*replacement.encode(other, 2))
    assert_within_bound(decoder.poses, other)


def test_old_frames_are_ignored_and_counted() -> None:
    poses, _, frames = resting_stream()
    decoder = RigidDecoder(50)
    for frame in frames:
        decoder.apply(*frame)
    assert decoder.apply(*frames[3])
    assert decoder.stale_frames == 1
    assert_within_bound(decoder.poses, poses)
    decoder.reset()
    assert decoder.apply(*frames[0])


@pytest.mark.parametrize("shape", [(3, 7), (2, 6), (14,)])
def test_wrong_shapes_are_rejected(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="expected"):
        RigidEncoder(2).encode(np.zeros(shape), 1)
    with pytest.raises(StreamError, match="expected"):
        RigidDecoder(2).load_keyframe(1, np.zeros(shape))


def test_wrong_arguments_are_rejected() -> None:
    with pytest.raises(ValueError, match="65535"):
        RigidEncoder(65536)
    with pytest.raises(ValueError, match="first_seq"):
        RigidEncoder(1, first_seq=0)
    with pytest.raises(StreamError, match="keyframe at"):
        RigidDecoder(1).load_keyframe(2**63, np.zeros((1, 7)))
    with pytest.raises(StreamError, match="base_seq"):
        RigidDecoder(1).apply(3, 4, b"")


# --- hostile bytes ----------------------------------------------------------------------------------------------------


def valid_payload() -> bytes:
    poses = random_poses(np.random.default_rng(11), 10)
    poses[3, 0] = np.nan
    poses[8, 0] = 1e12
    return RigidEncoder(10).encode(poses, 1).payload


def test_each_check_rejects() -> None:
    good = valid_payload()
    n = 10

    def assert_rejected(payload: bytes, match: str) -> None:
        with pytest.raises(StreamError, match=match):
            RigidDecoder(n).apply(1, 0, payload)

    assert RigidDecoder(n).apply(1, 0, memoryview(good))
    assert_rejected(good[:19], "shorter than its header")
    assert_rejected(b"\x01" + good[1:], "format 1")
    assert_rejected(good[:2] + b"\x0b\0" + good[4:], "for 11 bodies")
    assert_rejected(good[:1] + b"\x02" + good[2:], "layout 2")
    assert_rejected(good[:4] + b"\x0b\0" + good[6:], "of 11 bodies")
    assert_rejected(good + b"\0", "header asks for")
    last = len(good) - ESCAPE
    mask = last - ESCAPE - 2
    assert_rejected(good[:mask] + b"\xff\xff" + good[mask + 2 :], "mask")
    assert_rejected(good[: mask + 1] + bytes([good[mask + 1] | 0x80]) + good[mask + 2 :], "mask")
    assert_rejected(good[:last] + b"\x03\0" + good[last + 2 :], "ascending")
    assert_rejected(good[:last] + b"\x0a\0" + good[last + 2 :], "ascending")
    assert_rejected(good[:last] + b"\x09\0" + good[last + 2 :], "ascending")
    assert_rejected(good[:20] + b"\xff\xff\xff\xff" + good[24:], "rotation levels")
    full = RigidEncoder(n).encode(random_poses(np.random.default_rng(11), n), 1).payload
    assert_rejected(full[:6] + b"\x01\0" + full[8:] + good[last:], "ascending")
