"""The command line: help with examples, one JSON object, one line per error."""

from __future__ import annotations

import argparse
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from iris_session.authority.config import UNALIGNED
from iris_session.cli.main import build_parser, main
from iris_session.cli.serve import make_session_config
from iris_session.session.config import SessionConfig
from tests.cli.conftest import CommandLine
from tests.models import MENAGERIE


def list_parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield a parser, and those of its commands and actions."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner in action.choices.values():
                yield from list_parsers(inner)


PARSERS = {parser.prog: parser for parser in list_parsers(build_parser())}


@pytest.mark.parametrize("name", PARSERS)
def test_every_command_has_help_for_its_options_and_valid_examples(name: str) -> None:
    text = PARSERS[name].format_help()
    examples = [line.strip() for line in text.splitlines() if line.startswith("  iris-session ")]
    assert examples
    for example in examples:
        words = shlex.split(re.split(r" {2,}| >", example)[0])[1:]  # the rest is a comment, or a file
        PARSERS["iris-session"].parse_args(words)
    silent = [action.option_strings for action in PARSERS[name]._actions if action.option_strings and not action.help]
    assert silent == []


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("", "required: COMMAND, one of demo, serve"),
        ("fly", "invalid choice: 'fly'"),
        ("episode", "required: action, one of discard, failure, rerecord, reset, start, stop, success"),
        ("recording", "required: ACTION, one of inspect, episodes, view, verify, export, render, repair; see "),
        ("policy --repo x --robot left --hz 0", "give 1 to 240 steps a second, for example 30"),
        ("policy --repo x --robot left --address 127.0.0.1:1", "no session answers at 127.0.0.1:1"),
        (
            "view --port 70000",
            "give 1 to 65534, or 0 for a free one; see iris-session view --help",
        ),
        ("pair --web-port 70000", "'70000' is not a port: give 1 to 65535"),
        ("serve", "--resume RECORDING"),
        ("serve arms13", "1 to 12 arms, not 13"),
        ("serve handover --assign ann=elbow --control-port 0 --state-port 0", "left"),
        ("verify nothing.rrd", "nothing.rrd"),
        ("robots nothing", "expected one of handover, arm, arms, panda, aloha"),
        ("status nowhere:port", "is not HOST:PORT"),
        ("emulate --behaviour foo", "giver, receiver, folder, stower, wander, idle, observer"),
        ("emulate --behaviour giver", "needs a partner"),
        ("emulate --curve-key mine.key_secret", "go together"),
        ("emulate --curve-server its.key --curve-key mine.key_secret", "its.key"),
        *((f"emulate --headset name=a {option}", "model.drift_m_per_min") for option in ("--drift 3", "--bump-at 2")),
        ("emulate --headset name=a --glance-every 5", "model.drift_m_per_min"),
        ("bench input --robots 20", "--robots: '20' is not a number that can be measured: give 1 to 12"),
        ("bench input --operators 9 --robots 8", "--operators 9: "),
        ("bench alignment --pairs 3", "give 10 to 100000"),
        ("bench join --assets-mb 0.5", "give 1 to 2000"),
        ("bench state --profile nice-wifi", "'nice-wifi'"),
        ("bench stop --clients 4", "unrecognized arguments: --clients 4"),
        ("anchors calibrate-camera p --sheet table=9mm --at table=0,0,0", "is not a pose: x,y,z in metres"),
        ("anchors calibrate-camera p --sheet table=9mm --at table=0,0,0,2,0,0,0", "is not a pose: x,y,z in metres"),
        ("anchors calibrate-camera p --sheet table=9mm --at 0,0,0,1,0,0,0", "the id of the sheet is missing"),
    ],
)
def test_unusable_command_lines_are_one_line(words: str, text: str, cli: CommandLine) -> None:
    assert text in cli.refuse(*shlex.split(words))


def test_serve_prints_json_and_its_recording_verifies(tmp_path: Path, cli: CommandLine) -> None:
    recording = tmp_path / "session.rrd"
    ports = ("--control-port", 0, "--state-port", 0)
    result = cli.json("serve", "handover", "--seconds", "0.3", *ports, "--record", recording)
    assert (result["ok"], result["recording"]) == (True, str(recording))
    assert result["tick"] > 0
    assert {"ticks", "late", "late_share", "p99_ms"} <= set(result["lateness"])
    assert cli.run("verify", recording).startswith(f"{recording}: ok: ")
    report = cli.json("verify", recording)
    assert (report["ok"], report["files"][0]["steps"]) == (True, result["tick"])
    assert "none.rrd" in cli.refuse("verify", recording, tmp_path / "none.rrd")


