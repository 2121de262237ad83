"""`bench export`: what making a data set of a recording costs, episode by episode.

A session in which an agent swings an arm is computed and recorded, without processes and as fast as it goes; then the
command `export` makes a set of LeRobot of it, with two cameras. Where a Python with LeRobot is given, LeRobot's own
`add_frame` and `save_episode` write the same pictures as our writer, in the same run.
"""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.authority import AuthorityConfig
from iris_session.bench.operator import OPENING_STEPS, ScriptedOperator
from iris_session.bench.report import BenchError, BenchReport, make_bar
from iris_session.control import ControlConfig
from iris_session.dataset.cameras import PictureSpec, parse_cameras
from iris_session.dataset.episodes import make_plan
from iris_session.dataset.frames import make_schema
from iris_session.dataset.run import EpisodeMaker, EpisodeTask
from iris_session.dataset.video import PictureStats, VideoWriter
from iris_session.demo.scenes import scene_path
from iris_session.journal.messages import Batch
from iris_session.journal.rows import pack_model, seal_keyframe
from iris_session.physics import find_objects, find_robots, load_model
from iris_session.protocol.client_messages import Episode
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import Entry
from iris_session.protocol.names import EpisodeAction
from iris_session.recording import CLOSED, Keyframe, Recording, SessionHeader, header_root, make_row
from iris_session.recording.writer import RrdWriter
from iris_session.replay.simulation import Replay
from iris_session.session.core import CoreConfig, SessionCore
from iris_session.system.process import child_environment, module_command

TICK_NS: Final = 2_000_000
TICKS_PER_S: Final = 500
#: Ticks between samples, keyframes, and rows that are written together.
SAMPLE_TICKS: Final = 7
KEYFRAME_TICKS: Final = 2500
BATCH_TICKS: Final = 50
#: Ticks between two episodes.
PAUSE_TICKS: Final = 50
CAMERAS: Final = "operator,top=0,0,2.4->0,0.01,0.7:50"
N_CAMERAS: Final = 2
WIDTH: Final = 320
HEIGHT: Final = 240
FPS: Final = 30
#: First and last episode take the same time, within this.
MAX_RATIO: Final = 1.2
#: Frames that both writers write.
REFERENCE_FRAMES: Final = 300
_AGENT: Final = ScriptedOperator("desktop", "left")


