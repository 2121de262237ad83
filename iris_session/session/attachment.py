"""`Attachment`: a session in a script that stays as it is, by the step of its data or of its environment.

While a session is attached, `mujoco.mj_step` and `mj_step2` are Python functions that ask for the data they are given
whether it is attached: a session tick around every step of that data, the original for all others (some 0.1 us). They
replace the originals in every module that holds them under any name, so `from mujoco import mj_step` is wrapped, too.
MuJoCo's control callback is not used: it is one per process, it keeps MuJoCo from compiling any model, and it fires in
`mj_forward` and four times a step under RK4.

What is not seen: functions bound in other ways before (default arguments, `functools.partial`, C++), `mujoco.rollout`,
and threads of `mujoco.viewer` that were compiled in. An `environment` is for these: its own `step` is wrapped on the
instance, and is a tick by itself when no wrapped function was called in it. An environment also tells when it has
built another model and data, as benchmark suites do at a reset.

One registry per process: any number of sessions, closed in any order; with the last one the originals come back. A
child that is forked does not belong to the sessions of its parent.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import threading
from collections.abc import Callable
from typing import Any, Final

import mujoco

from iris_session.session.errors import OwnershipError
from iris_session.session.user_loop import UserLoop

#: Functions of MuJoCo that advance data by a timestep, and use the `ctrl` that is there when they are called.
STEP_FUNCTIONS: Final = ("mj_step", "mj_step2")


_lock = threading.RLock()
_originals: Final[dict[str, Callable[..., None]]] = {name: getattr(mujoco, name) for name in STEP_FUNCTIONS}
_wrappers: Final[dict[str, Callable[..., None]]] = {}
#: By the identity of their data, which the loop keeps alive.
_loops: Final[dict[int, Attachment]] = {}
#: Loops that may go on with other data.
_followers: Final[list[Attachment]] = []


def _find_loop(model: Any, data: Any) -> Attachment | None:
    loop = _loops.get(id(data))
    if loop is None and _followers:
        return next((follower for follower in tuple(_followers) if follower.follow(model, data)), None)
    return loop


def _make_wrappers() -> None:
    step, step2 = _originals["mj_step"], _originals["mj_step2"]

    @functools.wraps(step)
    def mj_step(m: Any, d: Any, nstep: int = 1) -> None:
        loop = _loops.get(id(d)) if not _followers else _find_loop(m, d)
        if loop is None:
            return step(m, d, nstep)
        for _ in range(nstep):
            loop.step(m, d, step)
        return None

    @functools.wraps(step2)
    def mj_step2(m: Any, d: Any) -> None:
        loop = _loops.get(id(d)) if not _followers else _find_loop(m, d)
        return step2(m, d) if loop is None else loop.step(m, d, step2)

    _wrappers.update(mj_step=mj_step, mj_step2=mj_step2)


_make_wrappers()


def add_loop(loop: Attachment, data: Any, *, follows: bool) -> None:
    """Wrap the steps of `data` from now on.

    Args:
        loop: Takes the steps.
        data: The `MjData`.
        follows: Ask `loop` about steps of other data, too.

    Raises:
        OwnershipError: A session is attached to this data already.
    """
    with _lock:
        if id(data) in _loops:
            raise OwnershipError("a session is attached to this data already: close it first")
        if not _loops:
            _replace(_originals, _wrappers)
        _loops[id(data)] = loop
        if follows:
            _followers.append(loop)


def move_loop(loop: Attachment, data: Any) -> None:
    """Wrap the steps of other data instead."""
    with _lock:
        for key in [key for key, other in _loops.items() if other is loop]:
            del _loops[key]
        _loops[id(data)] = loop


def remove_loop(loop: Attachment) -> None:
    """End the wrapping for a loop; with the last one MuJoCo's own functions come back."""
    with _lock:
        for key in [key for key, other in _loops.items() if other is loop]:
            del _loops[key]
        if loop in _followers:
            _followers.remove(loop)
        if not _loops:
            _replace(_wrappers, _originals)


def _replace(old: dict[str, Callable[..., None]], new: dict[str, Callable[..., None]]) -> None:
    """Replace functions in every imported module. Another function around ours stays, and passes through."""
    by_id = {id(function): new[name] for name, function in old.items()}
    for module in list(sys.modules.values()):
        names = getattr(module, "__dict__", None)
        if not isinstance(names, dict) or module is sys.modules[__name__]:
            continue
        for name, value in list(names.items()):
            if id(value) in by_id:
                with contextlib.suppress(AttributeError, TypeError):
                    setattr(module, name, by_id[id(value)])


def _forget_parent() -> None:
    _loops.clear()
    _followers.clear()


os.register_at_fork(after_in_child=_forget_parent)


