"""Small DAE and 3MF files that would fill memory or expose other files: rejected before a library follows them."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
import trimesh

from iris_session.scene import SceneBuildError
from iris_session.scene.importers import xml_files
from iris_session.scene.importers.files import load_file

NAMESPACE = 'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"'
PRODUCTION = 'xmlns:p="http://schemas.microsoft.com/3dmanufacturing/production/2015/06"'
MESH = (
    '<mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/><vertex x="0" y="1" z="0"/></vertices>'
    '<triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh>'
)


def dae(nodes: str, scene: str) -> str:
    """Return a file with geometry `g` of one triangle; `nodes` go into the library."""
    return (
        '<?xml version="1.0" encoding="utf-8"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" '
        'version="1.4.1"><asset><up_axis>Z_UP</up_axis></asset><library_geometries><geometry id="g"><mesh>'
        '<source id="p"><float_array id="a" count="9">0 0 0 1 0 0 0 1 0</float_array><technique_common>'
        '<accessor source="#a" count="3" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>'
        '<param name="Z" type="float"/></accessor></technique_common></source><vertices id="v"><input '
        'semantic="POSITION" source="#p"/></vertices><triangles count="1"><input semantic="VERTEX" source="#v" '
        'offset="0"/><p>0 1 2</p></triangles></mesh></geometry></library_geometries>'
        f'<library_nodes>{nodes}</library_nodes><library_visual_scenes><visual_scene id="s">{scene}</visual_scene>'
        '</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


def doubling(levels: int) -> str:
    """Return nodes of which each has the next one twice, the last one the geometry."""
    nodes = [
        f'<node id="n{k}"><instance_node url="#n{k + 1}"/><instance_node url="#n{k + 1}"/></node>'
        for k in reversed(range(levels))
    ]
    return f'<node id="n{levels}"><instance_geometry url="#g"/></node>{"".join(nodes)}'


def archive(path: Path, objects: str, build: str, part: str = "") -> Path:
    """`part`: objects of another file in it, `3D/part.model`."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        head = f'<?xml version="1.0"?><model unit="meter" {NAMESPACE} {PRODUCTION}><resources>'
        file.writestr("3D/3dmodel.model", f"{head}{objects}</resources><build>{build}</build></model>")
        if part:
            file.writestr("3D/part.model", f"{head}{part}</resources><build/></model>")
    return path


def components(*ids: int) -> str:
    return "<components>" + "".join(f'<component objectid="{k}"/>' for k in ids) + "</components>"


@pytest.mark.parametrize("spelled", ["utf-8", "UTF-8", "utf8"])  # the last one by Python's own writer
def test_every_spelling_of_utf_8_is_read(tmp_path: Path, spelled: str) -> None:
    text = dae("", '<node><instance_geometry url="#g"/></node>').replace('"utf-8"', f'"{spelled}"')
    (tmp_path / "a.dae").write_text(text)
    assert len(load_file(tmp_path / "a.dae").nodes) == 1


def test_few_instances_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.dae").write_text(dae(doubling(3), '<node id="top"><instance_node url="#n0"/></node>'))
    assert len(load_file(tmp_path / "a.dae").nodes) == 8
    objects = f'<object id="1">{MESH}</object><object id="2">{components(1, 1)}</object>'
    path = archive(tmp_path / "a.3mf", objects, '<item objectid="2"/><item objectid="1"/>')
    assert sum(len(node.surfaces) for node in load_file(path).nodes) == 3


def test_exponential_nesting_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "a.dae").write_text(dae(doubling(40), '<node id="top"><instance_node url="#n0"/></node>'))
    with pytest.raises(SceneBuildError, match=r"that it draws"):
        load_file(tmp_path / "a.dae")
    objects = f'<object id="0">{MESH}</object>' + "".join(
        f'<object id="{k}">{components(k - 1, k - 1)}</object>' for k in range(1, 40)
    )
    with pytest.raises(SceneBuildError, match="41 levels, at most 100,000 in 64"):
        load_file(archive(tmp_path / "a.3mf", objects, '<item objectid="39"/>'))


def test_long_chain_is_rejected(tmp_path: Path) -> None:
    objects = f'<object id="0">{MESH}</object>' + "".join(
        f'<object id="{k}">{components(k - 1)}</object>' for k in range(1, 100)
    )
    with pytest.raises(SceneBuildError, match="in 101 levels"):
        load_file(archive(tmp_path / "a.3mf", objects, '<item objectid="99"/>'))


def test_cyclic_nesting_is_rejected(tmp_path: Path) -> None:
    node = '<node id="n"><instance_geometry url="#g"/><instance_node url="#n"/></node>'
    (tmp_path / "a.dae").write_text(dae("", node))
    with pytest.raises(SceneBuildError, match="instance of itself"):
        load_file(tmp_path / "a.dae")
    objects = f'<object id="1">{components(2)}</object><object id="2">{components(1)}</object>'
    with pytest.raises(SceneBuildError, match="instance of itself"):
        load_file(archive(tmp_path / "a.3mf", objects, '<item objectid="1"/>'))


