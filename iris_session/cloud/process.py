"""The camera process: `python -m iris_session.cloud.process`, with `CameraStart` on standard input.

It joins the session in the role `camera`, publishes the cloud and the pictures of one camera file, and joins again by
itself when the connection is lost. It ends by SIGTERM, with its parent, and when the session refuses it for good.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import logging
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from types import FrameType
from typing import Final, NoReturn, TypeVar

import msgspec

from anchors.pose import PoseTuple
from iris_session.client.client import Client
from iris_session.client.core.interpolation import interpolate
from iris_session.client.core.scene_follower import pose_at
from iris_session.client.core.state_stream import Poses, SceneState
from iris_session.client.errors import ClientError, InvalidMessageError, NotConnectedError
from iris_session.client.fetched_scene import fetch_scene
from iris_session.client.sockets import CurveKeys
from iris_session.cloud.camera_file import CloudSettings
from iris_session.cloud.config import CameraReport, CameraStart, ProcessStart
from iris_session.cloud.robot_points import RobotPoints
from iris_session.cloud.sources import open_source
from iris_session.cloud.voxels import PointSet
from iris_session.cloud.worker import CloudWorker
from iris_session.link.discovery import host_port
from iris_session.protocol.media import StreamInfo
from iris_session.protocol.names import Role
from iris_session.protocol.status import DeliveryBudget
from iris_session.scene.budget import Budget
from iris_session.system.extras import MissingExtraError
from iris_session.system.log import configure_logging, describe_error
from iris_session.system.priority import lower_thread_priority
from iris_session.system.process import die_with_parent, is_parent, take_stdout

#: Longest wait for a frame, after which the loop looks whether it is to end [s].
POLL_S: Final = 0.05
REPORT_S: Final = 1.0
#: Time to wait for a connection between two looks [s].
CONNECT_S: Final = 0.1
#: States are kept for so long, for the poses of bodies: longer than any camera is late. And so many at most.
STATES_NS: Final = 1_000_000_000
MAX_STATES: Final = 256
#: Shapes of robots that could not be fetched are fetched again with a frame so much later.
FETCH_AGAIN_NS: Final = 15_000_000_000
#: Of the scene only the shapes matter.
COARSE_TEXTURES: Final = Budget(texture_bytes=1)
#: A pose that was sent longer before or after a capture says nothing about it.
POSE_REACH_NS: Final = 100_000_000

_STAY: Final = "points on robots stay in the cloud"

log = logging.getLogger(__name__)
OnReport = Callable[[CameraReport], None]
Start = TypeVar("Start", bound=ProcessStart)


class BodyHistory:
    """Poses of the scene's bodies over the last second: states come by `on_state`, in another thread."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._lock = threading.Lock()
        self._states: deque[tuple[int, Poses]] = deque(maxlen=MAX_STATES)
        self._version: tuple[str, str, int] | None = None
        self._places: dict[str, int] = {}

    def on_state(self, state: SceneState) -> None:
        """Take a state of `client`."""
        version = self._client.scene.version
        if version is None or self._client.scene.poses is None:
            return
        now_ns = state.header.session_time
        with self._lock:
            if version != self._version or (self._states and now_ns < self._states[-1][0]):  # or it was resumed
                self._states.clear()
                self._version = version
                self._places = dict(self._client.mirror.body_index)
            self._states.append((now_ns, self._client.scene.poses))
            while now_ns - self._states[0][0] > STATES_NS:
                self._states.popleft()

    def read_newest(self) -> tuple[int, dict[str, PoseTuple]] | None:
        """Return the session time [ns] of the newest state, and `T_world_body` of every body in it."""
        with self._lock:
            if not self._states:
                return None
            at_ns, poses = self._states[-1]
            return at_ns, {body: pose_at(poses, place) for body, place in self._places.items()}

    def covers(self, time_ns: int) -> bool:
        """Return whether there are states before and after a session time [ns]."""
        with self._lock:
            return bool(self._states) and self._states[0][0] <= time_ns <= self._states[-1][0]

    def find_pose(self, body: str, time_ns: int) -> PoseTuple | None:
        """Return `T_world_body` at a session time [ns], interpolated.

        `None` while there is no state after it, for a time before all states, and for an unknown body.
        """
        with self._lock:
            place, states = self._places.get(body), list(self._states)
        if place is None:
            return None
        for (before_ns, before), (after_ns, after) in itertools.pairwise(states):
            if before_ns <= time_ns <= after_ns and after_ns - before_ns <= 2 * POSE_REACH_NS:
                share = (time_ns - before_ns) / max(1, after_ns - before_ns)
                return pose_at(interpolate(before[place : place + 1], after[place : place + 1], share), 0)
        return None


