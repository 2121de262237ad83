"""A robot arm as a URDF package: seven joints, a gripper whose second finger follows the first, meshes of three kinds.

Numbers are irregular on purpose: no axis is parallel to another, no origin is upright.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

#: Joint, its type, its limits.
JOINTS = (
    ("turn", "revolute", -2.9, 2.9),
    ("lift", "revolute", -1.8, 1.8),
    ("twist", "continuous", None, None),
    ("bend", "revolute", 0.3, 2.5),
    ("roll", "revolute", -2.0, 2.0),
    ("slide", "prismatic", -0.05, 0.15),
    ("finger_left", "prismatic", 0.0, 0.04),
)
FREE = tuple(name for name, *_ in JOINTS)
_INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
_COMPILER = '<mujoco><compiler meshdir="meshes" discardvisual="false" fusestatic="{fuse}" strippath="true"/></mujoco>'


def write_arm(folder: Path, *, fuse: bool = False) -> Path:
    """Write the package `arm_description` below `folder`; return its URDF."""
    package = folder / "arm_description"
    (package / "meshes").mkdir(parents=True)
    (package / "urdf").mkdir()
    (package / "package.xml").write_text("<package><name>arm_description</name></package>")
    rng = np.random.default_rng(7)
    link = trimesh.creation.capsule(height=0.2, radius=0.04, count=[12, 12])
    link.vertices *= 1 + 0.1 * rng.random(link.vertices.shape)
    link.export(package / "meshes" / "link.stl")
    trimesh.creation.annulus(0.03, 0.06, 0.05).export(package / "meshes" / "ring.obj")
    urdf = package / "urdf" / "arm.urdf"
    urdf.write_text(_robot("true" if fuse else "false"))
    return urdf


def _robot(fuse: str) -> str:
    parts = [_link("base", '<cylinder radius="0.1" length="0.05"/>', "steel", "0.01 0.02 0.025", "0 0 0.3")]
    before = "base"
    for k, (name, kind, low, high) in enumerate(JOINTS[:6]):
        shape = '<mesh filename="package://arm_description/meshes/link.stl" scale="1 0.8 1.2"/>'
        parts.append(_link(f"link{k}", shape, "orange", f"0.0{k} 0 0.1", f"0.{k} 0.2 0"))
        origin = f'<origin xyz="0.0{k} -0.03 0.15" rpy="0.{k} {0.2 - 0.1 * k} {0.3 * k}"/>'
        axis = "0 0.6 0.8" if kind == "prismatic" else f"0.{k + 1} {1 - 0.3 * k} 0.5"
        parts.append(_joint(name, kind, before, f"link{k}", origin, axis, low, high))
        before = f"link{k}"
        if k == 3:  # a fixed sensor, as a link of its own
            parts.append(_link("sensor", '<box size="0.03 0.04 0.05"/>', "steel", "0 0 0", "0 0 0"))
            parts.append(
                _joint("mount", "fixed", before, "sensor", '<origin xyz="0.05 0 0.1" rpy="0.4 0.5 0.6"/>', "1 0 0")
            )
            before = "sensor"
    parts.append(_link("hand", '<mesh filename="../meshes/ring.obj"/>', "steel", "0 0 0", "0 0 0"))
    parts.append(_joint("flange", "fixed", before, "hand", '<origin xyz="0 0 0.1" rpy="0 0 0.7"/>', "1 0 0"))
    for side, sign, mimic in (
        ("left", 1, ""),
        ("right", -1, '<mimic joint="finger_left" multiplier="0.5" offset="0.01"/>'),
    ):
        parts.append(_link(f"finger_{side}", '<sphere radius="0.02"/>', "", "0 0 0.03", "0 0 0"))
        origin = f'<origin xyz="0 {0.02 * sign} 0.05" rpy="0 0 0"/>'
        parts.append(
            _joint(f"finger_{side}", "prismatic", "hand", f"finger_{side}", origin, f"0 {sign} 0", 0.0, 0.04, mimic)
        )
    materials = (
        '<material name="steel"><color rgba="0.6 0.6 0.7 1"/></material>'
        '<material name="orange"><color rgba="0.9 0.5 0.1 1"/></material>'
    )
    return f'<robot name="arm">{_COMPILER.format(fuse=fuse)}{materials}{"".join(parts)}</robot>'


def _link(name: str, shape: str, material: str, xyz: str, rpy: str) -> str:
    look = f'<material name="{material}"/>' if material else ""
    return (
        f'<link name="{name}">{_INERTIAL}<visual><origin xyz="{xyz}" rpy="{rpy}"/>'
        f"<geometry>{shape}</geometry>{look}</visual></link>"
    )


def _joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    origin: str,
    axis: str,
    low: float | None = None,
    high: float | None = None,
    mimic: str = "",
) -> str:
    limit = "" if low is None else f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/>'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{origin}'
        f'<axis xyz="{axis}"/>{limit}{mimic}</joint>'
    )
