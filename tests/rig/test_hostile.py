"""Clients that flood or send garbage: they are cut off and named, and other clients go on undisturbed."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import msgspec
import pytest

from iris_session.client import Client
from iris_session.protocol.client_messages import ClientMessage, GetSnapshot, Hello, Sample, wrap_message
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.names import AuditKind, FaultCode
from iris_session.protocol.server_messages import (
    Audited,
    EngagementChanged,
    Message,
    ProtocolFault,
    Refused,
    SamplesRejected,
    Welcome,
)
from tests.rig.session import Hand, Rig

MS = 1_000_000
TICK = 0.01  # [s]
#: Messages that a flood sends at a time, and how often it does [s].
BURST, BURST_S = 100, 0.01


class Peer:
    """A control connection without any logic behind it."""

    def __init__(self, rig: Rig) -> None:
        self.sockets = rig.connect_raw()
        self.received: list[object] = []

    def send(self, message: ClientMessage, epoch: int = 0, on_behalf_of: str = "") -> None:
        self.sockets.send_control(encode_client(wrap_message(message, epoch, on_behalf_of)))

    def list_received(self, kind: type[Message]) -> list[Message]:
        while frames := self.sockets.drain_control():
            self.received += [decode_server(one[0]).message for one in frames]
        return [message for message in self.received if isinstance(message, kind)]

    def join(self, rig: Rig, name: str = "Mallory") -> Welcome:
        self.send(Hello("observer", name, alignment="not_needed", secret=name.ljust(16).encode()))
        rig.run_until(lambda: self.list_received(Welcome), f"{name} is welcome", 1.0)
        welcome = self.list_received(Welcome)[-1]
        assert isinstance(welcome, Welcome)
        return welcome


class Undisturbed:
    """Ann drives and Eve observes while something else goes on in a session."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.ages_ms: list[float] = []
        self.eve: Client = rig.join("eve", "observer", on_state=lambda state: self.ages_ms.append(state.age_ns * 1e-6))
        self.hand: Hand = rig.drive("ann", "left", (0.0, 0.02, 0.0))
        rig.run(1.2)  # both have reported
        self._drops = self._count_drops()
        self._begun = len(rig.events["eve"])
        self._tip, self._since = self.hand.tip, rig.now_s
        self.ages_ms.clear()

    def _count_drops(self) -> tuple[int, int]:
        row = next(p for p in self.eve.status().participants if p.name == "ann")
        return row.drops, sum(row.rejected.values())

    def check(self) -> None:
        """Check that the robot followed all the time, that state came at its rate and not late; nothing was lost."""
        rig, seconds, ann = self.rig, self.rig.now_s - self._since, self.hand.client.participant_id
        log = [event.body for event in rig.events["eve"][self._begun :]]
        about_ann = [b for b in log if isinstance(b, EngagementChanged | SamplesRejected) and b.participant == ann]
        assert about_ann == []
        assert self.hand.tip[0][1] - self._tip[0][1] == pytest.approx(0.02 * seconds, abs=2e-3)
        assert len(self.ages_ms) > 45 * seconds
        assert max(self.ages_ms) < 1.0
        assert self._count_drops() == self._drops
        assert {c.connection.counters.reconnects for c in (self.eve, self.hand.client)} == {0}

    def list_floods(self) -> list[tuple[int, Audited]]:
        return [(at, a) for at, a in self.rig.list_events("eve", Audited) if a.kind == AuditKind.FLOOD]


def flood_samples(peer: Peer, epoch: int) -> Iterator[None]:
    sample = Sample("head", "pose", 1, 0, 1, 0, 0, pose=IDENTITY)
    seq = 0
    while True:
        seq += 1
        peer.send(msgspec.structs.replace(sample, seq=seq, clutch=seq % 2 == 0), epoch)
        yield


def flood_snapshots(peer: Peer, epoch: int) -> Iterator[None]:
    while True:
        peer.send(GetSnapshot(1), epoch)
        yield


@pytest.mark.parametrize(
    ("flood", "name"), [(flood_samples, "sample"), (flood_snapshots, "get_snapshot")], ids=["samples", "snapshots"]
)
def test_flood_of_a_participant_is_cut_and_reported(flood: Callable[[Peer, int], Iterator[None]], name: str) -> None:
    with Rig(timestep=TICK) as rig:
        both, peer = Undisturbed(rig), Peer(rig)
        stream = flood(peer, peer.join(rig).connection_epoch)
        connection = peer.sockets.connection
        begun_ns, begun_step = rig.session.clock(), len(rig.journal.rows)
        while not both.list_floods() and rig.session.clock() - begun_ns < 3_000 * MS:
            for _ in range(BURST):
                next(stream)
            rig.run(BURST_S)
        rig.run(0.1)
        assert {audit.detail for _, audit in both.list_floods()} == {name}
        assert both.list_floods()[0][0] - begun_ns < 1_500 * MS
        assert connection is not None
        assert not connection.is_open
        assert any("flood" in text and text.endswith(f": {name}") for text in both.eve.status().warnings)
        entries = [len(row.entry_lengths) for row in rig.journal.rows[begun_step:]]
        assert max(entries) < 64, "what reaches a step is bounded"
        both.check()


def test_garbage_disturbs_no_client() -> None:
    """It comes from a participant and from somebody who is none; a few of the messages are answered."""
    with Rig(timestep=TICK) as rig:
        both, participant, stranger = Undisturbed(rig), Peer(rig), Peer(rig)
        participant.join(rig)
        random = rig.simulation.random
        for n in range(600):
            for peer in (participant, stranger):
                peer.sockets.send_control(random.randbytes(1 + n % 300))
            rig.run(0.001)
        assert 1 <= len(participant.list_received(ProtocolFault)) < 20
        assert 1 <= len(stranger.list_received(Refused)) < 100
        assert {fault.code for fault in participant.list_received(ProtocolFault)} == {FaultCode.MALFORMED}  # type: ignore[attr-defined]
        stranger.join(rig, "Eve")
        both.check()
