"""Files and bytes to models: every failure is a one-line error with its reason."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from iris_session.physics import ModelInvalidError, ModelNotFoundError, decode_model, encode_model, load_model
from tests.physics.models import clutter

XML = '<mujoco><worldbody><body name="b"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'

URDF = """<robot name="arm"><link name="base"/><link name="upper"/><joint name="j" type="revolute"><parent link="base"/>
<child link="upper"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def test_xml_and_mjb_give_the_same_model(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(XML)
    m = load_model(tmp_path / "scene.xml")
    (tmp_path / "scene.mjb").write_bytes(encode_model(m))
    again = load_model(str(tmp_path / "scene.mjb"))
    assert again.nq == 7
    assert encode_model(again) == encode_model(m)


def test_errors_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "good.xml").write_text(XML)
    (tmp_path / "bad.xml").write_text("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>")
    (tmp_path / "broken.xml").write_text("<mujoco>")
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "robot.stl").write_bytes(b"solid")
    cases = [
        ("gone.xml", ModelNotFoundError, "does not exist; its folder has arm.urdf, bad.xml, broken.xml, good.xml"),
        ("no/where.xml", ModelNotFoundError, "neither does its folder"),
        ("robot.stl", ModelNotFoundError, "must end in one of .xml, .mjcf, .urdf, .mjb"),
        ("bad.xml", ModelInvalidError, "bad.xml: a body moves and has no mass: give it an <inertial>"),
        ("broken.xml", ModelInvalidError, "broken.xml: "),
        ("arm.urdf", ModelInvalidError, "arm.urdf: body 'upper' moves and has no mass: give it an <inertial>"),
    ]
    for name, kind, text in cases:
        with pytest.raises(kind) as caught:
            load_model(tmp_path / name)
        assert text in str(caught.value)
        assert "\n" not in str(caught.value)


def test_damaged_binary_is_a_one_line_error_without_a_log_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """MuJoCo itself prints a warning and writes it into a file in the current folder."""
    good = bytes(encode_model(clutter()))
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    heard: list[str] = []
    mujoco.set_mju_user_warning(heard.append)  # of another program
    try:
        for data, reason in (
            (b"no model at all", "incomplete header|missing header"),
            (bytes(1000), "Model missing header ID"),
            (good[:-100], "Truncated model file"),
            (b"", "failed to load"),
            (good[:12] + b"\xff" + good[13:], "different MuJoCo version"),
        ):
            (tmp_path / "damaged.mjb").write_bytes(data)
            with pytest.raises(ModelInvalidError, match=rf"^damaged.mjb: .*({reason})") as caught:
                load_model(tmp_path / "damaged.mjb")
            assert "\n" not in str(caught.value)
            with pytest.raises(ModelInvalidError, match=reason):
                decode_model(data)
        assert heard == []
        assert mujoco.get_mju_user_warning() == heard.append
    finally:
        mujoco.set_mju_user_warning(None)
    assert capfd.readouterr() == ("", "")
    assert list(here.iterdir()) == []


def test_names_that_are_not_utf_8_are_reported_at_load(tmp_path: Path) -> None:
    """MuJoCo compiles them and would raise when the name is read."""
    path = tmp_path / "latin.xml"
    path.write_bytes(b'<mujoco><worldbody><body name="Z\xf6e"><geom size=".1"/></body></worldbody></mujoco>')
    with pytest.raises(ModelInvalidError, match="as UTF-8"):
        load_model(path)
    path.write_text('<mujoco><worldbody><body name="Zöe"><geom size=".1"/></body></worldbody></mujoco>', "utf-8")
    assert load_model(path).body("Zöe").id == 1
