"""Support for the tests: a small deterministic session, a real recorder process, and files to damage."""

from __future__ import annotations

import hashlib
import os
import struct
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from iris_session.journal.messages import Batch, RecorderConfig
from iris_session.journal.rows import SNAPSHOTS, seal_keyframe
from iris_session.journal.verification import Models
from iris_session.protocol.client_messages import Marker, Sample
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import Entry, encode_entry
from iris_session.protocol.server_messages import BodyInfo, Event, MarkerAdded
from iris_session.protocol.steps import Decision, PresenceItem
from iris_session.recording import (
    CLOSED,
    OPEN,
    Keyframe,
    RecorderFeed,
    SessionHeader,
    header_root,
    make_row,
    pack_model,
)
from iris_session.recording.process import RecorderLoop
from iris_session.recording.writer import RrdWriter
from iris_session.rrd.rerun_tool import find_rerun

TICK_NS = 2_000_000
XML = """<mujoco><option timestep="0.002"/><worldbody><light pos="0 0 3"/>
<geom name="floor" type="plane" size="0 0 .1" rgba=".8 .8 .8 1"/>
<body name="ball" pos="0 0 1"><freejoint/><geom name="g/ball" type="sphere" size=".1" mass="1"/></body>
<body name="arm/link 1" pos="0 1 1"><joint axis="0 1 0"/>
 <geom type="capsule" fromto="0 0 0 .4 0 0" size=".04"/><geom type="cylinder" size=".05 .1" pos=".4 0 0"/>
 <body name="tip" pos=".4 0 0"><geom type="box" size=".02 .03 .04"/><geom type="ellipsoid" size=".02 .03 .04"/></body>
</body><body name="post" pos="1 1 0"><geom type="box" size=".1 .1 .5" group="3"/></body>
</worldbody></mujoco>"""


class SmallCore:
    """A minimal session: real physics and a hash of every entry, bit-exact, with snapshots."""

    def __init__(self, header: SessionHeader | None = None, models: Models | None = None) -> None:
        self.model = mujoco.MjModel.from_xml_string(XML)
        self.data = mujoco.MjData(self.model)
        self.memory = b"\0" * 16
        mujoco.mj_forward(self.model, self.data)

    def step(self, now_ns: int, entries: Sequence[Entry], n_ticks: int, plant: bytes = b"") -> bytes:
        h = hashlib.blake2b(self.memory + struct.pack("<q", now_ns), digest_size=16)
        for entry in entries:
            h.update(encode_entry(entry))
        self.memory = h.digest()
        if plant:
            self._set(plant)
        self.data.xfrc_applied[1, 0] = self.memory[0] / 64.0
        for _ in range(n_ticks):
            mujoco.mj_step(self.model, self.data)
        return hashlib.blake2b(self.memory + self.state(), digest_size=16).digest()

    def state(self) -> bytes:
        spec = mujoco.mjtState.mjSTATE_INTEGRATION
        out = np.empty(mujoco.mj_stateSize(self.model, spec))
        mujoco.mj_getState(self.model, self.data, out, spec)
        return out.tobytes()

    def _set(self, state: bytes) -> None:
        mujoco.mj_setState(self.model, self.data, np.frombuffer(state), mujoco.mjtState.mjSTATE_INTEGRATION)

    def keyframe(self, step: int) -> Keyframe:
        return Keyframe(step, self.state(), self.memory, b"controller", b"status")

    def find_differences(self, keyframe: Keyframe) -> list[str]:
        mine = self.keyframe(keyframe.step)
        return [name for name in SNAPSHOTS if getattr(mine, name) != getattr(keyframe, name)]

    def restore(self, keyframe: Keyframe) -> None:
        self._set(keyframe.plant)
        self.memory = keyframe.authority


def make_header(recording_class: str = CLOSED) -> SessionHeader:
    """Return the header of the small session, with its real model."""
    model = mujoco.MjModel.from_xml_string(XML)
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    names = [mujoco.mj_id2name(model, 1, i) for i in range(1, model.nbody)]
    return SessionHeader(
        session_id="s1",
        session_name="small",
        recording_class=recording_class,
        tick_period_ns=TICK_NS,
        config=b"config",
        model=pack_model(buffer.tobytes()),
        bodies=tuple(BodyInfo(i + 1, name, name != "post") for i, name in enumerate(names)),
    )


