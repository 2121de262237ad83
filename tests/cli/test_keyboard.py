"""Keys of the terminal of `serve`: what counts as a key, and what is a paste."""

from __future__ import annotations

import pytest

from iris_session.cli.keyboard import KeyBinding, _act


@pytest.mark.parametrize(
    ("typed", "acted"),
    [
        ("c", ["clear"]),
        ("   ", ["stop"]),  # held down
        ("p c", ["stop"]),  # a paste may stop, and never clears or resumes
        ("x", []),
        ("\x1b[A", []),  # an arrow
        ("\x1b[200~ c\x1b[201~", []),
    ],
)
def test_only_single_keys_act(typed: str, acted: list[str]) -> None:
    seen: list[str] = []
    actions = {" ": "stop", "c": "clear", "p": "pause"}
    _act(typed, {key: KeyBinding(text, lambda text=text: seen.append(text)) for key, text in actions.items()})
    assert seen == acted
