"""What directors and the front say about who may be here: removal, revocation, roles of keys, audit, two directors."""

from __future__ import annotations

import pytest

from iris_session.protocol.client_messages import Acquire, EStop, RemoveParticipant
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.entries import Audit, Lost
from iris_session.protocol.names import AuditKind, DenialReason
from iris_session.protocol.server_messages import Audited, ParticipantLeft, Refused
from iris_session.protocol.steps import Dropped

from .table import Table
from .test_roster import rejoin


@pytest.mark.parametrize("revoke", [False, True])
def test_a_director_removes_somebody_at_once_and_without_grace(revoke: bool) -> None:
    t = Table()
    director, ann = t.join("director"), t.operator("left")
    bob = t.join()
    assert bob.asks(Acquire(7, ("left",))).denial.reason == DenialReason.HELD
    assert director.asks(RemoveParticipant(1, ann.id, revoke, "took the wrong robot")).ok
    word = "revoked" if revoke else "removed"
    assert t.decision.dropped == (Dropped(ann.connection, word, "key2" if revoke else ""),)
    kind = AuditKind.KEY_REVOKED if revoke else AuditKind.REMOVED
    (audited,) = t.since(Audited)
    assert audited == Audited(kind, ann.id, "person2", "", "person1: took the wrong robot")
    assert t.since(ParticipantLeft) == [ParticipantLeft(ann.id, "removed")]
    assert t.hold() == "no_lease"
    assert bob.asks(Acquire(8, ("left",))).ok
    t.step(ann.says(EStop("late words")))
    t.step(ann.says(Lost("closed")))  # the front closes what is gone already
    assert t.decision.dropped == ()
    assert rejoin(t, ann).connection in {a.connection for a in t.decision.admitted}
    assert not t.decision.admitted[0].resumed, "it comes back as somebody new"


def test_who_is_away_is_removed_with_the_lease_that_was_kept() -> None:
    t = Table()
    director, ann = t.join("director"), t.operator("left")
    t.step(ann.says(Lost("closed")))
    assert director.asks(RemoveParticipant(1, ann.id, revoke=True)).ok
    assert t.decision.dropped == (Dropped(0, "revoked", "key2"),), "the front finds its key without a connection"
    assert t.since(ParticipantLeft) == [ParticipantLeft(ann.id, "removed")]
    rejoin(t, ann)
    assert not t.decision.admitted[0].resumed


def test_only_directors_and_the_host_remove_and_only_who_is_there() -> None:
    t = Table()
    ann, bob = t.join(), t.join()
    assert ann.asks(RemoveParticipant(1, bob.id)).denial.reason == DenialReason.ROLE
    director = t.join("director")
    denial = director.asks(RemoveParticipant(2, "p99")).denial
    assert (denial.reason, denial.advice) == (DenialReason.UNKNOWN_PARTICIPANT, "use an id of the roster")
    assert director.asks(RemoveParticipant(3, "host")).denial.reason == DenialReason.UNKNOWN_PARTICIPANT
    t.step(t.host(RemoveParticipant(0, bob.id, reason="key revoked")))
    assert t.decision.dropped == (Dropped(bob.connection, "removed"),)


def test_a_director_may_remove_itself_and_a_gateway_takes_its_people_along() -> None:
    t = Table()
    director, gateway = t.join("director"), t.join("gateway")
    tab = t.join(gateway=gateway.connection)
    assert director.asks(RemoveParticipant(1, gateway.id)).ok
    assert {e.participant for e in t.since(ParticipantLeft)} == {gateway.id, tab.id}
    assert director.asks(RemoveParticipant(2, director.id)).ok
    assert t.decision.dropped == (Dropped(director.connection, "removed"),)


@pytest.mark.parametrize(
    ("role", "roles", "allowed"),
    [
        ("operator", (), True),
        ("operator", ("observer", "operator"), True),
        ("director", ("observer", "operator"), False),
        ("gateway", ("observer",), False),
    ],
)
def test_a_key_joins_in_its_roles_only(role: str, roles: tuple[str, ...], allowed: bool) -> None:
    t = Table()
    t.join(role, roles=roles)
    assert bool(t.decision.admitted) == allowed
    if not allowed:
        (refused,) = [o.message for o in t.decision.outgoing if isinstance(o.message, Refused)]
        assert (refused.code, refused.advice) == (DenialReason.ROLE, f"its roles: {', '.join(roles)}")
        assert t.since(Audited) == [Audited(AuditKind.ROLE_REFUSED, "key1", "person1", "", role)]


def test_audits_of_the_front_become_events() -> None:
    t = Table()
    audit = Audit(AuditKind.CODE_REFUSED, "mark", "Eve", "10.0.0.9", "x" * MAX_TEXT, 12)
    t.step(t.host(audit))
    assert t.since(Audited) == [Audited(audit.kind, "mark", "Eve", "10.0.0.9", "x" * MAX_TEXT, 12)]
