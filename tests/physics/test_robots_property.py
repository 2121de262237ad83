"""Property of robot detection: it raises for no model that MuJoCo compiles, and its robots file is accepted."""

from __future__ import annotations

import mujoco
from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.physics import World, find_objects, find_robots, load_robots_toml
from tests.physics.models import model

WORDS = ("", "arm", "left/hip", "thumb", "gripper", "finger", "neck", "é'", "x" * 70)
DRIVES = (
    '<motor joint="{j}"/>',
    '<position joint="{j}" ctrlrange="-1 1"/>',
    '<velocity joint="{j}" name="{j}"/>',
    '<general joint="{j}" dyntype="integrator" gainprm="5" biastype="affine" biasprm="0 -5 0"/>',
    '<muscle joint="{j}" lengthrange="-1 1"/>',
    '<position joint="{j}" ctrlrange="0 0.04"/><motor joint="{j}"/>',
    "",
)
KINDS = ('type="hinge"', 'type="slide"', 'type="ball"')


@st.composite
def trees(draw: st.DrawFn) -> mujoco.MjModel:
    """Return a model with a random tree of bodies, joints, geoms, sites and actuators, named or not."""
    count = draw(st.integers(1, 14))
    children: list[list[int]] = [[] for _ in range(count + 1)]
    for body in range(1, count + 1):
        children[draw(st.integers(max(0, body - 4), body - 1))].append(body)
    drives = ""

    def make(body: int) -> str:
        nonlocal drives
        word = draw(st.sampled_from(WORDS))
        name = f'name="{word}{body}"' if word else ""
        parts = []
        for joint in range(draw(st.integers(0, 2))):
            kind = draw(st.sampled_from(KINDS))
            parts.append(f'<joint name="{word}_{body}_{joint}" {kind} axis="0 {joint} 1" armature=".1"/>')
            if "ball" in kind:
                break
            drives += draw(st.sampled_from(DRIVES)).format(j=f"{word}_{body}_{joint}")
        if not parts and body in children[0] and draw(st.booleans()):
            parts.append("<freejoint/>")
        size = draw(st.sampled_from((0.005, 0.05)))
        parts.append(f'<geom size="{size}" pos="0 0 {size}"/>')
        if draw(st.booleans()):
            parts.append(f'<site pos="0 0 {size}" {name}/>')
        inner = "".join(map(make, children[body]))
        return f'<body {name} pos="0 {size} {2 * size}">{"".join(parts)}{inner}</body>'

    bodies = "".join(map(make, children[0]))
    return model(f"<mujoco><worldbody>{bodies}</worldbody><actuator>{drives}</actuator></mujoco>")


@given(trees())
@settings(max_examples=150, deadline=None)
def test_detection_never_raises_and_its_file_is_accepted(m: mujoco.MjModel) -> None:
    for all_limbs in (False, True):
        found = find_robots(m, all_limbs=all_limbs)
        World(m, found.robots, find_objects(m))
        names = [robot.name for robot in found.robots]
        read = load_robots_toml(found.to_toml(), m)
        assert read[: len(names)] == found.robots
        for notice in found.notices:
            (spec,) = load_robots_toml(notice.toml, m)
            assert spec == notice.spec
