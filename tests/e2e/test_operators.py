"""Several real clients in one real session: denial, resuming, late joiners, recentring, invalid input, scaling."""

from __future__ import annotations

import itertools
import math
import subprocess
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
import zmq

from anchors.pose import PoseTuple, distance, quat_angle
from iris_session.client import Client, DeniedError
from iris_session.demo.scenes import n_arms_scene
from iris_session.protocol.names import DenialReason, RejectReason
from iris_session.protocol.server_messages import AlignmentChanged, LeaseChanged, SamplesRejected
from tests.e2e.scenario import Hand, Scenario, is_driven
from tests.e2e.session_process import SessionProcess
from tests.e2e.session_time import run_ticks, wait_for_new_state

pytestmark = pytest.mark.e2e


@pytest.fixture
def scenario(shared_scenario: Scenario) -> Scenario:
    """Use one session for all tests."""
    return shared_scenario


def test_second_operator_is_denied_with_the_holder(scenario: Scenario) -> None:
    ann, bob = scenario.join("ann"), scenario.join("bob")
    ann.acquire(["left"])
    with pytest.raises(DeniedError) as denied:
        bob.acquire(["left", "right"])
    denial = denied.value.denial
    assert denial.reason == DenialReason.HELD
    assert denial.holder == ann.connection.participant_id
    assert denial.holder_name == "ann"
    assert denial.advice
    assert bob.lease_version("right") is None  # all or none
    hand = scenario.add_hand(bob, "left")
    hand.clutch, hand.velocity = True, (0.2, 0.0, 0.0)
    before = hand.tip
    scenario.run_for(0.7)
    assert distance(before[0], hand.tip[0]) < 1e-4


def test_operator_moves_the_robot_and_it_holds_without_samples(scenario: Scenario) -> None:
    hand = scenario.add_hand(scenario.join("ann"), "left")
    hand.client.acquire(["left"])
    before = hand.tip
    scenario.engage(hand)
    assert distance(before[0], hand.tip[0]) < 1e-3
    scenario.move_until(
        hand, (0.0, 0.1, 0.0), lambda: hand.tip[0][1] - before[0][1] > 0.05, "the tip follows the hand by 5 cm"
    )
    hand.velocity = (0.0, 0.1, 0.0)
    hand.sending = False
    run_ticks(scenario, hand.client, 0.8)  # 150 ms until stale, then it decelerates
    resting = hand.tip
    run_ticks(scenario, hand.client, 0.5)
    assert distance(resting[0], hand.tip[0]) < 5e-4