class SessionRobots:
    """Removes the points on the session's robots, by their shapes and the state at capture.

    The shapes are fetched in a thread, again for another scene and while some are missing, and not for a session
    without robots. Until they are there all points stay.

    Args:
        client: Client of the session.
        history: Poses of its bodies.
    """

    def __init__(self, client: Client, history: BodyHistory) -> None:
        self._client = client
        self._history = history
        self._scene: tuple[str, str] | None = None
        self._fetched_ns = 0
        self._thread: threading.Thread | None = None
        self._points: RobotPoints | None = None
        self._n_missing = 0  # shapes that `_points` lacks
        self._fault = ""

    @property
    def warning(self) -> str:
        """One line for people about points on robots that stay; empty while all is well."""
        n = 0 if self._points is None else self._points.n_unknown
        unknown = f"the session sends no poses of {n} bodies of robots" if n else ""
        why = "; ".join(filter(None, (self._fault, unknown)))
        return f"{_STAY}: {why}" if why else ""

    def is_ready(self, capture_ns: int) -> bool:
        """Return whether the state of that time is there; begin to fetch the shapes when they are needed."""
        version = self._client.scene.version
        is_fetching = self._thread is not None and self._thread.is_alive()
        if version is not None and not is_fetching and self._client.mirror.robots:
            is_other = version[:2] != self._scene
            if is_other:
                self._scene, self._points, self._n_missing = version[:2], None, 0
            is_due = not 0 <= capture_ns - self._fetched_ns < FETCH_AGAIN_NS  # or session time went back
            if is_other or (is_due and (self._points is None or self._n_missing)):
                self._fetched_ns = capture_ns
                self._thread = threading.Thread(target=self._fetch, name="iris-robots", daemon=True)
                self._thread.start()
        return self._points is None or self._history.covers(capture_ns)

    def remove(self, points: PointSet, capture_ns: int) -> PointSet:
        """Return the points that do not lie on robots."""
        robots = self._points
        if robots is None:
            return points
        kept = ~robots.find(points.positions, self._history.find_pose, capture_ns)
        return PointSet(points.positions[kept], points.colors[kept], points.counts[kept])

    def _fetch(self) -> None:
        mirror = self._client.mirror
        try:
            scene = fetch_scene(self._client, COARSE_TEXTURES)
            if self._points is not None and len(scene.failed) >= self._n_missing:
                return  # it is as it was
            points = RobotPoints(scene.spec, scene.meshes, tuple(mirror.robots.values()), mirror.bodies)
        except Exception as error:  # of a connection, or of a scene: the cloud goes on with the points on robots
            if self._points is None:
                self._warn(str(error))
            return
        self._points, self._n_missing = points, len(scene.failed)
        self._warn(f"{self._n_missing} shapes are missing" if scene.failed else "")

    def _warn(self, fault: str) -> None:
        if fault and fault != self._fault:
            log.warning("%s: %s", _STAY, fault)
        self._fault = fault


