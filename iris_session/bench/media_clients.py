"""Clients of media streams: they decode every frame of a deformable or a cloud as it comes, and log it."""

from __future__ import annotations

import time
import zlib
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from enum import IntEnum, auto
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.bench.clients import MAX_FRAMES, BenchClient, ClientJob, Job, StateClients
from iris_session.protocol.codec import encode_media_header
from iris_session.protocol.media import CLASSES, make_topic
from iris_session.streams.cloud import decode_cloud
from iris_session.streams.deformable import DeformableDecoder
from iris_session.streams.deformable_topology import DeformableTopology

#: Of every so many clouds the checksum is logged: its computation keeps a state that has come waiting.
CHECK_EVERY: Final = 10
UNCHECKED: Final = -1


class MediaColumn(IntEnum):
    """Columns of the log of frames: times [ns], checksum, bytes, points, level."""

    CAPTURE = 0
    HANDED = auto()
    DECODED = auto()
    CHECKSUM = auto()
    SIZE = auto()
    POINTS = auto()
    LEVEL = auto()


def sum_counts(logs: Iterable[Mapping[str, NDArray[Any]]]) -> tuple[dict[str, int], int]:
    """Return the frames that were not delivered or not logged, by key of a report, and the bytes of heads."""
    *counts, heads = np.sum([log["counts"] for log in logs], axis=0).tolist()
    keys = ("superseded", "dropped", "malformed", "not_logged")
    return {f"frames_{key}": count for key, count in zip(keys, counts, strict=True)}, heads


class MediaClient(BenchClient):
    """One client with its log of states and of the frames of one stream."""

    def __init__(self, job: Job, spec: ClientJob) -> None:
        super().__init__(job, spec)
        self.feed = self.client.media.subscribe(job.stream)
        self.rows: list[tuple[int, ...]] = []
        self.levels: list[tuple[int, int]] = []  # session time at which a class was received, and the class
        self.payloads: list[bytes] = []
        self.heads = 0

    @abstractmethod
    def decode(self, data: bytes) -> Any:
        """Decode a frame."""

    @abstractmethod
    def describe(self, data: bytes, decoded: Any) -> tuple[int, int]:
        """Return the checksum of a frame, and how many points it has. Called after its times are taken."""

    def receive(self) -> None:
        """Decode the newest frame, as an application does before it draws."""
        level = CLASSES.index(self.feed.budget_class)
        if self.recording and (not self.levels or self.levels[-1][1] != level):
            self.levels.append((self._job.session_time_ns(), level))
        frame = self.feed.pop_newest()
        if frame is None:
            return
        header, data = frame.header, frame.data
        began_ns = time.thread_time_ns()
        decoded = self.decode(data)
        spent_ns = time.thread_time_ns() - began_ns
        handed_ns = self._job.session_time_ns()
        if not self.recording:
            return
        if len(self.rows) >= MAX_FRAMES:
            self.log.overflow += 1
            return
        topic = len(make_topic(self.client.connection.connection_epoch, self.feed.stream))
        self.heads += topic + len(header.budget_class) + len(encode_media_header(header))
        checksum, points = self.describe(data, decoded)
        level = CLASSES.index(header.budget_class)
        self.rows.append((header.capture_ns, handed_ns, spent_ns, checksum, len(data), points, level))

    def to_columns(self) -> dict[str, NDArray[Any]]:
        """Return the log. Columns of `frames`: `MediaColumn`. The last of `counts`: bytes of topics and headers."""
        feed = self.feed
        counts = [feed.superseded, feed.dropped, self.client.media.malformed, self.log.overflow, self.heads]
        return super().to_columns() | {
            "frames": np.array(self.rows, np.int64).reshape(-1, len(MediaColumn)),
            "levels": np.array(self.levels, np.int64).reshape(-1, 2),
            "payloads": np.frombuffer(b"".join(self.payloads), np.uint8),
            "counts": np.array(counts, np.int64),
        }


class DeformableClient(MediaClient):
    """Client of `bench deformable`; keeps the payloads, so that the benchmark can compare them with the truth."""

    def __init__(self, job: Job, spec: ClientJob) -> None:
        super().__init__(job, spec)
        self._decoder = DeformableDecoder(DeformableTopology.from_bytes(Path(job.topology).read_bytes()))

    def decode(self, data: bytes) -> Any:
        return self._decoder.decode(data)

    def describe(self, data: bytes, decoded: Any) -> tuple[int, int]:
        self.payloads.append(data)
        return zlib.crc32(decoded.data), len(decoded)


class CloudClient(MediaClient):
    """Client of `bench cloud-stream`. Checksums are those of payloads, `UNCHECKED` for most."""

    def decode(self, data: bytes) -> Any:
        return decode_cloud(data)

    def describe(self, data: bytes, decoded: Any) -> tuple[int, int]:
        checksum = UNCHECKED if len(self.rows) % CHECK_EVERY else zlib.crc32(data)
        return checksum, len(decoded.positions)


class DeformableClients(StateClients):
    """Clients of `bench deformable` in one process."""

    client_type = DeformableClient


class CloudClients(StateClients):
    """Clients of `bench cloud-stream` in one process."""

    client_type = CloudClient
