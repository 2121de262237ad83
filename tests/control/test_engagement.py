"""What a person feels on real robots: no jump on engage, no sag, no drift, with every type of actuator."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.pose import PoseTuple, quat_from_rotvec
from tests.control.rigs import (
    PANDA_HOME,
    Rig,
    aloha_model,
    aloha_robots,
    apart,
    decision,
    old,
    panda_model,
    panda_spec,
    pose_command,
)

pytestmark = pytest.mark.usefixtures("untraced")

KINDS = ["position", "velocity", "torque"]


def panda(kind: str) -> Rig:
    rig = Rig(panda_model(kind), [panda_spec(kind=kind)], home=PANDA_HOME)
    rig.hold(1000)  # physics settles under gravity
    return rig


def aloha() -> Rig:
    rig = Rig(aloha_model(), aloha_robots())
    rig.hold(2500)
    return rig


def drag(rig: Rig, steps: int, engagement: int, speed: float = 0.15) -> None:
    """Every robot's hand moves along a curve for a while, 72 Hz of samples at 500 Hz of steps."""
    commands = []
    for k in range(steps):
        t = k * 0.002
        if k % 7 == 0:
            p = (speed * math.sin(t), speed * (math.cos(1.7 * t) - 1), 0.5 * speed * math.sin(2.1 * t))
            q = quat_from_rotvec((0.0, 0.2 * math.sin(t), 0.3 * math.sin(1.3 * t)))
            commands = [pose_command(r.name, rig.source(p, q, engagement=engagement)) for r in rig.robots]
        else:
            commands = [pose_command(c.robot, *(old(s) for s in c.sources)) for c in commands]
        rig.step(decision(commands))


def engage_jump(rig: Rig, engagement: int) -> tuple[float, float]:
    """Tip motion [m, deg] over the first engaged step and the next two, hand anywhere in the room."""
    before = [rig.tip(i) for i in range(len(rig.robots))]
    worst = (0.0, 0.0)
    for _ in range(3):
        hand: PoseTuple = ((2.0, -1.0, 0.3 * engagement), quat_from_rotvec((1.0, 0.0, 0.1 * engagement)))
        rig.step(decision(pose_command(r.name, rig.source(*hand, engagement=engagement)) for r in rig.robots))
        moved = [apart(a, rig.tip(i)) for i, a in enumerate(before)]
        worst = max(worst[0], *(m[0] for m in moved)), max(worst[1], *(m[1] for m in moved))
    return worst


def test_the_first_engaged_step_leaves_ctrl_bitwise_unchanged() -> None:
    rig = panda("position")
    before = rig.data.ctrl.tobytes()
    rig.step(decision([pose_command("panda", rig.source((4.0, 5.0, 6.0), quat_from_rotvec((1.0, 1.0, 1.0))))]))
    assert rig.data.ctrl.tobytes() == before


@pytest.mark.parametrize("make", [*KINDS, "aloha"])
def test_no_jump_on_engage_nor_after_three_seconds_without_tracking(make: str) -> None:
    rig = aloha() if make == "aloha" else panda(make)
    for engagement, pause in ((1, 1500), (3, 1500), (5, 200)):
        rig.hold(pause)  # 1500 steps: 3 s
        distance, angle = engage_jump(rig, engagement)
        assert distance <= 1e-4
        assert angle <= 0.05
        rig.hold(50)
        drag(rig, 300, engagement + 1)


@pytest.mark.parametrize("make", [*KINDS, "aloha"])
def test_no_sag_on_repeated_engage(make: str) -> None:
    rig = aloha() if make == "aloha" else panda(make)
    targets = [rig.target(i) for i in range(len(rig.robots))]
    start = [rig.tip(i) for i in range(len(rig.robots))]
    for engagement in range(1, 31):
        for _ in range(20):
            source = [rig.source((0.0, 0.01 * engagement, 0.0), engagement=engagement) for _ in rig.robots]
            rig.step(decision(pose_command(r.name, s) for r, s in zip(rig.robots, source, strict=True)))
        rig.hold(10)
    for i in range(len(rig.robots)):
        # Aloha creeps in its own joint friction, and the target of an arm that holds is where it stands.
        assert apart(targets[i], rig.target(i))[0] < (2e-4 if make == "aloha" else 1e-6)
        assert apart(start[i], rig.tip(i))[0] < 2e-4


@pytest.mark.parametrize(("make", "bound"), [("position", 1e-6), ("velocity", 1e-4), ("torque", 1e-6), ("aloha", 1e-3)])
def test_no_drift_in_hold_after_a_drag(make: str, bound: float) -> None:
    rig = aloha() if make == "aloha" else panda(make)
    drag(rig, 700, 1)
    rig.hold(2000)
    start, ctrl = [rig.tip(i) for i in range(len(rig.robots))], rig.data.ctrl.copy()
    rig.hold(2500)  # 5 s
    for i, tip in enumerate(start):
        assert apart(tip, rig.tip(i))[0] < bound
    if make in ("position", "aloha"):
        assert (rig.data.ctrl == ctrl).all()


@pytest.mark.parametrize("kind", KINDS)
def test_the_tip_follows_the_hand(kind: str) -> None:
    rig = panda(kind)
    start = rig.tip()
    rig.step(decision([pose_command("panda", rig.source((0.0, 0.0, 0.0)))]))
    turn = quat_from_rotvec((0.0, 0.0, 0.5))
    for _ in range(200):
        for k in range(7):
            rig.step(decision([pose_command("panda", rig.source((-0.1, 0.15, 0.1), turn, new=k == 0))]))
    moved = np.subtract(rig.tip()[0], start[0])
    assert moved == pytest.approx((-0.1, 0.15, 0.1), abs={"position": 4e-3, "velocity": 2e-3, "torque": 1e-4}[kind])
    expected = apart(((0.0, 0.0, 0.0), start[1]), ((0.0, 0.0, 0.0), rig.tip()[1]))[1]
    assert expected == pytest.approx(math.degrees(0.5), abs=0.5)
