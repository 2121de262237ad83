"""The anchors file: roundtrip, and errors of one line that name the entry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from anchors.pose import PoseTuple
from iris_session import ConfigError, SessionConfig
from iris_session.session.config import dump_anchors, load_anchors

PLACES: dict[str, PoseTuple] = {
    "table": ((0.0, -0.45, 0.0), (1.0, 0.0, 0.0, 0.0)),
    'door "2"': ((1.25, 0.0, 0.4), (0.6, 0.0, 0.8, 0.0)),
}
GOOD = 'format = 1\nreference = "a"\n[anchors.a]\nposition_m = [0, 0, 0]\nquaternion_wxyz = [1, 0, 0, 0]\n'


@pytest.mark.parametrize("marks", [{}, {'door "2"': {"1": (0.1, 0.2, 0.0), "left up": (-0.1, 0.2, 0.0)}}])
def test_anchors_file_roundtrip(tmp_path: Path, marks: dict[str, Any]) -> None:
    path = tmp_path / "anchors.toml"
    path.write_text(dump_anchors(PLACES, {"table": 0.16}, marks))
    found = load_anchors(path)
    assert (found.anchors, found.sizes, found.reference) == (PLACES, {"table": 0.16}, "table")
    assert found.marks == marks
    config = SessionConfig(anchors=found.anchors, anchor_sizes=found.sizes, anchor_marks=found.marks)
    assert (config.sheet_sizes(), config.mark_positions()) == ({"table": 0.16}, marks)


@pytest.mark.parametrize(
    ("marks", "value"),
    [
        ({"shelf": {}}, "'shelf': there is no such anchor"),
        ({"table": {"1": (0.1, 0.2)}}, "mark '1'"),
        ({"table": {"1": (0.1, 0.2, float("nan"))}}, "mark '1'"),
        ({"table": {"1": (92.4, 131.6, 0.0)}}, "in metres"),
        ({"table": {"": (0.1, 0.2, 0.0)}}, "mark ''"),
        ({"table": {str(n): (0.0, 0.0, 0.0) for n in range(17)}}, "at most 16"),
        ({"table": [(0.1, 0.2, 0.0)]}, "positions by id"),
    ],
)
def test_marks_that_cannot_be_used_are_named(marks: dict[str, Any], value: str) -> None:
    with pytest.raises(ConfigError, match=value):
        SessionConfig(anchors=PLACES, anchor_marks=marks)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("anchors = [", "TOML"),
        ("", "format"),
        ("format = 1", r"\[anchors"),
        (GOOD.replace("[0, 0, 0]", "[0, 0]"), "anchors.a.position_m"),
        (GOOD.replace("[1, 0, 0, 0]", "[1, 1, 0, 0]"), "quaternion"),
        (GOOD.replace("[0, 0, 0]", "[0, -450, 0]"), "450 m"),
        (GOOD + "size_m = 160\n", "160.0"),
        (GOOD + "marks_m = 4\n", "anchors.a.marks_m must be a table"),
        (GOOD + "marks_m = {1 = [0, 0]}\n", "anchors.a.marks_m.1"),
        (GOOD.replace('"a"', f'"{"x" * 65}"').replace(".a]", f".{'x' * 65}]"), "1 to 64 characters"),
    ],
)
def test_invalid_anchors_file_names_the_entry(text: str, value: str, tmp_path: Path) -> None:
    path = tmp_path / "anchors.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=value) as caught:
        load_anchors(path)
    assert str(caught.value).startswith("anchors.toml: ")
    assert "\n" not in str(caught.value)


def test_unreadable_anchors_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none.toml.*No such file"):
        load_anchors(tmp_path / "none.toml")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="UTF-8"):
        load_anchors(tmp_path / "binary")
