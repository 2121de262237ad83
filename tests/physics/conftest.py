"""Real robot models for the physics tests."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from iris_session.demo.scenes import scene_path
from iris_session.physics import load_model
from tests.models import ALOHA, PANDA


@pytest.fixture(scope="session")
def aloha() -> mujoco.MjModel:
    return load_model(ALOHA)


@pytest.fixture(scope="session")
def panda() -> mujoco.MjModel:
    return load_model(PANDA)


@pytest.fixture(scope="session")
def handover() -> mujoco.MjModel:
    return load_model(scene_path("handover"))


@pytest.fixture(autouse=True)
def _redirect_mujoco_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo writes MUJOCO_LOG.TXT into the current folder when it warns."""
    monkeypatch.chdir(tmp_path)
