"""Sessions in a program's own loop: whose `ctrl` counts, resets, a loop that blocks, physics that diverges."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from anchors.pose import distance
from iris_session.protocol.names import CommandKind, HoldReason
from iris_session.protocol.server_messages import Gap, SceneChanged
from tests.rig.session import Hand, Rig, see_tip


def rest(rig: Rig, hand: Hand) -> None:
    """Stop the hand and wait until the tip does not move."""
    hand.velocity = (0.0, 0.0, 0.0)
    rig.run(1.0)


def reset(rig: Rig) -> None:
    assert rig.session.data is not None
    mujoco.mj_resetDataKeyframe(rig.session.model, rig.session.data, 0)
    rig.session.data.time = 0.0


def test_policy_drives_until_a_participant_engages_and_after_the_release() -> None:
    """The journal continues from every keyframe, also from those of a robot that is driven or given back."""
    with Rig(user_loop=True, timestep=0.02, keyframe_s=0.5) as rig:
        home = rig.session.model.key_ctrl[0].copy()

        def policy(data: mujoco.MjData) -> None:
            data.ctrl[:] = home
            data.ctrl[0] += 0.3 * min(1.0, data.time)
            for request in rig.session.poll_requests():
                requests.append((request.name, request.kind))
                reset(rig)

        requests: list[tuple[str, str]] = []
        rig.policy = policy
        watcher = rig.join("watcher", "director")
        rig.run(2.0)
        alone = see_tip(watcher, "left")
        hand = rig.drive("ann", "left", (0.0, 0.1, 0.0))
        rig.run(0.5)
        assert distance(alone[0], hand.tip[0]) > 0.02
        hand.sending = False
        hand.client.release("left")
        rig.run(3.0)
        assert distance(alone[0], hand.tip[0]) < 2e-3, "the policy has its robot again"
        epoch = watcher.mirror.scene_epoch
        watcher.control("reset")
        rig.run(0.5)
        assert requests == [("watcher", "reset")]
        assert watcher.mirror.scene_epoch == epoch + 1
    assert len(rig.journal.keyframes) > 10
    for i in range(len(rig.journal.keyframes)):
        rig.journal.verify(i)


def test_a_loop_that_blocks_keeps_leases_and_the_estop() -> None:
    """Afterwards the robot holds until the clutch was opened."""
    with Rig(user_loop=True, timestep=0.02) as rig:
        hand = rig.drive("ann", "left", (0.0, 0.05, 0.0))
        ann, director = hand.client, rig.join("director", "director")
        rest(rig, hand)
        before, reconnects = hand.tip, ann.connection.counters.reconnects
        state = director.scene.state
        assert state is not None
        rig.stop_loop(5.0)  # longer than the heartbeat timeout
        rig.run(0.1)
        director.acquire(["right"])
        assert ann.lease_version("right") is None
        ann.estop("test")
        rig.run(0.1)
        assert director.mirror.estop
        director.clear_estop()
        hand.velocity = (0.0, 0.2, 0.0)  # the hand moves on with its clutch closed
        rig.run(4.0)
        assert ann.connection.counters.reconnects == reconnects
        rig.run(2.0)
        assert distance(before[0], hand.tip[0]) < 2e-3
        feedback = ann.feedback["left"]
        assert feedback.state == CommandKind.HOLD
        assert feedback.hold_reason in (HoldReason.GAP, HoldReason.ESTOP)
        assert any(isinstance(event.body, Gap) for event in rig.events["ann"])
        hand.velocity = (0.0, 0.0, 0.0)
        rig.engage(hand)
        assert distance(before[0], hand.tip[0]) < 4e-3


def test_reset_by_the_program_begins_a_scene_epoch() -> None:
    """The robot holds where the reset put it; the clutch must be opened and closed."""
    with Rig(user_loop=True, timestep=0.02) as rig:
        watcher = rig.join("watcher", "observer")
        rig.run(0.5)
        start = see_tip(watcher, "left")
        hand = rig.drive("ann", "left", (0.0, 0.1, 0.0))
        rig.run(0.5)
        reset(rig)
        rig.run(1.5)
        assert watcher.mirror.scene_epoch == 2
        assert [e.body.cause for e in rig.events["watcher"] if isinstance(e.body, SceneChanged)] == ["external"]
        assert distance(start[0], hand.tip[0]) < 2e-3
        hand.velocity = (0.0, 0.0, 0.0)
        rig.engage(hand)
        assert distance(start[0], hand.tip[0]) < 4e-3


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_diverged_physics_does_not_end_the_session() -> None:
    """Clients are told; MuJoCo's own reset in `mj_step` begins a scene epoch."""
    with Rig(user_loop=True, timestep=0.02) as rig:
        watcher = rig.join("watcher", "observer")
        assert rig.session.data is not None
        rig.session.data.qvel[:] = np.nan
        rig.run(1.0)
        kinds = rig.list_event_kinds("watcher")
        assert {"MarkerAdded", "Gap"} <= set(kinds)
        assert watcher.mirror.scene_epoch == 2
        reset(rig)  # MuJoCo's reset leaves the arms stretched, where they cannot follow
        rig.run(0.5)
        assert watcher.mirror.scene_epoch == 3
        rig.drive("ann", "left")
