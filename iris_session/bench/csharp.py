"""`bench csharp`: the headset apps without engine, on .NET and on Mono: they decode frames of the real encoders, and
receive the state of a session behind its web gateway.

State of moving bodies with `applied`, presence, a cloth and a cloud come in every frame, as an app takes them. C# is
compiled by `tools/csharp` of a source checkout, so the benchmark runs in one only.
"""

from __future__ import annotations

import json
import math
import os
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.bench.clients import BROWSERS, ClientJob, Job
from iris_session.bench.harness import Log, compute_ages_ms, measure
from iris_session.bench.join import split_quads
from iris_session.bench.plugins import Plugin
from iris_session.bench.report import BenchError, BenchReport, compute_percentile, make_bar, summarize_percentiles
from iris_session.bench.state import compute_pose_errors
from iris_session.demo.scenes import free_bodies_scene
from iris_session.protocol.codec import encode_presence, encode_server, encode_state_header
from iris_session.protocol.common import Applied, Pose
from iris_session.protocol.names import Device, Role, SessionKind
from iris_session.protocol.server_messages import (
    BodyInfo,
    Endpoints,
    Presence,
    PresenceItem,
    ServerEnvelope,
    ServerMessage,
    Snapshot,
    StateHeader,
    Welcome,
)
from iris_session.streams.cloud import decode_cloud, encode_cloud
from iris_session.streams.deformable import DeformableDecoder, DeformableEncoder
from iris_session.streams.deformable_topology import DeformableTopology
from iris_session.streams.rigid import RigidDecoder, RigidEncoder
from iris_session.system.extras import require_package
from iris_session.system.process import ROOT, module_command

RUNTIMES: Final = ("dotnet", "mono")
CSHARP_CLIENTS: Final = "iris_session.bench.csharp:CsharpClient"
#: Beside them: the Python client, which has no gateway between, and one over the same WebSocket.
PYTHON, PYTHON_WEB = "python", "python_web"
FRAMES: Final = 10_000
#: Frames in which buffers grow and code is compiled.
WARM_UP: Final = 500
#: Every so many frames are compared with the truth.
SAMPLE: Final = 10
PERIOD_S: Final = 1.0 / 60.0
#: Participants, each with three devices, and robots with an `Applied`.
PEOPLE: Final = 8
CLOTH_SIDE: Final = 30
CLOTH_BOUND_M: Final = 0.0005
CLOUDS: Final = 8
#: Time in which a runtime decodes all frames [s].
DECODE_S: Final = 300.0
_INT: Final = struct.Struct("<i")
Floats = NDArray[np.float64]


