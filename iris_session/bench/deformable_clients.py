"""Clients of `bench deformable`: subscribe to the stream, decode every frame, and log it.

    python -m iris_session.bench.deformable_clients < job.json

Same protocol as `bench.clients`: prints `ready`, reads `begin end`, writes its log as one .npz file. The log has the
received payloads and a checksum of the decoded vertices, so that the parent can compare with the truth.
"""

from __future__ import annotations

import contextlib
import gc
import selectors
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from iris_session.bench.clients import JOIN_S, MAX_FRAMES, ClientJob, Job
from iris_session.client import Client, ClientGroup, CurveKeys
from iris_session.client.feeds import MediaFrame
from iris_session.protocol.codec import encode_media_header
from iris_session.protocol.media import make_topic
from iris_session.streams.deformable import DeformableDecoder
from iris_session.streams.deformable_topology import DeformableTopology


class DeformableJob(Job, frozen=True, kw_only=True):
    """Job of one process. `topology`: file of the topology, instead of the scene's asset."""

    stream: str
    topology: str


class DeformableClient:
    """One client with its log."""

    def __init__(self, job: DeformableJob, spec: ClientJob) -> None:
        curve = None
        if job.server_public:
            curve = CurveKeys(job.server_public.encode(), job.public.encode(), job.secret.encode())
        self.spec = spec
        self._origin_ns = job.origin_ns
        self.client = Client(
            f"{spec.link}:{job.address.rpartition(':')[2]}" if spec.link else job.address,
            role=spec.role,
            name=spec.name,
            alignment="not_needed",
            curve=curve,
        )
        self.feed = self.client.media.subscribe(job.stream)
        self._decoder = DeformableDecoder(DeformableTopology.from_bytes(Path(job.topology).read_bytes()))
        self.frames: list[MediaFrame] = []
        self.handed_ns: list[int] = []
        self.decode_ns: list[int] = []
        self.checksums: list[int] = []
        self.overflow = 0

    def decode_newest(self, recording: bool) -> None:
        """Decode the newest frame, as an application does before it draws."""
        frame = self.feed.pop_newest()
        if frame is None:
            return
        began_ns = time.thread_time_ns()
        vertices = self._decoder.decode(frame.data)
        spent_ns = time.thread_time_ns() - began_ns
        handed_ns = time.monotonic_ns() - self._origin_ns
        if not recording:
            return
        if len(self.frames) >= MAX_FRAMES:
            self.overflow += 1
            return
        self.frames.append(frame)
        self.handed_ns.append(handed_ns)
        self.decode_ns.append(spent_ns)
        self.checksums.append(zlib.crc32(vertices.data))

    def to_columns(self) -> dict[str, np.ndarray[Any, Any]]:
        """Return the log. `sizes`: bytes of each payload. The last of `counts`: bytes of topics and headers."""
        topic = len(make_topic(self.client.connection.connection_epoch, self.feed.stream))
        heads = sum(topic + len(f.header.budget_class) + len(encode_media_header(f.header)) for f in self.frames)
        return {
            "capture_ns": np.array([f.header.capture_ns for f in self.frames], np.int64),
            "handed_ns": np.array(self.handed_ns, np.int64),
            "decode_ns": np.array(self.decode_ns, np.int64),
            "checksums": np.array(self.checksums, np.int64),
            "sizes": np.array([len(f.data) for f in self.frames], np.int64),
            "payloads": np.frombuffer(b"".join(f.data for f in self.frames), np.uint8),
            "counts": np.array(
                [self.feed.superseded, self.feed.dropped, self.client.media.malformed, self.overflow, heads], np.int64
            ),
        }


def run(job: DeformableJob) -> None:
    """Join, wait for the window, measure, and write the log."""
    clients = [DeformableClient(job, spec) for spec in job.clients]
    for client in clients:
        client.client.connect(JOIN_S)
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
        group.poll(0.02)
        recording = bool(end) and begin <= time.monotonic_ns() - job.origin_ns < end
        for client in clients:
            client.decode_newest(recording)
    log = {f"{c.spec.name}.{key}": column for c in clients for key, column in c.to_columns().items()}
    np.savez(job.log, allow_pickle=False, **log)
    for client in clients:
        with contextlib.suppress(Exception):  # the session may have ended first
            client.client.close()


if __name__ == "__main__":
    run(msgspec.json.decode(sys.stdin.readline(), type=DeformableJob))
