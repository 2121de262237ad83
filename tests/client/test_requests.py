"""Every request of a client reaches the session and its answer returns, for operators and directors."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from iris_session.client import Client, DeniedError, RequestTimeoutError
from iris_session.protocol.client_messages import Acquire, Observation, Withdraw
from iris_session.protocol.names import DenialReason, Device, EpisodeState, LeaseMode
from iris_session.protocol.server_messages import (
    ConsentRequested,
    EpisodeChanged,
    Event,
    MarkerAdded,
    ObjectGrasped,
    Reply,
)
from tests.client.session import ClientSession

Join = Callable[..., Client]
HERE = ((1.0, 2.0, 0.0), (1.0, 0.0, 0.0, 0.0))


def bodies(events: list[Event], kind: type) -> list[object]:
    return [event.body for event in events if isinstance(event.body, kind)]


def test_director_requests_are_executed(session: ClientSession, join: Join) -> None:
    events: list[Event] = []
    boss = join("boss", role="director", on_event=events.append)
    ann = join("ann", alignment="measured", devices=(Device.HEAD,))
    boss.assign(["left"], ann.participant_id)
    assert ann.wait_for(lambda c: c.lease_version("left") is not None)
    boss.set_scale(["left"], 0.5)
    assert ann.wait_for(lambda c: c.mirror.leases["left"].scale == 0.5)
    boss.set_mode("right", LeaseMode.TAKEOVER)
    assert boss.wait_for(lambda c: c.mirror.leases["right"].mode == LeaseMode.TAKEOVER)
    boss.alignment.place(ann.participant_id, HERE)
    assert ann.wait_for(lambda c: c.alignment.current is not None)
    assert ann.alignment.current is not None
    assert ann.alignment.current.T_world_tracking.p == HERE[0]
    boss.control("pause")
    assert boss.wait_for(lambda c: c.mirror.paused)
    boss.control("resume")
    assert boss.wait_for(lambda c: not c.mirror.paused)
    boss.estop("drill")
    assert ann.wait_for(lambda c: c.mirror.estop)
    ann.estop("not yet")
    assert boss.wait_for(lambda c: c.mirror.stop_seq == 2)
    with pytest.raises(DeniedError) as denied:
        boss.clear_estop(1)
    assert (denied.value.denial.reason, denied.value.denial.holder) == (DenialReason.ESTOP, ann.participant_id)
    boss.clear_estop()
    assert ann.wait_for(lambda c: not c.mirror.estop)
    boss.marker("look here")
    assert boss.start_episode("first", countdown_s=0).state == EpisodeState.RUNNING
    assert boss.take_over_episode().led_by == boss.participant_id
    assert boss.stop_episode().state == EpisodeState.CLOSING
    assert boss.end_episode().successes == 1
    assert boss.start_episode(countdown_s=0.1).number == 2
    assert boss.discard_episode(again=True).number == 2
    assert boss.discard_episode().state == EpisodeState.CANCELLED
    with pytest.raises(DeniedError, match="no episode is running"):
        boss.end_episode("failure")
    states = [event.state for event in bodies(events, EpisodeChanged)]
    assert states[-5:] == ["confirm", "closing", "discarded", "countdown", "cancelled"]
    assert bodies(events, MarkerAdded) == [MarkerAdded(boss.participant_id, "look here")]


def answer_of(client: Client, request: int) -> Reply:
    """Return the reply to a submitted request."""
    replies: list[Reply] = []

    def come(_: Client) -> bool:
        reply = client.answer(request)
        replies.extend([] if reply is None else [reply])
        return bool(replies)

    assert client.wait_for(come)
    return replies[0]


def test_holder_may_refuse_or_consent_to_a_handover(session: ClientSession, join: Join) -> None:
    asked: list[Event] = []
    boss, ann, bob = join("boss", role="director"), join(on_event=asked.append), join("bob")
    boss.set_mode("left", LeaseMode.REQUEST)
    ann.acquire(["left"])
    for number, grant in ((1, False), (2, True)):
        request = bob.submit(Acquire(0, ("left",)))
        assert ann.wait_for(lambda c, number=number: len(bodies(asked, ConsentRequested)) == number)
        question = bodies(asked, ConsentRequested)[-1]
        assert isinstance(question, ConsentRequested)
        assert bob.answer(request) is None
        ann.consent(question.consent_id, grant)
        reply = answer_of(bob, request)
        assert reply.ok == grant
        assert (reply.denial is None) == grant
    assert bob.lease_version("left") is not None
    assert ann.wait_for(lambda c: c.lease_version("left") is None)


def test_who_gives_up_waiting_is_never_granted_the_robot(join: Join) -> None:
    ann, bob, carl = join(), join("bob"), join("carl")
    ann.acquire(["left"])
    carl.submit(Acquire(0, ("left",), wait=True))
    assert ann.wait_for(lambda c: c.mirror.leases["left"].queue == (carl.participant_id,))
    with pytest.raises(RequestTimeoutError, match="place 2 of 2") as late:
        bob.acquire(["left"], wait=True, timeout_s=0.3)
    assert late.value.denial is not None
    assert late.value.denial.holder == ann.participant_id
    assert ann.wait_for(lambda c: c.mirror.leases["left"].queue == (carl.participant_id,))
    ann.release()
    assert carl.wait_for(lambda c: c.lease_version("left") is not None)
    carl.release()
    assert bob.wait_for(lambda c: not c.mirror.leases["left"].holder)
    assert bob.lease_version("left") is None


def test_hand_grasps_an_object(session: ClientSession, join: Join) -> None:
    events: list[Event] = []
    ann = join(devices=(Device.HEAD, Device.HAND_RIGHT), on_event=events.append)

    def squeeze(clutch: bool) -> None:
        ann.send_sample(Device.HAND_RIGHT, HERE, objects=["hammer"], clutch=clutch)
        ann.sleep(0.01)

    squeeze(False)
    (lease,) = ann.grasp("hammer", Device.HAND_RIGHT)
    assert lease.target == "hammer"
    sample = ann.make_sample(Device.HAND_RIGHT, HERE, objects=["hammer"])
    assert [(t.name, t.kind) for t in sample.targets] == [("hammer", "object")]
    squeeze(False)
    for _ in range(50):
        squeeze(True)
    assert bodies(events, ObjectGrasped)
    ann.release("hammer")
    assert ann.wait_for(lambda c: c.lease_version("hammer") is None)


def test_worn_and_observations_are_sent() -> None:
    with ClientSession(forward_observations=True) as session:
        ann = session.join(devices=(Device.HEAD,))
        ann.worn = False
        assert ann.wait_for(lambda c: not c.mirror.participants[c.participant_id].worn)
        ann.alignment.observe("table", HERE, viewpoint_id=3)
        assert ann.wait_for(lambda c: bool(session.messages_of(Observation)))
        assert session.messages_of(Observation)[0].T_tracking_anchor.p == HERE[0]


def test_a_request_that_a_stalled_session_grants_later_is_given_back(session: ClientSession, join: Join) -> None:
    ann = join()
    session.paused = True
    with pytest.raises(RequestTimeoutError):
        ann.acquire(["left"], timeout_s=0.2)
    session.paused = False
    assert ann.wait_for(lambda c: bool(session.messages_of(Withdraw)))
    ann.marker("after it")
    assert ann.lease_version("left") is None
    assert not ann.mirror.leases["left"].holder
