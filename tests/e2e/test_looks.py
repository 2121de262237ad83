"""Recordings of real sessions in Rerun's viewer, checked by `tools/look_at_recordings.py`, and in its dataframes."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from iris_session.rrd.file import scan_file
from tests.e2e import session_program
from tests.e2e.scenario import Scenario
from tests.e2e.session_process import (
    COMMAND,
    DEADLINE_S,
    DEMO_OPTIONS,
    DEMO_S,
    SessionProcess,
    kill_all,
    run_command,
    skip_unless_ci,
    wait_until,
)
from tests.loopback import make_loopback_address
from tests.recording.dataframes import compare_dataframes
from tools.look_at_recordings import MissingViewerError, check_file, look_at

pytestmark = [pytest.mark.e2e, pytest.mark.long, pytest.mark.timeout(DEMO_S + 120.0)]


def assert_looks_right(path: Path) -> None:
    """Look at a recording; skip the test, or fail in CI, without a driver."""
    try:
        look = look_at(path)
    except MissingViewerError as error:
        skip_unless_ci(str(error))
        raise
    assert not look.problems, look


class Sessions(NamedTuple):
    """Recordings of two sessions. `killed`: of one whose recorder and authority were killed; `resumed` continues it."""

    eventful: Path
    killed: Path
    resumed: Path


def start(folder: Path) -> SessionProcess:
    """Start a session that loads and patches scenes on command."""
    folder.mkdir()
    recording = folder / "session.rrd"
    program = [sys.executable, session_program.__file__, make_loopback_address()]
    return SessionProcess(folder, recording, [*program, str(recording), str(folder)])


def play_eventful(scenario: Scenario) -> None:
    """Play an e-stop, a takeover, an operator that leaves, a patch, a reset, and a second scene."""
    server = scenario.server

    def command(scene: str, answer: str) -> None:
        (server.folder / scene).touch()
        scenario.run_until(lambda: answer in server.output, f"the session answers {answer!r}")

    director = scenario.join("dora", "director")
    hand = scenario.drive("ann", "left", (0.0, 0.03, 0.0))
    scenario.run_for(0.5)
    hand.client.estop("a person is near")
    scenario.run_until(lambda: director.mirror.estop, "the e-stop")
    director.clear_estop()
    scenario.run_until(lambda: not director.mirror.estop, "the end of the e-stop")
    director.set_mode("left", "takeover")
    scenario.hands.remove(hand)
    other = scenario.drive("bob", "left", (0.0, -0.03, 0.0))
    scenario.clients.remove(hand.client)
    hand.client.close()
    command("patch", "patched")
    scenario.run_for(0.5)
    director.control("reset")
    other.velocity = (0.0, 0.0, 0.0)
    scenario.engage(other)
    command("table", "loaded")
    scenario.run_until(lambda: director.mirror.scene_epoch >= 3, "the second scene")
    scenario.run_for(1.0)


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sessions]:
    base = tmp_path_factory.mktemp("sessions")
    servers = [start(base / "eventful"), start(base / "killed")]
    scenarios = [Scenario(server) for server in servers]
    try:
        play_eventful(scenarios[0])
        servers[0].finish()
        killed = scenarios[1]
        killed.drive("ann", "left", (0.0, 0.03, 0.0))
        killed.run_for(1.0)
        killed.run_until(killed.server.count_recorded_rows, "the recorder has written rows")
        killed.server.children()["recording.process"].kill()  # the next rows are in a part of their own
        killed.run_until((killed.server.folder / "session.part2.rrd").exists, "the next part of the recording")
        killed.run_for(1.0)
        killed.server.kill()
        resumed = killed.server.folder / "session.resume2.rrd"
        command = [*COMMAND, "serve", "--resume", str(killed.server.folder)]
        servers.append(SessionProcess(killed.server.folder, resumed, command))
        killed.run_until(
            lambda: killed.clients[0].ready and "participant_joined   ann" in servers[-1].output, "ann is back"
        )
        killed.run_for(1.0)
        servers[-1].finish()
        for path in (servers[0].recording, resumed):
            # It is written when a processor has nothing else to do.
            wait_until(lambda path=path: scan_file(path).indexed, f"{path} has its index", 3 * DEADLINE_S)  # type: ignore[misc]
        yield Sessions(servers[0].recording, servers[1].recording, resumed)
    finally:
        for scenario in scenarios:
            scenario.close()
        kill_all(servers)


def test_eventful_session_is_seen_without_errors(sessions: Sessions) -> None:
    """The file itself, too, is whole for Rerun's tools."""
    assert not [*check_file(sessions.eventful)]
    assert_looks_right(sessions.eventful)


def test_dataframes_of_rerun_have_every_row_of_an_eventful_session(sessions: Sessions) -> None:
    n, problems = compare_dataframes(sessions.eventful)
    assert not problems
    assert n > 10_000


def test_killed_session_is_seen_without_errors(sessions: Sessions, tmp_path: Path) -> None:
    """Both parts, without the recording that continues it."""
    for name in ("session.rrd", "session.part2.rrd"):
        (tmp_path / name).write_bytes((sessions.killed.parent / name).read_bytes())
    assert_looks_right(tmp_path / "session.rrd")


def test_resumed_session_is_seen_without_errors(sessions: Sessions) -> None:
    assert_looks_right(sessions.resumed)


def test_session_that_was_cut_in_a_message_is_seen_without_errors(sessions: Sessions, tmp_path: Path) -> None:
    message = max(scan_file(sessions.eventful).messages[40:], key=lambda one: one.length)
    path = tmp_path / "session.rrd"
    path.write_bytes(sessions.eventful.read_bytes()[: message.offset + message.length // 2])
    assert [*check_file(path)], "it is damaged"
    assert_looks_right(path)


@pytest.mark.parametrize("demo", ["handover", "aloha", "panda", "soft", "cloth"])
def test_demos_are_seen_without_errors(demo: str, tmp_path: Path) -> None:
    done = run_command("demo", demo, *DEMO_OPTIONS, cwd=tmp_path, timeout_s=DEMO_S)
    assert done.stdout, done.stderr[-3000:]
    # Whether its operators succeeded does not matter here.
    recording = Path(tmp_path, json.loads(done.stdout)["recording"])
    assert_looks_right(recording)
    n, problems = compare_dataframes(recording)
    assert not problems
    assert n > 10_000
