"""The front and its clients: join, identity, resume, snapshots, gateways, and one that is slow."""

from __future__ import annotations

import os
from collections.abc import Callable

import msgspec
import numpy as np

from iris_session.link import FrontLimits
from iris_session.protocol.client_messages import Acquire, Bye, EStop, Heartbeat, Hello, Marker, Sample
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.entries import Join, Lost
from iris_session.protocol.server_messages import Event, ProtocolFault, Refused, Snapshot, Welcome
from iris_session.protocol.steps import Decision, Dropped, OutgoingMessage
from tests.front.harness import N_BODIES, FrontSession

OpenSession = Callable[..., FrontSession]


def test_unsupported_version_is_refused_with_advice(session: FrontSession) -> None:
    client = session.client()
    client.socket.send(msgspec.msgpack.encode([7, 0, "", {"type": "hello", "some": "future"}]))
    refused = client.wait_for(Refused)
    assert refused.code == "version"
    assert refused.supported_versions == (1,)
    assert "session" in refused.advice


def test_states_of_another_scene_are_dropped_and_counted(session: FrontSession) -> None:
    session.send_state(np.zeros((N_BODIES + 1, 7)))
    assert session.wait_drops("state_of_other_scene") == 1


def test_resume_token_is_single_use_and_bound_to_the_key(session: FrontSession) -> None:
    first = session.client()
    token = first.join().resume_token
    thief = session.client()
    thief.send(Hello("operator", "Thief", secret=thief.secret, resume_token=token))
    assert thief.wait_for(Refused).code == "resume_token"
    back = session.client()
    back.secret = first.secret
    welcome = back.join(resume_token=token)
    assert welcome.resumed
    assert welcome.participant_id == "p1"
    back.send(Heartbeat())
    session.wait_entries(Heartbeat)
    again = session.client()
    again.secret = first.secret
    again.send(Hello("operator", "Ann", secret=first.secret, resume_token=token))
    assert again.wait_for(Refused).code == "resume_token"


def test_closed_socket_is_a_disconnect_after_its_last_messages(session: FrontSession) -> None:
    client = session.client()
    epoch = client.join().connection_epoch
    client.send(Marker(1, "last words"))
    client.send(EStop("stop"))
    client.close(linger=1000)
    session.wait_entries(Lost)
    kinds = [type(e.message) for e in session.entries if e.connection == epoch]
    assert kinds.index(Marker) < kinds.index(Lost)
    assert kinds.index(EStop) < kinds.index(Lost)
    (lost,) = session.wait_entries(Lost)
    assert lost.message == Lost("closed")


def test_silent_client_is_disconnected_and_asked_for_hello(open_session: OpenSession) -> None:
    session = open_session(silence_ns=1_000_000_000)
    client = session.client()
    client.join()
    (lost,) = session.wait_entries(Lost)
    assert lost.message == Lost("silent")
    client.send(Heartbeat())
    assert client.wait_for(ProtocolFault).code == "hello"
    client.send(EStop("I know of nothing"))
    (stop,) = session.wait_entries(EStop)
    assert stop.connection == 1
    assert client.join().connection_epoch == 2


def test_second_hello_on_a_connection_replaces_it(session: FrontSession) -> None:
    client = session.client()
    client.join()
    client.send(Hello("operator", "Ann", secret=client.secret))
    client.wait_for(Welcome, 2)
    (lost,) = session.wait_entries(Lost)
    assert (lost.connection, lost.message) == (1, Lost("replaced"))
    assert client.epoch == 2


def test_dropped_and_refused_connections_end(session: FrontSession) -> None:
    client = session.client()
    client.join()
    client.send(Bye())
    session.wait_entries(Bye)
    session.once(Decision((), dropped=(Dropped(1, "bye"),)))
    assert client.wait_for(ProtocolFault).code == "dropped"
    session.admits = False
    client.send(Hello("pilot", "Ann", secret=client.secret))
    join = session.wait_entries(Join, 2)[1]
    session.once(
        Decision((), outgoing=(OutgoingMessage(join.connection, Refused("unknown_value", "no role 'pilot'")),))
    )
    assert client.wait_for(Refused).code == "unknown_value"
    client.send(Heartbeat(), epoch=2)
    session.pump(lambda: any(f.code == "hello" for f in client.got(ProtocolFault)), "fault")
    client.send(EStop("sent before the refusal had arrived"), epoch=2)
    assert session.wait_entries(EStop)[0].connection == join.connection


