"""Small recordings of real sessions, written without processes, and what the sessions had at every step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.demo.scenes import scene_path
from iris_session.journal.messages import Batch, SceneModel
from iris_session.journal.rows import pack_model, seal_keyframe
from iris_session.physics.load import encode_model, load_model
from iris_session.protocol.entries import Entry
from iris_session.recording import CLOSED, OPEN, Continues, JournalRow, Keyframe, SessionHeader, header_root, make_row
from iris_session.recording.writer import RrdWriter
from iris_session.session.core import SessionCore, read_plant_state
from tests.session.play import TICK_NS, entries, make_core

KEYFRAME_STEPS = 20
#: Times of steps are off by up to this, as on a machine that has other things to do.
JITTER_NS = 400_000


def step_ns(step: int) -> int:
    return (step + 1) * TICK_NS + (step * 7919) % JITTER_NS


@dataclass
class Played:
    """A session that was played. `qpos`, `ctrl`, ...: after every step; of open ones `qpos` at its beginning."""

    path: Path
    header: SessionHeader
    core: SessionCore
    batch: Batch = field(default_factory=Batch)
    samples: list[Entry] = field(default_factory=list)
    media: list[list[bytes]] = field(default_factory=list)
    qpos: list[NDArray[np.float64]] = field(default_factory=list)
    qvel: list[NDArray[np.float64]] = field(default_factory=list)
    ctrl: list[NDArray[np.float64]] = field(default_factory=list)
    tips: list[NDArray[np.float64]] = field(default_factory=list)
    bodies: list[NDArray[np.float64]] = field(default_factory=list)
    session_time: list[int] = field(default_factory=list)

    def columns(self, robot: int = 0) -> list[int]:
        """Return where the joints of a robot are in `qpos`."""
        return [int(self.core.world.model.joint(name).qposadr[0]) for name in self.header.robots[robot].joints]

    def write(self) -> Path:
        """Write the recording, closed as after a session."""
        writer = RrdWriter(self.path, "id")
        writer.write_header(self.header)
        for entry in self.samples:
            writer.add_sample(entry.connection, entry.receive_ns, msgspec.msgpack.encode(entry.message))
        for message in self.media:
            writer.add_media(message)
        scenes = {one.step: one for one in self.batch.scenes}
        keyframes = self.batch.keyframes
        for i, row in enumerate(self.batch.rows):
            after = [one for one in keyframes if one.step == row.step or (i == 0 and one.step < row.step)]
            events = [one for one in self.batch.events if one.session_time == row.now_ns]
            loaded = [scenes[row.step - 1]] if row.step - 1 in scenes else []
            states = [one for one in self.batch.states if one.step == row.step]
            writer.add(Batch(rows=[row], keyframes=after, events=events, scenes=loaded, states=states))
        writer.close()
        return self.path


def make_drawn_core(scene: str = "handover", **authority: object) -> SessionCore:
    """Make a core of a scene that is drawn quickly in software: with coarse shadows, without smooth edges.

    Its sites, which are hidden at first, are large enough to be seen.
    """
    model = load_model(scene_path(scene))
    model.site_size[:] = 0.05
    model.vis.quality.shadowsize, model.vis.quality.offsamples = 64, 0
    return make_core(model, **authority)


def make_header(core: SessionCore, recording_class: str, continues: Continues | None = None) -> SessionHeader:
    return SessionHeader(
        session_id="s1",
        session_name="small",
        recording_class=recording_class,
        tick_period_ns=TICK_NS,
        config=msgspec.msgpack.encode(core.current_config()),
        model=pack_model(core.world.encode_model()),
        robots=core.scene.robots,
        objects=core.scene.objects,
        bodies=core.world.bodies,
        continues=continues,
    )


def keyframe_of(core: SessionCore, step: int, chain: bytes) -> Keyframe:
    state = core.snapshot()
    return seal_keyframe(Keyframe(step, state.plant, state.authority, state.controller, state.status), chain)


def play(
    path: Path,
    steps: int = 200,
    *,
    recording_class: str = CLOSED,
    make_entries: Callable[[int], Sequence[Entry]] = entries,
    scenes: Sequence[SceneModel] = (),
    core: SessionCore | None = None,
    make_plant: Callable[[int], bytes] | None = None,
) -> Played:
    """Play a session in which ann joins, takes the left robot and moves it, and return it, to be written.

    Class `open`: the plant is advanced here, and moved as only its owner knows; or it is that of `make_plant`.
    """
    recording_class = OPEN if make_plant else recording_class
    core = core or make_core(user_owned_loop=recording_class == OPEN)
    header = make_header(core, recording_class)
    chain = header_root(header)
    played = Played(path, header, core, Batch(keyframes=[keyframe_of(core, -1, chain)], scenes=list(scenes)))
    model, data = core.world.model, core.world.make_initial_data()
    for step in range(steps):
        plant = make_plant(step) if make_plant else b""
        if recording_class == OPEN and make_plant is None:
            data.qvel[core.world.model.joint("right/joint1").dofadr[0]] = np.sin(step / 20)
            plant = read_plant_state(model, data)
        chain = _take(played, step, list(make_entries(step)), plant, chain)
        if recording_class == OPEN and make_plant is None:
            data.ctrl[:] = core.world.data.ctrl
            mujoco.mj_step(model, data)
    return played


def _take(played: Played, step: int, taken: list[Entry], plant: bytes, chain: bytes) -> bytes:
    core, now_ns = played.core, step_ns(step)
    # A step without a plant in class `open` has no tick.
    n_ticks = int(bool(plant) or not core.config.authority.user_owned_loop)
    outcome = core.step(now_ns, taken, n_ticks, plant)
    row = make_row(chain, step, now_ns, n_ticks, taken, outcome.digest, plant)
    played.batch.rows.append(row)
    played.batch.events += outcome.decision.events
    played.samples += [entry for entry in taken if type(entry.message).__name__ == "Sample"]
    data = core.world.data
    for numbers, now in ((played.qpos, data.qpos), (played.qvel, data.qvel), (played.ctrl, data.ctrl)):
        numbers.append(now.copy())
    played.tips += [np.array(data.site(robot.site).xpos) for robot in core.scene.robots[:1]]
    played.bodies.append(np.concatenate([data.xpos, data.xquat], axis=1))
    played.session_time.append(now_ns)
    if step % KEYFRAME_STEPS == KEYFRAME_STEPS - 1:
        played.batch.keyframes.append(keyframe_of(core, step, row.chain))
    return row.chain


def scene_model(model: mujoco.MjModel, model_hash: str, step: int, core: SessionCore) -> SceneModel:
    """Return the record of a scene that is loaded by the row after `step`. `core`: one that has it."""
    packed = pack_model(bytes(encode_model(model)))
    return SceneModel(step, step_ns(step), model_hash, packed, core.world.bodies)


def damaged(row: JournalRow) -> JournalRow:
    """Return a row with a digest that its checksums do not fit."""
    return msgspec.structs.replace(row, digest=b"x" * 16)
