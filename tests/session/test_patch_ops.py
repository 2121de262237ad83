"""Operations of a patch as users give them: conversion to plain values, and errors of one line."""

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


def test_operations_are_converted_to_plain_values() -> None:
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
    ("ops", "value"),
    [
        ([], "SetVisual"),
        ([[SetVisual(0)]], "list"),
        (["red"], "operation 1 is 'red': SetVisual"),
        ([SetVisual(0), None], "operation 2 is None: SetVisual"),
        ([SetVisual(0)] * (MAX_OPS + 1), f"{MAX_OPS + 1} .*{MAX_OPS}"),
        ([SetVisual("box")], "operation 1, SetVisual"),
        ([SetVisual(0), SetVisual(0, rgba="red")], r"operation 2, SetVisual: .*rgba"),
        ([SetVisual(0, rgba=(1.0, 0.0, NAN, 1.0))], r"SetVisual: .*rgba\[2\]"),
        ([AddVisual(ball("teapot"))], "'teapot'.*sphere"),
        ([AddVisual(ball(T_body_visual=Pose((0.0, NAN, 0.0), IDENTITY.q)))], "AddVisual"),
        ([SetVisual(0, rgba=(255, 0, 0, 255))], "0 to 1"),
        ([SetVisual(0, T_body_visual=Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)))], "length 0"),
        ([AddVisual(ball(T_body_visual=Pose((0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0))))], "length 2"),
        ([SetVisual(10**400)], "operation 1, SetVisual"),
    ],
)  # fmt: skip
def test_invalid_operations_are_named_on_one_line(ops: list[Any], value: str) -> None:
    with pytest.raises(SceneError, match=value) as caught:
        check_patch(ops)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200
