"""A camera of a MuJoCo model: depth and colour as rendered, without a display.

The bodies stand as in the model's initial state, or as `body_poses` gives them; nothing is simulated.
`python -m iris_session.cloud.sources.mujoco_camera` tells whether this machine can draw: see `main`.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

import msgspec
import numpy as np
import numpy.typing as npt

from anchors.camera import CameraModel, pose_to_matrix
from anchors.pose import PoseTuple
from iris_session.cloud.camera_file import CameraSettings, CloudSettings
from iris_session.cloud.frames import DepthFrame, SourceError
from iris_session.cloud.sources.playback import DEFAULT_HZ, SECOND
from iris_session.cloud.voxels import VoxelFilter

Floats = npt.NDArray[np.float64]
_MAX_GEOMS: Final = 10_000
#: From OpenGL's camera (y up, z backward) to the optical frame (y down, z forward).
_FLIP: Final = np.diag([1.0, -1.0, -1.0])
_loading = threading.Lock()


class MujocoCamera:
    """Renders one camera of a model file.

    Args:
        settings: With the model file and the name of the camera in it.
        now_ns: Session time.
        body_poses: Newest poses of bodies by name, and their session time, of which frames are then: a state comes
            some milliseconds after it was so. Names that the model lacks are ignored.

    Raises:
        SourceError: The model, the camera or a way to draw without a display is missing.
    """

    recorded_hz = 0.0

    def __init__(
        self,
        settings: CameraSettings,
        now_ns: Callable[[], int],
        body_poses: Callable[[], tuple[int, Mapping[str, PoseTuple]] | None] | None = None,
    ) -> None:
        # Read when mujoco and OpenGL are imported; commands set it to "disable".
        if os.environ.get("MUJOCO_GL") not in ("egl", "osmesa"):
            os.environ["MUJOCO_GL"] = "egl"
        try:
            import mujoco
        except (ImportError, AttributeError) as error:  # the latter by PyOpenGL, where the library is missing
            raise _describe_missing_gl(error) from error

        self._mujoco: Any = mujoco
        self._now_ns, self._body_poses, self._captured_ns = now_ns, body_poses, 0
        self.depth_scale_m = settings.depth_scale_m or 0.001
        self._interval_ns, self._number = round(SECOND / (settings.hz or DEFAULT_HZ)), -1
        try:
            self._model = _load_model(mujoco, settings.model)
        except (ValueError, mujoco.FatalError) as error:
            raise SourceError(f"model {settings.model} cannot be loaded: {' '.join(str(error).split())}") from error
        self._camera_id = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, settings.camera)
        if self._camera_id < 0:
            cameras = ", ".join(self._model.camera(k).name for k in range(self._model.ncam)) or "no camera"
            raise SourceError(f"camera {settings.camera!r} is not in {settings.model}: it has {cameras}")
        if self._model.cam_sensorsize[self._camera_id].any():
            raise SourceError(f"camera {settings.camera!r} has a sensorsize: give it a fovy instead")
        self._size = (settings.width, settings.height)
        focal = 0.5 * settings.height / math.tan(0.5 * math.radians(self._model.cam_fovy[self._camera_id]))
        # The axis is in the middle of the picture; the centre of the first pixel is at 0.
        center = 0.5 * (settings.width - 1), 0.5 * (settings.height - 1)
        self.camera = CameraModel(settings.width, settings.height, focal, focal, *center)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self._bodies = _Bodies(mujoco, self._model)
        self._open_context()

    def _open_context(self) -> None:
        mujoco, model = self._mujoco, self._model
        model.vis.quality.offsamples = model.vis.quality.shadowsize = 0  # no buffers of what is not drawn
        model.vis.global_.offwidth, model.vis.global_.offheight = self._size
        try:
            if os.environ["MUJOCO_GL"] == "osmesa":
                from mujoco.osmesa import GLContext
            else:
                from mujoco.egl import GLContext
            self._gl = GLContext(*self._size)
            self._gl.make_current()
            self._context: Any = mujoco.MjrContext(model, int(mujoco.mjtFontScale.mjFONTSCALE_50))
        except (ImportError, AttributeError, RuntimeError, mujoco.FatalError) as error:
            raise _describe_missing_gl(error) from error
        self._context.readDepthMap = int(mujoco.mjtDepthMap.mjDEPTH_ZEROFAR)
        mujoco.mjr_setBuffer(int(mujoco.mjtFramebuffer.mjFB_OFFSCREEN), self._context)
        self._scene = mujoco.MjvScene(model, _MAX_GEOMS)
        for flag in ("mjRND_SHADOW", "mjRND_REFLECTION", "mjRND_HAZE", "mjRND_SKYBOX"):
            self._scene.flags[int(getattr(mujoco.mjtRndFlag, flag))] = 0
        self._option, self._view = mujoco.MjvOption(), mujoco.MjvCamera()
        self._view.type, self._view.fixedcamid = int(mujoco.mjtCamera.mjCAMERA_FIXED), self._camera_id

    def read(self, timeout_s: float) -> DepthFrame | None:
        """Return the next frame; see `DepthSource`."""
        # Frames are captured at multiples of the period, by all cameras of one rate together, also when drawing takes
        # longer: frames that are further apart than a pipeline joins would be left out.
        number, late_ns = divmod(self._now_ns(), self._interval_ns)
        if number <= self._number or late_ns > self._interval_ns // 4:
            number = max(number, self._number) + 1
        wait_s = (number * self._interval_ns - self._now_ns()) / SECOND
        if wait_s > 0.0:
            time.sleep(min(wait_s, timeout_s))
        if wait_s > timeout_s:
            return None
        self._number = number
        capture_ns = self._now_ns()
        state = None if self._body_poses is None else self._body_poses()
        if state is not None:
            capture_ns, poses = state
            self._bodies.place(self._data, poses)
        self._captured_ns = capture_ns = max(capture_ns, self._captured_ns)  # the first states are older than no state
        color, depth_m = self._render()
        units = np.rint(depth_m / self.depth_scale_m)
        depth = np.where(units < 65_535.0, units, 0.0).astype(np.uint16)
        return DepthFrame(depth, color, capture_ns, self._compute_pose())

    def close(self) -> None:
        """Release the OpenGL context."""
        if self._context is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._context = None

    def _render(self) -> tuple[npt.NDArray[np.uint8], Floats]:
        """Return colour, and depth along the axis [m]; beyond the far plane it is infinite."""
        mujoco = self._mujoco
        width, height = self._size
        self._gl.make_current()
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, self._view, int(mujoco.mjtCatBit.mjCAT_ALL), self._scene
        )
        area = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(area, self._scene, self._context)
        color, buffer = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.float32)
        mujoco.mjr_readPixels(color, buffer, area, self._context)
        limits, extent = self._model.vis.map, self._model.stat.extent
        near, far = limits.znear * extent, limits.zfar * extent
        # The buffer is 1 at the near plane, 0 at the far one, linear in 1 / depth.
        value = buffer.astype(np.float64)
        depth_m = np.where(value > 0.0, near * far / (near + value * (far - near)), np.inf)
        return np.ascontiguousarray(color[::-1]), depth_m[::-1]

    def _compute_pose(self) -> Floats:
        pose = np.eye(4)
        pose[:3, :3] = self._data.cam_xmat[self._camera_id].reshape(3, 3) @ _FLIP
        pose[:3, 3] = self._data.cam_xpos[self._camera_id]
        return pose


class _Bodies:
    """Places bodies, and all that is fixed to them, without computing joints."""

    def __init__(self, mujoco: Any, model: Any) -> None:
        self._mujoco, self._model = mujoco, model
        names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, k) for k in range(model.nbody)]
        self._ids = {name: k for k, name in enumerate(names) if name and k}
        #: Of each kind of thing that is fixed to a body: its name in MuJoCo's arrays, rotations in the body.
        self._fixed = [(kind, _to_rotations(getattr(model, f"{kind}_quat"))) for kind in ("geom", "site", "cam")]
        self._local = np.tile(np.eye(4), (model.nbody, 1, 1))
        self._local[:, :3, :3], self._local[:, :3, 3] = _to_rotations(model.body_quat), model.body_pos

    def place(self, data: Any, poses: Mapping[str, PoseTuple]) -> None:
        """Set the poses of bodies. A body that is not named moves with its parent if no joint is between them."""
        model = self._model
        world = np.tile(np.eye(4), (model.nbody, 1, 1))
        world[:, :3, :3], world[:, :3, 3] = data.xmat.reshape(-1, 3, 3), data.xpos
        given = {self._ids[name]: pose for name, pose in poses.items() if name in self._ids}
        for body in range(1, model.nbody):
            if body in given:
                world[body] = pose_to_matrix(given[body])
            elif not model.body_jntnum[body] and model.body_mocapid[body] < 0:
                world[body] = world[model.body_parentid[body]] @ self._local[body]
        turn, place = world[:, :3, :3], world[:, :3, 3]
        data.xmat[:], data.xpos[:] = turn.reshape(-1, 9), place
        for kind, rotation in self._fixed:
            body, position = getattr(model, f"{kind}_bodyid"), getattr(model, f"{kind}_pos")
            getattr(data, f"{kind}_xmat")[:] = (turn[body] @ rotation).reshape(-1, 9)
            getattr(data, f"{kind}_xpos")[:] = place[body] + np.einsum("nij,nj->ni", turn[body], position)


def _load_model(mujoco: Any, path: str) -> Any:
    """Load an MJCF or MJB file. Raises `ValueError` or `mujoco.FatalError`."""
    if not path.lower().endswith(".mjb"):
        return mujoco.MjModel.from_xml_path(path)
    why: list[str] = []
    with _loading:  # MuJoCo has one handler of warnings, which have the reason; without one it writes a file
        before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(why.append)
        try:
            return mujoco.MjModel.from_binary_path(path)
        except (ValueError, mujoco.FatalError) as error:
            reason = "; ".join(why) or error
            raise ValueError(f"{reason}; damaged, or not of MuJoCo {mujoco.__version__}: save it again") from error
        finally:
            mujoco.set_mju_user_warning(before)


def _describe_missing_gl(error: Exception) -> SourceError:
    said = " ".join(str(error).split())
    return SourceError(
        f"no OpenGL here ({said}): install libegl1 and Mesa's driver (Debian: libegl1 libgl1-mesa-dri), or libosmesa6 "
        "with MUJOCO_GL=osmesa"
    )


def _to_rotations(quaternions: Floats) -> Floats:
    """Return the rotation matrices (n, 3, 3) of quaternions (n, 4), w first."""
    turns = [pose_to_matrix(((0.0, 0.0, 0.0), tuple(q)))[:3, :3] for q in quaternions]
    return np.array(turns).reshape(-1, 3, 3)


def main() -> int:
    """Open the drawn cameras of a camera file and close them again: in a process that has nothing else to lose.

    Then let the filter of their points be compiled: beside a session, at low priority, that takes much longer. The
    file is on standard input, as `CloudSettings` in MessagePack. Why a camera cannot be drawn goes to standard output,
    on one line, with exit status 1.
    """
    settings = msgspec.msgpack.decode(sys.stdin.buffer.read(), type=CloudSettings)
    try:
        for camera in settings.cameras:
            if camera.source == "mujoco":
                MujocoCamera(camera, time.monotonic_ns).close()
        VoxelFilter(settings.voxel_m).warm_up()
    except SourceError as error:
        print(error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
