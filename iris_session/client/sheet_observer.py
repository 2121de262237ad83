"""Observation of printed sheets through a camera: an image in, observations of the session's anchors out.

For headsets whose camera can be read, and for cameras on a tracked device. The detector is that of `anchors`; OpenCV
and SciPy, which it needs, are imported with the first image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from anchors.pose import PoseTuple, compose, distance, quat_angle, quat_rotate
from iris_session.client.errors import ClientError, InvalidMessageError
from iris_session.protocol.client_messages import Observation
from iris_session.protocol.common import Pose

if TYPE_CHECKING:
    from anchors.camera import CameraModel
    from anchors.detection import SheetDetection
    from anchors.sheet import Sheet

#: From further away, or after such a turn, the errors of lens and light are others: a new viewpoint.
VIEWPOINT_M: Final = 0.15
VIEWPOINT_RAD: Final = 0.26
#: How well the camera's own pose is known, per axis: what a headset says of itself over a few seconds.
CAMERA_SIGMA: Final = (0.001, 0.001)  # [m], [rad]


class ViewpointCounter:
    """Numbers of viewpoints: the same number until the camera was moved elsewhere or its tracking frame jumped."""

    def __init__(self) -> None:
        self._number = 0
        self._from: tuple[int, PoseTuple] | None = None

    def number_at(self, tracking_epoch: int, T_tracking_camera: PoseTuple) -> int:
        """Return the number of the viewpoint that the camera is at now."""
        if self._from is not None and self._from[0] == tracking_epoch:
            p, q = self._from[1]
            near = distance(p, T_tracking_camera[0]) <= VIEWPOINT_M
            if near and quat_angle(q, T_tracking_camera[1]) <= VIEWPOINT_RAD:
                return self._number
        self._number += 1
        self._from = (tracking_epoch, T_tracking_camera)
        return self._number


class SheetObserver:
    """Detects sheets in images; keeps the detector of the camera and sheets that it was last used with."""

    def __init__(self) -> None:
        self.viewpoints = ViewpointCounter()
        self._detector: Any = None

    def detect(self, image: NDArray[Any], camera: CameraModel, sheets: Sequence[Sheet]) -> list[SheetDetection]:
        """Return the sheets in an image, (height, width[, 3]) uint8, whose pose is not ambiguous.

        Raises `InvalidMessageError` for an image or camera that cannot be, `ClientError` without OpenCV.
        """
        return [one for one in self._sightings(image, camera, sheets) if not one.ambiguous]

    def _sightings(self, image: NDArray[Any], camera: CameraModel, sheets: Sequence[Sheet]) -> list[SheetDetection]:
        try:
            from anchors.camera import CameraError
            from anchors.detection import DetectionError, SheetDetector
        except ImportError as error:
            raise _missing_package(error) from error
        try:
            detector = self._detector
            if detector is None or (detector.camera, detector.sheets) != (camera, tuple(sheets)):
                detector = self._detector = SheetDetector(sheets, camera)
            return list(detector.detect(np.asarray(image)))
        except ImportError as error:  # OpenCV is imported where it is used
            raise _missing_package(error) from error
        except (DetectionError, CameraError) as error:
            raise InvalidMessageError(f"observe_image: {error}") from error


def to_observation(
    sighting: SheetDetection,
    T_tracking_camera: PoseTuple,
    *,
    capture_ns: int,
    tracking_epoch: int,
    viewpoint_id: int,
    device: str,
    camera_sigma: tuple[float, float],
) -> Observation:
    """Return the observation of a sheet that was seen from `T_tracking_camera`."""
    return Observation(
        sighting.anchor_id,
        sighting.kind,
        Pose(*compose(T_tracking_camera, sighting.T_camera_sheet)),
        capture_ns,
        tracking_epoch,
        viewpoint_id,
        sighting.edge_m,
        device=device,
        covariance=to_tracking_covariance(
            sighting.covariance, T_tracking_camera, sighting.T_camera_sheet, camera_sigma
        ),
    )


def _missing_package(error: ImportError) -> ClientError:
    return ClientError(
        f"finding sheets needs OpenCV and SciPy ({error.name} is missing): pip install 'iris-session[anchors]'"
    )


def to_tracking_covariance(
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
