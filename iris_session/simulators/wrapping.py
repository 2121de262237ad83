"""`wrap_calls`: a method on one object, or a function of a module, with calls of a session around it."""

from __future__ import annotations

import copy
import functools
import os
from collections.abc import Callable, Mapping
from typing import Any

from iris_session.protocol.errors import IrisError

#: Called with the original, which takes no arguments any more, and with the arguments; returns its result.
Around = Callable[[Callable[[], Any], tuple[Any, ...], Mapping[str, Any]], Any]


class SimulatorError(IrisError, ValueError):
    """A simulation that cannot be shown; the message says what would be right."""


class AlreadyWrappedError(SimulatorError):
    """A method that is wrapped already, by another session over the same simulation."""


#: What is wrapped, by process, object and method. The objects are kept, so that no other gets their number.
_wrapped: dict[tuple[Any, ...], Any] = {}


def _get_same(value: Any) -> Any:
    return value


class MethodWrapper:
    """Stands for a method on an object. A deep copy or a pickle of the object has its own method instead: a planner
    that steps it does not step the original. In a process that is forked afterwards it calls the original alone.
    """

    def __init__(self, original: Callable[..., Any], own: Any) -> None:
        self.arounds: list[Around] = []
        self.own = own  # what the object itself had under the name
        self.process = os.getpid()
        self._original = original
        functools.update_wrapper(self, original, updated=())  # not its attributes: it may be a wrapper of ours, too

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        def call() -> Any:
            return self._original(*args, **kwargs)

        for around in tuple(self.arounds) if os.getpid() == self.process else ():
            call = functools.partial(around, call, args, kwargs)
        return call()

    def __deepcopy__(self, memo: dict[Any, Any]) -> Any:
        marker = "MethodWrapper", id(self)
        if marker in memo:  # an environment that copies itself, and does not note its copy
            return self._original
        memo[marker] = True
        return copy.deepcopy(self._original, memo)  # a bound method is bound to the copy

    def __reduce__(self) -> Any:
        return _get_same, (self._original,)


def wrap_calls(owner: Any, name: str, around: Around, key: tuple[Any, ...] = ()) -> Callable[[], None]:
    """Replace a method on one object, or a function of a module, by one that calls `around` with it.

    Args:
        owner: The object or module.
        name: Name of the method.
        around: Called instead, with the original.
        key: What no two sessions may wrap at once, where it is not the object.

    Returns:
        A function that puts the original back. Another function around ours stays, and passes through.

    Raises:
        AlreadyWrappedError: It is wrapped already.
        SimulatorError: The object does not allow it.
    """
    key = (os.getpid(), *(key or (id(owner),)), name)
    if key in _wrapped:
        raise AlreadyWrappedError("a session is attached to this simulation already: close it first")
    own = getattr(owner, "__dict__", {}).get(name)
    if isinstance(own, MethodWrapper) and own.process == os.getpid():  # of another session, on a module
        wrapper = own
    else:
        wrapper = MethodWrapper(getattr(owner, name), own)
        try:
            setattr(owner, name, wrapper)
        except (AttributeError, TypeError) as error:
            raise SimulatorError(f"{name!r} of {type(owner).__name__} cannot be wrapped: {error}") from error
    wrapper.arounds.append(around)
    _wrapped[key] = owner

    def remove() -> None:
        if _wrapped.pop(key, None) is None:
            return
        wrapper.arounds.remove(around)
        if not wrapper.arounds and owner.__dict__.get(name) is wrapper:
            if wrapper.own is None:
                delattr(owner, name)
            else:
                setattr(owner, name, wrapper.own)

    return remove


def wrap_method(
    owner: Any, name: str, before: Callable[..., None], after: Callable[..., None], key: tuple[Any, ...] = ()
) -> Callable[[], None]:
    """Call `before` and `after` around a method, with its arguments; otherwise as `wrap_calls`."""

    def around(call: Callable[[], Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        before(*args, **kwargs)
        result = call()
        after(*args, **kwargs)
        return result

    return wrap_calls(owner, name, around, key)