def test_killed_client_resumes_its_lease(
    scenario: Scenario, emulate: Callable[..., subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    """After SIGKILL of a client the robot holds, the lease stays, and a client with the same identity resumes it."""
    headset = f"name=ann,behaviour=wander,robot=left,identity_file={tmp_path}/ann.identity"
    watcher = scenario.join("watcher", "observer")
    first = emulate(scenario.server.address, headset)
    scenario.run_until(lambda: is_driven(watcher, "left"), "ann drives")
    lease = watcher.mirror.leases["left"]
    first.kill()
    scenario.run_until(lambda: watcher.mirror.leases["left"].expires_ns > 0, "the grace period of the lease begins")
    ann = watcher.mirror.participants[lease.holder]
    assert not ann.connected
    run_ticks(scenario, watcher, 0.5)
    resting = watcher.scene.tip_pose("left")
    assert resting is not None
    run_ticks(scenario, watcher, 0.5)
    now = watcher.scene.tip_pose("left")
    assert now is not None
    assert distance(resting[0], now[0]) < 5e-4
    emulate(scenario.server.address, headset)
    scenario.run_until(lambda: watcher.mirror.participants[lease.holder].connected, "ann has reconnected")
    scenario.run_until(lambda: watcher.mirror.leases["left"].expires_ns == 0, "the lease is resumed, the next event")
    resumed = watcher.mirror.leases["left"]
    assert resumed.holder == lease.holder
    assert resumed.lease_version > lease.lease_version
    scenario.run_until(lambda: is_driven(watcher, "left"), "ann drives again")


def test_late_client_has_the_same_state(scenario: Scenario) -> None:
    ann = scenario.join("ann")
    ann.acquire(["left"])
    director = scenario.join("director", "director")
    director.marker("before")
    director.set_mode("right", "request")
    ann.episode("start", "one")
    late = scenario.join("late", "observer")
    director.marker("after")

    def are_mirrors_equal() -> bool:
        return len({(c.mirror.event_seq, c.mirror.mirror_hash()) for c in (ann, director, late)}) == 1

    scenario.run_until(are_mirrors_equal, "all three mirrors agree")
    assert late.mirror.leases["left"].holder == ann.connection.participant_id
    assert late.mirror.episode is not None

    def are_poses_equal() -> bool:
        states = [c.scene.state for c in (ann, late)]
        if any(s is None for s in states):
            return False
        return all(
            abs(float(v)) < 3e-4
            for v in (states[0].poses - states[1].poses).ravel()  # type: ignore[union-attr]
        )

    scenario.run_until(are_poses_equal, "the late client has the same poses")


@pytest.mark.long
def test_recentring_in_motion_does_not_move_the_robot(
    scenario: Scenario, emulate: Callable[..., subprocess.Popen[bytes]]
) -> None:
    """The tracking frame jumps by metres while the clutch is closed: hold, realign, clutch again; never a jump."""
    watcher = scenario.join("watcher", "observer")
    emulate(scenario.server.address, "name=ann,behaviour=wander,robot=left,recentre_at_s=12")
    epochs: set[int] = set()
    tips: list[tuple[int, PoseTuple]] = []

    def has_realigned_and_drives() -> bool:
        for event in scenario.events["watcher"]:
            if isinstance(event.body, AlignmentChanged) and event.body.alignment.kind == "measured":
                epochs.add(event.body.alignment.tracking_epoch)
        tip, state = watcher.scene.tip_pose("left"), watcher.scene.state
        if tip is not None and state is not None and (not tips or tips[-1][0] != state.header.tick):
            tips.append((state.header.tick, tip))
        return len(epochs) >= 2 and is_driven(watcher, "left")

    scenario.run_until(has_realigned_and_drives, "ann drives again after recentring", 60.0)
    for (tick0, a), (tick1, b) in itertools.pairwise(tips):
        seconds = (tick1 - tick0) * 0.002
        assert distance(a[0], b[0]) <= 0.6 * max(seconds, 0.017), (tick0, tick1)


def test_unsupported_version_is_refused_with_the_supported_ones(shared_session: SessionProcess) -> None:
    context = zmq.Context()
    try:
        socket = context.socket(zmq.DEALER)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(f"tcp://{shared_session.address}")
        socket.send(msgspec.msgpack.encode([99, 0, "", {"type": "hello", "from": "the future"}]))
        assert socket.poll(30_000)
        _, _, message = msgspec.msgpack.decode(socket.recv_multipart()[0])
        assert message["type"] == "refused"
        assert message["code"] == "version"
        assert message["supported_versions"] == [1]
        socket.close()
    finally:
        context.term()
    scenario = Scenario(shared_session)
    scenario.join("ann")  # the session still accepts clients
    scenario.close()


INVALID_POSES: tuple[tuple[PoseTuple, str], ...] = (
    (((math.nan, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)), RejectReason.NOT_FINITE),
    (((0.0, math.inf, 1.0), (1.0, 0.0, 0.0, 0.0)), RejectReason.NOT_FINITE),
    (((0.0, 0.0, 1.0), (0.5, 0.0, 0.0, 0.0)), RejectReason.NOT_UNIT),
    (((2.5, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)), RejectReason.TOO_FAST),
)


def send_invalid_pose(scenario: Scenario, hand: Hand, pose: PoseTuple) -> PoseTuple:
    """Engage a hand, and send one sample with this pose. Return the pose of the tip before."""
    hand.sending = True
    scenario.engage(hand)
    before, hand.sending = hand.tip, False
    hand.client.send_sample(hand.device, pose, robots=[hand.robot], clutch=True)
    return before


@pytest.mark.long
def test_invalid_pose_ends_the_engagement_and_moves_nothing(scenario: Scenario) -> None:
    """Each pose is sent by another client."""
    watcher = scenario.join("watcher", "observer")
    for pose, reason in INVALID_POSES:
        hand = scenario.add_hand(scenario.join("ann"), "left")
        ann = hand.client
        ann.acquire(["left"])

        def is_reported(me: str = ann.participant_id, reason: str = reason) -> bool:
            bodies = [event.body for event in scenario.events["watcher"]]
            return any(isinstance(b, SamplesRejected) and (b.participant, b.reason) == (me, reason) for b in bodies)

        for _ in range(5):  # on a busy machine the sample may come too late, which is the reason then
            before = send_invalid_pose(scenario, hand, pose)
            if scenario.wait_for(is_reported, 3.0):
                break
        assert is_reported(), reason
        scenario.run_for(0.4)
        assert distance(before[0], hand.tip[0]) < 1e-3
        assert quat_angle(before[1], hand.tip[1]) < 1e-2
        hand.sending = True
        scenario.engage(hand)
        scenario.hands.remove(hand)
        scenario.clients.remove(ann)
        ann.close()
        scenario.run_until(lambda: not watcher.mirror.leases["left"].holder, "the robot is free")


def test_takeover_estop_pause_and_reset(serve: Callable[..., SessionProcess]) -> None:
    """A session with takeover, e-stop, pause and reset verifies."""
    scenario = Scenario(serve("handover", "--mode", "takeover"))
    try:
        ann, bob, director = scenario.join("ann"), scenario.join("bob"), scenario.join("director", "director")
        ann.acquire(["left"])
        anns_hand = scenario.add_hand(ann, "left")
        scenario.engage(anns_hand)
        anns_hand.velocity = (0.0, 0.05, 0.0)
        bob.acquire(["left"])
        scenario.run_until(lambda: ann.lease_version("left") is None, "ann has lost the lease")
        causes = [e.body.cause for e in scenario.events["ann"] if isinstance(e.body, LeaseChanged)]
        assert "takeover" in causes
        bobs_hand = scenario.add_hand(bob, "left")
        scenario.engage(bobs_hand)
        check_estop(scenario, bobs_hand, director)
        check_pause(scenario, bobs_hand, director)
        check_reset(scenario, bobs_hand, director)
        scenario.server.finish()
    finally:
        scenario.close()


def check_estop(scenario: Scenario, hand: Hand, director: Client) -> None:
    hand.velocity = (0.0, 0.1, 0.0)
    scenario.run_for(0.3)
    hand.client.estop("test")
    scenario.run_until(lambda: director.mirror.estop, "the e-stop is known")
    run_ticks(scenario, hand.client, 0.4)
    resting = hand.tip
    run_ticks(scenario, hand.client, 0.4)
    assert distance(resting[0], hand.tip[0]) < 5e-4
    with pytest.raises(DeniedError):
        hand.client.clear_estop()
    director.clear_estop()
    run_ticks(scenario, hand.client, 0.3)
    assert distance(resting[0], hand.tip[0]) < 5e-4, (
        "a closed clutch must not move the robot after the e-stop was cleared"
    )
    scenario.engage(hand)


def check_pause(scenario: Scenario, hand: Hand, director: Client) -> None:
    director.control("pause")
    scenario.run_until(lambda: hand.client.mirror.paused, "paused")
    wait_for_new_state(scenario, director)
    assert director.scene.state is not None
    tick = director.scene.state.header.tick
    scenario.run_for(0.3)
    wait_for_new_state(scenario, director)
    assert director.scene.state.header.tick == tick
    director.control("step", 5)
    scenario.run_until(
        lambda: director.scene.state is not None and director.scene.state.header.tick == tick + 5, "five single steps"
    )
    director.control("resume")
    scenario.run_until(
        lambda: director.scene.state is not None and director.scene.state.header.tick > tick + 50, "running again"
    )


def check_reset(scenario: Scenario, hand: Hand, director: Client) -> None:
    epoch = director.mirror.scene_epoch
    director.control("reset")
    scenario.run_until(lambda: hand.client.mirror.scene_epoch == epoch + 1, "a new scene epoch")
    scenario.run_until(lambda: hand.client.lease_version("left") is not None, "leases stay")
    scenario.engage(hand)


@pytest.mark.long
def test_four_headsets_drive_four_arms(
    serve: Callable[..., SessionProcess], emulate: Callable[..., subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    """Four aligned headsets, each in a process of its own; the recording verifies."""
    scene = tmp_path / "four.xml"
    spec = n_arms_scene(4)
    spec.compile()
    scene.write_text(spec.to_xml())
    scenario = Scenario(serve(str(scene)))
    try:
        watcher = scenario.join("watcher", "observer")
        for i in range(4):
            emulate(scenario.server.address, f"name=op{i},behaviour=wander,robot=arm{i + 1},seed={i}", seconds=300.0)
        scenario.run_until(lambda: all(is_driven(watcher, f"arm{i + 1}") for i in range(4)), "four arms move", 120.0)
        scenario.run_for(2.0)
        scenario.server.finish()
    finally:
        scenario.close()


# --- scaling ---------------------------------------------------------------------------------------------------------


def sweep_hand(scenario: Scenario, hand: Hand, metres: float, scale: float) -> None:
    """Move the hand along y by `metres`; the tip must move `scale` times as far, and stay there.

    It begins anew when the robot disengages: on a busy machine a sample may come too late.
    """
    start, y = hand.tip[0], hand.pose[0][1]

    def have_moved() -> bool:
        nonlocal start, y
        if not scenario.is_following(hand):
            hand.velocity = (0.0, 0.0, 0.0)
            scenario.engage(hand)
            start, y = hand.tip[0], hand.pose[0][1]
        moved = hand.pose[0][1] - y
        hand.velocity = (0.0, 0.1 if moved < metres else 0.0, 0.0)
        return moved >= metres and abs(distance(hand.tip[0], start) - scale * moved) < 1e-3

    scenario.run_until(have_moved, f"the hand has moved by {metres} m, and the tip {scale} times as far")
    run_ticks(scenario, hand.client, 0.4)
    assert distance(hand.tip[0], start) == pytest.approx(scale * (hand.pose[0][1] - y), abs=2e-3)


@pytest.mark.long
def test_scaled_robot_moves_a_fifth_as_far_as_the_hand(own_scenario: Scenario) -> None:
    scenario = own_scenario
    ann, bob = scenario.join("ann"), scenario.join("bob")
    ann.acquire(["left"])
    hand = scenario.add_hand(ann, "left")
    ann.set_scale(["left"], 0.2)
    scenario.engage(hand)
    sweep_hand(scenario, hand, 0.1, 0.2)
    with pytest.raises(DeniedError, match="ann"):
        bob.set_scale(["left"], 1.0)

    before = hand.tip[0]
    ann.set_scale(scale=1.0)  # far from where the clutch closed, and still closed
    scenario.run_for(0.6)
    scenario.keep_engaged(hand)
    assert distance(hand.tip[0], before) < 1e-3
    sweep_hand(scenario, hand, 0.05, 1.0)

    ann.set_scale(["left"], 0.5)
    late = scenario.join("late", role="observer")
    scenario.run_until(lambda: len({c.mirror.event_seq for c in scenario.clients}) == 1, "all have the same events")
    assert [c.mirror.leases["left"].scale for c in scenario.clients] == [0.5] * 3
    assert len({c.mirror.mirror_hash() for c in scenario.clients}) == 1
    assert scenario.list_event_kinds("bob").count("ScaleChanged") == 3
    ann.release()
    scenario.run_until(lambda: late.mirror.leases["left"].scale == 1.0, "the scale of a free robot is 1")
    assert scenario.server.finish()["ok"]
