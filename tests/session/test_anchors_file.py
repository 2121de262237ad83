"""The anchors file: what is written is read back, and every mistake is one line that says what would be right."""

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


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "anchors.toml"
    path.write_text(dump_anchors(PLACES, {"table": 0.16}))
    found = load_anchors(path)
    assert (found.anchors, found.sizes, found.reference) == (PLACES, {"table": 0.16}, "table")
    config = SessionConfig(anchors=found.anchors, anchor_sizes=found.sizes)
    assert config.sheet_sizes() == {"table": 0.16}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("anchors = [", "not a TOML file"),
        ("", "format = None: this version reads format = 1"),
        ("format = 1", r"it needs \[anchors.NAME\] tables"),
        (GOOD.replace("[0, 0, 0]", "[0, 0]"), "anchors.a.position_m must be a list of 3 numbers"),
        (GOOD.replace("[1, 0, 0, 0]", "[1, 1, 0, 0]"), "no unit quaternion"),
        (GOOD.replace("[0, 0, 0]", "[0, -450, 0]"), "450 m away: are these metres"),
        (GOOD + "size_m = 160\n", "160.0 is not the edge of a printed sheet in metres"),
        (GOOD.replace('"a"', f'"{"x" * 65}"').replace(".a]", f".{'x' * 65}]"), "1 to 64 characters"),
        (GOOD.replace('"a"', '""').replace(".a]", '.""]'), "1 to 64 characters"),
    ],
)
def test_mistakes(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "anchors.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said) as caught:
        load_anchors(path)
    assert str(caught.value).startswith("anchors.toml: ")
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none.toml' cannot be read: No such file.*; `iris-session anchors example`"):
        load_anchors(tmp_path / "none.toml")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not UTF-8 text"):
        load_anchors(tmp_path / "binary")
    with pytest.raises(ConfigError, match="cannot be read"):
        load_anchors(tmp_path)
