"""`Attachment`: a session in a script that stays as it is, by the step of its data or of its environment.

While a session is attached, `mujoco.mj_step` and `mj_step2` are Python functions that ask for the data they are given
whether it is attached: a session tick around every step of that data, the original for all others (some microseconds).
They replace the originals in every module that holds them under any name, so `from mujoco import mj_step` is wrapped,
too. MuJoCo's control callback is not used: it is one per process, it keeps MuJoCo from compiling any model, and it
fires in `mj_forward` and four times a step under RK4.

What is not seen: functions bound in other ways before (default arguments, `functools.partial`, C++), `mujoco.rollout`,
and threads of `mujoco.viewer` that were compiled in. An `environment` is for these: its own `step` is wrapped on the
instance, and is a tick by itself when no wrapped function was called in it.

Benchmark suites build another model and data at a reset. An environment tells which ones are its own now. Without one
the session goes on with other data that the program steps in the same thread while the attached one stands still, when
nothing but the session holds that any more (of the same model after a second: a program may step `session.data`, and
its planner copies), or when the other model is another one with mostly the same bodies. Where neither is so, a warning
says that other data is simulated.

One registry per process: any number of sessions, closed in any order; with the last one the originals come back. A
child that is forked does not belong to the sessions of its parent.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any, Final

import mujoco
import numpy as np

from iris_session.physics.names import list_element_names
from iris_session.session.errors import OwnershipError
from iris_session.session.simulation import find_path, find_simulation, read_path
from iris_session.session.user_loop import UserLoop
from iris_session.simulators.wrapping import SimulatorError, wrap_calls

#: Functions of MuJoCo that advance data by a timestep, and use the `ctrl` that is there when they are called.
STEP_FUNCTIONS: Final = ("mj_step", "mj_step2")
#: An environment's step that takes longer is looked at before its end, too [ns].
LONG_STEP_NS: Final = 20_000_000
#: Other data of a world with the same bodies is followed when the attached one has stood still for so long, and that
#: is decided again so often [ns].
FOLLOW_AFTER_NS: Final = 250_000_000
#: The same for other data of the same model, when nothing but the session holds the attached one [ns].
FOLLOW_SAME_AFTER_NS: Final = 1_000_000_000
ASK_AGAIN_NS: Final = 50_000_000
#: Other data that is remembered as not followed.
MAX_REFUSED: Final = 64
#: Other data is simulated for so long before the owner is warned [ns].
WARN_AFTER_NS: Final = 500_000_000
ELSEWHERE: Final = (
    "the shared data stands still while other data is simulated: share the environment itself, as in share(env)"
)
#: References to the attached data by its session, its loop, and the call that counts them.
OWN_REFERENCES: Final = 3
#: Share of the bodies of two models, by name, that must be the same.
ALIKE: Final = 0.5

_log = logging.getLogger(__name__)

_lock = threading.RLock()
_originals: Final[dict[str, Callable[..., None]]] = {name: getattr(mujoco, name) for name in STEP_FUNCTIONS}
#: By the identity of their data, which the loop keeps alive.
_loops: Final[dict[int, Attachment]] = {}


def _find_loop(model: Any, data: Any) -> Attachment | None:
    loop = _loops.get(id(data))
    if loop is None:
        return next((other for other in tuple(_loops.values()) if other.follow(model, data)), None)
    return loop


@functools.wraps(_originals["mj_step"])
def _mj_step(m: Any, d: Any, nstep: int = 1) -> None:
    loop = _find_loop(m, d)
    if loop is None:
        return _originals["mj_step"](m, d, nstep)
    for _ in range(nstep):
        loop.step(m, d, _originals["mj_step"])
    return None


@functools.wraps(_originals["mj_step2"])
def _mj_step2(m: Any, d: Any) -> None:
    loop = _find_loop(m, d)
    return _originals["mj_step2"](m, d) if loop is None else loop.step(m, d, _originals["mj_step2"])


_wrappers: Final[dict[str, Callable[..., None]]] = {"mj_step": _mj_step, "mj_step2": _mj_step2}


def require_free(data: Any) -> None:
    """Raise `OwnershipError` when a session is attached to this data already."""
    if id(data) in _loops:
        raise OwnershipError("a session is attached to this data already: close it first")


def add_loop(loop: Attachment, data: Any) -> None:
    """Let `loop` take the steps of `data` from now on, and ask it about those of data that no session has.

    Raises `OwnershipError` when a session is attached to this data already.
    """
    with _lock:
        require_free(data)
        if not _loops:
            _replace(_originals, _wrappers)
        _loops[id(data)] = loop


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


os.register_at_fork(after_in_child=_loops.clear)


def is_alike(a: mujoco.MjModel, b: mujoco.MjModel) -> bool:
    """Return whether two models are of one world: most of their bodies have the same names."""
    names = [set(list_element_names(model, "body")) - {"", "world"} for model in (a, b)]
    return len(names[0] & names[1]) > ALIKE * len(names[0] | names[1])


class Attachment:
    """Lets a session see every step of one model and data, and follows the program to others.

    While a participant drives, every step is a tick of the session. Otherwise the session looks at the state after a
    step when that is due, in an environment at the end of its step.

    Args:
        loop: The session in the user's loop.
        environment: Object that owns the simulation, `None` when the script calls MuJoCo itself.
        step: Name of the environment's method.
        change_model: Called with another model and data that the program has built.
        list_interventions: Returns the robots in whose part of a step participants came in, of those that they
            drive. Given for an environment that is driven by its action: its steps then say in `info` which they are.
    """

    def __init__(
        self,
        loop: UserLoop,
        environment: Any,
        step: str,
        change_model: Callable[[Any, Any], None],
        list_interventions: Callable[[Sequence[str]], tuple[str, ...]] | None = None,
    ) -> None:
        self._loop = loop
        self._list_interventions = list_interventions
        self.environment = environment
        self._change_model = change_model
        self._is_stepping = False
        self._ticks = 0
        #: Session time at which the environment's step began, `None` outside of it.
        self._environment_began_ns: int | None = None
        #: The environment advances its data by functions that are not wrapped: then its step is the tick.
        self._is_opaque = False
        self._unwrap = contextlib.ExitStack()
        self._thread: int | None = None  # that steps the data
        #: Steps of other data since the newest one of ours: session time of the first and of the newest.
        self._other_since_ns: int | None = None
        self._other_ns = 0
        #: When it is decided again about other data that is not followed, by its identity.
        self._refused: dict[int, int] = {}
        #: Names of attributes from the environment to its data, empty while they are not known.
        self._path: tuple[str, ...] = ()
        #: Data of the program that the session could not go on with, and why.
        self._failed: Any = None
        self.fault = ""
        self._has_warned = False
        #: Called after every step and reset of the environment, with true for a reset.
        self.on_environment: Callable[[bool], None] = lambda is_reset: None
        loop.is_attached = True
        add_loop(self, loop.data)
        if environment is not None:
            try:
                self._unwrap.callback(wrap_calls(environment, step, lambda call, *_: self._around_step(call)))
                if callable(getattr(environment, "reset", None)):
                    self._unwrap.callback(wrap_calls(environment, "reset", lambda call, *_: self._around_reset(call)))
            except SimulatorError as error:
                self.close()
                raise OwnershipError(str(error)) from None

    def step(self, model: Any, data: Any, advance: Callable[..., None]) -> None:
        """Take `advance(model, data)` into the session."""
        if self._is_stepping:  # MuJoCo calls back into Python, which steps: that is no tick of its own
            advance(model, data)
            return
        self._ticks += 1
        self._thread, self._other_since_ns = threading.get_ident(), None
        self._take_step(lambda: advance(model, data), 1)

    def _take_step(self, advance: Callable[[], Any], n_ticks: int) -> Any:
        """Call `advance` as a tick of the session when it drives; else look at what it has done, when that is due."""
        loop = self._loop
        self._is_stepping = True
        try:
            if loop.is_driving and self._unless_ended(lambda: loop.begin_tick(n_ticks)):
                result = advance()
                self._unless_ended(loop.end_tick)
                return result
            began_ns, began_time = loop.read_clock(), float(loop.data.time)
            result = advance()
            loop.note_step(began_ns, began_time)
            if self._environment_began_ns is None or began_ns - self._environment_began_ns > LONG_STEP_NS:
                self._unless_ended(loop.look)
            return result
        finally:
            self._is_stepping = False

    def _unless_ended(self, act: Callable[[], Any]) -> bool:
        """Let the session act, and return true; false when it has ended. No error of it is one of the program."""
        try:
            act()
        except Exception as error:
            if not self._loop.is_closed:
                _log.error("the program goes on without its session: %s", error)
                self._loop.end(error)
            return False
        return True

    def follow(self, model: Any, data: Any) -> bool:
        """Return whether the program goes on with `data` instead, which it is about to step; then do so, too."""
        if self.environment is None and self._thread not in (None, threading.get_ident()):
            return False
        self._other_ns = now_ns = self._loop.read_clock()
        if self._other_since_ns is None:
            self._other_since_ns = now_ns
        if now_ns < self._refused.get(id(data), 0):
            return False
        if not self._is_successor(model, data, now_ns - self._other_since_ns):
            if len(self._refused) >= MAX_REFUSED:
                self._refused.clear()
            self._refused[id(data)] = now_ns + ASK_AGAIN_NS
            if self.list_warnings() and not self._has_warned:
                self._has_warned = True
                _log.warning("%s", ELSEWHERE)
            return False
        return self._go_on_with(model, data)

    def _go_on_with(self, model: Any, data: Any) -> bool:
        """Go on with other data; return false, with a warning, when the session cannot."""
        if data is self._failed or self._loop.is_closed or self._loop.has_ended:
            return False
        try:
            self._change_model(model, data)
        except Exception as error:  # of the disk, for example
            fault = f"the new model is not shared, the old one stands still: {error}"
            if fault != self.fault:
                _log.warning("%s", fault)
            self._failed, self.fault = data, fault
            return False
        move_loop(self, data)
        self._other_since_ns, self._failed, self.fault = None, None, ""
        return True

    def _is_successor(self, model: Any, data: Any, stands_ns: int) -> bool:
        """Return whether the program has replaced the attached data by `data`, having left ours for `stands_ns`."""
        if self.environment is not None:
            found = find_simulation(self.environment)
            return found is not None and found.data is data
        is_same_model = model is self._loop.model
        if sys.getrefcount(self._loop.data) <= OWN_REFERENCES:
            # A program that steps `session.data` holds it no other way, and its planner steps copies meanwhile.
            return not is_same_model or stands_ns > FOLLOW_SAME_AFTER_NS
        return stands_ns > FOLLOW_AFTER_NS and not is_same_model and is_alike(model, self._loop.model)

    def list_warnings(self) -> tuple[str, ...]:
        """Return what the owner should know, one line each."""
        since_ns = self._other_since_ns
        is_elsewhere = self.environment is None and since_ns is not None and self._other_ns - since_ns > WARN_AFTER_NS
        return (*((self.fault,) if self.fault else ()), *((ELSEWHERE,) if is_elsewhere else ()))

    def follow_environment(self) -> bool:
        """Go on with the model and data that the environment has now; return whether they are others."""
        data = self._loop.data
        if self._path and read_path(self.environment, self._path) is data and self._failed is None:
            return False
        found = find_simulation(self.environment)
        if found is None or found.data is None:
            return False
        if found.data is data:  # perhaps again
            self._failed, self.fault = None, ""
            self._path = find_path(self.environment, data)
            return False
        return self._go_on_with(*found)

    def _around_step(self, original: Callable[[], Any]) -> Any:
        """Take the environment's step into the session; say in its `info` which robots people drove."""
        self.follow_environment()
        if self._is_stepping or self._environment_began_ns is not None:
            return original()
        before = self._loop.driven
        result = self._take_environment_step(original)
        # Results end with `info` in Gymnasium (5), and in Gym and robosuite (4).
        has_info = type(result) is tuple and len(result) in (4, 5) and isinstance(result[-1], dict)
        if has_info and self._list_interventions is not None:
            driven = self._list_interventions((*before, *self._loop.driven))
            result = (*result[:-1], {**result[-1], "intervention": driven})
        self._unless_ended(lambda: self.on_environment(False))
        return result

    def _take_environment_step(self, original: Callable[[], Any]) -> Any:
        """Take the environment's step into the session, unless wrapped functions are called in it."""
        if self._is_opaque:
            return self._take_step(original, 0)
        ticks, before = self._ticks, self._loop.data.time
        self._environment_began_ns = self._loop.read_clock()
        try:
            result = original()
        finally:
            self._environment_began_ns = None
        self._is_opaque = self._ticks == ticks and self._loop.data.time > before
        self._look()
        return result

    def _around_reset(self, original: Callable[[], Any]) -> Any:
        """Show the environment's reset at once, not only with the step after it."""
        data, resets = self._loop.data, self._loop.reset_count
        before = data.qpos.copy()
        result = original()
        if not self.follow_environment():
            self._loop.note_time()
            # Time may have been zero before, too.
            if resets == self._loop.reset_count and not np.array_equal(before, data.qpos):
                self._loop.reset()
        self._look()
        self._unless_ended(lambda: self.on_environment(True))
        return result

    def _look(self) -> None:
        if not self._loop.is_driving and self._environment_began_ns is None and not self._is_stepping:
            self._unless_ended(self._loop.look)

    def close(self) -> None:
        """Give the step back. May be called twice."""
        remove_loop(self)
        self._unwrap.close()
