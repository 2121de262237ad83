"""Checks of the serving machine, run on this machine."""

from __future__ import annotations

import socket
from pathlib import Path
from types import SimpleNamespace

import pytest

from iris_session.doctor import host_checks
from iris_session.security import KeyHome


def test_every_check_has_a_finding(tmp_path: Path) -> None:
    found = host_checks.check_host(tmp_path / "sessions")
    wanted = ["scheduling", "processors", "memory", "disk", "key_home", "ports", "interfaces", "clock_source"]
    assert [one.check for one in found] == wanted
    assert all(one.text and one.state in ("ok", "warning", "failed") for one in found)


def test_used_ports_name_their_process() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(1)
        port = listener.getsockname()[1]
        found = host_checks.check_ports(port)
    assert found.state == "warning"
    assert f"{port} (control)" in found.text
    assert "python" in found.text or "pytest" in found.text


def test_ports_used_by_a_session_are_ok(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each program is reported once, with all its ports."""
    monkeypatch.setattr(host_checks, "_is_port_in_use", lambda port: port != 7725)
    monkeypatch.setattr(host_checks, "_list_connections", list)
    assert host_checks.check_ports(7721).state == "warning"
    listening = [
        SimpleNamespace(status="LISTEN", laddr=SimpleNamespace(port=port), pid=1 + port // 7724)
        for port in range(7720, 7727)
    ]
    programs = {1: "python -m iris_session.front.main (process 1)", 2: "python iris-session (process 2)"}
    monkeypatch.setattr(host_checks, "_list_connections", lambda: listening)
    monkeypatch.setattr(host_checks, "_describe_process", programs.__getitem__)
    found = host_checks.check_ports(7721)
    assert found.state == "ok"
    assert found.text.count("process 1") == 1
    assert "7720 (introduction), 7721 (control), " in found.text


@pytest.mark.parametrize(
    ("command", "program"),
    [
        (
            ["/a/long/path/.venv/bin/python", "-P", "-m", "iris_session.front.main", "ipc:///tmp/x"],
            "python -m iris_session.front.main",
        ),
        (["/usr/bin/python3.11", "/home/ann/robot.py", "-m", "x"], "python3.11 robot.py"),
        (["/usr/sbin/nginx", "-c", "/etc/nginx.conf"], "nginx"),
        ([], ""),
    ],
)
def test_programs_are_named_without_folders_and_options(command: list[str], program: str) -> None:
    assert host_checks._name_program(command) == program


def test_key_home_that_others_can_read_or_that_is_damaged_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "home"))
    assert host_checks.check_key_home().state == "ok"  # does not exist yet
    KeyHome().load_server_key()
    assert host_checks.check_key_home().state == "ok"
    (tmp_path / "home" / "server.key_secret").chmod(0o644)
    found = host_checks.check_key_home()
    assert found.failed
    assert "server.key_secret" in found.text
    assert "chmod" in found.advice
    (tmp_path / "home" / "server.key_secret").chmod(0o600)
    path = tmp_path / "home" / "clients.json"
    path.write_text("[{}]")
    path.chmod(0o600)
    assert host_checks.check_key_home().failed


def test_recording_folder_is_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert str(tmp_path) in host_checks.check_disk_space(tmp_path / "deep" / "below").text
    monkeypatch.setattr(host_checks, "FULL_DISK", 1 << 60)
    assert host_checks.check_disk_space(tmp_path).failed
