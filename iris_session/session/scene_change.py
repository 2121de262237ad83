"""Changes of scene or drawing in a running session: checked and prepared off the loop, swapped between steps.

Not here: the files that clients get (`shared_scene`), and the swap itself (`stepper`).
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Sequence
from typing import Final

import msgspec
import mujoco
import numpy as np

from iris_session.authority.config import check_config
from iris_session.physics import FoundRobots, Pacer, find_objects
from iris_session.physics.load import compute_scene_hash, encode_model
from iris_session.protocol.entries import HOST, Entry, SceneLoaded, decode_entry, encode_entry
from iris_session.protocol.names import GeometryKind
from iris_session.protocol.scene import MAX_OPS, AddVisual, PatchOp, SceneError, SetVisual
from iris_session.protocol.specs import ObjectSpec
from iris_session.recording import pack_model
from iris_session.scene.mujoco_visuals import Shown
from iris_session.session.config import check_timestep
from iris_session.session.core import SessionCore, make_plant
from iris_session.session.deformables import list_deformables
from iris_session.session.errors import ConfigError
from iris_session.session.shared_scene import SharedScenes
from iris_session.session.stepper import NextScene, Stepper
from iris_session.session.tick_times import TickTimes

#: Tolerance of the length of a quaternion: it was rounded.
UNIT: Final = 1e-3
KINDS: Final = "SetVisual, AddVisual, RemoveVisual, AddMesh or AddMaterial of iris_session.protocol.scene"


def adopt_timestep(stepper: Stepper, pacer: Pacer, times: TickTimes, began_ns: int) -> bool:
    """Return whether the step that began at `began_ns` has loaded a scene with another timestep.

    If so, pacer and times keep that timestep, and the tick is accounted.
    """
    period_ns = stepper.core.world.tick_period_ns
    if period_ns == pacer.period_ns:
        return False
    pacer.change_period(period_ns, began_ns, stepper.clock())
    times.change_period(period_ns)
    return True


def prepare_scene(
    core: SessionCore,
    scenes: SharedScenes,
    model: mujoco.MjModel,
    state: bytes,
    found: FoundRobots,
    objects: tuple[ObjectSpec, ...] | None,
    shown: Shown | None = None,
) -> NextScene:
    """Make everything of a scene that takes long, without touching the session of `core`, whose configuration it has.

    Args:
        state: `mjSTATE_INTEGRATION` to begin with; empty for the model's own.
        found: The robots to offer, and what is unclear about them.
        objects: `None` to find them in the model.
        shown: What clients see of the model; `None` for what they see of every one.

    Raises:
        ConfigError: A robot, object or timestep that the session cannot use.
        PhysicsError, ControlError: The model cannot be driven.
    """
    binary = encode_model(model)
    all_robots = found.robots
    all_objects = tuple(find_objects(model) if objects is None else objects)
    message = SceneLoaded(compute_scene_hash(binary), all_robots, all_objects, state)
    # What is journaled is what is used: whole numbers in float fields become floats, lists tuples.
    scene = decode_entry(encode_entry(Entry(HOST, HOST, 0, message))).message
    assert isinstance(scene, SceneLoaded)
    try:
        check_config(msgspec.structs.replace(core.config.authority, assignments={}), all_robots, all_objects)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    check_timestep(model)
    plant = make_plant(model, scene, core.config.control)
    made = scenes.make(plant.world, state, shown=shown)
    return NextScene(
        plant, scene.model_hash, pack_model(bytes(binary)), made, list_deformables(plant.world), found.texts
    )


def _to_plain(value: object) -> object:
    """Return a numpy value as plain numbers."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} where a number, a text or a tuple is expected")


_encode_op: Final = msgspec.msgpack.Encoder(enc_hook=_to_plain).encode
_decode_op: Final = msgspec.msgpack.Decoder(PatchOp).decode


def check_patch(ops: Sequence[object]) -> tuple[PatchOp, ...]:
    """Return operations as they are journaled, so that every client can read them: tuples and plain numbers.

    Whether they fit the scene is checked where it is known (`shared_scene`). Raises `SceneError`.
    """
    if not ops:
        raise SceneError(f"nothing to change: give operations, {KINDS}")
    if len(ops) == 1 and isinstance(ops[0], list | tuple):
        raise SceneError(f"operations in a {type(ops[0]).__name__}: give them one by one, patch_scene(*operations)")
    if len(ops) > MAX_OPS:
        raise SceneError(f"{len(ops)} operations at once, at most {MAX_OPS}: give the others with further calls")
    checked = []
    for number, op in enumerate(ops, start=1):
        if not isinstance(op, PatchOp):
            raise SceneError(f"operation {number} is {reprlib.repr(op)}: {KINDS} is expected")
        try:
            checked.append(_check_op(op))
        except (TypeError, ValueError, OverflowError) as error:
            raise SceneError(f"operation {number}, {type(op).__name__}: {error}") from error
    return tuple(checked)


def _check_op(op: PatchOp) -> PatchOp:
    checked: PatchOp = _decode_op(_encode_op(op))
    try:
        msgspec.json.decode(msgspec.json.encode(checked), type=PatchOp)  # where what is not finite is null
    except msgspec.ValidationError as error:
        where = str(error).rpartition("$.")[2].rstrip("`")
        raise ValueError(f"numbers of {where} must be finite") from error
    visual = checked if isinstance(checked, SetVisual) else checked.visual if isinstance(checked, AddVisual) else None
    if visual is not None and visual.rgba is not None and not all(0.0 <= v <= 1.0 for v in visual.rgba):
        raise ValueError(f"rgba is {visual.rgba}: each from 0 to 1 is expected")
    if isinstance(checked, AddVisual) and checked.visual.geometry.kind not in GeometryKind.ALL:
        there_are = ", ".join(sorted(GeometryKind.ALL))
        raise ValueError(f"a geometry of kind {reprlib.repr(checked.visual.geometry.kind)}: there are {there_are}")
    if visual is not None and visual.T_body_visual is not None:
        length = math.hypot(*visual.T_body_visual.q)
        if abs(length - 1.0) > UNIT:
            raise ValueError(f"the quaternion has length {length:g}: (w, x, y, z) of length 1 is expected")
    return checked