def make_entries(step: int) -> list[Entry]:
    """Return zero to three entries, different in every step."""
    sample = Sample(
        "controller/left", "pose", step, step * TICK_NS, 1, 1, 1, pose=Pose((step / 3, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
    )
    return [Entry(7, 7, step * TICK_NS, sample), Entry(8, 8, step * TICK_NS, Marker(step, f"m{step}"))][: step % 3]


class SmallSession:
    """Steps a `SmallCore` and feeds a recorder like a session."""

    def __init__(self, feed: RecorderFeed, keyframe_steps: int = 100, **header: object) -> None:
        self.feed = feed
        self.core = SmallCore()
        self.header = make_header(**header)  # type: ignore[arg-type]
        self.chain = header_root(self.header)
        self.step_count = 0
        self.poses: list[np.ndarray] = []
        self._keyframe_steps = keyframe_steps
        feed.send_header(self.header)
        feed.add_keyframe(self.core.keyframe(-1), self.chain)

    def take(self, steps: int) -> None:
        for _ in range(steps):
            self._one()

    def _one(self) -> None:
        step, feed, core = self.step_count, self.feed, self.core
        now_ns = (step + 1) * TICK_NS
        entries = make_entries(step)
        plant = core.state() if self.header.recording_class == "open" else b""
        digest = core.step(now_ns, entries, 1, plant)
        row = make_row(self.chain, step, now_ns, 1, entries, digest, plant)
        self.chain = row.chain
        feed.add_row(row)
        head = PresenceItem("p1", "head", Pose((0.0, 0.0, 1.0 + step / 1000), (1.0, 0.0, 0.0, 0.0)), now_ns)
        events = ()
        if step % 50 == 0:
            events = (Event(step // 50 + 1, step, now_ns, MarkerAdded("p1", f"event {step}")),)
        feed.add_decision(step, now_ns, Decision(commands=(), events=events, presence=(head,)))
        feed.add_metric(step, now_ns, "late_ms", step / 10)
        if step % 8 == 0:
            poses = np.concatenate([core.data.xpos[1:], core.data.xquat[1:]], axis=1)
            self.poses.append(poses.copy())
            feed.add_state(step, step + 1, core.data.time, now_ns, poses)
        if step % self._keyframe_steps == self._keyframe_steps - 1 or feed.wants_keyframe:
            feed.add_keyframe(core.keyframe(step), self.chain)
        self.step_count += 1


class LoopRecorder:
    """A recorder whose loop runs when the test says so, and the feed of its session, over all parts."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.folder, self.path = folder, folder / "session.rrd"
        self._options = options
        self.loop = self.begin(1)
        self.feed = RecorderFeed(f"ipc://{folder}/f")

    def begin(self, part: int, **options: Any) -> RecorderLoop:
        """Start the recorder of a part, as the process does."""
        endpoints = (f"ipc://{self.folder}/f", f"ipc://{self.folder}/s")
        config = RecorderConfig(str(self.path), part, "r", *endpoints, 0, os.getppid(), **(self._options | options))
        self.loop = RecorderLoop(config)
        return self.loop

    def pump(self, condition: Callable[[], object] | None = None) -> None:
        """Drain and write until a condition holds; without one until all batches of the feed are in the file."""
        until = condition or (lambda: not self.feed._window and not self.feed._backlog)
        self.feed.flush()
        self.loop._send_status(self.loop._received)
        for _ in range(500):
            self.loop._feed.poll(20)
            self.loop._drain()
            self.loop._flush()
            self.loop._write_assets()
            self.loop._send_status(self.loop._received)
            self.feed._socket.poll(20)
            self.feed.flush()
            if until():
                return
        pytest.fail("the recorder does not get there")

    def kill(self) -> None:
        """End the loop as a kill does: nothing more is written, and the lock is released."""
        if self.loop._context.closed:
            return
        self.loop._syncer.stop()
        self.loop._context.destroy(linger=0)
        stream: Any = self.loop._writer.stream
        stream._file.close()
        stream.recording.disconnect()
        assert self.loop._lock is not None
        self.loop._lock.release()

    def finish(self) -> None:
        """Close the file."""
        self.loop._stopping = True
        self.loop._close_file()
        self.kill()


@contextmanager
def loop_recorder(**options: Any) -> Iterator[LoopRecorder]:
    """Yield a recorder in a folder of its own: the path of a socket must be short."""
    with tempfile.TemporaryDirectory(prefix="iris-") as folder:
        one = LoopRecorder(Path(folder), **options)
        try:
            yield one
        finally:
            one.feed.close(0.0)
            one.kill()


def wait_until(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    """Poll `condition` until it holds; fail after `timeout_s`."""
    until = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < until, "the condition did not come true"
        time.sleep(0.01)


def journal(steps: int, recording_class: str = CLOSED, keyframe_steps: int = 50) -> tuple[SessionHeader, Batch]:
    """Return header, rows and keyframes of a session."""
    core, header = SmallCore(), make_header(recording_class)
    chain = header_root(header)
    batch = Batch(keyframes=[seal_keyframe(core.keyframe(-1), chain)])
    for step in range(steps):
        if recording_class == OPEN:
            core.data.qvel[0] = np.sin(step)  # what only the user's loop knows
        plant = core.state() if recording_class == OPEN else b""
        now_ns, entries = (step + 1) * TICK_NS, make_entries(step)
        digest = core.step(now_ns, entries, 1, plant)
        batch.rows.append(make_row(chain, step, now_ns, 1, entries, digest, plant))
        chain = batch.rows[-1].chain
        if step % keyframe_steps == keyframe_steps - 1:
            batch.keyframes.append(seal_keyframe(core.keyframe(step), chain))
    return header, batch


def write(path: Path, header: SessionHeader, batch: Batch, rows_per_chunk: int = 20, *, reason: str = "") -> Path:
    """Write a finished file with this content."""
    writer = RrdWriter(path, "id")
    writer.write_header(header)
    for i in range(0, len(batch.rows), rows_per_chunk):
        last = i + rows_per_chunk >= len(batch.rows)
        keyframes = [k for k in batch.keyframes if k.step < i + rows_per_chunk or last]
        batch.keyframes = [k for k in batch.keyframes if k not in keyframes]
        writer.add(Batch(rows=batch.rows[i : i + rows_per_chunk], keyframes=keyframes))
        writer.flush()
    writer.close(reason=reason)
    return path


def read(path: Path) -> dict[str, list[Any]]:
    """Read a file with Rerun. Return its record batches by entity path."""
    from rerun.chunk import RrdReader

    found: dict[str, list[Any]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for chunk in RrdReader(str(path)).stream():
            found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found


def has_index(path: Path) -> bool:
    """Return whether Rerun finds a valid index in a file."""
    return subprocess.run([find_rerun(), "rrd", "verify", path], capture_output=True, check=False).returncode == 0


def column(batches: list[Any], name: str) -> list[Any]:
    """Return the values of a column by row."""
    return [value for batch in batches for value in batch.column(name).to_pylist()]
