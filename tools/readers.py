"""Load exported data sets in the programs that train on them, and compare every number and label.

    make readers
    python tools/readers.py --work FOLDER [--recording session.rrd]

A recording of `iris-session demo cloud` is exported, then read in an environment of its own (FOLDER/venv) with
LeRobot's `LeRobotDataset` and `lerobot-doctor`, robomimic's `SequenceDataset`, and the reader of `mcap`. What they give
is compared with what was exported (`reader_checks.py`, which runs there); a copy of the set in which one column is
shifted by one frame must be noticed. Exit status 0 if all agree.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from PIL import Image
from pyarrow import parquet

from iris_session.dataset.cameras import CameraSet, PictureSpec, parse_cameras
from iris_session.dataset.episodes import LABELS, PlanOptions, make_plan
from iris_session.dataset.frames import FrameReader, Table, make_schema
from iris_session.recording import Recording
from iris_session.replay.simulation import Replay
from iris_session.session.core import SessionCore

#: What the environment has: the newest LeRobot that this Python can have.
PACKAGES = ("lerobot", "lerobot-doctor", "robomimic", "mcap")
FPS = 30
CAMERAS = "operator,top=0,0,2.4->0,0.01,0.7:50"
#: A camera whose pictures were recorded, and its stream.
REAL, STREAM = "front", "room-front"
AGE = f"pictures.{REAL}.age_s"
SIZE = (160, 120)
#: Every so many pictures, one is compared.
EVERY = 20
#: Columns that are shifted by one frame in a copy of the set, by format.
SHIFTED = {
    "lerobot": ("action", "robots.left.joint_positions", "objects.hammer.contact_force", "session_time_ns", AGE),
    "robomimic": ("actions_ctrl", "states", "robots.left.joint_positions", "objects.hammer.contact_force", AGE),
    "mcap": ("robots.left.joint_positions", "objects.hammer.contact_force", "session_time_ns", AGE),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, help="folder for environment and data; kept (default: a temporary one)")
    parser.add_argument("--recording", type=Path, help="a recording of `demo cloud` (default: one is made)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work: Path = (arguments.work or Path(temporary)).resolve()
        work.mkdir(parents=True, exist_ok=True)
        python = make_environment(work / "venv")
        recording = work / "demo" / "session.rrd"
        shutil.rmtree(recording.parent, ignore_errors=True)
        if arguments.recording is None:
            run_iris("demo", "cloud", "--record", str(recording))
        else:  # a copy, whose curation is changed
            recording.parent.mkdir()
            shutil.copyfile(arguments.recording, recording)
        trim_to_pictures(recording)
        write_expected(recording, work / "expected.npz")
        failures = [one for to in SHIFTED for one in check(to, python, recording, work)]
        failures += run_doctor(python, work / "lerobot")
        print("\n".join(f"FAILED {one}" for one in failures) or "all readers agree")
        return 1 if failures else 0


def make_environment(folder: Path) -> Path:
    """Make the environment, or use the one that is there. Return its Python."""
    python = folder / "bin" / "python"
    if not (folder / ".made").exists():
        print(f"installing {', '.join(PACKAGES)} into {folder} ...", flush=True)
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(folder)], check=True)
        pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, *PACKAGES], check=True)
        (folder / ".made").touch()
    return python


def run_iris(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "iris_session.cli.main", *arguments], check=True)


def trim_to_pictures(recording: Path) -> None:
    """Begin the episode after the first recorded picture: the cameras of the demo start within it."""
    with Recording.open(recording) as opened:
        episode, first = opened.episodes[0], next(opened.pictures(STREAM))
    begin_s = max(0.0, (first.capture_ns - episode.start_ns) * 1e-9) + 0.1
    end_s = (episode.end_ns - episode.start_ns) * 1e-9 - 0.1
    run_iris("recording", "episodes", str(recording), "--trim", f"{episode.number}={begin_s:.2f}:{end_s:.2f}")


def write_expected(recording: Path, path: Path) -> None:
    """Write the frames of the recording and some of their pictures, before any encoding."""
    plan = make_plan([recording], PlanOptions(LABELS))
    found: dict[str, Any] = {}
    with (
        Recording.open(recording) as opened,
        CameraSet(PictureSpec(parse_cameras(CAMERAS), *SIZE, plain=True)) as cameras,
    ):
        reader = FrameReader(opened, plan.recordings[0], make_schema(Replay(opened).core, FPS))
        for i, episode in enumerate(plan.episodes):
            table = reader.read(episode, partial(keep_picture, cameras, opened, found, i, count()))
            find_recorded(opened, table, found, i)
            found |= {f"{i}|{key}": values for key, values in table.columns.items()}
            found[f"{i}|states"] = table.states
            found[f"{i}|task"] = np.array(episode.task)
            found[f"{i}|label"] = np.array(episode.label)
    np.savez(path, **found)


def find_recorded(recording: Recording, table: Table, found: dict[str, Any], episode: int) -> None:
    """Find the recorded picture of each frame: the newest that is not later."""
    pictures, times = list(recording.pictures(STREAM)), table.columns["session_time_ns"]
    captures = np.array([min(one.capture_ns, one.received_ns) for one in pictures])
    newest = np.searchsorted(captures, times, "right") - 1
    table.columns[AGE] = (times - captures[newest]) * 1e-9
    for frame in range(0, len(times), EVERY):
        image = Image.open(BytesIO(pictures[int(newest[frame, 0])].jpeg))
        found[f"{episode}|observation.images.{REAL}|{frame}"] = np.array(image.convert("RGB"))


def keep_picture(
    cameras: CameraSet,
    recording: Recording,
    found: dict[str, Any],
    episode: int,
    frames: Iterator[int],
    core: SessionCore,
) -> None:
    """Draw some of the frames."""
    frame = next(frames)
    if frame % EVERY == 0:
        for _, camera, image in cameras.draw(core, recording):
            found[f"{episode}|observation.images.{camera}|{frame}"] = image


def check(to: str, python: Path, recording: Path, work: Path) -> list[str]:
    """Export in a format, and check in the environment the set, and copies that are wrong. Return what fails."""
    folder, expected = work / to, work / "expected.npz"
    shutil.rmtree(folder, ignore_errors=True)
    labels = [
        "--labels",
        ",".join(LABELS),
        "--cameras",
        f"{CAMERAS},{REAL}={STREAM}",
        "--size",
        f"{SIZE[0]}x{SIZE[1]}",
        "--plain",
    ]
    run_iris("export", str(recording), "--to", to, "--out", str(folder), "--fps", str(FPS), *labels)
    status = run_checks(python, to, folder, expected)
    print(f"{to}: {status or 'every number, label and picture is as exported'}", flush=True)
    failures = [f"{to}: {status}"] if status else []
    for key in SHIFTED[to]:
        copy = work / "shifted"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(folder, copy)
        SHIFTS[to](copy, key)
        noticed = run_checks(python, to, copy, expected, "--numbers-only")
        print(f"{to}: {key} shifted by one frame: {noticed or 'NOT NOTICED'}", flush=True)
        failures += [] if key in noticed else [f"{to}: a shift of {key} is not noticed"]
    return failures


def run_doctor(python: Path, folder: Path) -> list[str]:
    """Run `lerobot-doctor`. Return what fails."""
    command = [python.with_name("lerobot-doctor"), "check", folder]
    doctor = subprocess.run(command, check=False, capture_output=True, text=True)
    lines = [line for line in doctor.stdout.splitlines() if line.startswith(("[", "Summary"))]
    print("\n".join(lines), flush=True)
    return ["lerobot-doctor: a check fails"] if "[FAIL]" in doctor.stdout or not lines else []


def run_checks(python: Path, to: str, folder: Path, expected: Path, *options: str) -> str:
    """Return the first difference that a reader finds, empty for none."""
    script = Path(__file__).with_name("reader_checks.py")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"HF_HUB_OFFLINE": "1", "HF_HOME": str(expected.parent / "hf")}
    command = [python, script, to, folder, expected, *options]
    done = subprocess.run(command, check=False, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"the reader failed:\n{done.stderr[-3000:]}")
    return str(json.loads(done.stdout.splitlines()[-1])["difference"])


def shift_lerobot(folder: Path, key: str) -> None:
    """Shift a column by one frame: the first value stands twice, the last is gone."""
    path = folder / "data/chunk-000/file-000.parquet"
    table = parquet.read_table(path)
    values = table.column(key).combine_chunks()
    rows = [0, *range(len(values) - 1)]
    parquet.write_table(table.set_column(table.column_names.index(key), key, values.take(rows)), path)


def shift_robomimic(folder: Path, key: str) -> None:
    with h5py.File(folder / "episodes/episode_000000.hdf5", "r+") as file:
        data = file[key] if key in file else file[f"obs/{key}"]
        values = data[:]
        data[1:] = values[:-1]


def shift_mcap(folder: Path, key: str) -> None:
    path = folder / "episodes/episode_000000.mcap"
    owner, _, name = key.rpartition(".")
    topic, before, channels = "/" + owner.replace(".", "/", 1) if owner else "/time", None, {}
    with path.open("rb") as file:
        messages = list(make_reader(file).iter_messages())
        (metadata,) = make_reader(path.open("rb")).iter_metadata()
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata(metadata.name, metadata.metadata)
        for schema, channel, message in messages:
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            data = message.data
            if channel.topic == topic:
                values = json.loads(data)
                before, values[name] = values[name], values[name] if before is None else before
                data = json.dumps(values).encode()
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time)
        writer.finish()


SHIFTS = {"lerobot": shift_lerobot, "robomimic": shift_robomimic, "mcap": shift_mcap}


if __name__ == "__main__":
    sys.exit(main())
