"""A picture in, observations out: what a client with a camera of its own reports of the sheets that it sees."""

from __future__ import annotations

import builtins
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from anchors.camera import CameraModel
from anchors.pose import PoseTuple, compose, distance, quat_angle, quat_from_rotvec
from anchors.sheet import Sheet
from anchors.sheet_print import to_pdf
from iris_session.client import Client, ClientError, InvalidMessageError
from iris_session.client.sheet_observer import CAMERA_SIGMA, ViewpointCounter, to_tracking_covariance
from iris_session.protocol.client_messages import Align, ClientMessage, MoveAnchor, Observation
from iris_session.protocol.common import Pose
from iris_session.protocol.server_messages import Reply

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from render_sheet import Conditions, Page, photograph

CAMERA = CameraModel(640, 480, 585.0, 585.0, 319.5, 239.5)
TABLE = Sheet("table", 0.120)
T_CAMERA_SHEET: PoseTuple = ((0.03, -0.02, 0.7), quat_from_rotvec((math.pi - 0.5, 0.0, 0.0)))
T_TRACKING_CAMERA: PoseTuple = ((0.4, 1.2, 1.5), quat_from_rotvec((-1.8, 0.5, 0.4)))
ZERO: PoseTuple = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


class Quiet(Client):
    """A client whose messages go nowhere but into `sent`."""

    def __init__(self) -> None:
        super().__init__("127.0.0.1:1", name="ann")
        self.sent: list[Any] = []

    def send(self, message: ClientMessage) -> bool:
        self.sent.append(message)
        return True

    def request(self, message: Any, timeout_s: float = 5.0) -> Reply:
        self.sent.append(message)
        return Reply(1, True)

    def session_now_ns(self) -> int:
        return 7_000


@pytest.fixture
def ann() -> Iterator[Quiet]:
    client = Quiet()
    yield client
    client.close()


@pytest.fixture(scope="module")
def picture() -> Any:
    """The sheet from a known place."""
    page, rng = Page(to_pdf(TABLE)), np.random.default_rng(1)
    return photograph([(page, T_CAMERA_SHEET)], CAMERA, Conditions(rays=2), rng)


def test_a_sheet_in_a_picture_is_observed_in_the_tracking_frame(ann: Quiet, picture: Any) -> None:
    found = ann.observe_image(picture, CAMERA, [TABLE], T_TRACKING_CAMERA, capture_ns=5)
    (seen,) = ann.sent
    assert isinstance(seen, Observation)
    assert (seen.anchor_id, seen.kind, seen.capture_ns, seen.size_m, seen.viewpoint_id) == (
        "table",
        "board",
        5,
        0.12,
        1,
    )
    assert [one.anchor_id for one in found] == ["table"]
    p, q = compose(T_TRACKING_CAMERA, T_CAMERA_SHEET)
    assert distance(seen.T_tracking_anchor.p, p) < 0.002
    assert quat_angle(seen.T_tracking_anchor.q, q) < math.radians(0.3)
    C = np.reshape(seen.covariance, (6, 6))
    assert np.all(np.linalg.eigvalsh(C) > 0.0)
    # The camera's own pose is known to 1 mm and 1 mrad: at 0.7 m nobody knows better than that.
    assert CAMERA_SIGMA[0] < math.sqrt(np.trace(C[:3, :3]) / 3.0) < 0.003


def test_a_picture_without_a_sheet_says_nothing(ann: Quiet, picture: Any) -> None:
    assert ann.observe_image(np.zeros_like(picture), CAMERA, [TABLE], T_TRACKING_CAMERA) == []
    assert ann.observe_image(picture, CAMERA, [Sheet("shelf", 0.120)], T_TRACKING_CAMERA) == []
    assert ann.sent == []


def test_pictures_and_poses_that_cannot_be_are_named(ann: Quiet, picture: Any) -> None:
    with pytest.raises(InvalidMessageError, match="must belong to the same resolution"):
        ann.observe_image(picture[:100], CAMERA, [TABLE], T_TRACKING_CAMERA)
    with pytest.raises(InvalidMessageError, match="two sheets have the same id"):
        ann.observe_image(picture, CAMERA, [TABLE, TABLE], T_TRACKING_CAMERA)
    with pytest.raises(InvalidMessageError, match="T_tracking_camera"):
        ann.observe_image(picture, CAMERA, [TABLE], (1.0, 2.0))  # type: ignore[arg-type]
    assert ann.sent == []


