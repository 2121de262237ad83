"""The adapter for Genesis, over stand-ins for a scene: no Genesis takes part."""

from __future__ import annotations

from typing import Any

import pytest

from iris_session.simulators import SimulatorError
from iris_session.simulators.genesis import GenesisAdapter


class Scene:
    """A scene whose `reset` cannot be replaced."""

    def step(self) -> None: ...

    def reset(self) -> None: ...

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "reset":
            raise AttributeError(name)
        super().__setattr__(name, value)


def test_a_step_comes_back_when_the_reset_cannot_be_followed() -> None:
    adapter: Any = object.__new__(GenesisAdapter)
    adapter._scene = Scene()
    with pytest.raises(SimulatorError, match="reset"):
        adapter.wrap_step(lambda: None, lambda: None)
    assert "step" not in vars(adapter._scene)
