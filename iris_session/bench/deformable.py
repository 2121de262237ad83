"""`bench deformable`: stream a moving cloth of 1 m from the session's loop over the media channel to clients.

Two guided corners swing it, drag it over a ball, lower it to the floor, and lift it again, so it folds and wrinkles.
Simulating 100 x 100 vertices takes seven to ten minutes of a processor (a cloth vertex is a body), so the result is
kept in the user's cache folder: the first run with a seed takes that much longer.
"""

from __future__ import annotations

import math
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.assets.store import default_root
from iris_session.bench.clients import MEDIA_CLIENTS, ClientJob
from iris_session.bench.harness import Log, Measurement, measure
from iris_session.bench.media_clients import MediaColumn as Column
from iris_session.bench.media_clients import sum_counts
from iris_session.bench.report import (
    BenchError,
    BenchReport,
    compute_percentile,
    make_bar,
    summarize_percentiles,
)
from iris_session.demo.scenes import free_bodies_scene
from iris_session.protocol.names import BudgetClass
from iris_session.session.session import Session
from iris_session.streams.deformable import COARSER, DeformableDecoder, DeformableEncoder
from iris_session.streams.deformable_topology import DeformableTopology
from iris_session.system.files import Replacement

STREAM: Final = "cloth"
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

    Reference: the same frames as float32, and as float32 compressed by deflate.
    """
    side = math.isqrt(vertices)
    if side * side != vertices:
        raise BenchError(f"--vertices {vertices}: the cloth is square, choose {side * side} or {(side + 1) ** 2}")
    motion = load_cloth_motion(side, seed, progress)
    topology = DeformableTopology(vertices, motion.faces)
    specs = [ClientJob(f"client{i}", "observer", profile=profile, plugin=MEDIA_CLIENTS) for i in range(clients)]
    source = _ClothSource(motion, topology)
    with tempfile.TemporaryDirectory(prefix="iris-bench-") as folder:
        file = Path(folder) / "topology"
        file.write_bytes(topology.to_bytes())
        got = measure(
            free_bodies_scene(BODIES, seed).compile(),
            specs,
            seconds,
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
    return BenchReport(results, bars, _measure_reference(motion), {"hz": HZ, "bound_mm": BOUND_M * 1e3})


class _ClothSource:
    """Publishes the motion from the session's loop, 60 frames a second, as the session does with deformables.

    `frames`: index into the motion and payload by `capture_ns`. `encoded`: session time, wall time [ns], processor time
    [ns] and bytes of every frame.
    """

    def __init__(self, motion: ClothMotion, topology: DeformableTopology) -> None:
        self.motion, self.topology = motion, topology
        self._encoder = DeformableEncoder(topology, BOUND_M)
        self._begin_ns = -1
        self._next = 0
        self.frames: dict[int, tuple[int, bytes]] = {}
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
        index = self.motion.find_frame(due)
        vertices = self.motion.vertices[index]
        wall_ns, cpu_ns = time.perf_counter_ns(), time.thread_time_ns()
        made = self._encoder.encode(vertices)
        wall_ns, cpu_ns = time.perf_counter_ns() - wall_ns, time.thread_time_ns() - cpu_ns
        size = 0 if made is None else len(made[BudgetClass.FULL])
        self.encoded.append((now_ns, wall_ns, cpu_ns, size))
        if made is not None:
            self.frames[now_ns] = index, made[BudgetClass.FULL]
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
    counts, heads = sum_counts(logs)
    sent = sizes.sum() + np.count_nonzero(sizes) * heads / len(ages)
    return {
        **summarize_percentiles("encode_ms", spent[:, 0]),
        "mbit_per_s": round(float(sent) * 8e-6 / got.seconds, 3),
        "max_error_mm": round(_compute_max_error_m(got.logs, source) * 1e3, 5),
        "delivered_hz_min": round(min(len(log["frames"]) for log in logs) / got.seconds, 2),
        **summarize_percentiles("encode_cpu_ms", spent[:, 1]),
        "decode_cpu_ms_p50": compute_percentile(decode, 50),
        **summarize_percentiles("age_ms", ages),
        "bytes_per_frame": round(float(sizes[sizes > 0].mean()), 1),
        "frames_encoded": len(spent),
        "frames_refused": source.refused,
        **counts,
        **got.summarize("late_tick_share", "late_causes", "scheduling", "drops"),
    }


def _compute_max_error_m(logs: dict[str, Log], source: _ClothSource) -> float:
    """Return the largest error of all delivered vertices. Also check that clients decoded what was sent."""
    decoder = DeformableDecoder(source.topology)
    found: dict[int, tuple[int, float]] = {}  # checksum and error by capture: the same frame goes to every client
    for name, log in logs.items():
        for capture_ns, checksum in log["frames"][:, [Column.CAPTURE, Column.CHECKSUM]].tolist():
            if capture_ns not in found:
                index, payload = source.frames[capture_ns]
                decoded = decoder.decode(payload)
                error_m = float(np.linalg.norm(decoded - source.motion.vertices[index], axis=1).max())
                found[capture_ns] = zlib.crc32(decoded.data), error_m
            if found[capture_ns][0] != checksum:
                raise BenchError(f"{name} decoded other vertices than were sent")
    return max(error_m for _, error_m in found.values())


def _measure_offline(motion: ClothMotion, topology: DeformableTopology) -> dict[str, Any]:
    """Return the bit rate of the coarser classes at 60 Hz, and the speed of the vertices."""
    found: dict[str, Any] = {}
    for name in (BudgetClass.HALF, BudgetClass.QUARTER):
        encoder = DeformableEncoder(topology, BOUND_M)
        sizes = []
        for vertices in motion.vertices[::_SAMPLE]:
            encoder.reset()
            made = encoder.encode(vertices, (name,))
            assert made is not None
            sizes.append(len(made[name]))
        found[f"{name}_bound_mm"] = BOUND_M * COARSER[name] * 1e3
        found[f"{name}_mbit_per_s"] = round(float(np.mean(sizes)) * 8e-6 * HZ, 3)
    speeds = np.linalg.norm(np.diff(motion.vertices, axis=0)[::_SAMPLE], axis=2) * HZ
    return found | summarize_percentiles("vertex_speed_m_per_s", speeds.ravel())


def _measure_reference(motion: ClothMotion) -> dict[str, float]:
    """Return the bit rate of the same frames as float32, and as float32 compressed by deflate, level 1."""
    sizes, spent_ns = [], []
    for vertices in motion.vertices[::_SAMPLE]:
        raw = vertices.astype("<f4").tobytes()
        began_ns = time.perf_counter_ns()
        sizes.append(len(zlib.compress(raw, 1)))
        spent_ns.append(time.perf_counter_ns() - began_ns)
    return {
        "float32_mbit_per_s": round(12 * motion.vertices.shape[1] * HZ * 8e-6, 3),
        "float32_deflate_mbit_per_s": round(float(np.mean(sizes)) * HZ * 8e-6, 3),
        "float32_deflate_encode_ms_p50": compute_percentile(np.array(spent_ns) * 1e-6, 50),
    }


# --- the motion -------------------------------------------------------------------------------------------------------


HZ: Final = 60
SECONDS: Final = 6
EDGE_M: Final = 1.0
#: Initial height of the hands.
TOP_M: Final = 1.4
#: Short steps keep the cloth stiff: a constraint of MuJoCo settles within some of them.
STEPS_PER_FRAME: Final = 6
TIMESTEP_S: Final = 1.0 / (STEPS_PER_FRAME * HZ)
#: Share of an edge that one hand holds.
_GRIP: Final = 0.1
#: Version of the scene and of the file: increment it with either.
VERSION: Final = 3

_SCENE: Final = """
<mujoco model="cloth">
  <option integrator="discrete" solver="CG" timestep="{timestep}" iterations="80" tolerance="1e-6"/>
  <size memory="1G"/>
  <worldbody>
    <geom type="plane" size="3 3 .1"/>
    <geom type="sphere" size=".18" pos="0.2 0 .6"/>
    <body name="left" mocap="true" pos="{left}"/>
    <body name="right" mocap="true" pos="{right}"/>
    <flexcomp name="cloth" type="grid" dim="2" count="{side} {side} 1" spacing="{spacing} {spacing} {spacing}"
              pos="0 0 {top}" radius="0.004" mass="0.3">
      <edge equality="true" solref="0.006 1"/>
      <contact selfcollide="none"/>
    </flexcomp>
  </worldbody>
  <equality>
    {grips}
  </equality>