class SessionSink:
    """Publishes what a worker makes in the session of a client."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._refused = ""

    def now_ns(self) -> int:
        return self._client.session_now_ns()

    def publish(
        self, stream: str, frames: bytes | Mapping[str, bytes], capture_ns: int, encoding: str, info: StreamInfo | None
    ) -> bool:
        try:
            return self._client.media.publish(stream, frames, capture_ns=capture_ns, encoding=encoding, info=info)
        except NotConnectedError:
            return False
        except InvalidMessageError as error:  # one camera's values end neither this process nor the other cameras
            if str(error) != self._refused:
                self._refused = str(error)
                log.warning("a frame of %r cannot be sent: %s", stream, error)
            return False


def run_cameras(settings: CloudSettings, client: Client, on_report: OnReport, is_ending: Callable[[], bool]) -> str:
    """Publish the cloud and the pictures of a camera file in a session.

    Args:
        settings: The camera file.
        client: In role `camera`, not connected yet; it is closed at the end.
        on_report: Called about once a second.
        is_ending: Asked several times a second.

    Returns:
        Why it ended by itself: the session refuses it; empty otherwise.
    """
    history = BodyHistory(client)
    robots = SessionRobots(client, history) if settings.remove_robots else None
    client.on_state = history.on_state
    try:
        client.open()
        client.start()  # it joins while the filter is compiled or loaded
        worker = CloudWorker(
            settings,
            SessionSink(client),
            partial(open_source, body_poses=history.read_newest),
            time.perf_counter_ns,
            body_pose=history.find_pose,
            remover=robots,
        )
        on_report(CameraReport(settings.stream, starting=True))

        def report(one: CameraReport) -> None:
            warning = "; ".join(filter(None, (one.warning, robots.warning if robots else "")))
            on_report(msgspec.structs.replace(one, warning=warning, starting=worker.cloud is None))

        try:
            return _work(settings, worker, client, report, is_ending)
        finally:
            worker.close()
    except ClientError as error:
        return str(error)
    finally:
        client.close()


def _work(
    settings: CloudSettings, worker: CloudWorker, client: Client, on_report: OnReport, is_ending: Callable[[], bool]
) -> str:
    """Publish until the end. Return why it ends by itself: another source has one of the streams.

    Raises `ClientError` when the session refuses the client.
    """
    session_id = ""
    report_at = time.monotonic() + REPORT_S
    while not is_ending():
        connected = client.wait_for(lambda one: one.ready, CONNECT_S)
        welcome = client.connection.welcome
        if connected and welcome is not None and welcome.session_id != session_id:
            worker.restart_clock() if session_id else worker.start()
            session_id = welcome.session_id
        if connected:
            worker.poll(POLL_S)
            if fault := find_taken_stream(settings, client.media.delivery):
                return fault
        if time.monotonic() >= report_at:
            report_at = time.monotonic() + REPORT_S
            on_report(worker.make_report(connected=connected))
    return ""


def find_taken_stream(settings: CloudSettings, delivery: DeliveryBudget | None) -> str:
    """Return one line for people about a stream of a camera file that another source has, empty while there is none."""
    ours = settings.list_streams()
    for one in () if delivery is None else delivery.streams:
        if one.taken_by and one.stream in ours:
            key = "stream" if one.stream == settings.stream else "name"
            return (
                f"the stream {one.stream!r} has another source already, {one.taken_by}: write another `{key} =` into "
                "the camera file, or end that source"
            )
    return ""


def run_start(start: CameraStart, on_report: OnReport, is_ending: Callable[[], bool]) -> str:
    """Run the cameras of a process, and report why they end. Return it, empty where they were to end."""
    settings = start.settings
    return join_session(
        start, settings.stream, on_report, lambda client: run_cameras(settings, client, on_report, is_ending)
    )


def join_session(start: ProcessStart, stream: str, on_report: OnReport, work: Callable[[Client], str]) -> str:
    """Do the work of a camera process with a client of its session, and report why it ends.

    Args:
        start: Where the session is, and the keys.
        stream: Name for people: of the client, and in reports.
        on_report: Called with the first and the last report.
        work: Connects the client, closes it at the end, and returns why it ends by itself.

    Returns:
        Why it ends, empty where it was to end.
    """
    # Before the filter is compiled: on a busy machine that takes as long again as what was imported by now.
    on_report(CameraReport(stream, starting=True))
    keys = (start.server_key, start.public_key, start.secret_key)
    curve = CurveKeys(*(one.encode() for one in keys)) if start.server_key else None
    try:
        address = host_port(start.host, start.control_port)
        fault = work(Client(address, role=Role.CAMERA, name=stream, curve=curve))
    except (ClientError, MissingExtraError) as error:
        fault = str(error)
    except Exception as error:
        fault = describe_error(error)
        if fault != start.known_fault:  # else once for every restart
            log.exception("the camera process of %r ends", stream)
    if fault:
        on_report(CameraReport(stream, fault=fault))
    return fault


def run_process(start_type: type[Start], run: Callable[[Start, OnReport, Callable[[], bool]], str]) -> NoReturn:
    """Run a camera process of one session and end it, with exit status 1 if the session does not admit it.

    Args:
        start_type: Type of its standard input.
        run: Does the work: gets the input, writes reports, asks whether it is to end; returns why it ends by itself.
    """
    configure_logging()
    lower_thread_priority()  # of this thread and those that it starts: no tick is to wait for a cloud
    start = msgspec.msgpack.decode(sys.stdin.buffer.read(), type=start_type)
    reports = take_stdout()  # packages of cameras print
    os.set_blocking(reports, False)
    ending = threading.Event()

    def on_signal(number: int, _frame: FrameType | None) -> None:
        if number == signal.SIGTERM:
            ending.set()

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, on_signal)
    if start.parent_pid:
        signal.signal(signal.SIGHUP, on_signal)  # wakes the loop, which looks for its parent
        die_with_parent(signal.SIGHUP)

    def write_report(report: CameraReport) -> None:
        with contextlib.suppress(OSError):  # a parent that does not read is not waited for
            os.write(reports, msgspec.json.encode(report) + b"\n")

    def is_ending() -> bool:
        return ending.is_set() or (start.parent_pid != 0 and not is_parent(start.parent_pid))

    gc.collect()
    gc.freeze()
    fault = run(start, write_report, is_ending)
    # A driver that hangs in a thread would keep the interpreter from ending.
    os._exit(1 if fault else 0)


if __name__ == "__main__":
    run_process(CameraStart, run_start)
