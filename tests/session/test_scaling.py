"""Motion scaling through the whole session: the hand's path times the scale, and no jump when the scale changes."""

from __future__ import annotations

import pytest

from anchors.pose import Vec3, distance
from iris_session.control import ControlConfig
from iris_session.protocol.client_messages import Acquire, Sample, SetScale
from iris_session.protocol.common import Pose, Target
from iris_session.protocol.entries import Entry, Join
from iris_session.protocol.server_messages import Reply
from iris_session.session.core import CoreConfig, SessionCore, StepOutcome
from tests.session.play import ANN, SAMPLE_STEPS, TICK_NS, make_core


class Ann:
    """An operator that holds the left robot and moves its hand."""

    def __init__(self, core: SessionCore) -> None:
        self.core = core
        self.step_number = self.sampled = 0
        self.hand: Vec3 = (0.0, 0.0, 1.0)
        self.step(Join("key", "operator", "ann", devices=("desktop",), alignment="not_needed"))
        self.step(Acquire(1, ("left",)))
        self.hold(20, clutch=False)
        self.hold(20)

    def step(self, *messages: object) -> StepOutcome:
        self.step_number += 1
        now_ns = self.step_number * TICK_NS
        return self.core.step(now_ns, [Entry(ANN, ANN, now_ns, m) for m in messages], 1)  # type: ignore[arg-type]

    def hold(self, steps: int, velocity: Vec3 = (0.0, 0.0, 0.0), clutch: bool = True) -> None:
        """Move the hand at `velocity` [m/s] for some steps, with samples at 71 Hz."""
        for _ in range(steps):
            x, y, z = (p + v * TICK_NS * 1e-9 for p, v in zip(self.hand, velocity, strict=True))
            self.hand = (x, y, z)
            due = self.step_number >= self.sampled + SAMPLE_STEPS
            self.step(*([self.sample(clutch)] if due else []))

    def sample(self, clutch: bool) -> Sample:
        self.sampled = self.step_number
        return Sample(
            device="desktop",
            kind="pose",
            seq=self.step_number,
            capture_ns=(self.step_number + 1) * TICK_NS,
            scene_epoch=1,
            tracking_epoch=0,
            alignment_version=1,
            targets=(Target("left", 1),),
            clutch=clutch,
            pose=Pose(self.hand, (1.0, 0.0, 0.0, 0.0)),
        )

    def tip(self) -> Vec3:
        """Return the commanded tip, without the sag of the simulated arm."""
        return self.core.controller.get_targets()["left"].p

    def set_scale(self, scale: float) -> None:
        outcome = self.step(SetScale(9, ("left",), scale))
        (reply,) = [o.message for o in outcome.decision.outgoing if isinstance(o.message, Reply)]
        assert reply.ok


def test_tip_moves_by_the_path_of_the_hand_times_the_scale() -> None:
    ann = Ann(make_core())
    start = ann.tip()
    ann.hold(250, (0.0, 0.1, 0.0))  # 50 mm
    ann.hold(100)
    assert ann.tip()[1] - start[1] == pytest.approx(0.05, abs=1e-4)
    ann.set_scale(0.2)
    ann.hold(250, (0.0, 0.1, 0.0))
    ann.hold(100)
    assert ann.tip()[1] - start[1] == pytest.approx(0.06, abs=1e-4)
    assert distance(ann.tip(), (start[0], ann.tip()[1], start[2])) < 1e-3


@pytest.mark.parametrize("scale", [0.05, 5.0])
def test_changing_the_scale_while_engaged_does_not_move_the_tip(scale: float) -> None:
    """The hand rests far from where it engaged: the latched offset must not be scaled again."""
    ann = Ann(make_core())
    ann.hold(500, (0.05, 0.1, 0.0))
    ann.hold(200)
    before = ann.tip()
    plant = ann.core.world.view().tip_pose("left").p
    ann.set_scale(scale)
    assert ann.tip() == before
    ann.hold(200)
    assert distance(ann.tip(), before) < 1e-6
    assert distance(ann.core.world.view().tip_pose("left").p, plant) < 1e-4


def test_changing_the_scale_in_motion_changes_only_speed() -> None:
    """In no tick does the arm move much faster than the hand at the largest of the scales, 0.2 m/s."""
    ann = Ann(make_core())
    ann.hold(250, (0.0, 0.1, 0.0))
    fastest, tip = 0.0, ann.core.world.view().tip_pose("left").p
    for scale in (0.2, 2.0, 0.2, 1.0, 2.0):
        ann.set_scale(scale)
        for _ in range(50):
            ann.hold(1, (0.0, 0.1, 0.0))
            before, tip = tip, ann.core.world.view().tip_pose("left").p
            fastest = max(fastest, distance(tip, before))
    assert fastest < 2.0 * 0.2 * TICK_NS * 1e-9


def test_restored_session_keeps_its_scale() -> None:
    one, two = make_core(), make_core()
    ann = Ann(one)
    ann.hold(100, (0.0, 0.1, 0.0))
    ann.set_scale(0.3)
    two.restore(one.snapshot())
    now_ns = (ann.step_number + 1) * TICK_NS
    entry = Entry(ANN, ANN, now_ns, ann.sample(True))
    assert one.step(now_ns, [entry], 1).digest == two.step(now_ns, [entry], 1).digest
    assert one.snapshot() == two.snapshot()


def test_scale_out_of_range_is_denied() -> None:
    config = make_core().config
    narrow = CoreConfig(config.authority, ControlConfig(min_scale=0.5, max_scale=1.0), config.robots, config.objects)
    core = SessionCore(make_core().world.model, narrow)
    ann = Ann(core)
    outcome = ann.step(SetScale(9, ("left",), 2.0))
    (reply,) = [o.message for o in outcome.decision.outgoing if isinstance(o.message, Reply)]
    assert reply.denial is not None
    assert "0.5 to 1" in reply.denial.advice
