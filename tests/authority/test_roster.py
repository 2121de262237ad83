"""Join, resume, lost connections, heartbeats, grace, gateways."""

from __future__ import annotations

from typing import Any

import pytest

from iris_session.authority import AuthorityConfig
from iris_session.protocol.client_messages import Acquire, Bye, Heartbeat, Release
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.entries import Entry, FrontRestarted, Join, Lost, SessionResumed
from iris_session.protocol.server_messages import (
    LeaseChanged,
    ParticipantChanged,
    ParticipantJoined,
    ParticipantLeft,
    Refused,
)
from iris_session.protocol.steps import Dropped

from .table import MS, SECOND, Person, Table


def rejoin(t: Table, old: Person, **fields: Any) -> Person:
    """`old` comes back on a new connection with its resume token."""
    t.people += 1
    key = f"key{old.connection}"
    join = Join(**{"key_id": key, "role": "operator", "name": old.name, "resume_of": old.id, **fields})
    person = t.persons[t.people] = Person(t, t.people, old.name)
    person.id = old.id
    t.step(Entry(t.people, t.people, t.now_ns, join))
    return person


def refused(t: Table) -> str:
    (message,) = [o.message for o in t.decision.outgoing if isinstance(o.message, Refused)]
    return message.code


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"role": "king"}, "unknown_value"),
        ({"alignment": "guessed"}, "unknown_value"),
        ({"gateway": 1}, "gateway_only"),
        ({"gateway": 5}, "gateway_only"),
        ({"alignment": "not_needed", "devices": ("head", "controller/right")}, "unaligned"),
        ({"alignment": "not_needed", "devices": ("hand/left",), "role": "director"}, "unaligned"),
    ],
)
def test_refused_joins(fields: dict[str, Any], code: str) -> None:
    t = Table()
    t.join()
    t.join(**fields)
    assert refused(t) == code
    assert t.decision.admitted == ()


def test_refusal_that_lists_what_was_sent_can_be_read() -> None:
    """One that is too long would cost everybody the whole step."""
    t = Table()
    t.join(alignment="not_needed", devices=(*("controller/right",) * 32, "head"))
    (message,) = [o.message for o in t.decision.outgoing if isinstance(o.message, Refused)]
    assert message.message.count("controller/right") == 1
    long = Refused("full", "x" * 1000, "y" * 1000)
    assert (len(long.message), len(long.advice)) == (MAX_TEXT, MAX_TEXT)


def test_a_connection_joins_once() -> None:
    t = Table()
    anna = t.join()
    t.step(anna.says(Join("key1", "operator", "anna")))
    assert refused(t) == "already_joined"
    anna.does(Bye())
    t.step(anna.says(Join("key1", "operator", "anna")))
    assert refused(t) == "already_joined"


def test_session_full_forgets_lost_people_without_leases_first() -> None:
    t = Table(AuthorityConfig(max_participants=2))
    anna, bert = t.operator("left"), t.join()
    t.join()
    assert refused(t) == "session_full"
    t.step(anna.says(Lost()), bert.says(Lost()))
    assert t.join().id == "p3"
    assert t.last(ParticipantLeft).participant == bert.id
    t.join()
    assert refused(t) == "session_full"


def test_grace_begins_anew_when_the_session_was_down_also_for_who_was_lost_before() -> None:
    t = Table()
    ann = t.operator("left")
    t.step(ann.says(Lost("silent")))
    t.wait(10 * SECOND)
    t.step(t.host(SessionResumed(3_600 * SECOND)), dt_ns=3_600 * SECOND)
    t.wait(t.config.grace_ns - SECOND)
    assert t.last(LeaseChanged).lease.holder == ann.id
    t.wait(2 * SECOND)
    assert t.last(LeaseChanged).lease.holder == ""


