"""The authority's side of the link, against a bare PAIR socket in place of the front."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zmq

from iris_session.link import FrontConfig, FrontLink, Ports, SceneInfo, messages
from iris_session.link import front_link as link_module
from iris_session.protocol.client_messages import EStop, Heartbeat, Marker
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.entries import Entry, FrontRestarted, encode_entries
from iris_session.protocol.server_messages import Event, Notice, ParticipantLeft, PresenceItem, StateHeader
from iris_session.protocol.steps import Command, Decision, Dropped

EVENT = Decision((), events=(Event(1, 1, 0, Notice("info", "x")),))


class Pair:
    """Link and far end, with a clock of its own."""

    def __init__(self, folder: Path) -> None:
        self.now_ns = 1_000_000_000
        self.link = FrontLink(FrontConfig(origin_ns=500), monotonic_ns=lambda: self.now_ns)
        self.folder = folder
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.far = self.connect("a")

    def connect(self, name: str) -> zmq.Socket[bytes]:
        far = self.context.socket(zmq.PAIR)
        far.linger = 0
        far.connect(self.link.open(self.folder / name))
        return far

    def say(self, kind: bytes, payload: bytes) -> None:
        self.far.send_multipart((kind, payload))

    def hand_back(self, step: int, state: bytes) -> None:
        self.say(messages.HANDBACK, msgspec.msgpack.encode(messages.TokenState(step, state)))

    def ready(self) -> None:
        self.say(messages.READY, msgspec.msgpack.encode(Ports("127.0.0.1", 1, 2)))
        while self.link.ports is None:
            self.link.poll()

    def poll(self, n: int) -> list[Entry]:
        entries: list[Entry] = []
        for _ in range(100_000):
            entries += self.link.poll()
            if len(entries) >= n:
                return entries
        raise AssertionError(f"only {len(entries)} of {n} entries came")

    def heard(self) -> list[list[bytes]]:
        frames = []
        while self.far.poll(100 if not frames else 20):
            frames.append(self.far.recv_multipart())
        return frames

    def close(self) -> None:
        self.link.close()
        self.context.destroy(linger=0)


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    one = Pair(tmp_path)
    yield one
    one.close()


def batch(*texts: str) -> bytes:
    return encode_entries([Entry(1, 1, i, Marker(i, text)) for i, text in enumerate(texts)])


def test_entries_are_ordered_and_half_of_the_credits_acknowledged_at_once(pair: Pair) -> None:
    pair.ready()
    for i in range(8):
        pair.say(messages.ENTRIES, batch(f"{i}a", f"{i}b"))
    texts = [e.message.text for e in pair.poll(16) if isinstance(e.message, Marker)]
    assert texts == [f"{i}{c}" for i in range(8) for c in "ab"]
    acks = [frames[1][0] for frames in pair.heard() if frames[0] == messages.ACK]
    assert min(acks) >= 4
    assert 8 - 4 < sum(acks) <= 8  # fewer than half may still be owed: the batches need not come at once


def test_nothing_is_sent_before_the_front_is_ready(pair: Pair) -> None:
    pair.link.send_decision(1, EVENT)
    pair.link.send_state(StateHeader(1, 0, 0, 0.0, 0, 0, 0, 0), np.zeros((1, 7)))
    pair.ready()
    assert pair.heard() == []


def test_empty_decisions_are_not_sent_except_as_keep_alive(pair: Pair) -> None:
    pair.ready()
    pair.link.send_decision(1, Decision((Command("left", "hold", "no_lease"),)))
    assert [frames[0] for frames in pair.heard()] == [messages.ALIVE]
    pair.now_ns += messages.KEEPALIVE_NS // 2
    pair.link.send_decision(2, Decision(()))
    assert pair.heard() == []
    pair.now_ns += messages.KEEPALIVE_NS
    pair.link.send_decision(3, Decision(()))
    pair.link.send_decision(4, EVENT)
    alive, decided = pair.heard()
    assert alive[0] == messages.ALIVE
    assert messages.decode_decided(decided[1]) == messages.Decided(4, events=EVENT.events)


def test_presence_is_latest_per_device_and_follows_the_state(pair: Pair) -> None:
    pair.ready()
    decode = msgspec.msgpack.Decoder(tuple[PresenceItem, ...]).decode

    def at(step: int, *devices: str) -> Decision:
        return Decision((), presence=tuple(PresenceItem("p1", device, IDENTITY, step) for device in devices))

    def sent() -> list[list[tuple[str, int]]]:
        heard = [frames for frames in pair.heard() if frames[0] != messages.ALIVE]
        return [[(i.device, i.capture_ns) for i in decode(f[1])] if f[0] == messages.PRESENCE else [] for f in heard]

    pair.link.send_decision(1, at(1, "head"))
    pair.heard()
    pair.link.send_decision(2, at(2, "head", "hand/left"))
    pair.link.send_decision(3, at(3, "head"))
    pair.now_ns += 16_000_000
    pair.link.send_state(StateHeader(1, 0, 0, 0.0, 0, 0, 0, 0), np.zeros((1, 7)))
    assert sent() == [[], [("head", 3), ("hand/left", 2)]]  # the state, and right after it who is where
    pair.link.send_decision(4, at(4, "head"))
    assert sent() == []
    pair.now_ns += link_module.PRESENCE_ALONE_NS
    pair.link.send_decision(5, Decision(()))
    assert sent() == [[("head", 4)]]  # no state came: presence does not wait for ever


def test_stalled_front_loses_states_but_no_decisions_until_it_is_replaced(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link_module, "_BACKLOG", 5000)
    pair.ready()
    poses = np.zeros((2000, 7))
    for step in range(3000):
        pair.link.send_state(StateHeader(1, 0, step, 0.0, 0, 0, 0, 0), poses)
        pair.link.send_decision(step, EVENT)
    assert pair.link.state_drops > 0
    assert not pair.link.overrun
    steps: list[int] = []
    for _ in range(200):
        for frames in pair.heard():
            if frames[0] == messages.DECIDED:
                steps.append(messages.decode_decided(frames[1]).step)
        pair.link.send_decision(9999, EVENT)
        if 2999 in steps:
            break
    assert [s for s in steps if s != 9999] == list(range(3000))
    for step in range(20_000):
        pair.link.send_decision(step, EVENT)
    assert pair.link.overrun


def test_new_front_is_announced_once_and_old_entries_are_dropped(pair: Pair) -> None:
    pair.ready()
    pair.hand_back(0, b"memory")
    pair.say(messages.ENTRIES, batch("old"))
    pair.poll(1)
    pair.far.close()
    pair.far = pair.connect("b")
    assert pair.link.ports is None
    (restarted,) = pair.poll(1)
    assert restarted == Entry(0, 0, pair.now_ns - 500, FrontRestarted())
    assert pair.link.poll() == []
    assert pair.link.handback == b"memory"
    pair.ready()
    pair.say(messages.ENTRIES, encode_entries([Entry(2, 2, 5, EStop())]))
    assert pair.poll(1)[0].connection == 2


def test_revocations_are_repeated_until_a_front_has_applied_them(pair: Pair) -> None:
    """Also one that a director asks for while there is no front."""

    def list_revoked() -> list[list[str]]:
        said = [messages.decode_decided(frames[1]) for frames in pair.heard() if frames[0] == messages.DECIDED]
        return [[dropped.key_id for dropped in decided.dropped] for decided in said]

    def restart(name: str) -> None:
        pair.far.close()
        pair.far = pair.connect(name)

    pair.ready()
    pair.link.send_decision(5, Decision((), dropped=(Dropped(1, "revoked", "ann"), Dropped(2, "left"))))
    restart("b")  # which has not read it
    pair.link.send_decision(6, Decision((), dropped=(Dropped(0, "revoked", "bob"),)))
    pair.ready()
    assert list_revoked() == [["ann", "bob"]]
    pair.hand_back(5, b"tokens")
    while pair.link.handback != b"tokens":
        pair.link.poll()
    restart("c")
    pair.ready()
    assert list_revoked() == [["bob"]]
    pair.hand_back(6, b"newer")
    while pair.link.handback != b"newer":
        pair.link.poll()
    restart("d")
    pair.ready()
    assert list_revoked() == []


def test_failure_status_and_scene_are_forwarded(pair: Pair) -> None:
    pair.say(messages.FAILED, b"port 1 is in use")
    while not pair.link.failure:
        pair.link.poll()
    assert pair.link.failure == "port 1 is in use"
    pair.ready()
    status = messages.FrontStatus(2, {"rate": 3}, {1: 3}, 0, 10, 20)
    pair.say(messages.STATUS, msgspec.msgpack.encode(status))
    pair.say(messages.ENTRIES, encode_entries([Entry(1, 1, 1, Heartbeat())]))
    pair.poll(1)
    assert pair.link.status == status
    pair.link.send_scene(SceneInfo("other"))
    pair.link.send_end()
    scene, end = pair.heard()
    assert messages.decode_scene(scene[1]).scene_hash == "other"
    assert end[0] == messages.END


def test_last_messages_of_a_dead_front_are_read(pair: Pair) -> None:
    pair.ready()
    stop = Entry(3, 3, 5, EStop("stop"))
    pair.say(messages.ENTRIES, encode_entries([stop]))
    pair.hand_back(0, b"tokens")
    assert pair.link._socket is not None
    with pair.link._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED) as monitor:
        pair.far.close(linger=30_000)
        assert monitor.poll(30_000), "everything that it said has come by then"
        pair.link._socket.disable_monitor()
    pair.far = pair.connect("b")
    assert pair.link.handback == b"tokens"
    heard = [entry.message for entry in pair.link.poll()]
    assert heard == [EStop("stop"), FrontRestarted()]


def test_presence_is_not_sent_after_the_participant_left(pair: Pair) -> None:
    pair.ready()
    heads = tuple(PresenceItem(name, "head", IDENTITY) for name in ("p1", "p2"))
    pair.link.send_decision(1, Decision((), presence=heads))
    pair.heard()
    left = Event(1, 2, 0, ParticipantLeft("p1", "bye"))
    pair.link.send_decision(2, Decision((), presence=heads, events=(left,)))
    pair.now_ns += link_module.PRESENCE_ALONE_NS
    pair.link.send_decision(3, Decision(()))
    items = [msgspec.msgpack.decode(f[1], type=list[PresenceItem]) for f in pair.heard() if f[0] == messages.PRESENCE]
    assert items == [[heads[1]]]


def test_silence_of_a_front_counts_only_while_polling(pair: Pair) -> None:
    pair.ready()
    pair.now_ns += 60_000_000_000
    pair.link.poll()
    assert pair.link.silence_ns <= link_module.LOOKED_NS
    for _ in range(100):
        pair.now_ns += 10_000_000
        pair.link.poll()
    assert pair.link.silence_ns >= 1_000_000_000
    pair.say(messages.BEAT, b"")
    while pair.link.silence_ns:
        pair.link.poll()
