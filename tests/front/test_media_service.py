"""Descriptions of streams that the front sends to clients and reports, without sockets."""

from __future__ import annotations

import threading
from typing import Any

import msgspec

from iris_session.front.connections import FrontConnection, Peer, Route
from iris_session.front.key_budgets import HandshakeLimiter
from iris_session.front.media.scheduler import MediaScheduler
from iris_session.front.media.service import DESCRIPTION_BURST, PERIOD_NS, MediaService
from iris_session.link import FrontConfig
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.media import MediaPush, StreamBudget, StreamCamera, StreamInfo
from iris_session.protocol.status import DeliveryBudget
from tests.front.fakes import make_context

SECOND = 1_000_000_000
CAMERA = StreamCamera(640, 480, 585.0, 585.0, 319.5, 239.5)
ROOM = StreamInfo("Room", "remote", CAMERA, 30.0)


class FakeProxy:
    """The thread's data without the thread."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.scheduler = MediaScheduler()

    def start(self) -> None: ...

    def pop_floods(self) -> list[Any]:
        return []


class Room:
    """A service with one client, and the budgets that it was sent."""

    def __init__(self) -> None:
        self.now_ns = 5 * SECOND
        self.budgets: list[DeliveryBudget] = []  # of ann
        self.others: dict[int, DeliveryBudget] = {}  # the newest one of each other client
        self.proxy = FakeProxy()
        context = make_context(self, lambda: self.now_ns, FrontConfig(adapt_media=False))
        self.connections = context.connections
        self.join(7, Hello("observer", "ann"))
        proxy: Any = self.proxy
        handshakes = HandshakeLimiter(context.config.limits.key, context.drops, bool, lambda *_: False)
        self.service = MediaService(context, proxy, handshakes)
        self.drops = context.drops

    def join(self, number: int, hello: Hello) -> FrontConnection:
        """Admit a client."""
        peer = Peer(number, "")
        client = FrontConnection(number, Route(hello.name.encode()), peer, (f"10.0.0.{number}", 1), "", hello, 0)
        client.admitted, client.participant_id = True, f"p{number}"
        self.connections.add(client)
        return client

    def send_to_route(self) -> None: ...

    def send(self, connection: FrontConnection, message: DeliveryBudget) -> bool:
        if connection.number == 7:
            self.budgets.append(message)
        else:
            self.others[connection.number] = message
        return True

    def push(self, stream: str = "room", info: StreamInfo | None = ROOM, encoding: str = "cloud") -> None:
        push = MediaPush(stream, 1, self.now_ns, encoding=encoding, info=info)
        assert self.proxy.scheduler.push(push, [b"x"], "", self.now_ns)

    def push_from(self, number: int, stream: str = "room") -> bool:
        """Push a frame by a client's own connection to media ingest. Return whether it was taken."""
        push = MediaPush(stream, 1, self.now_ns, encoding="cloud", info=ROOM, connection_epoch=number)
        return self.proxy.scheduler.push(push, [b"x"], "", self.now_ns, 100 + number)

    def tick(self, periods: int = 1) -> int:
        """Return how many budgets were sent."""
        before = len(self.budgets)
        for _ in range(periods):
            self.now_ns += PERIOD_NS
            self.service.tick(self.now_ns)
        return len(self.budgets) - before

    def find(self, stream: str = "room") -> StreamBudget:
        (found,) = [one for one in self.budgets[-1].streams if one.stream == stream]
        return found


def test_client_gets_the_description_and_its_changes() -> None:
    room = Room()
    room.tick()
    room.push()
    assert room.tick() == 1
    expected = StreamBudget("room", encoding="cloud", title="Room", audience="remote", camera=CAMERA, hz=30.0)
    assert room.find() == expected
    room.push(info=None)
    assert room.tick() == 0
    room.push(info=msgspec.structs.replace(ROOM, fault="moved", detail="by 3 cm"))
    assert room.tick() == 1
    assert (room.find().fault, room.find().detail) == ("moved", "by 3 cm")
    room.push()
    assert room.tick() == 1
    assert room.find() == expected


def test_stale_stream_is_told_within_a_second_and_a_quarter() -> None:
    room = Room()
    room.push()
    room.tick(4)
    assert not room.find().stale
    assert room.tick() == 1
    assert room.find().stale
    (report,) = room.service.report_streams()
    assert (report.stale, report.title, report.audience, report.age_ms) == (True, "Room", "remote", 1250.0)
    room.push(info=None)
    assert room.tick() == 1
    assert not room.find().stale
    assert not room.service.report_streams()[0].stale


def test_two_sources_of_one_stream_are_reported_while_they_are() -> None:
    room = Room()
    for n in range(3):
        room.push()
        room.tick()
        assert bool(room.service.list_warnings()) == (n > 1), "once the owner has sent again"
        push = MediaPush("room", 1, room.now_ns)
        assert not room.proxy.scheduler.push(push, [b"x"], "", room.now_ns, 12)
    (text,) = room.service.list_warnings()
    assert "'room'" in text
    room.tick(16)
    assert room.service.list_warnings() == ()


def test_who_sends_in_vain_gets_to_know_who_has_the_stream() -> None:
    room = Room()
    room.join(8, Hello("camera", "room"))
    room.join(9, Hello("camera", "hall"))
    room.tick()
    for _ in range(5):
        assert room.push_from(8)
        assert not room.push_from(9)
        room.tick()
    (told,) = room.others[9].streams
    assert told.taken_by == "camera 'room' at 10.0.0.8"
    assert room.find().taken_by == ""
    assert room.others[8].streams[0].taken_by == ""
    assert room.drops.by_reason["media_stream_taken"] == 5
    assert room.service.report_streams()[0].source == "room"
    room.tick(16)
    assert room.others[9].streams[0].taken_by == "", "it sends no more"


def test_streams_end_with_the_participant_and_not_with_its_connection() -> None:
    room = Room()
    camera, other = room.join(8, Hello("camera", "room")), room.join(9, Hello("camera", "hall"))
    room.tick()
    for number, stream in ((8, "room"), (9, "hall")):
        assert room.push_from(number, stream)
    room.tick()
    room.connections.remove(camera)
    room.proxy.scheduler.release_streams(108)
    room.tick(8)
    assert room.find("room").stale, "it may come back"
    room.service.end_sources(camera.participant_id)
    room.tick()
    assert [one.stream for one in room.budgets[-1].streams] == ["hall"]
    assert not room.push_from(8), "it was on its way"
    assert room.proxy.scheduler.pop_drops()[0] == {"media_source_left": 1}
    room.service.end_sources(other.participant_id)  # while its connection is there
    room.tick()
    assert room.budgets[-1].streams == ()
    assert room.service.report_streams() == ()


def test_changes_with_every_frame_are_sent_at_a_bounded_rate_and_the_last_one_is() -> None:
    room = Room()
    sent = 0
    for n in range(80):  # 20 s
        room.push(info=msgspec.structs.replace(ROOM, detail=str(n)), encoding=f"e{n}")
        sent += room.tick()
    assert DESCRIPTION_BURST < sent <= DESCRIPTION_BURST + 21
    room.tick(4)
    assert (room.find().detail, room.find().encoding) == ("79", "e79")
