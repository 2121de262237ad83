"""Several real clients in one real session: denial, killing and resuming, late joiners, recentring, bad input."""

from __future__ import annotations

import itertools
import math
import subprocess
from collections.abc import Callable

import msgspec
import pytest
import zmq

from anchors.pose import PoseTuple, distance, quat_angle
from iris_session.client import Client, DeniedError
from iris_session.protocol.names import DenialReason, RejectReason
from iris_session.protocol.server_messages import AlignmentChanged, LeaseChanged, SamplesRejected
from tests.e2e.conftest import Hand, Server, Stage

pytestmark = pytest.mark.e2e


@pytest.fixture
def stage(visit: Stage) -> Stage:
    """One session for all of them."""
    return visit


def _moved(a: PoseTuple, b: PoseTuple) -> float:
    return distance(a[0], b[0])


def test_second_operator_is_denied_and_told_by_whom(stage: Stage) -> None:
    ann, bob = stage.join("ann"), stage.join("bob")
    ann.acquire(["left"])
    with pytest.raises(DeniedError) as denied:
        bob.acquire(["left", "right"])
    denial = denied.value.denial
    assert denial.reason == DenialReason.HELD
    assert denial.holder == ann.connection.participant_id
    assert denial.holder_name == "ann"
    assert denial.advice
    assert bob.lease_version("right") is None  # all or none
    hand = stage.hand(bob, "left")
    hand.clutch, hand.velocity = True, (0.2, 0.0, 0.0)
    before = hand.tip
    stage.seconds(0.7)
    assert _moved(before, hand.tip) < 1e-4


def test_operator_moves_the_robot_and_holding_stops_it(stage: Stage) -> None:
    hand = stage.hand(stage.join("ann"), "left")
    hand.client.acquire(["left"])
    before = hand.tip
    stage.engage(hand)
    assert _moved(before, hand.tip) < 1e-3
    hand.velocity = (0.0, 0.1, 0.0)
    stage.run(lambda: hand.tip[0][1] - before[0][1] > 0.05, "the tip follows the hand by 5 cm")
    hand.sending = False
    stage.seconds(0.8)  # 150 ms until stale, then it decelerates
    resting = hand.tip
    stage.seconds(0.5)
    assert _moved(resting, hand.tip) < 5e-4


def test_killed_while_holding_then_resumes(
    stage: Stage, emulate: Callable[..., subprocess.Popen[bytes]], tmp_path: object
) -> None:
    """kill -9 of a person's process: the robot holds, the lease waits, and the same person comes back to it."""
    headset = f"name=ann,behaviour=wander,robot=left,identity_file={tmp_path}/ann.identity"
    watcher = stage.join("watcher", "observer")
    first = emulate(stage.server.address, headset)
    stage.run(lambda: _applied_since(watcher, "left"), "ann drives")
    lease = watcher.mirror.leases["left"]
    first.kill()
    stage.run(lambda: watcher.mirror.leases["left"].expires_ns > 0, "the lease is kept for a while")
    ann = watcher.mirror.participants[lease.holder]
    assert not ann.connected
    stage.seconds(0.5)
    resting = watcher.scene.tip_pose("left")
    assert resting is not None
    stage.seconds(0.5)
    now = watcher.scene.tip_pose("left")
    assert now is not None
    assert _moved(resting, now) < 5e-4
    emulate(stage.server.address, headset)
    stage.run(lambda: watcher.mirror.participants[lease.holder].connected, "ann is back")
    resumed = watcher.mirror.leases["left"]
    assert resumed.holder == lease.holder
    assert resumed.lease_version > lease.lease_version
    stage.run(lambda: _applied_since(watcher, "left"), "ann drives again")


def _applied_since(client: Client, robot: str) -> bool:
    state = client.scene.state
    return state is not None and any(
        a.robot == robot and state.header.session_time - a.step_ns < 100_000_000 for a in state.header.applied
    )


