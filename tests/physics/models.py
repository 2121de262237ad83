"""MJCF text for the physics tests: boxes with many contacts, and every arm that `find_robots` distinguishes."""

from __future__ import annotations

import mujoco

GRIPPER_TENDON = """
  <tendon><fixed name="split"><joint joint="finger_l" coef=".5"/><joint joint="finger_r" coef=".5"/></fixed></tendon>
"""


def model(xml: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(xml)


def clutter(integrator: str = "implicitfast", option: str = "", flag: str = "") -> mujoco.MjModel:
    """A two-joint arm (position and motor) beside falling boxes, a mocap body, an equality that can be switched."""
    boxes = "".join(
        f'<body name="box{i}" pos="{0.1 * i} {0.03 * i} {0.3 + 0.12 * i}"><freejoint/>'
        f'<geom type="box" size=".05 .04 .03" euler="{10 * i} 20 30"/></body>'
        for i in range(5)
    )
    return model(f"""<mujoco><size nuserdata="3"/><option integrator="{integrator}" {option}>{flag}</option><worldbody>
      <geom type="plane" size="2 2 .1"/>
      <body name="arm" pos="0 0 .6"><joint name="a" axis="0 1 0" damping=".1"/>
        <geom type="capsule" fromto="0 0 0 .4 0 0" size=".03"/>
        <body name="fore" pos=".4 0 0"><joint name="b" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/></body></body>
      {boxes}
      <body name="pusher" mocap="true" pos="-1 0 .1"><geom type="sphere" size=".1"/></body>
    </worldbody>
    <equality><weld name="glue" body1="box0" body2="box1" active="false"/></equality>
    <actuator><position joint="a" kp="50"/><general joint="b" dyntype="filter" dynprm=".05"/></actuator></mujoco>""")


def arm(
    name: str = "",
    joints: int = 4,
    end: str = '<site name="{p}tcp"/>',
    site_before: str = "",
    joint_name: str = "{p}j{i}",
    actuator: str = "position",
) -> tuple[str, str]:
    """(body, actuators) MJCF of a serial arm; `end` goes inside its last link. Names get the prefix `name/`."""
    prefix = f"{name}/" if name else ""
    body = end.format(p=prefix)
    for i in reversed(range(joints)):
        before = site_before.format(p=prefix) if i == joints - 2 else ""
        body = (
            f'<body name="{prefix}link{i}" pos="0 0 .1"><joint name="{joint_name.format(p=prefix, i=i)}" '
            f'axis="0 {i % 2} {1 - i % 2}" range="-2 2"/><geom type="capsule" size=".02" fromto="0 0 0 0 0 .1"/>'
            f"{before}{body}</body>"
        )
    actuators = "".join(
        f'<{actuator} name="{prefix}a{i}" joint="{joint_name.format(p=prefix, i=i)}" ctrlrange="-2 2"/>'
        for i in range(joints)
    )
    return f'<body name="{prefix}base">{body}</body>', actuators


FINGERS = """<site name="{p}pinch" pos="0 0 .15"/><body name="{p}hand" pos="0 0 .1">
  <geom type="box" size=".03 .05 .01"/>
  <body name="{p}left_pad" pos="0 0 .05"><joint name="{p}finger_l" type="slide" axis="0 1 0" range="0 .04"/>
    <geom type="box" size=".01 .01 .02"/></body>
  <body name="{p}right_pad" pos="0 0 .05"><joint name="{p}finger_r" type="slide" axis="0 -1 0" range="0 .04"/>
    <geom type="box" size=".01 .01 .02"/></body></body>"""


def scene(bodies: str, actuators: str, extra: str = "", name: str = "") -> mujoco.MjModel:
    title = f' model="{name}"' if name else ""
    return model(
        f"<mujoco{title}><compiler angle='radian'/><worldbody><geom name='floor' type='plane' size='2 2 .1'/>"
        f"{bodies}</worldbody>{extra}<actuator>{actuators}</actuator></mujoco>"
    )
