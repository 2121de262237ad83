"""Bases of all messages, and value types shared by messages, entries and views: poses, targets, leases, denials."""

from __future__ import annotations

from typing import Annotated

import msgspec

#: A name typed by a person: robot, object, participant, anchor.
Name = Annotated[str, msgspec.Meta(max_length=64)]
#: Characters of a `Text`.
MAX_TEXT = 512
#: Free text shown to a person.
Text = Annotated[str, msgspec.Meta(max_length=MAX_TEXT)]
#: A few names: devices, robots, roles.
Names = Annotated[tuple[Name, ...], msgspec.Meta(max_length=32)]
#: Any counter, epoch, version or nanosecond count. Fits an int64 in every client language.
Count = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Nanoseconds = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
#: HMAC-SHA256 of a join code (`protocol.pairing`).
Proof = Annotated[bytes, msgspec.Meta(max_length=64)]
#: Metres (or metres per second), x y z.
Vec3 = tuple[float, float, float]
#: Unit quaternion `[w, x, y, z]`.
Quat = tuple[float, float, float, float]


class Message(msgspec.Struct, frozen=True, tag_field="type"):
    """Base of all tagged messages."""


class EventBody(msgspec.Struct, frozen=True, tag_field="event"):
    """Base of all event bodies."""


class Pose(msgspec.Struct, frozen=True, array_like=True):
    """A rigid transform `T_a_b`: position `p` [m] of frame b in a, rotation `q` `[w, x, y, z]` from b to a."""

    p: Vec3
    q: Quat


IDENTITY = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


class Target(msgspec.Struct, frozen=True, array_like=True):
    """Target of a sample, and the lease that it is driven under. `lease_version` is the fencing token."""

    name: Name
    lease_version: Count
    kind: Name = "robot"


class Lease(msgspec.Struct, frozen=True):
    """Public state of one lease. `holder` is a participant id, empty when free.

    `expires_ns` is the session time at which the grace period of a disconnected holder ends, 0 while it is connected.
    `sub_holders` and `weights` have the same length: everyone who shares the target (mode `shared`, objects), or an
    agent and the human who stands by (mode `priority`; the one in charge is `holder` and has weight 1, the other 0). In
    mode `shared` a token stays valid for its holder when others join and raise `lease_version`. `scale`: motion scaling
    of a robot for its `holder`, 1 by default.
    """

    target: Name
    kind: Name
    mode: Name
    holder: Name
    lease_version: Count
    expires_ns: Nanoseconds = 0
    queue: tuple[Name, ...] = ()
    sub_holders: tuple[Name, ...] = ()
    weights: tuple[float, ...] = ()
    scale: float = 1.0


def cut_texts(message: msgspec.Struct, *fields: str) -> None:
    """Cut fields of a message to the length of a `Text`: a longer one makes its receiver refuse the whole message."""
    for field in fields:
        text = getattr(message, field)
        if len(text) > MAX_TEXT:
            msgspec.structs.force_setattr(message, field, text[: MAX_TEXT - 3] + "...")


class Denial(msgspec.Struct, frozen=True):
    """A typed denial: the reason (`DenialReason`), the holder of the target, and advice.

    Texts that list what would have been right are cut to the length of a `Text`.
    """

    reason: Name
    message: Text
    advice: Text = ""
    target: Name = ""
    holder: Name = ""
    holder_name: Name = ""

    def __post_init__(self) -> None:
        # A scene may have hundreds of names.
        cut_texts(self, "message", "advice")


class Alignment(msgspec.Struct, frozen=True):
    """`T_world_tracking` of one participant, as accepted by the authority.

    `covariance`: 6x6 row-major, order (x, y, z [m], rx, ry, rz [rad]), world frame, empty when unknown; that of the
    position is stated at `pivot_world`.
    `error_at_anchor_m`, `error_at_robot_m`: stated p95 of the position error at the anchor and at the robot.
    """

    version: Count
    kind: Name
    T_world_tracking: Pose
    tracking_epoch: Count = 0
    covariance: tuple[float, ...] = ()
    error_at_anchor_m: float = 0.0
    error_at_robot_m: float = 0.0
    offset: bool = False
    pivot_world: Vec3 = (0.0, 0.0, 0.0)


class Applied(msgspec.Struct, frozen=True, array_like=True):
    """The newest sample that entered the IK target behind the `ctrl` in use, for one robot. All times session time."""

    robot: Name
    participant: Name
    device: Name
    seq: Count
    capture_ns: Nanoseconds
    receive_ns: Nanoseconds
    step_ns: Nanoseconds
