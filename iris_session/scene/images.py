"""Textures as assets: raw pixels compressed by Zstandard (default: decodes fastest), PNG, JPEG, and back."""

from __future__ import annotations

import struct
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.assets import MAX_ARRAY_BYTES
from iris_session.protocol.names import ArrayFilter, ArrayKind, ArrayName, AssetEncoding
from iris_session.scene.arrays import Stored, decode_arrays, encode_arrays, filtered, require
from iris_session.scene.errors import AssetDecodeError

Pixels = NDArray[np.uint8]
_PNG: Final = b"\x89PNG\r\n\x1a\n"
#: Rows of a large image that decide which filter suits it.
_SAMPLE_ROWS: Final = 128


class EncodedImage(NamedTuple):
    """`max_error`: of a channel, 0..255; 0 is exact."""

    data: bytes
    encoding: str
    max_error: int = 0


def encode_image(pixels: Pixels, encoding: str = AssetEncoding.ARRAYS, quality: int = 92) -> EncodedImage:
    """`pixels`: (height, width, channels), first row on top. `quality`: of JPEG, 1..100."""
    if encoding == AssetEncoding.ARRAYS:
        stored = Stored(ArrayName.PIXELS, pixels, _filter(pixels))
        return EncodedImage(encode_arrays(ArrayKind.IMAGE, [stored]), encoding)
    cv2 = _opencv()
    swapped = _swapped(pixels)
    if encoding == AssetEncoding.PNG:
        ok, data = cv2.imencode(".png", swapped, [cv2.IMWRITE_PNG_COMPRESSION, 6])
    elif encoding == AssetEncoding.JPEG:
        if pixels.shape[2] not in (1, 3):
            raise AssetDecodeError(f"JPEG holds 1 or 3 channels, not {pixels.shape[2]}: use PNG")
        ok, data = cv2.imencode(".jpg", swapped, [cv2.IMWRITE_JPEG_QUALITY, quality])
    else:
        raise AssetDecodeError(f"unknown encoding {encoding!r} of an image: arrays, png or jpeg")
    if not ok:
        raise AssetDecodeError(f"an image of {pixels.shape} cannot be written as {encoding}")
    encoded = data.tobytes()
    if encoding == AssetEncoding.PNG:
        return EncodedImage(encoded, encoding)
    back = decode_image(encoded, encoding).astype(np.int16)
    return EncodedImage(encoded, encoding, int(np.abs(back - pixels).max()))


def decode_image(data: bytes | bytearray | memoryview, encoding: str, max_bytes: int = MAX_ARRAY_BYTES) -> Pixels:
    """Return pixels (height, width, channels).

    Raises:
        AssetDecodeError: The bytes are no such image, or its pixels would exceed `max_bytes`.
    """
    if encoding == AssetEncoding.ARRAYS:
        arrays = decode_arrays(data, ArrayKind.IMAGE, max_bytes)
        return require(arrays, ArrayName.PIXELS, "u1", (None, None, None))
    if encoding not in (AssetEncoding.PNG, AssetEncoding.JPEG):
        raise AssetDecodeError(f"unknown encoding {encoding!r} of an image: arrays, png or jpeg")
    width, height = _stated_size(bytes(data[:65_536]), encoding)
    if width * height * 4 > max_bytes:
        raise AssetDecodeError(f"an image of {width} x {height} pixels, at most {max_bytes} bytes are read")
    cv2 = _opencv()
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise AssetDecodeError(f"damaged {encoding}: {error}") from None
    if image is None or image.dtype != np.uint8:
        raise AssetDecodeError(f"damaged {encoding}, or one with more than 8 bits a channel")
    if image.shape[:2] != (height, width):
        raise AssetDecodeError(
            f"damaged {encoding}: {image.shape[1]} x {image.shape[0]} pixels, stated {width} x {height}"
        )
    return _swapped(image if image.ndim == 3 else image[:, :, None])


def halved(pixels: Pixels) -> Pixels:
    """Half the width and height, at least one pixel each: means of two by two; an odd last row or column is lost."""
    height, width = (max(1, n // 2) for n in pixels.shape[:2])
    tall = pixels if pixels.shape[0] > 1 else np.repeat(pixels, 2, axis=0)
    wide = tall if tall.shape[1] > 1 else np.repeat(tall, 2, axis=1)
    even = wide[: 2 * height, : 2 * width].astype(np.uint16)
    total = even[0::2, 0::2] + even[1::2, 0::2] + even[0::2, 1::2] + even[1::2, 1::2]
    return ((total + 2) // 4).astype(np.uint8)


def _filter(pixels: Pixels) -> str:
    """`up` suits pictures, none what is drawn in flat colours: whichever makes a middle part smaller."""
    middle = max(0, len(pixels) // 2 - _SAMPLE_ROWS // 2)
    sample = np.ascontiguousarray(pixels[middle : middle + _SAMPLE_ROWS])
    import zstandard

    sizes = {
        kind: len(zstandard.ZstdCompressor(level=1).compress(filtered(sample, kind)))
        for kind in (ArrayFilter.NONE, ArrayFilter.UP)
    }
    return min(sizes, key=lambda kind: sizes[kind])


def _stated_size(head: bytes, encoding: str) -> tuple[int, int]:
    """Width and height as the file says, before anything is decoded."""
    if encoding == AssetEncoding.PNG:
        if head[:8] != _PNG or len(head) < 24:
            raise AssetDecodeError("these bytes are no PNG")
        width, height = struct.unpack(">II", head[16:24])
        return width, height
    at = 2
    if head[:2] != b"\xff\xd8":
        raise AssetDecodeError("these bytes are no JPEG")
    while at + 9 <= len(head) and head[at] == 0xFF:
        marker, length = head[at + 1], int.from_bytes(head[at + 2 : at + 4], "big")
        if marker == 0xFF:  # any number of them may stand before a marker
            at += 1
            continue
        if marker <= 0x01 or 0xD0 <= marker <= 0xDA:  # without a length, or the picture itself: none before its size
            break
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a start of frame, which has the size
            height, width = struct.unpack(">HH", head[at + 5 : at + 9])
            return width, height
        at += 2 + length
    raise AssetDecodeError("a JPEG without a size in its first 64 KiB")


def _swapped(pixels: Pixels) -> Pixels:
    """Red and blue exchanged: OpenCV's order to ours, and back."""
    order = {1: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}.get(pixels.shape[2])
    if order is None:
        raise AssetDecodeError(f"an image of {pixels.shape[2]} channels has no PNG or JPEG: 1, 3 or 4")
    return np.ascontiguousarray(pixels[:, :, order])


def _opencv() -> Any:
    try:
        import cv2
    except ImportError:
        raise AssetDecodeError("PNG and JPEG need OpenCV: pip install 'iris-session[scene]'") from None
    return cv2
