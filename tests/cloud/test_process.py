"""Poses of bodies at the capture of a frame, and the removal of robots, in the camera process."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from iris_session.client.errors import InvalidMessageError, NotConnectedError
from iris_session.cloud import process
from iris_session.cloud.config import CameraReport, CameraStart
from iris_session.cloud.process import FETCH_AGAIN_NS, BodyHistory, SessionRobots, SessionSink, find_taken_stream
from iris_session.cloud.voxels import PointSet
from iris_session.protocol.media import StreamBudget
from iris_session.protocol.status import DeliveryBudget
from tests.cloud.camera_settings import make_settings

MS = 1_000_000
DEADLINE_S = 60.0


class FakeClient:
    """The scene and the bodies of a client, by the test."""

    def __init__(self) -> None:
        self.scene: Any = SimpleNamespace(version=("session", "scene", 1), poses=None)
        self.mirror: Any = SimpleNamespace(body_index={"base": 0, "hand": 1}, robots={"left": None}, bodies=())


class Lab:
    """A history of the poses of two bodies, the second of which moves along x."""

    def __init__(self) -> None:
        self.client: Any = FakeClient()
        self.history = BodyHistory(self.client)

    def add(self, at_ms: float, x: float) -> None:
        poses = np.zeros((2, 7))
        poses[:, 3] = 1.0
        poses[1, 0] = x
        self.client.scene.poses = poses
        state: Any = SimpleNamespace(header=SimpleNamespace(session_time=round(at_ms * MS)))
        self.history.on_state(state)

    def find_x(self, at_ms: float, body: str = "hand") -> float | None:
        pose = self.history.find_pose(body, round(at_ms * MS))
        return None if pose is None else pose[0][0]


def test_poses_are_interpolated_between_states() -> None:
    lab = Lab()
    assert lab.find_x(0) is None
    assert lab.history.read_newest() is None
    for at in (0, 16, 32):
        lab.add(at, 0.01 * at)
    assert lab.find_x(0) == 0.0
    assert lab.find_x(20) == pytest.approx(0.2)
    assert lab.find_x(32) == pytest.approx(0.32)
    assert lab.find_x(20, "base") == 0.0
    assert lab.find_x(20, "no such body") is None
    newest = lab.history.read_newest()
    assert newest is not None
    assert (newest[0], newest[1]["hand"]) == (32 * MS, ((0.32, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))


def test_nothing_is_known_before_and_after_the_states_and_in_their_gaps() -> None:
    lab = Lab()
    for at in (100, 116, 500):
        lab.add(at, 0.0)
    assert lab.find_x(99) is None
    assert lab.find_x(501) is None
    assert lab.find_x(300) is None
    assert [lab.history.covers(at * MS) for at in (99, 100, 300, 500, 501)] == [False, True, True, True, False]


def test_another_scene_and_another_clock_begin_anew() -> None:
    """As of a session that is resumed after a reboot."""
    lab = Lab()
    lab.add(4990, 1.0)
    lab.client.scene.version = ("session", "other", 2)
    for at in (5000, 5016):
        lab.add(at, 1.0)
    assert lab.find_x(5008) == 1.0
    assert not lab.history.covers(4995 * MS), "one scene tells nothing of the other"
    for at in (3000, 3016):
        lab.add(at, 2.0)
    assert lab.find_x(3008) == 2.0
    assert lab.find_x(5008) is None
    assert lab.history.covers(3016 * MS)
    assert not lab.history.covers(5008 * MS)


class FakeRobotPoints:
    """Finds the points at x > 0."""

    def __init__(self, *_: object) -> None:
        self.n_unknown = 0

    def find(self, positions: Any, body_pose: object, capture_ns: int) -> Any:
        return positions[:, 0] > 0.0


def make_points() -> PointSet:
    positions = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], np.float32)
    return PointSet(positions, np.zeros((2, 3), np.uint8), np.ones(2, np.int64))


def wait_for_fetch(robots: SessionRobots) -> None:
    assert robots._thread is not None
    robots._thread.join(DEADLINE_S)
    assert not robots._thread.is_alive()


@pytest.mark.parametrize(("known_fault", "tracebacks"), [("", 1), ("KeyError: 'no such\\ncell'", 0)])
def test_an_unexpected_error_is_reported_and_logged_once(
    known_fault: str, tracebacks: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Once, and not with every restart."""

    def fail(_settings: object, client: Any, *_: object) -> str:
        client.close()
        raise KeyError("no such\ncell")

    monkeypatch.setattr(process, "run_cameras", fail)
    start = msgspec.structs.replace(CameraStart(make_settings("front")), known_fault=known_fault)
    reports: list[CameraReport] = []
    fault = "KeyError: 'no such\\ncell'"
    assert process.run_start(start, reports.append, lambda: False) == fault
    assert [(one.stream, one.starting, one.fault) for one in reports] == [("room", True, ""), ("room", False, fault)]
    assert caplog.text.count("Traceback") == tracebacks


