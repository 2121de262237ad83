"""Clients of `bench cloud-stream`: log the states they receive, decode every cloud, and log it.

    python -m iris_session.bench.cloud_clients < job.json

Same protocol as `bench.clients`.
"""

from __future__ import annotations

import contextlib
import gc
import selectors
import sys
import time
import zlib
from enum import IntEnum, auto
from typing import Any

import msgspec
import numpy as np

from iris_session.bench.clients import MAX_FRAMES, BenchClient, ClientJob, Job
from iris_session.client import ClientGroup
from iris_session.client.feeds import MediaFrame
from iris_session.protocol.codec import encode_media_header
from iris_session.protocol.media import CLASSES, make_topic
from iris_session.streams.cloud import decode_cloud

#: Of every so many clouds the checksum is logged: its computation keeps a state that has come waiting.
CHECK_EVERY = 10
UNCHECKED = -1


class CloudColumn(IntEnum):
    """Columns of the log of clouds: times [ns], checksum (`UNCHECKED` of most), bytes, points, level."""

    CAPTURE = 0
    HANDED = auto()
    DECODED = auto()
    CHECKSUM = auto()
    SIZE = auto()
    POINTS = auto()
    LEVEL = auto()


class CloudStreamJob(Job, frozen=True, kw_only=True):
    """Job of one process. `stream`: name of the stream of clouds."""

    stream: str


class CloudClient(BenchClient):
    """One client with its log of states and of clouds."""

    def __init__(self, job: CloudStreamJob, spec: ClientJob) -> None:
        super().__init__(job, spec)
        self._origin_ns = job.origin_ns
        self.feed = self.client.media.subscribe(job.stream)
        self.rows: list[tuple[int, ...]] = []
        self.levels: list[tuple[int, int]] = []  # session time at which a class was received, and the class
        self.heads = 0

    def decode_newest(self) -> None:
        """Decode the newest cloud, as an application does before it draws."""
        level = CLASSES.index(self.feed.budget_class)
        if self.recording and (not self.levels or self.levels[-1][1] != level):
            self.levels.append((time.monotonic_ns() - self._origin_ns, level))
        frame = self.feed.pop_newest()
        if frame is None:
            return
        began_ns = time.thread_time_ns()
        cloud = decode_cloud(frame.data)
        spent_ns = time.thread_time_ns() - began_ns
        handed_ns = time.monotonic_ns() - self._origin_ns
        if not self.recording:
            return
        if len(self.rows) >= MAX_FRAMES:
            self.overflow += 1
            return
        self.heads += self._count_head_bytes(frame)
        self.rows.append(
            (
                frame.header.capture_ns,
                handed_ns,
                spent_ns,
                UNCHECKED if len(self.rows) % CHECK_EVERY else zlib.crc32(frame.data),
                len(frame.data),
                len(cloud.positions),
                CLASSES.index(frame.header.budget_class),
            )
        )

    def _count_head_bytes(self, frame: MediaFrame) -> int:
        topic = len(make_topic(self.client.connection.connection_epoch, self.feed.stream))
        return topic + len(frame.header.budget_class) + len(encode_media_header(frame.header))

    def to_columns(self) -> dict[str, np.ndarray[Any, Any]]:
        """Return the log. Columns of `clouds`: those of `CloudColumn`."""
        feed = self.feed
        counts = [feed.superseded, feed.dropped, self.client.media.malformed, self.overflow, self.heads]
        return {
            "handed_ns": np.array(self.handed_ns, np.int64),
            "state_ns": np.array(self.state_ns, np.int64),
            "clouds": np.array(self.rows, np.int64).reshape(-1, len(CloudColumn)),
            "levels": np.array(self.levels, np.int64).reshape(-1, 2),
            "counts": np.array(counts, np.int64),
        }


def run(job: CloudStreamJob) -> None:
    """Join, wait for the window, measure, and write the log."""
    clients = [CloudClient(job, spec) for spec in job.clients]
    for client in clients:
        client.join()
    gc.collect()
    gc.freeze()
    print("ready", flush=True)
    selector = selectors.DefaultSelector()
    selector.register(sys.stdin, selectors.EVENT_READ)
    group = ClientGroup([c.client for c in clients])
    begin = end = 0
    while not end or time.monotonic_ns() - job.origin_ns < end:
        if not end and selector.select(0):
            begin, end = map(int, sys.stdin.readline().split())
        for client in clients:
            client.recording = bool(end) and begin <= time.monotonic_ns() - job.origin_ns < end
        group.poll(0.02)
        for client in clients:
            client.decode_newest()
    log = {f"{c.spec.name}.{key}": column for c in clients for key, column in c.to_columns().items()}
    np.savez(job.log, allow_pickle=False, **log)
    for client in clients:
        with contextlib.suppress(Exception):  # the session may have ended first
            client.client.close()


if __name__ == "__main__":
    run(msgspec.json.decode(sys.stdin.readline(), type=CloudStreamJob))
