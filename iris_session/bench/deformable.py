"""`bench deformable`: stream a moving cloth of 1 m from the session's loop over the media channel to clients."""

from __future__ import annotations

import math
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import zstandard

from iris_session.bench.clients import ClientJob
from iris_session.bench.cloth_motion import HZ, ClothMotion, load_cloth_motion
from iris_session.bench.harness import Measurement, assign_links, group_clients, measure
from iris_session.bench.intervals import Log
from iris_session.bench.media_clients import MediaColumn as Column
from iris_session.bench.report import BenchError, BenchReport, compute_percentile, make_bar, make_link_report
from iris_session.demo.scenes import free_bodies_scene
from iris_session.protocol.names import BudgetClass
from iris_session.session.session import Session
from iris_session.streams.deformable import COARSER, DeformableDecoder, DeformableEncoder
from iris_session.streams.deformable_topology import DeformableTopology

STREAM: Final = "cloth"
CLIENTS: Final = "iris_session.bench.media_clients:DeformableClients"
BOUND_M: Final = 0.0005
#: Moving rigid bodies beside the cloth.
BODIES: Final = 50
#: Every sixth recorded frame is encoded for results that need no session.
_SAMPLE: Final = 6


def run_deformable(
    vertices: int = 10_000,
    clients: int = 4,
    seconds: float = 20.0,
    seed: int = 0,
    curve: bool = False,
    profile: str = "",
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Stream a cloth at 60 Hz to observers, beside 50 rigid bodies.

    Args:
        vertices: Vertices of the cloth, a square number.
        clients: Number of observers.
        seconds: Length of the measured window.
        seed: Random seed.
        curve: Encrypt and authenticate.
        profile: Link profile of every client; bars do not apply then.
        progress: Called with short texts.

    Returns:
        The report. Reference: the same frames as float32, and as float32 compressed by zstd.
    """
    side = math.isqrt(vertices)
    if side * side != vertices:
        raise BenchError(f"--vertices {vertices}: the cloth is square, choose {side * side} or {(side + 1) ** 2}")
    motion = load_cloth_motion(side, seed, progress)
    topology = DeformableTopology(motion.n_vertices, motion.faces)
    specs, links = assign_links([ClientJob(f"client{i}", "observer") for i in range(clients)], profile)
    source = _ClothSource(motion, topology)
    with tempfile.TemporaryDirectory(prefix="iris-bench-") as folder:
        file = Path(folder) / "topology"
        file.write_bytes(topology.to_bytes())
        got = measure(
            free_bodies_scene(BODIES, seed).compile(),
            {CLIENTS: group_clients(specs)},
            seconds,
            links=links,
            seed=seed,
            curve=curve,
            stream=STREAM,
            topology=str(file),
            on_tick=source.publish,
            progress=progress,
        )
    progress("comparing every delivered frame with the motion")
    results = {**_summarize(got, source), **_measure_offline(motion, topology)}
    bars = [
        make_bar(results, "encode_ms_p50", "<=", 1.0),
        make_bar(results, "encode_ms_p99", "<=", 1.0),
        make_bar(results, "mbit_per_s", "<=", 20.0),
        make_bar(results, "max_error_mm", "<=", 0.5),
        make_bar(results, "delivered_hz_min", ">=", 59.0),
    ]
    params: dict[str, Any] = {"vertices": vertices, "clients": clients, "seconds": seconds, "seed": seed}
    params |= {"curve": curve, "hz": HZ, "bound_mm": BOUND_M * 1e3}
    return make_link_report("deformable", params, results, bars, profile, _measure_reference(motion))


class _ClothSource:
    """Publishes the motion from the session's loop, 60 frames a second, as the session does with deformables.

    `frames`: index into the motion by `capture_ns`. `encoded`: session time, wall time [ns], processor time [ns] and
    bytes of every frame.
    """

    def __init__(self, motion: ClothMotion, topology: DeformableTopology) -> None:
        self.motion, self.topology = motion, topology
        self._encoder = DeformableEncoder(topology, BOUND_M)
        self._begin_ns = -1
        self._next = 0
        self.frames: dict[int, int] = {}
        self.encoded: list[tuple[int, int, int, int]] = []
        self.refused = 0

    def publish(self, session: Session) -> None:
        """Publish a frame if it is due."""
        now_ns = session.clock()
        if self._begin_ns < 0:
            self._begin_ns = now_ns
        due = int((now_ns - self._begin_ns) * HZ // 1_000_000_000)
        if due < self._next:
            return
        self._next = due + 1  # frames for which the loop had no time are skipped
        index = self.motion.frame_index(due)
        vertices = self.motion.vertices(index)
        wall_ns, cpu_ns = time.perf_counter_ns(), time.thread_time_ns()
        made = self._encoder.encode(vertices)
        wall_ns, cpu_ns = time.perf_counter_ns() - wall_ns, time.thread_time_ns() - cpu_ns
        size = 0 if made is None else len(made[BudgetClass.FULL])
        self.encoded.append((now_ns, wall_ns, cpu_ns, size))
        if made is not None:
            self.frames[now_ns] = index
            self.refused += not session.publish_media(STREAM, made, capture_ns=now_ns)


def _summarize(got: Measurement, source: _ClothSource) -> dict[str, Any]:
    """Return the results of the window. Bits are those of the messages sent to one client, with topic and header."""
    end_ns = got.begin_ns + got.seconds * 1e9
    rows = np.array([row[1:] for row in source.encoded if got.begin_ns <= row[0] < end_ns]).reshape(-1, 3)
    spent, sizes = rows[:, :2] * 1e-6, rows[:, 2]
    logs = got.logs.values()
    frames = np.concatenate([log["frames"] for log in logs])
    ages, decode = (frames[:, Column.HANDED] - frames[:, Column.CAPTURE]) * 1e-6, frames[:, Column.DECODED] * 1e-6
    if not len(ages) or not len(spent):
        raise BenchError("no frame of the cloth reached a client within the window")
    superseded, dropped, malformed, overflow, heads = np.sum([log["counts"] for log in logs], axis=0).tolist()
    sent = sizes.sum() + np.count_nonzero(sizes) * heads / len(ages)
    return {
        "encode_ms_p50": compute_percentile(spent[:, 0], 50),
        "encode_ms_p99": compute_percentile(spent[:, 0], 99),
        "mbit_per_s": round(float(sent) * 8e-6 / got.seconds, 3),
        "max_error_mm": round(_compute_max_error_m(got.logs, source) * 1e3, 5),
        "delivered_hz_min": round(min(len(log["frames"]) for log in logs) / got.seconds, 2),
        "encode_cpu_ms_p50": compute_percentile(spent[:, 1], 50),
        "encode_cpu_ms_p99": compute_percentile(spent[:, 1], 99),
        "decode_cpu_ms_p50": compute_percentile(decode, 50),
        "age_ms_p50": compute_percentile(ages, 50),
        "age_ms_p99": compute_percentile(ages, 99),
        "bytes_per_frame": round(float(sizes[sizes > 0].mean()), 1),
        "frames_encoded": len(spent),
        "frames_refused": source.refused,
        "frames_superseded": superseded,
        "frames_dropped": dropped,
        "frames_malformed": malformed,
        "frames_not_logged": overflow,
        **got.summarize("late_tick_share", "late_causes", "scheduling", "drops"),
    }


def _compute_max_error_m(logs: dict[str, Log], source: _ClothSource) -> float:
    """Return the largest error of all delivered vertices. Also check that clients decoded the same vertices."""
    decoder = DeformableDecoder(source.topology)
    errors: dict[tuple[int, int], float] = {}  # by capture and checksum: the same frame goes to every client
    worst = 0.0
    for name, log in logs.items():
        for capture_ns, checksum, payload in _iterate_payloads(log):
            key = (capture_ns, checksum)
            if key not in errors:
                decoded = decoder.decode(payload)
                if zlib.crc32(decoded.data) != checksum:
                    raise BenchError(f"{name} decoded other vertices than its payload contains")
                truth = source.motion.vertices(source.frames[capture_ns])
                errors[key] = float(np.linalg.norm(decoded - truth, axis=1).max())
            worst = max(worst, errors[key])
    return worst


def _iterate_payloads(log: Log) -> Iterator[tuple[int, int, bytes]]:
    """Yield `capture_ns`, checksum and payload of every frame that one client decoded."""
    ends = np.cumsum(log["frames"][:, Column.SIZE])
    for row, end in zip(log["frames"].tolist(), ends.tolist(), strict=True):
        payload = log["payloads"][end - row[Column.SIZE] : end].tobytes()
        yield row[Column.CAPTURE], row[Column.CHECKSUM], payload


def _measure_offline(motion: ClothMotion, topology: DeformableTopology) -> dict[str, Any]:
    """Return the bit rate of the coarser classes at 60 Hz, and the speed of the vertices."""
    found: dict[str, Any] = {}
    for name in (BudgetClass.HALF, BudgetClass.QUARTER):
        encoder = DeformableEncoder(topology, BOUND_M)
        sizes = []
        for index in range(0, len(motion.nodes), _SAMPLE):
            encoder.reset()
            made = encoder.encode(motion.vertices(index), (name,))
            assert made is not None
            sizes.append(len(made[name]))
        found[f"{name}_bound_mm"] = BOUND_M * COARSER[name] * 1e3
        found[f"{name}_mbit_per_s"] = round(float(np.mean(sizes)) * 8e-6 * HZ, 3)
    pairs = range(0, len(motion.nodes) - 1, _SAMPLE)
    steps = np.stack([motion.vertices(index + 1) - motion.vertices(index) for index in pairs])
    speeds = np.linalg.norm(steps, axis=2) * HZ
    found["vertex_speed_m_per_s_p50"] = compute_percentile(speeds, 50)
    found["vertex_speed_m_per_s_p99"] = compute_percentile(speeds, 99)
    return found


def _measure_reference(motion: ClothMotion) -> dict[str, float]:
    """Return the bit rate of the same frames as float32, and as float32 compressed by zstd, level 1."""
    compressor = zstandard.ZstdCompressor(level=1)
    sizes, spent_ns = [], []
    for index in range(0, len(motion.nodes), _SAMPLE):
        raw = motion.vertices(index).astype("<f4").tobytes()
        began_ns = time.perf_counter_ns()
        sizes.append(len(compressor.compress(raw)))
        spent_ns.append(time.perf_counter_ns() - began_ns)
    return {
        "float32_mbit_per_s": round(12 * motion.n_vertices * HZ * 8e-6, 3),
        "float32_zstd_mbit_per_s": round(float(np.mean(sizes)) * HZ * 8e-6, 3),
        "float32_zstd_encode_ms_p50": compute_percentile(np.array(spent_ns) * 1e-6, 50),
    }
