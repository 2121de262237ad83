"""Settings that cannot work are refused with what would be right."""

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


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"name": "a/b"}, "letters, digits"),
        ({"name": ""}, "letters, digits"),
        ({"name": "x" * 49}, "1 to 48"),
        ({"control_port": -1}, "control_port -1 is not a port"),
        ({"state_port": 65536}, "state_port 65536"),
        ({"beacon_port": 70000}, "beacon_port 70000"),
        ({"advertise": "lab:pc/7"}, "an address without port"),
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


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"name": 5}, "name must be str, not int 5"),
        ({"control_port": "7721"}, "control_port must be int"),
        ({"state_hz": True}, "state_hz must be float"),
        ({"record": 3}, r"record must be bool \| str \| Path"),
        ({"interfaces": "eth0"}, "interfaces must be tuple"),
        ({"authority": ControlConfig()}, "authority must be AuthorityConfig, not ControlConfig"),
        ({"anchors": {"a": (0.0, 0.0, 0.0)}}, r"anchor 'a': .* must be T_world_anchor as"),
        ({"anchors": {"a": ((0.0, 0.0), (1.0, 0.0, 0.0, 0.0))}}, "must be T_world_anchor as"),
        ({"anchors": {"a": ((0.0, 0.0, math.nan), (1.0, 0.0, 0.0, 0.0))}}, "not finite"),
        ({"anchors": {"a": ((0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0))}}, "has length 1.41, it must be 1"),
        ({"anchor_sizes": {"b": 0.16}}, "no anchor 'b': 'table'"),
        ({"anchor_sizes": {"table": 160}}, "160 is not the edge of a printed sheet in metres"),
        ({"anchor_sizes": {"table": "16 cm"}}, "not the edge"),
    ],
)
def test_wrong_types_and_anchors_say_what_is_right(fields: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        SessionConfig(**fields)


def test_the_size_of_the_default_sheet_is_known_and_that_of_others_when_it_is_given() -> None:
    door = {"door": ((1.2, 0.0, 0.4), (1.0, 0.0, 0.0, 0.0))}
    assert SessionConfig().sheet_sizes() == {"table": 0.16}
    assert SessionConfig(anchor_sizes={"table": 0.2}).sheet_sizes() == {"table": 0.2}
    assert SessionConfig(anchors=door).sheet_sizes() == {}
    assert SessionConfig(anchors=door, anchor_sizes={"door": 1}).sheet_sizes() == {"door": 1.0}


def test_what_is_no_scene_says_what_is_right() -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    other = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    for arguments, error, text in (
        ((mujoco.MjSpec(),), TypeError, "call its compile"),
        ((model, SessionConfig()), TypeError, "data must be MjData"),
        ((model, None, {"name": "x"}), TypeError, "config must be a SessionConfig, not dict"),
        ((model, mujoco.MjData(other)), ConfigError, "data is of another model: it has 7 positions"),
    ):
        with pytest.raises(error, match=text):
            Session(*arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"objects": ["hammer"]}, r"^objects\[0\] is 'hammer': a list of ObjectSpec .*ObjectSpec\(name="),
        ({"objects": "hammer"}, "^objects is 'hammer': a list of ObjectSpec is expected"),
        (
            {"objects": [RobotSpec("left", (), (), "tcp", "base")]},
            r"^objects\[0\] is RobotSpec.*ObjectSpec is expected",
        ),
        ({"robots": ["left"]}, r"^robots\[0\] is 'left': a list of RobotSpec is expected; load_robots_toml"),
        ({"robots": "robots.toml"}, "^robots is 'robots.toml': .*load_robots_toml"),
        ({"robots": Path("robots.toml")}, "^robots is .*load_robots_toml"),
        ({"robots": {"name": "left"}}, "^robots is .*a list of RobotSpec is expected"),
        ({"robots": 5}, "^robots is 5: a list of RobotSpec is expected"),
        ({"robots": [RobotSpec("left", "joint1", (), "tcp", "base")]}, r"^robots\[0\] is a RobotSpec .*joints"),  # type: ignore[arg-type]
    ],
)
def test_what_are_no_robots_or_objects_says_what_is_right(given: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text) as caught:
        Session(mujoco.MjModel.from_xml_string("<mujoco/>"), **given)
    assert "\n" not in str(caught.value)


def test_recording_without_rerun_is_said_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "rerun" else find(name))
    config = SessionConfig(control_port=0, state_port=0, record=tmp_path / "x.rrd")
    with pytest.raises(StartError, match=r"iris-session\[recording\]"):
        Session(mujoco.MjModel.from_xml_string("<mujoco/>"), config=config).start()
