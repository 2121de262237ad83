"""Files that would cost everybody the scene: more than memory holds, and what cannot be sent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from iris_session.scene import AssetStore, SceneBuildError
from iris_session.scene.compose import SceneBuilder
from tests.scene.documents import Document
from tests.scene.test_files import write_obj

PIXELS = np.random.default_rng(3).integers(0, 255, (8, 16, 3), dtype=np.uint8)


def test_many_large_images_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("iris_session.scene.pictures.MAX_FILE_PIXELS", 3 * 8 * 16)
    document = Document()
    for _ in range(4):
        texture = document.image(PIXELS)
        document.json.setdefault("materials", []).append(
            {"pbrMetallicRoughness": {"baseColorTexture": {"index": texture}}}
        )
    for material in range(3):
        document.square(material)
    SceneBuilder().add_file(document.write(tmp_path / "a.glb"))
    document.square(3)
    with pytest.raises(SceneBuildError, match="more than 384 pixels together"):
        SceneBuilder().add_file(document.write(tmp_path / "b.glb"))


def test_a_large_picture_is_refused_whoever_opens_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_obj(tmp_path)
    monkeypatch.setattr("iris_session.scene.pictures.MAX_PIXELS", 4 * 8 - 1)
    with pytest.raises(SceneBuildError, match=r"a picture of parts\.obj has 8 x 4 pixels, at most 31"):
        SceneBuilder().add_file(path)
    with pytest.raises(SceneBuildError, match="has 8 x 4 pixels"):
        SceneBuilder().add_box(half_size=(1, 1, 1), texture=tmp_path / "picture.png")


def test_names_that_cannot_be_sent_are_changed(tmp_path: Path) -> None:
    """JSON may hold half of a character."""
    document = Document()
    document.square()
    document.json["nodes"] = [{"mesh": 0, "name": "half \ud800"}, {"mesh": 0, "name": "table"}]
    scene = SceneBuilder()
    scene.add_file(document.write(tmp_path / "a.glb"))
    names = [body.name for body in scene.build(AssetStore(tmp_path / "store")).spec.bodies]
    assert names[-2:] == ["half ?", "table"]
