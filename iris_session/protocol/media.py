"""The media channel, version 1: headers, topics, and the message by which a source sends a frame. Latest value wins.

A stream has classes (`BudgetClass`). `half` and `quarter` are coarser forms offered by its source; without one, every
second or fourth frame of the next better class.
"""

from __future__ import annotations

import math
import re
from typing import Annotated, Final

import msgspec

from iris_session.protocol.common import Count, Name, Nanoseconds, Quat, Text, Vec3
from iris_session.protocol.names import BudgetClass, MediaEncoding, StreamAudience

#: Classes from everything to nothing; the index is the level of a class.
CLASSES: Final = (BudgetClass.FULL, BudgetClass.HALF, BudgetClass.QUARTER, BudgetClass.NONE)
MAX_STREAMS: Final = 16
#: Largest width and height of a camera and of an image of encoding `jpeg` [px]. A few hundred bytes can claim any size.
MAX_IMAGE_SIZE: Final = 4096
#: A source does not mean to send more frames a second.
MAX_STREAM_HZ: Final = 1000.0
#: Farthest that a camera is from the origin of its frame [m].
_MAX_DISTANCE_M: Final = 1e6
_UNIT_TOLERANCE: Final = 0.01
_STREAM: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,47}")
_TOPIC: Final = re.compile(rb"media/([1-9][0-9]{0,18})/([A-Za-z0-9][A-Za-z0-9._-]{0,47})/")


class StreamCamera(msgspec.Struct, frozen=True):
    """Camera of a media stream: pinhole with OpenCV's distortion, and where it is.

    `fx`, `fy`, `cx`, `cy` [px]: the centre of the first pixel is at 0. `distortion`: 0, 4, 5 or 8 coefficients (k1, k2,
    p1, p2, k3, ...). `position`, `orientation`: pose of the optical frame (x right, y down, z forward) in the frame of
    `body`, a body of the scene; in the world if that is empty.
    """

    width: Count
    height: Count
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Annotated[tuple[float, ...], msgspec.Meta(max_length=8)] = ()
    body: Name = ""
    position: Vec3 = (0.0, 0.0, 0.0)
    orientation: Quat = (1.0, 0.0, 0.0, 0.0)


class StreamInfo(msgspec.Struct, frozen=True):
    """Description of a stream by its source. `title`: for people; empty: the stream's name. `hz`: frames per second
    that it means to hold, 0 for a stream at rest. `fault`: why its frames are wrong, or do not come; `detail`: the same
    in one line, for people. The session passes on 64 characters of the title, and 256 of the detail.
    """

    title: Text = ""
    audience: Name = StreamAudience.ALL
    camera: StreamCamera | None = None
    hz: float = 0.0
    fault: Name = ""
    detail: Text = ""


class StreamBudget(msgspec.Struct, frozen=True):
    """One media stream, and the class that a client gets. `mbit_per_s`: of that class, as measured. `encoding`: of its
    newest frame, so that a client knows what it would get before it subscribes. `title`, `audience`, `camera`, `hz`,
    `fault`, `detail`: of its newest `StreamInfo`. `stale`: no frame came for so long that the newest one shows what
    was. `taken_by`: what this client sends under the name is refused, because the stream is of that source; else empty.
    """

    stream: Name
    budget_class: Name = BudgetClass.FULL
    mbit_per_s: float = 0.0
    encoding: Name = MediaEncoding.BYTES
    title: Text = ""
    audience: Name = StreamAudience.ALL
    camera: StreamCamera | None = None
    fault: Name = ""
    detail: Text = ""
    stale: bool = False
    taken_by: Text = ""
    hz: float = 0.0


