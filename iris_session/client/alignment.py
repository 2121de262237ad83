"""`client.alignment`: the alignment of this client, observations of anchors and images, and what a director does."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from anchors.pose import PoseTuple, compose, distance, quat_angle, quat_rotate
from iris_session.client.arguments import Numbers, PoseLike, to_numbers, to_pose
from iris_session.client.core.connection import ClientConnection
from iris_session.client.errors import ClientError, InvalidMessageError
from iris_session.protocol.client_messages import (
    MAX_TIP_POSES,
    Align,
    ClientMessage,
    MoveAnchor,
    Observation,
    PlaceAlignment,
    TrackingEpoch,
)
from iris_session.protocol.common import IDENTITY, Alignment, Pose
from iris_session.protocol.names import AlignAction, AnchorKind
from iris_session.protocol.server_messages import Reply

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


class ClientAlignment:
    """Alignment of one client: how its tracking frame lies in the world.

    A client in role `director` also measures, places and moves those of others.
    """

    def __init__(
        self,
        connection: ClientConnection,
        send: Callable[[ClientMessage], bool],
        request: Callable[[ClientMessage], Reply],
    ) -> None:
        self._connection = connection
        self._send = send
        self._request = request
        self._viewpoints = ViewpointCounter()
        self._lock = threading.Lock()  # of the numbers of viewpoints
        self._detector: Any = None  # of the camera and sheets of the newest image

    @property
    def current(self) -> Alignment | None:
        """Our own `T_world_tracking` as accepted by the session, `None` before."""
        return self._connection.mirror.find_alignment(self._connection.participant_id)

    @property
    def tracking_epoch(self) -> int:
        """Number of jumps of our tracking frame so far; `report_tracking_jump` counts one more."""
        return self._connection.tracking_epoch

    # --- our own ------------------------------------------------------------------------------------------------------

    def report_tracking_jump(self) -> int:
        """Report that the tracking frame jumped: our alignment is void.

        Returns:
            The new tracking epoch.
        """
        epoch = self._connection.tracking_epoch = self._connection.tracking_epoch + 1
        if self._connection.is_joined:  # else it follows the next welcome
            self._send(TrackingEpoch(epoch))
        return epoch

    def observe(
        self,
        anchor_id: str,
        T_tracking_anchor: PoseLike,
        *,
        kind: str = AnchorKind.QR,
        capture_ns: int | None = None,
        viewpoint_id: int = 0,
        size_m: float = 0.0,
        quality: float = 1.0,
        device: str = "head",
        covariance: Numbers = (),
        mark: str = "",
        tracking_epoch: int | None = None,
    ) -> None:
        """Report the observation of an anchor, in the tracking frame.

        Args:
            anchor_id: Id of the anchor; of kind `point`, a name for what others touch too.
            T_tracking_anchor: Its pose in the tracking frame, `((x, y, z) [m], (w, x, y, z))`.
            kind: An `AnchorKind`.
            capture_ns: Session time of the observation [ns], default now.
            viewpoint_id: The same number for observations from one place.
            size_m: Measured edge length [m], 0 when not measured.
            quality: 0 to 1.
            device: The device that observed it; of kinds `touch` and `point`, what touched. Without a covariance, all
                but a controller whose tip was calibrated counts as a fingertip.
            covariance: 36 values, 6x6 row-major, (x, y, z [m], rx, ry, rz [rad]), tracking axes; without it the
                session assumes that of a headset's camera, or of a touch with `device`. Of kind `touch` only the
                position counts; of kind `persistent` the axes are those of the anchor
                (`anchors.persistent.covariance_at_anchor`).
            mark: Of kind `touch`, the touched mark. Of both kinds the position is that of the tip, the rotation that of
                the grip.
            tracking_epoch: Epoch of the tracking frame, default the present one.

        Raises:
            InvalidMessageError: A value does not fit the protocol.
            NotConnectedError: There is no connection.
        """
        values = to_numbers("covariance", covariance)
        if len(values) not in (0, 36):
            raise InvalidMessageError(f"covariance: expected 36 numbers, 6x6 row-major, or none, got {len(values)}")
        self._send(
            Observation(
                anchor_id=anchor_id,
                kind=kind,
                T_tracking_anchor=to_pose("T_tracking_anchor", T_tracking_anchor),
                capture_ns=self._session_now_ns() if capture_ns is None else capture_ns,
                tracking_epoch=self.tracking_epoch if tracking_epoch is None else tracking_epoch,
                viewpoint_id=viewpoint_id,
                size_m=size_m,
                quality=quality,
                device=device,
                covariance=values,
                mark=mark,
            )
        )

    def report_tip_poses(self, device: str, T_tracking_grip: Sequence[PoseLike]) -> None:
        """Report poses of a controller that was turned while its tip stayed in a hole.

        The session calibrates the tip, and answers with the event `tip_calibrated`.

        Args:
            device: The controller, such as `controller/right`.
            T_tracking_grip: 20 to 100 poses, `((x, y, z) [m], (w, x, y, z))`; of more, 100 are sent. Poses within 15
                degrees of one another share their error: spread them over the whole motion.

        Raises:
            InvalidMessageError: A value does not fit the protocol.
            NotConnectedError: There is no connection.
        """
        n = len(T_tracking_grip)
        kept = min(n, MAX_TIP_POSES)
        self._send(
            Observation(
                anchor_id="",
                kind=AnchorKind.TIP,
                T_tracking_anchor=IDENTITY,
                capture_ns=self._session_now_ns(),
                tracking_epoch=self.tracking_epoch,
                device=device,
                grip_poses=tuple(to_pose("T_tracking_grip", T_tracking_grip[k * n // kept]) for k in range(kept)),
            )
        )

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
        """Detect sheets in an image and report them as observations.

        Where both poses of a plane fit, both are reported, and the session decides. Takes tenths of a second: not for
        the loop that sends samples.

        Args:
            image: (height, width[, 3]) uint8.
            camera: Intrinsics of the camera.
            sheets: Sheets to look for.
            T_tracking_camera: Pose of the camera at `capture_ns` (x right, y down, z into the scene),
                `((x, y, z) [m], (w, x, y, z))`.
            capture_ns: Session time of the image [ns], default now.
            viewpoint_id: By default counted by where the camera goes.
            device: The device that observed it.
            camera_sigma: Standard deviations ([m], [rad]) of `T_tracking_camera`.
            tracking_epoch: Epoch of the tracking frame, default the present one at the call.

        Returns:
            The sightings that were reported.

        Raises:
            InvalidMessageError: Image, camera or pose cannot be.
            NotConnectedError: There is no connection.
            ClientError: OpenCV or SciPy is missing.
        """
        epoch = self.tracking_epoch if tracking_epoch is None else tracking_epoch  # before the detection
        now_ns = self._session_now_ns() if capture_ns is None else capture_ns
        pose = to_pose("T_tracking_camera", T_tracking_camera)
        T: PoseTuple = (pose.p, pose.q)
        found = self._detect(image, camera, sheets)
        if viewpoint_id is None:
            with self._lock:
                viewpoint_id = self._viewpoints.number_at(epoch, T)
        for one in found:
            covariance = to_tracking_covariance(one.covariance, T, one.T_camera_sheet, camera_sigma)
            other = one.mirrored if one.ambiguous else None  # else the picture has decided
            px = one.reprojection_px
            self._send(
                Observation(
                    one.anchor_id,
                    one.kind,
                    Pose(*compose(T, one.T_camera_sheet)),
                    now_ns,
                    epoch,
                    viewpoint_id,
                    0.0,  # one camera cannot measure the size of a sheet, it takes it as given
                    device=device,
                    covariance=covariance,
                    alternative=None if other is None else Pose(*compose(T, other)),
                    residuals_px=() if other is None else (px, px * one.mirrored_ratio),
                )
            )
        return found

    def _detect(self, image: NDArray[Any], camera: CameraModel, sheets: Sequence[Sheet]) -> list[SheetDetection]:
        """Return the sheets in an image; OpenCV and SciPy are imported with the first."""
        try:
            from anchors.camera import CameraError
            from anchors.detection import DetectionError, SheetDetector
        except ImportError as error:
            raise _missing_package(error) from error
        try:
            if self._detector is None or (self._detector.camera, self._detector.sheets) != (camera, tuple(sheets)):
                self._detector = SheetDetector(sheets, camera)
            return list(self._detector.detect(np.asarray(image)))
        except ImportError as error:  # OpenCV is imported where it is used
            raise _missing_package(error) from error
        except (DetectionError, CameraError) as error:
            raise InvalidMessageError(f"observe_image: {error}") from error

    # --- measurements, and those of others ----------------------------------------------------------------------------

    def start_run(self, participant: str = "") -> None:
        """Measure an alignment again from the beginning. The one in force stays until there is a better one.

        Args:
            participant: Id of another participant, as director; empty: ourselves.

        Raises:
            DeniedError: We may not.
        """
        self._request(Align(0, AlignAction.START, participant))

    def stop_run(self, participant: str = "") -> None:
        """Stop the measurement of an alignment, and keep the one in force.

        Args:
            participant: Id of another participant, as director; empty: ourselves.

        Raises:
            DeniedError: We may not.
        """
        self._request(Align(0, AlignAction.STOP, participant))

    def place(self, participant: str, T_world_tracking: PoseLike, *, offset: bool = False) -> None:
        """As director, align a participant by hand.

        Args:
            participant: Id of the participant.
            T_world_tracking: Pose of its tracking frame in the world, `((x, y, z) [m], (w, x, y, z))`.
            offset: The pose is an offset to the measured alignment.

        Raises:
            DeniedError: We are not a director, or there is no such participant.
        """
        self._request(PlaceAlignment(0, participant, to_pose("T_world_tracking", T_world_tracking), offset))

    def move_anchor(self, anchor_id: str, T_world_anchor: PoseLike, *, force: bool = False) -> None:
        """As director, set the pose of an anchor; the scene moves for every participant aligned to it.

        Args:
            anchor_id: Id of the anchor.
            T_world_anchor: Its pose in the world, `((x, y, z) [m], (w, x, y, z))`.
            force: Also further than 5 m from where it was.

        Raises:
            DeniedError: We are not a director, or it is too far (`too_far`).
        """
        self._request(MoveAnchor(0, anchor_id, to_pose("T_world_anchor", T_world_anchor), force))

    def _session_now_ns(self) -> int:
        return self._connection.clock.session_ns(time.monotonic_ns())


def _missing_package(error: ImportError) -> ClientError:
    return ClientError(
        f"finding sheets needs OpenCV and SciPy ({error.name} is missing): pip install 'iris-session[anchors,opencv]'"
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
