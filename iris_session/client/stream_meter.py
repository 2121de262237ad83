"""Measure a media stream at a client: rate, size, and age by stage, with what the session says of it."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import msgspec

from iris_session.client.client import Client
from iris_session.protocol.media import StreamBudget
from iris_session.protocol.names import MediaEncoding
from iris_session.protocol.status import compute_quantiles

#: Stages of the age of a frame. Each ends at the next of the times after the capture; the last is only of clouds.
STAGES: Final = ("camera process", "to the front", "in the front", "to the client", "decoding")
#: Frames whose ages and points are kept.
MAX_AGES: Final = 4_000


class StreamMeasurement(msgspec.Struct, frozen=True):
    """Measurement of a stream at a client.

    Attributes:
        stream: Its name.
        title, encoding, stale, fault, detail: As the session says; fault `malformed`: the newest frame is no cloud.
        budget_class: Class in which it is delivered.
        seconds: Time since the measurement began.
        frames: Frames that came.
        silent_s: Time since the newest one came, or since the measurement began [s].
        hz, mbit_per_s: Of these, over that time.
        age_ms, age_ms_p99: From the capture of a frame until it was here, of a cloud until it was decoded: median and
            99th percentile [ms]; `None` before the first.
        ages_ms: Medians of the stages of the age. One whose end is not known is left out, and part of the next.
        dropped: Frames that our link did not take in time.
        points: Of a cloud, median; `None` for other encodings, as are the next three.
        bytes_per_point: Size of all clouds by their points.
        voxel_m: Edge of the cells of the newest cloud [m].
        error_mm: Its stated error [mm], `None` where it is not known.
    """

    stream: str
    title: str = ""
    encoding: str = ""
    budget_class: str = ""
    seconds: float = 0.0
    frames: int = 0
    silent_s: float = 0.0
    hz: float = 0.0
    mbit_per_s: float = 0.0
    age_ms: float | None = None
    age_ms_p99: float | None = None
    ages_ms: dict[str, float] = {}
    dropped: int = 0
    stale: bool = False
    fault: str = ""
    detail: str = ""
    points: int | None = None
    bytes_per_point: float | None = None
    voxel_m: float | None = None
    error_mm: float | None = None


class StreamMeter:
    """Measure what arrives of one stream, which it subscribes to.

    Args:
        client: The client.
        stream: Name of the stream.
        now_ns: A monotonic time, at which the measurement begins [ns].
    """

    def __init__(self, client: Client, stream: str, now_ns: int) -> None:
        self._client = client
        self._feed = client.media.subscribe(stream)
        self._cloud = client.media.cloud(stream)
        self._began_ns = self._came_ns = now_ns
        self._bytes = self._frames = self._cloud_bytes = 0
        self._points: deque[int] = deque(maxlen=MAX_AGES)
        self._all_points = 0
        self._ages_ns: deque[int] = deque(maxlen=MAX_AGES)
        self._stages_ns: dict[str, deque[int]] = {stage: deque(maxlen=MAX_AGES) for stage in STAGES}

    def poll(self, now_ns: int) -> None:
        """Take the newest frame, if there is another, at `now_ns`. Call it more often than frames come."""
        frame = self._feed.pop_newest()
        if frame is None:
            return
        self._frames += 1
        self._came_ns = now_ns
        self._bytes += len(frame.data)
        cloud = self._cloud.poll() if frame.header.encoding == MediaEncoding.CLOUD else None
        self._ages_ns.append(frame.age_ns if cloud is None else cloud.age_ns)
        if cloud is not None:
            self._points.append(len(cloud.positions))
            self._all_points += len(cloud.positions)
            self._cloud_bytes += len(frame.data)
        header = frame.header
        times = (header.sent_ns, header.received_ns, header.published_ns, header.capture_ns + frame.age_ns)
        before_ns = header.capture_ns
        for stage, at_ns in zip(STAGES, (*times, 0 if cloud is None else cloud.times.decoded_ns), strict=True):
            if at_ns:
                self._stages_ns[stage].append(at_ns - before_ns)
                before_ns = at_ns

    def measure(self, now_ns: int) -> StreamMeasurement:
        """Return what was measured until `now_ns`."""
        name = self._feed.stream
        delivery = self._client.media.delivery
        told = [] if delivery is None else [one for one in delivery.streams if one.stream == name]
        said = told[0] if told else StreamBudget(name, encoding="", stale=True)
        seconds = (now_ns - self._began_ns) * 1e-9
        ages = compute_quantiles(self._ages_ns)
        stages = {stage: compute_quantiles(found) for stage, found in self._stages_ns.items()}
        cloud = self._cloud.newest if said.encoding == MediaEncoding.CLOUD else None
        return StreamMeasurement(
            stream=name,
            title=said.title,
            encoding=said.encoding,
            budget_class=self._feed.budget_class,
            seconds=seconds,
            frames=self._frames,
            silent_s=(now_ns - self._came_ns) * 1e-9,
            hz=self._frames / seconds if seconds > 0.0 else 0.0,
            mbit_per_s=self._bytes * 8e-6 / seconds if seconds > 0.0 else 0.0,
            age_ms=None if ages is None else ages.p50,
            age_ms_p99=None if ages is None else ages.p99,
            ages_ms={stage: one.p50 for stage, one in stages.items() if one is not None},
            dropped=self._feed.dropped,
            stale=said.stale,
            fault="malformed" if self._cloud.fault else said.fault,
            detail=self._cloud.fault or said.detail,
            points=sorted(self._points)[len(self._points) // 2] if self._points else None,
            bytes_per_point=self._cloud_bytes / self._all_points if self._all_points else None,
            voxel_m=None if cloud is None else cloud.voxel_m,
            error_mm=None if cloud is None or math.isinf(cloud.error_m) else 1000.0 * cloud.error_m,
        )
