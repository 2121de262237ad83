"""Operations of a patch as somebody gives them: what cannot be one is said on one line, what can is plain values."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.scene import MAX_OPS, AddVisual, Geometry, RemoveVisual, SceneError, SetVisual, Visual
from iris_session.session.scene_change import check_patch

NAN = float("nan")


def ball(kind: str = "sphere", **changes: Any) -> Visual:
    fields = {"T_body_visual": IDENTITY, "rgba": (1.0, 0.0, 0.0, 1.0)} | changes
    return Visual(id=9, body=0, name="ball", group=0, geometry=Geometry(kind, (0.1, 0.1, 0.1)), material=-1, **fields)


def test_what_is_computed_becomes_what_is_sent() -> None:
    quaternion = np.array([1.0, 0.0, 0.0, 0.0])
    given: list[Any] = [
        SetVisual(np.int64(3), rgba=np.array([1, 0, 0, 1])),
        SetVisual(4, rgba=[0, 0, np.float32(0.5), 1], T_body_visual=Pose(np.zeros(3), quaternion)),
        AddVisual(ball()),
        RemoveVisual(5),
    ]
    assert check_patch(given) == (
        SetVisual(3, rgba=(1.0, 0.0, 0.0, 1.0)),
        SetVisual(4, rgba=(0.0, 0.0, 0.5, 1.0), T_body_visual=IDENTITY),
        AddVisual(ball()),
        RemoveVisual(5),
    )
    assert len(check_patch([RemoveVisual(i) for i in range(MAX_OPS)])) == MAX_OPS


@pytest.mark.parametrize(
    ("ops", "says"),
    [
        ([], "nothing to change: give operations, SetVisual"),
        ([[SetVisual(0)]], r"operations in a list: .* patch_scene\(\*operations\)"),
        ([()], "operations in a tuple"),
        (["red"], "operation 1 is 'red': SetVisual"),
        ([SetVisual(0), None], "operation 2 is None: SetVisual"),
        ([SetVisual], "operation 1 is <class"),
        ([[0] * 1000, SetVisual(0)], "operation 1 is "),
        ([SetVisual(0)] * (MAX_OPS + 1), f"65 operations at once, at most {MAX_OPS}: .*further calls"),
        ([SetVisual("box")], "operation 1, SetVisual: Expected `int`"),
        ([SetVisual(ball())], "operation 1, SetVisual: Expected `int`"),
        ([SetVisual(0), SetVisual(0, rgba="red")], r"operation 2, SetVisual: .*rgba"),
        ([SetVisual(0, rgba={1.0, 0.0})], r"operation 1, SetVisual: .*rgba"),
        ([SetVisual(0, rgba=(1.0, 0.0, NAN, 1.0))], r"SetVisual: numbers of rgba\[2\] must be finite"),
        ([AddVisual(ball("teapot"))], "a geometry of kind 'teapot': there are box, capsule, .*, sphere"),
        ([AddVisual(ball("x" * 64))], "there are box"),
        ([AddVisual(ball(T_body_visual=Pose((0.0, NAN, 0.0), IDENTITY.q)))], "AddVisual: numbers of .*finite"),
        ([SetVisual(0, rgba=(255, 0, 0, 255))], "each from 0 to 1"),
        ([AddVisual(ball(rgba=(1.0, 0.0, 0.0, 2.0)))], "each from 0 to 1"),
        ([SetVisual(0, T_body_visual=Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)))], "quaternion has length 0"),
        ([AddVisual(ball(T_body_visual=Pose((0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0))))], "quaternion has length 2"),
        ([SetVisual(10**400)], "operation 1, SetVisual"),
        ([SetVisual(0, group=object())], "object where a number"),
    ],
)  # fmt: skip
def test_what_is_none_is_said_on_one_line(ops: list[Any], says: str) -> None:
    with pytest.raises(SceneError, match=says) as caught:
        check_patch(ops)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200
