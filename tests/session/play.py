"""A scripted session without processes: entries as the front makes them, for cores and steppers under test."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from iris_session.authority import AuthorityConfig
from iris_session.control import ControlConfig
from iris_session.demo.scenes import scene_path
from iris_session.physics import find_objects, find_robots, load_model
from iris_session.protocol.client_messages import Acquire, Control, Marker, Sample
from iris_session.protocol.common import Pose, Target
from iris_session.protocol.entries import HOST, Entry, EntryMessage, Join
from iris_session.protocol.names import Role
from iris_session.session.core import CoreConfig, SessionCore

TICK_NS = 2_000_000
#: One sample in so many steps: 71 Hz.
SAMPLE_STEPS = 7
ANN = 1


def make_core(
    model: mujoco.MjModel | None = None, control: ControlConfig | None = None, **authority: object
) -> SessionCore:
    """Make a core of the handover scene with default settings."""
    model = model or load_model(scene_path("handover"))
    config = CoreConfig(
        AuthorityConfig(**authority),  # type: ignore[arg-type]
        control or ControlConfig(),
        find_robots(model).robots,
        find_objects(model),
    )
    return SessionCore(model, config)


def host(now_ns: int, message: EntryMessage) -> Entry:
    return Entry(HOST, HOST, now_ns, message)


def entries(step: int, scene_epoch: int = 1) -> list[Entry]:
    """Return the entries of a step: ann joins, acquires the left robot, engages at step 50 and moves along y."""
    now_ns = (step + 1) * TICK_NS
    if step == 0:
        join = Join("key", Role.OPERATOR, "ann", devices=("desktop",), alignment="not_needed")
        return [Entry(ANN, ANN, now_ns, join)]
    if step == 1:
        return [Entry(ANN, ANN, now_ns, Acquire(1, ("left",)))]
    if step < 3 or step % SAMPLE_STEPS:
        return []
    sample = Sample(
        device="desktop",
        kind="pose",
        seq=step,
        capture_ns=now_ns,
        scene_epoch=scene_epoch,
        tracking_epoch=0,
        alignment_version=1,
        targets=(Target("left", 1),),
        clutch=step >= 50,
        pose=Pose((0.0, 0.2 * now_ns * 1e-9, 1.0), (1.0, 0.0, 0.0, 0.0)),
    )
    return [Entry(ANN, ANN, now_ns, sample)]


def play(core: SessionCore, first: int, last: int) -> list[bytes]:
    """Take steps `first` to `last` - 1, one tick each, with a pause. Return their digests."""
    return [
        core.step((i + 1) * TICK_NS, entries(i) + _extras(i), int(not 120 <= i < 130)).digest
        for i in range(first, last)
    ]


def _extras(step: int) -> Sequence[Entry]:
    now_ns = (step + 1) * TICK_NS
    what = {100: Marker(0, "half way"), 120: Control(0, "pause"), 129: Control(0, "resume")}.get(step)
    return [host(now_ns, what)] if what is not None else []
