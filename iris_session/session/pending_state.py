"""`PendingState`: poses, joints and vertices that a publisher has set, checked when set, and published as one frame.

A wrong value raises `PublishError` in the caller and changes nothing. Joints beyond their limits are not wrong, as real
robots report some: they are shown so, and `warnings` names those far beyond. All methods work from any thread.
"""

from __future__ import annotations

import difflib
import math
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iris_session.protocol.common import Pose
from iris_session.scene import SceneBuildError
from iris_session.scene.result import ComposedScene, Joint
from iris_session.session.errors import PublishError, short_repr

#: Farthest coordinate [m]. Beyond it units are wrong, and the stream's error bound does not hold.
FARTHEST_M: Final = 1e6
#: Tolerance of the length of a quaternion: it was rounded, and is normalised.
UNIT: Final = 1e-3
#: Excess over its limits at which a joint is warned about, as a share of their range: encoders and limits of a
#: description differ by less, degrees in place of radians by more.
BEYOND: Final = 0.05
#: Most joints that `warnings` names; a robot in degrees has many.
MAX_WARNINGS: Final = 4


@dataclass(frozen=True)
class Frame:
    """The world at one moment.

    Attributes:
        capture_ns: Session time.
        time_s: Time of the world [s].
        poses: Of the moving bodies, shape (n, 7) as `x y z qw qx qy qz`, world frame.
        vertices: Shape (n, 3) [m], world frame, by name of the deformable.
        anew: The world was reset since the frame before.
    """

    capture_ns: int
    time_s: float
    poses: NDArray[np.float64]
    vertices: Mapping[str, NDArray[np.float32]]
    anew: bool = False