def test_late_joiner_has_the_same_state(stage: Stage) -> None:
    ann = stage.join("ann")
    ann.acquire(["left"])
    director = stage.join("director", "director")
    director.marker("before")
    director.set_mode("right", "request")
    ann.episode("start", "one")
    late = stage.join("late", "observer")
    director.marker("after")

    def same() -> bool:
        return len({(c.mirror.event_seq, c.mirror.mirror_hash()) for c in (ann, director, late)}) == 1

    stage.run(same, "all three mirrors agree")
    assert late.mirror.leases["left"].holder == ann.connection.participant_id
    assert late.mirror.episode is not None

    def poses_agree() -> bool:
        states = [c.scene.state for c in (ann, late)]
        if any(s is None for s in states):
            return False
        return all(
            abs(float(v)) < 3e-4
            for v in (states[0].poses - states[1].poses).ravel()  # type: ignore[union-attr]
        )

    stage.run(poses_agree, "the late joiner has the same poses")


def test_recentring_in_motion_does_not_move_the_robot(
    stage: Stage, emulate: Callable[..., subprocess.Popen[bytes]]
) -> None:
    """The tracking frame jumps by metres while the clutch is closed: hold, realign, clutch again; never a jump."""
    watcher = stage.join("watcher", "observer")
    emulate(stage.server.address, "name=ann,behaviour=wander,robot=left,recentre_at_s=12")
    epochs: set[int] = set()
    tips: list[tuple[int, PoseTuple]] = []

    def realigned_and_driving() -> bool:
        for event in stage.events["watcher"]:
            if isinstance(event.body, AlignmentChanged) and event.body.alignment.kind == "measured":
                epochs.add(event.body.alignment.tracking_epoch)
        tip, state = watcher.scene.tip_pose("left"), watcher.scene.state
        if tip is not None and state is not None and (not tips or tips[-1][0] != state.header.tick):
            tips.append((state.header.tick, tip))
        return len(epochs) >= 2 and _applied_since(watcher, "left")

    stage.run(realigned_and_driving, "ann drives again after recentring", 60.0)
    for (tick0, a), (tick1, b) in itertools.pairwise(tips):
        seconds = (tick1 - tick0) * 0.002
        assert _moved(a, b) <= 0.6 * max(seconds, 0.017), (tick0, tick1)


def test_wrong_version_is_refused_with_what_is_supported(house: Server) -> None:
    context = zmq.Context()
    try:
        socket = context.socket(zmq.DEALER)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(f"tcp://{house.address}")
        socket.send(msgspec.msgpack.encode([99, 0, "", {"type": "hello", "from": "the future"}]))
        assert socket.poll(30_000)
        _, _, message = msgspec.msgpack.decode(socket.recv_multipart()[0])
        assert message["type"] == "refused"
        assert message["code"] == "version"
        assert message["supported_versions"] == [1]
        socket.close()
    finally:
        context.term()
    stage = Stage(house)
    stage.join("ann")  # the session takes others as before
    stage.close()


IMPOSSIBLE: tuple[tuple[PoseTuple, str], ...] = (
    (((math.nan, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)), RejectReason.NOT_FINITE),
    (((0.0, math.inf, 1.0), (1.0, 0.0, 0.0, 0.0)), RejectReason.NOT_FINITE),
    (((0.0, 0.0, 1.0), (0.5, 0.0, 0.0, 0.0)), RejectReason.NOT_UNIT),
    (((2.5, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)), RejectReason.TOO_FAST),
)


def test_poses_that_cannot_be(stage: Stage) -> None:
    """One impossible pose ends the engagement, is named, and moves nothing. Each comes from somebody else."""
    watcher = stage.join("watcher", "observer")
    for pose, reason in IMPOSSIBLE:
        hand = stage.hand(stage.join("ann"), "left")
        ann = hand.client
        ann.acquire(["left"])
        stage.engage(hand)
        before = hand.tip
        hand.sending = False
        ann.send_sample(hand.device, pose, robots=["left"], clutch=True)

        def named(me: str = ann.participant_id, reason: str = reason) -> bool:
            bodies = [event.body for event in stage.events["watcher"]]
            return any(isinstance(b, SamplesRejected) and (b.participant, b.reason) == (me, reason) for b in bodies)

        stage.run(named, f"a rejection for {reason}")
        stage.seconds(0.4)
        assert _moved(before, hand.tip) < 1e-3
        assert quat_angle(before[1], hand.tip[1]) < 1e-2
        hand.sending = True
        stage.engage(hand)
        stage.hands.remove(hand)
        stage.clients.remove(ann)
        ann.close()
        stage.run(lambda: not watcher.mirror.leases["left"].holder, "the robot is free")


