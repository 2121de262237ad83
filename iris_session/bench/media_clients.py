"""Clients of media streams: they decode every frame of a deformable or a cloud as it comes, and log it."""

from __future__ import annotations

import time
import zlib
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
    """One client with its log of states and of the frames of one stream: deformables if there is a topology, clouds if
    there is none.

    Checksums of deformables are of their vertices, those of clouds of payloads, `UNCHECKED` for most.
    """

    def __init__(self, job: Job, spec: ClientJob) -> None:
        super().__init__(job, spec)
        self._decoder: DeformableDecoder | None = None
        if job.topology:
            self._decoder = DeformableDecoder(DeformableTopology.from_bytes(Path(job.topology).read_bytes()))
        self.feed = self.client.media.subscribe(job.stream)
        self.rows: list[tuple[int, ...]] = []
        self.levels: list[tuple[int, int]] = []  # session time at which a class was received, and the class
        self.heads = 0

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
        points = self._decoder.decode(data) if self._decoder else decode_cloud(data).positions
        spent_ns = time.thread_time_ns() - began_ns
        handed_ns = self._job.session_time_ns()
        if not self.recording:
            return
        if len(self.rows) >= MAX_FRAMES:
            self.log.overflow += 1
            return
        topic = len(make_topic(self.client.connection.connection_epoch, self.feed.stream))
        self.heads += topic + len(header.budget_class) + len(encode_media_header(header))
        checksum = UNCHECKED
        if self._decoder:
            checksum = zlib.crc32(points.data)
        elif len(self.rows) % CHECK_EVERY == 0:
            checksum = zlib.crc32(data)
        level = CLASSES.index(header.budget_class)
        self.rows.append((header.capture_ns, handed_ns, spent_ns, checksum, len(data), len(points), level))

    def to_columns(self) -> dict[str, NDArray[Any]]:
        """Return the log. Columns of `frames`: `MediaColumn`. The last of `counts`: bytes of topics and headers."""
        feed = self.feed
        counts = [feed.superseded, feed.dropped, self.client.media.malformed, self.log.overflow, self.heads]
        return super().to_columns() | {
            "frames": np.array(self.rows, np.int64).reshape(-1, len(MediaColumn)),
            "levels": np.array(self.levels, np.int64).reshape(-1, 2),
            "counts": np.array(counts, np.int64),
        }


class MediaClients(StateClients):
    """Clients of `bench deformable` and `bench cloud-stream` in one process."""

    client_type = MediaClient
