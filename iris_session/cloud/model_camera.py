"""Cameras of a model whose pictures a session publishes: how they are written, and what their process is started with.

Plain data, no behaviour. The process writes `CameraReport`s, as those of camera files do.
"""

from __future__ import annotations

import re
from typing import Final

import msgspec

from iris_session.cloud.config import ProcessStart
from iris_session.protocol.media import is_stream_name

#: A picture that nothing else is said of [px, px, Hz].
WIDTH: Final = 320
HEIGHT: Final = 240
HZ: Final = 30.0
MIN_SIDE: Final = 16
MAX_SIDE: Final = 2048
MIN_HZ: Final = 0.1
MAX_HZ: Final = 120.0
_TEXT: Final = re.compile(r"(?P<camera>.+?)(?::(?P<width>\d{1,5})x(?P<height>\d{1,5}))?(?:@(?P<hz>\d+(?:\.\d+)?))?")


class ModelCamera(msgspec.Struct, frozen=True):
    """A camera of a model. `camera`: its name there; `width`, `height` [px]; `hz`: most pictures a second."""

    camera: str
    width: int = WIDTH
    height: int = HEIGHT
    hz: float = HZ

    @property
    def stream(self) -> str:
        """Name of its media stream, and of its pictures in data sets: that of the camera, `/` as `_`."""
        return self.camera.replace("/", "_")


def parse_model_camera(text: str) -> ModelCamera:
    """Parse `CAMERA[:WIDTHxHEIGHT][@HZ]`, as `wrist` or `top:320x240@30`.

    Raises:
        ValueError: The text is none, or a number is out of range; the text says what would be right.
    """
    found = _TEXT.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"{text!r:.80} is no camera: write CAMERA, or CAMERA:WIDTHxHEIGHT@HZ as top:320x240@30")
    width, height = int(found["width"] or WIDTH), int(found["height"] or HEIGHT)
    camera = ModelCamera(found["camera"], width, height, float(found["hz"] or HZ))
    if not (MIN_SIDE <= width <= MAX_SIDE and MIN_SIDE <= height <= MAX_SIDE):
        raise ValueError(f"{text!r:.80}: a picture has {MIN_SIDE} to {MAX_SIDE} pixels on each side")
    if not MIN_HZ <= camera.hz <= MAX_HZ:
        raise ValueError(f"{text!r:.80}: {MIN_HZ:g} to {MAX_HZ:g} pictures a second")
    if not is_stream_name(camera.stream):
        raise ValueError(
            f"{camera.camera!r:.80} cannot be the name of a media stream: give the camera of the model a name of 1 to "
            "48 letters, digits, '.', '_' or '-'"
        )
    return camera


class PicturesStart(ProcessStart, frozen=True):
    """Standard input of the process. `packed_model`: the model that the session simulates, as in its
    recording; `plain`: drawn without shadows, reflections and smooth edges.
    """

    cameras: tuple[ModelCamera, ...]
    packed_model: bytes
    plain: bool = False
