"""`iris-session emulate`: options that are refused before joining."""

from __future__ import annotations

import pytest

from tests.cli.conftest import CommandLine


@pytest.mark.parametrize("option", [("--drift", "30"), ("--bump-at", "20"), ("--glance-every", "5")])
def test_options_for_unnamed_headsets_exclude_headset(option: tuple[str, str], cli: CommandLine) -> None:
    assert "model.drift_m_per_min" in cli.refuse("emulate", "127.0.0.1:1", "--headset", "name=ann", *option)
