"""Invalid settings raise errors that name the argument."""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path
from typing import Any

import mujoco
import pytest

from iris_session import ConfigError, Session, SessionConfig, SessionError, StartError
from iris_session.control import ControlConfig
from iris_session.protocol.specs import RobotSpec
from iris_session.session.config import DEFAULT_SHEET_M


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"name": "a/b"}, "letters, digits"),
        ({"name": "x" * 49}, "1 to 48"),
        ({"control_port": -1}, "control_port -1"),
        ({"advertise": "lab:pc/7"}, "advertise"),
        ({"state_hz": 0.5}, "1 to 240"),
        ({"state_hz": float("nan")}, "1 to 240"),
        ({"keyframe_s": 0.0}, "0.5 to 60"),
        ({"record_clouds_hz": 61.0}, "record_clouds_hz 61.0 is out of range: 0.01 to 60, or 0"),
        ({"record_assets": "some"}, "record_assets 'some' is none of none, scene, all"),
        ({"record_budget_bytes": 15_999_999}, "record_budget_bytes 15999999 is too small: give 16000000 or more, or 0"),
        ({"name": 5}, "name"),
        ({"control_port": "7721"}, "control_port"),
        ({"state_hz": True}, "state_hz"),
        ({"interfaces": "eth0"}, "interfaces"),
        ({"authority": ControlConfig()}, "authority"),
        ({"anchors": {"a": ((0.0, 0.0), (1.0, 0.0, 0.0, 0.0))}}, "anchor 'a'"),
        ({"anchors": {"a": ((0.0, 0.0, math.nan), (1.0, 0.0, 0.0, 0.0))}}, "not finite"),
        ({"anchors": {"a": ((0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0))}}, "1.41"),
        ({"anchor_sizes": {"b": 0.16}}, "'b'"),
        ({"anchor_sizes": {"table": 160}}, "160"),
        ({"anchor_sizes": {"table": "16 cm"}}, "16 cm"),
    ],
)
def test_settings_that_cannot_be_used_are_named(settings: dict[str, Any], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected) as caught:
        SessionConfig(**settings)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, SessionError)


def test_recording_path() -> None:
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


def test_sheet_size_is_known_for_the_default_and_given_ones() -> None:
    door = {"door": ((1.2, 0.0, 0.4), (1.0, 0.0, 0.0, 0.0))}
    assert SessionConfig().sheet_sizes() == {"table": DEFAULT_SHEET_M}
    assert SessionConfig(anchor_sizes={"table": 0.2}).sheet_sizes() == {"table": 0.2}
    assert SessionConfig(anchors=door).sheet_sizes() == {}
    assert SessionConfig(anchors=door, anchor_sizes={"door": 1}).sheet_sizes() == {"door": 1.0}


def test_invalid_scene_is_named() -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    other = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    for arguments, error, text in (
        ((mujoco.MjSpec(),), TypeError, "compile"),
        ((model, SessionConfig()), TypeError, "data"),
        ((model, None, {"name": "x"}), TypeError, "config"),
        ((model, mujoco.MjData(other)), ConfigError, "data .*7"),
    ):
        with pytest.raises(error, match=text):
            Session(*arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"objects": ["hammer"]}, r"^objects\[0\] is 'hammer'.*ObjectSpec"),
        (
            {"objects": [RobotSpec("left", (), (), "tcp", "base")]},
            r"^objects\[0\] is RobotSpec.*ObjectSpec",
        ),
        ({"robots": ["left", 3]}, r"^robots\[0\] is 'left'.*RobotSpec"),
        ({"robots": {"left": 3}}, r"^robots is \{'left': 3\}: .*RobotSpec"),
        ({"robots": ["left"]}, r"^robots: 'left' does not exist in the model. Available robots: none"),
        ({"robots": [RobotSpec("left", "joint1", (), "tcp", "base")]}, r"^robots\[0\] is a RobotSpec .*joints"),  # type: ignore[arg-type]
    ],
)
def test_invalid_robots_or_objects_are_named(given: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text) as caught:
        Session(mujoco.MjModel.from_xml_string("<mujoco/>"), **given)
    assert "\n" not in str(caught.value)


def test_recording_without_rerun_is_an_error_at_start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "rerun" else find(name))
    config = SessionConfig(control_port=0, state_port=0, record=tmp_path / "x.rrd")
    with pytest.raises(StartError, match=r"iris-session\[recording\]"):
        Session(mujoco.MjModel.from_xml_string("<mujoco/>"), config=config).start()
