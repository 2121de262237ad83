"""Objects are the named free bodies that nothing drives."""

from __future__ import annotations

import mujoco

from iris_session.physics import World, find_objects
from iris_session.physics.names import body_names, element_id, element_names
from iris_session.protocol.specs import ObjectSpec
from tests.physics.models import arm, model, scene


def test_objects_of_real_scenes(handover: mujoco.MjModel, aloha: mujoco.MjModel, iiwa: mujoco.MjModel) -> None:
    assert find_objects(handover) == (ObjectSpec("hammer", "hammer"), ObjectSpec("board", "board"))
    assert find_objects(aloha) == find_objects(iiwa) == ()


def test_robots_fixed_and_unnamed_bodies_are_no_objects() -> None:
    body, actuators = arm("dog")
    free = body.replace('<body name="dog/base">', '<body name="dog/base"><freejoint/><geom size=".1"/>')
    ball = '<body name="ball"><joint type="free"/><geom size=".1"/></body>'
    scissors = (
        '<body name="scissors"><freejoint/><geom size=".1"/>'
        '<body name="blade"><joint axis="0 0 1"/><geom size=".1"/></body></body>'
    )
    rest = '<body><freejoint/><geom size=".1"/></body><body name="post"><geom size=".1"/></body>'
    long = f'<body name="{"n" * 65}"><freejoint/><geom size=".1"/></body>'
    m = scene(free + ball + scissors + rest + long, actuators)
    assert [o.name for o in find_objects(m)] == ["ball", "scissors"]
    flags = {b.name: b.object for b in World(m, (), find_objects(m)).bodies}
    assert [n for n, is_object in flags.items() if is_object] == ["ball", "scissors"]
    assert "n" * 64 in flags


def test_generated_body_names_are_unique_and_short() -> None:
    bodies = "".join(
        f"<body{name}><geom size='.1'/></body>"
        for name in ("", " name='body_1'", f" name='{'x' * 64}'", f" name='{'x' * 65}'", f" name='{'x' * 66}'", "")
    )
    m = model(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    names = body_names(m)
    assert names == ("world", "body_1~2", "body_1", "x" * 64, "x" * 62 + "~2", "x" * 62 + "~3", "body_6")
    assert element_names(m, "body")[1] == ""
    assert element_id(m, "body", "body_1") == 2