def test_snapshot_is_filled_and_comes_after_the_events_of_its_step(session: FrontSession) -> None:
    client, other = session.client(), session.client()
    client.join()
    other.join(name="Bob")
    poses = np.random.default_rng(1).normal(size=(N_BODIES, 7))
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
    session.send_state(poses)
    events = tuple(session.notice(str(i)) for i in range(3))
    snapshot = msgspec.structs.replace(session.snapshot(5), event_seq=events[-1].event_seq)
    session.once(Decision((), outgoing=(OutgoingMessage(1, snapshot),), events=events))
    filled = client.wait_for(Snapshot)
    client.wait_for(Event, 3)
    assert (filled.request_id, filled.scene_hash, filled.state_seq) == (5, "hash", 1)
    assert [body.name for body in filled.bodies] == ["body0", "body1", "body2"]
    kinds = [type(message) for message, _ in client.inbox]
    assert [kind for kind in kinds if kind in (Event, Snapshot)] == [Event, Event, Event, Snapshot]
    (bulk,) = next(bulk for message, bulk in client.inbox if isinstance(message, Snapshot))
    np.testing.assert_allclose(np.frombuffer(bulk).reshape(-1, 7), poses, atol=1e-12)
    other.wait_for(Event, 3)
    assert [e.event_seq for e in other.got(Event)] == [1, 2, 3]
    assert not other.got(Snapshot)


def test_gateway_sends_for_participants_and_they_leave_with_it(session: FrontSession) -> None:
    gateway = session.client()
    stranger = session.client()
    stranger.join("operator")
    stranger.send(Hello("operator", "Web", secret=os.urandom(16)), on_behalf_of="tab1")
    assert stranger.wait_for(Refused).code == "gateway_only"
    gateway.join("gateway", "web")
    gateway.send(Hello("operator", "Web", secret=os.urandom(16)), on_behalf_of="tab1")
    welcome = gateway.wait_for(Welcome, 2)
    assert [bulk for message, bulk in gateway.inbox if message is welcome] == [[b"tab1"]]  # more may have come since
    join = session.wait_entries(Join, 3)[-1].message
    assert isinstance(join, Join)
    assert join.gateway == 2
    gateway.send(Acquire(1), on_behalf_of="tab1", epoch=welcome.connection_epoch)
    (acquire,) = session.wait_entries(Acquire)
    assert acquire.connection == acquire.connection_epoch == 3
    gateway.close()
    assert [e.connection for e in session.wait_entries(Lost, 2)] == [2, 3]


def test_stalled_authority_gets_a_bounded_batch_with_the_estop_first(session: FrontSession) -> None:
    client, other = session.client(), session.client()
    client.join()
    other.join(name="Bob")
    for seq in range(500):
        client.send(Sample("head", "pose", seq, 0, 1, 0, 1, pose=IDENTITY))
        client.send(Marker(seq, "x"))
        session.run_front()  # the authority takes nothing, and the credit of the front is used up
    other.send(EStop())
    session.run_front()
    waiting = session.link.poll()
    assert len(waiting) < 300
    assert any(isinstance(entry.message, EStop) for entry in waiting), "urgent entries have credit of their own"
    assert session.wait_drops("rate") > 0


def test_client_that_reads_nothing_is_disconnected_as_slow(open_session: OpenSession) -> None:
    session = open_session(limits=FrontLimits(slow_drops=16))
    honest, slow = session.client(), session.client()
    honest.join(name="Ann")
    slow.join(name="Slow")
    slow.reads = False
    for _ in range(20):
        session.once(Decision((), events=(session.notice("x" * 500),)))
    (loss,) = session.wait_entries(Lost)
    assert (loss.connection, loss.message) == (2, Lost("slow"))
    assert session.wait_drops("send_queue_full", 16) >= 16
    assert not slow.is_connected, "what waits for it takes no memory any more"
    assert [event.event_seq for event in honest.got(Event)] == list(range(1, 21))
