"""Real robot models (`IRIS_DATA`, else `shared` beside the repository) and small MJCFs for the physics tests."""

from __future__ import annotations

import os
from pathlib import Path

import mujoco
import pytest

from iris_session.demo.scenes import scene_path
from iris_session.physics import load_model

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder with the test data; its absence is a failure, not a skip."""
    folder = Path(os.environ.get("IRIS_DATA") or REPOSITORY.parent / "shared").resolve()
    if not (folder / "models").is_dir():
        pytest.fail(f"test data missing: {folder} has no models folder; set IRIS_DATA")
    return folder


@pytest.fixture(scope="session")
def aloha(data_dir: Path) -> mujoco.MjModel:
    return load_model(data_dir / "models/aloha/scene.xml")


@pytest.fixture(scope="session")
def iiwa(data_dir: Path) -> mujoco.MjModel:
    return load_model(data_dir / "models/kuka_iiwa_14/scene.xml")


@pytest.fixture(scope="session")
def handover() -> mujoco.MjModel:
    return load_model(scene_path("handover"))


@pytest.fixture(autouse=True)
def _redirect_mujoco_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo writes MUJOCO_LOG.TXT into the current folder when it warns."""
    monkeypatch.chdir(tmp_path)
