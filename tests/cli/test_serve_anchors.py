"""`serve --anchors`: the file replaces the anchors of the scene, and the example file works."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from iris_session.cli import serve
from iris_session.cli.main import build_parser, main
from iris_session.session.config import SessionConfig

DOOR = (
    'format = 1\nreference = "door"\n[anchors.door]\nposition_m = [1.0, 2.0, 0.5]\n'
    "quaternion_wxyz = [0.0, 0.0, 0.0, 1.0]\nsize_m = 0.12\n"
)


def test_the_file_takes_the_place_of_the_scenes_anchors(tmp_path: Path) -> None:
    path = tmp_path / "anchors.toml"
    path.write_text(DOOR)
    arguments = build_parser().parse_args(["serve", "arm", "--no-record", "--anchors", str(path)])
    config = serve.create_session(arguments).config
    assert config.anchors == {"door": ((1.0, 2.0, 0.5), (0.0, 0.0, 0.0, 1.0))}
    assert config.sheet_sizes() == {"door": 0.12}
    plain = serve.create_session(build_parser().parse_args(["serve", "arm", "--no-record"])).config
    assert set(plain.anchors) == {"table"}


def test_the_example_is_read_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for scene in ([], ["arms4"]):
        assert main(["anchors", "example", *scene]) == 0
        text = capsys.readouterr().out
        path = tmp_path / "example.toml"
        path.write_text(text)
        arguments = build_parser().parse_args(["serve", "arms4", "--no-record", "--anchors", str(path)])
        config = serve.create_session(arguments).config
        assert set(config.anchors) == {"table"}
        assert config.sheet_sizes() == {"table": 0.16}
    own = serve.create_session(build_parser().parse_args(["serve", "arms4", "--no-record"])).config
    assert config.anchors == own.anchors, "that of the scene"
    assert main(["anchors", "example", "arms4", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"toml": text}


@pytest.mark.parametrize("text", ["nonsense", DOOR.replace("position_m", "position_mm"), None])
def test_a_bad_file_is_one_line_that_names_the_example(
    text: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "anchors.toml"
    if text is not None:
        path.write_text(text)
    assert main(["serve", "arm", "--no-record", "--anchors", str(path)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("iris-session: ")
    assert "`iris-session anchors example` prints one that is right" in said


def test_a_resumed_session_is_given_anchors_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the runtime makes of them: tests/session/test_continuation.py."""
    path = tmp_path / "anchors.toml"
    path.write_text(DOOR)
    opened: list[SessionConfig] = []
    monkeypatch.setattr("iris_session.session.session.Session", lambda model, config: opened.append(config))
    for given in (["--anchors", str(path)], []):
        serve.resume_session(build_parser().parse_args(["serve", "--resume", str(tmp_path), *given]))
    assert [set(config.anchors) for config in opened] == [{"door"}, {"table"}]
    assert opened[0].resume == tmp_path
