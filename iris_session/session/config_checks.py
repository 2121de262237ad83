"""Checks of what a session is given in Python: types and anchors, each mistake one line that says what is right."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from types import NoneType
from typing import Any, Final, TypeVar

import msgspec
import mujoco
import numpy as np

from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.session.errors import ConfigError, brief

_Spec = TypeVar("_Spec", RobotSpec, ObjectSpec)
#: What is expected of robots and objects that somebody gives, for error texts.
_ROBOTS: Final = (
    "a list of RobotSpec is expected; load_robots_toml(file, model) of iris_session.physics reads one from a robots "
    "file, and without robots= they are found in the model"
)
_OBJECTS: Final = (
    'a list of ObjectSpec is expected, as [ObjectSpec(name="hammer", body="hammer")] of iris_session.protocol.specs; '
    "without objects= they are found in the model"
)
#: Annotations of `SessionConfig`, and what may stand there. A bool is no number.
_KINDS: Final[dict[str, tuple[type, ...]]] = {
    "str": (str,),
    "int": (int,),
    "float": (float, int),
    "bool": (bool,),
    "bool | str | Path": (bool, str, Path),
    "str | Path | None": (str, Path, NoneType),
    "tuple[str, ...]": (tuple,),
    "Mapping[str, PoseTuple]": (Mapping,),
    "Mapping[str, float]": (Mapping,),
    "AuthorityConfig": (msgspec.Struct,),
    "ControlConfig": (msgspec.Struct,),
}
#: Quaternions of people's files have few digits.
UNIT_TOLERANCE: Final = 1e-3
#: Millimetres in a field of metres are a mistake, not a sheet.
SMALLEST_SHEET_M: Final = 0.01
LARGEST_SHEET_M: Final = 5.0
#: Of one tick, where our loop takes them: below, no computer keeps up; above, samples could not be held for a tick.
SHORTEST_TICK_S: Final = 1e-5
LONGEST_TICK_S: Final = 0.1


def check_types(config: Any) -> None:
    """Raises `ConfigError` for a field of another type than its annotation says."""
    for item in fields(config):
        value, annotation = getattr(config, item.name), str(item.type)
        kinds = _KINDS.get(annotation, (object,))
        right = isinstance(value, kinds) and (bool in kinds or not isinstance(value, bool))
        if kinds == (msgspec.Struct,):
            right = type(value).__name__ == annotation
        if kinds == (tuple,):
            right = right and all(isinstance(part, str) for part in value)
        if not right:
            raise ConfigError(f"{item.name} must be {annotation}, not {type(value).__name__} {value!r:.60}")


def check_anchors(anchors: Mapping[str, Any], sizes: Mapping[str, Any]) -> None:
    """Raises `ConfigError` for a pose that is no `((x, y, z), (w, x, y, z))` in metres, finite, of unit length, and for
    the size of an anchor that is none or has none [m]."""
    for name, size in sizes.items():
        if name not in anchors:
            raise ConfigError(f"anchor_sizes: there is no anchor {name!r}: {', '.join(map(repr, anchors)) or 'none'}")
        number = isinstance(size, int | float) and not isinstance(size, bool)
        if not (number and SMALLEST_SHEET_M <= size <= LARGEST_SHEET_M):
            raise ConfigError(
                f"anchor_sizes: {name!r}: {size!r:.40} is not the edge of a printed sheet in metres, "
                f"{SMALLEST_SHEET_M:g} to {LARGEST_SHEET_M:g}"
            )
    for name, pose in anchors.items():
        where = f"anchor {name!r}: {pose!r:.80}"
        try:
            p, q = (tuple(float(v) for v in part) for part in pose)
        except (TypeError, ValueError):
            p, q = (), ()
        if not isinstance(name, str) or (len(p), len(q)) != (3, 4):
            raise ConfigError(
                f"{where} must be T_world_anchor as ((x, y, z), (w, x, y, z)), metres and unit quaternion"
            )
        if not all(map(math.isfinite, (*p, *q))):
            raise ConfigError(f"{where} holds a number that is not finite")
        if abs(math.hypot(*q) - 1.0) > UNIT_TOLERANCE:
            raise ConfigError(f"{where}: the quaternion (w, x, y, z) has length {math.hypot(*q):.3g}, it must be 1")


def check_timestep(model: mujoco.MjModel) -> None:
    """Raises `ConfigError` for a timestep that our loop cannot keep. In a user's loop any will do."""
    timestep = float(model.opt.timestep)
    if not SHORTEST_TICK_S <= timestep <= LONGEST_TICK_S:
        raise ConfigError(
            f"the model has a timestep of {timestep:g} s, run() takes {SHORTEST_TICK_S:g} to {LONGEST_TICK_S:g} s: "
            '<option timestep="0.002"/>'
        )


def check_robots(given: object) -> tuple[RobotSpec, ...] | None:
    """As they are given, None for those of the model. Raises `ConfigError` for what are none."""
    return None if given is None else _specs("robots", given, RobotSpec, _ROBOTS)


def check_objects(given: object) -> tuple[ObjectSpec, ...] | None:
    """As they are given, None for those of the model. Raises `ConfigError` for what are none."""
    return None if given is None else _specs("objects", given, ObjectSpec, _OBJECTS)


def _specs(what: str, given: object, kind: type[_Spec], expected: str) -> tuple[_Spec, ...]:
    if isinstance(given, str | bytes | Path | Mapping) or not isinstance(given, Iterable):
        raise ConfigError(f"{what} is {brief(given)}: {expected}")
    specs = tuple(given)
    for place, spec in enumerate(specs):
        if not isinstance(spec, kind):
            raise ConfigError(f"{what}[{place}] is {brief(spec)}: {expected}")
        try:
            msgspec.msgpack.decode(msgspec.msgpack.encode(spec), type=kind)
        except (TypeError, ValueError) as error:  # as the journal could not hold it
            raise ConfigError(f"{what}[{place}] is a {kind.__name__} with a wrong field: {error}") from error
    return specs


def check_arguments(model: object, data: object, config: object) -> None:
    """Raises `TypeError` for what is no model, data and `SessionConfig`, `ConfigError` for data of another model."""
    if type(config).__name__ != "SessionConfig":
        raise TypeError(f"config must be a SessionConfig, not {type(config).__name__}: Session(model, data, config)")
    if not isinstance(model, mujoco.MjModel):
        kind = type(model).__name__
        advice = "; call its compile() first" if kind == "MjSpec" else ""
        raise TypeError(f"model must be an MjModel or the path of a model file, not {kind}{advice}")
    if data is None:
        return
    if not isinstance(data, mujoco.MjData):
        raise TypeError(f"data must be MjData of the model, not {type(data).__name__}: Session(model, data, config)")
    if np.shape(data.qpos) != (model.nq,) or np.shape(data.ctrl) != (model.nu,):
        raise ConfigError(
            f"data is of another model: it has {np.size(data.qpos)} positions and {np.size(data.ctrl)} controls, "
            f"the model {model.nq} and {model.nu}"
        )
