"""Image files to the pixels of textures: PNG, JPEG, WebP, TGA, BMP and a few more (`FORMATS`)."""

from __future__ import annotations

import io
from typing import Any, Final

import numpy as np

from iris_session.scene.errors import SceneBuildError
from iris_session.scene.images import Pixels
from iris_session.scene.parts import array_of

#: As Pillow calls them. Not all that it reads: it hands EPS to Ghostscript, whatever the file is called.
FORMATS: Final = ("PNG", "JPEG", "WEBP", "TGA", "BMP", "GIF", "TIFF", "PPM", "DDS")
_JPEGS: Final = "MPO"  # JPEG with further pictures: cameras make them
#: Most pixels of one image: larger ones are no texture, or a bomb.
MAX_PIXELS: Final = 1 << 26
#: Most pixels of all pictures of a file: 2 GiB in memory. A file of a few MiB can have any number of large ones.
MAX_FILE_PIXELS: Final = 1 << 29


class PixelBudget:
    """Counts the pixels of all pictures of the file `name`, each as often as it is kept."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._used = 0

    def spend(self, pixels: Pixels) -> Pixels:
        """`pixels`. Raises `SceneBuildError` when they are more than one file may have, with those before."""
        self._used += pixels.shape[0] * pixels.shape[1]
        if self._used > MAX_FILE_PIXELS:
            raise SceneBuildError(
                f"the images of {self._name} have more than {MAX_FILE_PIXELS:,} pixels together: shrink them"
            )
        return pixels


def read_pixels(data: bytes, what: str) -> Pixels:
    """(height, width, 1, 3 or 4), first row on top. Raises `SceneBuildError` with `what` in it."""
    image_module = _pillow()
    try:
        return pixels_of(image_module.open(io.BytesIO(data), formats=FORMATS), what)
    except (OSError, ValueError, SyntaxError, EOFError, image_module.DecompressionBombError) as error:
        raise SceneBuildError(f"{what} is no image that can be read: {error}") from None


def pixels_of(image: Any, what: str) -> Pixels:
    """Pixels of a Pillow image, 8 bits a channel; alpha only where something is not opaque. Raises `SceneBuildError`
    for too many, before they are decoded."""
    if image.format not in (None, *FORMATS, _JPEGS):  # None: made in memory
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
    return without_alpha(np.ascontiguousarray(np.asarray(image.convert("RGBA" if see_through else "RGB"), np.uint8)))


def without_alpha(pixels: Pixels, *, always: bool = False) -> Pixels:
    """`pixels` with three channels when their alpha says nothing, or is not wanted."""
    if pixels.shape[2] == 4 and (always or bool((pixels[:, :, 3] == 255).all())):
        return np.ascontiguousarray(pixels[:, :, :3])
    return pixels


def checked_pixels(pixels: Any, what: str) -> Pixels:
    """A texture that a caller gave as an array. Raises `SceneBuildError` for what is none."""
    array = array_of(pixels, what)
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


def _pillow() -> Any:
    try:
        from PIL import Image
    except ImportError:
        raise SceneBuildError("textures of files need Pillow: pip install 'iris-session[files]'") from None
    return Image
