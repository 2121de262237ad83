"""The state channel, version 1: header of a rigid-state message, and presence. World frame, latest value."""

from __future__ import annotations

import msgspec

from iris_session.protocol.common import Applied, Count, Name, Nanoseconds, Pose


class StateHeader(msgspec.Struct, frozen=True, array_like=True):
    """First payload frame of a rigid-state message; topic frame before it, encoded poses after it.

    `session_time`: end of the tick that this state belongs to. `published_ns`: session time when handed to the socket.
    `base_seq`: a client that holds any frame >= `base_seq` of this `scene_epoch` has every body within the bound after
    this one; an older client asks for a snapshot. `ticks` are counted within the epoch.
    """

    scene_epoch: Count
    scene_revision: Count
    tick: Count
    sim_time: float
    session_time: Nanoseconds
    published_ns: Nanoseconds
    state_seq: Count
    base_seq: Count
    applied: tuple[Applied, ...] = ()


class PresenceItem(msgspec.Struct, frozen=True, array_like=True):
    """A device of a participant in the world. Only of participants that are aligned."""

    participant: Name
    device: Name
    pose: Pose
    capture_ns: Nanoseconds = 0


class Presence(msgspec.Struct, frozen=True, array_like=True):
    """Message on topic `presence`: heads and hands of everyone, latest value."""

    session_time: Nanoseconds
    published_ns: Nanoseconds
    items: tuple[PresenceItem, ...]


TOPIC_RIGID = b"rigid"
TOPIC_PRESENCE = b"presence"
