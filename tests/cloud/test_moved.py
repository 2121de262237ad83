"""A bumped camera is found by the sheets it sees, on computed photographs; noise and single bad detections are not."""

from __future__ import annotations

import math
import re
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from anchors.camera import CameraModel, pose_from_matrix, pose_to_matrix
from anchors.detection import DetectionError, SheetDetection, SheetDetector
from anchors.pose import PoseTuple, compose, inverse, quat_from_rotvec
from anchors.sheet import Sheet
from anchors.sheet_print import to_pdf
from iris_session.cloud.camera_file import CameraPose
from iris_session.cloud.frames import DepthFrame
from iris_session.cloud.moved import (
    CONFIRM_EVERY_NS,
    LOOK_EVERY_NS,
    ROBOT_EVERY_NS,
    CameraMove,
    MoveMonitor,
    MoveWatch,
    RobotMonitor,
    WatchedFrame,
)
from iris_session.cloud.robot_surface import PlacedSurface, SurfaceLook, Verdict
from iris_session.cloud.worker import CloudWorker
from iris_session.protocol.names import StreamFault
from tests.cloud.camera_settings import make_settings
from tests.cloud.fake_source import DEADLINE_S, FakeOutlet, FakeSource
from tests.cloud.rays import look_at

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from render_sheet import Conditions, Page, photograph

