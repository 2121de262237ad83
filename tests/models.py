"""Models of real robots that some tests need: in the folder `IRIS_DATA`, else beside the checkout."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

BESIDE = Path(__file__).parents[2] / "shared"


@pytest.fixture
def robot_models(monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of models, visible to child processes too. Its absence is a failure, not a skip."""
    folder = Path(os.environ.get("IRIS_DATA") or BESIDE)
    for name in ("aloha/scene.xml", "kuka_iiwa_14/iiwa14.xml"):
        if not (folder / "models" / name).is_file():
            pytest.fail(f"models/{name} is not in {folder}: set IRIS_DATA to the folder with the test data")
    monkeypatch.setenv("IRIS_DATA", str(folder.resolve()))
    return folder
