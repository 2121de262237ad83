"""Values that a publisher sets: checked at once, unchanged after an error, published together as one frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from iris_session.protocol.common import Pose
from iris_session.scene.result import ArticulatedBody
from iris_session.session.errors import PublishError
from iris_session.session.pending_state import PendingState
from tests.session.published import CLOTH, MOVING, UNIT, composed

TURNED = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # a quarter turn around z


@pytest.fixture
def pending() -> PendingState:
    return PendingState(composed())


def pose(pending: PendingState, name: str) -> list[float]:
    return pending.make_frame(0, 0.0, anew=False).poses[MOVING.index(name)].tolist()


def everything(pending: PendingState) -> bytes:
    frame = pending.make_frame(0, 0.0, anew=False)
    return frame.poses.tobytes() + b"".join(v.tobytes() for v in frame.vertices.values())


def test_frame_has_new_values_and_keeps_others(pending: PendingState) -> None:
    pending.set_pose("blue", (1.0, 2.0, 3.0), TURNED)
    frame = pending.make_frame(7, 0.5, anew=True)
    assert (frame.capture_ns, frame.time_s, frame.anew) == (7, 0.5, True)
    assert frame.poses[1].tolist() == pytest.approx([1.0, 2.0, 3.0, *TURNED])
    assert frame.poses[0].tolist() == [0.0, 0.0, 0.5, *UNIT]
    pending.set_pose("blue", (0.0, 0.0, 0.0), UNIT)
    pending.set_vertices("cloth", CLOTH + 1.0)
    assert frame.poses[1, 0] == 1.0, "a frame that was taken does not change any more"
    assert (frame.vertices["cloth"] == CLOTH).all()
    assert (pending.make_frame(8, 1.0, anew=False).vertices["cloth"] == CLOTH + 1.0).all()


def test_joints_and_the_root_place_the_bodies_of_an_articulation(pending: PendingState) -> None:
    pending.set_joints("arm", {"turn": math.pi / 2})
    assert pose(pending, "arm/fore") == pytest.approx([0.0, 1.0, 0.8, *TURNED])
    pending.set_joints("arm", {"slide": 0.25})
    assert pose(pending, "arm/fore")[:3] == pytest.approx([0.0, 1.25, 0.8]), "the other joint stays"
    pending.set_pose("arm", (10.0, 0.0, 0.0), TURNED)
    assert pose(pending, "arm/base") == pytest.approx([10.0, 0.0, 0.0, *TURNED])
    assert pose(pending, "arm/fore")[:3] == pytest.approx([8.75, 0.0, 0.0])


def test_joints_beyond_their_limits_are_shown_and_warned_about(pending: PendingState) -> None:
    """Encoders exceed the limits of the description slightly; degrees exceed them far."""
    pending.set_joints("arm", {"turn": math.pi + 0.05, "slide": -0.01})
    assert pending.warnings() == ()
    assert pose(pending, "arm/upper")[3:] == pytest.approx([math.cos((math.pi + 0.05) / 2), 0, 0, 0.9997], abs=1e-4)
    pending.set_joints("arm", {"turn": 90.0, "slide": 0.6})
    assert pending.warnings() == (
        "joint 'turn' of 'arm' is set to 90 rad, far beyond its limits, -3.142 to 3.142 rad",
        "joint 'slide' of 'arm' is set to 0.6 m, far beyond its limits, 0 to 0.5 m",
    )
    pending.set_joints("arm", {"slide": 0.5})
    assert len(pending.warnings()) == 1, "of those that are there now"


def on_a_floating_base() -> PendingState:
    """An arm whose upper arm has a floating joint."""
    scene = composed()
    robot = scene.articulations["arm"]
    base, _, fore = robot.parts
    parts = (base, ArticulatedBody("arm/upper", 0, Pose((0.0, 0.0, 0.2), UNIT)), fore)
    floating = replace(robot, parts=parts, loose={"fly": "arm/upper"})
    return PendingState(replace(scene, articulations={"arm": floating}))


@pytest.mark.parametrize("many", [False, True])
def test_body_on_a_floating_joint_keeps_its_pose(many: bool) -> None:
    pending = on_a_floating_base()
    pending.set_joints("arm", {"slide": 0.25})
    assert pose(pending, "arm/fore")[:3] == pytest.approx([1.25, 0.0, 1.0]), "at first it goes with the rest"
    if many:
        pending.set_poses(["red", "arm/upper"], [(1.0, 2.0, 3.0), (0.0, 0.0, 5.0)], [UNIT, TURNED])
    else:
        pending.set_pose("arm/upper", (0.0, 0.0, 5.0), TURNED)
    assert pose(pending, "arm/upper") == pytest.approx([0.0, 0.0, 5.0, *TURNED])
    assert pose(pending, "arm/fore")[:3] == pytest.approx([0.0, 1.25, 5.0]), "what is on it goes with it"
    pending.set_joints("arm", {"slide": 0.5})
    pending.set_pose("arm", (7.0, 0.0, 0.0), UNIT)
    assert pose(pending, "arm/base")[:3] == [7.0, 0.0, 0.0]
    assert pose(pending, "arm/upper") == pytest.approx([0.0, 0.0, 5.0, *TURNED])
    assert pose(pending, "arm/fore")[:3] == pytest.approx([0.0, 1.5, 5.0])


NAN = float("nan")


@pytest.mark.parametrize(
    ("wrong", "value"),
    [
        (lambda d: d.set_pose("redd", (0, 0, 0), UNIT), "nearest: 'red'"),
        (lambda d: d.set_pose("cloth", (0, 0, 0), UNIT), "set_vertices"),
        (lambda d: d.set_pose("red", (0, NAN, 0), UNIT), "3 finite numbers"),
        (lambda d: d.set_vertices("cloth", CLOTH.astype(str)), "numbers"),
        (lambda d: d.set_pose("red", (0, 0, 2e6), UNIT), "in metres"),
        (lambda d: d.set_pose("red", (0, 0, 0), (0, 0, 0, 0)), "length 0"),
        (lambda d: d.set_pose("red", (0, 0, 0), (1.002, 0, 0, 0)), "length 1"),
        (lambda d: d.set_pose("red", (0, 0, 10**400), UNIT), "3 numbers"),
        (lambda d: d.set_poses(["red", "blu"], [(1, 1, 1)] * 2, [UNIT] * 2), "nearest: 'blue'"),
        (lambda d: d.set_poses(["red", "arm"], [(1, 1, 1)] * 2, [UNIT] * 2), "set_pose"),
        (lambda d: d.set_poses(["red", "blue"], [(1, 1, 1)] * 2, [UNIT, (1.1, 0, 0, 0)]), "of 'blue' has length 1.1"),
        (lambda d: d.set_poses(["red", "blue", "red"], [(1, 1, 1)] * 3, [UNIT] * 3), "'red'"),
        (lambda d: d.set_poses("red", [(1, 1, 1)] * 3, [UNIT] * 3), "'red'"),
        (lambda d: d.set_poses(["red"], [(1, NAN, 1)], [UNIT]), "not finite"),
        (lambda d: d.set_poses(["red"], [(1, 1)], [UNIT]), r"\(1, 2\)"),
        (lambda d: d.set_joints("armm", {}), "nearest: 'arm'"),
        (lambda d: d.set_joints("arm", {"turn": 1.0, "twist": 1.0}), "turn, slide"),
        (lambda d: d.set_joints("arm", {"follower": 1.0}), "'turn'"),
        (lambda d: d.set_joints("arm", {"turn": NAN}), "finite"),
        (lambda d: d.set_joints("arm", {"turn": "1.0"}), "turn"),
        (lambda d: d.set_joints("arm", {"turn": 1e300}), "radians"),
        (lambda d: d.set_vertices("clot", CLOTH), "nearest: 'cloth'"),
        (lambda d: d.set_vertices("cloth", CLOTH[:3]), r"\(3, 3\)"),
        (lambda d: d.set_vertices("cloth", CLOTH * NAN), "not finite"),
        (lambda d: d.set_vertices("cloth", CLOTH * 1e9), "metres"),
    ],
)  # fmt: skip
def test_invalid_values_raise_and_change_nothing(
    pending: PendingState, wrong: Callable[[PendingState], None], value: str
) -> None:
    before = everything(pending)
    with pytest.raises(PublishError, match=value):
        wrong(pending)
    assert everything(pending) == before
    pending.set_pose("arm", (0.0, 0.0, 0.8), UNIT)  # nor does it come back later
    assert pose(pending, "arm/fore") == pytest.approx([1.0, 0.0, 0.8, *UNIT])
