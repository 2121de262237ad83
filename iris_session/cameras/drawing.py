"""The work of the process of model cameras without its connection: what is due, drawing, encoding, descriptions.

Pictures are drawn as `export` draws them of a recording, with the poses of a published state. No sockets and no clock.
"""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.cloud.config import CameraReport, SourceReport
from iris_session.cloud.model_camera import ModelCamera
from iris_session.cloud.worker import FrameSink
from iris_session.physics.names import list_body_names
from iris_session.protocol.media import StreamCamera, StreamInfo
from iris_session.protocol.names import MediaEncoding
from iris_session.protocol.server_messages import BodyInfo
from iris_session.replay.pictures import Image, Renderer, find_camera, list_model_cameras, open_gl

SECOND: Final = 1_000_000_000
INFO_NS: Final = SECOND
#: Share of pictures that were left out in a second, above which that is a warning.
SLOW_SHARE: Final = 0.2
TOO_SLOW: Final = "drawing takes too long here (smaller, slower or plain pictures, or a graphics card)"
JPEG_QUALITY: Final = 95
#: From OpenGL's camera (y up, z backward) to the optical frame (y down, z forward): half a turn about x.
_FLIP: Final = np.array([0.0, 1.0, 0.0, 0.0])
Floats = NDArray[np.float64]
_FIXED: Final = int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED)


class SeenState(NamedTuple):
    """A state of the session as a client sees it: session time [ns], `T_world_body` (n, 7) of `bodies`, and vertices
    (m, 3) of flexes by name, NaN where they are not known.
    """

    time_ns: int
    poses: NDArray[np.float64]
    bodies: tuple[BodyInfo, ...]
    vertices: Mapping[str, NDArray[np.floating]] = {}


class _View:
    """A camera, and what was published of it. `number`: period of the newest picture, `shown_ns`: time of its state;
    `n_drawn`, `n_skipped`: since the last report.
    """

    def __init__(self, spec: ModelCamera, camera: mujoco.MjvCamera) -> None:
        self.spec, self.camera = spec, camera
        self.period_ns = round(SECOND / spec.hz)
        self.restart()

    def restart(self) -> None:
        self.number = self.described = self.shown_ns = -1
        self.n_drawn = self.n_skipped = 0


