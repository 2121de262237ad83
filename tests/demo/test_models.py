"""Models of real robots are found in `IRIS_DATA`, else by mujoco-menagerie, else in a package of files."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from iris_session.demo.scenes.models import find_model_file
from iris_session.physics import ModelNotFoundError
from tests.models import ALOHA


class Menagerie(SimpleNamespace):
    """The part of mujoco-menagerie that is used; without a folder, every download fails."""

    def __init__(self, folder: Path | None = None) -> None:
        super().__init__(MenagerieError=LookupError)
        self.folder = folder
        self.__spec__ = self

    def get(self, robot: str) -> SimpleNamespace:
        return SimpleNamespace(path=lambda: self.fetch(robot))

    def fetch(self, robot: str) -> Path:
        if self.folder is None:
            raise self.MenagerieError("no connection")
        return self.folder / robot


@pytest.fixture
def no_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither package is installed."""
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    monkeypatch.setattr("iris_session.demo.scenes.models.WHEEL", "envpool-assets-that-are-not-there")


def write_model(folder: Path) -> Path:
    path = folder / "aloha" / "scene.xml"
    path.parent.mkdir(parents=True)
    path.write_text("<mujoco/>")
    return path


def test_packages_have_the_robots_of_the_demos() -> None:
    assert find_model_file("aloha", "scene.xml") == ALOHA
    assert find_model_file("franka_emika_panda", "panda.xml").is_file()


@pytest.mark.usefixtures("no_source")
def test_first_source_that_has_the_file_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    downloaded = write_model(tmp_path / "downloads")
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", Menagerie(downloaded.parents[1]))
    assert find_model_file("aloha", "scene.xml") == downloaded
    own = write_model(tmp_path / "models")
    monkeypatch.setenv("IRIS_DATA", str(tmp_path))
    assert find_model_file("aloha", "scene.xml") == own


@pytest.mark.usefixtures("no_source")
def test_error_names_what_would_help(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ModelNotFoundError, match=r"aloha.*mujoco-menagerie.*IRIS_DATA.*models/aloha/scene\.xml"):
        find_model_file("aloha", "scene.xml")
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", Menagerie())
    with pytest.raises(ModelNotFoundError, match=r"no connection\): it is downloaded on first use(?!.*pip install)"):
        find_model_file("aloha", "scene.xml")
