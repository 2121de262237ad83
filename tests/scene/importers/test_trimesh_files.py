"""Mesh files that are truncated or name missing vertices; DAE files that would fill memory or expose other files."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from iris_session.scene import SceneBuildError
from iris_session.scene.importers.files import load_file

TRIANGLE = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)
FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {}\nproperty list uchar int vertex_index\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
)
OFF = "OFF\n3 {} 0\n0 0 0\n1 0 0\n0 1 0\n"


def written(tmp_path: Path, name: str, content: str | bytes) -> Path:
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return tmp_path / name


def binary_stl(n_triangles: int, content: bytes, head: bytes = b"") -> bytes:
    return head.ljust(80, b"\0") + struct.pack("<I", n_triangles) + content


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("a.stl", binary_stl(10, 10 * TRIANGLE)[:-70], "584 bytes, and it has 514"),
        ("a.stl", binary_stl(10, 9 * TRIANGLE, b"solid by name only"), "says 10 triangles"),
        ("a.stl", binary_stl(1, b"")[:60], "no STL"),
        ("a.stl", f"solid x\n{3 * FACET}", "endsolid"),
        ("a.ply", PLY.format(2) + "3 0 1 2\n", "5 lines, and it has 4"),
        ("a.ply", PLY.format(2_000_000_000) + "3 0 1 2", "2,000,000,003 lines, and it has 4"),
        ("a.ply", PLY.format(1) + "3 0 1 7\n", "names vertex 7 of 3|names something that it does not have"),
        ("a.ply", PLY.format(1) + "3 0 1 -1\n", "names vertex -1 of 3"),
        ("a.off", OFF.format(2) + "3 0 1 2\n", "2 faces, .* number 1"),
        ("a.off", OFF.format(2) + "3 0 1 2\n3 0 1", "2 faces, .* number 2"),
        ("a.off", OFF.format("x"), "no OFF"),
        ("a.obj", f"{CORNERS}f 1 2 3\nf 1 2 10\n", "does not have"),
        ("a.obj", f"{CORNERS}f 1 2 3\nf -3 -2 -1\n", r"a\.obj, line 5"),
    ],
)
def test_damaged_meshes_are_rejected(tmp_path: Path, name: str, content: str | bytes, text: str) -> None:
    with pytest.raises(SceneBuildError, match=text) as raised:
        load_file(written(tmp_path, name, content))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "content", "triangles"),
    [
        ("a.stl", binary_stl(2, 2 * TRIANGLE + bytes(40)), 2),
        ("a.stl", binary_stl(2, 2 * TRIANGLE, b"solid by name only"), 2),
        ("a.stl", f"solid x\n{2 * FACET}endsolid x", 2),
        ("a.ply", PLY.format(1) + "3 0 1 2", 1),
        ("a.off", OFF.format(2) + "\n3 0 1 2 # first\n3 0 2 1 255 0 0", 2),
        ("a.obj", f"\ufeff# Größe\n{CORNERS}s off\nl 1 2\nf 1 2 3\nf 3 2 \\\n1\n", 2),
        ("a.off", "C" + OFF.format(1) + "3 0 1 2", 1),
    ],
)
def test_valid_meshes_are_read(tmp_path: Path, name: str, content: str | bytes, triangles: int) -> None:
    (node,) = load_file(written(tmp_path, name, content)).nodes
    assert node.surfaces[0].mesh.triangles == triangles


# --- DAE files that would fill memory or expose other files -----------------------------------------------------------


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


def test_few_instances_are_read(tmp_path: Path) -> None:
    text = dae(doubling(3), '<node id="top"><instance_node url="#n0"/></node>')
    (tmp_path / "a.dae").write_text(text.replace('"utf-8"', '"utf8"'))  # as Python's own writer spells it
    assert len(load_file(tmp_path / "a.dae").nodes) == 8


def test_exponential_nesting_is_rejected(tmp_path: Path) -> None:
    """Of nodes without anything in them: the reader follows them all the same."""
    nodes = doubling(40).replace('<instance_geometry url="#g"/>', "")
    (tmp_path / "a.dae").write_text(dae(nodes, '<node id="top"><instance_node url="#n0"/></node>'))
    with pytest.raises(SceneBuildError, match=r"that it draws"):
        load_file(tmp_path / "a.dae")


def test_cyclic_nesting_is_rejected(tmp_path: Path) -> None:
    node = '<node id="n"><instance_geometry url="#g"/><instance_node url="#n"/></node>'
    (tmp_path / "a.dae").write_text(dae("", node))
    with pytest.raises(SceneBuildError, match="instance of itself"):
        load_file(tmp_path / "a.dae")