class PendingState:
    """The moving things of a composed scene as they will be published next. Thread-safe."""

    def __init__(self, scene: ComposedScene) -> None:
        self._lock = threading.Lock()
        self._scene = scene
        self._rows = {name: row for row, name in enumerate(scene.moving)}
        self._poses = np.array([(*pose.p, *pose.q) for pose in scene.poses]).reshape(-1, 7)
        self._roots = {name: one.T_world_root for name, one in scene.articulations.items()}
        self._joints: dict[str, dict[str, float]] = {name: {} for name in scene.articulations}
        self._loose = {  # bodies on floating and planar joints: of which articulation
            body: name for name, one in scene.articulations.items() for body in one.loose.values()
        }
        self._moved: dict[str, dict[str, Pose]] = {name: {} for name in scene.articulations}  # where those were put
        self._beyond: dict[tuple[str, str], str] = {}  # warnings about joints far beyond their limits
        self._vertices = {name: one.vertices for name, one in scene.deformables.items()}

    def make_frame(self, capture_ns: int, time_s: float, anew: bool) -> Frame:
        """Return everything as it is set now."""
        with self._lock:
            return Frame(capture_ns, time_s, self._poses.copy(), dict(self._vertices), anew)

    def warnings(self) -> tuple[str, ...]:
        """Return what is shown as it was set though it looks like a mistake, one line each."""
        with self._lock:
            found = tuple(self._beyond.values())
        more = len(found) - MAX_WARNINGS
        return found if more <= 0 else (*found[:MAX_WARNINGS], f"{more} more joints are set far beyond their limits")

    def set_pose(self, name: str, position: Sequence[float], quaternion: Sequence[float]) -> None:
        _check_name(name)
        pose = Pose(_check_position(position, name), _check_quaternion(quaternion, name))
        with self._lock:
            if name in self._roots:
                self._set_bodies(self._place(name, pose, self._joints[name], self._moved[name]))
                self._roots[name] = pose
            elif name in self._loose:
                self._move_loose({name: pose})
            else:
                self._poses[self._find_row(name)] = (*pose.p, *pose.q)

    def set_poses(self, names: Sequence[str], positions: ArrayLike, quaternions: ArrayLike) -> None:
        names = _check_names(names)
        p = _check_array(positions, (len(names), 3), "positions")
        q = _check_array(quaternions, (len(names), 4), "quaternions")
        with np.errstate(over="ignore"):  # infinite is no length of 1 either
            lengths = np.sqrt(np.einsum("ij,ij->i", q, q))
        if len(names) and (np.abs(p).max() > FARTHEST_M or np.abs(lengths - 1.0).max() > UNIT):
            for row, name in enumerate(names):  # raises for the one that is wrong
                _check_position(p[row].tolist(), name)
                _check_quaternion(q[row].tolist(), name)
        rows = [self._rows[name] if name in self._rows else self._find_row(name) for name in names]
        if len(set(rows)) != len(rows):
            twice = next(name for name in names if names.count(name) > 1)
            raise PublishError(f"set_poses: {twice!r} is named more than once: give one pose of each")
        q = q / lengths[:, None]
        loose = [row for row, name in enumerate(names) if name in self._loose] if self._loose else []
        with self._lock:
            if loose:
                self._move_loose({names[row]: Pose((*p[row].tolist(),), (*q[row].tolist(),)) for row in loose})
            self._poses[rows, :3] = p
            self._poses[rows, 3:] = q

    def set_joints(self, name: str, positions: object) -> None:
        _check_name(name)
        articulation = self._scene.articulations.get(name)
        if articulation is None:
            known = _suggest_names(name, self._roots, "articulations")
            raise PublishError(f"{name!r} has no joints in this scene; {known}")
        if not isinstance(positions, Mapping):
            example = {joint.name: joint.rest for joint in articulation.joints}
            raise PublishError(f"set_joints({name!r}): positions by name of the joint are expected, as {example}")
        try:
            articulation.check_positions(positions)
            given = {joint: float(position) for joint, position in positions.items()}
        except (SceneBuildError, TypeError, OverflowError) as error:
            raise PublishError(f"set_joints({name!r}): {error}") from error
        with self._lock:
            joints = self._joints[name] | given
            self._set_bodies(self._place(name, self._roots[name], joints, self._moved[name]))
            self._joints[name] = joints
            for joint in articulation.joints:
                if joint.name in given:
                    self._note_limits(name, joint, given[joint.name])

    def set_vertices(self, name: str, vertices: ArrayLike) -> None:
        _check_name(name)
        before = self._vertices.get(name)
        if before is None:
            near = _suggest_names(name, self._vertices, "deformables")
            raise PublishError(f"{name!r} is no deformable of this scene; {near}")
        given = _check_array(vertices, before.shape, f"vertices of {name!r}")
        if np.abs(given).max(initial=0.0) > FARTHEST_M:
            raise PublishError(f"vertices of {name!r} are more than 1,000 km away: metres are expected")
        taken = given.astype(np.float32)
        taken.flags.writeable = False
        with self._lock:
            self._vertices[name] = taken

    # --- inside -------------------------------------------------------------------------------------------------------

    def _find_row(self, name: str) -> int:
        row = self._rows.get(name)
        if row is None:
            if name in self._vertices:
                raise PublishError(f"{name!r} is a deformable and has no pose: use set_vertices")
            if name in self._roots:
                raise PublishError(f"{name!r} is an articulation: move its root with set_pose")
            known = _suggest_names(name, (*self._rows, *self._roots), "names")
            raise PublishError(f"nothing that moves is called {name!r} in this scene; {known}")
        return row

    def _move_loose(self, poses: Mapping[str, Pose]) -> None:
        """Move bodies on floating and planar joints, with their subtrees; they stay there when joints are set."""
        moved = {name: self._moved[name].copy() for name in {self._loose[body] for body in poses}}
        for body, pose in poses.items():
            moved[self._loose[body]][body] = pose
        placed = [self._place(name, self._roots[name], self._joints[name], one) for name, one in moved.items()]
        self._moved |= moved
        for one in placed:
            self._set_bodies(one)

    def _place(
        self, name: str, root: Pose, joints: Mapping[str, float], moved: Mapping[str, Pose]
    ) -> Mapping[str, Pose]:
        """Return the poses of the bodies of an articulation. Raises `PublishError` when one is out of range."""
        try:
            placed = self._scene.articulations[name].compute_world_poses(root, joints, moved)
        except ValueError:  # beyond the range in which floats can compute the pose
            placed = {}
        if not placed or not all(abs(v) <= FARTHEST_M for one in placed.values() for v in one.p):  # NaN is not
            raise PublishError(f"{name!r} would lie more than 1,000 km away: metres and radians are expected")
        return placed

    def _set_bodies(self, placed: Mapping[str, Pose]) -> None:
        for body, pose in placed.items():
            self._poses[self._rows[body]] = (*pose.p, *pose.q)

    def _note_limits(self, name: str, joint: Joint, position: float) -> None:
        """Note a joint that is far beyond its limits."""
        slack = BEYOND * (joint.high - joint.low)  # infinite without limits
        if joint.low - slack <= position <= joint.high + slack:
            self._beyond.pop((name, joint.name), None)
        else:
            unit = "m" if joint.kind == "prismatic" else "rad"
            limits = f"{joint.low:.4g} to {joint.high:.4g} {unit}"
            self._beyond[name, joint.name] = (
                f"joint {joint.name!r} of {name!r} is set to {position:.4g} {unit}, far beyond its limits, {limits}"
            )


