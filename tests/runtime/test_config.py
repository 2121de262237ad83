"""Settings that cannot work are refused with what would be right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from iris_session import ConfigError, SessionConfig, SessionError


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"name": "a/b"}, "letters, digits"),
        ({"name": ""}, "letters, digits"),
        ({"name": "x" * 49}, "1 to 48"),
        ({"control_port": -1}, "control_port -1 is not a port"),
        ({"state_port": 65536}, "state_port 65536"),
        ({"state_hz": 0.5}, "1 to 240"),
        ({"state_hz": float("nan")}, "1 to 240"),
        ({"keyframe_s": 0.0}, "0.5 to 60"),
    ],
)
def test_values_out_of_range(settings: dict[str, Any], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected) as caught:
        SessionConfig(**settings)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, SessionError)


def test_where_it_records_to() -> None:
    assert SessionConfig(record=False).recording_path() is None
    assert SessionConfig(record="a/b.rrd").recording_path() == Path("a/b.rrd")
    path = SessionConfig(name="lab").recording_path()
    assert path is not None
    sessions, folder, name = path.parts
    assert (sessions, name) == ("sessions", "session.rrd")
    assert folder.endswith("Z-lab")
    assert folder[:8].isdigit()


def test_defaults_listen_on_loopback_only() -> None:
    assert SessionConfig().host == "127.0.0.1"
