"""A picture in, observations out: reports of a client with a camera of its own."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anchors.camera import CameraModel
from anchors.pose import PoseTuple, compose, distance, quat_angle, quat_from_rotvec
from anchors.sheet import Sheet
from anchors.sheet_print import to_pdf
from iris_session.client import Client, InvalidMessageError
from iris_session.client.alignment import CAMERA_SIGMA, ViewpointCounter, to_tracking_covariance
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


class FakeClient(Client):
    """A client whose messages are only collected in `sent`."""

    def __init__(self) -> None:
        super().__init__("127.0.0.1:1", name="ann")
        self.sent: list[Any] = []

    def send(self, message: ClientMessage) -> bool:
        self.sent.append(message)
        return True

    def request(self, message: Any, timeout_s: float = 5.0) -> Reply:
        self.sent.append(message)
        return Reply(1, True)


@pytest.fixture
def ann() -> Iterator[FakeClient]:
    client = FakeClient()
    yield client
    client.close()


@pytest.fixture(scope="module")
def picture() -> Any:
    """The sheet from a known place."""
    page, rng = Page(to_pdf(TABLE)), np.random.default_rng(1)
    return photograph([(page, T_CAMERA_SHEET)], CAMERA, Conditions(rays=2), rng)


def test_sheet_in_a_picture_is_observed_in_the_tracking_frame(ann: FakeClient, picture: Any) -> None:
    found = ann.alignment.observe_image(picture, CAMERA, [TABLE], T_TRACKING_CAMERA, capture_ns=5)
    (seen,) = ann.sent
    assert isinstance(seen, Observation)
    assert (seen.anchor_id, seen.kind, seen.capture_ns, seen.size_m, seen.viewpoint_id) == (
        "table",
        "board",
        5,
        0.0,
        1,
    )
    assert [one.anchor_id for one in found] == ["table"]
    p, q = compose(T_TRACKING_CAMERA, T_CAMERA_SHEET)
    assert distance(seen.T_tracking_anchor.p, p) < 0.002
    assert quat_angle(seen.T_tracking_anchor.q, q) < math.radians(0.3)
    C = np.reshape(seen.covariance, (6, 6))
    assert np.all(np.linalg.eigvalsh(C) > 0.0)
    # The camera's own pose is known to 1 mm and 1 mrad, which bounds the accuracy at 0.7 m.
    assert CAMERA_SIGMA[0] < math.sqrt(np.trace(C[:3, :3]) / 3.0) < 0.003


def test_picture_without_a_sheet_reports_nothing(ann: FakeClient, picture: Any) -> None:
    assert ann.alignment.observe_image(np.zeros_like(picture), CAMERA, [TABLE], T_TRACKING_CAMERA) == []
    assert ann.alignment.observe_image(picture, CAMERA, [Sheet("shelf", 0.120)], T_TRACKING_CAMERA) == []
    assert ann.sent == []


def test_both_poses_are_reported_where_the_picture_does_not_decide(
    ann: FakeClient, picture: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest = ann.alignment._detect
    other: PoseTuple = ((0.03, -0.02, 0.69), quat_from_rotvec((math.pi + 0.5, 0.0, 0.0)))
    for ratio in (1.01, 9.0):

        def detect(*given: Any, ratio: float = ratio) -> Any:
            return [replace(one, mirrored=other, mirrored_ratio=ratio) for one in honest(*given)]

        monkeypatch.setattr(ann.alignment, "_detect", detect)
        ann.alignment.observe_image(picture, CAMERA, [TABLE], T_TRACKING_CAMERA)
    in_doubt, decided = ann.sent
    assert in_doubt.alternative == Pose(*compose(T_TRACKING_CAMERA, other))
    assert in_doubt.residuals_px[1] == pytest.approx(1.01 * in_doubt.residuals_px[0])
    assert (decided.alternative, decided.residuals_px) == (None, ())


def test_observations_belong_to_the_tracking_frame_of_their_picture(
    ann: FakeClient, picture: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Finding sheets takes tenths of a second, and the frame may jump meanwhile."""
    honest = ann.alignment._detect

    def slow(*given: Any) -> Any:
        ann.alignment.report_tracking_jump()
        return honest(*given)

    monkeypatch.setattr(ann.alignment, "_detect", slow)
    ann.alignment.observe_image(picture, CAMERA, [TABLE], T_TRACKING_CAMERA)
    ann.alignment.observe_image(picture, CAMERA, [TABLE], T_TRACKING_CAMERA, tracking_epoch=0)
    assert ann.connection.tracking_epoch == 2
    assert [(one.tracking_epoch, one.viewpoint_id) for one in ann.sent] == [(0, 1), (0, 1)]


def test_viewpoints_are_counted_by_camera_motion() -> None:
    viewpoints = ViewpointCounter()
    turned: PoseTuple = ((0.0, 0.0, 0.0), quat_from_rotvec((0.0, 0.5, 0.0)))
    assert viewpoints.number_at(0, ZERO) == 1
    assert viewpoints.number_at(0, ((0.1, 0.0, 0.0), ZERO[1])) == 1
    assert viewpoints.number_at(0, ((0.3, 0.0, 0.0), ZERO[1])) == 2
    assert viewpoints.number_at(0, turned) == 3
    assert viewpoints.number_at(1, turned) == 4, "the tracking frame jumped: the place may differ"


def test_covariance_of_a_rotated_camera_is_rotated() -> None:
    along_view = np.diag([1e-6, 1e-6, 1e-2, 1e-6, 1e-6, 1e-4])
    quarter: PoseTuple = ((0.0, 0.0, 0.0), quat_from_rotvec((0.0, math.pi / 2, 0.0)))  # its z is our x
    C = np.reshape(to_tracking_covariance(along_view.ravel().tolist(), quarter, ZERO, (0.0, 0.0)), (6, 6))
    assert np.allclose(np.diag(C), [1e-2, 1e-6, 1e-6, 1e-4, 1e-6, 1e-6])


def test_covariances_of_wrong_size_are_rejected(ann: FakeClient) -> None:
    with pytest.raises(InvalidMessageError, match=r"36 numbers.*got 6"):
        ann.alignment.observe("table", ZERO, covariance=[1.0] * 6)
    ann.alignment.observe("table", ZERO, covariance=np.eye(6).ravel())
    assert ann.sent[0].covariance == tuple(np.eye(6).ravel().tolist())


def test_alignment_runs_and_anchors_are_requests(ann: FakeClient) -> None:
    ann.alignment.start_run()
    ann.alignment.stop_run("p2")
    ann.alignment.move_anchor("table", ([0.0, 1.0, 0.0], np.array([1.0, 0.0, 0.0, 0.0])))
    moved = Pose((0.0, 1.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    assert ann.sent == [Align(0, "start", ""), Align(0, "stop", "p2"), MoveAnchor(0, "table", moved)]
    with pytest.raises(InvalidMessageError, match="T_world_anchor"):
        ann.alignment.move_anchor("table", (1.0, 2.0))  # type: ignore[arg-type]