class MediaHeader(msgspec.Struct, frozen=True, array_like=True):
    """Second frame of a media message: topic before it, one bulk frame after it.

    `seq`: of the stream, as its source numbered it; at `half` and `quarter` some are left out. `capture_ns`: when it
    was captured or computed, `published_ns`: when it was passed to the socket, both session time. `dropped`: frames of
    this subscriber that its link did not take before newer ones were there, since it subscribed. `sent_ns`,
    `received_ns`: when its source passed it to a socket and when the session received it, session time; 0: not known.
    """

    stream: Name
    budget_class: Name
    scene_epoch: Count
    seq: Count
    capture_ns: Nanoseconds
    published_ns: Nanoseconds
    encoding: Name = MediaEncoding.BYTES
    dropped: Count = 0
    sent_ns: Nanoseconds = 0
    received_ns: Nanoseconds = 0


class MediaPush(msgspec.Struct, frozen=True, array_like=True):
    """First frame of a source's message; a bulk frame for each of `classes` follows, in their order.

    `classes`: `full`, and any of `half` and `quarter` that the source has in a coarser form; none in a message that has
    an `info` and no frame. `info`: of the stream, with its first frames, when it changes, and once a second; null: as
    before. `sent_ns`: when the source passed the message to its socket, session time; 0: not known. `connection_epoch`:
    of the sender's `Welcome`, by which the session knows whose stream it is; 0: not known.
    """

    stream: Name
    scene_epoch: Count
    capture_ns: Nanoseconds
    classes: tuple[Name, ...] = (BudgetClass.FULL,)
    encoding: Name = MediaEncoding.BYTES
    info: StreamInfo | None = None
    sent_ns: Nanoseconds = 0
    connection_epoch: Count = 0


def find_info_problem(info: StreamInfo) -> str:
    """Return what is wrong with the values of an info that fits the schema, empty if nothing is."""
    if not 0.0 <= info.hz <= MAX_STREAM_HZ:  # not a number fails, too
        return f"hz of a media stream: {info.hz}: 0 to {MAX_STREAM_HZ:g} are expected"
    camera = info.camera
    if camera is None:
        return ""
    if not (1 <= camera.width <= MAX_IMAGE_SIZE and 1 <= camera.height <= MAX_IMAGE_SIZE):
        return f"camera of {camera.width} x {camera.height}: 1 to {MAX_IMAGE_SIZE} pixels are expected"
    values = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    if not all(map(math.isfinite, values)) or min(camera.fx, camera.fy) <= 0.0:
        return "intrinsics of a camera: finite numbers and focal lengths above 0 are expected"
    if len(camera.distortion) not in (0, 4, 5, 8):
        return f"{len(camera.distortion)} distortion coefficients: 0, 4, 5 or 8 are expected"
    if not all(abs(value) <= _MAX_DISTANCE_M for value in camera.position):
        return f"position of a camera: {camera.position}: three numbers of metres are expected"
    if not abs(math.hypot(*camera.orientation) - 1.0) <= _UNIT_TOLERANCE:
        return f"orientation of a camera: {camera.orientation}: a unit quaternion (w, x, y, z) is expected"
    return ""


def is_stream_name(name: str) -> bool:
    """Return true for 1 to 48 letters, digits, `.`, `_`, `-`, beginning with a letter or digit."""
    return _STREAM.fullmatch(name) is not None


def describe_bad_stream_name(name: str) -> str:
    """Return the error text for a name that is not `is_stream_name`."""
    return (
        f"{name!r} cannot be the name of a media stream: 1 to 48 letters, digits, '.', '_' or '-', beginning with a "
        "letter or digit"
    )


def make_topic(connection_epoch: int, stream: str) -> bytes:
    """Return the topic prefix that a client subscribes to. Messages have the class after it."""
    return b"media/%d/%s/" % (connection_epoch, stream.encode())


def parse_topic(topic: bytes) -> tuple[int, str] | None:
    """Parse a topic of `make_topic`; return `None` for anything else."""
    match = _TOPIC.fullmatch(topic)
    return None if match is None else (int(match[1]), match[2].decode())
