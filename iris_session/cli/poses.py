"""Poses on the command line: `x,y,z,qw,qx,qy,qz`, metres and a unit quaternion."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from anchors.pose import PoseTuple

FORM: Final = "X,Y,Z,QW,QX,QY,QZ"


def pose(text: str) -> PoseTuple:
    """Type of poses: position [m] and unit quaternion, w first."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 7 or not all(map(math.isfinite, numbers)) or abs(math.hypot(*numbers[3:]) - 1.0) > 0.01:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a pose: x,y,z in metres and a unit quaternion qw,qx,qy,qz, for example 0,-0.45,0,1,0,0,0"
        )
    x, y, z, *q = numbers
    norm = math.hypot(*q)
    return (x, y, z), (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


def add_pose(parser: argparse.ArgumentParser, what: str) -> None:
    """`--pose`, which must be given."""
    text = f"{what}: metres, unit quaternion with w first; one that begins with a minus as --pose=-0.1,..."
    parser.add_argument("--pose", type=pose, required=True, metavar=FORM, help=text)
