"""Scenes that are replaced or patched in a running session: all clients follow, late ones get the same, it replays."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from anchors.pose import distance
from iris_session.client import Client
from iris_session.demo.scenes import n_arms_scene
from iris_session.protocol.common import Pose
from iris_session.protocol.scene import AddVisual, Geometry, SetVisual, Visual
from iris_session.protocol.server_messages import SceneChanged
from tests.rig.session import Rig

RED = (1.0, 0.0, 0.0, 1.0)


def compile_scene(timestep: float, n_arms: int, objects: int = 0) -> mujoco.MjModel:
    spec = n_arms_scene(n_arms, objects=objects)
    spec.option.timestep = timestep
    return spec.compile()


def wait_for_epoch(rig: Rig, epoch: int) -> None:
    def has_arrived(client: Client) -> bool:
        state = client.scene.state
        return client.mirror.synced and state is not None and state.header.scene_epoch == epoch

    rig.run_until(lambda: all(map(has_arrived, rig.clients)), f"all have state of scene epoch {epoch}", 2.0)


def test_operators_go_on_in_another_scene() -> None:
    with Rig(timestep=0.01) as rig:
        hand = rig.drive("ann", "left", (0.0, 0.03, 0.0))
        ann, bob = hand.client, rig.join("bob")
        bob.acquire(["right"])
        rig.run(0.5)

        rig.session.load_scene(compile_scene(0.005, 2, objects=3)).result(0.0)
        wait_for_epoch(rig, 2)
        assert ann.mirror.leases["left"].holder == ann.participant_id, "ann keeps her robot"
        assert "object3" in bob.mirror.body_index
        assert "hammer" not in bob.mirror.leases
        still = hand.tip[0]
        rig.run(1.0)
        assert distance(hand.tip[0], still) < 1e-3, "a closed clutch must not move the robot"
        hand.velocity = (0.0, 0.0, 0.0)
        rig.engage(hand)
        hand.velocity = (0.0, 0.05, 0.0)
        rig.run(1.0)
        assert hand.tip[0][1] - still[1] > 0.03
        assert {client.scene.tick_period_ns for client in rig.clients} == {5_000_000}


def test_clients_of_every_kind_have_the_new_scene() -> None:
    """Present when it was loaded, late, and joined again through a front that was replaced."""
    with Rig(timestep=0.01) as rig:
        ann = rig.join("ann")
        rig.session.load_scene(compile_scene(0.004, 3)).result(0.0)
        wait_for_epoch(rig, 2)
        late = rig.join("late", "observer")
        wait_for_epoch(rig, 2)
        rig.kill_front()
        rig.run_until(lambda: not ann.ready, "ann is disconnected")
        rig.run_until(lambda: ann.ready and late.ready, "both are back")
        ann.acquire(["arm2"])
        wait_for_epoch(rig, 2)
        rig.run(0.2)
        for client in (ann, late):
            assert sorted(client.mirror.robots) == ["arm1", "arm2", "arm3"]
            welcome, state = client.connection.welcome, client.scene.state
            assert welcome is not None
            assert state is not None
            assert welcome.tick_period_ns == client.mirror.tick_period_ns == 4_000_000
            assert state.header.sim_time == pytest.approx(4e-3 * state.header.tick)
        assert late.status().tick_period_ns == 4_000_000
        assert ann.mirror.event_seq == late.mirror.event_seq
        assert ann.mirror.mirror_hash() == late.mirror.mirror_hash()


def test_patch_is_the_same_for_present_and_late_clients_and_stops_nobody(tmp_path: Path) -> None:
    with Rig(timestep=0.01, assets=tmp_path) as rig:
        hand = rig.drive("ann", "left", (0.0, 0.02, 0.0))
        before = rig.session.scene
        assert before is not None
        lamp = Visual(
            1 + max(v.id for v in before.visuals), 0, "lamp", Pose((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)), 0,
            Geometry("sphere", (0.1, 0.1, 0.1)), -1, RED,
        )  # fmt: skip
        rig.session.patch_scene(*(SetVisual(visual.id, rgba=RED) for visual in before.visuals[:60]))
        rig.session.patch_scene(AddVisual(lamp))
        rig.run_until(lambda: hand.client.mirror.scene_revision == 2, "both patches have arrived", 1.0)
        assert hand.is_following
        late = rig.join("late", "observer")
        rig.run(0.2)
        changes = [e.body for e in rig.events["ann"] if isinstance(e.body, SceneChanged)]
        assert late.mirror.scene_hash == hand.client.mirror.scene_hash == changes[-1].scene_hash
        assert late.mirror.mirror_hash() == hand.client.mirror.mirror_hash()
        after = rig.session.scene
        assert after is not None
        assert after.visuals[-1] == lamp
        assert {v.rgba for v in after.visuals[:60]} == {RED}
        assert after.visuals[60:-1] == before.visuals[60:]