def _check_names(given: Sequence[str]) -> tuple[str, ...]:
    if isinstance(given, str | bytes) or not isinstance(given, Iterable):
        raise PublishError(f"names is {short_repr(given)}: a list of the names of what moves is expected")
    names = tuple(given)
    for name in names:
        _check_name(name)
    return names


def _check_name(name: object) -> None:
    if not isinstance(name, str):
        raise PublishError(f"{short_repr(name)} is no name: that of something that moves, as text, is expected")


def _check_position(given: Sequence[float], name: str) -> tuple[float, float, float]:
    x, y, z = _check_numbers(given, 3, f"position of {name!r}")
    if not (abs(x) <= FARTHEST_M and abs(y) <= FARTHEST_M and abs(z) <= FARTHEST_M):
        raise PublishError(f"position of {name!r} is ({x:g}, {y:g}, {z:g}): within 1,000 km, in metres, is expected")
    return x, y, z


def _check_quaternion(given: Sequence[float], name: str) -> tuple[float, float, float, float]:
    w, x, y, z = _check_numbers(given, 4, f"quaternion of {name!r}")
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(length - 1.0) <= UNIT:
        right = "(w, x, y, z) of length 1 is expected; (1, 0, 0, 0) turns nothing"
        raise PublishError(f"quaternion of {name!r} has length {length:g}: {right}")
    return w / length, x / length, y / length, z / length


def _check_numbers(given: Sequence[float], n: int, what: str) -> list[float]:
    try:
        numbers = [_to_float(number) for number in given]
    except (TypeError, ValueError, OverflowError) as error:
        raise PublishError(f"{what} is {short_repr(given)}: {n} numbers are expected") from error
    if len(numbers) != n or not all(map(math.isfinite, numbers)):
        raise PublishError(f"{what} is {short_repr(given)}: {n} finite numbers are expected")
    return numbers


def _to_float(given: Any) -> float:
    if isinstance(given, str | bytes):  # `float` would parse digits
        raise TypeError("a text")
    return float(given)


def _reject_texts(array: NDArray[Any]) -> NDArray[Any]:
    if array.dtype.kind in "US":
        raise TypeError("of numbers, not texts")
    return array


def _check_array(given: ArrayLike, shape: tuple[int, ...], what: str) -> NDArray[np.float64]:
    try:
        array = np.asarray(_reject_texts(np.asarray(given)), np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise PublishError(f"{what}: an array of shape {shape} is expected ({error})") from error
    if array.shape != shape:
        raise PublishError(f"{what} have shape {array.shape}: {shape} is expected")
    if not np.isfinite(array).all():
        raise PublishError(f"{what} hold numbers that are not finite")
    return array


def _suggest_names(name: object, known: Iterable[str], what: str) -> str:
    names = sorted(known)
    near = difflib.get_close_matches(str(name), names, n=3, cutoff=0.4)
    if near:
        return f"nearest: {', '.join(map(repr, near))}"
    listed = ", ".join(map(repr, names[:8])) + (", ..." if len(names) > 8 else "")
    return f"{what}: {listed or 'none'}"
