"""Images: pixels as assets (arrays, PNG, JPEG) and back, and image files as pixels (PNG, JPEG, WebP, TGA, BMP, ...)."""

from __future__ import annotations

import io
import struct
import zlib
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iris_session.protocol.assets import MAX_ARRAY_BYTES
from iris_session.protocol.names import ArrayFilter, ArrayKind, ArrayName, AssetEncoding
from iris_session.scene.arrays import (
    LEVEL,
    StoredArray,
    apply_filter,
    decode_arrays,
    encode_arrays,
    require_array,
    to_array,
)
from iris_session.scene.errors import AssetDecodeError, SceneBuildError

Pixels = NDArray[np.uint8]
_PNG: Final = b"\x89PNG\r\n\x1a\n"
#: Number of rows of a large image by which its filter is chosen.
_SAMPLE_ROWS: Final = 128
#: Accepted formats, by Pillow's names. Not all that it reads: it passes EPS to Ghostscript, under any file name.
FORMATS: Final = ("PNG", "JPEG", "WEBP", "TGA", "BMP", "GIF", "TIFF", "PPM", "DDS")
_JPEGS: Final = "MPO"  # JPEG with several images, as written by cameras
#: Maximum number of pixels of one image: larger ones are no textures, or decompression bombs.
MAX_PIXELS: Final = 1 << 26
#: Maximum number of pixels of all images of a file: 2 GiB in memory. A file of a few MiB can have many large ones.
MAX_FILE_PIXELS: Final = 1 << 29


class EncodedImage(NamedTuple):
    """`max_error`: of a channel, 0..255; 0 is exact."""

    data: bytes
    encoding: str
    max_error: int = 0


def encode_image(pixels: Pixels, encoding: str = AssetEncoding.ARRAYS, quality: int = 92) -> EncodedImage:
    """Encode `pixels` (height, width, channels), first row on top. `quality`: of JPEG, 1..100."""
    if encoding == AssetEncoding.ARRAYS:
        stored = StoredArray(ArrayName.PIXELS, pixels, _choose_filter(pixels))
        return EncodedImage(encode_arrays(ArrayKind.IMAGE, [stored]), encoding)
    if encoding not in (AssetEncoding.PNG, AssetEncoding.JPEG):
        raise AssetDecodeError(f"unknown encoding {encoding!r} of an image: arrays, png or jpeg")
    if pixels.shape[2] not in ((1, 3) if encoding == AssetEncoding.JPEG else (1, 3, 4)):
        raise AssetDecodeError(f"an image of {pixels.shape[2]} channels: JPEG holds 1 or 3, PNG 1, 3 or 4")
    image = _import_pillow().fromarray(pixels[:, :, 0] if pixels.shape[2] == 1 else pixels)
    file = io.BytesIO()
    image.save(file, encoding, quality=quality)
    if encoding == AssetEncoding.PNG:
        return EncodedImage(file.getvalue(), encoding)
    back = decode_image(file.getvalue(), encoding).astype(np.int16)
    return EncodedImage(file.getvalue(), encoding, int(np.abs(back - pixels).max()))


def decode_image(data: bytes | bytearray | memoryview, encoding: str, max_bytes: int = MAX_ARRAY_BYTES) -> Pixels:
    """Return pixels (height, width, channels).

    Raises:
        AssetDecodeError: The bytes are no such image, or its pixels would exceed `max_bytes`.
    """
    if encoding == AssetEncoding.ARRAYS:
        arrays = decode_arrays(data, ArrayKind.IMAGE, max_bytes)
        return require_array(arrays, ArrayName.PIXELS, "u1", (None, None, None))
    if encoding not in (AssetEncoding.PNG, AssetEncoding.JPEG):
        raise AssetDecodeError(f"unknown encoding {encoding!r} of an image: arrays, png or jpeg")
    width, height = read_stated_size(bytes(data[:65_536]), encoding)
    if width * height * 4 > max_bytes:
        raise AssetDecodeError(f"an image of {width} x {height} pixels, at most {max_bytes} bytes are read")
    pillow = _import_pillow()
    try:
        image = pillow.open(io.BytesIO(data), formats=(encoding,))
        if image.mode not in ("L", "RGB", "RGBA") and not image.mode.startswith("I"):  # palettes, CMYK
            image = image.convert("RGBA" if "transparency" in image.info or "A" in image.mode else "RGB")
        pixels = np.array(image)
    except (OSError, ValueError, SyntaxError, EOFError, pillow.DecompressionBombError) as error:
        raise AssetDecodeError(f"damaged {encoding}: {error}") from None
    pixels = pixels if pixels.ndim == 3 else pixels[:, :, None]
    if pixels.dtype != np.uint8:
        raise AssetDecodeError(f"{encoding} of {pixels.dtype}: 8 bits a channel are read")
    if pixels.shape[:2] != (height, width):
        raise AssetDecodeError(
            f"damaged {encoding}: {pixels.shape[1]} x {pixels.shape[0]} pixels, stated {width} x {height}"
        )
    return pixels