def find_simulation(environment: Any) -> tuple[Any, Any] | None:
    """Return the `MjModel` and `MjData` of an environment now, `None` when it shows none.

    Known are objects with `model` and `data`, and those that wrap them: Gymnasium (`unwrapped`), robosuite (`sim`,
    whose model and data are wrapped again) and dm_control (`physics`, `model.ptr`).
    """
    for path in ("", "unwrapped", "sim", "physics", "unwrapped.sim", "unwrapped.physics", "env.sim", "env.physics"):
        owner = environment
        for name in path.split(".") if path else ():
            owner = getattr(owner, name, None)
        model = _unwrap(getattr(owner, "model", None), mujoco.MjModel)
        data = _unwrap(getattr(owner, "data", None), mujoco.MjData)
        if model is not None and data is not None:
            return model, data
    return None


def _unwrap(value: Any, kind: Any) -> Any:
    for found in (value, getattr(value, "ptr", None), getattr(value, "_model", None), getattr(value, "_data", None)):
        if isinstance(found, kind):
            return found
    return None


class EnvironmentStep:
    """The step method of one environment, wrapped on the instance: `around` is called with the original.

    Raises `OwnershipError` for an environment whose attributes cannot be set.
    """

    def __init__(self, environment: Any, name: str, around: Callable[[Callable[[], Any]], Any]) -> None:
        original = getattr(environment, name)
        self._environment, self._name = environment, name
        self._before = vars(environment).get(name) if hasattr(environment, "__dict__") else None
        self._active = True

        @functools.wraps(original)
        def step(*args: Any, **kwargs: Any) -> Any:
            if not self._active:
                return original(*args, **kwargs)
            return around(lambda: original(*args, **kwargs))

        self._wrapper = step
        try:
            setattr(environment, name, step)
        except (AttributeError, TypeError) as error:
            raise OwnershipError(f"{name!r} of {type(environment).__name__} cannot be wrapped: {error}") from error

    def remove(self) -> None:
        """Put the original back; another function around ours stays, and passes through."""
        self._active = False
        if vars(self._environment).get(self._name) is not self._wrapper:
            return
        if self._before is None:
            delattr(self._environment, self._name)
        else:
            setattr(self._environment, self._name, self._before)


class Attachment:
    """Takes a session tick around every step of one model and data, and follows its environment to others.

    Args:
        loop: The session in the user's loop.
        environment: Object that owns the simulation, `None` when the script calls MuJoCo itself.
        step: Name of the environment's method.
        change_model: Called with another model and data that the environment has built.
    """

    def __init__(self, loop: UserLoop, environment: Any, step: str, change_model: Callable[[Any, Any], None]) -> None:
        self._loop = loop
        self._environment = environment
        self._change_model = change_model
        self._is_stepping = False
        self._ticks = 0
        #: The environment advances its data by functions that are not wrapped: then its step is the tick.
        self._is_opaque = False
        self._environment_step: EnvironmentStep | None = None
        loop.is_attached = True
        add_loop(self, loop.data, follows=environment is not None)
        if environment is not None:
            try:
                self._environment_step = EnvironmentStep(environment, step, self._around_step)
            except BaseException:
                remove_loop(self)
                raise

    def step(self, model: Any, data: Any, advance: Callable[..., None]) -> None:
        """Take a tick around `advance(model, data)`."""
        if self._is_stepping:  # MuJoCo calls back into Python, which steps: that is no tick of its own
            advance(model, data)
            return
        self._ticks += 1
        self._is_stepping = True
        try:
            self._loop.begin_tick(1)
            advance(model, data)
            self._loop.end_tick()
        finally:
            self._is_stepping = False

    def follow(self, model: Any, data: Any) -> bool:
        """Return whether `data` is what the environment simulates; go on with it when it is new."""
        if data is self._loop.data:
            return True
        found = find_simulation(self._environment)
        if found is None or found[1] is not data:
            return False
        self._change_model(model, data)
        move_loop(self, data)
        return True

    def _around_step(self, original: Callable[[], Any]) -> Any:
        """Take a tick around the environment's step, unless wrapped functions are called in it."""
        found = find_simulation(self._environment)
        if found is not None and found[1] is not self._loop.data:
            self.follow(*found)
        if self._is_stepping or not self._is_opaque:
            ticks, before = self._ticks, self._loop.data.time
            result = original()
            self._is_opaque = self._ticks == ticks and self._loop.data.time > before
            return result
        self._is_stepping = True
        try:
            self._loop.begin_tick()
            result = original()
            self._loop.end_tick()
        finally:
            self._is_stepping = False
        return result

    def close(self) -> None:
        """Give the step back. May be called twice."""
        remove_loop(self)
        if self._environment_step is not None:
            self._environment_step.remove()
            self._environment_step = None