def run_csharp(
    bodies: int = 300,
    points: int = 10_000,
    seed: int = 0,
    frames: int = FRAMES,
    seconds: float = 20.0,
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Decode many frames after the first ones; then receive the state of a session, behind its web gateway.

    Returns:
        The report: the worse of both runtimes, and each by itself. Reference: the decoders of the Python client, and
        the age of state at it in the same session, and at one over the same WebSocket, with which the bar compares.

    Raises:
        BenchError: This is no source checkout, or C# cannot be compiled here.
    """
    if not (ROOT / "tools/csharp/__main__.py").exists():
        raise BenchError("bench csharp compiles the C# of a source checkout: clone the repository and run it there")
    with tempfile.TemporaryDirectory(prefix="iris-bench-") as folder:
        progress("encoding frames")
        made = _Frames(bodies, points, frames, seed)
        file = Path(folder, "frames")
        file.write_bytes(made.content)
        results: dict[str, Any] = {}
        for runtime in RUNTIMES:
            progress(f"decoding them on {runtime}")
            results[runtime] = _decode(made, runtime, file, Path(folder, f"{runtime}.out"))
    ages = _measure_ages(bodies, seconds, seed, progress)
    for runtime in RUNTIMES:
        results[runtime] |= ages[runtime]
    reference = made.reference | {
        f"{name}_{key}": value for name in (PYTHON, PYTHON_WEB) for key, value in ages[name].items()
    }
    worst = {key: max(one[key] for one in results.values()) for key in results[RUNTIMES[0]]}
    results = worst | results
    bars = [
        make_bar(results, "allocated_bytes_per_frame", "<=", 0.0),
        make_bar(results, "max_error_mm", "<=", 0.1),
        make_bar(results, "cloth_max_error_mm", "<=", CLOTH_BOUND_M * 1e3),
        make_bar(results, "age_ms_p99", "<=", reference[f"{PYTHON_WEB}_age_ms_p99"]),
    ]
    return BenchReport(results, bars, reference, {"vertices": CLOTH_SIDE**2, "frames": frames})


def _measure_ages(
    bodies: int, seconds: float, seed: int, progress: Callable[[str], None]
) -> dict[str, dict[str, float]]:
    """Return the age of state at clients of one session, by their names."""
    for package in ("aiohttp", "cryptography"):
        require_package(package, "bench csharp")
    clients = [ClientJob(PYTHON, "observer"), ClientJob(PYTHON_WEB, "observer", plugin=BROWSERS)]
    clients += [ClientJob(runtime, "observer", plugin=CSHARP_CLIENTS, alone=True) for runtime in RUNTIMES]
    got = measure(free_bodies_scene(bodies, seed).compile(), clients, seconds, seed=seed, progress=progress)
    return {name: _summarize_ages(name, log) for name, log in got.logs.items()}


def _summarize_ages(name: str, log: Log) -> dict[str, float]:
    """Return percentiles of the age of state when an application could have it [ms]."""
    if not len(log["ticks"]):
        raise BenchError(f"the client {name} received no state: increase --seconds")
    return summarize_percentiles("age_ms", compute_ages_ms([log]))


class _Frames:
    """Frames of a session, and what is in them.

    Attributes:
        content: Bytes for the program (tools/csharp/programs/bench has the layout).
        poses: Poses of every `SAMPLE`-th frame, (n, bodies, 7).
        vertices: Vertices of these, (n, vertices, 3).
        last_cloud: Points of the last cloud, as Python decodes them.
        reference: Times of the Python decoders for the same frames.
    """

    def __init__(self, bodies: int, points: int, frames: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        model = free_bodies_scene(bodies, seed).compile()
        model.opt.timestep = PERIOD_S
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        topology = _make_cloth_topology()
        parts = [struct.pack("<4i", bodies, frames + WARM_UP, WARM_UP, SAMPLE)]
        mujoco.mj_forward(model, data)
        parts += map(_pack, (_welcome(), *_make_snapshot(_read_poses(data)), topology.to_bytes()))
        clouds = [_make_cloud(rng, points, k) for k in range(CLOUDS)]
        cloud_frames = [encode_cloud(*cloud)["full"] for cloud in clouds]
        self.last_cloud = decode_cloud(cloud_frames[(frames + WARM_UP - 1) % CLOUDS]).positions
        parts += [_INT.pack(CLOUDS), *map(_pack, cloud_frames)]
        poses, vertices, spent = [], [], []
        rigid, rigid_decoder = RigidEncoder(bodies), RigidDecoder(bodies)
        cloth, cloth_decoder = DeformableEncoder(topology, CLOTH_BOUND_M), DeformableDecoder(topology)
        for i in range(frames + WARM_UP):
            mujoco.mj_step(model, data)
            now = _read_poses(data)
            sheet = _move_cloth(i * PERIOD_S)
            encoded = rigid.encode(now, 1)
            drawn = (cloth.encode(sheet) or {}).get("full", b"")
            header = encode_state_header(_make_header(i, encoded.state_seq, encoded.base_seq))
            parts += map(_pack, (header, encoded.payload, encode_presence(_make_presence(i)), drawn))
            if i % SAMPLE == 0:
                poses.append(now)
                vertices.append(sheet)
            began = time.perf_counter_ns()
            rigid_decoder.apply(*encoded)
            middle = time.perf_counter_ns()
            if drawn:
                cloth_decoder.decode(drawn)
            ended = time.perf_counter_ns()
            decode_cloud(cloud_frames[i % CLOUDS])
            spent.append((middle - began, ended - middle, time.perf_counter_ns() - ended))
        self.poses, self.vertices = np.array(poses), np.array(vertices)
        times = np.array(spent[WARM_UP:]) * 1e-3
        names = ("python_rigid_us_p50", "python_cloth_us_p50", "python_cloud_us_p50")
        self.reference = {name: compute_percentile(times[:, k], 50) for k, name in enumerate(names)}
        self.content = b"".join([*parts, b"rigid", b"presence"])


def _read_poses(data: mujoco.MjData) -> Floats:
    """Return rows `x y z qw qx qy qz` of all bodies but the world."""
    return np.hstack([data.xpos[1:], data.xquat[1:]])


def _pack(data: bytes) -> bytes:
    return _INT.pack(len(data)) + data


def _envelope(message: ServerMessage) -> bytes:
    return encode_server(ServerEnvelope(1, 1, message))


def _welcome() -> bytes:
    return _envelope(
        Welcome(
            "bench", "bench", SessionKind.LIVE, "p", 1, Role.OBSERVER, b"", False, 0, 1_000_000_000, 2_000_000,
            16_666_667, Endpoints(0, 0, 0, 0),
        )
    )  # fmt: skip


def _make_snapshot(poses: Floats) -> tuple[bytes, bytes]:
    bodies = tuple(BodyInfo(k + 1, f"body {k}", True) for k in range(len(poses)))
    return _envelope(Snapshot(1, 0, 1, 0, "", 0, 0.0, 0, (), (), bodies=bodies)), poses.tobytes()


def _make_header(i: int, state_seq: int, base_seq: int) -> StateHeader:
    now_ns = round((i + 1) * PERIOD_S * 1e9)
    applied = tuple(
        Applied(f"arm {k}", f"participant {(i // 60 + k) % PEOPLE}", Device.CONTROLLER_RIGHT, i, now_ns, now_ns, now_ns)
        for k in range(PEOPLE)
    )
    return StateHeader(1, 0, i, i * PERIOD_S, now_ns, now_ns, state_seq, base_seq, applied)


def _make_presence(i: int) -> Presence:
    devices = (Device.HEAD, Device.HAND_LEFT, Device.HAND_RIGHT)
    turn = math.cos(0.01 * i), 0.0, 0.0, math.sin(0.01 * i)
    items = [
        PresenceItem(f"participant {k}", device, Pose((0.001 * i, 0.1 * k, 1.5), turn), i)
        for k in range(PEOPLE)
        for device in devices
    ]
    return Presence(round((i + 1) * PERIOD_S * 1e9), i + 1, tuple(items))


def _make_cloth_topology() -> DeformableTopology:
    corners = np.arange(CLOTH_SIDE**2).reshape(CLOTH_SIDE, CLOTH_SIDE)
    return DeformableTopology(CLOTH_SIDE**2, split_quads(corners))


def _move_cloth(t: float) -> Floats:
    """Return the vertices of a cloth of 1 m in waves."""
    x, y = np.meshgrid(np.linspace(0.0, 1.0, CLOTH_SIDE), np.linspace(0.0, 1.0, CLOTH_SIDE))
    z = 1.0 + 0.1 * np.sin(7.0 * x + 2.0 * t) * np.cos(5.0 * y - 1.3 * t)
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def _make_cloud(rng: np.random.Generator, points: int, k: int) -> tuple[Floats, NDArray[np.uint8]]:
    places = rng.uniform(-2.0, 2.0, (points, 3))
    return places + 0.01 * k, rng.integers(0, 256, (points, 3), np.uint8)


def _decode(made: _Frames, runtime: str, file: Path, out: Path) -> dict[str, float]:
    """Decode the frames in C#. Return the results."""
    command = [*make_command(runtime), "decode", str(file), str(out)]
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=make_environment(), capture_output=True, text=True, timeout=DECODE_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise BenchError(f"{runtime} has not decoded the frames within {DECODE_S:g} s") from None
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        raise BenchError(f"the C# decoders do not run on {runtime}: {lines[0] if lines else done.returncode}")
    got = json.loads(done.stdout)
    position, rotation, cloth, cloud = _measure_errors(made, out.read_bytes())
    return {
        **{key: got[key] for key in ("decode_us_p50", "decode_us_p99", "cloth_us_p50", "cloud_us_p50")},
        "allocated_bytes_per_frame": got["allocated_bytes"] / got["frames"],
        "max_error_mm": position,
        "max_rotation_error_deg": rotation,
        "cloth_max_error_mm": cloth,
        "cloud_difference_mm": cloud,
    }


def _measure_errors(made: _Frames, data: bytes) -> tuple[float, float, float, float]:
    """Return the largest errors of what C# decoded: positions [mm], rotations [deg], vertices [mm]; and by how much
    points differ from those of the Python decoder [mm]."""
    size, drawn = made.poses.size * 8, made.vertices.size * 4
    poses = np.frombuffer(data, "<f8", count=made.poses.size).reshape(-1, 7)
    vertices = np.frombuffer(data, "<f4", count=made.vertices.size, offset=size).reshape(made.vertices.shape)
    points = np.frombuffer(data, "<f8", offset=size + drawn).reshape(-1, 3)
    position_mm, rotation_deg = compute_pose_errors(poses, made.poses.reshape(-1, 7))
    cloth = np.linalg.norm(vertices - made.vertices, axis=-1).max()
    cloud = np.abs(points - made.last_cloud).max() if points.shape == made.last_cloud.shape else math.inf
    found = (position_mm, rotation_deg, cloth * 1e3, cloud * 1e3)
    return tuple(round(float(value), 5) for value in found)  # type: ignore[return-value]


# --- C# programs ---


def make_command(runtime: str) -> list[str]:
    """Return the command that runs the program `bench` of tools/csharp on a runtime, in `ROOT`."""
    return module_command("tools.csharp", "run", "--runtime", runtime, "bench")


def make_environment() -> dict[str, str]:
    """Return the environment in which `make_command` finds the tools of the checkout."""
    return {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}


class CsharpClient(Plugin):
    """One C# client on the runtime that its name is."""

    def __init__(self, job: Job) -> None:
        self._job = job
        (spec,) = job.clients
        command = [*make_command(spec.name), "live", job.page, spec.name, str(job.origin_ns)]
        self._name = spec.name
        self._process = subprocess.Popen(
            command, cwd=ROOT, env=make_environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._expect("ready")

    def measure(self, begin_ns: int, end_ns: int) -> None:
        """Let the client log a window of session time [ns], and write its log."""
        assert self._process.stdin is not None
        file = f"{self._job.log}.txt"
        self._process.stdin.write(f"measure {begin_ns} {end_ns} {file}\n")
        self._process.stdin.flush()
        self._expect("done")
        rows = np.loadtxt(file, np.int64, ndmin=2).reshape(-1, 3)
        self._job.write_log({self._name: dict(zip(("ticks", "handed_ns", "state_ns"), rows.T, strict=True))})

    def close(self) -> None:
        """Let the client leave the session."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()

    def _expect(self, line: str) -> None:
        assert self._process.stdout is not None
        if (got := self._process.stdout.readline().strip()) != line:
            raise BenchError(f"the C# client {self._name} said {got!r} instead of {line!r}")
