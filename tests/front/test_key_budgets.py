"""Budgets of keys: what one key may send and cause over all its connections, on a clock of the test's own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import msgspec
import pytest
import zmq

from iris_session.front.connections import Peer
from iris_session.front.key_budgets import FORGET_NS, HandshakeLimiter, KeyBudget
from iris_session.link import FrontLimits, SceneInfo
from iris_session.protocol.client_messages import Acquire, EStop, GetSnapshot, Hello, Release, Sample
from iris_session.protocol.common import IDENTITY, Target
from iris_session.protocol.entries import Entry
from iris_session.protocol.limits import Drops, KeyLimits
from iris_session.protocol.names import DenialReason
from iris_session.protocol.server_messages import BodyInfo, ProtocolFault, Refused, Reply
from iris_session.security.zap import ZAP_ASSETS, ZAP_CONTROL, ZAP_INGEST, ZAP_MEDIA, ZAP_STATE
from tests.front.intake_rig import HELLO, IntakeRig

MS = 1_000_000
SECOND = 1_000_000_000
SAMPLE = Sample("head", "pose", 1, 0, 1, 0, 1, pose=IDENTITY)


@pytest.fixture
def rig() -> Iterator[IntakeRig]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield IntakeRig(context)
    context.destroy(linger=0)


class KeyRig:
    """Several connections of one key, each with a TCP connection of its own."""

    def __init__(self, rig: IntakeRig, n: int, secret: bytes = b"s" * 16, first: int = 100) -> None:
        self.rig = rig
        self.epochs: list[int] = []
        self.peers = [Peer(first + i, "") for i in range(n)]
        self.routes = [b"%d" % (first + i) for i in range(n)]
        for peer, route in zip(self.peers, self.routes, strict=True):
            self.epochs.append(rig.join(peer, route=route, secret=secret).connection_epoch)
            rig.now_ns += SECOND

    def send(self, i: int, message: object) -> None:
        self.rig.take(message, self.peers[i], self.epochs[i], route=self.routes[i])  # type: ignore[arg-type]


def collect(rig: IntakeRig, counts: Counter[type]) -> list[Entry]:
    entries = rig.entries()
    counts.update(type(entry.message) for entry in entries)
    return entries


def test_the_messages_of_one_key_are_limited_over_all_its_connections(rig: IntakeRig) -> None:
    hog, ann = KeyRig(rig, 8), KeyRig(rig, 1, b"a" * 16, 200)
    kept: Counter[type] = Counter()
    seconds, seq = 5, 0
    for _ in range(seconds * 100):
        rig.now_ns += 10 * MS
        for i in range(8):
            for _ in range(6):  # each connection within its own limit: 600 a second
                seq += 1
                hog.send(i, msgspec.structs.replace(SAMPLE, seq=seq, clutch=bool(seq % 2)))
        ann.send(0, msgspec.structs.replace(SAMPLE, seq=seq))
        kept.update(entry.connection for entry in rig.entries())
    assert sum(kept[epoch] for epoch in hog.epochs) <= 2400 * (seconds + 1)
    assert rig.drops.by_reason["key_messages"] > 5000
    assert kept[ann.epochs[0]] == seconds * 100
    assert any("this key" in m.message for _, m, _ in rig.sent if isinstance(m, ProtocolFault))


def test_requests_for_many_targets_are_weighed_by_the_events_that_they_cause(rig: IntakeRig) -> None:
    hog, kept = KeyRig(rig, 1), Counter[type]()
    robots, objects = tuple(f"arm{i}" for i in range(32)), tuple(f"part{i}" for i in range(8))
    for i in range(100):
        rig.now_ns += 50 * MS
        hog.send(0, Acquire(2 * i + 1, robots, objects))
        hog.send(0, Release(2 * i + 2))
        collect(rig, kept)
    assert kept[Acquire] <= 4 + 5  # a burst of 80 events, then 20 a second, at 22 each
    assert kept[Release] == 100  # what ends something is never denied
    denied = [m.denial for _, m, _ in rig.sent if isinstance(m, Reply) and m.denial is not None]
    assert {denial.reason for denial in denied} == {DenialReason.QUOTA}
    assert "events a second" in denied[0].message
    assert rig.drops.by_reason["key_events"] == 100 - kept[Acquire]


@pytest.mark.parametrize("period", [2, 3])
def test_a_clutch_that_opens_always_passes(rig: IntakeRig, period: int) -> None:
    """Every second sample opens it; or every third, and the one before closes it without a target, which is no way
    around the budget."""
    hog, targets = KeyRig(rig, 1), (Target("left", 1),)
    driven, begins = False, 0
    for i in range(1500):
        rig.now_ns += 10 * MS
        held = () if i % 3 == 1 and period == 3 else targets
        hog.send(0, msgspec.structs.replace(SAMPLE, seq=i, targets=held, clutch=i % period != 0))
        for entry in rig.entries():
            if not isinstance(entry.message, Sample):
                continue  # the audit that names the flood
            drives = entry.message.clutch and bool(entry.message.targets)
            begins += drives and not driven
            driven = drives
        assert not driven or i % period
    assert 100 <= begins <= (80 + 15 * 20) // 2 + 1


def test_a_snapshot_of_a_scene_of_many_bodies_costs_more_than_that_of_an_empty_one(rig: IntakeRig) -> None:
    counts = []
    for i, n_bodies in enumerate((0, 5000)):
        hog, kept = KeyRig(rig, 8, b"%d" % i * 16, 100 * (i + 1)), Counter[type]()
        rig.intake._context.publisher.scene = SceneInfo("", bodies=(BodyInfo(1, "part", True),) * n_bodies)
        for c in range(8):
            for _ in range(8):
                hog.send(c, GetSnapshot(1))
        collect(rig, kept)
        counts.append(kept[GetSnapshot])
    assert counts == [800 // 20, 800 // (20 + 5000 // 50)]


def test_one_key_joins_a_few_times_a_second(rig: IntakeRig) -> None:
    joined = 0
    for i in range(200):
        rig.now_ns += 50 * MS
        rig.take(HELLO, Peer(1000 + i, ""), route=b"x")
        joined += len(rig.entries())
    assert joined <= (80 + 10 * 20) / 4 + 1
    refused = [m for _, m, _ in rig.sent if isinstance(m, Refused)]
    assert "joins too often" in refused[-1].message
    rig.take(Hello("operator", "Bob", secret=b"b" * 16), Peer(5000, ""), route=b"y")
    assert len(rig.entries()) == 1


def test_the_first_stop_counts_at_once_and_the_others_are_merged_into_one_within_half_a_second(rig: IntakeRig) -> None:
    hog, ann = KeyRig(rig, 3), KeyRig(rig, 1, b"a" * 16, 200)
    hog.send(0, EStop("first"))
    assert [e.message for e in rig.entries()] == [EStop("first")]
    stops = 0
    for i in range(300):
        hog.send(i % 3, EStop(f"again {i}"))
        stops += len(rig.entries())
    assert stops <= 4
    assert rig.drops.by_reason["estops_merged"] >= 290
    ann.send(0, EStop("really"))
    assert [e.message for e in rig.entries()] == [EStop("really")]
    rig.now_ns += 500 * MS
    rig.budgets.tick(rig.now_ns)
    assert [e.message for e in rig.entries()] == [EStop("again 299")]
    rig.now_ns += 5 * SECOND
    rig.budgets.tick(rig.now_ns)
    assert rig.entries() == []


def test_each_of_many_behind_a_gateway_is_limited_and_all_together(rig: IntakeRig) -> None:
    rig.join(role="gateway")
    names, epochs = [f"p{i}" for i in range(12)], []
    for name in names:
        rig.now_ns += SECOND
        rig.take(Hello("observer", name, secret=name.encode().ljust(16)), behalf=name)
        (entry,) = rig.entries()
        rig.clients.by_number[entry.connection].admitted = True
        epochs.append(entry.connection)
    put_on, worn = Counter[int](), dict.fromkeys(epochs, True)
    for i in range(1000):  # ten seconds
        rig.now_ns += 10 * MS
        for name, epoch in zip(names, epochs, strict=True):
            rig.take(msgspec.structs.replace(SAMPLE, seq=i, worn=i % 2 > 0), epoch=epoch, behalf=name)
        for entry in rig.entries():
            if isinstance(entry.message, Sample):
                put_on[entry.connection] += entry.message.worn and not worn[entry.connection]
                worn[entry.connection] = entry.message.worn
    budget = (80 + 10 * 20) // 2 + 1  # each time is two events
    assert max(put_on.values()) <= budget
    assert sum(put_on.values()) <= 8 * budget


@pytest.mark.parametrize("kind", ["messages", "bytes"])
def test_all_behind_a_gateway_send_together_what_eight_keys_may(kind: str) -> None:
    limits = FrontLimits()
    gateway = KeyBudget(limits, is_gateway=True)
    people = [KeyBudget(limits, parent=gateway) for _ in range(12)]
    burst = limits.key.message_burst if kind == "messages" else limits.key.byte_burst
    assert [one.take(0, **{kind: burst}) for one in people] == [""] * 8 + [f"key_{kind}"] * 4


def test_handshakes_of_a_key_are_limited_for_each_channel() -> None:
    drops, limits = Drops(), KeyLimits()
    limiter = HandshakeLimiter(limits, drops, lambda key: key == "gate", lambda key, _now_ns: key == "flooder")

    def count_allowed(domain: bytes, key: str, now_ns: int = 0) -> int:
        return sum(limiter.allow(domain, key, "10.0.0.1", now_ns) for _ in range(1000))

    for domain, rate, burst in (
        (ZAP_CONTROL, limits.handshakes, limits.handshake_burst),
        (ZAP_ASSETS, limits.handshakes, limits.handshake_burst),
        (ZAP_STATE, limits.subscriber_handshakes, limits.subscriber_handshake_burst),
        (ZAP_MEDIA, limits.subscriber_handshakes, limits.subscriber_handshake_burst),
    ):
        assert count_allowed(domain, "hog") == burst, "each channel has its own"
        assert count_allowed(domain, "hog", SECOND) == rate
        assert count_allowed(domain, "gate") == limits.gateway_factor * burst
    assert limiter.allow(ZAP_STATE, "ann", "10.0.0.1", 0)
    assert "key_banned" not in drops.by_reason
    assert count_allowed(ZAP_STATE, "flooder") == 0
    assert limiter.allow(ZAP_CONTROL, "flooder", "10.0.0.1", 0), "its hello is refused with the reason"
    assert drops.by_reason["key_banned"] == 1000


# --- media ingest after a flood ---


def make_limiter(drops: Drops) -> HandshakeLimiter:
    return HandshakeLimiter(KeyLimits(), drops, lambda _key: False, lambda _key, _now_ns: False)


def test_a_key_that_floods_media_ingest_is_refused_for_longer_each_time_and_forgiven() -> None:
    limiter, now_ns, seconds = make_limiter(Drops()), 10 * SECOND, []
    for _ in range(8):
        refused = limiter.refuse_source("10.0.0.1", "cam", now_ns, now_ns)
        assert limiter.refuse_source("10.0.0.1", "cam", now_ns, now_ns + MS) == {}, "the same flood"
        seconds.append(refused["cam"] // SECOND)
        assert not limiter.allow(ZAP_INGEST, "cam", "10.0.0.1", now_ns + refused["cam"] - 1)
        now_ns += refused["cam"]
        assert limiter.allow(ZAP_INGEST, "cam", "10.0.0.1", now_ns)
    assert seconds == [1, 2, 4, 8, 16, 32, 60, 60]
    assert limiter.refuse_source("10.0.0.1", "cam", now_ns, now_ns + FORGET_NS + 1) == {"cam": SECOND}


def test_a_flood_without_a_key_is_of_those_that_connected_from_its_address_meanwhile() -> None:
    drops = Drops()
    limiter = make_limiter(drops)
    for key, address, at_s in (
        ("honest", "10.0.0.1", 1),
        ("other", "10.0.0.2", 9),
        ("mallory", "::ffff:10.0.0.1", 9),
        ("mallory2", "10.0.0.1", 12),
    ):
        assert limiter.allow(ZAP_INGEST, key, address, at_s * SECOND)
    now_ns = 14 * SECOND
    assert limiter.refuse_source("10.0.0.1", "", 9 * SECOND, now_ns) == {"mallory": SECOND, "mallory2": SECOND}
    assert [limiter.allow(ZAP_INGEST, key, "10.0.0.1", now_ns) for key in ("honest", "mallory")] == [True, False]
    assert limiter.allow(ZAP_MEDIA, "mallory", "10.0.0.1", now_ns)
    assert drops.by_reason == {"media_backoff": 1}
    assert limiter.allow(ZAP_INGEST, "mallory", "10.0.0.1", now_ns + SECOND)
