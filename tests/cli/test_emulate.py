"""`iris-session emulate`: what it refuses before anybody joins."""

from __future__ import annotations

import pytest

from iris_session.cli.main import main


@pytest.mark.parametrize("option", [("--drift", "30"), ("--bump-at", "20"), ("--glance-every", "5")])
def test_what_is_for_nameless_people_is_refused_beside_named_ones(
    option: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["emulate", "127.0.0.1:1", "--headset", "name=ann", *option]) == 2
    assert "model.drift_m_per_min" in capsys.readouterr().err
