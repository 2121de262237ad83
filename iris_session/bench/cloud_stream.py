"""`bench cloud-stream`: a source process streams points in motion through a session to client processes.

Intervals with and without the cloud alternate, so that the age of state with it is compared with that without it in
one run. With `mbit` every client has a link of its own, whose bandwidth falls in the middle of the window: the cloud
comes before, and after that; in the last part there is none.
"""

from __future__ import annotations

import json
import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.bench.clients import MEDIA_CLIENTS, ClientJob, make_curve_keys
from iris_session.bench.harness import (
    Action,
    BenchRun,
    Interval,
    Log,
    Measurement,
    compute_age_p99_ms,
    measure,
    plan_rounds,
    select_between,
)
from iris_session.bench.media_clients import UNCHECKED, sum_counts
from iris_session.bench.media_clients import MediaColumn as Column
from iris_session.bench.plugins import POLL_S, Plugin, PluginProcess
from iris_session.bench.report import Bar, BenchError, BenchReport, allow_increase, make_bar, summarize_percentiles
from iris_session.client import Client
from iris_session.client.errors import NotConnectedError
from iris_session.cloud.pipeline import CLASSES
from iris_session.demo.scenes import free_bodies_scene
from iris_session.streams.cloud import decode_cloud, encode_cloud, order_points, read_header
from iris_session.system.priority import lower_thread_priority

STREAM: Final = "room"
VOXEL_M: Final = 0.01
ERROR_M: Final = 0.01
#: Amplitude of the motion [m], its frequency [Hz], and its wave number [rad/m].
_SWING: Final = 0.15
_HZ: Final = 0.4
_WAVE: Final = 2.0
#: Red, green, blue of the walls and the floor.
_PAINT: Final = np.array(((215, 210, 200), (190, 200, 215), (130, 110, 90)))
_LOW, _HIGH = np.array(((-2.0, -2.0, 0.0), (2.0, 2.0, 2.4)), np.float32)


class MovingCloud:
    """Points on the walls and the floor of a room, which swing: where they are depends on seed and frame only."""

    def __init__(self, points: int, seed: int) -> None:
        random = np.random.default_rng(seed)
        self._base = random.uniform(_LOW, _HIGH, (points, 3)).astype(np.float32)
        axis = random.integers(0, 3, points)
        self._base[np.arange(points), axis] = _LOW[axis]
        self._phase = _WAVE * self._base.sum(axis=1)
        self.colors = (_PAINT[axis] + random.integers(-12, 13, (points, 3))).astype(np.uint8)

    def compute_positions(self, t: float) -> NDArray[np.float32]:
        """Return the positions (n, 3) at a time [s]."""
        swing = np.sin(np.float32(2.0 * np.pi * _HZ * t) + self._phase) * np.float32(_SWING)
        return np.asarray(self._base + swing[:, None], np.float32)

    def sort(self, t: float) -> NDArray[np.float64]:
        """Return the positions at a time in the order of the points of a frame."""
        positions = self.compute_positions(t)
        return positions[order_points(positions.T, VOXEL_M)].astype(np.float64)

    def encode(self, t: float) -> dict[str, bytes]:
        """Return the frames at a time [s]."""
        return encode_cloud(self.compute_positions(t), self.colors, voxel_m=VOXEL_M, error_m=ERROR_M, classes=CLASSES)