def test_without_opencv_the_extra_is_named(ann: Quiet, picture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    honest = builtins.__import__

    def lacking(name: str, *rest: Any) -> Any:
        if name == "cv2":
            raise ImportError("no OpenCV here", name="cv2")
        return honest(name, *rest)

    monkeypatch.setattr(builtins, "__import__", lacking)
    monkeypatch.delitem(sys.modules, "cv2")
    with pytest.raises(ClientError, match=r"cv2 is missing\): pip install 'iris-session\[anchors\]'"):
        ann.observe_image(picture, CAMERA, [TABLE], T_TRACKING_CAMERA)
    assert cv2 is not None


def test_ambiguous_sightings_are_left_out(ann: Quiet, picture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from anchors import detection

    monkeypatch.setattr(detection.SheetDetection, "ambiguous", property(lambda _: True))
    assert ann.observe_image(picture, CAMERA, [TABLE], T_TRACKING_CAMERA) == []
    assert ann.sent == []


def test_looks_are_of_the_tracking_frame_that_the_picture_was_taken_in(
    ann: Quiet, picture: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Finding sheets takes tenths of a second, and the frame may jump meanwhile."""
    honest = ann._sheets._sightings

    def slow(*given: Any) -> Any:
        ann.new_tracking_frame()
        return honest(*given)

    monkeypatch.setattr(ann._sheets, "_sightings", slow)
    ann.observe_image(picture, CAMERA, [TABLE], T_TRACKING_CAMERA)
    ann.observe_image(picture, CAMERA, [TABLE], T_TRACKING_CAMERA, tracking_epoch=0)
    assert ann.connection.tracking_epoch == 2
    assert [(one.tracking_epoch, one.viewpoint_id) for one in ann.sent] == [(0, 1), (0, 1)]


def test_observations_can_be_of_an_earlier_tracking_frame(ann: Quiet) -> None:
    ann.new_tracking_frame()
    ann.observe("table", ZERO, tracking_epoch=0)
    ann.observe("table", ZERO)
    assert [one.tracking_epoch for one in ann.sent] == [0, 1]


def test_viewpoints_are_counted_by_where_the_camera_goes() -> None:
    viewpoints = ViewpointCounter()
    turned: PoseTuple = ((0.0, 0.0, 0.0), quat_from_rotvec((0.0, 0.5, 0.0)))
    assert viewpoints.number_at(0, ZERO) == 1
    assert viewpoints.number_at(0, ((0.1, 0.0, 0.0), ZERO[1])) == 1
    assert viewpoints.number_at(0, ((0.3, 0.0, 0.0), ZERO[1])) == 2
    assert viewpoints.number_at(0, turned) == 3
    assert viewpoints.number_at(1, turned) == 4, "the tracking frame jumped: nothing says that it is the same place"


def test_covariance_of_a_turned_camera_is_turned_with_it() -> None:
    along_view = np.diag([1e-6, 1e-6, 1e-2, 1e-6, 1e-6, 1e-4])
    quarter: PoseTuple = ((0.0, 0.0, 0.0), quat_from_rotvec((0.0, math.pi / 2, 0.0)))  # its z is our x
    C = np.reshape(to_tracking_covariance(along_view.ravel().tolist(), quarter, ZERO, (0.0, 0.0)), (6, 6))
    assert np.allclose(np.diag(C), [1e-2, 1e-6, 1e-6, 1e-4, 1e-6, 1e-6])


def test_a_camera_whose_turn_is_uncertain_is_uncertain_across_the_view() -> None:
    far: PoseTuple = ((0.0, 0.0, 2.0), ZERO[1])
    C = np.reshape(to_tracking_covariance([0.0] * 36, ZERO, far, (0.0, 0.01)), (6, 6))
    assert np.allclose(np.diag(C), [4e-4, 4e-4, 0.0, 1e-4, 1e-4, 1e-4])
    wobble = np.array([0.0, 0.001, 0.0])
    moved = np.cross(wobble, far[0])
    assert np.sign(C[0, 4]) == np.sign(moved[0] * wobble[1])


def test_covariances_of_other_sizes_are_refused(ann: Quiet) -> None:
    with pytest.raises(InvalidMessageError, match="expected 36 numbers, 6x6 row-major, or none, got 6"):
        ann.observe("table", ZERO, covariance=[1.0] * 6)
    ann.observe("table", ZERO, covariance=np.eye(6).ravel())
    assert ann.sent[0].covariance == tuple(np.eye(6).ravel().tolist())


def test_alignment_runs_and_anchors_are_requests(ann: Quiet) -> None:
    ann.align("start")
    ann.align("stop", "p2")
    ann.move_anchor("table", ([0.0, 1.0, 0.0], np.array([1.0, 0.0, 0.0, 0.0])))
    moved = Pose((0.0, 1.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    assert ann.sent == [Align(0, "start", ""), Align(0, "stop", "p2"), MoveAnchor(0, "table", moved)]
    with pytest.raises(InvalidMessageError, match="T_world_anchor"):
        ann.move_anchor("table", (1.0, 2.0))  # type: ignore[arg-type]
