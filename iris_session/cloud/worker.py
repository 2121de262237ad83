"""The work of one camera process without its connection: sources, pipeline, pictures, faults, reports.

It publishes through a `FrameSink`: a session, or nothing at all where a camera file is inspected. No sockets: session
time is that of the sink, and the clock that measures stages is an argument.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from statistics import fmean
from typing import Final, Protocol

import msgspec

from anchors.camera import CameraModel, pose_from_matrix
from iris_session.cloud.camera_file import CameraSettings, CloudSettings
from iris_session.cloud.config import CameraReport, SourceReport
from iris_session.cloud.frames import DepthSource, SourceFrame
from iris_session.cloud.health import CameraHealth, Fault
from iris_session.cloud.pipeline import BodyPose, Cloud, CloudPipeline, PointRemover
from iris_session.cloud.reader import SourceReader
from iris_session.cloud.sources.playback import DEFAULT_HZ
from iris_session.cloud.voxels import Colors, Floats, VoxelFilter, choose_max_cells
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.media import StreamCamera, StreamInfo, find_info_problem
from iris_session.protocol.names import MediaEncoding, StreamFault
from iris_session.system.extras import require_package
from iris_session.system.log import describe_error

MILLISECOND: Final = 1_000_000
SECOND: Final = 1_000_000_000
#: Period of the description of a stream.
INFO_NS: Final = SECOND
JPEG_QUALITY: Final = 80
#: Sources whose pictures of a world at rest are all the same.
RENDERED: Final = frozenset({"mujoco"})
LEFT_OUT: Final = "its frames are in no cloud: they are captured, or dated, more than 50 ms before those of the others"
NO_BODY: Final = "the session has no body {!r}, or no state of it when a frame was captured"
NO_STATE: Final = "the session has no state of its robots when a frame was captured, which remove_robots needs"
#: Session time that runs back by more than its slewing explains is that of another clock: the session was resumed.
BACK_NS: Final = 50 * MILLISECOND
#: Time for the threads to leave their sources.
JOIN_NS: Final = SECOND // 2

log = logging.getLogger(__name__)
#: Opens the source of a camera, which stamps its frames by the clock [ns].
OpenSource = Callable[[CameraSettings, Callable[[], int]], DepthSource]


class FrameSink(Protocol):
    """The destination of frames."""

    def now_ns(self) -> int:
        """Return session time [ns]."""
        ...

    def publish(
        self, stream: str, frames: bytes | Mapping[str, bytes], capture_ns: int, encoding: str, info: StreamInfo | None
    ) -> bool:
        """Publish a frame, or `info` only where `frames` is empty. False: it was dropped."""
        ...


class _Stream:
    """One stream, and when it was described last."""

    def __init__(self, name: str, encoding: str) -> None:
        self.name = name
        self.encoding = encoding
        self.restart()

    def restart(self) -> None:
        """Begin anew: for another session."""
        self.due_ns = 0
        self.described_ns = -INFO_NS
        self.described: Fault | None = None

    def needs_info(self, fault: Fault | None, now_ns: int) -> bool:
        """Return whether the description is due: the kind of fault is another one, or a second has passed."""
        kinds = {None if one is None else one.fault for one in (fault, self.described)}
        return len(kinds) > 1 or now_ns - self.described_ns >= INFO_NS

    def is_due(self, hz: float, now_ns: int) -> bool:
        """Return whether another frame may be published, at most `hz` of them in the mean; count it then."""
        if now_ns < self.due_ns:
            return False
        period_ns = round(SECOND / hz)
        self.due_ns = max(self.due_ns + period_ns, now_ns - period_ns)
        return True


class CloudWorker:
    """Sources, pipeline and streams of one camera file.

    Args:
        settings: The camera file.
        sink: Destination of the frames.
        open_source: Opens a source.
        clock_ns: Clock by which stages are measured [ns].
        body_pose: Poses of bodies that carry cameras.
        remover: Removes points from every cloud.

    Attributes:
        cloud: The newest cloud, `None` before the first.
        poses: `T_world_camera` of the newest joined frames by camera.
    """

    def __init__(
        self,
        settings: CloudSettings,
        sink: FrameSink,
        open_source: OpenSource,
        clock_ns: Callable[[], int],
        *,
        body_pose: BodyPose | None = None,
        remover: PointRemover | None = None,
    ) -> None:
        if settings.picture_hz:
            require_package("cv2", "pictures of cameras (picture_hz)")
        self._settings = settings
        self._sink = sink
        self._clock_ns = clock_ns
        self._wake = threading.Event()
        self.cloud: Cloud | None = None
        self.poses: dict[str, Floats] = {}
        voxels = VoxelFilter(settings.voxel_m, max_cells=choose_max_cells(settings.points))
        voxels.warm_up()  # else the first picture would take seconds, in which nothing is reported
        self.pipeline = CloudPipeline(settings, clock_ns, body_pose=body_pose, remover=remover, voxels=voxels)
        self._cameras = {one.name: one for one in settings.cameras}
        self._readers = {one.name: self._make_reader(one, open_source) for one in settings.cameras}
        self._models: dict[str, CameraModel] = {}
        self._stream = _Stream(settings.stream, MediaEncoding.CLOUD)
        self._pictures = {
            one.name: _Stream(settings.name_picture_stream(one.name), MediaEncoding.JPEG)
            for one in settings.cameras
            if settings.picture_hz
        }
        self._drops: Counter[str] = Counter()
        self._has_sent = False
        self._failures: dict[str, str] = {}  # by stream: why its last frame could not be made
        self._polled_ns: int | None = None
        self._reported_ns: int | None = None
        self._clouds = self._bytes = 0
        self._age_ms = 0.0
        self._stages: defaultdict[str, list[float]] = defaultdict(list)  # durations since the last report [ms]

    def _make_reader(self, camera: CameraSettings, open_source: OpenSource) -> SourceReader:
        settings, now_ns = self._settings, self._sink.now_ns
        hz = min(settings.hz, camera.hz or DEFAULT_HZ)  # a recording with times of its own limits it further
        return SourceReader(
            camera.name,
            lambda: open_source(camera, now_ns),
            CameraHealth(hz, has_noise=camera.source not in RENDERED),
            now_ns,
            self._wake.set,
        )

    def start(self) -> None:
        """Open the sources, each in its thread."""
        for reader in self._readers.values():
            reader.start()

    def restart_clock(self) -> None:
        """Forget all frames: session time is that of another session from now on."""
        self._polled_ns = self._reported_ns = None
        self._has_sent = False
        self.pipeline.clear()
        for reader in self._readers.values():
            reader.restart_clock()
        for stream in (self._stream, *self._pictures.values()):
            stream.restart()

    def poll(self, timeout_s: float) -> bool:
        """Do what is due: publish a cloud, pictures, faults.

        Args:
            timeout_s: Seconds to wait at most for a frame.

        Returns:
            True when a cloud was made.
        """
        self._wake.wait(timeout_s)
        self._wake.clear()
        now_ns = self._sink.now_ns()
        if self._polled_ns is not None and now_ns < self._polled_ns - BACK_NS:
            log.warning(
                "session time went back by %.1f s: sources are opened anew", (self._polled_ns - now_ns) / SECOND
            )
            self.restart_clock()
        self._polled_ns = now_ns
        for name, reader in self._readers.items():
            new = reader.take_frame()
            if new is not None:
                self._take_over(name, new, now_ns)
        has_made = self._make_cloud(now_ns)
        self._publish_faults(now_ns)
        return has_made

    def find_fault(self, now_ns: int) -> Fault | None:
        """Return the fault of the cloud: that of the first camera that has one, or why it cannot be made."""
        for name in self._readers:
            fault = self._find_camera_fault(name, now_ns)
            if fault is not None:
                return Fault(fault.fault, f"camera {name}: {fault.detail}")
        failure = self._failures.get(self._stream.name)
        return None if failure is None else Fault(StreamFault.SOURCE, failure)

    def make_report(self, *, connected: bool = True, fault: str = "") -> CameraReport:
        """Return the state of the work, with rates and means since the last report."""
        now_ns = self._sink.now_ns()
        elapsed_s = (now_ns - (now_ns if self._reported_ns is None else self._reported_ns)) / SECOND
        self._reported_ns = now_ns
        n, sent, age_ms = self._clouds, self._bytes, self._age_ms
        self._clouds, self._bytes, self._age_ms = 0, 0, 0.0
        stages_ms = {stage: fmean(durations_ms) for stage, durations_ms in self._stages.items()}
        self._stages.clear()
        cloud = self.cloud
        return CameraReport(
            self._settings.stream,
            connected,
            n / elapsed_s if elapsed_s > 0.0 else 0.0,
            0 if cloud is None else cloud.n_points,
            0.0 if cloud is None else cloud.voxel_m,
            None if cloud is None or math.isinf(cloud.error_m) else cloud.error_m,
            sent / elapsed_s if elapsed_s > 0.0 else 0.0,
            age_ms / n if n else 0.0,
            stages_ms,
            self.count_drops(),
            {name: self._make_source_report(name, now_ns) for name in self._readers},
            fault,
            "; ".join(self._failures.values()),
        )

    def count_drops(self) -> dict[str, int]:
        """Return how much was left out, by reason, since the start."""
        drops = self._drops + self.pipeline.drops
        for reader in self._readers.values():
            drops["superseded"] += reader.superseded
            drops["unusable"] += reader.refused
            drops["incomplete"] += reader.incomplete
        return {reason: n for reason, n in drops.items() if n}

    def close(self) -> bool:
        """End the threads. Return false when one is kept by its source."""
        for reader in self._readers.values():
            reader.stop()
        end_ns = self._clock_ns() + JOIN_NS  # of all together
        ended = [reader.join(max(0, end_ns - self._clock_ns()) / SECOND) for reader in self._readers.values()]
        return all(ended)

    # --- inside -------------------------------------------------------------------------------------------------------

    def _take_over(self, name: str, new: SourceFrame, now_ns: int) -> None:
        self._models[name] = new.camera
        self.pipeline.offer(name, new, now_ns)
        picture = self._pictures.get(name)
        if picture is not None and picture.is_due(self._settings.picture_hz, now_ns):
            began_ns = self._clock_ns()
            try:
                data = encode_picture(new.frame.color)
            except Exception as error:
                self._note_failure(picture, error)
                return
            self._failures.pop(picture.name, None)
            self._stages["jpeg"].append((self._clock_ns() - began_ns) / MILLISECOND)
            self._publish(picture, data, new.frame.capture_ns, self._find_camera_fault(name, now_ns), now_ns)

    def _make_cloud(self, now_ns: int) -> bool:
        if now_ns < self._stream.due_ns:
            return False
        frames = self.pipeline.take_frames(now_ns)
        if not frames or not self._stream.is_due(self._settings.hz, now_ns):
            return False
        try:
            cloud = self.cloud = self.pipeline.make_cloud(frames)
        except Exception as error:
            self._note_failure(self._stream, error)
            return False
        self._failures.pop(self._stream.name, None)
        self.poses = {name: one.T_world_camera for name, one in frames.items()}
        for stage, duration_ms in {
            "read": max(self._readers[name].read_ms for name in frames),
            **cloud.stages_ms,
        }.items():
            self._stages[stage].append(duration_ms)
        began_ns = self._clock_ns()
        self._publish(self._stream, cloud.frames, cloud.capture_ns, self.find_fault(now_ns), now_ns)
        self._stages["send"].append((self._clock_ns() - began_ns) / MILLISECOND)
        self._clouds += 1
        self._age_ms += (self._sink.now_ns() - cloud.capture_ns) / MILLISECOND
        return True

    def _note_failure(self, stream: _Stream, error: Exception) -> None:
        """Note that a frame could not be made: that ends neither this process nor the other streams."""
        self._drops["failed"] += 1
        failure = f"frames of {stream.name!r} cannot be made: {describe_error(error)}"
        if failure != self._failures.get(stream.name):
            log.warning("%s", failure, exc_info=log.isEnabledFor(logging.DEBUG))
        self._failures[stream.name] = failure

    def _publish_faults(self, now_ns: int) -> None:
        """Publish faults without a frame, while no frame comes that would carry them."""
        fault = self.find_fault(now_ns)
        if fault is not None and self._stream.needs_info(fault, now_ns):
            self._publish(self._stream, {}, now_ns, fault, now_ns)
        for name, picture in self._pictures.items():
            fault = self._find_camera_fault(name, now_ns)
            if fault is not None and picture.needs_info(fault, now_ns):
                self._publish(picture, {}, now_ns, fault, now_ns)

    def _publish(
        self, stream: _Stream, frames: bytes | dict[str, bytes], capture_ns: int, fault: Fault | None, now_ns: int
    ) -> None:
        described = stream.needs_info(fault, now_ns)
        info = self._make_info(stream, fault) if described else None
        if not self._sink.publish(stream.name, frames, capture_ns, stream.encoding, info):
            self._drops["send"] += self._has_sent  # the first frames connect
            return
        self._has_sent = True
        if described:
            stream.described, stream.described_ns = fault, now_ns
        self._bytes += len(frames) if isinstance(frames, bytes) else sum(map(len, frames.values()))

    def _make_info(self, stream: _Stream, fault: Fault | None) -> StreamInfo:
        settings = self._settings
        name = next((name for name, picture in self._pictures.items() if picture is stream), "")
        camera = self._describe_camera(name or settings.cameras[0].name) if name or len(self._cameras) == 1 else None
        info = StreamInfo(
            title=(f"{settings.title}: {name}" if name else settings.title)[:MAX_TEXT],
            audience=settings.audience,
            camera=camera,
            hz=settings.picture_hz if name else settings.hz,
            fault="" if fault is None else fault.fault,
            detail="" if fault is None else fault.detail[:MAX_TEXT],
        )
        # Pictures that are too large for the protocol, or a camera too far away, are no reason to publish nothing.
        return msgspec.structs.replace(info, camera=None) if find_info_problem(info) else info

    def _describe_camera(self, name: str) -> StreamCamera | None:
        """Return intrinsics and pose of a camera, `None` while they are not known."""
        camera = self._cameras[name]
        if name not in self._models:
            return None
        model = self._models[name]
        pose = None if camera.pose is None else camera.pose.to_matrix()
        if not camera.body:
            pose = self.poses.get(name, pose)
        if pose is None:
            return None
        position, orientation = pose_from_matrix(pose)
        return StreamCamera(
            model.width, model.height, model.fx, model.fy, model.cx, model.cy, tuple(model.distortion),
            camera.body, position, orientation,
        )  # fmt: skip

    def _find_camera_fault(self, name: str, now_ns: int) -> Fault | None:
        fault = self._readers[name].find_fault(now_ns)
        if fault is None and self.pipeline.lacks_pose(name):
            body = self._cameras[name].body
            fault = Fault(StreamFault.POSE, NO_BODY.format(body) if body else NO_STATE)
        if fault is None and self.pipeline.is_left_out(name, now_ns):
            fault = Fault(StreamFault.CLOCK, LEFT_OUT)
        return fault

    def _make_source_report(self, name: str, now_ns: int) -> SourceReport:
        reader, fault = self._readers[name], self._find_camera_fault(name, now_ns)
        return SourceReport(
            reader.measure_hz(now_ns),
            "" if fault is None else fault.fault,
            "" if fault is None else fault.detail,
            reader.failures,
        )


def encode_picture(color: Colors) -> bytes:
    """Return a picture, RGB, as JPEG."""
    import cv2

    fits, data = cv2.imencode(".jpg", color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not fits:
        raise ValueError(f"a picture of shape {color.shape} cannot be encoded as JPEG")
    return bytes(data.tobytes())