class MediaPublisher(Plugin):
    """Plug-in that publishes clouds. `role`: in which it joins."""

    role: ClassVar[str]

    def __init__(self) -> None:
        lower_thread_priority()  # of this thread and those that it starts, as in a camera process
        self._client: Client | None = None

    def connect(self, address: str, *keys: str) -> None:
        """Join a session, with the keys of an encrypted one."""
        curve = make_curve_keys(keys)
        self._client = Client(address, role=self.role, name=self.role, alignment="not_needed", curve=curve)
        self._client.connect(30.0)
        nothing = encode_cloud(np.empty((0, 3)), np.empty((0, 3), np.uint8))
        until_s = time.monotonic() + 30.0
        while not self._client.media.publish(STREAM, nothing, encoding="cloud"):  # the first call connects
            if time.monotonic() > until_s:
                raise TimeoutError("the session takes no media")
            self._client.poll(POLL_S)

    def poll(self) -> None:
        """Keep the connection alive."""
        if self._client is None:
            super().poll()
        else:
            self._client.poll(POLL_S)

    def close(self) -> None:
        """Leave the session."""
        if self._client is not None:
            self._client.close()

    def publish(self, frames: dict[str, bytes], capture_ns: int) -> bool:
        """Publish a cloud. Return false if the link takes nothing, or the client is reconnecting."""
        assert self._client is not None
        try:
            return self._client.media.publish(STREAM, frames, capture_ns=capture_ns, encoding="cloud")
        except NotConnectedError:
            return False


class Source(MediaPublisher):
    """Publisher of a moving cloud."""

    role = "source"

    def __init__(self, points: int, hz: int, seed: int) -> None:
        super().__init__()
        self._cloud, self._hz = MovingCloud(points, seed), hz

    def run(self, seconds: float) -> dict[str, Any]:
        """Publish for some seconds. Return captures [ns] of the frames by number, and what their encoding took [ms]."""
        assert self._client is not None
        hz = self._hz
        captures: dict[int, int] = {}
        encode_ms, refused = [], 0
        begin = time.perf_counter()
        number = 0
        while (now := time.perf_counter()) < begin + seconds:
            if now < begin + number / hz:
                self._client.poll(begin + number / hz - now)
                continue
            capture_ns = self._client.session_now_ns()
            positions = self._cloud.compute_positions(number / hz)
            began_ns = time.perf_counter_ns()
            frames = encode_cloud(positions, self._cloud.colors, voxel_m=VOXEL_M, error_m=ERROR_M, classes=CLASSES)
            encode_ms.append((time.perf_counter_ns() - began_ns) * 1e-6)
            refused += not self.publish(frames, capture_ns)
            captures[number] = capture_ns
            # Frames without time for them are left out.
            number = max(number + 1, int((time.perf_counter() - begin) * hz))
        return {"captures": captures, "encode_ms": encode_ms, "refused": refused}


# --- benchmark --------------------------------------------------------------------------------------------------------


SOURCE: Final = "iris_session.bench.cloud_stream:Source"
#: Moving rigid bodies beside the cloud.
BODIES: Final = 50
#: Before the first interval, so that the source has joined; and shortest interval [s].
LEAD_S: Final = 1.0
SHORTEST_S: Final = 0.5
#: From the fall of the bandwidth to the coarser class at every client [s].
MAX_LOWER_S: Final = 1.0
WITHOUT, WITH, SLOW, SLOW_WITHOUT = "without", "with", "slow", "slow_without"


def plan_stream(seconds: float, *, slow: bool = False) -> list[Interval]:
    """Return the intervals of a window, `slow`: in whose middle links become slow."""
    kinds, rounds = ((WITH, SLOW, SLOW_WITHOUT), 1) if slow else ((WITHOUT, WITH), 4)
    return plan_rounds(dict.fromkeys(kinds, SHORTEST_S), seconds, rounds, LEAD_S)


