"""Clients of the benchmarks: up to four real clients in one process, which log the states they receive.

Plug-ins of `bench.plugins`. They join when they are made; `measure` runs through a window of session time and writes a
log as one .npz file. Ages use the session's own clock (one machine, CLOCK_MONOTONIC), not the clients' estimate of it.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import math
import time
import zlib
from collections.abc import Sequence
from typing import Any, ClassVar, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from anchors.pose import PoseTuple
from iris_session.bench.plugins import POLL_S, Plugin
from iris_session.client import Client, ClientGroup, CurveKeys, SceneState
from iris_session.client.core.state_stream import StateStream
from iris_session.protocol.names import Device
from iris_session.protocol.server_messages import StateHeader

SAMPLE_NS: Final = round(1e9 / 72.0)
DEVICES: Final = (Device.HEAD, Device.CONTROLLER_LEFT, Device.CONTROLLER_RIGHT)
#: Log entries per client; two minutes at 60 Hz.
MAX_FRAMES: Final = 8192
#: State comes at 60 Hz; twice as many frames are room enough.
MAX_HZ: Final = 120.0
JOIN_S: Final = 30.0
#: Plug-ins of clients. `BROWSERS` are at the session's page without a picture, `TABS` in a real Chromium.
CLIENTS: Final = "iris_session.bench.clients:StateClients"
MEDIA_CLIENTS: Final = "iris_session.bench.media_clients:MediaClients"
BROWSERS: Final = "iris_session.bench.web_clients:Browsers"
TABS: Final = "iris_session.bench.web_tab:Tab"


class ClientJob(msgspec.Struct, frozen=True):
    """One client.

    Attributes:
        robot: Robot to drive with the right controller.
        samples: Send 3 devices x 72 Hz.
        profile: Profile of its impaired link; empty: none.
        alone: It has a process of its own.
        loads_s: Of a browser: times in the window at which it fetches assets [s].
    """

    name: str
    role: str
    robot: str = ""
    samples: bool = False
    profile: str = ""
    plugin: str = CLIENTS
    alone: bool = False
    loads_s: tuple[float, ...] = ()


def make_operators(robots: Sequence[str], profile: str = "") -> list[ClientJob]:
    """Return one operator for each robot."""
    return [ClientJob(f"operator{i}", "operator", robot, True, profile) for i, robot in enumerate(robots)]


class Job(msgspec.Struct, frozen=True):
    """Job of one process.

    Attributes:
        origin_ns: Session time zero on CLOCK_MONOTONIC.
        log: File to write.
        keep_poses: Log every decoded pose of every frame.
        stream: Media stream to subscribe to; empty: none.
        topology: File of the topology of a deformable stream, instead of the scene's asset.
        keys: CURVE keys of `CurveKeys`, Z85 text; empty: plain.
        page: Address of the session's page, for browsers.
        links: Addresses of impaired links by client.
    """

    address: str
    origin_ns: int
    log: str
    clients: tuple[ClientJob, ...]
    keep_poses: bool = False
    stream: str = ""
    topology: str = ""
    keys: tuple[str, ...] = ()
    page: str = ""
    links: dict[str, str] = {}

    def session_time_ns(self) -> int:
        """Return the present session time [ns]."""
        return time.monotonic_ns() - self.origin_ns

    def write_log(self, columns: dict[str, dict[str, NDArray[Any]]]) -> None:
        """Write the columns of every client, by its name."""
        flat = {f"{name}.{key}": column for name, own in columns.items() for key, column in own.items()}
        np.savez(self.log, allow_pickle=False, **flat)


def make_curve_keys(keys: Sequence[str]) -> CurveKeys | None:
    """Return the keys of a client, `None` for a plain session."""
    return CurveKeys(*(key.encode() for key in keys)) if keys else None


def make_web_secret(keys: Sequence[str], name: str) -> bytes:
    """Return the secret of a browser at an encrypted session, made from the keys of its job."""
    return hashlib.sha256(f"{keys[-1]} {name}".encode()).digest()


class StateLog:
    """Log of the states of one client, at most `MAX_FRAMES`; the rest is counted in `overflow`."""

    def __init__(self) -> None:
        self.overflow = 0
        self._rows: list[tuple[int, int, int, int, int]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, header: StateHeader, handed_ns: int, robot: str = "", most: int = MAX_FRAMES) -> bool:
        """Log a state. Return false when the log is full.

        Args:
            header: Its header.
            handed_ns: Session time when the application had it [ns].
            robot: Robot that the client drives.
            most: Rows that there is room for.
        """
        if len(self._rows) >= most:
            self.overflow += 1
            return False
        applied = next((a.seq for a in header.applied if a.robot == robot), -1) if robot else -1
        self._rows.append((header.tick, handed_ns, header.session_time, header.published_ns, applied))
        return True

    def to_columns(self, stream: StateStream, sent: int = 0) -> dict[str, NDArray[Any]]:
        """Return the columns, with counts: samples sent, states not logged, superseded, messages, and their bytes."""
        counters = stream.counters
        counts = [sent, self.overflow, counters.superseded, counters.rigid_messages, counters.rigid_bytes]
        rows = np.array(self._rows, np.int64).reshape(-1, 5)
        names = ("ticks", "handed_ns", "state_ns", "published_ns", "applied_seq")
        return {**dict(zip(names, rows.T, strict=True)), "counts": np.array(counts, np.int64)}


class BenchClient:
    """One client with its log."""

    def __init__(self, job: Job, spec: ClientJob) -> None:
        self.spec = spec
        self._job = job
        link = job.links.get(spec.name)
        self.client = Client(
            f"{link}:{job.address.rpartition(':')[2]}" if link else job.address,
            role=spec.role,
            name=spec.name,
            devices=DEVICES if spec.samples else (),
            alignment="not_needed",
            curve=make_curve_keys(job.keys),
            on_state=self._on_state,
        )
        self.recording = False
        self.log = StateLog()
        self.poses = np.empty((0, 0, 7))
        self.sent = 0
        self._phase = zlib.crc32(spec.name.encode()) / 2**32
        self._next_ns = 0
        self._open_samples = 5

    def _on_state(self, state: SceneState) -> None:
        most = len(self.poses) if self._job.keep_poses else MAX_FRAMES
        if not self.recording or not self.log.add(state.header, self._job.session_time_ns(), self.spec.robot, most):
            return
        if self._job.keep_poses:
            self.poses[len(self.log) - 1] = state.poses

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

    def receive(self) -> None:
        """Take what came since the last call; a client of states has had it by `on_state`."""

    def _pose(self, t: float, device: int) -> PoseTuple:
        """Return a pose on a slow circle of 3 cm radius, so that inverse kinematics always has work."""
        angle = 2.0 * math.pi * (0.25 * t + self._phase)
        return ((0.03 * math.cos(angle), 0.03 * math.sin(angle), 1.0 + 0.1 * device), (1.0, 0.0, 0.0, 0.0))

    @property
    def next_ns(self) -> int:
        return self._next_ns if self.spec.samples else 2**63 - 1

    def to_columns(self) -> dict[str, NDArray[Any]]:
        """Return the log."""
        columns = self.log.to_columns(self.client.connection.stream, self.sent)
        return columns | ({"poses": self.poses[: len(self.log)]} if self._job.keep_poses else {})


class StateClients(Plugin):
    """Clients of one process."""

    client_type: ClassVar[type[BenchClient]] = BenchClient

    def __init__(self, job: Job) -> None:
        self._job = job
        self._clients = [self.client_type(job, spec) for spec in job.clients]
        for client in self._clients:
            client.join()
        self._group = ClientGroup([client.client for client in self._clients])
        gc.collect()
        gc.freeze()
        gc.disable()  # as a latency-sensitive application does: nothing here creates cycles

    def poll(self) -> None:
        """Send the samples that are due, and receive."""
        now = self._job.session_time_ns()
        for client in self._clients:
            client.step(now)
        wake = min(now + round(POLL_S * 1e9), *(client.next_ns for client in self._clients))
        self._group.poll(max(0.0, (wake - self._job.session_time_ns()) * 1e-9))
        for client in self._clients:
            client.receive()

    def measure(self, begin_ns: int, end_ns: int) -> None:
        """Run through a window of session time [ns], and write the log."""
        for client in self._clients:
            client.prepare((end_ns - begin_ns) * 1e-9)
        cpu_s = time.process_time()
        while (now := self._job.session_time_ns()) < end_ns:
            for client in self._clients:
                client.recording = begin_ns <= now
            self.poll()
        cpu_share = (time.process_time() - cpu_s) / ((end_ns - begin_ns) * 1e-9)
        share = {"cpu_share": np.array([cpu_share / len(self._clients)])}
        self._job.write_log({client.spec.name: client.to_columns() | share for client in self._clients})

    def close(self) -> None:
        """Leave the session."""
        for client in self._clients:
            with contextlib.suppress(Exception):
                client.client.close()
