"""Configurations that cannot work are refused with what would be right."""

from __future__ import annotations

import math

import pytest

from iris_session.control import ControlConfig


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"output": "torque"}, "output is 'torque'; it must be 'ctrl' or 'targets'"),
        ({"joint_velocity": 0.0}, "joint_velocity is 0.0; it must be finite and positive"),
        ({"tip_speed": math.nan}, "tip_speed is nan"),
        ({"solve_rate_hz": 200.0}, "at most 100 Hz"),
        ({"max_solves_per_tick": 4}, "1 to 3"),
        ({"max_scale": 0.01}, "at least min_scale"),
        ({"proximity_stop": 0.2}, "proximity_stop is 0.2"),
        ({"workspace": ((0.0, 0.0, 0.0), (1.0, -1.0, 1.0))}, "'workspace'"),
        ({"workspaces": {"left": ((0.0, 0.0, 2.0), (1.0, 1.0, 1.0))}}, "'left'"),
        ({"velocity_limits": {"j": -1.0}}, "limit of joint 'j' is -1.0"),
        ({"acceleration_limits": {"j": math.inf}}, "limit of joint 'j' is inf"),
    ],
)
def test_impossible_values_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError) as refused:
        ControlConfig(**change)  # type: ignore[arg-type]
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_defaults_and_switched_off_proximity_are_fine() -> None:
    assert ControlConfig().output == "ctrl"
    assert ControlConfig(proximity_margin=0.0, workspace=((-1.0, -1.0, 0.0), (1.0, 1.0, 2.0))).proximity_margin == 0.0
