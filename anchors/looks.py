"""Looks at an anchor: which poses count, those measured just now, from a head at rest, at a place of its own.

Sources of poses repeat them, report the origin before they have any, and number viewpoints as they like. So a pose that
is bit for bit one of the last ones is no look, nor is the origin with identity, nor one from a head in motion: the
picture is older than the head pose that it is combined with. Viewpoints are places of the head. Pure.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from anchors.pose import IDENTITY_QUAT, PoseTuple, Vec3

#: Why a pose is no look.
ZERO: Final = "at the exact origin: the source has no pose yet"
REPEATED: Final = "repeated: this source repeats poses"
MOVING: Final = "while the head moved: stand still"

#: Zero within rounding, [m] and per component of the quaternion.
_ZERO: Final = 1e-9
#: Poses compared with a new one: two prints of one id may be reported in turn.
_REMEMBERED_POSES: Final = 8
_MAX_SOURCES: Final = 64
#: A head this far from the centre of a place is elsewhere [m], a quarter more to leave it. At half a metre from a sheet
#: that is 14 degrees; assumed: no correlation of errors between viewpoints was ever measured.
PLACE_RADIUS_M: Final = 0.12
_STAY_RADIUS_M: Final = 1.25 * PLACE_RADIUS_M
_MAX_PLACES: Final = 256
#: Viewpoints that a client may claim without head poses: those of one ordinary survey.
MAX_CLAIMED: Final = 3
#: Motion of a head beyond which what it sees is not used: slow walking; twice the fastest sway of standing people.
MAX_SPEED_M_PER_S: Final = 0.15
MAX_TURN_RAD_PER_S: Final = math.radians(15.0)


#: What reports poses: anchor, kind of observation, device.
Source = tuple[str, str, str]


class HeadMotion(NamedTuple):
    """Pose and velocity of a head, tracking frame; [m/s], [rad/s]."""

    T_tracking_head: PoseTuple
    v: Vec3
    w: Vec3

    @property
    def is_fast(self) -> bool:
        """True if looks of it are not used."""
        return math.hypot(*self.v) > MAX_SPEED_M_PER_S or math.hypot(*self.w) > MAX_TURN_RAD_PER_S

    def compute_shift(self, p_tracking_anchor: Vec3) -> tuple[float, ...]:
        """Return by how much an anchor is displaced and turned per second that its picture is late (6,)."""
        x, y, z = (a - b for a, b in zip(p_tracking_anchor, self.T_tracking_head[0], strict=True))
        (vx, vy, vz), (wx, wy, wz) = self.v, self.w
        return (vx + wy * z - wz * y, vy + wz * x - wx * z, vz + wx * y - wy * x, wx, wy, wz)


class Look(NamedTuple):
    """A look at an anchor. `shift` (6,): displacement [m/s] and turn [rad/s] of the anchor per second that its picture
    is late, empty if the head's motion is unknown."""

    viewpoint_id: int
    p_tracking_head: Vec3 | None = None
    shift: tuple[float, ...] = ()


def is_zero_pose(pose: PoseTuple) -> bool:
    """Return whether a pose is the identity, as reported by a source that has none."""
    p, q = pose
    sign = -1.0 if q[0] < 0.0 else 1.0
    turned = (abs(sign * a - b) for a, b in zip(q, IDENTITY_QUAT, strict=True))
    return max(abs(c) for c in p) <= _ZERO and max(turned) <= _ZERO


@dataclass
class LookFilter:
    """Poses and places of one headset. `is_new` has memory: ask once about each pose."""

    _poses: dict[Source, deque[PoseTuple]] = field(default_factory=dict)
    _places: dict[int, Vec3] = field(default_factory=dict)
    _claimed: dict[int, int] = field(default_factory=dict)
    _place: int = 0
    _numbered: int = 0

    def is_new(self, source: Source, pose: PoseTuple) -> bool:
        """Return false for a pose that this source has just reported, bit for bit (or with the other sign of q)."""
        p, q = pose
        same = (p, (-q[0], -q[1], -q[2], -q[3])) if q[0] < 0.0 else (p, q)
        known = self._poses.setdefault(source, deque(maxlen=_REMEMBERED_POSES))
        if same in known:
            return False
        known.append(same)
        while len(self._poses) > _MAX_SOURCES:
            del self._poses[next(iter(self._poses))]
        return True

    def number_viewpoint(self, p_tracking_head: Vec3 | None, claimed_id: int) -> int:
        """Return the number of the viewpoint: that of the head's place, whatever number the client gives.

        Without a head pose the client's numbers count, the first `MAX_CLAIMED - 1` of them each, all others as one.
        """
        if p_tracking_head is None:
            if claimed_id not in self._claimed and len(self._claimed) < MAX_CLAIMED - 1:
                self._claimed[claimed_id] = -1 - len(self._claimed)
            return self._claimed.get(claimed_id, -MAX_CLAIMED)
        here = self._places.get(self._place)
        if here is not None and math.dist(here, p_tracking_head) <= _STAY_RADIUS_M:
            return self._place
        near = min(self._places, key=lambda k: math.dist(self._places[k], p_tracking_head), default=None)
        if near is not None and math.dist(self._places[near], p_tracking_head) <= PLACE_RADIUS_M:
            self._place = near
            return near
        self._numbered += 1
        self._place = self._numbered
        self._places[self._place] = p_tracking_head
        if len(self._places) > _MAX_PLACES:
            del self._places[next(iter(self._places))]
        return self._place

    def forget_viewpoints(self) -> None:
        """Forget where the head was: the tracking frame has changed. Poses are remembered, as they may be repeated."""
        self._places.clear()
        self._claimed.clear()
