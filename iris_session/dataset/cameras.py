"""Cameras of a data set, chosen after the session: of the model, or anywhere; and looks of the scene, by a seed.

A picture of look 0 is what MuJoCo's own renderer draws of the state, bit for bit. Other looks change light, colours and
textures, and nothing that moves. Pictures of real cameras are those that the session recorded, in every look.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import partial
from types import TracebackType
from typing import Any, Final, Self

import msgspec
import mujoco
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from iris_session.dataset.episodes import DatasetError
from iris_session.dataset.frames import EpisodeLeftOutError
from iris_session.protocol.media import is_stream_name
from iris_session.protocol.names import AssetEncoding, MediaEncoding
from iris_session.recording import RecordedImage, Recording
from iris_session.replay.pictures import (
    Layer,
    Renderer,
    find_camera,
    list_model_cameras,
    open_gl,
    require_shapes,
)
from iris_session.scene.errors import AssetDecodeError
from iris_session.scene.images import decode_image, read_stated_size
from iris_session.session.core import SessionCore

#: Most pixels of a side of a picture, and fewest.
MAX_SIDE: Final = 4096
MIN_SIDE: Final = 16
_NAME: Final = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_NUMBER: Final = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_PLACE: Final = re.compile(
    rf"({_NUMBER}),({_NUMBER}),({_NUMBER})->({_NUMBER}),({_NUMBER}),({_NUMBER})(?::({_NUMBER}))?".replace(" ", "")
)


class CameraSpec(msgspec.Struct, frozen=True):
    """A camera of a data set.

    Attributes:
        name: Its name in the set.
        camera: Camera of the model, empty for one that stands anywhere.
        eye, target: Where it stands, and a point that it looks at [m], world frame. Up is up.
        fovy: Vertical field of view [deg]; 0: that of the model's free camera.
        stream: Stream of recorded pictures, empty for a camera that is drawn.
        size: Width and height of those pictures [px].
    """

    name: str
    camera: str = ""
    eye: tuple[float, float, float] = (0.0, 0.0, 0.0)
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    fovy: float = 0.0
    stream: str = ""
    size: tuple[int, int] = (0, 0)


class PictureSpec(msgspec.Struct, frozen=True):
    """Pictures of every frame. `looks`: varied looks beside the scene as it is; `seed`: of these. `plain`: without
    shadows, reflections and smooth edges. `depth`, `masks`: these too, as further layers of each camera.
    """

    cameras: tuple[CameraSpec, ...] = ()
    width: int = 640
    height: int = 480
    looks: int = 0
    seed: int = 0
    plain: bool = False
    depth: bool = False
    masks: bool = False

    def get_size(self, camera: CameraSpec) -> tuple[int, int]:
        """Return width and height of the pictures of a camera [px]."""
        return camera.size if camera.stream else (self.width, self.height)


def parse_camera(text: str) -> CameraSpec:
    """Parse a camera: `wrist`, of the model or a stream; `top=overview`, under another name; or a place,
    `top=1.2,0,2->0,0,0.8:45`: where it stands, a point that it looks at, and its vertical field of view.

    Raises:
        DatasetError: The text is none of these.
    """
    name, is_named, what = text.strip().partition("=")
    wrong = DatasetError(
        f"{text!r:.80} is no camera: give a name of the model, NAME=CAMERA, or in quotes, as > is for the shell else, "
        "a place, 'NAME=X,Y,Z->X,Y,Z' or with :FOVY from 1 to 170"
    )
    place = _PLACE.fullmatch(what.replace(" ", ""))
    if not _NAME.fullmatch(name.replace("/", "_")) or (is_named and not what):
        raise wrong
    if place is None:
        if "->" in what or what.endswith("-"):
            raise wrong
        return CameraSpec(name.replace("/", "_"), what or name)
    x, y, z, tx, ty, tz, fovy = (float(number or 0.0) for number in place.groups())
    if (x, y, z) == (tx, ty, tz):
        raise DatasetError(f"{text!r:.80} looks at where it stands: give two places")
    if not (fovy == 0.0 or 1.0 <= fovy <= 170.0):
        raise wrong
    return CameraSpec(name, "", (x, y, z), (tx, ty, tz), fovy)


def parse_cameras(text: str) -> tuple[CameraSpec, ...]:
    """Parse cameras with commas between; a comma within the numbers of a place does not end it."""
    parts = re.split(r",(?=\s*[A-Za-z_][^,]*(?:,|=|$))", text) if text.strip() else []
    cameras = tuple(map(parse_camera, parts))
    names = [one.name for one in cameras]
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DatasetError(f"two cameras have the name {twice!r}: give one another name, NAME=CAMERA")
    return cameras


def find_streams(pictures: PictureSpec, model: mujoco.MjModel, recording: Recording) -> PictureSpec:
    """Return pictures of which those that the model has no camera for come from streams that were recorded.

    Raises:
        DatasetError: There is neither such a camera nor such a stream, or the size of its pictures is odd.
    """

    def find(spec: CameraSpec) -> CameraSpec:
        if not spec.camera or find_camera(model, spec.camera) is not None:
            return spec
        first = next(recording.pictures(spec.camera), None) if is_stream_name(spec.camera) else None
        if first is None:
            jpeg = (one.stream for one in recording.streams() if one.encoding == MediaEncoding.JPEG)
            streams, cameras = (", ".join(names) or "none" for names in (sorted(set(jpeg)), list_model_cameras(model)))
            raise DatasetError(
                f"there is no camera {spec.camera!r} in the scene, and no recorded picture of it: give a camera of the "
                f"scene ({cameras}), a stream of {recording.files[0]} ({streams}), or a place, "
                f"'{spec.name}=X,Y,Z->X,Y,Z:FOVY'"
            )
        try:
            width, height = read_stated_size(first.jpeg, AssetEncoding.JPEG)
        except AssetDecodeError as error:
            raise DatasetError(
                f"the first picture of {spec.camera!r} in {recording.files[0]} cannot be read: {error}"
            ) from error
        if width % 2 or height % 2:
            raise DatasetError(f"pictures of {spec.camera!r} are {width}x{height}: a video needs even numbers")
        return replace(spec, camera="", stream=spec.camera, size=(width, height))

    return replace(pictures, cameras=tuple(map(find, pictures.cameras)))


class RecordedCamera:
    """Pictures of a real camera, as the session recorded them.

    Args:
        recording: The open recording.
        spec: A camera that has a `stream`.
    """

    def __init__(self, recording: Recording, spec: CameraSpec) -> None:
        self.spec = spec
        self._pictures = recording.pictures(spec.stream)
        self._next = next(self._pictures, None)
        self._newest: RecordedImage | None = None

    def read(self, times_ns: Sequence[int]) -> Iterator[tuple[Layer, int]]:
        """Yield the newest picture at each frame of an episode, uint8, shape (height, width, 3), and its capture [ns].

        Args:
            times_ns: Session times of the frames, ascending, and later than those of earlier calls.

        Raises:
            EpisodeLeftOutError: The first frame has no picture yet, none is of the episode, or one has another size.
        """
        image, shown, of_stream = None, None, f"picture of {self.spec.stream!r}"
        for at_ns in times_ns:
            while self._next is not None and find_capture(self._next) <= at_ns:
                self._newest = max(filter(None, (self._next, self._newest)), key=find_capture)
                self._next = next(self._pictures, None)
            if self._newest is None:
                if self._next is None:
                    raise EpisodeLeftOutError(f"the recording has no {of_stream}")
                late_s = (find_capture(self._next) - at_ns) * 1e-9
                raise EpisodeLeftOutError(f"the first {of_stream} is {late_s:.2f} s after its first frame: trim it")
            if image is None or shown is not self._newest:
                image, shown = self._decode(self._newest), self._newest
            yield image, find_capture(self._newest)
        if self._newest is None or find_capture(self._newest) < times_ns[0]:
            raise EpisodeLeftOutError(f"no {of_stream} was taken in it")

    def _decode(self, picture: RecordedImage) -> Layer:
        try:
            pixels = decode_image(picture.jpeg, AssetEncoding.JPEG)
        except AssetDecodeError as error:
            raise EpisodeLeftOutError(f"a picture of {self.spec.stream!r} cannot be read: {error}") from error
        height, width = pixels.shape[:2]
        if (width, height) != self.spec.size:
            expected = "x".join(map(str, self.spec.size))
            raise EpisodeLeftOutError(f"a picture of {self.spec.stream!r} is {width}x{height}, not {expected}")
        return np.repeat(pixels, 3 // pixels.shape[2], axis=2)


def find_capture(picture: RecordedImage) -> int:
    """Return the session time of a picture [ns]: its capture, at the latest its receipt."""
    return min(picture.capture_ns, picture.received_ns)


class CameraSet:
    """Draws the cameras and looks of a data set, in an OpenGL context of its own.

    Raises `PictureError` where there is no OpenGL.
    """

    def __init__(self, spec: PictureSpec) -> None:
        self._spec = spec
        self._gl: Any = open_gl(spec.width, spec.height)
        self._model: mujoco.MjModel = None
        self._renderers: list[Renderer] = []
        self._cameras: list[tuple[CameraSpec, mujoco.MjvCamera]] = []
        self.notes: list[str] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Release what it holds of OpenGL."""
        if self._gl is not None:
            self._gl.make_current()  # else what has the same numbers in another context would be freed
            self._release()
            self._gl.free()
            self._gl = None

    def _release(self) -> None:
        for renderer in self._renderers:
            renderer.close()
        self._renderers.clear()

    def draw(self, core: SessionCore, recording: Recording) -> Iterator[tuple[int, str, Layer]]:
        """Yield look, camera and picture of the session's present state: uint8, shape (height, width, 3), RGB.

        After a picture come its layers, if wanted, under the names CAMERA_depth and CAMERA_mask: `Renderer.measure`.

        Raises:
            DatasetError: The scene has no such camera.
            PictureError: The scene has nothing that MuJoCo can draw.
        """
        self._gl.make_current()  # another set may have drawn meanwhile
        if self._model is not core.world.model:
            self._begin(core.world.model, recording)
        data, patches = core.world.data, core.authority.patches
        for look, renderer in enumerate(self._renderers):
            for spec, camera in self._cameras:
                yield look, spec.name, renderer.draw(data, camera, patches, fovy=spec.fovy)
                if self._spec.depth or self._spec.masks:
                    depth, bodies = renderer.measure()
                    if self._spec.depth:
                        yield look, f"{spec.name}_depth", depth
                    if self._spec.masks:
                        yield look, f"{spec.name}_mask", bodies

    def _begin(self, model: mujoco.MjModel, recording: Recording) -> None:
        """Make the renderers of a model, one for each look."""
        self._release()
        require_shapes(model, recording)
        spec = self._spec
        self._cameras = [(one, make_view(model, one)) for one in spec.cameras]
        for look in range(spec.looks + 1):
            rng = np.random.default_rng((spec.seed, look))
            vary = partial(vary_look, rng=rng) if look else lambda drawn: None
            self._renderers.append(Renderer(model, spec.width, spec.height, self.notes, vary, plain=spec.plain))
        self._model = model