def run_export(
    episodes: int = 20,
    seconds: float = 20.0,
    shadows: bool = False,
    jobs: int = 1,
    python: str = "",
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Measure the export of one recording."""
    with tempfile.TemporaryDirectory(prefix="iris-bench-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        progress(f"computing a session with {episodes} episodes of {seconds:g} s")
        record_session(folder / "session.rrd", episodes, max(1, round(seconds * TICKS_PER_S)))
        progress("exporting it")
        options = ["--fps", str(FPS), "--cameras", CAMERAS, "--size", f"{WIDTH}x{HEIGHT}", "--jobs", str(jobs)]
        options += [] if shadows else ["--plain"]
        command = ["export", str(folder / "session.rrd"), "--to", "lerobot", "--out", str(folder / "set"), "--json"]
        began = time.perf_counter()
        done = subprocess.run(
            module_command("iris_session.cli.main", *command, *options),
            check=False,
            capture_output=True,
            text=True,
            env=child_environment(),
        )
        took_s = time.perf_counter() - began
        if done.returncode:
            raise BenchError(f"the export failed: {' '.join(done.stderr.split())[-300:]}")
        report = json.loads(done.stdout)
        rss_mib = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0  # of the largest process, in KiB
        progress("making early and late episodes in turn")
        pictures_of = PictureSpec(parse_cameras(CAMERAS), WIDTH, HEIGHT, plain=not shadows)
        growth = measure_growth(folder / "session.rrd", folder / "made", pictures_of)
        results = summarize_export(report, took_s, rss_mib, growth)
        progress("writing pictures alone")
        pictures = make_pictures()
        results["write_ms_per_frame"] = round(measure_writer(folder, pictures), 3)
        reference = measure_lerobot(Path(python), folder, pictures) if python else None
    bars = [make_bar(results, "first_to_last_ratio", "<=", MAX_RATIO)]
    if reference is not None:
        bars.append(make_bar(results, "write_ms_per_frame", "<=", reference["write_ms_per_frame"]))
    params: dict[str, Any] = {"cameras": N_CAMERAS, "size": f"{WIDTH}x{HEIGHT}", "fps": FPS}
    params["lerobot"] = python or "none: give a Python with LeRobot, --python, for a reference"
    return BenchReport(results, bars, reference, params)


def measure_growth(recording: Path, folder: Path, pictures: PictureSpec) -> tuple[float, float]:
    """Return the processor time of making an early and a late episode [s]: means over a tenth of the episodes.

    One of each is made in turn, so that the load of the machine, which changes processor time too, meets both alike.
    """
    plan = make_plan([recording])
    with Recording.open(recording, warn=False) as opened:
        schema = make_schema(Replay(opened).core, FPS)
    n = len(plan.episodes)
    few = max(1, n // 10)
    makers, seconds = (EpisodeMaker(), EpisodeMaker()), [0.0, 0.0]
    for i in range(few + 1):  # the first of each opens files and renderer
        for which, number in enumerate((i, n - few - 1 + i)):
            where = str(folder / f"{which}-{i}")
            task = EpisodeTask(number, "lerobot", plan.recordings[0], plan.episodes[number], schema, pictures, where)
            made = makers[which].make(task)
            seconds[which] += made.shares.cpu_s / few if i else 0.0
    for maker in makers:
        maker.close()
    return seconds[0], seconds[1]


def summarize_export(
    report: dict[str, Any], took_s: float, rss_mib: float, growth: tuple[float, float]
) -> dict[str, Any]:
    """Return the results. First and last: processor time of an episode, made (`measure_growth`) and closed."""
    closing, shares = report["closing"], report["shares"]
    few = max(1, len(closing) // 10)
    first, last = growth[0] + float(np.median(closing[:few])), growth[1] + float(np.median(closing[-few:]))
    return {
        "episodes_per_minute": round(60.0 * len(closing) / took_s, 2),
        "first_to_last_ratio": round(max(first, last) / min(first, last), 3),
        "first_cpu_s": round(first, 3),
        "last_cpu_s": round(last, 3),
        "peak_rss_mib": round(rss_mib, 1),
        **{f"share_{name}": round(share, 4) for name, share in shares.items()},
        "frames": report["frames"],
    }


# --- the session ------------------------------------------------------------------------------------------------------


def record_session(path: Path, episodes: int, ticks: int) -> None:
    """Compute a session in which an agent swings an arm in episodes of so many ticks, and write its recording."""
    model = load_model(scene_path("handover"))
    config = CoreConfig(AuthorityConfig(), ControlConfig(), find_robots(model).robots, find_objects(model))
    core = SessionCore(model, config)
    header = SessionHeader(
        session_id="bench",
        session_name="bench",
        recording_class=CLOSED,
        tick_period_ns=TICK_NS,
        config=msgspec.msgpack.encode(core.current_config()),
        model=pack_model(core.world.encode_model()),
        robots=core.scene.robots,
        objects=core.scene.objects,
        bodies=core.world.bodies,
    )
    chain = header_root(header)
    writer = RrdWriter(path, "bench")
    writer.write_header(header)
    batch = Batch(keyframes=[_make_keyframe(core, -1, chain)])
    period = ticks + PAUSE_TICKS
    for step in range(PAUSE_TICKS + episodes * period):
        now_ns = (step + 1) * TICK_NS
        entries = list(_make_entries(step, now_ns, ticks, period))
        outcome = core.step(now_ns, entries, 1)
        row = make_row(chain, step, now_ns, 1, entries, outcome.digest, b"")
        chain = row.chain
        batch.rows.append(row)
        batch.events += outcome.decision.events
        if step % KEYFRAME_TICKS == KEYFRAME_TICKS - 1:
            batch.keyframes.append(_make_keyframe(core, step, chain))
        if len(batch.rows) == BATCH_TICKS:
            writer.add(batch)
            batch = Batch()
    writer.add(batch)
    writer.close()


def _make_keyframe(core: SessionCore, step: int, chain: bytes) -> Keyframe:
    state = core.snapshot()
    return seal_keyframe(Keyframe(step, state.plant, state.authority, state.controller, state.status), chain)


def _make_entries(step: int, now_ns: int, ticks: int, period: int) -> Iterator[Entry]:
    """Yield what the agent sends in a step."""
    yield from _AGENT.make_opening(step, now_ns)
    within = (step - PAUSE_TICKS) % period
    if step >= PAUSE_TICKS and within in (0, ticks):
        action = EpisodeAction.SUCCESS if within else EpisodeAction.START
        yield _AGENT.make_entry(Episode(100 + step, action, "swing the arm", countdown_ns=0), now_ns)
    if step > OPENING_STEPS and step % SAMPLE_TICKS == 0:
        pose = Pose((0.0, 0.1 * math.sin(now_ns * 1e-9), 1.0), (1.0, 0.0, 0.0, 0.0))
        yield _AGENT.make_entry(_AGENT.make_sample(pose, now_ns, step >= PAUSE_TICKS), now_ns)


# --- writers alone ----------------------------------------------------------------------------------------------------


def make_pictures() -> NDArray[np.uint8]:
    """Return moving pictures, shape (REFERENCE_FRAMES, HEIGHT, WIDTH, 3): as smooth and as noisy as drawn ones."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    frames = np.arange(REFERENCE_FRAMES)[:, None, None]
    waves = 127.0 + 60.0 * np.sin((x + 2 * frames) / 23.0) + 40.0 * np.cos((y - frames) / 17.0)
    grey = waves.astype(np.uint8)
    return np.stack([grey, np.roll(grey, 9, axis=2), 255 - grey], axis=-1)


def measure_writer(folder: Path, pictures: NDArray[np.uint8]) -> float:
    """Return the time of our writer for a frame of two cameras, with statistics [ms]."""
    began = time.perf_counter()
    writers = [VideoWriter(folder / f"{i}.mp4", FPS, WIDTH, HEIGHT) for i in range(N_CAMERAS)]
    stats = [PictureStats() for _ in writers]
    for picture in pictures:
        for writer, stat in zip(writers, stats, strict=True):
            writer.add(picture)
            stat.add(picture)
    for writer, stat in zip(writers, stats, strict=True):
        writer.close()
        stat.make()
    return (time.perf_counter() - began) * 1e3 / len(pictures)


def measure_lerobot(python: Path, folder: Path, pictures: NDArray[np.uint8]) -> dict[str, float]:
    """Return the time of LeRobot's `add_frame` and `save_episode` for the same frames [ms]."""
    np.save(folder / "pictures.npy", pictures)
    command = [str(python), "-c", _LEROBOT, str(folder / "pictures.npy"), str(folder / "lerobot"), str(FPS)]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise BenchError(f"{python} cannot write a set of LeRobot: {' '.join(done.stderr.split())[-300:]}")
    return {"write_ms_per_frame": round(float(done.stdout.split()[-1]), 3)}


_LEROBOT: Final = """
import sys, time
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

pictures, folder, fps = np.load(sys.argv[1]), sys.argv[2], int(sys.argv[3])
image = {"dtype": "video", "shape": pictures.shape[1:], "names": ["height", "width", "channels"]}
vector = {"dtype": "float32", "shape": (16,), "names": None}
features = {"observation.images.a": image, "observation.images.b": image, "observation.state": vector, "action": vector}
data = LeRobotDataset.create("local/set", fps, features, root=folder, use_videos=True)
began = time.perf_counter()
zeros = np.zeros(16, np.float32)
for picture in pictures:
    frame = {"observation.images.a": picture, "observation.images.b": picture}
    data.add_frame({**frame, "observation.state": zeros, "action": zeros, "task": "swing the arm"})
data.save_episode()
data.finalize()
print((time.perf_counter() - began) * 1e3 / len(pictures))
"""
