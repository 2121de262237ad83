"""Participants rename themselves; a director renames anyone and gives other roles."""

from __future__ import annotations

import msgspec
import pytest

from iris_session.authority import AuthorityConfig, is_same_snapshot
from iris_session.authority.state import AGEING_FIELDS
from iris_session.protocol.client_messages import Control, GetSnapshot, Rename, SetRole
from iris_session.protocol.entries import Lost
from iris_session.protocol.server_messages import Audited, LeaseChanged, ParticipantChanged, Snapshot
from tests.authority.table import Person, Table, robot
from tests.authority.test_roster import refused, rejoin


def snapshot(t: Table) -> Snapshot:
    t.step(t.host(GetSnapshot(1)))
    (message,) = [o.message for o in t.decision.outgoing if isinstance(o.message, Snapshot)]
    return message


def meet(**fields: object) -> tuple[Table, Person, Person]:
    """A director and an operator."""
    t = Table()
    return t, t.join("director", name="dora"), t.operator(name="ann", **fields)


class TestRename:
    def test_everyone_learns_the_name(self) -> None:
        t, dora, ann = meet()
        assert dora.asks(Rename(1, ann.id, " eva ")).ok
        (event,) = t.since(ParticipantChanged)
        assert (event.participant.id, event.participant.name) == (ann.id, "eva")
        (audit,) = t.since(Audited)
        assert (audit.kind, audit.subject, audit.name, audit.detail) == ("renamed", ann.id, "eva", "dora: was ann")
        assert [p.name for p in snapshot(t).participants] == ["dora", "eva"]

    def test_taken_name_gets_a_number(self) -> None:
        t, dora, ann = meet()
        t.join(name="dora-2")
        assert dora.asks(Rename(1, ann.id, "dora")).ok
        assert t.since(ParticipantChanged)[0].participant.name == "dora-3"
        long = "x" * 64
        t.join(name=long)
        assert dora.asks(Rename(2, ann.id, long)).ok
        assert t.since(ParticipantChanged)[0].participant.name == "x" * 60 + "-2"

    @pytest.mark.parametrize("name", ["", "  ", "a\nb", "\x1b[2J"])
    def test_no_name(self, name: str) -> None:
        _, dora, ann = meet()
        assert dora.denied(Rename(1, ann.id, name)) == "invalid"

    @pytest.mark.parametrize("role", ["operator", "observer", "agent"])
    def test_everyone_renames_themselves_with_the_same_checks(self, role: str) -> None:
        t, dora, _ = meet()
        bob = t.join(role, name="bob")
        assert bob.asks(Rename(1, bob.id, "ann")).ok
        assert t.since(ParticipantChanged)[0].participant.name == "ann-2"
        assert [(a.kind, a.subject, a.detail) for a in t.since(Audited)] == [("renamed", bob.id, "bob: was bob")]
        assert bob.denied(Rename(2, bob.id, "\x1b[2J")) == "invalid"
        assert bob.denied(Rename(3, dora.id, "eva")) == "role"

    def test_recordings_before_self_rename_replay_as_they_were(self) -> None:
        ann = Table(AuthorityConfig(self_rename=False)).operator(name="ann")
        assert ann.denied(Rename(1, ann.id, "eva")) == "role"