class CameraDrawing:
    """Draws cameras of a model at their rates and publishes the pictures. Belongs to one thread.

    Args:
        model: The model of the session.
        cameras: Those that are wanted; what the model lacks is a warning.
        sink: Where pictures go.
        plain: Without shadows, reflections and smooth edges.

    Raises:
        PictureError: There is no OpenGL here.
    """

    def __init__(
        self, model: mujoco.MjModel, cameras: Sequence[ModelCamera], sink: FrameSink, *, plain: bool = False
    ) -> None:
        self._model, self._sink = model, sink
        self._data: Any = mujoco.MjData(model)
        mujoco.mj_forward(model, self._data)
        self._bodies = list(enumerate(list_body_names(model)))
        self._known: tuple[BodyInfo, ...] = ()
        self._ids: NDArray[np.intp] | None = None
        found = [(one, find_camera(model, one.camera)) for one in cameras]
        self._views = [_View(one, camera) for one, camera in found if camera is not None]
        lacking = [one.camera for one, camera in found if camera is None]
        self.warning = ""
        if lacking:
            there_are = ", ".join(list_model_cameras(model)) or "none"
            self.warning = f"the scene has no camera {', '.join(map(repr, lacking))}: it has {there_are}"
        self._notes: list[str] = []
        self._drops: Counter[str] = Counter()
        self._bytes = 0
        self._reported_ns: int | None = None
        width = max((one.spec.width for one in self._views), default=1)
        height = max((one.spec.height for one in self._views), default=1)
        self._gl: Any = open_gl(width, height)
        self._renderer = Renderer(model, width, height, self._notes, plain=plain)

    def close(self) -> None:
        """Release what it holds of OpenGL."""
        self._renderer.close()
        self._gl.free()

    def restart_clock(self) -> None:
        """Begin anew: session time is that of another session."""
        for view in self._views:
            view.restart()
        self._reported_ns = None

    def find_wait_s(self, now_ns: int) -> float:
        """Return the time until the next picture is due [s]; 0: one is."""
        due_ns = min(((view.number + 1) * view.period_ns for view in self._views), default=now_ns + SECOND)
        return max(0.0, (due_ns - now_ns) / SECOND)

    def poll(self, state: SeenState, now_ns: int) -> int:
        """Draw and publish what is due. A camera that is late leaves out pictures; the next one is of the newest state.

        Returns:
            The number of pictures that were published.
        """
        due = [
            view for view in self._views if now_ns // view.period_ns > view.number and state.time_ns != view.shown_ns
        ]
        if not due or not self._place(state):
            return 0
        n_sent = 0
        for view in due:
            number = now_ns // view.period_ns
            skipped = number - view.number - 1 if view.number >= 0 else 0
            view.n_skipped += skipped
            self._drops["superseded"] += skipped
            view.number, view.shown_ns = number, state.time_ns
            spec = view.spec
            image = self._renderer.draw(self._data, view.camera, size=(spec.width, spec.height))
            n_sent += self._publish(view, encode_jpeg(image), state.time_ns, now_ns)
        return n_sent

    def make_report(self, now_ns: int, *, connected: bool) -> CameraReport:
        """Return the state of the work, with rates since the last report."""
        elapsed_s = (now_ns - (now_ns if self._reported_ns is None else self._reported_ns)) / SECOND
        self._reported_ns = now_ns
        rates, slow = {}, []
        for view in self._views:
            hz = view.n_drawn / elapsed_s if elapsed_s > 0.0 else 0.0
            rates[view.spec.stream] = SourceReport(hz)
            if view.n_skipped > SLOW_SHARE * (view.n_skipped + view.n_drawn):
                slow.append(f"{view.spec.stream} at {hz:.1f} of {view.spec.hz:g} Hz")
            view.n_drawn = view.n_skipped = 0
        bytes_per_s, self._bytes = (self._bytes / elapsed_s if elapsed_s > 0.0 else 0.0), 0
        return CameraReport(
            connected=connected,
            bytes_per_s=bytes_per_s,
            drops={reason: n for reason, n in self._drops.items() if n},
            cameras=rates,
            warning="; ".join(
                filter(None, (self.warning, *self._notes, f"{TOO_SLOW}: {', '.join(slow)}" if slow else ""))
            ),
        )

    # --- inside -------------------------------------------------------------------------------------------------------

    def _place(self, state: SeenState) -> bool:
        """Place the bodies. False while the session has those of another model, for a moment after a scene change."""
        if state.bodies is not self._known:
            self._known = state.bodies
            fits = all((body.id, body.name) in self._bodies for body in state.bodies)
            self._ids = np.array([body.id for body in state.bodies], np.intp) if fits and state.bodies else None
        if self._ids is None or len(self._ids) != len(state.poses):
            return False
        place_bodies(self._model, self._data, self._ids, state.poses)
        for name, vertices in state.vertices.items():
            self._place_vertices(name, vertices)
        return True

    def _place_vertices(self, name: str, vertices: NDArray[np.floating]) -> None:
        flex = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_FLEX, name)
        if flex < 0:
            return
        begin, n = int(self._model.flex_vertadr[flex]), int(self._model.flex_vertnum[flex])
        rows = np.flatnonzero(np.isfinite(vertices[:n]).all(axis=1))
        self._data.flexvert_xpos[begin + rows] = vertices[rows]

    def _publish(self, view: _View, jpeg: bytes, capture_ns: int, now_ns: int) -> bool:
        info = self._describe(view) if now_ns // INFO_NS > view.described else None
        if not self._sink.publish(view.spec.stream, jpeg, capture_ns, MediaEncoding.JPEG, info):
            self._drops["send"] += view.described >= 0  # the first ones connect
            return False
        view.described = now_ns // INFO_NS
        view.n_drawn += 1
        self._bytes += len(jpeg)
        return True

    def _describe(self, view: _View) -> StreamInfo:
        """Return title, rate, size and pose of a camera. One that tracks something stands where it is now."""
        spec, k, model = view.spec, view.camera.fixedcamid, self._model
        focal = 0.5 * spec.height / math.tan(0.5 * math.radians(model.cam_fovy[k]))
        center = 0.5 * (spec.width - 1), 0.5 * (spec.height - 1)
        body, turn = int(model.cam_bodyid[k]), np.empty(4)
        if body and model.cam_mode[k] == _FIXED:
            name, position, quat = self._bodies[body][1], model.cam_pos[k], model.cam_quat[k]
        else:
            name, position, quat = "", self._data.cam_xpos[k], np.empty(4)
            mujoco.mju_mat2Quat(quat, self._data.cam_xmat[k])
        mujoco.mju_mulQuat(turn, quat, _FLIP)
        x, y, z = position.tolist()
        qw, qx, qy, qz = turn.tolist()
        camera = StreamCamera(spec.width, spec.height, focal, focal, *center, (), name, (x, y, z), (qw, qx, qy, qz))
        return StreamInfo(title=spec.camera if spec.camera != spec.stream else "", camera=camera, hz=spec.hz)


def encode_jpeg(image: Image) -> bytes:
    """Return a picture (h, w, 3), RGB, as JPEG with all of its colour."""
    import PIL.Image

    file = io.BytesIO()
    PIL.Image.fromarray(image).save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return file.getvalue()


# --- where bodies stand -----------------------------------------------------------------------------------------------


def place_bodies(model: mujoco.MjModel, data: Any, bodies: NDArray[np.intp], poses: Floats) -> None:
    """Move bodies of a state to poses, without joints.

    Args:
        model: The model.
        data: Its state; the places of everything that is drawn are written, `qpos` is not. A body that is not given
            stays where it is.
        bodies: Ids (n,).
        poses: `T_world_body` (n, 7), `x y z qw qx qy qz` [m].
    """
    data.xpos[bodies], data.xquat[bodies] = poses[:, :3], poses[:, 3:]
    turns = _to_matrices(data.xquat)
    data.xmat[:] = turns.reshape(-1, 9)
    data.xipos[:] = data.xpos + _rotate(turns, model.body_ipos)
    data.ximat[:] = (turns @ _to_matrices(model.body_iquat)).reshape(-1, 9)
    for kind in ("geom", "site"):
        body = getattr(model, f"{kind}_bodyid")
        getattr(data, f"{kind}_xpos")[:] = data.xpos[body] + _rotate(turns[body], getattr(model, f"{kind}_pos"))
        turned = turns[body] @ _to_matrices(getattr(model, f"{kind}_quat"))
        getattr(data, f"{kind}_xmat")[:] = turned.reshape(-1, 9)
    mujoco.mj_comPos(model, data)  # what a tracking camera or light looks at
    mujoco.mj_camlight(model, data)
    if model.nflex:
        mujoco.mj_flex(model, data)
    if model.ntendon:
        mujoco.mj_tendon(model, data)


def _rotate(turns: Floats, vectors: Floats) -> Floats:
    rotated: Floats = np.einsum("nij,nj->ni", turns, vectors)
    return rotated


def _to_matrices(quaternions: Floats) -> Floats:
    """Return rotation matrices (n, 3, 3) of unit quaternions (n, 4), w first."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)
