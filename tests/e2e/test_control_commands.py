"""`iris-session estop`, `clear-estop`, `pause`, `assign`, ...: a running session controlled from another terminal."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import termios
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from iris_session import AuthorityConfig, Session, SessionConfig
from iris_session.client import Client
from iris_session.demo.scenes import scene_path
from iris_session.protocol.server_messages import Event, MarkerAdded
from tests.e2e.session_process import DEADLINE_S, SessionProcess, make_serve_command, run_in_process, wait_until
from tests.loopback import make_loopback_address

pytestmark = pytest.mark.e2e


def run_control(server: SessionProcess, command: str, *arguments: str, status: int = 0) -> dict[str, Any]:
    """Return the JSON object of one control command, which must end with `status`."""
    code, out, errors = run_in_process(command, *arguments, "--address", server.address, "--json")
    assert code == status, (out, errors)
    result: dict[str, Any] = json.loads(out) if out else {}
    return result


@pytest.fixture
def ann(shared_session: SessionProcess) -> Iterator[Client]:
    with (
        Client(shared_session.address, name="ann", role="agent", devices=("target",))
        .connect(DEADLINE_S)
        .start() as client
    ):
        yield client


@pytest.mark.long
def test_a_session_is_found_by_its_name(shared_session: SessionProcess) -> None:
    name = re.search(r"session '([^']+)' on", shared_session.output)
    assert name, shared_session.output
    code, _, errors = run_in_process("marker", "found by name", "--session", name[1])
    assert code == 0, errors
    assert run_in_process("marker", "not found", "--session", "no-such-session")[0] != 0


def test_estop_is_set_and_cleared(shared_session: SessionProcess, ann: Client) -> None:
    assert run_control(shared_session, "estop", "hand in the way")["estop"] is True
    assert ann.wait_for(lambda c: c.mirror.estop, DEADLINE_S)
    assert run_control(shared_session, "clear-estop")["cleared"][0]["reason"] == "hand in the way"
    assert ann.wait_for(lambda c: not c.mirror.estop, DEADLINE_S)
    assert run_control(shared_session, "clear-estop")["cleared"] == []


def test_physics_is_paused_and_continued_and_reset(shared_session: SessionProcess, ann: Client) -> None:
    run_control(shared_session, "pause")
    assert ann.wait_for(lambda c: c.mirror.paused, DEADLINE_S)
    run_control(shared_session, "resume")
    assert ann.wait_for(lambda c: not c.mirror.paused, DEADLINE_S)
    epoch = ann.mirror.scene_epoch
    run_control(shared_session, "reset")
    assert ann.wait_for(lambda c: c.mirror.scene_epoch == epoch + 1, DEADLINE_S)


def test_robots_are_assigned_and_released(shared_session: SessionProcess, ann: Client) -> None:
    assert run_control(shared_session, "assign", "left,right", "ann")["robots"] == ["left", "right"]
    assert ann.wait_for(lambda c: c.mirror.leases["right"].holder == c.participant_id, DEADLINE_S)
    run_control(shared_session, "release", "left", "right")
    assert ann.wait_for(lambda c: not c.mirror.leases["left"].holder, DEADLINE_S)
    assert run_control(shared_session, "mode", "takeover", "left")["robots"] == ["left"]
    assert ann.wait_for(lambda c: c.mirror.leases["left"].mode == "takeover", DEADLINE_S)
    run_control(shared_session, "mode", "exclusive")
    assert ann.wait_for(lambda c: c.mirror.leases["left"].mode == "exclusive", DEADLINE_S)


def test_episodes_and_markers_are_recorded(shared_session: SessionProcess, ann: Client) -> None:
    notes: list[str] = []

    def note_marker(event: Event) -> None:
        if isinstance(event.body, MarkerAdded):
            notes.append(event.body.text)

    ann.on_event = note_marker
    assert run_control(shared_session, "episode", "start", "--label", "pour")["state"] == "running"
    assert run_control(shared_session, "episode", "success")["state"] == "success"
    run_control(shared_session, "marker", "gripper was cleaned")
    assert ann.wait_for(lambda _: "gripper was cleaned" in notes, DEADLINE_S)
    denied = run_control(shared_session, "episode", "success", status=1)
    assert (denied["ok"], denied["reason"]) == (False, "episode_state")


def test_unknown_participant_or_robot_is_named(shared_session: SessionProcess, ann: Client) -> None:
    code, _, errors = run_in_process("assign", "left", "unknown", "--address", shared_session.address)
    assert code == 2
    assert "'unknown'" in errors
    assert f"ann ({ann.participant_id})" in errors
    assert run_control(shared_session, "release", "elbow", status=1)["reason"] == "unknown_target"


def test_participants_get_names_and_roles(shared_session: SessionProcess, ann: Client) -> None:
    assert run_control(shared_session, "rename", "ann", "eva")["name"] == "eva"
    assert ann.wait_for(lambda c: c.mirror.participants[c.participant_id].name == "eva", DEADLINE_S)
    with Client(shared_session.address, name="bob", role="observer").connect(DEADLINE_S) as bob:
        bob.start()
        assert run_control(shared_session, "rename", bob.participant_id, "eva")["name"] == "eva-2"
    assert run_control(shared_session, "role", "eva", "director")["role"] == "director"
    assert ann.wait_for(lambda c: c.mirror.participants[c.participant_id].role == "director", DEADLINE_S)
    ann.assign("left", ann.participant_id)
    run_control(shared_session, "role", ann.participant_id, "observer")
    assert ann.wait_for(lambda c: not c.mirror.leases["left"].holder, DEADLINE_S)
    assert run_control(shared_session, "role", "nobody", "observer", status=2)["ok"] is False


def test_ambiguous_participant_name_lists_the_ids(shared_session: SessionProcess, ann: Client) -> None:
    with Client(shared_session.address, name="ann", role="agent").connect(DEADLINE_S) as second:
        code, _, errors = run_in_process("assign", "left", "ann", "--address", shared_session.address)
        assert code == 2
        assert ann.participant_id in errors
        assert second.participant_id in errors


def test_a_reason_needs_no_quotes_and_is_no_address(shared_session: SessionProcess) -> None:
    assert run_control(shared_session, "estop", "hand", "in", "the", "way")["estop"] is True
    assert run_control(shared_session, "clear-estop")["cleared"][0]["reason"] == "hand in the way"
    for address in ("192.168.0.10", "lab-1:7721", "iris://lab-1"):
        assert run_control(shared_session, "estop", address, status=2)["ok"] is False


def test_estop_reaches_a_session_that_is_full() -> None:
    limits = AuthorityConfig(max_participants=1)
    config = SessionConfig(host=make_loopback_address(), control_port=0, state_port=0, authority=limits)
    with Session(scene_path("handover"), config=config) as session, ThreadPoolExecutor() as pool:
        stop = threading.Event()
        running = pool.submit(lambda: [session.run(seconds=0.05) for _ in iter(stop.is_set, True)])
        try:
            with Client(session.address, name="ann", role="observer").connect(DEADLINE_S).start() as ann:
                code, _, errors = run_in_process("estop", "--address", session.address)
                assert code == 1
                assert "sent" in errors
                assert ann.wait_for(lambda c: c.mirror.estop, DEADLINE_S)
        finally:
            stop.set()
            running.result()


def test_no_session_is_one_line() -> None:
    code, _, errors = run_in_process("estop", "--address", "127.0.0.1:1")
    assert code == 2
    assert len(errors.splitlines()) == 1


def test_keys_of_the_terminal_stop_and_clear(tmp_path: Path) -> None:
    """Space stops; after Ctrl-C the terminal is as it was before."""
    parent, terminal = pty.openpty()
    before = termios.tcgetattr(terminal)
    screen = b""

    def read_screen() -> bytes:
        nonlocal screen
        while True:
            try:
                screen += os.read(parent, 65536)
            except BlockingIOError:
                return screen

    os.set_blocking(parent, False)
    command = make_serve_command("handover", tmp_path / "session.rrd", "--no-beacon")
    process = subprocess.Popen(
        ["setsid", "--ctty", *command], stdin=terminal, stdout=terminal, stderr=terminal, cwd=tmp_path
    )
    try:
        wait_until(lambda: b"space e-stop" in read_screen(), "the footer is shown")
        os.write(parent, b" ")
        wait_until(lambda: b"E-STOP" in read_screen(), "the e-stop is shown")
        os.write(parent, b"c")
        wait_until(lambda: b"running" in read_screen().rpartition(b"E-STOP")[2], "it is cleared")
        termios.tcsetattr(terminal, termios.TCSANOW, before)  # as a shell does after Ctrl-Z
        wait_until(lambda: not termios.tcgetattr(terminal)[3] & termios.ICANON, "keys count without Enter again")
        os.write(parent, b" ")
        wait_until(lambda: b"E-STOP" in read_screen().rpartition(b"running")[2], "the e-stop is shown again")
        os.write(parent, b"\x03")
        wait_until(lambda: read_screen() is not None and process.poll() is not None, "the session ends")
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, read_screen().decode(errors="replace")
    assert termios.tcgetattr(terminal) == before
    os.close(parent)
    os.close(terminal)


@pytest.mark.long
def test_background_session_does_not_read_the_terminal(tmp_path: Path) -> None:
    """A process of a background group that reads its terminal would be stopped by the system."""
    parent, terminal = pty.openpty()
    script = 'set -m; "$@" & wait'  # -m: a process group of its own, so not in the foreground
    command = make_serve_command("handover", tmp_path / "session.rrd", "--no-beacon", "--seconds", "1")
    process = subprocess.Popen(
        ["setsid", "--ctty", "bash", "-c", script, "bash", *command],
        stdin=terminal, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=tmp_path,
    )  # fmt: skip
    try:
        assert process.wait(DEADLINE_S) == 0
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
        os.close(parent)
        os.close(terminal)