def run_cloud_stream(
    points: int = 50_000,
    hz: int = 60,
    clients: int = 4,
    seconds: float = 20.0,
    mbit: float = 0.0,
    seed: int = 0,
    curve: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Stream a cloud to observers, beside 50 rigid bodies."""
    plan = plan_stream(seconds, slow=mbit > 0.0)
    link = "none" if mbit else ""
    specs = [
        ClientJob(f"client{i}", "observer", profile=link, plugin=MEDIA_CLIENTS, alone=True) for i in range(clients)
    ]
    with (
        tempfile.TemporaryDirectory(prefix="iris-bench-") as folder,
        PluginProcess(SOURCE, points, hz, seed) as source,
    ):
        source.read()
        profile = Path(folder) / "slow.json"
        profile.write_text(json.dumps({"phases": [{"rate_mbit": mbit, "delay_ms": 2}]}))

        def connect(run: BenchRun) -> None:
            source.send("connect", run.session.address, *run.processes[0].job.keys)

        actions: list[Action] = [(0.0, connect)]
        for one in plan:
            if one.kind == SLOW:
                actions.append((one.begin_s, lambda run: run.command_links(f"profile {profile}")))
            if one.kind in (WITH, SLOW):
                actions.append((one.begin_s, lambda _: source.send("run", plan[0].length_s)))
        got = measure(
            free_bodies_scene(BODIES, seed).compile(),
            specs,
            plan[-1].end_s,
            seed=seed,
            actions=actions,
            curve=curve,
            stream=STREAM,
            progress=progress,
        )
        source.read()  # the answer to `connect`
        runs = [source.read() for one in plan if one.kind in (WITH, SLOW)]
    progress("comparing the delivered clouds with those of the source")
    results = summarize(got, plan, runs, MovingCloud(points, seed), hz)
    params = {"seconds": plan[-1].end_s, "bodies": BODIES}
    return BenchReport(results, _make_bars(results, hz, mbit), params=params)


def summarize(
    got: Measurement, plan: Sequence[Interval], runs: Sequence[dict[str, Any]], cloud: MovingCloud, hz: int
) -> dict[str, Any]:
    """Return the results of a window."""
    logs = list(got.logs.values())
    clouds = np.concatenate([log["frames"] for log in logs])
    if not (clouds[:, Column.LEVEL] == 0).any():
        raise BenchError("no whole cloud reached a client within the window")
    streamed = [one for one in plan if one.kind == WITH]
    fast = [np.concatenate([_select(log["frames"], Column.HANDED, got, one) for one in streamed]) for log in logs]
    fast = [one[one[:, Column.LEVEL] == 0] for one in fast]  # a coarser class is less than was asked for
    rows = np.concatenate(fast)
    length_s = sum(one.length_s for one in streamed)
    counts, heads = sum_counts(logs)
    whole = clouds[clouds[:, Column.LEVEL] == 0]
    errors_m, stated_m = _compare(clouds, runs, cloud, hz)
    results: dict[str, Any] = {
        "delivered_hz_min": round(min(len(one) for one in fast) / length_s, 2),
        "bytes_per_point": round(
            (whole[:, Column.SIZE].mean() + heads / len(clouds)) / whole[:, Column.POINTS].mean(), 4
        ),
        **summarize_percentiles("age_ms", (rows[:, Column.HANDED] - rows[:, Column.CAPTURE]) * 1e-6),
        **summarize_percentiles("encode_ms", np.concatenate([run["encode_ms"] for run in runs])),
        **summarize_percentiles("decode_ms", whole[:, Column.DECODED] * 1e-6),
        "max_error_mm": round(errors_m * 1e3, 5),
        "stated_error_mm": round(stated_m * 1e3, 5),
        "mbit_per_s": round(float(whole[:, Column.SIZE].mean()) * 8e-6 * hz, 1),
    }
    for kind, key in ((WITH, ""), (WITHOUT, "_without"), (SLOW, "_slow"), (SLOW_WITHOUT, "_slow_without")):
        intervals = [one for one in plan if one.kind == kind]
        if intervals:
            p99s = [compute_age_p99_ms(logs, got.begin_ns, one.begin_s, one.end_s) for one in intervals]
            results[f"state_age_ms_p99{key}"] = round(float(np.median(p99s)), 3)
    for slow in (one for one in plan if one.kind == SLOW):
        results |= _summarize_slow(logs, got, slow)
        lowered_s = min(slow.begin_s + MAX_LOWER_S, slow.end_s - SHORTEST_S / 2)
        results["state_age_ms_p99_slow_lowered"] = compute_age_p99_ms(logs, got.begin_ns, lowered_s, slow.end_s)
    return results | {
        "frames_refused": sum(run["refused"] for run in runs),
        **counts,
        **got.summarize("late_tick_share", "scheduling", "drops"),
    }


def _summarize_slow(logs: Sequence[Log], got: Measurement, slow: Interval) -> dict[str, float]:
    """Return what happens after the bandwidth has fallen.

    Times until the client knew of a coarser class, and until a cloud of one came; the longest time without a cloud; and
    the rate after `MAX_LOWER_S`.
    """
    known_s, lower_s, gaps_s, rates = [], [], [], []
    for log in logs:
        rows = _select(log["frames"], Column.HANDED, got, slow)
        at_s = (rows[:, Column.HANDED] - got.begin_ns) * 1e-9 - slow.begin_s
        levels = _select(log["levels"], 0, got, slow)
        known_s.append(_first(((levels[:, 0] - got.begin_ns) * 1e-9 - slow.begin_s)[levels[:, 1] > 0]))
        lower_s.append(_first(at_s[rows[:, Column.LEVEL] > 0]))
        gaps_s.append(float(np.diff(np.concatenate([[0.0], at_s, [slow.length_s]])).max()))
        rates.append(float(np.count_nonzero(at_s >= MAX_LOWER_S)) / max(slow.length_s - MAX_LOWER_S, 0.1))
    return {
        "lower_class_after_s": round(max(known_s), 3),
        "lower_cloud_after_s": round(max(lower_s), 3),
        "longest_gap_s": round(max(gaps_s), 3),
        "slow_hz_min": round(min(rates), 2),
    }


def _first(times_s: NDArray[Any]) -> float:
    return float(times_s[0]) if len(times_s) else float("inf")


def _make_bars(results: dict[str, Any], hz: int, mbit: float) -> list[Bar]:
    bars = [
        make_bar(results, "bytes_per_point", "<=", 9.1),
        make_bar(results, "max_error_mm", "<=", results["stated_error_mm"]),
    ]
    if mbit:
        bars.append(make_bar(results, "lower_class_after_s", "<=", MAX_LOWER_S))
        bars.append(make_bar(results, "longest_gap_s", "<=", MAX_LOWER_S))
        key, without = "state_age_ms_p99_slow_lowered", "state_age_ms_p99_slow_without"
    else:
        bars.append(make_bar(results, "delivered_hz_min", ">=", hz * 58.0 / 60.0))
        bars.append(make_bar(results, "decode_ms_p50", "<", 0.2))
        key, without = "state_age_ms_p99", "state_age_ms_p99_without"
    return [*bars, make_bar(results, key, "<=", allow_increase(results[without]))]


# --- evaluation -------------------------------------------------------------------------------------------------------


def _select(rows: NDArray[Any], column: int, got: Measurement, interval: Interval) -> NDArray[Any]:
    """Return the rows with a session time within an interval."""
    return np.asarray(rows[select_between(rows[:, column], got.begin_ns, interval.begin_s, interval.end_s)])


def _compare(clouds: NDArray[Any], runs: Sequence[dict[str, Any]], cloud: MovingCloud, hz: int) -> tuple[float, float]:
    """Return the largest error of the delivered clouds, and the smallest bound that their headers state [m].

    Clouds are encoded again, and compared by their checksum with those that the clients received.
    """
    frames = {capture_ns: int(number) for run in runs for number, capture_ns in run["captures"].items()}
    worst_m, stated_m = 0.0, float("inf")
    unique = {tuple(row): None for row in clouds[:, [Column.CAPTURE, Column.CHECKSUM]].tolist()}
    checksums: dict[int, set[int]] = {}
    for capture_ns, checksum in unique:
        if capture_ns in frames and checksum != UNCHECKED:  # not the empty one with which the source connects
            checksums.setdefault(frames[capture_ns], set()).add(checksum)
    for number, received in checksums.items():
        made = cloud.encode(number / hz)
        if not received <= {zlib.crc32(one) for one in made.values()}:
            raise BenchError(f"a client received another cloud {number} than the source made")
        whole = made["full"]
        decoded = decode_cloud(whole).positions
        worst_m = max(worst_m, float(np.linalg.norm(decoded - cloud.sort(number / hz), axis=1).max()))
        stated_m = min(stated_m, read_header(whole).quantum_error_m)
    return worst_m, stated_m
