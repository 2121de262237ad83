"""Conversion of arguments to values of the protocol: names, numbers, poses, texts.

A value that cannot be converted raises `InvalidMessageError` at once, in one line that names the field.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.client.errors import InvalidMessageError
from iris_session.protocol.common import MAX_TEXT, Pose
from iris_session.protocol.names import Device

Numbers = Sequence[float] | NDArray[Any]
#: `((x, y, z) [m], (w, x, y, z))` of tuples, lists or arrays, or a `Pose`.
PoseLike = Pose | tuple[Numbers, Numbers]
POSE_FORM: Final = "((x, y, z), (w, x, y, z))"


def to_text(value: object) -> str:
    """Convert any value to a `Text`: an e-stop must not fail because of its reason."""
    try:
        text = str(value)
    except Exception:  # the object's own conversion may raise anything
        text = type(value).__name__
    return text.encode("utf-8", "replace").decode("utf-8")[:MAX_TEXT]


def to_names(field: str, names: str | Iterable[str]) -> tuple[str, ...]:
    """Convert names to a tuple; a bare string is one name."""
    if isinstance(names, str):
        return (names,)
    found = tuple(names) if isinstance(names, Iterable) else (names,)
    for name in found:
        if not isinstance(name, str):
            raise InvalidMessageError(f"{field}: expected names, got {str(name)[:40]} of type {type(name).__name__}")
    return found


def to_devices(devices: str | Iterable[str]) -> tuple[str, ...]:
    """Convert names of devices to a tuple."""
    found = to_names("devices", devices)
    unknown = [device for device in found if device not in Device.ALL]
    if unknown:
        raise InvalidMessageError(f"devices: {', '.join(unknown)[:80]} is none of {', '.join(sorted(Device.ALL))}")
    return found


def to_numbers(field: str, values: Iterable[float], length: int | None = None) -> tuple[float, ...]:
    """Convert numbers, or an array (n,), to floats."""
    try:
        found = tuple(v if type(v) is float else _to_float(v) for v in values)
    except (TypeError, ValueError):
        found = None
    if found is None or (length is not None and len(found) != length):
        wanted = "numbers" if length is None else f"{length} numbers"
        raise InvalidMessageError(f"{field}: expected {wanted}, got {_short_repr(values)}")
    return found


def _to_float(value: Any) -> float:
    if isinstance(value, str | bytes) or np.ndim(value):
        raise TypeError
    return float(value)


def to_pose(field: str, pose: PoseLike) -> Pose:
    """Convert `((x, y, z) [m], (w, x, y, z))` of tuples, lists or arrays to a `Pose`; a `Pose` is returned as it is."""
    if isinstance(pose, Pose):
        return pose
    try:
        p, q = pose
        return Pose(to_numbers(field, p, 3), to_numbers(field, q, 4))  # type: ignore[arg-type]  # lengths are checked
    except (TypeError, ValueError):  # InvalidMessageError is one too
        raise InvalidMessageError(f"{field}: expected {POSE_FORM}, got {_short_repr(pose)}") from None


def to_python_scalar(value: Any) -> Any:
    """Convert a NumPy scalar to a Python number or truth value."""
    return value.item() if isinstance(value, np.generic) else value


def _short_repr(value: Any) -> str:
    size = f" of shape {value.shape}" if isinstance(value, np.ndarray) else ""
    if not size and isinstance(value, list | tuple):
        size = f" of length {len(value)}"
    text = " ".join(repr(value).split())
    return f"{type(value).__name__}{size}: {text if len(text) <= 100 else text[:97] + '...'}"