</mujoco>
"""


class ClothMotion(NamedTuple):
    """Motion of a cloth at 60 Hz: `vertices` (frames, n, 3) [m], world frame, and `faces` (m, 3), their indices."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]

    def find_frame(self, number: int) -> int:
        """Return the index of the recorded frame for frame `number`: the motion runs to its end and back."""
        period = 2 * (len(self.vertices) - 1)
        return min(number % period, period - number % period)


def load_cloth_motion(side: int, seed: int, progress: Callable[[str], None]) -> ClothMotion:
    """Return the motion of a cloth of `side` x `side` vertices: from the cache, or simulated and stored there."""
    path = default_root("bench") / f"cloth-v{VERSION}-{side}x{side}-{seed}-mujoco-{version('mujoco')}.npz"
    try:
        with path.open("rb") as file, np.load(file) as kept:  # numpy leaves a damaged file open
            return ClothMotion(kept["vertices"], kept["faces"])
    except FileNotFoundError:
        pass
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        progress(f"{path} cannot be read ({error}): simulating again")
    motion = simulate_cloth(side, seed, progress)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with Replacement(path) as replacement:
            np.savez(replacement.file, allow_pickle=False, **motion._asdict())
    except OSError as error:
        progress(f"the motion cannot be cached: {error}")
    return motion


