"""The anchors file: roundtrip, and errors of one line that name the entry."""

from __future__ import annotations

from pathlib import Path

import pytest

from anchors.pose import PoseTuple
from iris_session import ConfigError, SessionConfig
from iris_session.session.config import dump_anchors, load_anchors

PLACES: dict[str, PoseTuple] = {
    "table": ((0.0, -0.45, 0.0), (1.0, 0.0, 0.0, 0.0)),
    'door "2"': ((1.25, 0.0, 0.4), (0.6, 0.0, 0.8, 0.0)),
}
GOOD = 'format = 1\nreference = "a"\n[anchors.a]\nposition_m = [0, 0, 0]\nquaternion_wxyz = [1, 0, 0, 0]\n'


def test_anchors_file_roundtrip(tmp_path: Path) -> None:
    path = tmp_path / "anchors.toml"
    path.write_text(dump_anchors(PLACES, {"table": 0.16}))
    found = load_anchors(path)
    assert (found.anchors, found.sizes, found.reference) == (PLACES, {"table": 0.16}, "table")
    config = SessionConfig(anchors=found.anchors, anchor_sizes=found.sizes)
    assert config.sheet_sizes() == {"table": 0.16}


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
        (GOOD.replace('"a"', f'"{"x" * 65}"').replace(".a]", f".{'x' * 65}]"), "1 to 64 characters"),
        (GOOD.replace('"a"', '""').replace(".a]", '.""]'), "1 to 64 characters"),
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
    with pytest.raises(ConfigError, match=str(tmp_path)):
        load_anchors(tmp_path)
