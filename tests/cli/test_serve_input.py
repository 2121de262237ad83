"""Invalid input of `iris-session serve`: one line that names the value, exit status 2, and no process stays."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import psutil
import pytest

from tests.e2e.session_process import FREE_PORTS, run_command, run_in_process, wait_until

#: An arm with two sites that may be its end effector.
AMBIGUOUS = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
<body name="arm"><joint name="j1" axis="0 0 1"/><geom size=".05"/>
<body name="link" pos=".3 0 0"><joint name="j2" axis="0 1 0"/><geom size=".05"/>
<body name="hand" pos=".3 0 0"><joint name="j3" axis="1 0 0"/><geom size=".05"/>
<site name="p1"/><site name="p2"/></body></body></body></worldbody>
<actuator><position name="a1" joint="j1"/><position name="a2" joint="j2"/><position name="a3" joint="j3"/></actuator>
</mujoco>"""
#: Torque actuators and no declared hold law.
TORQUE = AMBIGUOUS.replace('<site name="p2"/>', "").replace("<position", "<motor")

FILES = {
    "unknown.xml": '<mujoco><worldbody><geom type="cube" size="1"/></worldbody></mujoco>',
    "scene.txt": "hello",
    "ambiguous.xml": AMBIGUOUS,
    "torque.xml": TORQUE,
    "bad.toml": "[[robot]\nname = ",
    "unknown.toml": '[[robot]]\nname = "left"\njoints = ["no_such_joint"]\nactuators = ["x"]\nsite = "left/tip"\n'
    'base_body = "left/base"\n',
    "keys.toml": '[[robot]]\nname = "left"\ncolour = "red"\n',
    "taken": "a file where a folder is expected",
    "old.rrd": "an existing file",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["nothing.xml"], "nothing.xml"),
        (["nowhere"], "handover"),  # lists the packaged scenes
        (["unknown.xml"], "cube"),
        (["scene.txt"], "scene.txt"),
        (["torque.xml", "--no-record", *FREE_PORTS], "hold"),
        (["handover", "--robots", "bad.toml"], "bad.toml"),
        (["handover", "--robots", "unknown.toml"], "no_such_joint"),
        (["handover", "--robots", "keys.toml"], "colour"),
        (["handover", "--record", "taken/session.rrd", *FREE_PORTS], "taken"),
        (["handover", "--record", "old.rrd", *FREE_PORTS], "old.rrd"),
        (["handover", "--no-record", "--host", "192.0.2.1", "--curve-key", "missing.key"], "missing.key"),
        (["handover", "--no-record", "--control-port", "70000"], "65535"),
        (["handover", "--name", "no/slash"], "letters"),
    ],
)
def test_invalid_input_is_one_line_that_names_the_value(
    folder: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], expected: str
) -> None:
    monkeypatch.chdir(folder)
    status, out, errors = run_in_process("serve", *arguments)
    assert status == 2, (out, errors)
    lines = errors.strip().splitlines()
    assert len(lines) == 1, errors
    assert lines[0].startswith("iris-session: ")
    assert expected.lower() in lines[0].lower()
    assert not out.strip()
    assert_no_process_in(folder)


@pytest.mark.e2e
def test_ambiguous_model_prints_a_robot_file_to_edit(folder: Path) -> None:
    done = run_command("serve", "ambiguous.xml", "--no-record", cwd=folder)
    assert done.returncode == 2, (done.stdout, done.stderr)
    assert done.stderr.startswith("iris-session: ")
    assert "\n" not in done.stderr.strip()
    toml = folder / "robots.toml"
    toml.write_text(done.stdout.replace('site = ""', 'site = "p2"'))
    assert "p1, p2" in done.stdout
    edited = run_command(
        "serve", "ambiguous.xml", "--robots", str(toml), *FREE_PORTS, "--no-record", "--seconds", "0.1", cwd=folder
    )
    assert edited.returncode == 0, edited.stderr
    assert "robots: arm" in edited.stdout
    assert_no_process_in(folder)


@pytest.mark.e2e
def test_port_in_use_is_one_line_that_names_the_port(folder: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        ports = [*FREE_PORTS, "--state-port", port]
        done = run_command("serve", "handover", "--record", "new.rrd", *ports, cwd=folder)
    assert done.returncode == 2, (done.stdout, done.stderr)
    (line,) = done.stderr.strip().splitlines()
    assert port in line
    assert_no_process_in(folder)


def assert_no_process_in(folder: Path) -> None:
    """Wait until no process has this working directory, which children inherit."""

    def list_processes() -> list[str]:
        found = []
        for process in psutil.process_iter():
            try:
                if process.pid != os.getpid() and process.cwd() == str(folder):
                    found.append(" ".join(process.cmdline()))
            except psutil.Error:
                continue
        return found

    wait_until(lambda: not list_processes(), f"the processes of the command end: {list_processes()}")