def test_takeover_estop_pause_reset_verify(serve: Callable[..., Server]) -> None:
    """One session with everything that changes who moves what; its recording verifies."""
    stage = Stage(serve("handover", "--mode", "takeover"))
    try:
        ann, bob, director = stage.join("ann"), stage.join("bob"), stage.join("director", "director")
        ann.acquire(["left"])
        anns = stage.hand(ann, "left")
        stage.engage(anns)
        anns.velocity = (0.0, 0.05, 0.0)
        bob.acquire(["left"])
        stage.run(lambda: ann.lease_version("left") is None, "ann hears of the takeover")
        causes = [e.body.cause for e in stage.events["ann"] if isinstance(e.body, LeaseChanged)]
        assert "takeover" in causes
        bobs = stage.hand(bob, "left")
        stage.engage(bobs)
        _estop_and_clear(stage, bobs, director)
        _pause_and_resume(stage, bobs, director)
        _reset(stage, bobs, director)
        stage.server.finish()
    finally:
        stage.close()


def _estop_and_clear(stage: Stage, hand: Hand, director: Client) -> None:
    hand.velocity = (0.0, 0.1, 0.0)
    stage.seconds(0.3)
    hand.client.estop("test")
    stage.run(lambda: director.mirror.estop, "the e-stop is known")
    stage.seconds(0.4)
    resting = hand.tip
    stage.seconds(0.4)
    assert _moved(resting, hand.tip) < 5e-4
    with pytest.raises(DeniedError):
        hand.client.clear_estop()
    director.clear_estop()
    stage.seconds(0.3)
    assert _moved(resting, hand.tip) < 5e-4, "a closed clutch must not move the robot after the e-stop was cleared"
    stage.engage(hand)


def _pause_and_resume(stage: Stage, hand: Hand, director: Client) -> None:
    director.control("pause")
    stage.run(lambda: hand.client.mirror.paused, "paused")
    assert director.scene.state is not None
    stage.seconds(0.2)
    tick = director.scene.state.header.tick
    stage.seconds(0.3)
    assert director.scene.state.header.tick == tick
    director.control("step", 5)
    stage.run(
        lambda: director.scene.state is not None and director.scene.state.header.tick == tick + 5, "five single steps"
    )
    director.control("resume")
    stage.run(
        lambda: director.scene.state is not None and director.scene.state.header.tick > tick + 50, "running again"
    )


def _reset(stage: Stage, hand: Hand, director: Client) -> None:
    epoch = director.mirror.scene_epoch
    director.control("reset")
    stage.run(lambda: hand.client.mirror.scene_epoch == epoch + 1, "a new scene epoch")
    stage.run(lambda: hand.client.lease_version("left") is not None, "leases stay")
    stage.engage(hand)


def test_four_operators_verify(serve: Callable[..., Server], emulate: Callable[..., subprocess.Popen[bytes]],
                               tmp_path: object) -> None:  # fmt: skip
    """Four aligned people, each in a process of their own, move four arms at once."""
    from pathlib import Path

    from iris_session.demo.scenes import n_arms_scene

    scene = Path(str(tmp_path)) / "four.xml"
    spec = n_arms_scene(4)
    spec.compile()
    scene.write_text(spec.to_xml())
    stage = Stage(serve(str(scene)))
    try:
        watcher = stage.join("watcher", "observer")
        for i in range(4):
            emulate(stage.server.address, f"name=op{i},behaviour=wander,robot=arm{i + 1},seed={i}")
        stage.run(lambda: all(_applied_since(watcher, f"arm{i + 1}") for i in range(4)), "four arms move", 60.0)
        stage.seconds(2.0)
        stage.server.finish()
    finally:
        stage.close()