CAMERA = CameraModel(640, 480, 585.0, 585.0, 319.5, 239.5, (0.08, -0.18, 0.0008, -0.0005, 0.0))
TABLE, SHELF = Sheet("table", 0.160), Sheet("shelf", 0.160)
ANCHORS: dict[str, PoseTuple] = {
    "table": ((0.0, -0.45, 0.0), (1.0, 0.0, 0.0, 0.0)),
    "shelf": ((0.3, -0.35, 0.0), quat_from_rotvec((0.0, 0.0, 0.4))),
}
POSE = look_at((0.3, -1.2, 0.9), (0.1, -0.4, 0.0))
CALIBRATED = pose_from_matrix(POSE)
BUMP: PoseTuple = ((0.03, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
SECOND_NS = 1_000_000_000
#: Standard deviations of the position and rotation of a sheet a metre away.
COVARIANCE = np.diag([0.0005**2, 0.0005**2, 0.002**2, *[math.radians(0.3) ** 2] * 3])


@pytest.fixture(scope="module")
def pages() -> dict[str, Page]:
    return {sheet.anchor_id: Page(to_pdf(sheet)) for sheet in (TABLE, SHELF)}


def take_picture(pages: dict[str, Page], T_world_camera: PoseTuple, seed: int, *names: str) -> NDArray[np.uint8]:
    """Photograph sheets that lie where the session has them, from a camera. Return RGB."""
    placed = [(pages[name], compose(inverse(T_world_camera), ANCHORS[name])) for name in names]
    grey = photograph(placed, CAMERA, Conditions(rays=2), np.random.default_rng(seed))
    return np.repeat(grey[:, :, None], 3, axis=2)


def detect(name: str, T_world_camera: PoseTuple, random: np.random.Generator | None = None) -> SheetDetection:
    """Return the detection of a sheet by a camera, with noise."""
    error = np.zeros(6) if random is None else np.linalg.cholesky(COVARIANCE) @ random.normal(size=6)
    p, q = compose(inverse(T_world_camera), ANCHORS[name])
    rx, ry, rz = error[3:].tolist()
    turned = compose(((0.0, 0.0, 0.0), quat_from_rotvec((rx, ry, rz))), ((0.0, 0.0, 0.0), q))[1]
    x, y, z = (np.array(p) + error[:3]).tolist()
    covariance = tuple(COVARIANCE.ravel().tolist())
    return SheetDetection(name, "board", 0.16, ((x, y, z), turned), covariance, None, math.inf, 0.3, 4, True)


def watched(picture: NDArray[np.uint8], at_ns: int) -> WatchedFrame:
    """Return a frame of the camera with that picture, and without depth."""
    return WatchedFrame(DepthFrame(np.zeros((480, 640), np.uint16), picture, at_ns), CAMERA, 0.001, POSE, 0.01)


def make_monitor(error_m: float = 0.010) -> MoveMonitor:
    return MoveMonitor(CAMERA, [TABLE, SHELF], error_m=error_m)


@pytest.mark.long
def test_a_bump_of_3_cm_is_found_within_a_second_and_cleared_when_it_is_undone(pages: dict[str, Page]) -> None:
    monitor, now_ns = make_monitor(), 0
    bumped = compose(CALIBRATED, BUMP)
    for phase, pose in enumerate((CALIBRATED, bumped, CALIBRATED)):
        changed_ns, until_ns = now_ns, now_ns + SECOND_NS
        verdicts = []
        while now_ns < until_ns:  # pictures at 30 Hz; a look when it is due
            if monitor.is_due(now_ns):
                picture = take_picture(pages, pose, now_ns % 9973, "table")
                verdicts.append((now_ns - changed_ns, monitor.look(picture, POSE, ANCHORS, now_ns)))
            now_ns += SECOND_NS // 30
        assert monitor.seen_ns is not None
        assert len(verdicts) <= 4
        if phase != 1:
            assert monitor.move is None
            continue
        assert monitor.move is not None
        assert monitor.move.shift_m == pytest.approx(0.03, abs=0.006)
        assert math.degrees(monitor.move.turn_rad) < 0.5
        assert str(monitor.move).startswith("by ")
        assert next(late_ns for late_ns, move in verdicts if move is not None) < SECOND_NS


def test_noise_is_no_alarm_in_ten_minutes() -> None:
    random, monitor = np.random.default_rng(3), make_monitor()
    for step in range(10 * 60 * 2):
        assert (
            monitor.add_look([detect("table", CALIBRATED, random)], CALIBRATED, ANCHORS, step * LOOK_EVERY_NS) is None
        )
    # ... nor is an error of the calibration within what it states.
    off = compose(CALIBRATED, ((0.009, 0.0, 0.0), quat_from_rotvec((0.0, 0.0, math.radians(0.5)))))
    for step in range(1200):
        assert monitor.add_look([detect("table", off, random)], CALIBRATED, ANCHORS, step * LOOK_EVERY_NS) is None


def test_one_bad_detection_is_no_alarm_and_asks_for_another_look() -> None:
    monitor = make_monitor()
    bumped = compose(CALIBRATED, BUMP)
    poses = [CALIBRATED] * 3 + ([bumped] * 2 + [CALIBRATED]) * 5
    for step, pose in enumerate(poses):
        assert monitor.add_look([detect("table", pose)], CALIBRATED, ANCHORS, step * SECOND_NS) is None
        contradicts = pose == bumped
        assert monitor.is_due(step * SECOND_NS + CONFIRM_EVERY_NS) == contradicts
        assert monitor.is_due(step * SECOND_NS + LOOK_EVERY_NS)


def test_a_sheet_that_was_moved_is_not_a_camera_that_was_moved() -> None:
    monitor = make_monitor()
    bumped = compose(CALIBRATED, BUMP)
    for step in range(5):
        seen = [detect("table", CALIBRATED), detect("shelf", bumped)]
        assert monitor.add_look(seen, CALIBRATED, ANCHORS, step * SECOND_NS) is None
    for step in range(5, 8):
        seen = [detect("table", bumped), detect("shelf", bumped)]
        move = monitor.add_look(seen, CALIBRATED, ANCHORS, step * SECOND_NS)
    assert move is not None
    assert move.shift_m == pytest.approx(0.03, abs=1e-6)


def test_without_sheets_the_verdict_stays() -> None:
    monitor = make_monitor()
    bumped = compose(CALIBRATED, BUMP)
    for step in range(3):
        monitor.add_look([detect("table", bumped)], CALIBRATED, ANCHORS, step * SECOND_NS)
    assert monitor.move is not None
    ambiguous = replace(detect("table", CALIBRATED), mirrored=CALIBRATED, mirrored_ratio=1.0)
    unknown = replace(detect("table", CALIBRATED), anchor_id="door")
    for step in range(3, 9):
        assert monitor.is_due(step * SECOND_NS) == (step % 2 == 1)
        if step % 2 == 0:
            continue
        assert monitor.add_look([ambiguous, unknown], CALIBRATED, ANCHORS, step * SECOND_NS) is not None
    assert monitor.seen_ns == 2 * SECOND_NS


def test_a_turned_camera_is_found() -> None:
    monitor = make_monitor()
    turned = compose(CALIBRATED, ((0.0, 0.0, 0.0), quat_from_rotvec((0.0, math.radians(2.0), 0.0))))
    for step in range(3):
        move = monitor.add_look([detect("table", turned)], CALIBRATED, ANCHORS, step * SECOND_NS)
    assert move is not None
    assert math.degrees(move.turn_rad) == pytest.approx(2.0, abs=0.01)


def test_a_camera_that_is_carried_is_compared_with_where_it_should_be() -> None:
    """The pose by the calibration changes with the body that carries the camera."""
    monitor = make_monitor()
    for step in range(6):
        carried = compose(((0.05 * step, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), CALIBRATED)
        pose = compose(carried, BUMP) if step > 2 else carried
        move = monitor.add_look([detect("table", pose)], carried, ANCHORS, step * SECOND_NS)
        assert (move is not None) == (step == 5)
    assert move is not None
    assert move.shift_m == pytest.approx(0.03, abs=1e-6)


def test_pictures_of_another_size_are_refused() -> None:
    with pytest.raises(DetectionError, match="320 x 240"):
        make_monitor().look(np.zeros((240, 320, 3), np.uint8), pose_to_matrix(CALIBRATED), ANCHORS, 0)
    with pytest.raises(DetectionError, match="same id"):
        MoveMonitor(CAMERA, [TABLE, TABLE], error_m=0.01)


def test_colours_are_red_green_blue() -> None:
    """A detector takes blue first: a sheet on a coloured ground is as grey as it is to the eye."""
    seen: list[NDArray[np.uint8]] = []
    monitor = make_monitor()

    class Detector(SheetDetector):
        def detect(self, image: NDArray[np.uint8]) -> list[SheetDetection]:
            seen.append(image)
            return []

    monitor._detector = Detector([TABLE], CAMERA)
    red = np.zeros((480, 640, 3), np.uint8)
    red[:, :, 0] = 255
    monitor.look(red, POSE, ANCHORS, 0)
    assert seen[0][0, 0].tolist() == [0, 0, 255]


def test_looks_are_taken_in_a_thread_of_the_sheets_that_the_session_has(
    pages: dict[str, Page], caplog: pytest.LogCaptureFixture
) -> None:
    sheets: dict[str, tuple[float, PoseTuple]] = {}
    watch = MoveWatch(lambda: sheets)
    bumped = compose(CALIBRATED, BUMP)
    picture = take_picture(pages, bumped, 1, "table")
    watch.offer("front", watched(picture, 0))  # no sheets yet: nothing to look for
    assert watch._look is None
    sheets["table"] = (0.160, ANCHORS["table"])
    for step in range(1, 4):
        watch.offer("front", watched(picture, step * SECOND_NS))
        watch.offer("front", watched(picture, step * SECOND_NS + 1))  # not due, or one is under way
        assert watch._look is not None
        watch._look.result(60.0)
        assert (watch.find_move("front") is not None) == (step == 3)
    assert watch.find_move("left") is None
    # Another set of sheets puts no camera back.
    sheets["shelf"] = (0.160, ANCHORS["shelf"])
    sheets["\N{LATIN SMALL LETTER U WITH DIAERESIS}ber"] = (0.160, ANCHORS["shelf"])  # no name of a printed sheet
    watch.offer("front", watched(np.zeros((4, 4, 3), np.uint8), 9 * SECOND_NS))
    bad = watch._look
    bad.result(60.0)
    watch.offer("front", watched(picture, 9 * SECOND_NS + 1))
    assert watch._look is bad  # not at once: the next one may be as bad
    assert "4 x 4" in caplog.text
    assert watch.find_move("front") is not None
    # A camera that was opened anew with other intrinsics begins anew.
    watch.offer("front", watched(picture, 20 * SECOND_NS)._replace(camera=replace(CAMERA, fx=586.0)))
    assert watch.find_move("front") is None
    watch.close()


def test_sheets_that_come_and_go_leave_looks_at_the_others_and_the_verdict() -> None:
    monitor, bumped = make_monitor(), compose(CALIBRATED, BUMP)
    for step in range(2):
        assert monitor.add_look([detect("table", bumped)], CALIBRATED, ANCHORS, step * SECOND_NS) is None
    monitor.replace_sheets([TABLE, SHELF, Sheet("door", 0.160)])
    assert monitor.add_look([detect("table", bumped)], CALIBRATED, ANCHORS, 2 * SECOND_NS) is not None
    # Of looks at sheets that are gone nothing is known any more.
    monitor.replace_sheets([SHELF])
    shelf = {"shelf": ANCHORS["shelf"]}
    found = [monitor.add_look([detect("shelf", CALIBRATED)], CALIBRATED, shelf, n * SECOND_NS) for n in range(3, 6)]
    assert [one is None for one in found] == [False, False, True]


def test_cameras_are_looked_at_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """A look may take longer than the time between two clouds, and then every camera of a cloud is due at once."""
    looked: list[int] = []
    may_end = threading.Semaphore(0)

    def look(self: MoveMonitor, color: NDArray[np.uint8], *_: object) -> None:
        looked.append(int(color[0, 0, 0]))
        may_end.acquire(timeout=DEADLINE_S)

    monkeypatch.setattr(MoveMonitor, "look", look)
    watch = MoveWatch(lambda: {"table": (0.160, ANCHORS["table"])})
    for cloud in range(6):
        for number in range(3):
            picture = np.full((480, 640, 3), number, np.uint8)
            watch.offer(f"camera {number}", watched(picture, cloud * SECOND_NS))
        assert watch._look is not None
        may_end.release()
        watch._look.result(60.0)
    assert looked == [0, 1, 2, 0, 1, 2]
    watch.close()


def look(verdict: Verdict, bump: PoseTuple = BUMP) -> SurfaceLook:
    """Return a look of the camera at robots, which finds it off by `bump`."""
    correction = POSE @ pose_to_matrix(bump) @ np.linalg.inv(POSE)
    return SurfaceLook(verdict, correction if verdict == "off" else np.eye(4), 0.03)


def add_looks(monitor: RobotMonitor, start_s: int, *looks: SurfaceLook) -> list[CameraMove | None]:
    return [monitor.add_look(one, POSE, (start_s + step) * SECOND_NS) for step, one in enumerate(looks)]


def test_three_looks_at_robots_that_agree_decide() -> None:
    monitor = RobotMonitor()
    assert add_looks(monitor, 0, look("fits"), look("off"), look("off"), look("fits"), look("off")) == [None] * 5
    assert monitor.is_due(4 * SECOND_NS + CONFIRM_EVERY_NS), "the next look is soon"
    *_, move = add_looks(monitor, 5, look(""), look("off"), look(""), look("off"))
    assert move is not None
    assert move.shift_m == pytest.approx(0.03)
    assert not monitor.is_due(8 * SECOND_NS + CONFIRM_EVERY_NS)
    assert monitor.is_due(8 * SECOND_NS + ROBOT_EVERY_NS)
    assert add_looks(monitor, 9, *[look("")] * 5) == [move] * 5, "pictures that do not tell leave the verdict"
    assert add_looks(monitor, 14, *[look("fits")] * 3) == [move, move, None]


def test_looks_at_robots_that_disagree_are_no_move() -> None:
    """Things that move in front of robots may be taken for robots, each time at another place."""
    other: PoseTuple = ((-0.03, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    assert add_looks(RobotMonitor(), 0, *[look("off"), look("off", other)] * 5) == [None] * 10


def test_robots_that_were_never_seen_may_be_none_of_this_room() -> None:
    monitor = RobotMonitor()
    assert add_looks(monitor, 0, *[look("lost")] * 5) == [None] * 5
    add_looks(monitor, 5, *[look("fits")] * 3)
    *_, move = add_looks(monitor, 8, *[look("lost")] * 3)
    assert str(move) == "by an unknown distance"
    *_, move = add_looks(monitor, 11, *[look("off")] * 3)
    assert str(move) == "by 30 mm, 0.0 deg"


class FakeRobots:
    """Robots whose state is there or not."""

    def __init__(self, surface: PlacedSurface | None = None) -> None:
        self.ready = True
        self.asked: list[tuple[int, str]] = []
        self._surface = surface

    def is_ready(self, capture_ns: int) -> bool:
        return self.ready

    def place_surface(self, capture_ns: int, carrier: str) -> PlacedSurface | None:
        self.asked.append((capture_ns, carrier))
        return self._surface


def test_robots_are_looked_at_while_no_sheet_is_seen_and_their_state_is_there() -> None:
    robots = FakeRobots()
    watch = MoveWatch(dict, robots)

    def offer(at_ns: int) -> None:
        watch.offer("front", watched(np.zeros((480, 640, 3), np.uint8), at_ns)._replace(body="hand"))
        if watch._look is not None:
            watch._look.result(60.0)

    offer(0)
    offer(SECOND_NS // 2)
    assert robots.asked == [(0, "hand")], "once a second, also if there was nothing to compare"
    robots.ready = False
    offer(SECOND_NS + 2)
    assert robots.asked == [(0, "hand")]
    robots.ready = True
    offer(SECOND_NS + 3)  # the frame that waited is compared
    assert robots.asked == [(0, "hand"), (SECOND_NS + 2, "hand")]
    robots.ready = False
    offer(3 * SECOND_NS)
    offer(4 * SECOND_NS)  # the state of the one before never came
    robots.ready = True
    offer(4 * SECOND_NS + 1)
    assert robots.asked[2:] == [(4 * SECOND_NS + 1, "hand")]
    watch.restart()
    assert watch.find_move("front") is None
    watch.close()


def test_a_camera_that_lost_sheets_and_robots_at_once_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Robots are looked at beside sheets, so that it is known that the camera has seen them."""
    verdict: Verdict = "off"

    def see(
        self: MoveMonitor, color: NDArray[np.uint8], _pose: object, poses: dict[str, PoseTuple], at_ns: int
    ) -> None:
        self.add_look([detect("table", CALIBRATED)] if color.any() else [], CALIBRATED, poses, at_ns)

    monkeypatch.setattr(MoveMonitor, "look", see)
    monkeypatch.setattr("iris_session.cloud.moved.compare_depth", lambda *_: look(verdict))
    robots = FakeRobots(PlacedSurface(np.zeros((1, 3)), np.zeros((1, 3)), np.ones(1, bool)))
    watch = MoveWatch(lambda: {"table": (0.160, ANCHORS["table"])}, robots)
    dark, with_sheet = np.zeros((480, 640, 3), np.uint8), np.ones((480, 640, 3), np.uint8)

    def show(picture: NDArray[np.uint8], start_s: int, end_s: int) -> CameraMove | None:
        for half in range(2 * start_s, 2 * end_s):
            watch.offer("front", watched(picture, half * SECOND_NS // 2))
            if watch._look is not None:
                watch._look.result(60.0)
        return watch.find_move("front")

    assert show(with_sheet, 0, 20) is None, "while sheets are seen they decide"
    assert len(robots.asked) == 4
    verdict = "fits"
    assert show(with_sheet, 20, 40) is None
    verdict = "lost"
    assert str(show(dark, 40, 50)) == "by an unknown distance"
    assert show(with_sheet, 50, 53) is None
    watch.close()


def test_a_look_at_robots_that_fails_is_not_repeated_at_every_cloud(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> SurfaceLook:
        raise ValueError("no depth")

    monkeypatch.setattr("iris_session.cloud.moved.compare_depth", fail)
    watch = MoveWatch(dict, FakeRobots(PlacedSurface(np.zeros((1, 3)), np.zeros((1, 3)), np.ones(1, bool))))
    for step in range(60):
        watch.offer("front", watched(np.zeros((480, 640, 3), np.uint8), step * SECOND_NS // 30))
        if watch._look is not None:
            watch._look.result(60.0)
    assert caplog.text.count("no depth") == 2
    watch.close()


def test_the_cloud_of_a_moved_camera_is_flagged_until_it_is_back(pages: dict[str, Page]) -> None:
    outlet, source = FakeOutlet(), FakeSource()
    source.camera = CAMERA
    settings = make_settings("front")
    (front,) = settings.cameras
    settings = msgspec.structs.replace(
        settings, cameras=(msgspec.structs.replace(front, pose=CameraPose(*CALIBRATED)),)
    )
    watch = MoveWatch(lambda: {"table": (0.160, ANCHORS["table"])})
    worker = CloudWorker(settings, outlet, lambda camera, now_ns: source, time.perf_counter_ns, watch=watch)
    worker.start()
    noise = np.random.default_rng(5)

    def show(picture: NDArray[np.uint8], until: Callable[[str], bool]) -> str:
        deadline = time.monotonic() + DEADLINE_S
        found = None
        while found is None or not until(found.fault):
            assert time.monotonic() < deadline
            depth = noise.integers(1000, 1003, (480, 640)).astype(np.uint16)
            source.put(DepthFrame(depth, picture, outlet.now_ns(), None))
            worker.poll(0.05)
            found = outlet.newest_info("room")
        return found.detail

    # On a busy machine the frames are too slow as well, which is another fault.
    show(take_picture(pages, CALIBRATED, 1, "table"), lambda fault: fault != StreamFault.MOVED)
    bumped = take_picture(pages, compose(CALIBRATED, BUMP), 2, "table")
    detail = show(bumped, lambda fault: fault == StreamFault.MOVED)
    assert re.match(r"camera front: by (2[5-9]|3[0-5]) mm, 0\.\d deg", detail)
    show(take_picture(pages, CALIBRATED, 3, "table"), lambda fault: fault != StreamFault.MOVED)
    assert worker.close()