def simulate_cloth(side: int, seed: int, progress: Callable[[str], None]) -> ClothMotion:
    """Simulate `SECONDS` of the cloth. The same arguments give the same motion on the same version of MuJoCo."""
    spacing = EDGE_M / (side - 1)
    hands = _Hands(seed)
    left, right = (" ".join(map(str, p)) for p in hands.positions_at(0.0))
    progress(f"simulating a cloth of {side} x {side} vertices once: this takes ten minutes for 100 x 100")
    fields = {"timestep": TIMESTEP_S, "top": TOP_M, "left": left, "right": right, "side": side, "spacing": spacing}
    model = mujoco.MjModel.from_xml_string(_SCENE.format(grips=_format_grips(side), **fields))
    data = mujoco.MjData(model)
    frames = np.empty((HZ * SECONDS, model.nflexvert, 3), np.float32)
    began_s = time.monotonic()
    for frame in range(len(frames)):
        if frame and frame % (HZ // 2) == 0:
            left_s = (time.monotonic() - began_s) * (len(frames) / frame - 1.0)
            progress(f"{frame / HZ:g} s of {SECONDS} s are simulated, {left_s:.0f} s left")
        for _ in range(STEPS_PER_FRAME):
            data.mocap_pos[:] = hands.positions_at(data.time)
            mujoco.mj_step(model, data)
        frames[frame] = data.flexvert_xpos
    if not np.isfinite(frames).all():
        raise BenchError(
            f"the simulated cloth of {side} x {side} vertices (seed {seed}) diverged: choose another --seed"
        )
    return ClothMotion(frames, np.array(model.flex_elem, np.int32).reshape(-1, 3))


def _format_grips(side: int) -> str:
    """Return the constraints by which the hands hold the ends of the first row."""
    held = max(1, round(_GRIP * side))
    ends = (("left", range(held)), ("right", range(side - held, side)))
    return "".join(
        f'<connect body1="cloth_{vertex}" body2="{hand}" anchor="0 0 0"/>' for hand, end in ends for vertex in end
    )


class _Hands:
    """Motion of two hands that hold two corners of one edge: slow large movements plus small fast ones, from rest."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._phase = rng.uniform(0.0, 2.0 * math.pi, (2, 3))
        self._hz = rng.uniform(1.2, 2.2, (2, 3))

    def positions_at(self, t: float) -> NDArray[np.float64]:
        """Return the positions of left and right hand at time `t` [s], (2, 3) [m]."""
        ramp = min(1.0, t)
        turn = 2.0 * math.pi * t / SECONDS
        reach = 0.35 * (1.0 - math.cos(turn))  # over the ball and back
        height = TOP_M - 0.45 * (1.0 - math.cos(turn))  # down to 0.5 m, and up again
        gap = 0.5 - 0.18 * (1.0 - math.cos(turn))
        shake = 0.05 * ramp * (np.sin(2.0 * math.pi * self._hz * t + self._phase) - np.sin(self._phase))
        base = np.array(((-0.5 + reach, -gap, height), (-0.5 + reach, gap, height)))
        return np.asarray(base + shake)
