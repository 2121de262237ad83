"""Files that would cost more than memory holds, and content that cannot be sent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from iris_session.scene import AssetStore, SceneBuildError
from iris_session.scene.builder import SceneBuilder
from iris_session.scene.importers.files import load_file
from tests.scene.documents import Document
from tests.scene.importers.test_files import write_obj

PIXELS = np.random.default_rng(3).integers(0, 255, (8, 16, 3), dtype=np.uint8)


def test_many_large_images_are_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("iris_session.scene.images.MAX_FILE_PIXELS", 3 * 8 * 16)
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
    with pytest.raises(SceneBuildError, match="more than 384 pixels"):
        SceneBuilder().add_file(document.write(tmp_path / "b.glb"))


def test_large_picture_is_rejected_in_every_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_obj(tmp_path)
    monkeypatch.setattr("iris_session.scene.images.MAX_PIXELS", 4 * 8 - 1)
    with pytest.raises(SceneBuildError, match=r"parts\.obj has 8 x 4 .*31"):
        SceneBuilder().add_file(path)
    with pytest.raises(SceneBuildError, match="has 8 x 4 pixels"):
        SceneBuilder().add_box(half_size=(1, 1, 1), texture=tmp_path / "picture.png")


def test_pictures_of_all_files_count_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where many materials name one picture: an OBJ file opens it for each."""
    path = write_obj(tmp_path)
    material = "newmtl {}\nKd 1 1 1\nmap_Kd picture.png\n"
    (tmp_path / "parts.mtl").write_text(material.format("red") + material.format("painted"))
    load_file(path)
    monkeypatch.setattr("iris_session.scene.images.MAX_FILE_PIXELS", 2 * 4 * 8 - 1)
    with pytest.raises(SceneBuildError, match=r"parts\.obj .* 63 pixels"):
        load_file(path)


def test_accessors_without_bytes_are_bounded(tmp_path: Path) -> None:
    """As doubles they would be eight times as large."""
    document = Document()
    document.square()
    document.json["accessors"].append({"componentType": 5121, "count": 100_000_000, "type": "VEC4", "normalized": True})
    document.json["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = len(document.json["accessors"]) - 1
    with pytest.raises(SceneBuildError, match="100000000 entries"):
        SceneBuilder().add_file(document.write(tmp_path / "a.glb"))


def test_copies_in_many_scales_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("iris_session.scene.build.MAX_TRIANGLES", 10)
    for alike in (True, False):
        document = Document()
        document.square()
        document.json["nodes"] = [{"mesh": 0, "scale": [1, 1, 2 if alike else 2 + k]} for k in range(8)]
        scene, store = SceneBuilder(), AssetStore(tmp_path / "store")
        scene.add_file(document.write(tmp_path / "a.glb"))
        if alike:
            assert len(scene.build(store).spec.meshes) == 1
            continue
        with pytest.raises(SceneBuildError, match="over 10 triangles"):
            scene.build(store)


def test_file_is_added_completely_or_not_at_all(tmp_path: Path) -> None:
    document = Document()
    document.square()
    far = {"mesh": 0, "scale": [1e200, 1e200, 1e200]}
    document.json["nodes"] = [{"mesh": 0}, {**far, "children": [2]}, far]
    path, scene = document.write(tmp_path / "a.glb"), SceneBuilder()
    before = scene.build(AssetStore(tmp_path / "store")).scene_hash
    with pytest.raises(SceneBuildError, match="not finite"):
        scene.add_file(path, name="part", movable=True)
    assert scene.build(AssetStore(tmp_path / "store")).scene_hash == before
    assert scene.add_box("part", half_size=(1, 1, 1), movable=True) == "part", "the name is free"


def test_pictures_that_need_external_programs_are_rejected(tmp_path: Path) -> None:
    """Pillow passes PostScript to Ghostscript, by content and not by file name."""
    path = write_obj(tmp_path)
    picture = tmp_path / "picture.png"
    Image.fromarray(PIXELS).save(tmp_path / "a.eps")
    picture.write_bytes((tmp_path / "a.eps").read_bytes())
    with pytest.raises(SceneBuildError, match="EPS; PNG, JPEG"):
        load_file(path)
    with pytest.raises(SceneBuildError, match="no image"):
        SceneBuilder().add_box(half_size=(1, 1, 1), texture=picture)


def test_limits_apply_to_the_whole_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document = Document()
    for _ in range(3):
        document.square()
    path = document.write(tmp_path / "a.glb")
    monkeypatch.setattr("iris_session.scene.importers.gltf.MAX_TRIANGLES", 5)
    with pytest.raises(SceneBuildError, match="more than 5 triangles"):
        load_file(path)