class TestSetRole:
    def test_operator_becomes_director_and_keeps_its_robot(self) -> None:
        t, dora, ann = meet()
        ann.acquire("left")
        assert ann.denied(Control(1, "pause")) == "role"
        assert dora.asks(SetRole(1, ann.id, "director")).ok
        (event,) = t.since(ParticipantChanged)
        assert (event.participant.id, event.participant.role) == (ann.id, "director")
        (audit,) = t.since(Audited)
        assert (audit.kind, audit.subject, audit.detail) == ("role_changed", ann.id, "dora: operator to director")
        assert t.since(LeaseChanged) == []
        ann.engage("left")
        assert t.hold() == ""
        assert ann.asks(Control(2, "pause")).ok

    def test_person_who_becomes_an_agent_lets_go(self) -> None:
        """Modes `priority` and `takeover` treat agents otherwise than people."""
        t = Table(robots=(robot("left", "priority"), robot("right")))
        dora, ann = t.join("director", name="dora"), t.operator("left", name="ann")
        assert dora.asks(SetRole(1, ann.id, "agent")).ok
        assert t.last(LeaseChanged).lease.holder == ""
        bob = t.operator(name="bob")
        assert ann.acquire("left").ok
        assert bob.acquire("left").ok, "a person preempts it"

    @pytest.mark.parametrize(
        ("roles", "role", "reason"),
        [
            (("operator", "observer"), "director", "role"),
            ((), "gateway", "role"),
            (("operator", "gateway"), "gateway", "role"),
            ((), "king", "unknown_value"),
        ],
    )
    def test_denied(self, roles: tuple[str, ...], role: str, reason: str) -> None:
        t, dora, ann = meet(roles=roles)
        assert dora.denied(SetRole(1, ann.id, role)) == reason
        assert t.decision.events == ()

    def test_directors_only_and_people_only(self) -> None:
        _, dora, ann = meet()
        assert ann.denied(SetRole(1, ann.id, "director")) == "role"
        assert dora.denied(SetRole(1, "host", "observer")) == "unknown_participant"
        assert dora.asks(SetRole(2, dora.id, "operator")).ok
        assert dora.denied(SetRole(3, dora.id, "director")) == "role", "it has given its rights away"

    def test_wearer_who_is_not_aligned_by_measurement_may_not_drive(self) -> None:
        """As at joining: an observer in remote VR shows its hands, but does not drive with them."""
        t = Table()
        dora = t.join("director", name="dora")
        far = t.join("observer", alignment="not_needed", devices=("head", "controller/right"))
        assert dora.denied(SetRole(1, far.id, "operator")) == "unaligned"
        assert dora.asks(SetRole(2, far.id, "agent")).ok, "agents may, by default"

    def test_role_outlives_the_connection(self) -> None:
        t, dora, ann = meet()
        ann.acquire("left")
        dora.does(SetRole(1, ann.id, "director"))
        t.step(ann.says(Lost()))
        rejoin(t, ann, role="operator")
        (admitted,) = t.decision.admitted
        assert (admitted.role, admitted.resumed) == ("director", True)
        assert t.last(LeaseChanged).lease.holder == ann.id

    def test_role_that_the_key_has_lost_is_not_resumed(self) -> None:
        t, dora, ann = meet()
        dora.does(SetRole(1, ann.id, "director"))
        t.step(ann.says(Lost()))
        rejoin(t, ann, role="operator", roles=("operator",))
        assert refused(t) == "resume_token"


class TestEarlierSnapshots:
    """Keyframes of recordings that were made before participants had `roles` and the like, and alignments a pivot."""

    def test_without_the_fields_they_say_the_same(self) -> None:
        t, _, ann = meet(roles=("operator",))
        now = t.authority.snapshot()
        earlier = msgspec.msgpack.decode(now)
        for fields in earlier["participants"].values():
            for name in ("roles", "hello_name", "hello_role", "doubt", "confirmed_ns", *AGEING_FIELDS):
                del fields[name]
            if fields["alignment"]:
                del fields["alignment"]["pivot_world"]
        del earlier["episode_ns"], earlier["placed_epoch"]
        data = msgspec.msgpack.encode(earlier)
        assert data != now
        assert is_same_snapshot(data, now)
        assert is_same_snapshot(now, now)
        Table().authority.restore(data)
        earlier["participants"][ann.id]["name"] = "eva"
        assert not is_same_snapshot(msgspec.msgpack.encode(earlier), now)
        earlier["participants"][ann.id]["name"] = "ann"
        earlier["participants"][ann.id]["alignment"] = None
        assert not is_same_snapshot(msgspec.msgpack.encode(earlier), now)
