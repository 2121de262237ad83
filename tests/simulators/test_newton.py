"""The adapter for Newton, over stand-ins for its solver and model: no Newton takes part."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from iris_session.simulators.newton import NewtonAdapter


def make_adapter(parents: list[int], children: list[int]) -> Any:
    adapter: Any = object.__new__(NewtonAdapter)
    adapter._newton = SimpleNamespace(JointType=SimpleNamespace(REVOLUTE=1, PRISMATIC=0))
    adapter._model = SimpleNamespace(
        joint_parent=np.array(parents),
        joint_child=np.array(children),
        joint_type=np.ones(len(parents), int),
        joint_count=len(parents),
        device=SimpleNamespace(is_capturing=False),
    )
    adapter._solver = SimpleNamespace(step=lambda state_in, state_out, control, contacts, dt: None)
    adapter._time_s = 0.0
    return adapter


def test_joints_that_close_a_loop_end_a_tree() -> None:
    names = {0: "arm/a", 1: "arm/b", 2: "arm/c", 3: "arm/d"}
    for extra in (0, 1, 2):  # to the base, to a link between, to the parent
        adapter = make_adapter([-1, 0, 1, 2, 3], [0, 1, 2, 3, extra])
        (robot,) = adapter._find_robots(names)
        assert (robot.base_body, robot.tip_body) == ("arm/a", "arm/d")
    twice = make_adapter([-1, 0, 1, 2, -1], [0, 1, 2, 3, 0])
    assert [robot.name for robot in twice._find_robots(names)] == ["arm"]


def test_nothing_is_read_while_a_graph_is_captured() -> None:
    adapter = make_adapter([-1], [0])
    adapter.notes = ("a shape is not shown",)
    calls: list[str] = []
    end = adapter.wrap_step(lambda: None, lambda: calls.append("read"))
    adapter._model.device.is_capturing = True
    for _ in range(2):
        adapter._solver.step("in", "out", None, None, 0.01)
    assert not calls
    assert adapter._state == "out", "what sync() reads after the launch"
    assert [note for note in adapter.notes if "sync()" in note] == [adapter.notes[1]]
    adapter._model.device.is_capturing = False
    adapter._solver.step("in", "out", None, None, 0.01)
    assert calls == ["read"]
    assert adapter._time_s == 0.01
    end()
