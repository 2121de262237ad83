"""`bench record`: what recording costs a session, how large its file is, and what kills take from it.

Two operators drive two arms among bodies that fly, at 500 Hz, in sessions with and without a recording in turn. A
session of `handover` in which nothing happens gives what a recording costs at rest. Then recorder, authority and both
are killed (SIGKILL) in sessions of other processes, and what is left is read.

A loss is the session time from the newest row of the journal in the file to the kill. After a kill of the recorder
alone the session goes on in the next part, which has the rows that the first one lacks; the loss of that kill is what
would be missing if the session had ended with it.
"""

from __future__ import annotations

import itertools
import os
import random
import select
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
import psutil
import rerun as rr
from numpy.typing import NDArray

from iris_session.bench.clients import CLIENTS, Job, make_operators
from iris_session.bench.harness import make_session_config, measure
from iris_session.bench.plugins import Plugin, PluginProcess
from iris_session.bench.report import BenchError, BenchReport, make_bar
from iris_session.demo.scenes import free_bodies_scene, scene_path
from iris_session.demo.scenes.generators import (
    ARM_FILE,
    ARM_HOME,
    FINGER_OPEN,
    arm_names,
    compute_bearing,
    compute_circle_radius,
    place_arm,
)
from iris_session.journal.feed import RATE_NS
from iris_session.recording import NotARecordingError, RecordedState, Recording
from iris_session.rrd import paths
from iris_session.rrd.batches import read_index
from iris_session.rrd.file import read_chunks, scan_file
from iris_session.rrd.paths import part_path
from iris_session.session.session import Session
from iris_session.viewer.scene_layer import SceneLayer, SceneSource, escape_entity_part
from iris_session.viewer.timelines import Moment, to_time_columns

#: Rounds with a recording, and as many without; and the shortest of them.
ROUNDS: Final = 3
SHORTEST_S: Final = 2.0
#: Time at rest [s]: the rate of a file is measured over `RATE_NS`, after half of it for scene and assets.
REST_S: Final = 1.5 * RATE_NS * 1e-9 + 5.0
RECORDER, AUTHORITY, BOTH = "recorder", "authority", "both"
#: Kills in their order. A session survives that of its recorder, so it has one of the others, too.
KINDS: Final = (RECORDER, AUTHORITY, RECORDER, BOTH)
START_S: Final = 60.0
END_S: Final = 30.0
SESSION: Final = "iris_session.bench.record:RecordedSession"


class Round(NamedTuple):
    """Measurements of one round."""

    recorded: bool
    late: int
    ticks: int
    recorder_cpu_share: float


class Kill(NamedTuple):
    """A kill: what was killed, and the session time before it that is in no file [s]."""

    kind: str
    loss_s: float


class FileSize(NamedTuple):
    """Size of a recording, and of naive logs of its values in long batches and in those of `rerun.log` [bytes], and
    their session time [s]."""

    recorded: int
    naive: int
    live: int
    duration_s: float


