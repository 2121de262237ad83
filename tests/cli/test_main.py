"""The command line: help with examples, one JSON object, one line per error."""

from __future__ import annotations

import argparse
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from iris_session.authority.config import UNALIGNED
from iris_session.cli.main import build_parser, main
from iris_session.cli.serve import make_session_config
from tests.loopback import make_loopback_address

COMMANDS = ("demo", "serve", "sessions", "verify", "recording", "emulate", "robots", "bench")


def _help(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_a_valid_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = _help(command, capsys)
    assert "example" in text
    examples = [line.strip() for line in text.splitlines() if line.strip().startswith(f"iris-session {command}")]
    assert examples
    for example in examples:
        words = example.split("   ")[0].split(">")[0].split()  # the rest is a comment, or a file
        build_parser().parse_args(words[1:])


def test_overview_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    for command in COMMANDS:
        assert f"iris-session {command}" in text


def test_every_option_has_help() -> None:
    parser = build_parser()
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    silent = [
        f"{name} {action.option_strings[0]}"
        for name, sub in commands.choices.items()
        for action in sub._actions
        if action.option_strings and not action.help
    ]
    assert silent == []


def test_serve_without_a_scene_prints_its_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve"]) == 2
    assert "--resume RECORDING" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [[], ["fly"], ["demo", "juggle"], ["bench", "state", "--clients", "x"]])
def test_invalid_command_line_exits_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("iris-session")
    assert "--help" in said
    assert said.count("\n") == 1


def test_robots_prints_toml_that_serve_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from iris_session.demo.scenes import scene_path
    from iris_session.physics import load_model, load_robots_toml

    scene = scene_path("handover")
    assert main(["robots", str(scene)]) == 0
    text = capsys.readouterr().out
    assert text.startswith("# 2 robots, 2 free objects: hammer, board")
    file = tmp_path / "robots.toml"
    file.write_text(text)
    model = load_model(scene)
    assert [r.name for r in load_robots_toml(file, model)] == ["left", "right"]


