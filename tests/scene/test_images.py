"""Textures: exact or within the stated error; damaged files in every encoding raise a typed error."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from iris_session.scene import AssetDecodeError, decode_image, encode_image
from iris_session.scene.images import halve

ENCODINGS = ("arrays", "png", "jpeg")


def picture(height: int = 60, width: int = 80, channels: int = 3) -> NDArray[np.uint8]:
    """A soft pattern with noise."""
    y, x, c = np.meshgrid(np.arange(height), np.arange(width), np.arange(channels), indexing="ij")
    noise = np.random.default_rng(0).integers(0, 5, y.shape)
    return (120 + 60 * np.sin(x / 9 + c) + 50 * np.cos(y / 7) + noise).astype(np.uint8)


@given(st.integers(1, 20), st.integers(1, 20), st.sampled_from([1, 3, 4]), st.sampled_from(["arrays", "png"]))
def test_lossless_encodings(height: int, width: int, channels: int, encoding: str) -> None:
    pixels = picture(height, width, channels)
    image = encode_image(pixels, encoding)
    assert image.max_error == 0
    assert np.array_equal(decode_image(image.data, encoding), pixels)


def test_jpeg_states_its_error_and_is_small() -> None:
    pixels = picture(300, 400)
    image = encode_image(pixels, "jpeg")
    error = np.abs(decode_image(image.data, "jpeg").astype(int) - pixels).max()
    assert 0 < error == image.max_error < 40
    assert len(image.data) < len(encode_image(pixels).data) / 3
    with pytest.raises(AssetDecodeError, match="JPEG holds 1 or 3"):
        encode_image(picture(channels=4), "jpeg")


def test_half_size() -> None:
    assert np.array_equal(halve(np.arange(16, dtype=np.uint8).reshape(4, 4, 1))[..., 0], [[3, 5], [11, 13]])
    assert halve(picture(5, 1)).shape == (2, 1, 3)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_damaged_images(encoding: str) -> None:
    good = encode_image(picture(), encoding).data
    for length in (0, 3, 20, 40):
        with pytest.raises(AssetDecodeError):
            decode_image(good[:length], encoding)
    rng = np.random.default_rng(1)
    for _ in range(100):
        bad = bytearray(good)
        bad[int(rng.integers(len(bad)))] = int(rng.integers(256))
        try:
            decode_image(bad, encoding)
        except AssetDecodeError:
            continue


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_oversized_image_is_rejected_by_its_header(encoding: str) -> None:
    data = encode_image(picture(6, 8, 4 if encoding == "arrays" else 3), encoding).data
    assert decode_image(data, encoding, 4 * 6 * 8).shape[:2] == (6, 8)
    with pytest.raises(AssetDecodeError):  # every pixel counts four bytes
        decode_image(data, encoding, 4 * 6 * 8 - 1)
    with pytest.raises(AssetDecodeError):
        decode_image(data, "webp")


def test_jpeg_cannot_hide_its_size_behind_fill_bytes() -> None:
    """Decoders skip 255-bytes before a marker: a parser that reads them as a length is misled."""
    good = encode_image(picture(), "jpeg").data
    assert decode_image(good[:2] + b"\xff" * 3 + good[2:], "jpeg").shape == (60, 80, 3)
    frame = good.index(b"\xff\xc0")
    # Skipped as a segment, the true size would be inside it, with a small one at the apparent end.
    length = int.from_bytes(good[frame : frame + 2], "big")
    lie = b"\xff\xc0\x00\x11\x08\x00\x01\x00\x01" + bytes(10)
    bad = good[:frame] + b"\xff" + good[frame:]
    bad += bytes(max(0, frame + 2 + length - len(bad)))
    with pytest.raises(AssetDecodeError, match="80 x 60 pixels"):
        decode_image(bad[: frame + 2 + length] + lie, "jpeg", max_bytes=1_000)
    for marker in (b"\xff\xd8", b"\xff\x01", b"\xff\xda"):
        with pytest.raises(AssetDecodeError, match="without a size"):
            decode_image(good[:2] + marker + good[2:], "jpeg")
