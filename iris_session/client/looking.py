"""Looking at sheets through a camera of our own: a picture in, observations of the session's anchors out.

For headsets whose camera can be read, and for cameras on a tracked thing. The detector is that of `anchors`; OpenCV and
SciPy, which it needs, are imported with the first picture.
"""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from anchors.pose import PoseTuple, compose, distance, quat_angle, quat_rotate
from iris_session.client.connection import Connection
from iris_session.client.errors import ClientError, InvalidMessageError
from iris_session.client.values import PoseLike, pose_of
from iris_session.protocol.client_messages import ClientMessage, Observation
from iris_session.protocol.common import Pose

if TYPE_CHECKING:
    from anchors.camera import CameraModel
    from anchors.detection import SheetDetection
    from anchors.sheet import Sheet

Array = NDArray[np.float64]
#: From further away, or after such a turn, the errors of lens and light are others: a new viewpoint.
VIEWPOINT_M: Final = 0.15
VIEWPOINT_RAD: Final = 0.26
#: How well the camera's own pose is known, per axis: what a headset says of itself over a few seconds.
CAMERA_SIGMA: Final = (0.001, 0.001)  # [m], [rad]


class Viewpoints:
    """Numbers of viewpoints: the same number until the camera was moved elsewhere or its tracking frame jumped."""

    def __init__(self) -> None:
        self._number = 0
        self._from: tuple[int, PoseTuple] | None = None

    def at(self, tracking_epoch: int, T_tracking_camera: PoseTuple) -> int:
        """The number of the viewpoint that the camera is at now."""
        if self._from is not None and self._from[0] == tracking_epoch:
            p, q = self._from[1]
            near = distance(p, T_tracking_camera[0]) <= VIEWPOINT_M
            if near and quat_angle(q, T_tracking_camera[1]) <= VIEWPOINT_RAD:
                return self._number
        self._number += 1
        self._from = (tracking_epoch, T_tracking_camera)
        return self._number


class Looking:
    """Mixin of `Client`: sees sheets in pictures and reports them."""

    connection: Connection
    _lock: threading.RLock
    _viewpoints: Viewpoints
    _detector: Any

    @abstractmethod
    def session_now_ns(self) -> int: ...

    @abstractmethod
    def send(self, message: ClientMessage) -> bool: ...

    def _init_looking(self) -> None:
        self._viewpoints, self._detector = Viewpoints(), None

    def observe_image(
        self,
        image: NDArray[Any],
        camera: CameraModel,
        sheets: Sequence[Sheet],
        T_tracking_camera: PoseLike,
        *,
        capture_ns: int | None = None,
        viewpoint_id: int | None = None,
        device: str = "head",
        camera_sigma: tuple[float, float] = CAMERA_SIGMA,
        tracking_epoch: int | None = None,
    ) -> list[SheetDetection]:
        """Finds `sheets` in a picture, (height, width[, 3]) uint8, and reports them. Returns those that were reported.

        `T_tracking_camera`: where the camera was when it took the picture (x right, y down, z into the scene), at
        `capture_ns` of session time (default: now), known to `camera_sigma` ([m], [rad], standard deviations).
        `viewpoint_id`: by default counted by where the camera goes. `tracking_epoch`: of the frame that
        `T_tracking_camera` is in, by default the present one when this is called. Sightings of which nobody can tell
        which of the two poses of a plane is right are left out. Takes tenths of a second: not for the loop that sends
        samples.

        Raises `InvalidMessageError` for a picture, camera or pose that cannot be, `ClientError` without OpenCV.
        """
        epoch = self.connection.tracking_epoch if tracking_epoch is None else tracking_epoch  # before the detection
        now_ns = self.session_now_ns() if capture_ns is None else capture_ns
        pose = pose_of("T_tracking_camera", T_tracking_camera)
        T: PoseTuple = (pose.p, pose.q)
        found = [one for one in self._sightings(image, camera, sheets) if not one.ambiguous]
        if viewpoint_id is None:
            with self._lock:
                viewpoint_id = self._viewpoints.at(epoch, T)
        for one in found:
            self.send(
                Observation(
                    one.anchor_id,
                    one.kind,
                    Pose(*compose(T, one.T_camera_sheet)),
                    now_ns,
                    epoch,
                    viewpoint_id,
                    one.edge_m,
                    device=device,
                    covariance=in_tracking(one.covariance, T, one.T_camera_sheet, camera_sigma),
                )
            )
        return found

    def _sightings(self, image: NDArray[Any], camera: CameraModel, sheets: Sequence[Sheet]) -> list[SheetDetection]:
        try:
            from anchors.camera import CameraError
            from anchors.detection import DetectionError, SheetDetector
        except ImportError as error:
            raise _without(error) from error
        try:
            detector = self._detector
            if detector is None or (detector.camera, detector.sheets) != (camera, tuple(sheets)):
                detector = self._detector = SheetDetector(sheets, camera)
            return list(detector.detect(np.asarray(image)))
        except ImportError as error:  # OpenCV is imported where it is used
            raise _without(error) from error
        except (DetectionError, CameraError) as error:
            raise InvalidMessageError(f"observe_image: {error}") from error


def _without(error: ImportError) -> ClientError:
    return ClientError(
        f"finding sheets needs OpenCV and SciPy ({error.name} is missing): pip install 'iris-session[anchors]'"
    )


def in_tracking(
    covariance: Sequence[float],
    T_tracking_camera: PoseTuple,
    T_camera_sheet: PoseTuple,
    camera_sigma: tuple[float, float],
) -> tuple[float, ...]:
    """Covariance of `T_tracking_sheet` (36 values, tracking axes) from that of `T_camera_sheet` in camera axes and how
    well the camera's own pose is known: a camera that is turned by w puts the sheet off by w x lever."""
    q = T_tracking_camera[1]
    R = np.array([quat_rotate(q, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]).T
    turn = np.kron(np.eye(2), R)
    x, y, z = quat_rotate(q, T_camera_sheet[0])  # from the camera to the sheet, tracking axes
    J = np.eye(6)
    J[:3, 3:] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    own = np.diag([camera_sigma[0] ** 2] * 3 + [camera_sigma[1] ** 2] * 3)
    C = turn @ np.asarray(covariance, dtype=np.float64).reshape(6, 6) @ turn.T + J @ own @ J.T
    return tuple(float(v) for v in (0.5 * (C + C.T)).ravel())
