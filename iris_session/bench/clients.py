"""Benchmark clients: up to four real clients in one process, which log the states they receive, with their times.

    python -m iris_session.bench.clients < job.json

Prints `ready`, reads `begin end` (session time in ns), runs through that window, writes its log as one .npz file.
Ages use the session's own clock (one machine, CLOCK_MONOTONIC), not the clients' estimate of it.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import math
import selectors
import sys
import time
import zlib
from typing import Final

import msgspec
import numpy as np

from anchors.pose import PoseTuple
from iris_session.client import Client, ClientGroup, CurveKeys, SceneState
from iris_session.protocol.common import Applied
from iris_session.protocol.names import Device

SAMPLE_NS: Final = round(1e9 / 72.0)
DEVICES: Final = (Device.HEAD, Device.CONTROLLER_LEFT, Device.CONTROLLER_RIGHT)
#: Log entries per client; two minutes at 60 Hz.
MAX_FRAMES: Final = 8192
#: State comes at 60 Hz; twice as many frames are room enough.
MAX_HZ: Final = 120.0
JOIN_S: Final = 30.0


class ClientJob(msgspec.Struct, frozen=True):
    """One client. `robot`: robot to drive with the right controller. `samples`: send 3 devices x 72 Hz. `link`: address
    of its impaired link; empty: none."""

    name: str
    role: str
    robot: str = ""
    samples: bool = False
    link: str = ""


class Job(msgspec.Struct, frozen=True):
    """Job of one process. `keep_poses`: log every decoded pose of every frame. Keys: Z85 text; empty: plain. `page`:
    address of the session's page, for browsers."""

    address: str
    origin_ns: int
    log: str
    clients: tuple[ClientJob, ...]
    keep_poses: bool = False
    server_public: str = ""
    public: str = ""
    secret: str = ""
    page: str = ""


def make_web_secret(secret: str, name: str) -> bytes:
    """Return the secret of a browser at an encrypted session, made from the secret of its job."""
    return hashlib.sha256(f"{secret} {name}".encode()).digest()


class BenchClient:
    """One client with its log."""

    def __init__(self, job: Job, spec: ClientJob) -> None:
        self.spec = spec
        self._job = job
        curve = None
        if job.server_public:
            curve = CurveKeys(job.server_public.encode(), job.public.encode(), job.secret.encode())
        devices = DEVICES if spec.samples else ()
        self.client = Client(
            f"{spec.link}:{job.address.rpartition(':')[2]}" if spec.link else job.address,
            role=spec.role,
            name=spec.name,
            devices=devices,
            alignment="not_needed",
            curve=curve,
            on_state=self._on_state,
        )
        self.recording = False
        self.ticks: list[int] = []
        self.handed_ns: list[int] = []
        self.state_ns: list[int] = []
        self.published_ns: list[int] = []
        self.applied_seq: list[int] = []
        self.poses = np.empty((0, 0, 7))
        self.sent = 0
        self.overflow = 0
        self._phase = zlib.crc32(spec.name.encode()) / 2**32
        self._next_ns = 0
        self._open_samples = 5

    def _on_state(self, state: SceneState) -> None:
        if not self.recording:
            return
        if len(self.ticks) >= (len(self.poses) if self._job.keep_poses else MAX_FRAMES):
            self.overflow += 1
            return
        self.handed_ns.append(time.monotonic_ns() - self._job.origin_ns)
        self.ticks.append(state.header.tick)
        self.state_ns.append(state.header.session_time)
        self.published_ns.append(state.header.published_ns)
        self.applied_seq.append(_find_applied_seq(state.header.applied, self.spec.robot))
        if self._job.keep_poses:
            self.poses[len(self.ticks) - 1] = state.poses

    def prepare(self, seconds: float) -> None:
        """Allocate and touch memory for the poses of a window: new pages in every frame would cost time."""
        frames = min(MAX_FRAMES, math.ceil(MAX_HZ * seconds))
        self.poses = np.empty((frames if self._job.keep_poses else 0, len(self.client.mirror.bodies), 7))
        self.poses.fill(np.nan)

    def join(self) -> None:
        """Connect, and acquire the robot if one is given."""
        self.client.connect(JOIN_S)
        if self.spec.robot:
            self.client.acquire([self.spec.robot])

    def step(self, now_ns: int) -> None:
        """Send one sample of each device if it is due."""
        if not self.spec.samples or now_ns < self._next_ns:
            return
        if not self._next_ns:  # independent headsets do not sample at the same instant
            self._next_ns = now_ns + round(self._phase * SAMPLE_NS)
            return
        self._next_ns = max(self._next_ns + SAMPLE_NS, now_ns - SAMPLE_NS)
        t = now_ns * 1e-9
        samples = []
        for i, device in enumerate(DEVICES):
            robots = [self.spec.robot] if self.spec.robot and device == Device.CONTROLLER_RIGHT else []
            clutch = bool(robots) and self._open_samples == 0
            samples.append(self.client.make_sample(device, self._pose(t, i), robots=robots, clutch=clutch))
        self.sent += len(samples) * self.client.send_samples(samples)
        self._open_samples = max(0, self._open_samples - 1)

    def _pose(self, t: float, device: int) -> PoseTuple:
        """Return a pose on a slow circle of 3 cm radius, so that inverse kinematics always has work."""
        angle = 2.0 * math.pi * (0.25 * t + self._phase)
        return ((0.03 * math.cos(angle), 0.03 * math.sin(angle), 1.0 + 0.1 * device), (1.0, 0.0, 0.0, 0.0))

    @property
    def next_ns(self) -> int:
        return self._next_ns if self.spec.samples else 2**63 - 1


