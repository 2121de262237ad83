"""Programs that drive robots: `move_to`, `send_target`, and a clutch that is opened and closed again by itself."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import pytest

from anchors.pose import PoseTuple, distance
from iris_session.client import Client, ClientError, InvalidMessageError, UnreachedError
from iris_session.protocol.client_messages import ClearEStop
from iris_session.protocol.names import HoldReason
from iris_session.protocol.server_messages import EngagementChanged
from iris_session.session.session import Session
from tests.rig.session import Rig, see_tip

SECOND = 1_000_000_000


def join_policy(rig: Rig) -> tuple[Client, PoseTuple]:
    """Join a policy that holds `left`. Return it, and the pose of the end effector."""
    policy = rig.join("policy", "agent")
    policy.acquire("left")
    rig.run_until(lambda: policy.scene.tip_pose("left") is not None)
    return policy, see_tip(policy, "left")


def list_ends(rig: Rig, name: str = "policy") -> list[str]:
    """Return the reasons of the engagements that have ended, as a client has learnt them."""
    return [body.reason for _, body in rig.list_events(name, EngagementChanged) if not body.engaged]


def test_move_to_reaches_a_pose_again_and_again_and_waits_for_the_gripper() -> None:
    with Rig(timestep=0.01) as rig:
        policy, ((x, y, z), q) = join_policy(rig)
        policy.move_to("left", ((x, y + 0.1, z + 0.1), q), gripper=1.0, settle_s=0.5)
        assert distance(see_tip(policy, "left")[0], (x, y + 0.1, z + 0.1)) < 0.003
        rig.run(0.5)
        assert list_ends(rig) == [HoldReason.STALE], "it holds once nothing is sent"
        policy.move_to("left", ((x, y, z), q))
        assert distance(see_tip(policy, "left")[0], (x, y, z)) < 0.003
        assert not any(policy.feedback["left"].rejected.values())


def test_a_motion_goes_on_after_a_stall_an_estop_and_a_lost_connection() -> None:
    with Rig(timestep=0.01) as rig:
        policy, ((x, y, z), q) = join_policy(rig)
        director = rig.join("dora", "director")
        now_ns = rig.simulation.now_ns
        disturbances: tuple[tuple[float, Callable[[], object]], ...] = (
            (1.0, lambda: rig.stop_loop(0.5)),
            (3.0, lambda: director.estop("test")),
            (4.0, lambda: director.submit(ClearEStop(0, 1))),
            (5.0, lambda: rig.cut(policy)),
        )
        for at_s, disturb in disturbances:
            rig.simulation.call_at(now_ns + round(at_s * SECOND), disturb)  # type: ignore[arg-type]
        for height in (0.05, 0.0) * 3:
            policy.move_to("left", ((x, y, z + height), q), settle_s=1.0)
        assert {HoldReason.GAP, HoldReason.ESTOP, HoldReason.DISCONNECTED} <= set(list_ends(rig, "dora"))
        assert distance(see_tip(policy, "left")[0], (x, y, z)) < 0.003


def test_a_pose_that_is_not_reached_says_how_far_and_why() -> None:
    with Rig(timestep=0.01) as rig:
        policy, ((x, y, z), q) = join_policy(rig)
        assert not policy.is_armed("left"), "the session has not seen the clutch open"
        with pytest.raises(InvalidMessageError, match="finite"):
            policy.move_to("left", ((x, y, z), q), gripper=float("nan"))
        for length, bad in ((0.0, (0.0, 0.0, 0.0, 0.0)), (2.0, (2.0, 0.0, 0.0, 0.0))):
            with pytest.raises(InvalidMessageError, match=f"has the length {length:g}; it must be 1"):
                policy.move_to("left", ((x, y, z), bad))
        with pytest.raises(ClientError, match="do not hold the robot 'right'"):
            policy.move_to("right", ((x, y, z), q))
        with pytest.raises(UnreachedError, match=r"within 0\.1 s") as soon:
            policy.move_to("left", ((x, y + 0.2, z), q), timeout_s=0.1)
        assert soon.value.distance_m > 0.1
        policy.release("left")
        rig.run(0.1)
        assert not policy.is_armed("left")
        with pytest.raises(InvalidMessageError, match=r"devices: joystick is none of controller/left, .*target"):
            Client(devices=("target", "joystick"))
        desktop = rig.join("ann", devices="desktop")
        desktop.acquire("left")
        with pytest.raises(ClientError, match=r"made with desktop: make it with devices='target'"):
            desktop.move_to("left", ((x, y, z), q))


def test_a_pose_out_of_reach_is_given_up_soon_and_the_arm_comes_back_from_beside_another() -> None:
    with Rig(timestep=0.005) as rig:
        policy, ((x, y, z), q) = join_policy(rig)
        begin_s = rig.now_s
        with pytest.raises(
            UnreachedError, match=r"came no nearer for 1 s; its limits: .*reach.*within its reach"
        ) as far:
            policy.move_to("left", ((x + 3.0, y, z), q))
        assert rig.now_s - begin_s < 6.0
        assert far.value.distance_m > 1.0
        rig.run(0.5)
        rig.check_rest(policy, "left", 0.5)
        policy.move_to("left", ((x + 0.1, y, z), q))
        policy.move_to("left", ((x, y, z), q))
        with pytest.raises(UnreachedError, match=r"within 3 s"):
            policy.move_to("left", ((x + 3.0, y, z), q), timeout_s=3.0, stall_s=5.0)


def test_a_motion_does_not_begin_while_the_session_is_stopped_or_paused() -> None:
    with Rig(timestep=0.01) as rig:
        policy, ((x, y, z), q) = join_policy(rig)
        director = rig.join("dora", "director")
        for stop, go_on, why in (
            (lambda: policy.estop("test"), director.clear_estop, r"stopped \(e-stop\).*clear_estop"),
            (lambda: director.control("pause"), lambda: director.control("resume"), "is paused"),
        ):
            stop()
            begin_s = rig.now_s
            with pytest.raises(UnreachedError, match=why):
                policy.move_to("left", ((x, y, z + 0.05), q))
            assert rig.now_s - begin_s < 0.5
            go_on()
            rig.run(0.2)
            policy.move_to("left", ((x, y, z + 0.05), q))
            policy.move_to("left", ((x, y, z), q))


def test_the_error_of_a_motion_whose_samples_are_rejected_says_why() -> None:
    with Rig(timestep=0.01) as rig:
        policy, ((x, y, z), q) = join_policy(rig)
        with pytest.raises(UnreachedError, match=r"it holds: rejected \(not_finite\)"):
            policy.move_to("left", ((x + 2000.0, y, z), q), timeout_s=1.0)


class HomingRig(Rig):
    """Its robots go home when they are released."""

    def _make_session(self) -> Session:
        session = super()._make_session()
        session.robots = tuple(msgspec.structs.replace(one, on_release="home") for one in session.robots)
        return session


def test_a_released_robot_goes_home_within_its_limits_and_an_estop_stops_it_for_good() -> None:
    with HomingRig(timestep=0.01) as rig:
        policy, home = join_policy(rig)
        director = rig.join("dora", "director")
        (x, y, z), q = home
        for stops in (False, True):
            policy.acquire("left")
            policy.move_to("left", ((x, y + 0.15, z + 0.1), q))
            policy.release("left")
            rig.run(0.2)
            rig.check_rest(director, "left", 0.2)
            if stops:
                rig.run_until(lambda: distance(see_tip(director, "left")[0], (x, y, z)) < 0.1)
                director.estop("test")
                rig.run(0.4)
                director.clear_estop()
                rig.check_rest(director, "left", 2.0)
                assert distance(see_tip(director, "left")[0], (x, y, z)) > 0.03
            else:
                rig.run(6.0)
                assert distance(see_tip(director, "left")[0], (x, y, z)) < 0.01
                rig.check_rest(director, "left", 1.0)


def test_a_client_reads_joints_gripper_force_target_and_commands_of_its_robot() -> None:
    with Rig(timestep=0.01) as rig:
        policy = rig.join("policy", "agent", robot_states=True)
        other = rig.join("other", "observer")
        policy.acquire("left")
        rig.run_until(lambda: policy.scene.robot_state("left") is not None)
        world, robots = rig.session.stepper.core.world, rig.session.stepper.core.scene.robots
        names = robots[0].actuators + tuple(one.actuator for one in robots[0].gripper_actuators)
        assert robots[0].name == "left"
        rest = policy.scene.robot_state("left")
        assert rest is not None
        assert rest.target is None, "it holds"
        (x, y, z), q = rest.tip.p, rest.tip.q
        policy.move_to("left", ((x, y, z + 0.05), q), gripper=1.0, settle_s=0.5)
        state = policy.scene.robot_state("left")
        assert state is not None
        assert state.target is not None
        assert distance(state.target.p, (x, y, z + 0.05)) < 1e-6
        assert rest.gripper == pytest.approx(0.0, abs=0.1)
        assert state.gripper == pytest.approx(1.0, abs=0.1)
        rig.run(1.0)  # it holds at rest: what the client sees is what the world is
        state = policy.scene.robot_state("left")
        assert state is not None
        assert state.target is None
        assert state.q == pytest.approx([world.data.joint(name).qpos[0] for name in robots[0].joints], abs=1e-6)
        assert state.qd == pytest.approx([world.data.joint(name).qvel[0] for name in robots[0].joints], abs=1e-6)
        assert state.ctrl == pytest.approx([world.data.actuator(name).ctrl[0] for name in names], abs=1e-6)
        assert distance(state.tip.p, see_tip(policy, "left")[0]) < 1e-3
        assert policy.scene.robot_state("nothing") is None
        with pytest.raises(ClientError, match="robot_states"):
            other.scene.robot_state("left")
        assert other.counters()["state"]["robot_states"] == 0, "only who asks receives them"