def run_record(
    seconds: float = 60.0,
    kills: int = 21,
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Measure a session of two operators and 50 bodies with and without a recording, and kill recorded sessions."""
    rounds = max(1, min(ROUNDS, int(seconds / (2.0 * SHORTEST_S))))
    length_s = max(SHORTEST_S, seconds / (2.0 * rounds))
    with tempfile.TemporaryDirectory(prefix="iris-bench-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        measured: list[Round] = []
        files: list[Path] = []
        drops: dict[str, int] = {}
        for i in range(2 * rounds):
            recorded = i % 4 in (0, 3)  # in turn, and neither is always the first
            path = folder / f"round{i}.rrd"
            progress(f"round {i + 1} of {2 * rounds}, {'with' if recorded else 'without'} recording")
            got = measure(
                make_record_scene(seed).compile(),
                make_operators(arm_names(OPERATORS)),
                length_s,
                record=path if recorded else False,
                seed=seed,
                progress=progress,
            )
            stats = got.usage.stats
            measured.append(Round(recorded, stats.late, stats.ticks, got.usage.cpu_shares.get("recorder", 0.0)))
            if recorded:
                drops |= got.status.drops
                files.append(path)
                _wait_for_index(path)
        progress("writing the same values as naive logs")
        sizes = [measure_size(path, folder) for path in files]
        progress("a session at rest")
        rest_mb = measure_rest(folder / "rest.rrd")
        losses, missing = _kill_sessions(folder, kills, seed, progress)
    results = summarize_rounds(measured) | summarize_sizes(sizes) | summarize_kills(losses)
    results |= {
        "rest_mb_per_hour": rest_mb,
        "kill_rows_missing": missing,
        "scheduling": got.status.scheduling,
        "drops": drops,
    }
    params = {"operators": OPERATORS, "bodies": BODIES, "seconds": 2 * rounds * length_s, "rounds": rounds}
    return BenchReport(results, make_record_bars(results), params=params)


def _wait_for_index(path: Path) -> None:
    """Wait until a finished recording has its index: the next round is measured without the process that adds it."""
    until = time.monotonic() + END_S
    while time.monotonic() < until and not scan_file(path).indexed:
        time.sleep(0.02)


# --- results ----------------------------------------------------------------------------------------------------------


def measure_size(path: Path, folder: Path) -> FileSize:
    """Compare the size of a recording with those of naive logs of its values, which are written into `folder`."""
    with Recording.open(path) as recording:
        times = [row.now_ns for row in recording.rows()]
        if len(times) < 2:
            raise BenchError("a recording has no rows")
        naive = write_naive_log(recording, folder / "naive.rrd", LONG_BATCH_S)
        live = write_naive_log(recording, folder / "live.rrd", LOG_BATCH_S)
        return FileSize(path.stat().st_size, naive, live, (times[-1] - times[0]) * 1e-9)


def measure_rest(path: Path) -> float:
    """Return what a session of `handover` without clients adds to its recording in an hour [MB]."""
    model = mujoco.MjModel.from_xml_path(str(scene_path("handover")))
    with Session(model, config=make_session_config(record=path)) as session:
        session.run(seconds=REST_S)
        feed = session.processes.feed
        if feed is None or not feed.stats.bytes_per_hour:
            raise BenchError("the recording of a session at rest does not grow")
        return round(feed.stats.bytes_per_hour * 1e-6, 1)


def summarize_rounds(rounds: Sequence[Round]) -> dict[str, Any]:
    """Return the processor time of the recorder, and late ticks with and without it.

    The spread of the rounds is the difference of the largest and the smallest.
    """
    shares = [one.recorder_cpu_share for one in rounds if one.recorded]
    results: dict[str, Any] = {
        "writer_cpu_share": round(float(np.mean(shares)), 4),
        "writer_cpu_share_runs": _number(shares, 4),
    }
    for label, recorded in (("on", True), ("off", False)):
        of = [one for one in rounds if one.recorded is recorded]
        late = [one.late / max(1, one.ticks) for one in of]
        results[f"late_tick_share_{label}"] = round(sum(o.late for o in of) / max(1, sum(o.ticks for o in of)), 6)
        results[f"late_tick_share_{label}_runs"] = _number(late, 6)
        results[f"late_tick_share_{label}_spread"] = round(max(late) - min(late), 6)
    return results


def summarize_sizes(sizes: Sequence[FileSize]) -> dict[str, Any]:
    """Return the size of recordings per minute, beside those of naive logs."""
    recorded, naive, live, duration_s = (sum(values) for values in zip(*sizes, strict=True))
    return {
        "mb_per_min": round(recorded * 60e-6 / duration_s, 2),
        "naive_mb_per_min": round(naive * 60e-6 / duration_s, 2),
        "live_log_mb_per_min": round(live * 60e-6 / duration_s, 2),
        "size_ratio": round(recorded / naive, 3),
        "live_log_size_ratio": round(recorded / live, 3),
    }


def summarize_kills(kills: Sequence[Kill]) -> dict[str, Any]:
    """Return what kills take from the files, of all and by kind."""
    losses = [kill.loss_s for kill in kills]
    by_kind = {kind: [k.loss_s for k in kills if k.kind == kind] for kind in (RECORDER, AUTHORITY, BOTH)}
    return {
        "kills": {kind: len(of) for kind, of in by_kind.items()},
        "kill_loss_s_p50": round(float(np.percentile(losses, 50)), 4),
        "kill_loss_s_p95": round(float(np.percentile(losses, 95)), 4),
        "kill_loss_s_max": round(max(losses), 4),
        "kill_loss_s_max_by_kind": {kind: round(max(of), 4) for kind, of in by_kind.items() if of},
    }


def make_record_bars(results: dict[str, Any]) -> list[Any]:
    """Return the bars. Those with a recording are compared with those without it, and their spread."""
    late = round(results["late_tick_share_off"] + results["late_tick_share_off_spread"], 6)
    return [
        make_bar(results, "writer_cpu_share", "<=", 0.05),
        make_bar(results, "late_tick_share_on", "<=", late),
        make_bar(results, "size_ratio", "<=", 1.5),
        make_bar(results, "rest_mb_per_hour", "<=", 20.0),
        make_bar(results, "kill_loss_s_max", "<=", 0.25),
        make_bar(results, "kill_rows_missing", "<=", 0),
    ]


def _number(values: Sequence[float], digits: int) -> dict[str, float]:
    return {str(i + 1): round(value, digits) for i, value in enumerate(values)}


# --- kills ------------------------------------------------------------------------------------------------------------


def _kill_sessions(folder: Path, kills: int, seed: int, progress: Callable[[str], None]) -> tuple[list[Kill], int]:
    """Kill sessions one after the other. Return the kills, and the rows missing between others in what is left."""
    random_of = random.Random(seed)
    losses: list[Kill] = []
    missing = 0
    kinds = [KINDS[i % len(KINDS)] for i in range(kills)]
    for i in range(0, kills, 2):
        pair = kinds[i : i + 2]
        progress(f"kill {i + 1} of {kills}: {', then '.join(pair)}")
        path = folder / f"killed{i}" / paths.FIRST_FILE
        lost, gaps = read_losses(path, kill_session(path, seed, pair, random_of))
        losses += lost
        missing += gaps
    return losses, missing


def read_losses(path: Path, kills: Sequence[tuple[str, int]]) -> tuple[list[Kill], int]:
    """Return the losses of kills of a recording, and how many rows are missing between others in what is left.

    `kills`: what was killed, and the session time of the kill [ns], in order.
    """
    losses = []
    for part, (kind, at_ns) in enumerate(kills, 1):
        try:
            # The part alone: those after it have what it lacks.
            with Recording([part_path(str(path), part)]) as recording:
                newest_ns = max((row.now_ns for row in recording.rows()), default=0)
        except NotARecordingError as error:
            raise BenchError(f"nothing can be read of what a kill has left: {error}") from None
        losses.append(Kill(kind, max(0.0, (at_ns - newest_ns) * 1e-9)))
    with Recording.open(path, warn=False) as recording:
        steps = [row.step for row in recording.rows()]
        gaps = (steps[-1] + 1 - len(set(steps))) if steps else 0
    return losses, gaps


def kill_session(path: Path, seed: int, kinds: Sequence[str], random_of: random.Random) -> list[tuple[str, int]]:
    """Record a session, and kill processes of it, as `kinds` says, each time after the recorder has caught up.

    Returns:
        What was killed, and the session time of the kill [ns].
    """
    killed: list[tuple[str, int]] = []
    children: list[psutil.Process] = []
    session = PluginProcess(SESSION, str(path), seed)
    try:
        session.read(START_S)
        for kind in kinds:
            recorder, origin_ns = session.ask("wait_until_written", START_S)
            if not recorder:
                raise BenchError("the recorder of a session that is to be killed is not up to date")
            children = psutil.Process(session.pid).children(recursive=True)
            time.sleep(random_of.uniform(0.5, 1.0))  # until any moment between two writes
            now_ns = time.monotonic_ns()
            for pid in {RECORDER: [recorder], AUTHORITY: [session.pid], BOTH: [recorder, session.pid]}[kind]:
                try:
                    os.kill(pid, signal.SIGKILL)
                except ProcessLookupError:
                    raise BenchError("a process ended before it was killed") from None
            killed.append((kind, now_ns - origin_ns))
    finally:
        with suppress(psutil.Error):
            children = psutil.Process(session.pid).children(recursive=True) or children
        session.close(exit_s=END_S)
        # A recorder whose session was killed writes the rest first.
        for process in psutil.wait_procs(children, timeout=END_S)[1]:
            with suppress(psutil.Error):
                process.kill()
    return killed


# --- naive logs of the same values ------------------------------------------------------------------------------------


#: Session time of a batch: of a program that collects for `rerun.send_columns` as long as a recorder does, and of one
#: that calls `rerun.log`, whose batcher writes after 0.2 s (`ChunkBatcherConfig.flush_tick`).
LONG_BATCH_S: Final = 8.0
LOG_BATCH_S: Final = 0.2
_SCALARS: Final = "Scalars:scalars"
_TIMELINES: Final = (paths.STEP, paths.SIM_TIME, paths.SESSION_TIME, paths.WALL_TIME)
_Row = tuple[str, Moment, list[float]]  # entity, time, values


def write_naive_log(recording: Recording, output: Path, batch_s: float) -> int:
    """Log the values of a recording to `output`, as Rerun's own calls do. Return its size [bytes].

    There is one entity per body, device and series, one row per state, on the four timelines of a recording, without a
    journal and raw messages; the geometry of the scene is in the file once. The length of the batches [s of session
    time] decides about the size, since a short chunk is mostly its schema.
    """
    log = rr.RecordingStream("naive", recording_id="naive")
    log.set_log_time_enabled(False)
    log.save(output)
    states, header = list(recording.states()), recording.header
    if states:
        picture = SceneLayer(log)
        picture.set_scene(SceneSource(header.model, header.bodies, robots=header.robots))
        picture.draw(_make_moment(states[0], header.origin_utc_ns))
    _send(log, _list_poses(states, header.origin_utc_ns), batch_s, _make_transforms)
    _send(log, _list_scalars(recording), batch_s, _make_scalars)
    for event in recording.events():
        log.set_time(paths.SESSION_TIME, duration=np.timedelta64(event.session_time, "ns"))
        log.log("events", rr.TextLog(repr(event.body)))
    log.disconnect()
    return output.stat().st_size


def _list_poses(states: list[RecordedState], origin_utc_ns: int) -> Iterator[_Row]:
    """Yield the pose (`x y z qw qx qy qz`) of every moving body and device at every state."""
    for state in states:
        moment = _make_moment(state, origin_utc_ns)
        for body, pose in zip(state.bodies, state.poses.tolist(), strict=True):
            if body.moving:
                yield f"bodies/{escape_entity_part(body.name)}", moment, pose
        for item in state.presence:
            yield f"people/{item.participant}/{item.device}", moment, [*item.pose.p, *item.pose.q]


def _list_scalars(recording: Recording) -> Iterator[_Row]:
    """Yield the values of what the recording plots: joints, grippers, speeds, delays."""
    for file in recording.readable_files:
        for chunk in read_chunks(file, (f"{paths.ROBOTS}/**", f"{paths.METRICS}/**")):
            batch = chunk.to_record_batch()
            if _SCALARS not in batch.schema.names:
                continue
            times = zip(*(read_index(batch, timeline) for timeline in _TIMELINES), strict=True)
            for moment, values in zip(times, batch.column(_SCALARS).to_pylist(), strict=True):
                yield str(chunk.entity_path), Moment(*moment), values


def _make_moment(state: RecordedState, origin_utc_ns: int) -> Moment:
    time_ns = state.session_time
    return Moment(state.step, round(state.sim_time * 1e9), time_ns, time_ns + origin_utc_ns)


def _make_transforms(poses: NDArray[np.float64]) -> Any:
    numbers = poses.astype(np.float32)
    return rr.Transform3D.columns(translation=numbers[:, :3], quaternion=numbers[:, [4, 5, 6, 3]])


def _make_scalars(values: NDArray[np.float64]) -> Any:
    return rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))


def _send(
    log: rr.RecordingStream, rows: Iterable[_Row], batch_s: float, make_columns: Callable[[NDArray[np.float64]], Any]
) -> None:
    """Send the rows of every entity in batches."""

    def find_batch(row: _Row) -> tuple[str, int]:
        return row[0], row[1].session_ns // round(batch_s * 1e9)

    for (entity, _), batch in itertools.groupby(sorted(rows, key=find_batch), find_batch):
        _, moments, values = zip(*batch, strict=True)
        times: NDArray[np.int64] = np.array(moments, np.int64).T
        columns = make_columns(np.array(values, np.float64))
        rr.send_columns(entity, to_time_columns(times), [*columns], recording=log, strict=True)


# --- the session that is killed ---------------------------------------------------------------------------------------


#: Moving bodies: those that fly, and ten of each of the two arms.
BODIES: Final = 50
OPERATORS: Final = 2
#: Age of the newest row at its write [ns] from which on a recorder has caught up.
CURRENT_NS: Final = 250_000_000


def make_record_scene(seed: int) -> Any:
    """Return an `mujoco.MjSpec` with two arms and as many flying bodies as make `BODIES` that move."""
    spec = free_bodies_scene(BODIES - 10 * OPERATORS, seed)
    home = spec.key("home")
    qpos, qvel = list(home.qpos), list(home.qvel)
    spec.delete(home)
    for i, name in enumerate(arm_names(OPERATORS)):
        arm = mujoco.MjSpec.from_file(str(ARM_FILE))
        frame = place_arm(spec, compute_circle_radius(OPERATORS), compute_bearing(i, OPERATORS))
        frame.attach_body(arm.body("base"), f"{name}/", "")
        qpos += [*ARM_HOME, FINGER_OPEN, FINGER_OPEN]
        qvel += [0.0] * (len(ARM_HOME) + 2)
    spec.add_key(name="home", qpos=qpos, qvel=qvel, ctrl=[*ARM_HOME, FINGER_OPEN] * OPERATORS)
    return spec


class RecordedSession(Plugin):
    """Plug-in that runs a recorded session of the scene with its operators. `path`: first file of the recording."""

    def __init__(self, path: str, seed: int) -> None:
        model = make_record_scene(seed).compile()
        self._session = Session(model, config=make_session_config(record=Path(path)))
        self._session.start()
        job = Job(self._session.address, self._session.origin_ns, "", tuple(make_operators(arm_names(OPERATORS))))
        self._operators = PluginProcess(CLIENTS, job)
        self._session.run(seconds=START_S, until=self._operators.has_answered)
        self._operators.read()
        self._known = 0
        self._calls = select.poll()
        self._calls.register(sys.stdin.fileno(), select.POLLIN)

    def poll(self) -> None:
        """Run the session until the next call: every begin of a run costs it a moment."""
        self._session.run(until=lambda: self._calls.poll(0))

    def wait_until_written(self, timeout_s: float) -> tuple[int, int]:
        """Run until a recorder that is new has written the rows that waited for it.

        Returns:
            Its process id, 0 if there is none; and session time zero on CLOCK_MONOTONIC [ns].
        """
        due_ns = 0

        def is_written() -> bool:
            nonlocal due_ns
            feed, now_ns = self._session.processes.feed, self._session.clock()
            if now_ns < due_ns or feed is None:
                return False
            due_ns = now_ns + 20_000_000
            last = feed.stats.recorder
            if last is None or last.instance == self._known or last.written < 0 or not 0 < last.lag_ns < CURRENT_NS:
                return False
            self._known = last.instance
            return True

        before = self._known
        self._session.run(seconds=timeout_s, until=is_written)
        recorder = self._session.processes.recorder
        return recorder.pid if recorder and self._known != before else 0, self._session.origin_ns

    def close(self) -> None:
        """Close the session."""
        self._operators.close()
        self._session.close()
