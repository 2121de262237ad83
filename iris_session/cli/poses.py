"""Poses on the command line: `x,y,z,qw,qx,qy,qz`, metres and a unit quaternion."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from anchors.pose import PoseTuple

FORM: Final = "X,Y,Z,QW,QX,QY,QZ"
#: Numbers with a comma between them, the first negative: no option looks like that.
_BEGINS_WITH_MINUS: Final = re.compile(r"-[0-9.][^,]*(,[^,]*)+")


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


def joined(words: Sequence[str]) -> list[str]:
    """Words of a command line, where a pose that begins with a minus is joined to its option: alone it would be read as
    an option itself."""
    out: list[str] = []
    for word in words:
        if _BEGINS_WITH_MINUS.fullmatch(word) and out and out[-1].startswith("--") and "=" not in out[-1]:
            out[-1] += f"={word}"
        else:
            out.append(word)
    return out


def add_pose(parser: argparse.ArgumentParser, what: str) -> None:
    """`--pose`, which must be given."""
    parser.add_argument(
        "--pose", type=pose, required=True, metavar=FORM, help=f"{what}: metres, unit quaternion with w first"
    )
