"""The hidden state of control, as plain structs that encode exactly (floats as float64, arrays as raw bytes)."""

from __future__ import annotations

import msgspec

from anchors.pose import IDENTITY_POSE, PoseTuple
from iris_session.control.clutch import Latch
from iris_session.protocol.common import Applied

#: A solve this long ago counts as never.
LONG_AGO = -(2**40)


class RobotControlState(msgspec.Struct, array_like=True):
    """One robot. `latch` is set while it is engaged.

    `fresh`: latched in this step, whose sample has not moved the target yet. `want_solve`: the target has moved, or is
    not reached yet. `pending`: newest sample in the target, not yet behind `ctrl`. `commanded`: end-effector target in
    force. `stalls`: solves in a row without progress. `lagging`: the measured joints are far from the commanded ones.
    Output `targets`: `settle`: ticks for which a hold still moves the target, -1 when it has just begun; `carry`: lead
    [m, rad] that the environment's controller needs at rest; `learning`: it may grow.
    """

    T_world_root: PoseTuple = IDENTITY_POSE
    commanded: PoseTuple = IDENTITY_POSE
    latch: Latch | None = None
    fresh: bool = False
    want_solve: bool = False
    pending: Applied | None = None
    applied: Applied | None = None
    last_solve: int = LONG_AGO
    stalls: int = 0
    ramping: bool = False
    proximity: float = 1.0
    lagging: bool = False
    solver_limits: tuple[str, ...] = ()
    settle: int = 0
    carry: tuple[float, float] = (0.0, 0.0)
    learning: bool = False


class ControllerState(msgspec.Struct, array_like=True):
    """The whole memory of `Controller` between calls."""

    now_ns: int
    tick: int
    cursor: int
    robots: list[RobotControlState]
    rest: bytes
    joints: list[bytes]
    moving: bool
    grippers: list[bytes]
    grasp_poses: list[tuple[str, PoseTuple]]
    grasp_written: list[str]
    hold: list[bytes]
    stale: int
    seen_time: float
    estop: bool


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(ControllerState)


def encode_state(state: ControllerState) -> bytes:
    return _encoder.encode(state)


def decode_state(data: bytes) -> ControllerState:
    """Decode a snapshot of control. Raises `msgspec.DecodeError` for other bytes."""
    return _decoder.decode(data)