def make_view(model: mujoco.MjModel, spec: CameraSpec) -> mujoco.MjvCamera:
    """Return a camera for MuJoCo's renderer.

    Raises:
        DatasetError: The model has no such camera.
    """
    if spec.camera:
        camera = find_camera(model, spec.camera)
        if camera is None:
            there_are = ", ".join(list_model_cameras(model)) or "none"
            raise DatasetError(
                f"there is no camera {spec.camera!r} in the scene: give one of its own ({there_are}), or a place, "
                f"{spec.name}=X,Y,Z->X,Y,Z:FOVY"
            )
        return camera
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    eye, target = np.array(spec.eye), np.array(spec.target)
    forward = (target - eye) / np.linalg.norm(target - eye)
    camera.lookat, camera.distance = target, float(np.linalg.norm(target - eye))
    camera.elevation = float(np.degrees(np.arcsin(np.clip(forward[2], -1.0, 1.0))))
    camera.azimuth = float(np.degrees(np.arctan2(forward[1], forward[0])))
    camera.orthographic = 0
    return camera


def vary_look(model: mujoco.MjModel, rng: np.random.Generator) -> None:
    """Change light, colours and textures of a model that is only drawn. The same draws give the same look."""
    for i in range(model.nlight):
        model.light_pos[i] += rng.uniform(-0.5, 0.5, 3)
        turned = model.light_dir[i] + rng.uniform(-0.3, 0.3, 3)
        model.light_dir[i] = turned / max(float(np.linalg.norm(turned)), 1e-6)
        model.light_diffuse[i] = np.clip(model.light_diffuse[i] * _draw_tint(rng, 0.5, 1.3, 0.15), 0.0, 1.0)
    headlight = model.vis.headlight
    headlight.ambient[:] = np.clip(headlight.ambient * rng.uniform(0.6, 1.5), 0.0, 1.0)
    headlight.diffuse[:] = np.clip(headlight.diffuse * rng.uniform(0.6, 1.3), 0.0, 1.0)
    for colours in (model.mat_rgba, model.geom_rgba, model.skin_rgba, model.flex_rgba):
        for colour in colours:
            colour[:3] = np.clip(colour[:3] * _draw_tint(rng, 0.7, 1.3, 0.25), 0.0, 1.0)
    for i in range(model.ntex):
        begin = int(model.tex_adr[i])
        channels = int(model.tex_nchannel[i])
        end = begin + int(model.tex_height[i]) * int(model.tex_width[i]) * channels
        texels: NDArray[np.uint8] = model.tex_data[begin:end].reshape(-1, channels)
        tint = np.ones(channels)
        tint[:3] = _draw_tint(rng, 0.7, 1.3, 0.25)[: min(3, channels)]
        texels[:] = np.clip(texels * tint, 0.0, 255.0).astype(np.uint8)


def _draw_tint(rng: np.random.Generator, low: float, high: float, spread: float) -> NDArray[np.float64]:
    """Return factors for red, green and blue: a common brightness, and a tint."""
    return rng.uniform(low, high) * rng.uniform(1.0 - spread, 1.0 + spread, 3)