def halve(pixels: Pixels) -> Pixels:
    """Return an image of half the width and height, at least one pixel each: means of two by two pixels.

    An odd last row or column is dropped.
    """
    height, width = (max(1, n // 2) for n in pixels.shape[:2])
    tall = pixels if pixels.shape[0] > 1 else np.repeat(pixels, 2, axis=0)
    wide = tall if tall.shape[1] > 1 else np.repeat(tall, 2, axis=1)
    even = wide[: 2 * height, : 2 * width].astype(np.uint16)
    total = even[0::2, 0::2] + even[1::2, 0::2] + even[0::2, 1::2] + even[1::2, 1::2]
    return ((total + 2) // 4).astype(np.uint8)


def _choose_filter(pixels: Pixels) -> str:
    """Return the filter that makes a middle part smaller: `up` suits photographs, none suits flat colours."""
    middle = max(0, len(pixels) // 2 - _SAMPLE_ROWS // 2)
    sample = np.ascontiguousarray(pixels[middle : middle + _SAMPLE_ROWS])
    sizes = {kind: len(zlib.compress(apply_filter(sample, kind), LEVEL)) for kind in (ArrayFilter.NONE, ArrayFilter.UP)}
    return min(sizes, key=lambda kind: sizes[kind])


def read_stated_size(head: bytes, encoding: str) -> tuple[int, int]:
    """Return width and height in the header of the file, before anything is decoded."""
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
        if marker == 0xFF:  # any number of fill bytes may precede a marker
            at += 1
            continue
        if marker <= 0x01 or 0xD0 <= marker <= 0xDA:  # no length, or image data: neither may precede the size
            break
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start of frame, with the size
            height, width = struct.unpack(">HH", head[at + 5 : at + 9])
            return width, height
        at += 2 + length
    raise AssetDecodeError("a JPEG without a size in its first 64 KiB")


def _import_pillow() -> Any:
    """Return the module `PIL.Image`."""
    try:
        from PIL import Image
    except ImportError:
        raise AssetDecodeError("PNG, JPEG and other images need Pillow: pip install 'iris-session[scene]'") from None
    return Image


# --- image files ------------------------------------------------------------------------------------------------------


class PixelBudget:
    """Counter of the pixels of all images of the file `name`, each as often as it is kept."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._used = 0

    def spend(self, pixels: Pixels) -> Pixels:
        """Count and return `pixels`. Raises `SceneBuildError` when the total exceeds the limit per file."""
        self._used += pixels.shape[0] * pixels.shape[1]
        if self._used > MAX_FILE_PIXELS:
            raise SceneBuildError(
                f"the images of {self._name} have more than {MAX_FILE_PIXELS:,} pixels together: shrink them"
            )
        return pixels


def read_pixels(data: bytes, what: str) -> Pixels:
    """Return pixels (height, width, 1, 3 or 4), first row on top. Raises `SceneBuildError` with `what` in it."""
    image_module = _import_pillow()
    try:
        return to_pixels(image_module.open(io.BytesIO(data), formats=FORMATS), what)
    except (OSError, ValueError, SyntaxError, EOFError, image_module.DecompressionBombError) as error:
        raise SceneBuildError(f"{what} is no image that can be read: {error}") from None


def to_pixels(image: Any, what: str) -> Pixels:
    """Return the pixels of a Pillow image, 8 bits a channel; with alpha only when a pixel is not opaque.

    Raises `SceneBuildError` for too many pixels, before they are decoded.
    """
    if image.format not in (None, *FORMATS, _JPEGS):  # None: created in memory
        raise SceneBuildError(f"{what} is a picture in the form {image.format}; {', '.join(FORMATS)} are read")
    width, height = image.size
    if width * height > MAX_PIXELS:
        raise SceneBuildError(f"{what} has {width} x {height} pixels, at most {MAX_PIXELS:,} are read: shrink it")
    if image.mode.startswith(("I", "F")):
        values = np.asarray(image, np.float64)
        top = 65_535.0 if image.mode.startswith("I") else 1.0
        return np.ascontiguousarray(np.rint(np.clip(values / top, 0, 1) * 255)[:, :, None], np.uint8)
    if image.mode in ("1", "L"):
        return np.ascontiguousarray(np.asarray(image.convert("L"), np.uint8)[:, :, None])
    see_through = "A" in image.mode or "a" in image.mode or "transparency" in image.info
    return drop_alpha(np.ascontiguousarray(np.asarray(image.convert("RGBA" if see_through else "RGB"), np.uint8)))


def drop_alpha(pixels: Pixels, *, always: bool = False) -> Pixels:
    """Return `pixels` with three channels when all are opaque, or when `always` is set."""
    if pixels.shape[2] == 4 and (always or bool((pixels[:, :, 3] == 255).all())):
        return np.ascontiguousarray(pixels[:, :, :3])
    return pixels


def check_pixels(pixels: Any, what: str) -> Pixels:
    """Return a texture given as an array. Raises `SceneBuildError` for invalid ones."""
    array = to_array(pixels, what)
    if array.ndim == 2:
        array = array[:, :, None]
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] not in (1, 3, 4) or not array.size:
        raise SceneBuildError(
            f"{what}: a texture is a path or an array (height, width, 1, 3 or 4) of uint8, "
            f"not {array.shape} of {array.dtype}"
        )
    if array.shape[0] * array.shape[1] > MAX_PIXELS:
        raise SceneBuildError(f"{what} has {array.shape[1]} x {array.shape[0]} pixels, at most {MAX_PIXELS:,}")
    return np.array(array)


# --- colours: linear as in glTF, sRGB as in specifications; values beyond 0 to 1 are clipped -------------------------


def to_srgb(linear: ArrayLike) -> NDArray[np.float64]:
    """Convert linear values to sRGB."""
    v = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    curved = np.where(v < 1.0, 1.055 * v ** (1 / 2.4) - 0.055, 1.0)  # which is off by one bit at 1
    return np.where(v <= 0.0031308, v * 12.92, curved)


def to_linear(srgb: ArrayLike) -> NDArray[np.float64]:
    """Convert sRGB values to linear ones."""
    v = np.clip(np.asarray(srgb, np.float64), 0.0, 1.0)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
