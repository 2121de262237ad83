"""`iris-session estop`, `pause`, `assign`, `status`, ...: a running session controlled from another terminal."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from iris_session import AuthorityConfig
from iris_session.client import Client
from iris_session.protocol.server_messages import MarkerAdded
from tests.rig.session import ADDRESS, Rig


class Terminal:
    """A session, its participant ann, and a terminal beside them."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.ann = rig.join("ann", "agent")

    def run(self, command: str, *arguments: str, status: int = 0) -> dict[str, Any]:
        """Return the JSON object of a control command, which must end with `status`."""
        code, out, errors = self.rig.run_command(command, *arguments, "--address", ADDRESS, "--json")
        assert code == status, (out, errors)
        self.rig.run(0.1)  # until ann has heard of it
        result: dict[str, Any] = json.loads(out) if out else {}
        return result


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    with Rig(timestep=0.01) as rig:
        yield Terminal(rig)


def holder(client: Client, robot: str) -> str:
    return client.mirror.leases[robot].holder


def test_estop_is_set_and_cleared(terminal: Terminal) -> None:
    """A reason needs no quotes, and is no address."""
    assert terminal.run("estop", "hand", "in", "the", "way")["estop"] is True
    assert terminal.ann.mirror.estop
    assert terminal.run("clear-estop")["cleared"][0]["reason"] == "hand in the way"
    assert not terminal.ann.mirror.estop
    assert terminal.run("clear-estop")["cleared"] == []
    for address in ("192.168.0.10", "lab-1:7721", "iris://lab-1"):
        assert terminal.run("estop", address, status=2)["ok"] is False


def test_physics_is_paused_and_continued_and_reset(terminal: Terminal) -> None:
    terminal.run("pause")
    assert terminal.ann.mirror.paused
    terminal.run("resume")
    assert not terminal.ann.mirror.paused
    epoch = terminal.ann.mirror.scene_epoch
    terminal.run("reset")
    assert terminal.ann.mirror.scene_epoch == epoch + 1


def test_robots_are_assigned_and_released(terminal: Terminal) -> None:
    ann = terminal.ann
    assert terminal.run("assign", "left,right", "ann")["robots"] == ["left", "right"]
    assert holder(ann, "right") == ann.participant_id
    terminal.run("release", "left", "right")
    assert not holder(ann, "left")
    assert terminal.run("mode", "takeover", "left")["robots"] == ["left"]
    assert ann.mirror.leases["left"].mode == "takeover"
    terminal.run("mode", "exclusive")
    assert ann.mirror.leases["left"].mode == "exclusive"


def test_episodes_and_markers_are_events(terminal: Terminal) -> None:
    begun = terminal.run("episode", "start", "--label", "pour")
    assert (begun["state"], begun["number"], begun["label"]) == ("running", 1, "pour")
    assert terminal.run("episode", "stop")["state"] == "closing"
    assert terminal.run("episode", "success")["state"] == "success"
    assert terminal.run("episode", "start", "--countdown", "0")["number"] == 2
    again = terminal.run("episode", "rerecord")
    assert (again["state"], again["number"]) == ("countdown", 2)
    assert terminal.run("episode", "discard")["state"] == "cancelled"
    terminal.run("marker", "gripper was cleaned")
    notes = [e.body.text for e in terminal.rig.events["ann"] if isinstance(e.body, MarkerAdded)]
    assert "gripper was cleaned" in notes
    denied = terminal.run("episode", "success", status=1)
    assert (denied["ok"], denied["reason"]) == (False, "episode_state")


def test_unknown_or_ambiguous_participant_and_unknown_robot_are_named(terminal: Terminal) -> None:
    second = terminal.rig.join("ann", "agent")
    for name in ("unknown", "ann"):
        code, _, errors = terminal.rig.run_command("assign", "left", name, "--address", ADDRESS)
        assert code == 2
        assert f"'{name}'" in errors
        assert terminal.ann.participant_id in errors
        assert second.participant_id in errors
    assert terminal.run("release", "elbow", status=1)["reason"] == "unknown_target"


def test_participants_get_names_and_roles(terminal: Terminal) -> None:
    ann = terminal.ann
    assert terminal.run("rename", "ann", "eva")["name"] == "eva"
    assert ann.mirror.participants[ann.participant_id].name == "eva"
    bob = terminal.rig.join("bob", "observer")
    assert terminal.run("rename", bob.participant_id, "eva")["name"] == "eva-2"
    assert terminal.run("role", "eva", "director")["role"] == "director"
    assert ann.mirror.participants[ann.participant_id].role == "director"
    ann.assign("left", ann.participant_id)
    terminal.run("role", ann.participant_id, "observer")
    assert not holder(ann, "left")
    assert terminal.run("role", "nobody", "observer", status=2)["ok"] is False


def test_status_has_participants_and_holders(terminal: Terminal) -> None:
    terminal.ann.acquire(["left"])
    code, text, _ = terminal.rig.run_command("status", ADDRESS)
    assert code == 0
    assert "ann" in text
    report = json.loads(terminal.rig.run_command("status", ADDRESS, "--json")[1])
    assert {robot["name"]: robot["holder_name"] for robot in report["robots"]} == {"left": "ann", "right": ""}
    assert {p["name"] for p in report["participants"]} >= {"ann", "status"}
    metrics = terminal.rig.run_command("status", ADDRESS, "--prometheus")[1]
    assert 'iris_session_robot_held{robot="right",holder=""} 0' in metrics
    assert "iris_session_stalled 0" in metrics


def test_status_of_a_session_that_stands_still_is_stalled(terminal: Terminal) -> None:
    terminal.rig.stop_loop(60.0)
    terminal.rig.run(1.0)
    code, text, _ = terminal.rig.run_command("status", ADDRESS)
    assert code == 0
    assert "STALLED" in text.splitlines()[0]


def test_estop_reaches_a_session_that_is_full() -> None:
    with Rig(timestep=0.01, authority=AuthorityConfig(max_participants=1)) as rig:
        ann = rig.join("ann", "observer")
        code, _, errors = rig.run_command("estop", "--address", ADDRESS)
        assert code == 1
        assert "sent" in errors
        rig.run(0.1)
        assert ann.mirror.estop


def test_no_session_is_one_line_that_names_the_address() -> None:
    with Rig(timestep=0.01) as rig:
        rig.kill_front()
        for command in (("estop", "--address", ADDRESS), ("status", ADDRESS)):
            rig.stop_loop(60.0)  # nobody replaces the front
            code, _, errors = rig.run_command(*command)
            assert code == 2
            assert ADDRESS in errors
            assert len(errors.splitlines()) == 1