@pytest.mark.parametrize("news", [SessionResumed(SECOND), FrontRestarted()])
def test_who_waited_keeps_the_place_while_the_session_was_down(news: SessionResumed | FrontRestarted) -> None:
    """Bert is first, comes back last and need not ask again; Carl asks again and keeps his place; Dora never comes."""
    t = Table()
    ann, bert, carl, dora = t.operator("left"), t.join(), t.join(), t.join()
    for waiting in (bert, carl, dora):
        waiting.does(Acquire(7, ("left",), wait=True))
    t.step(t.host(news), dt_ns=SECOND)
    assert t.last(LeaseChanged).lease.queue == (bert.id, carl.id, dora.id)
    ann, carl = rejoin(t, ann), rejoin(t, carl)
    carl.does(Acquire(3, ("left",), wait=True))
    assert carl.replies() == []
    ann.does(Release())
    t.wait(SECOND)
    assert t.last(LeaseChanged).lease.queue == (bert.id, carl.id, dora.id), "nobody overtakes who is not back yet"
    bert = rejoin(t, bert)
    t.step()
    lease = t.last(LeaseChanged).lease
    assert (lease.holder, lease.queue) == (bert.id, (carl.id, dora.id))
    assert bert.replies() == [], "nobody asked over this connection"
    bert.does(Release())
    t.step()
    assert t.last(LeaseChanged).lease.holder == carl.id
    t.wait(t.config.grace_ns)
    assert t.last(LeaseChanged).lease.queue == ()


def test_resume_fences_old_tokens_and_drops_the_old_connection() -> None:
    t = Table()
    anna = t.operator("left", capabilities=("run:a",))
    anna.engage("left")
    again = rejoin(t, anna, capabilities=("run:a",))
    assert t.decision.dropped == (Dropped(anna.connection, "replaced"),)
    assert t.decision.admitted[0].resumed
    lease = t.last(LeaseChanged).lease
    assert (lease.lease_version, t.last(LeaseChanged).cause) == (anna.versions["left"] + 1, "resumed")
    assert t.hold() == "rearm"
    again.versions = anna.versions
    again.engage("left")
    assert t.hold() == "rearm"
    again.learn([lease])
    again.engage("left")
    assert t.command().kind == "pose"
    anna.versions = again.versions
    anna.sends("left", clutch=False)
    assert t.command().kind == "pose"


@pytest.mark.parametrize(("run", "kept"), [("run:a", True), ("run:b", False), ("other", False)])
def test_alignment_survives_a_resume_only_within_one_run_of_the_app(run: str, kept: bool) -> None:
    t = Table()
    anna = t.operator("left", capabilities=("run:a",))
    rejoin(t, anna, capabilities=(run,))
    assert (t.last(ParticipantJoined).participant.alignment is not None) == kept


def test_resume_needs_the_same_key_and_role() -> None:
    for fields in ({"key_id": "other"}, {"role": "director"}):
        t = Table()
        anna = t.operator("left")
        rejoin(t, anna, **fields)
        assert refused(t) == "resume_token"


def test_bye_releases_at_once() -> None:
    t = Table()
    anna = t.operator("left")
    anna.engage("left")
    anna.does(Bye("done"))
    assert t.hold() == "no_lease"
    assert t.decision.dropped == (Dropped(1, "bye"),)
    assert t.since(ParticipantLeft) == [ParticipantLeft(anna.id, "done", False)]


def test_three_silent_seconds_are_a_lost_connection() -> None:
    t = Table()
    anna = t.operator("left")
    t.wait(2 * SECOND)
    anna.does(Heartbeat())
    t.wait(2900 * MS)
    assert t.hold() == "no_sample"
    dropped = []
    for _ in range(10):
        t.step(dt_ns=20 * MS)
        dropped += t.decision.dropped
    assert t.hold() == "disconnected"
    assert dropped == [Dropped(anna.connection, "heartbeat")]
    assert t.last(ParticipantLeft) == ParticipantLeft(anna.id, "heartbeat", True)


def test_host_cannot_be_lost_say_bye_or_be_resumed() -> None:
    t = Table()
    t.step(t.host(Lost()), t.host(Bye()))
    t.step(t.host(Release(4)))
    assert t.decision.outgoing[0].connection == 0
    anna = t.join()
    anna.id = "host"
    rejoin(t, anna, role="director", key_id="")
    assert not t.decision.admitted[0].resumed


def test_worn_is_shown_and_a_gateway_takes_its_clients_along() -> None:
    t = Table()
    gate = t.join("gateway")
    anna = t.operator("left", gateway=gate.connection)
    anna.does(Heartbeat(worn=False))
    assert not t.since(ParticipantChanged)[0].participant.worn
    anna.does(Heartbeat())
    assert t.since(ParticipantChanged)[0].participant.worn
    t.step(gate.says(Lost()))
    assert t.hold() == "disconnected"
    assert t.decision.dropped == (Dropped(anna.connection, "gateway"),)
    gate = t.join("gateway")
    t.operator("right", gateway=gate.connection)
    gate.does(Bye())
    assert t.hold("right") == "disconnected"
