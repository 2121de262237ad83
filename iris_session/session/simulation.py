"""Finding the MuJoCo model and data inside the objects of benchmark suites."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np

from iris_session.session.errors import ConfigError, PublishError

#: Attributes behind which suites keep what they simulate with: Gymnasium's wrappers and LeRobot (`unwrapped`, `env`),
#: robosuite, LIBERO and MyoSuite (`sim`), dm_control, its wrappers and gym-aloha (`physics`, `_env`, `_environment`),
#: Brax (`sys`).
_OWNERS: Final = ("unwrapped", "sim", "physics", "_physics", "env", "_env", "_environment", "sys")
#: Names of the model and of the data: Gymnasium, gym-quadruped, MuJoCo Playground, OGBench.
_MODELS: Final = ("model", "mjModel", "mj_model", "_model", "_mj_model")
_DATA: Final = ("data", "mjData", "mj_data", "_data", "_mj_data")
#: Bindings of suites around those of MuJoCo: dm_control (`ptr`), robosuite (`_model`, `_data`).
_BINDINGS: Final = ("ptr", "_model", "_data")
_MAX_DEPTH: Final = 6
#: What `copy_state` takes over.
_STATE: Final = ("time", "qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat")


class Simulation(NamedTuple):
    """Model and data of an environment. `data` is `None` where it is advanced outside of Python's MuJoCo (MJX)."""

    model: mujoco.MjModel
    data: mujoco.MjData | None


def unwrap_model(value: Any) -> mujoco.MjModel | None:
    """Return the `MjModel` that a value is or wraps, `None` for another value."""
    return _unwrap(value, mujoco.MjModel)


def unwrap_data(value: Any) -> mujoco.MjData | None:
    """Return the `MjData` that a value is or wraps, `None` for another value."""
    return _unwrap(value, mujoco.MjData)


def find_simulation(environment: Any) -> Simulation | None:
    """Return what an environment simulates now, `None` when it shows no MuJoCo model.

    Looked at are its own attributes and those of what it wraps, nearest first.
    """
    without_data = None
    for owner in list_owners(environment):
        model = _find_attribute(owner, _MODELS, mujoco.MjModel)
        if model is None:
            continue
        data = _find_attribute(owner, _DATA, mujoco.MjData)
        if data is not None:
            return Simulation(model, data)
        without_data = without_data or Simulation(model, None)
    return without_data


def find_path(environment: Any, data: mujoco.MjData) -> tuple[str, ...]:
    """Return the names of attributes from an environment to its data, for `read_path`; empty if there are none."""
    for owner, path in _walk_owners(environment):
        for name in _DATA:
            value = read_attribute(owner, name)
            if value is data:
                return (*path, name)
            for binding in _BINDINGS:
                if read_attribute(value, binding) is data:
                    return (*path, name, binding)
    return ()


def read_path(owner: Any, path: tuple[str, ...]) -> Any:
    """Return the attribute at the end of a path, `None` where there is none."""
    for name in path:
        owner = read_attribute(owner, name)
    return owner


def require_simulation(environment: Any) -> Simulation:
    """Return what an environment simulates. Raises `ConfigError` that says why an object cannot be shared."""
    found = find_simulation(environment)
    if found is not None:
        return found
    inner = read_attribute(environment, "unwrapped")
    kind = type(environment if inner is None else inner).__name__
    environments = read_attribute(environment, "envs")
    if environments is not None or "vector" in type(environment).__module__.split("."):
        is_local = isinstance(environments, list | tuple)
        what = "one of its environments, as in share(env.envs[0])" if is_local else "an environment made alone"
        raise ConfigError(f"{kind} runs several environments, a session shows one: share {what}")
    raise ConfigError(
        f"no MuJoCo model in {kind}: share the path of a model, an MjModel with its MjData, an environment that "
        "simulates with MuJoCo, or a simulation of Genesis, SAPIEN, PyBullet, Newton, USD or CoppeliaSim"
    )


def copy_state(source: Any, data: mujoco.MjData) -> None:
    """Copy what `source` knows of a state into `data`: arrays of NumPy or JAX, as of `mjx.Data` or what has one as
    `data`.

    Raises `PublishError`, with `data` as it was, for arrays of another shape: a batch of worlds, or another model.
    """
    inner = source if read_attribute(source, "qpos") is not None else read_attribute(source, "data")
    if read_attribute(inner, "qpos") is None:
        raise PublishError(f"{type(source).__name__} has no qpos: give the data of the simulation, as sync(mjx_data)")
    values = {}
    for name in _STATE:
        value = read_attribute(inner, name)
        if value is None:
            continue
        array, shape = np.asarray(value, dtype=np.float64), np.shape(getattr(data, name))
        if array.shape != shape:
            is_batch = array.shape[1:] == shape
            advice = "give one world of the batch" if is_batch else "give the data of the model that is shared"
            raise PublishError(f"{name} has shape {array.shape}, the model's has {shape}: {advice}")
        values[name] = array
    for name, array in values.items():
        if name == "time":
            data.time = float(array)
        else:
            getattr(data, name)[:] = array


def list_owners(environment: Any) -> Iterator[Any]:
    """Return the environment and what it wraps, breadth first. A wrapper comes after what it stands for."""
    return (owner for owner, _ in _walk_owners(environment))


def _walk_owners(environment: Any) -> Iterator[tuple[Any, tuple[str, ...]]]:
    """Yield what `list_owners` returns, and the names of attributes from the environment to it."""
    level: list[tuple[Any, tuple[str, ...]]] = [(environment, ())]
    seen = {id(environment)}
    for _ in range(_MAX_DEPTH):
        deeper = []
        for owner, path in level:
            inner = {name: read_attribute(owner, name) for name in _OWNERS}
            if inner["unwrapped"] is None or inner["unwrapped"] is owner:
                yield owner, path
            for name, one in inner.items():
                if one is not None and id(one) not in seen:
                    seen.add(id(one))
                    deeper.append((one, (*path, name)))
        level = deeper


def _find_attribute(owner: Any, names: tuple[str, ...], kind: Any) -> Any:
    return next((found for name in names if (found := _unwrap(read_attribute(owner, name), kind)) is not None), None)


def _unwrap(value: Any, kind: Any) -> Any:
    if value is None or isinstance(value, kind):
        return value
    inner = (read_attribute(value, name) for name in _BINDINGS)
    return next((one for one in inner if isinstance(one, kind)), None)


def read_attribute(owner: Any, name: str) -> Any:
    """Return an attribute, `None` where there is none or reading it fails."""
    if inspect.ismodule(owner) or isinstance(owner, str | bytes | int | float):
        return None
    try:
        return getattr(owner, name, None)
    except Exception:  # properties of other people's classes
        return None