def test_points_on_robots_go_once_their_shapes_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    fetched: list[object] = []
    is_there = threading.Event()

    def fetch(client: object, budget: object) -> Any:
        assert is_there.wait(DEADLINE_S)
        fetched.append(client)
        return SimpleNamespace(spec=None, meshes={}, failed={})

    monkeypatch.setattr(process, "fetch_scene", fetch)
    monkeypatch.setattr(process, "RobotPoints", FakeRobotPoints)
    lab = Lab()
    robots = SessionRobots(lab.client, lab.history)
    assert len(robots.remove(make_points(), 0).positions) == 2
    assert robots.is_ready(10 * MS), "frames do not wait for the shapes"
    is_there.set()
    wait_for_fetch(robots)
    assert not robots.is_ready(10 * MS), "but for the state, from then on"
    for at in (0, 16):
        lab.add(at, 0.0)
    assert robots.is_ready(10 * MS)
    left = robots.remove(make_points(), 10 * MS)
    assert left.positions.tolist() == [[-1.0, 0.0, 0.0]]
    assert (len(left.colors), len(left.counts)) == (1, 1)
    assert len(fetched) == 1
    lab.client.scene.version = ("session", "other", 2)
    robots.is_ready(10 * MS)
    wait_for_fetch(robots)
    assert len(fetched) == 2


def test_without_shapes_all_points_stay_until_they_are_there(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(client: object, budget: object) -> Any:
        raise NotConnectedError("this session shares no specification")

    monkeypatch.setattr(process, "fetch_scene", fail)
    lab = Lab()
    robots = SessionRobots(lab.client, lab.history)
    assert robots.is_ready(0)
    wait_for_fetch(robots)
    assert robots.is_ready(0)
    assert len(robots.remove(make_points(), 0).positions) == 2
    assert "points on robots stay in the cloud: this session shares no specification" in caplog.text
    assert robots.warning
    monkeypatch.setattr(process, "RobotPoints", FakeRobotPoints)
    monkeypatch.setattr(process, "fetch_scene", lambda *_: SimpleNamespace(spec=None, meshes={}, failed={}))
    robots.is_ready(FETCH_AGAIN_NS - 1)
    assert robots.is_ready(FETCH_AGAIN_NS - 1), "not tried again at once"
    robots.is_ready(FETCH_AGAIN_NS)
    wait_for_fetch(robots)
    assert len(robots.remove(make_points(), 0).positions) == 1
    assert robots.warning == ""


@pytest.mark.parametrize("error", [NotConnectedError("away"), InvalidMessageError("too large")])
def test_a_frame_that_cannot_be_sent_is_dropped(error: Exception) -> None:
    def publish(*_: object, **__: object) -> bool:
        raise error

    client: Any = SimpleNamespace(media=SimpleNamespace(publish=publish))
    assert not SessionSink(client).publish("room", b"", 0, "cloud", None)


def test_a_stream_that_another_source_has_is_named_with_the_key_to_change() -> None:
    settings = make_settings("front", picture_hz=5.0)
    assert find_taken_stream(settings, None) == ""
    free, taken = StreamBudget("room"), StreamBudget("room", taken_by="camera 'lab' at 10.0.0.8")
    picture = msgspec.structs.replace(taken, stream="room-front")
    other = msgspec.structs.replace(taken, stream="hall")
    assert find_taken_stream(settings, DeliveryBudget("full", streams=(free, other))) == ""
    assert find_taken_stream(settings, DeliveryBudget("full", streams=(other, taken))) == (
        "the stream 'room' has another source already, camera 'lab' at 10.0.0.8: write another `stream =` into the "
        "camera file, or end that source"
    )
    assert "another `name =` into" in find_taken_stream(settings, DeliveryBudget("full", streams=(free, picture)))
