"""Invalid input of `iris-session serve`: one line that names the value, exit status 2, and no process stays."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import psutil
import pytest

from tests.cli.conftest import CommandLine
from tests.e2e.session_process import FREE_PORTS, run_command, wait_until

#: An arm with two actuators on one joint.
UNCLEAR = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
<body name="arm"><joint name="j1" axis="0 0 1"/><geom size=".05"/>
<body name="link" pos=".3 0 0"><joint name="j2" axis="0 1 0"/><geom size=".05"/>
<body name="hand" pos=".3 0 0"><joint name="j3" axis="1 0 0"/><geom size=".05"/>
<site name="p1"/></body></body></body></worldbody>
<actuator><position name="a1" joint="j1"/><position name="a2" joint="j2"/><position name="a3" joint="j3"/>
<velocity name="b2" joint="j2"/></actuator>
</mujoco>"""
#: Torque actuators and no declared hold law.
TORQUE = UNCLEAR.replace('<velocity name="b2" joint="j2"/>', "").replace("<position", "<motor")

FILES = {
    "unknown.xml": '<mujoco><worldbody><geom type="cube" size="1"/></worldbody></mujoco>',
    "unclear.xml": UNCLEAR,
    "torque.xml": TORQUE,
    "bad.toml": "[[robot]\nname = ",
    "torque.toml": '[[robot]]\nname = "arm"\njoints = ["j1", "j2", "j3"]\nsite = "p1"\n',
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
        (["unknown.xml"], "cube"),
        (["torque.xml", "--robots", "torque.toml", "--no-record", *FREE_PORTS], "hold"),
        (["handover", "--robots", "bad.toml"], "bad.toml"),
        (["handover", "--record", "taken/session.rrd", *FREE_PORTS], "taken"),
        (["handover", "--record", "old.rrd", *FREE_PORTS], "old.rrd"),
        (["handover", "--no-record", "--host", "192.0.2.1", "--curve-key", "missing.key"], "missing.key"),
    ],
)
def test_invalid_input_is_one_line_that_names_the_value(
    folder: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], expected: str, cli: CommandLine
) -> None:
    monkeypatch.chdir(folder)
    assert expected.lower() in cli.refuse("serve", *arguments).lower()
    assert_no_process_in(folder)


@pytest.mark.e2e
def test_unclear_robot_is_watched_until_a_robot_file_says_more(folder: Path) -> None:
    """The file that is printed lists the actuators to choose from; without it a session says what is unclear."""
    options = (*FREE_PORTS, "--no-record", "--seconds", "0.1")
    watched = run_command("serve", "unclear.xml", *options, cwd=folder)
    assert watched.returncode == 0, watched.stderr
    assert "robots: none" in watched.stdout
    assert "robot 'arm' can only be watched: joint 'j2' has 2 actuators (a2, b2)" in watched.stdout
    printed = run_command("robots", "unclear.xml", cwd=folder)
    assert "actuators = []  # one per joint; candidates: " in printed.stdout
    chosen = printed.stdout.replace("actuators = []", 'actuators = ["a1", "a2", "a3"]')
    (folder / "robots.toml").write_text(chosen)
    served = run_command("serve", "unclear.xml", "--robots", "robots.toml", *options, cwd=folder)
    assert served.returncode == 0, served.stderr
    assert "robots: arm" in served.stdout
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
