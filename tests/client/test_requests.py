"""Every request of a client reaches the session and its answer comes back, for people and for directors."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from iris_session.client import Client, DeniedError, RequestTimeoutError, poll_all
from iris_session.protocol.client_messages import Acquire, Observation
from iris_session.protocol.names import DenialReason, Device, EpisodeAction, LeaseMode
from iris_session.protocol.server_messages import (
    ConsentRequested,
    EpisodeChanged,
    Event,
    MarkerAdded,
    ObjectGrasped,
    Reply,
    ScaleChanged,
)
from tests.client.harness import LiveSession

Join = Callable[..., Client]
HERE = ((1.0, 2.0, 0.0), (1.0, 0.0, 0.0, 0.0))


def bodies(events: list[Event], kind: type) -> list[object]:
    return [event.body for event in events if isinstance(event.body, kind)]


def test_a_director_directs(session: LiveSession, join: Join) -> None:
    events: list[Event] = []
    boss = join("boss", role="director", on_event=events.append)
    ann = join("ann", alignment="measured", devices=(Device.HEAD,))
    boss.assign(["left"], ann.participant_id)
    assert ann.wait_for(lambda c: c.lease_version("left") is not None)
    boss.set_mode("right", LeaseMode.TAKEOVER)
    assert boss.wait_for(lambda c: c.mirror.leases["right"].mode == LeaseMode.TAKEOVER)
    boss.place_alignment(ann.participant_id, HERE)
    assert ann.wait_for(lambda c: c.alignment is not None)
    assert ann.alignment is not None
    assert ann.alignment.T_world_tracking.p == HERE[0]
    boss.control("pause")
    assert boss.wait_for(lambda c: c.mirror.paused)
    boss.control("resume")
    assert boss.wait_for(lambda c: not c.mirror.paused)
    boss.estop("drill")
    assert ann.wait_for(lambda c: c.mirror.estop)
    boss.clear_estop()
    assert ann.wait_for(lambda c: not c.mirror.estop)
    boss.marker("look here")
    boss.episode(EpisodeAction.START, "first")
    boss.episode(EpisodeAction.SUCCESS)
    assert boss.wait_for(lambda c: len(bodies(events, EpisodeChanged)) >= 2)
    assert bodies(events, MarkerAdded) == [MarkerAdded(boss.participant_id, "look here")]


def test_a_holder_scales_the_motion_of_its_robot_for_all_to_see(session: LiveSession, join: Join) -> None:
    events: list[Event] = []
    ann, bob = join(), join("bob", on_event=events.append)
    ann.acquire(["left"])
    (lease,) = ann.set_scale(["left"], 0.25)
    assert (lease.target, lease.scale) == ("left", 0.25)
    assert bob.wait_for(lambda c: c.mirror.leases["left"].scale == 0.25)
    assert bodies(events, ScaleChanged) == [ScaleChanged("left", 0.25, ann.participant_id)]
    late = join("late")
    assert late.mirror.leases["left"].scale == 0.25
    seq = late.mirror.event_seq
    hashes = []
    for client in (ann, bob, late):
        assert client.wait_for(lambda c: c.mirror.event_seq >= seq)
        hashes.append((client.mirror.event_seq, client.mirror.mirror_hash()))
    assert len(set(hashes)) == 1
    with pytest.raises(DeniedError, match=r"0\.05 to 5"):
        ann.set_scale(["left"], 100.0)
    with pytest.raises(DeniedError) as denied:
        bob.set_scale(["left"], 0.5)
    assert (denied.value.denial.reason, denied.value.denial.holder) == (DenialReason.NOT_HOLDER, ann.participant_id)
    ann.release("left")
    assert bob.wait_for(lambda c: c.mirror.leases["left"].scale == 1.0)


def test_an_operator_may_not_direct(session: LiveSession, join: Join) -> None:
    ann = join()
    for forbidden in (lambda: ann.control("pause"), lambda: ann.assign(["left"]), ann.clear_estop):
        with pytest.raises(DeniedError) as denied:
            forbidden()
        assert denied.value.denial.reason == DenialReason.ROLE


def answer_of(client: Client, request: int) -> Reply:
    """The reply to a submitted request."""
    replies: list[Reply] = []

    def come(_: Client) -> bool:
        reply = client.answer(request)
        replies.extend([] if reply is None else [reply])
        return bool(replies)

    assert client.wait_for(come)
    return replies[0]


def test_a_holder_is_asked_and_may_refuse_or_consent(session: LiveSession, join: Join) -> None:
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


def test_waiting_in_the_queue_ends_with_the_lease(session: LiveSession, join: Join) -> None:
    ann, bob = join(), join("bob")
    ann.acquire(["left"])
    with pytest.raises(RequestTimeoutError):
        bob.acquire(["left"], wait=True, timeout_s=0.3)
    assert ann.wait_for(lambda c: c.mirror.leases["left"].queue == (bob.participant_id,))
    ann.release()
    assert bob.wait_for(lambda c: c.lease_version("left") is not None)


def test_releasing_what_is_not_ours_is_denied_and_frees_nothing(session: LiveSession, join: Join) -> None:
    ann = join()
    ann.acquire(["left"])
    for name in ("right", "nothing"):
        with pytest.raises(DeniedError):
            ann.release(name)
    ann.marker("after")
    assert ann.lease_version("left") is not None


def test_a_hand_takes_an_object(session: LiveSession, join: Join) -> None:
    events: list[Event] = []
    ann = join(devices=(Device.HEAD, Device.HAND_RIGHT), on_event=events.append)

    def squeeze(client: Client, clutch: bool) -> None:
        client.send_sample(Device.HAND_RIGHT, HERE, objects=["hammer"], clutch=clutch)
        client.poll(0.01)

    squeeze(ann, False)
    (lease,) = ann.grasp("hammer", Device.HAND_RIGHT)
    assert lease.target == "hammer"
    sample = ann.make_sample(Device.HAND_RIGHT, HERE, objects=["hammer"])
    assert [(t.name, t.kind) for t in sample.targets] == [("hammer", "object")]
    squeeze(ann, False)
    assert ann.wait_for(lambda c: bool(squeeze(c, True) or bodies(events, ObjectGrasped)))
    ann.release("hammer")
    assert ann.wait_for(lambda c: c.lease_version("hammer") is None)


def test_people_see_each_other(session: LiveSession, join: Join) -> None:
    ann, bob = join(devices=(Device.HEAD,)), join("bob")

    def seen(_: Client) -> bool:
        ann.send_sample(Device.HEAD, HERE)
        poll_all([ann, bob], 0.005)
        return (ann.participant_id, Device.HEAD) in bob.scene.presence

    assert bob.wait_for(seen)
    assert bob.scene.presence[ann.participant_id, Device.HEAD].pose.p == HERE[0]
    ann.close()
    assert bob.wait_for(lambda c: not c.scene.presence)


def test_worn_and_observations_are_told(join: Join) -> None:
    live = LiveSession(forward_observations=True)
    ann = Client(live.address, name="ann", devices=(Device.HEAD,))
    try:
        ann.connect()
        ann.worn = False
        assert ann.wait_for(lambda c: not c.mirror.participants[c.participant_id].worn)
        ann.observe("table", HERE, viewpoint_id=3)
        assert ann.wait_for(lambda c: bool(live.kinds(Observation)))
        (entry,) = live.kinds(Observation)
        assert isinstance(entry.message, Observation)
        assert entry.message.T_tracking_anchor.p == HERE[0]
    finally:
        ann.close()
        live.close()