def _find_applied_seq(applied: tuple[Applied, ...], robot: str) -> int:
    return next((a.seq for a in applied if a.robot == robot), -1) if robot else -1


def run(job: Job) -> None:
    """Join, wait for the window, measure, and write the log."""
    clients = [BenchClient(job, spec) for spec in job.clients]
    for client in clients:
        client.join()
    gc.collect()
    gc.freeze()
    gc.disable()  # as a latency-sensitive application does: nothing here creates cycles
    print("ready", flush=True)
    selector = selectors.DefaultSelector()
    selector.register(sys.stdin, selectors.EVENT_READ)
    group = ClientGroup([c.client for c in clients])
    begin = end = 0
    cpu_s = time.process_time()
    while not end or _session_time_ns(job) < end:
        now = _session_time_ns(job)
        if not end and selector.select(0):
            begin, end = map(int, sys.stdin.readline().split())
            for client in clients:
                client.prepare((end - begin) * 1e-9)
            cpu_s = time.process_time()
        for client in clients:
            client.recording = bool(end) and begin <= now < end
            client.step(now)
        wake = min(now + 20_000_000, *(c.next_ns for c in clients))
        group.poll(max(0.0, (wake - _session_time_ns(job)) * 1e-9))
    cpu_share = (time.process_time() - cpu_s) / ((end - begin) * 1e-9)
    _write_log(job, clients, cpu_share)
    for client in clients:
        with contextlib.suppress(Exception):  # the session may have ended first
            client.client.close()


def _session_time_ns(job: Job) -> int:
    return time.monotonic_ns() - job.origin_ns


def _write_log(job: Job, clients: list[BenchClient], cpu_share: float) -> None:
    columns: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.int64 | np.float64]]] = {}
    for client in clients:
        name = client.spec.name
        counters = client.client.connection.stream.counters
        columns[f"{name}.ticks"] = np.array(client.ticks, np.int64)
        columns[f"{name}.handed_ns"] = np.array(client.handed_ns, np.int64)
        columns[f"{name}.state_ns"] = np.array(client.state_ns, np.int64)
        columns[f"{name}.published_ns"] = np.array(client.published_ns, np.int64)
        columns[f"{name}.applied_seq"] = np.array(client.applied_seq, np.int64)
        columns[f"{name}.counts"] = np.array(
            [client.sent, client.overflow, counters.superseded, counters.rigid_messages, counters.rigid_bytes], np.int64
        )
        columns[f"{name}.cpu_share"] = np.array([cpu_share / len(clients)])
        if job.keep_poses:
            columns[f"{name}.poses"] = client.poses[: len(client.ticks)]
    np.savez(job.log, allow_pickle=False, **columns)


if __name__ == "__main__":
    run(msgspec.json.decode(sys.stdin.readline(), type=Job))
