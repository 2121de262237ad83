"""The media channel, version 1: headers, topics, and the message by which a source sends a frame. Latest value wins.

A stream has classes (`BudgetClass`). `half` and `quarter` are coarser forms offered by its source; without one, every
second or fourth frame of the next better class.
"""

from __future__ import annotations

import re
from typing import Final

import msgspec

from iris_session.protocol.common import Count, Name, Nanoseconds
from iris_session.protocol.names import BudgetClass, MediaEncoding

#: Classes from everything to nothing; the index is the level of a class.
CLASSES: Final = (BudgetClass.FULL, BudgetClass.HALF, BudgetClass.QUARTER, BudgetClass.NONE)
MAX_STREAMS: Final = 16
_STREAM: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,47}")
_TOPIC: Final = re.compile(rb"media/([1-9][0-9]{0,18})/([A-Za-z0-9][A-Za-z0-9._-]{0,47})/")


class StreamBudget(msgspec.Struct, frozen=True):
    """One media stream, and the class that a client gets. `mbit_per_s`: of that class, as measured. `encoding`: of its
    newest frame, so that a client knows what it would get before it subscribes.
    """

    stream: Name
    budget_class: Name = BudgetClass.FULL
    mbit_per_s: float = 0.0
    encoding: Name = MediaEncoding.BYTES


class MediaHeader(msgspec.Struct, frozen=True, array_like=True):
    """Second frame of a media message: topic before it, one bulk frame after it.

    `seq`: of the stream, as its source numbered it; at `half` and `quarter` some are left out. `capture_ns`: when it
    was captured or computed, `published_ns`: when it was passed to the socket, both session time. `dropped`: frames of
    this subscriber that its link did not take before newer ones were there, since it subscribed.
    """

    stream: Name
    budget_class: Name
    scene_epoch: Count
    seq: Count
    capture_ns: Nanoseconds
    published_ns: Nanoseconds
    encoding: Name = MediaEncoding.BYTES
    dropped: Count = 0


class MediaPush(msgspec.Struct, frozen=True, array_like=True):
    """First frame of a source's message; a bulk frame for each of `classes` follows, in their order.

    `classes`: `full`, and any of `half` and `quarter` that the source has in a coarser form.
    """

    stream: Name
    scene_epoch: Count
    capture_ns: Nanoseconds
    classes: tuple[Name, ...] = (BudgetClass.FULL,)
    encoding: Name = MediaEncoding.BYTES


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