def test_model_without_robots_says_what_a_robot_needs(tmp_path: Path, cli: CommandLine) -> None:
    scene = tmp_path / "ball.xml"
    scene.write_text("<mujoco><worldbody><body name='ball'><freejoint/><geom size='.1'/></body></worldbody></mujoco>")
    cli.run("robots", scene)
    assert "3 actuated joints" in cli.err


def test_legs_are_listed_on_request(cli: CommandLine) -> None:
    scene = str(MENAGERIE / "unitree_go1" / "go1.xml")
    assert cli.json("robots", scene)["robots"] == []
    found = cli.json("robots", scene, "--all")
    assert [robot["name"] for robot in found["robots"]] == ["FR_leg", "FL_leg", "RR_leg", "RL_leg"]
    assert found["notices"] == []


def test_options_of_a_session_reach_its_configuration() -> None:
    def make(*options: str) -> SessionConfig:
        return make_session_config(build_parser().parse_args(["serve", "scene.xml", *options]), "scene")

    plain = make()
    assert (plain.authority.policy, plain.authority.assignments) == ("join-order", {})
    assert plain.authority.unaligned == UNALIGNED
    config = make("--assign", "ann=left", "--assign", "bob=right,third", "--assign", "ann=right,left")
    assert config.authority.policy == "config"
    assert config.authority.assignments == {"ann": ("left", "right"), "bob": ("right", "third")}
    config = make("--unaligned", "operator", "--unaligned", "key:abc")
    assert config.authority.unaligned == (*UNALIGNED, "operator", "key:abc")


def test_verify_names_every_file_that_is_no_recording(tmp_path: Path, cli: CommandLine) -> None:
    files = [tmp_path / "monday" / "session.rrd", tmp_path / "tuesday" / "session.rrd"]
    for file in files:
        file.parent.mkdir()
        file.write_text("not a recording")
    for given in (files, [tmp_path]):
        assert [one["path"] for one in cli.json("verify", *given, status=2)["files"]] == [str(file) for file in files]
        assert all(str(file) in cli.err for file in files)
    (tmp_path / "empty").mkdir()
    assert str(tmp_path / "empty") in cli.refuse("verify", tmp_path / "empty")


def test_closed_pipe_ends_quietly(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        assert main(["robots", "handover"]) == 1
    assert capfd.readouterr().err == ""


SCRIPT = """
import sys
from iris_session.cli.main import main
try:
    main(["--help"])
except SystemExit:
    print(*sys.modules, file=sys.stderr)
main(["robots", "handover"])
print(*sys.modules, file=sys.stderr)
"""
#: Loaded on use: the display, recordings, inverse kinematics, images, windows.
HEAVY = {"rich", "rerun", "pyarrow", "mink", "scipy", "cv2", "glfw", "matplotlib"}


def test_commands_load_only_what_they_use() -> None:
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    command = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120.0, env=environment)
    overview, model = (set(line.split()) for line in done.stderr.splitlines())
    assert not overview & {*HEAVY, "mujoco", "numpy", "asyncio"}
    assert "mujoco" in model
    assert not model & HEAVY


@pytest.mark.parametrize("command", ["status", "doctor", "web", "emulate", "anchors status", "estop", "cloud inspect"])
def test_every_command_of_a_session_takes_its_address_by_the_same_option(command: str) -> None:
    parser = build_parser()
    words = command.split()
    assert parser.parse_args(words).address == ""
    assert parser.parse_args([*words, "--address", "lab:7721"]).address == "lab:7721"
    if command not in ("estop", "cloud inspect"):
        assert parser.parse_args([*words, "lab:7721"]).address == "lab:7721"


@pytest.mark.parametrize("action", ["view", "verify"])
def test_the_short_commands_are_actions_of_recordings(action: str) -> None:
    parser = build_parser()
    short, long = parser.parse_args([action, "s.rrd"]), parser.parse_args(["recording", action, "s.rrd"])
    assert short.run == long.run
