"""Looking for the adapter of an object, and the parts that all adapters share; no simulator is installed for them."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from iris_session.simulators import SimulatorError, find_adapter
from iris_session.simulators.adapter import Names, find_gripper
from iris_session.simulators.wrapping import wrap_method


def of_package(package: str, **values: Any) -> Any:
    """Return an object whose type says that it comes from a package."""
    return type("Thing", (), {"__module__": f"{package}.engine.thing", **values})()


def test_objects_of_other_packages_have_no_adapter_and_nothing_is_imported() -> None:
    before = set(sys.modules)
    for thing in (
        object(),
        3,
        None,
        "scene.xml",
        of_package("numpy"),
        of_package("genesisx"),
        SimpleNamespace(env=None),
    ):
        assert find_adapter(thing) is None
    assert not {"genesis", "sapien", "pybullet", "newton", "pxr"} & (set(sys.modules) - before)


def test_wrong_objects_of_a_simulator_are_refused_with_the_right_one() -> None:
    cases = [
        (of_package("genesis"), "gs.Scene"),
        (of_package("genesis", rigid_solver=None, is_built=False), r"scene\.build\(\)"),
        (of_package("sapien"), "sapien.Scene"),
        (SimpleNamespace(unwrapped=of_package("mani_skill")), "sapien.Scene"),
    ]
    for thing, right in cases:
        with pytest.raises(SimulatorError, match=right) as caught:
            find_adapter(thing)
        assert "\n" not in str(caught.value)


def test_a_stage_without_the_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(SimulatorError, match="pip install usd-core"):
        find_adapter("lab.USDA")


def test_a_module_is_told_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = ModuleType("pybullet")
    module.getConnectionInfo = lambda client: {"isConnected": 0}
    monkeypatch.setitem(sys.modules, "pybullet", module)
    with pytest.raises(SimulatorError, match="connect"):
        find_adapter(module)
    module.getConnectionInfo = lambda client: {"isConnected": client == 2}
    adapter: Any = find_adapter(module)
    assert adapter._client == 2


def test_names_are_unique_and_fit() -> None:
    names = Names()
    assert [names.add("box"), names.add("box"), names.add("world"), names.add("")] == [
        "box",
        "box_2",
        "world_2",
        "body",
    ]
    long = [names.add("x" * 100), names.add("x" * 100)]
    assert [len(name) for name in long] == [64, 64]
    assert long[0] != long[1]


def test_grippers_of_arms_and_what_is_no_arm() -> None:
    chain = [-1, 0, 1, 2, 3]
    assert find_gripper(chain, [False, True, True, True, False]) == (4, ()), "the flange, which is fixed"
    assert find_gripper([*chain, 4, 4, 4], [False, True, True, True, False, True, True, False]) == (4, (5, 6))
    assert find_gripper([-1, 0, 0, 1, 2], [False, True, True, True, True]) is None, "legs"
    assert find_gripper([-1, 0], [False, True]) is None, "a door"
    assert find_gripper([], []) is None


def test_a_wrapped_method_keeps_what_was_there() -> None:
    calls: list[Any] = []
    owner = SimpleNamespace(step=lambda n: calls.append(n) or n)  # type: ignore[func-returns-value]
    original = owner.step
    end = wrap_method(owner, "step", lambda n: calls.append("before"), lambda n: calls.append("after"))
    assert owner.step(3) == 3
    assert calls == ["before", 3, "after"]
    ours = owner.step

    def around(n: int) -> int:  # of another program
        return int(ours(n))

    owner.step = around
    end()
    assert owner.step(4) == 4
    assert calls[3:] == [4]
    end = wrap_method(owner2 := SimpleNamespace(step=original), "step", lambda n: None, lambda n: None)
    end()
    assert owner2.step is original
    with pytest.raises(SimulatorError, match="cannot be wrapped"):
        wrap_method(type("Fixed", (), {"__slots__": (), "step": lambda self: 0})(), "step", print, print)
