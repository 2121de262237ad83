"""A scene at the recorded poses of its bodies: what can be seen of a moment without simulating the session again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.dataset.cameras import CameraSpec, make_view
from iris_session.physics.load import decode_model
from iris_session.physics.tip import Tip
from iris_session.protocol.specs import RobotSpec
from iris_session.recording import Recording, unpack_model

Floats = NDArray[np.float64]
_MOST_GEOMS: Final = 1


class PosedScene:
    """The first scene of a recording, with its bodies where a recorded state has them.

    Poses of class `closed` are rounded to 0.1 um in the recording. Skins, shapes, sites, cameras and lights follow the
    bodies; soft bodies stay as they were at first.

    Attributes:
        model, data: Of MuJoCo. Only what follows from poses is right in `data`: no joints, no forces.

    Raises:
        RecordingError: The model is of another version of MuJoCo.
    """

    def __init__(self, recording: Recording) -> None:
        header = recording.header
        self.model = decode_model(unpack_model(header.model))
        self.data: Any = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.bodies = header.bodies
        self._ids = np.array([body.id for body in header.bodies], np.intp)
        model = self.model
        self._geom_turns, self._site_turns = to_matrices(model.geom_quat), to_matrices(model.site_quat)

    def show(self, poses: Floats) -> None:
        """Put the bodies at `poses`, shape (n_bodies, 7): position [m], unit quaternion, in the world."""
        model, data = self.model, self.data
        data.xpos[self._ids], data.xquat[self._ids] = poses[:, :3], poses[:, 3:]
        R = to_matrices(data.xquat)
        data.xmat[:] = R.reshape(-1, 9)
        data.xipos[:] = data.xpos + np.einsum("nij,nj->ni", R, model.body_ipos)
        geoms, sites = model.geom_bodyid, model.site_bodyid
        data.geom_xpos[:] = data.xpos[geoms] + np.einsum("nij,nj->ni", R[geoms], model.geom_pos)
        data.geom_xmat[:] = (R[geoms] @ self._geom_turns).reshape(-1, 9)
        data.site_xpos[:] = data.xpos[sites] + np.einsum("nij,nj->ni", R[sites], model.site_pos)
        data.site_xmat[:] = (R[sites] @ self._site_turns).reshape(-1, 9)
        mujoco.mj_camlight(model, data)

    def make_tips(self, robots: Sequence[RobotSpec]) -> dict[str, Tip]:
        """Return the end effectors of robots by name."""
        return {robot.name: Tip(self.model, robot) for robot in robots}


class Projection:
    """View of a camera: says whether a point is within its picture.

    Args:
        scene: The scene.
        spec: The camera.
        aspect: Width of the picture by its height.

    Raises:
        DatasetError: The scene has no such camera.
    """

    def __init__(self, scene: PosedScene, spec: CameraSpec, aspect: float) -> None:
        self._scene, self._aspect = scene, aspect
        self._camera, self._fovy = make_view(scene.model, spec), spec.fovy
        self._drawn = mujoco.MjvScene(scene.model, _MOST_GEOMS)
        self._model_fovy = float(scene.model.vis.global_.fovy)

    def sees(self, point: Floats) -> bool:
        """Return whether a point [m, world] is in the picture of the scene as it is now, whatever is before it."""
        model = self._scene.model
        model.vis.global_.fovy = self._fovy or self._model_fovy
        mujoco.mjv_updateCamera(model, self._scene.data, self._camera, self._drawn)
        model.vis.global_.fovy = self._model_fovy
        left, right = self._drawn.camera  # of the two eyes: MuJoCo draws their mean
        eye = (np.array(left.pos, np.float64) + right.pos) / 2.0
        forward, up = np.array(left.forward, np.float64), np.array(left.up, np.float64)
        x, y, depth = np.array([np.cross(forward, up), up, forward]) @ (point - eye)
        if depth <= left.frustum_near:
            return False
        x, y = x * left.frustum_near / depth, y * left.frustum_near / depth
        half_width = left.frustum_width or self._aspect * (left.frustum_top - left.frustum_bottom) / 2.0
        is_across = abs(x - left.frustum_center) <= half_width
        return bool(is_across and left.frustum_bottom <= y <= left.frustum_top)


def to_matrices(quaternions: Floats) -> Floats:
    """Return the rotation matrices of unit quaternions (w, x, y, z), shape (n, 4), as shape (n, 3, 3)."""
    w, x, y, z = np.asarray(quaternions, np.float64).T
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
