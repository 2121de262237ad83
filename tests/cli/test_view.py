"""`view` and `recording repair` on the command line: what is chosen, what is said, and exit statuses."""

from __future__ import annotations

import os
import shutil
import socket
from pathlib import Path

import pytest

from iris_session.cli.common import CommandError
from iris_session.cli.view import find_live
from iris_session.recording.lock import RecordingLock
from iris_session.recording.repair import RepairReport
from iris_session.rrd.file import scan_file
from tests.cli.conftest import CommandLine
from tests.recording.support import journal, write


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("closed") / "session.rrd", *journal(40))


@pytest.fixture
def path(closed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(closed, tmp_path))


def test_newest_session_of_a_folder_is_chosen(
    closed: Path, tmp_path: Path, cli: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the newest file of a session, which may be a part or a resumed recording."""
    for i, name in enumerate(
        ("sessions/a/session.rrd", "sessions/b/session.rrd", "sessions/c/session.rrd", "sessions/b/session.resume2.rrd")
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(closed, tmp_path / name)
        os.utime(tmp_path / name, (1e9 + i, 1e9 + i))
    monkeypatch.chdir(tmp_path)
    lines = cli.run("view", "--no-open").splitlines()
    assert cli.err == ""
    assert lines[0] == "3 sessions below sessions, the newest is shown; the others:"
    assert [line.split()[-1] for line in lines[1:3]] == ["sessions/c/session.rrd", "sessions/a/session.rrd"]
    assert lines[3] == "shows session.rrd, session.resume2.rrd of sessions/b"
    assert lines[4].startswith("made the copy sessions/b/session.view.rrd (")
    assert "\nuses the copy sessions/b/session.view.rrd (" in cli.run("view", "sessions/b", "--no-open")


def test_recording_that_is_being_written_is_found_among_resumed_ones(path: Path, cli: CommandLine) -> None:
    others = [path.with_name(f"session.resume{number}.rrd") for number in (2, 3)]
    for other in others:
        shutil.copy(path, other)
    for live in (path, *others):
        lock = RecordingLock(live, shared=True)
        assert {find_live(one) for one in (path, *others, path.parent)} == {live}
        with pytest.raises(CommandError, match="other"):
            find_live(path.parent / "other" / path.name)
        lock.release()
    assert "no session writes" in cli.refuse("view", path.parent, "--live")


def test_damage_is_named(path: Path, cli: CommandLine) -> None:
    data = bytearray(path.read_bytes())
    victim = scan_file(path).messages[-10]
    data[victim.offset + 60 : victim.offset + victim.length] = bytes(victim.length - 60)
    path.write_bytes(data)
    assert f"DAMAGED: session.rrd: message of {victim.length} bytes at byte" in cli.run("view", path, "--no-open")


def test_unusable_input_is_one_line(tmp_path: Path, cli: CommandLine) -> None:
    (tmp_path / "other.rrd").write_bytes(b"x" * 99)
    (tmp_path / "empty").mkdir()
    for name, why in (
        ("no.rrd", "does not exist: give a recording"),
        ("empty", "there is no recording below the folder"),
        ("other.rrd", "not a Rerun file"),
    ):
        assert why in cli.refuse("view", tmp_path / name)


def test_port_of_another_program_is_refused(path: Path, cli: CommandLine) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        for given in (port, port - 1):  # the page gets its data from the next one
            assert f"port {port} already" in cli.refuse("view", path, "--port", given)
    assert not list(path.parent.glob("*.view.rrd")), "before the copy is made"


def test_viewer_that_fails_is_a_line(
    path: Path, tmp_path: Path, cli: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    cli.run("view", path, "--no-open")
    tool = tmp_path / "tool"
    tool.write_text("#!/bin/sh\nexit 3\n")
    tool.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", str(tool))
    for display in ("", ":77"):
        monkeypatch.setenv("DISPLAY", display)
        assert "Rerun's viewer ended with exit status 3" in cli.refuse("view", path, status=1)


def test_repair_says_what_is_lost(path: Path, tmp_path: Path, cli: CommandLine) -> None:
    output = tmp_path / "repaired.rrd"
    out = cli.run("recording", "repair", path, "-o", output)
    assert out.startswith(f"{output}: 40 steps, 0.1 s, ")
    assert "  lost    nothing" in out
    assert cli.err == ""
    assert "--force" in cli.refuse("recording", "repair", path, "-o", output)
    victim = scan_file(path).messages[-10]
    data = bytearray(path.read_bytes())
    data[victim.offset + 60 : victim.offset + victim.length] = bytes(victim.length - 60)
    path.write_bytes(data[: scan_file(path).messages[-4].offset + 3])  # in the first mark of the end
    out = cli.run("recording", "repair", path, "-o", output, "--force", status=1)
    assert f"{victim.length + 16 + 3:,} bytes that cannot be read; what may have followed the last step" in out
    assert f"  found   session.rrd: message of {victim.length} bytes at byte {victim.offset}" in out
    result = cli.json("recording", "repair", path, "-o", output, "--force", status=1)
    assert sorted(result) == sorted(RepairReport.__struct_fields__)
    assert (result["ok"], result["lost_bytes"]) == (False, victim.length + 19)
