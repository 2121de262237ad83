"""An attacker in a session, and a participant that is removed. Keys are those of loopback."""

from __future__ import annotations

import pytest

from anchors.pose import distance
from iris_session.client import Client, DeniedError, RefusedError
from iris_session.client.identity import Identity
from iris_session.protocol.client_messages import EStop, Hello, RemoveParticipant, Sample
from iris_session.protocol.names import AuditKind, DenialReason, FaultCode, RefusalCode, RejectReason
from iris_session.protocol.server_messages import (
    Audited,
    LeaseChanged,
    ParticipantLeft,
    ProtocolFault,
    Refused,
    SamplesRejected,
)
from tests.rig.session import Rig
from tests.rig.test_hostile import Peer

TICK = 0.01  # [s]


def list_rejections(rig: Rig, client: Client) -> set[str]:
    """Return why samples of a client were rejected, as ann has heard."""
    events = rig.list_events("ann", SamplesRejected)
    return {body.reason for _, body in events if body.participant == client.participant_id}


def test_forged_and_replayed_messages_move_nothing_and_are_audited() -> None:
    """An attacker with a stolen token and recorded samples, who also is a participant."""
    with Rig(timestep=TICK) as rig:
        hand = rig.drive("ann", "left")
        ann, eve = hand.client, rig.join("eve")
        epoch, before = ann.connection.connection_epoch, hand.tip
        thief, forger = Peer(rig), Peer(rig)
        thief.send(Hello("operator", "ann", secret=bytes(16), resume_token=ann.connection.identity.resume_token))
        rig.run(0.1)
        assert [answer.code for answer in thief.list_received(Refused)] == [RefusalCode.RESUME_TOKEN]  # type: ignore[attr-defined]

        sniffed: list[Sample] = []
        send = ann.send
        ann.send = lambda message: (sniffed.append(message) if isinstance(message, Sample) else None, send(message))[1]  # type: ignore[method-assign]
        rig.run(0.4)
        del ann.send
        assert len(sniffed) > 20
        hand.velocity = (0.0, 0.0, 0.0)
        for old in sniffed[:20]:
            for sample in (old, sniffed[-1]):  # an old one, and the newest
                forger.send(sample, epoch)  # without hello
                forger.send(sample, epoch, on_behalf_of="ann")
                eve.send(sample)  # from the attacker's own connection
            rig.run(0.02)
        forger.send(EStop("in the name of ann"), epoch, on_behalf_of="ann")
        assert list_rejections(rig, ann) == set()
        for sample in sniffed:  # ann's own connection, old numbers: counted, harmless
            ann.connection.send(sample)
        rig.run(0.1)
        assert list_rejections(rig, eve) == {RejectReason.NOT_HOLDER, RejectReason.STALE}
        assert list_rejections(rig, ann) == {RejectReason.SEQ}
        assert {a.kind for _, a in rig.list_events("ann", Audited)} == {
            AuditKind.TOKEN_MISUSED,
            AuditKind.GATEWAY_REFUSED,
        }
        assert forger.list_received(ProtocolFault)
        assert [b.cause for _, b in rig.list_events("ann", LeaseChanged) if b.previous_holder] == []
        assert not ann.mirror.estop
        assert hand.is_following
        assert distance(before[0], hand.tip[0]) < 1e-4


def test_removed_participant_is_out_at_once_and_others_are_not() -> None:
    """Its robot is free without a grace period, and its key does not come back."""
    with Rig(timestep=TICK) as rig:
        director, bob = rig.join("director", "director"), rig.drive("bob", "right", (0.0, 0.02, 0.0))
        identity = Identity.in_memory()
        ann = rig.join("ann", identity=identity)
        hand = rig.add_hand(ann, "left")
        ann.acquire(["left"])
        rig.engage(hand)
        me = ann.participant_id
        with pytest.raises(DeniedError) as denied:
            bob.client.request(RemoveParticipant(0, me))
        assert denied.value.denial.reason == DenialReason.ROLE
        removed = rig.now_s
        director.submit(RemoveParticipant(0, me, True, "left the lab"))
        rig.run_until(lambda: "ann" in rig.failures, "ann is out", 1.0)
        failure = rig.failures["ann"]
        assert isinstance(failure, RefusedError)
        assert failure.code == FaultCode.REVOKED
        assert rig.now_s - removed < 0.05
        rig.run(0.1)
        assert not director.mirror.leases["left"].holder
        assert [(b.reason, b.grace) for _, b in rig.list_events("director", ParticipantLeft)] == [("removed", False)]
        rig.run(0.2)
        rig.check_rest(director, "left", 0.5)
        assert bob.is_following
        del rig.failures["ann"]
        with pytest.raises(RefusedError):
            rig.join("ann", identity=identity)