def test_copies_of_a_large_geometry_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """trimesh copies a geometry for every instance in a DAE."""
    monkeypatch.setattr("iris_session.scene.importers.xml_files.MAX_TRIANGLES", 30)
    trimesh.creation.box().export(tmp_path / "box.dae")
    text = (tmp_path / "box.dae").read_text()
    load_file(tmp_path / "box.dae")
    begin, end = text.index("<instance_geometry"), text.index("</instance_geometry>") + len("</instance_geometry>")
    (tmp_path / "boxes.dae").write_text(text[:end] + text[begin:end] * 20 + text[end:])
    with pytest.raises(SceneBuildError, match="triangles"):
        load_file(tmp_path / "boxes.dae")


def test_entities_are_rejected_in_an_archive_too(tmp_path: Path) -> None:
    path = tmp_path / "a.3mf"
    for model, text in (
        (b"<!DOCTYPE model [<!ENTITY a 'b'>]><model/>", "DOCTYPE"),
        ("<!DOCTYPE model [<!ENTITY a 'b'>]><model/>".encode("utf-16"), "no XML in UTF-8"),
    ):
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("3D/3dmodel.model", model)
        with pytest.raises(SceneBuildError, match=text):
            load_file(path)


@pytest.mark.parametrize("file_name", ["3D/3dmodel.model.bak", "x/3D/3dmodel.modelX", "3D/part.txt"])
def test_every_file_that_is_read_of_a_3mf_is_checked(tmp_path: Path, file_name: str) -> None:
    """The reader takes the first file with `3d/3dmodel.model` in its name, and what this refers to by any name."""
    bad = b"<!DOCTYPE model [<!ENTITY a 'b'>]><model/>"
    path = tmp_path / "a.3mf"
    with zipfile.ZipFile(path, "w") as file:
        if "3dmodel" not in file_name:
            refers = f'<component p:path="/{file_name}" objectid="10"/>'
            file.writestr(
                "3D/3dmodel.model",
                f'<model {NAMESPACE} {PRODUCTION}><resources><object id="1"><components>{refers}</components></object>'
                '</resources><build><item objectid="1"/></build></model>',
            )
        file.writestr(file_name, bad)
    with pytest.raises(SceneBuildError, match="DOCTYPE"):
        load_file(path)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_files_of_one_name_in_a_3mf_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.3mf"
    with zipfile.ZipFile(path, "w") as file:
        for text in ("<model/>", "<model><build/></model>"):
            file.writestr("3D/3dmodel.model", text)
    with pytest.raises(SceneBuildError, match="two files of one name"):
        load_file(path)


@pytest.mark.parametrize(("times", "least", "text"), [(400, 1, "its other files so often that"), (20, 0, "")])
def test_several_files_of_a_3mf_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, times: int, least: int, text: str
) -> None:
    """All meshes of a file are read at every reference: a million references are small in the archive."""
    monkeypatch.setattr(xml_files, "MAX_TRIANGLES", 3_000)
    part = "".join(f'<object id="{k}">{MESH}</object>' for k in range(10, 20))
    refers = '<component p:path="/3D/part.model" objectid="10"/>' * times
    path = archive(
        tmp_path / "a.3mf", f'<object id="1"><components>{refers}</components></object>', '<item objectid="1"/>', part
    )
    if least:
        with pytest.raises(SceneBuildError, match=f"{text} 4,000 triangles are read"):
            load_file(path)
    else:
        assert load_file(path).nodes


def test_parts_in_other_files_of_a_3mf_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(xml_files, "MAX_NODES", 30)
    refers = '<component p:path="/3D/part.model" objectid="10"/>' * 40
    objects = f'<object id="1"><components>{refers}</components></object>'
    path = archive(tmp_path / "a.3mf", objects, '<item objectid="1"/>', f'<object id="10">{MESH}</object>')
    with pytest.raises(SceneBuildError, match=r"draws 4\d parts"):
        load_file(path)


def test_library_nodes_are_counted_at_their_instances(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    node = '<node id="n"><instance_geometry url="#g"/></node>'
    (tmp_path / "a.dae").write_text(dae(node, '<node id="top"><instance_node url="#n"/></node>'))
    monkeypatch.setattr(xml_files, "MAX_TRIANGLES", 3)  # one triangle, one character above its minimum
    assert len(load_file(tmp_path / "a.dae").nodes) == 1
    (tmp_path / "b.dae").write_text(dae(node, '<node id="top"><instance_node url="#n"/></node>' * 2))
    with pytest.raises(SceneBuildError, match="draws 4 triangles"):
        load_file(tmp_path / "b.dae")


def test_broken_dae_is_rejected_without_library_text(tmp_path: Path) -> None:
    """No class names, no missing attributes of `None`."""
    text = dae("", '<node><instance_geometry url="#g"/></node>')
    path = tmp_path / "a.dae"
    for before, after, reason in (
        (text[200:], "", "a.dae is cut: it ends in line 1, without </COLLADA>"),
        ("</mesh>", "</mess>", r"a.dae, line 1: this is no XML \(Opening and ending tag mismatch"),
        ('source="#p"', 'source="#q"', "is damaged, or no DAE: something in it is missing or of another kind"),
        ('<scene><instance_visual_scene url="#s"/></scene>', "", "something in it is missing"),
    ):
        assert before in text
        path.write_text(text.replace(before, after, 1))
        with pytest.raises(SceneBuildError, match=reason) as raised:
            load_file(path)
        assert not any(word in str(raised.value) for word in ("Error", "NoneType", "attribute '", "<string>", "\n"))
