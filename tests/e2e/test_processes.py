"""Every process of a session is killed in turn; what is wrong with the input is said in one line. Nothing stays."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from anchors.pose import distance
from iris_session.protocol.server_messages import Gap, MarkerAdded
from iris_session.recording.feed import BATCH_ROWS
from tests.e2e.conftest import Hand, Server, Stage, here, iris, none_left, relatives, wait

pytestmark = pytest.mark.e2e


@pytest.fixture
def driving(stage: Stage) -> Hand:
    """Ann moves the left robot."""
    hand = stage.hand(stage.join("ann"), "left")
    hand.client.acquire(["left"])
    stage.engage(hand)
    hand.velocity = (0.0, 0.05, 0.0)
    return hand


def _markers(stage: Stage, name: str) -> str:
    return "\n".join(e.body.text for e in stage.events[name] if isinstance(e.body, MarkerAdded))


def test_a_killed_front_is_replaced_and_everyone_comes_back(stage: Stage, driving: Hand) -> None:
    """Same ports, same leases by resume tokens; the robot holds meanwhile and waits for the clutch."""
    watcher = stage.join("watcher", "observer")
    ann = driving.client
    me, before = ann.participant_id, ann.mirror.leases["left"]
    front = stage.server.children()["front.main"]
    front.kill()
    stage.run(lambda: not ann.connection.is_joined, "ann notices")
    stage.run(lambda: ann.ready and watcher.ready, "everyone is back")
    driving.velocity = (0.0, 0.3, 0.0)  # the hand goes on, clutch closed
    assert ann.participant_id == me
    after = ann.mirror.leases["left"]
    assert after.holder == me
    assert after.lease_version > before.lease_version
    # Nobody was connected at that moment: the owner's terminal and the recording tell it.
    stage.run(lambda: "the front process ended and was replaced" in stage.server.output, "the owner is told")
    assert stage.server.children()["front.main"].pid != front.pid
    stage.seconds(0.5)
    resting = driving.tip
    stage.seconds(0.5)
    assert distance(resting[0], driving.tip[0]) < 1e-3, "the robot must not move before it was clutched again"
    driving.velocity = (0.0, 0.0, 0.0)
    stage.engage(driving)
    stage.server.finish()


def test_a_killed_recorder_goes_on_in_a_next_part(stage: Stage, driving: Hand) -> None:
    """No step waits for it, no row is lost, both parts verify as one recording."""
    watcher = stage.join("watcher", "observer")
    ticks: list[int] = []
    stage.seconds(1.0)
    stage.server.children()["recording.process"].kill()

    def replaced() -> bool:
        assert watcher.scene.state is not None
        if not ticks or ticks[-1] != watcher.scene.state.header.tick:
            ticks.append(watcher.scene.state.header.tick)
        return "recorder ended" in _markers(stage, "watcher") and "recording.process" in stage.server.children()

    stage.run(replaced, "it is replaced")
    assert not any(isinstance(e.body, Gap) for e in stage.events["watcher"]), "no step may have waited"
    part2 = stage.server.recording.with_name("session.part2.rrd")
    stage.run(lambda: part2.exists() and part2.stat().st_size > 100_000, "the next part grows")
    assert stage.following(driving)
    report = stage.server.finish()
    assert report["parts"] == 2
    assert report["finished"]
    assert report["gaps"] == []


def test_a_killed_authority_leaves_a_whole_recording_and_no_process(stage: Stage, driving: Hand) -> None:
    """The front tells the clients and ends, the recorder finishes the file, which verifies up to the end."""
    stage.seconds(1.0)
    assert driving.client.scene.state is not None
    tick = driving.client.scene.state.header.tick
    children = relatives(stage.server.process.pid)
    assert len(children) >= 2
    stage.server.process.kill()
    stage.server.process.wait()
    driving.sending = False
    stage.run(lambda: not driving.client.connection.is_joined, "ann knows that the session is gone")
    none_left(children)
    assert "session_ended" in driving.client.connection.counters.faults
    report = stage.server.verify()
    assert report["finished"]
    # What the feed had not handed over yet ends with the process: at most one batch of it, 20 ms.
    assert report["last_step"] >= tick - 1 - BATCH_ROWS, "what the client saw is in the file, but for one batch"


def test_an_authority_that_stands_still_is_announced(stage: Stage, driving: Hand) -> None:
    """A suspended process: the front says `stalled`, nobody loses a lease, robots hold until clutched again."""
    ann = driving.client
    stage.server.process.send_signal(signal.SIGSTOP)
    try:
        stage.run(lambda: ann.connection.stalled, "the front says that the session stands still")
        before = driving.tip
        stage.seconds(4.0)  # longer than heartbeats may be missing
    finally:
        stage.server.process.send_signal(signal.SIGCONT)
    stage.run(lambda: not ann.connection.stalled, "the session steps again")
    stage.run(lambda: any(isinstance(e.body, Gap) for e in stage.events["ann"]), "the gap is an event")
    stage.seconds(0.5)
    assert distance(before[0], driving.tip[0]) < 5e-3
    assert ann.lease_version("left") is not None
    assert ann.connection.counters.reconnects == 0
    driving.velocity = (0.0, 0.0, 0.0)
    stage.engage(driving)
    stage.server.finish()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_everything_in_order(serve: Callable[..., Server], number: signal.Signals) -> None:
    server = serve("handover", "--json")
    stage = Stage(server)
    ann = stage.join("ann", "observer")
    children = relatives(server.process.pid)
    server.process.send_signal(number)
    wait(lambda: server.process.poll() is not None, "the session ends")
    assert server.process.wait() == 0, server.output
    none_left(children)
    stage.run(lambda: not ann.connection.is_joined, "ann is told")
    stage.close()
    assert server.verify()["finished"]


def test_a_hard_killed_front_and_recorder_at_once(stage: Stage, driving: Hand) -> None:
    for child in stage.server.children().values():
        child.kill()
    stage.run(lambda: not driving.client.connection.is_joined, "ann notices")
    stage.run(lambda: driving.client.ready, "ann is back")
    stage.engage(driving)
    assert stage.server.finish()["parts"] == 2


# --- input that cannot be used ----------------------------------------------------------------------------------------

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
    "bad.xml": "<mujoco><body></mujoco>",
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
        (["nowhere"], "handover"),  # names the packaged scenes
        (["bad.xml"], "bad.xml"),
        (["unknown.xml"], "cube"),
        (["scene.txt"], "scene.txt"),
        (["torque.xml", "--no-record", "--control-port", "0", "--state-port", "0"], "hold"),
        (["handover", "--robots", "missing.toml"], "missing.toml"),
        (["handover", "--robots", "bad.toml"], "bad.toml"),
        (["handover", "--robots", "unknown.toml"], "no_such_joint"),
        (["handover", "--robots", "keys.toml"], "colour"),
        (["handover", "--record", "taken/session.rrd", "--control-port", "0", "--state-port", "0"], "taken"),
        (["handover", "--record", "old.rrd", "--control-port", "0", "--state-port", "0"], "old.rrd"),
        (["handover", "--record", "/proc/nowhere/session.rrd"], "/proc/nowhere"),
        (["handover", "--no-record", "--host", "192.0.2.1", "--curve-key", "missing.key"], "missing.key"),
        (["handover", "--no-record", "--control-port", "70000"], "65535"),
        (["handover", "--name", "no/slash"], "letters"),
    ],
)
def test_input_that_cannot_be_used_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], expected: str
) -> None:
    monkeypatch.chdir(folder)
    status, out, errors = here("serve", *arguments)
    assert status == 2, (out, errors)
    lines = errors.strip().splitlines()
    assert len(lines) == 1, errors
    assert lines[0].startswith("iris-session: ")
    assert expected.lower() in lines[0].lower()
    assert not out.strip()
    _nothing_runs_in(folder)


def test_an_ambiguous_model_prints_a_file_to_edit(folder: Path) -> None:
    done = iris("serve", "ambiguous.xml", "--no-record", cwd=folder)
    assert done.returncode == 2, (done.stdout, done.stderr)
    assert done.stderr.startswith("iris-session: ")
    assert "\n" not in done.stderr.strip()
    toml = folder / "robots.toml"
    toml.write_text(done.stdout.replace('site = ""', 'site = "p2"'))
    assert "# choose one of: p1, p2" in done.stdout
    ports = ["--control-port", "0", "--state-port", "0"]
    edited = iris(
        "serve", "ambiguous.xml", "--robots", str(toml), *ports, "--no-record", "--seconds", "0.1", cwd=folder
    )
    assert edited.returncode == 0, edited.stderr
    assert "robots: arm" in edited.stdout
    _nothing_runs_in(folder)


@pytest.mark.parametrize("option", ["--control-port", "--state-port"])
def test_a_port_in_use_is_one_line(folder: Path, option: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        ports = ["--control-port", "0", "--state-port", "0", option, port]
        done = iris("serve", "handover", "--record", "new.rrd", *ports, cwd=folder)
    assert done.returncode == 2, (done.stdout, done.stderr)
    (line,) = done.stderr.strip().splitlines()
    assert port in line
    _nothing_runs_in(folder)


def _nothing_runs_in(folder: Path) -> None:
    """No process works in this folder any more: children inherit it."""

    def left() -> list[str]:
        found = []
        for process in psutil.process_iter():
            try:
                if process.pid != os.getpid() and process.cwd() == str(folder):
                    found.append(" ".join(process.cmdline()))
            except psutil.Error:
                continue
        return found

    wait(lambda: not left(), f"nothing is left of the command, but {left()}")