def test_robots_json_is_one_object(capsys: pytest.CaptureFixture[str]) -> None:
    from iris_session.demo.scenes import scene_path

    assert main(["robots", str(scene_path("handover")), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [r["name"] for r in result["robots"]] == ["left", "right"]
    assert {o["name"] for o in result["objects"]} == {"hammer", "board"}


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["robots", "nothing.xml"], "nothing.xml"),
        (["verify", "nothing.rrd"], "nothing.rrd"),
        (["serve", "nothing"], "expected one of handover, arm, arms, panda, aloha"),
        (["robots", "nothing"], "expected one of handover, arm, arms, panda, aloha"),
        (["serve", "arms13"], "1 to 12 arms, not 13"),
        (["serve", "handover", "--assign", "ann"], "NAME=ROBOT[,ROBOT]"),
        (["serve", "handover", "--unaligned", "ann"], "key:FINGERPRINT"),
        (["serve", "handover", "--assign", "ann=left,"], "NAME=ROBOT[,ROBOT]"),
        (["serve", "handover", "--assign", "ann=left", "--assignment", "nearest"], "--assignment config"),
        (["serve", "handover", "--assign", "ann=elbow", "--control-port", "0", "--state-port", "0"], "left"),
        (["emulate", "--behaviour", "foo"], "giver, receiver, folder, stower, wander, idle, observer"),
        (["emulate", "--behaviour", "giver"], "needs a partner"),
        (["emulate", "nowhere:port"], "HOST:PORT"),
        (["emulate", "--curve-key", "mine.key_secret"], "go together"),
        (["emulate", "--curve-server", "its.key", "--curve-key", "mine.key_secret"], "its.key"),
        (["serve", "handover", "--seconds", "1", "--control-port", "99999"], "99999"),
    ],
)
def test_expected_errors_are_one_line(
    arguments: list[str],
    expected: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.strip().splitlines()
    assert line.startswith("iris-session: ")
    assert expected in line


def test_robots_accepts_packaged_scenes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robots", "handover"]) == 0
    assert capsys.readouterr().out.startswith("# 2 robots, 2 free objects: hammer, board")


def test_emulate_fails_without_admission(capsys: pytest.CaptureFixture[str]) -> None:
    host = make_loopback_address()  # whose ports no other test takes
    with socket.create_server((host, 0)) as taken:
        port = taken.getsockname()[1]  # a listening socket that is no session
        assert main(["emulate", f"{host}:{port}", "--join-timeout", "0.2", "--count", "2"]) == 1
        errors = capsys.readouterr().err.splitlines()
        assert [line.split(": ")[:2] for line in errors] == [
            ["iris-session", f"wander{i}-{os.getpid()}"] for i in (1, 2)
        ], "two commands without names have people of different names"
        assert all(f"{host}:{port} within 0.2 s" in line for line in errors)
        assert main(["emulate", f"{host}:{port}", "--behaviour", "observer", "--seconds", "0.1"]) == 1
        assert host in capsys.readouterr().err
    assert main(["emulate", f"{host}:{port}", "--join-timeout", "0.2"]) == 1
    captured = capsys.readouterr()
    assert host in captured.err.splitlines()[-1]
    assert "age p99 -, alignment -" in captured.out


SERVE = ("--no-record", "--control-port", "0", "--state-port", "0", "--json")


def test_model_without_robots_is_served_with_an_explanation(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    scene = tmp_path / "ball.xml"
    scene.write_text("<mujoco><worldbody><body name='ball'><freejoint/><geom size='.1'/></body></worldbody></mujoco>")
    assert main(["serve", str(scene), "--seconds", "0.1", *SERVE]) == 0
    (line,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("no robots found")]
    assert "3 actuated joints" in line
    assert "no actuators" in line
    assert f"iris-session robots {scene}" in line
    assert main(["robots", str(scene)]) == 0
    assert "no actuators" in capfd.readouterr().err


def test_assigned_robots_reach_the_configuration() -> None:
    options = ["--assign", "ann=left", "--assign", "bob=right,third", "--assign", "ann=right,left"]
    config = make_session_config(build_parser().parse_args(["serve", "scene.xml", *options]), "scene")
    assert config.authority.policy == "config"
    assert config.authority.assignments == {"ann": ("left", "right"), "bob": ("right", "third")}
    plain = make_session_config(build_parser().parse_args(["serve", "scene.xml"]), "scene")
    assert (plain.authority.policy, plain.authority.assignments) == ("join-order", {})


def test_whoever_may_be_unaligned_reaches_the_configuration() -> None:
    options = ["--unaligned", "operator", "--unaligned", "key:abc"]
    config = make_session_config(build_parser().parse_args(["serve", "scene.xml", *options]), "scene")
    assert config.authority.unaligned == (*UNALIGNED, "operator", "key:abc")
    plain = make_session_config(build_parser().parse_args(["serve", "scene.xml"]), "scene")
    assert plain.authority.unaligned == UNALIGNED


def test_sites_and_tendons_are_optional() -> None:
    parser = build_parser()
    config = make_session_config(parser.parse_args(["serve", "scene.xml", "--sites", "--tendons"]), "scene")
    assert (config.sites, config.tendons) == (True, True)
    plain = make_session_config(parser.parse_args(["demo", "handover"]), "scene")
    assert (plain.sites, plain.tendons) == (False, False)


def test_serve_prints_json_and_its_recording_verifies(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    recording = tmp_path / "session.rrd"
    ports = ["--control-port", "0", "--state-port", "0", "--record", str(recording)]
    assert main(["serve", "handover", "--seconds", "0.3", "--json", *ports]) == 0
    result = json.loads(capfd.readouterr().out)
    assert result["ok"] is True
    assert result["recording"] == str(recording)
    assert result["tick"] > 0
    assert {"ticks", "late", "late_share", "p99_ms"} <= set(result["lateness"])
    assert main(["verify", str(recording)]) == 0
    assert capfd.readouterr().out.startswith(f"{recording}: ok: ")
    assert main(["verify", "--json", str(recording)]) == 0
    report = json.loads(capfd.readouterr().out)
    assert report["ok"] is True
    assert report["files"][0]["steps"] == result["tick"]
    assert main(["verify", str(recording), str(tmp_path / "none.rrd")]) == 2


def test_closed_pipe_prints_no_traceback(tmp_path: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "iris_session.cli.main", "robots", "handover.xml"]
    from iris_session.demo.scenes import scene_path

    command[-1] = str(scene_path("handover"))
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, check=False, cwd=tmp_path)
    os.close(write)
    assert "Traceback" not in done.stderr
    assert done.returncode == 1


@pytest.mark.parametrize("seconds", ["-1", "0", "nan", "soon"])
def test_duration_must_be_positive(seconds: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["serve", "handover", "--seconds", seconds])
    assert ended.value.code == 2
    assert "duration" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"), [(["a.txt"], "ends in .rrd"), (["a.rrd", "--no-record"], "contradict each other")]
)
def test_recording_that_could_not_be_made_is_refused(
    options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["serve", "handover", "--record", *options]) == 2
    assert said in capsys.readouterr().err


def test_file_that_is_no_recording_does_not_hide_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a.rrd", "b.rrd"):
        (tmp_path / name).write_text("not a recording")
    for given in ([tmp_path / "a.rrd", tmp_path / "b.rrd"], [tmp_path]):
        assert main(["verify", *map(str, given)]) == 2
        errors = capsys.readouterr().err
        assert "a.rrd" in errors
        assert "b.rrd" in errors
    (tmp_path / "empty").mkdir()
    assert main(["verify", str(tmp_path / "empty")]) == 2
    assert "no recording below" in capsys.readouterr().err


def test_verify_takes_every_recording_below_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [tmp_path / "monday" / "session.rrd", tmp_path / "tuesday" / "session.rrd"]
    for file in files:
        file.parent.mkdir()
        file.write_text("not a recording")
    assert main(["verify", "--json", str(tmp_path)]) == 2
    assert [one["path"] for one in json.loads(capsys.readouterr().out)["files"]] == [str(file) for file in files]


SCRIPT = """
import sys
from iris_session.cli.main import main
main(["robots", "handover"])
print(*sys.modules, file=sys.stderr)
"""
#: Loaded on use: the display, recordings, inverse kinematics, images, windows.
HEAVY = {"rich", "rerun", "pyarrow", "mink", "scipy", "cv2", "glfw", "matplotlib"}


def test_command_that_reads_a_model_loads_only_mujoco() -> None:
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    command = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120.0, env=environment)
    loaded = set(done.stderr.split())
    assert "mujoco" in loaded
    assert not loaded & HEAVY
