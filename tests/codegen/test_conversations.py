"""docs/protocol/conversations.json: the client core behaves as the file states, and the file covers its behaviour."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from iris_session.client.core import connection
from tools.codegen.conversations import AssetPlayer, ConversationPlayer

FILE = Path(__file__).parents[2] / "docs" / "protocol" / "conversations.json"
CONVERSATIONS: list[dict[str, Any]] = json.loads(FILE.read_text())["conversations"]
OUTCOMES = ("sent", "inbox", "replies", "state", "outcome", "idle")


def play(conversation: dict[str, Any]) -> None:
    """Play a conversation against the core; every outcome must be that of the file."""
    if conversation["core"] == "asset loader":
        player: AssetPlayer | ConversationPlayer = AssetPlayer()
    else:
        player = ConversationPlayer(conversation["secret"], conversation["resume_token"])
    for number, step in enumerate(conversation["steps"]):
        expected = {name: step[name] for name in OUTCOMES if name in step}
        given = {name: value for name, value in step.items() if name not in OUTCOMES}
        assert json.loads(json.dumps(player.play_step(given))) == expected, (
            f"{conversation['name']}, step {number}: {step['do']}"
        )


@pytest.mark.parametrize("conversation", CONVERSATIONS, ids=lambda conversation: conversation["name"])
def test_core_plays_the_conversation(conversation: dict[str, Any]) -> None:
    play(conversation)


def test_conversations_cover_required_behaviour() -> None:
    phases = {step["state"]["phase"] for each in CONVERSATIONS for step in each["steps"] if "state" in step}
    assert phases == {"joining", "syncing", "ready", "waiting", "refused", "closed"}
    times = [[step["at_ns"] for step in each["steps"]] for each in CONVERSATIONS]
    assert all(each == sorted(each) for each in times), "time never goes back"


def play_all() -> None:
    for conversation in CONVERSATIONS:
        play(conversation)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("HELLO_TIMEOUT_NS", 2_000_000_000),
        ("BACKOFF_MIN_NS", 200_000_000),
        ("SNAPSHOT_RETRY_NS", 100_000_000),
        ("RETRYABLE_REFUSALS", frozenset()),
        ("STEADY_NS", 10_000_000_000),
        ("SILENT_HEARTBEATS", 0),
        ("encode_client", lambda _: b""),
    ],
)
def test_changed_behaviour_is_detected(name: str, value: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, name, value)
    with pytest.raises(AssertionError):
        play_all()
