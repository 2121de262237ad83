"""From the authority to clients: order, and only the newest state."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import zmq

from iris_session.front.downlink import Downlink
from iris_session.front.state_publisher import StatePublisher
from iris_session.link import messages as link
from iris_session.link.config import SceneInfo
from iris_session.protocol.server_messages import (
    BodyInfo,
    Event,
    MarkerAdded,
    ParticipantLeft,
    SceneChanged,
    StateHeader,
)
from iris_session.protocol.status import RecorderReport, StatusReport
from tests.front.fakes import make_alignment, make_context


class LinkRig:
    """The authority's end of the link; keeps what is published."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self.socket = context.socket(zmq.PAIR)
        self.socket.bind("inproc://link")
        near = context.socket(zmq.PAIR)
        near.connect("inproc://link")
        self.published: list[tuple[bytes, ...]] = []
        self.heard_of: list[str] = []  # scenes
        publisher = StatePublisher(self, scene(1), lambda: 77)  # type: ignore[arg-type]
        front = make_context(self, lambda: 77, publisher=publisher)
        self.drops, self.publisher, self.authority = front.drops, publisher, front.authority
        self.left: list[str] = []  # participants whose streams have ended
        unused: Any = None
        services: Any = SimpleNamespace(expire_tokens=lambda _: None), unused, unused, make_alignment(front), self, self
        self.downlink = Downlink(front, near, *services)

    def sync_clients(self) -> None:
        """In place of the asset service."""
        self.heard_of.append(self.publisher.scene.scene_hash)

    def end_sources(self, participant_id: str) -> None:
        """In place of the media service."""
        self.left.append(participant_id)

    def send_multipart(self, frames: tuple[bytes, ...]) -> None:
        self.published.append(frames)

    def state(self, tick: int, n: int = 1) -> None:
        header = StateHeader(1, 0, tick, 0.0, tick, 0, 0, 0)
        self.socket.send_multipart((link.STATE, msgspec.msgpack.encode(header), np.zeros((n, 7)).tobytes()))

    def scene(self, n: int) -> None:
        self.socket.send_multipart((link.SCENE, msgspec.msgpack.encode(scene(n))))

    def headers(self) -> list[StateHeader]:
        return [msgspec.msgpack.decode(frames[1], type=StateHeader) for frames in self.published]


def scene(n: int) -> SceneInfo:
    return SceneInfo(f"scene{n}", (), tuple(BodyInfo(i, f"b{i}", True) for i in range(n)), np.ones((n, 7)).tobytes())


@pytest.fixture
def rig() -> Iterator[LinkRig]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield LinkRig(context)
    context.destroy(linger=0)


def test_only_the_newest_pending_state_is_published(rig: LinkRig) -> None:
    for tick in (1, 2, 3):
        rig.state(tick)
    rig.downlink.drain()
    (header,) = rig.headers()
    assert (header.tick, header.state_seq, header.published_ns) == (3, 1, 77)
    assert rig.drops.by_reason == {"state_superseded": 2}
    rig.state(4)
    rig.downlink.drain()
    assert [h.state_seq for h in rig.headers()] == [1, 2]


def test_end_of_a_recording_is_known_from_the_report(rig: LinkRig) -> None:
    for recorder, is_recorded in ((RecorderReport("running"), True), (RecorderReport("ended"), False), (None, True)):
        report = StatusReport(0, "", "", 0, recorder=recorder)
        rig.socket.send_multipart((link.REPORT, link.encoder.encode(report)))
        rig.downlink.drain()
        assert rig.authority.is_recorded is is_recorded


def test_state_precedes_other_pending_messages(rig: LinkRig) -> None:
    order: list[str] = []
    rig.publisher.publish_presence = lambda *_: order.append("presence")  # type: ignore[method-assign]
    rig.publisher.publish = lambda *_: order.append("state") or True  # type: ignore[method-assign, func-returns-value]
    rig.socket.send_multipart((link.PRESENCE, msgspec.msgpack.encode([])))
    rig.state(1)
    rig.downlink.drain()
    assert order == ["state", "presence"]


def test_state_of_the_next_scene_is_published_after_it(rig: LinkRig) -> None:
    rig.state(1)
    rig.scene(2)
    rig.state(2, n=2)
    rig.downlink.drain()
    assert rig.publisher.scene.scene_hash == "scene2"
    assert [h.tick for h in rig.headers()] == [2]
    assert "state_of_other_scene" not in rig.drops.by_reason


def test_new_scene_is_set_in_the_front_before_clients_are_notified(rig: LinkRig) -> None:
    rig.downlink.broadcast = lambda event: rig.heard_of.append(event.body.scene_hash)  # type: ignore[method-assign, union-attr]
    rig.scene(1)
    event = Event(1, 1, 0, SceneChanged(1, 1, "patch", "to everybody"))
    rig.socket.send_multipart((link.DECIDED, link.encoder.encode(link.Decided(1, events=(event,)))))
    rig.scene(2)
    rig.downlink.drain()
    assert rig.heard_of == ["scene1", "to everybody", "scene2"]


def test_media_of_a_participant_end_when_it_has_left_for_good(rig: LinkRig) -> None:
    bodies = ParticipantLeft("p1", "closed", grace=True), ParticipantLeft("p2", "bye", grace=False)
    events = tuple(Event(n, 1, 0, body) for n, body in enumerate(bodies))
    passed: list[object] = []
    rig.downlink._alignment.process_event = passed.append  # type: ignore[method-assign, assignment]
    rig.socket.send_multipart((link.DECIDED, link.encoder.encode(link.Decided(1, events=events))))
    rig.downlink.drain()
    assert rig.left == ["p2"]
    assert passed == list(bodies), "alignment follows every event: anchors that are moved, among others"


def test_keyframe_before_the_first_state_has_the_poses_of_the_scene(rig: LinkRig) -> None:
    rig.state(1)
    rig.downlink.drain()
    assert rig.publisher.read_keyframe()[0] == 1
    rig.scene(2)
    rig.downlink.drain()
    assert rig.publisher.read_keyframe() == (0, np.ones((2, 7)).tobytes())
    rig.state(3, n=2)
    rig.downlink.drain()
    assert rig.publisher.read_keyframe()[0] == 2


def test_decision_beyond_the_limits_does_not_end_the_front(rig: LinkRig) -> None:
    event = Event(1, 1, 0, MarkerAdded("p1", "x" * 3000))
    rig.socket.send_multipart((link.DECIDED, link.encoder.encode(link.Decided(1, events=(event,)))))
    rig.state(1)
    rig.downlink.drain()
    assert rig.drops.by_reason == {"decision_invalid": 1}
    assert [h.tick for h in rig.headers()] == [1]
