"""Generated scenes: N seven-joint arms around a table, free bodies flying in a hall. Same arguments, same model."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

#: Joint positions with the gripper pointing down, 0.40 m in front of the base and 0.28 m above it; then the fingers.
ARM_HOME = (0.0, 0.314, 0.0, 1.8127, 0.0, 1.0149, 0.0)
FINGER_OPEN = 0.04
ARM_FILE = Path(__file__).parent / "arm.xml"
_FREE_HALL = (10.0, 10.0, 3.0)  # m


def arm_names(n: int) -> tuple[str, ...]:
    """Return the names of the arms of `n_arms_scene(n)`: `left`, `right` for two, else `arm1` ... `armN`."""
    return ("left", "right") if n == 2 else tuple(f"arm{i + 1}" for i in range(n))


def n_arms_scene(n: int, objects: int | None = None) -> Any:
    """Build a scene of `n` arms around a round table, each facing its centre, with a keyframe `home`.

    Arms are named as in `arm_names`, their parts as in `handover.xml` (`arm1/joint1`, `arm1/tcp`, ...).

    Args:
        n: Number of arms, 1 to 12.
        objects: Number of free hammers and boards on the table, named `object1` and so on; by default one for every two
            arms.

    Returns:
        A `mujoco.MjSpec`.

    Raises:
        ValueError: `n` is out of range.
    """
    import mujoco

    if not 1 <= n <= 12:
        raise ValueError(f"n_arms_scene makes 1 to 12 arms, not {n}")
    n_objects = (n + 1) // 2 if objects is None else objects
    radius = compute_circle_radius(n)
    spec = make_room(f"{n}_arms")
    add_round_table(spec, radius + 0.25)
    for i, name in enumerate(arm_names(n)):
        arm = mujoco.MjSpec.from_file(str(ARM_FILE))
        arm.material("accent").rgba = [*compute_hue(i / n), 1.0]
        place_arm(spec, radius, compute_bearing(i, n)).attach_body(arm.body("base"), f"{name}/", "")
    qpos = [*ARM_HOME, FINGER_OPEN, FINGER_OPEN] * n
    for k in range(n_objects):
        qpos += add_object(spec, k, n_objects, radius - 0.38)
    spec.add_key(name="home", qpos=qpos, ctrl=[*ARM_HOME, FINGER_OPEN] * n)
    return spec


def compute_circle_radius(n: int, least: float = 0.6, apart: float = 0.72) -> float:
    """Return the radius [m] of the circle on which `n` arms stand: at least `least`, adjacent arms at least `apart`."""
    return max(least, 0.5 * apart / math.sin(math.pi / max(n, 2)))


def compute_bearing(i: int, n: int) -> float:
    """Return the bearing of the `i`-th of `n`, seen from the middle of the table [rad]; the first at -x, as in
    handover.xml."""
    return math.pi + 2.0 * math.pi * i / n


def place_arm(spec: Any, radius: float, bearing: float) -> Any:
    """A frame on the table at `bearing`, its x axis towards the middle."""
    return spec.worldbody.add_frame(
        pos=[radius * math.cos(bearing), radius * math.sin(bearing), 0.0],
        quat=[math.cos((bearing + math.pi) / 2), 0.0, 0.0, math.sin((bearing + math.pi) / 2)],
    )


def add_round_table(spec: Any, radius: float) -> None:
    """A round table whose top is z = 0, 0.75 m above the floor."""
    import mujoco

    cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
    top, foot = [0.66, 0.67, 0.66, 1], [0.25, 0.26, 0.28, 1]
    spec.worldbody.add_geom(name="table_top", type=cylinder, size=[radius, 0.02, 0], pos=[0, 0, -0.02], rgba=top)
    spec.worldbody.add_geom(name="table_foot", type=cylinder, size=[0.12, 0.355, 0], pos=[0, 0, -0.395], rgba=foot)


def free_bodies_scene(n: int = 300, seed: int = 0) -> Any:
    """Return an `mujoco.MjSpec` with `n` free bodies (`body001` ...) that fly in a 10 x 10 x 3 m hall without touching.

    No gravity, no contacts. Every body turns at 0.5 rad/s about its centre of mass, which rests 0.2 to 1 m from the
    body's origin: so the origin moves on a circle at a constant 0.1 to 0.5 m/s and stays inside for ever. Drawn from
    `seed`; the motion is in the keyframe `home`.
    """
    import mujoco

    rng = np.random.default_rng(seed)
    spec = make_room(f"{n}_free_bodies", floor_z=0.0)
    spec.option.gravity = [0, 0, 0]
    qpos: list[float] = []
    qvel: list[float] = []
    for i in range(n):
        p_world, quat, p_body_com, velocity, spin = _circling(rng)
        body = spec.worldbody.add_body(
            name=f"body{i + 1:03d}",
            pos=p_world,
            quat=quat,
            explicitinertial=True,
            mass=1.0,
            ipos=p_body_com,
            inertia=[0.01, 0.01, 0.01],  # equal: the turning axis stays where it is
        )
        body.add_freejoint()
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX if i % 2 else mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            size=list(map(float, rng.uniform(0.03, 0.12, size=3))),
            rgba=[*compute_hue(i / n), 1.0],
            contype=0,
            conaffinity=0,
        )
        qpos += [*p_world, *quat]
        qvel += [*velocity, *spin]
    spec.add_key(name="home", qpos=qpos, qvel=qvel)
    return spec


def _circling(rng: np.random.Generator) -> tuple[list[float], list[float], list[float], list[float], list[float]]:
    """One body of `free_bodies_scene`: origin [m] and quaternion in the world, centre of mass [m] in the body,
    velocity of the origin [m/s] in the world, angular velocity [rad/s] in the body."""
    import mujoco

    quat = rng.normal(size=4)
    quat /= np.linalg.norm(quat)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    radius = rng.uniform(0.2, 1.0)
    arm = np.cross(axis, rng.normal(size=3))
    arm *= radius / np.linalg.norm(arm)  # from the centre of mass to the origin, world frame
    margin = np.minimum(radius + 0.05, np.array(_FREE_HALL) / 2 - 0.01)
    low = np.array([-_FREE_HALL[0] / 2, -_FREE_HALL[1] / 2, 0.0]) + margin
    high = np.array([_FREE_HALL[0] / 2, _FREE_HALL[1] / 2, _FREE_HALL[2]]) - margin
    com = rng.uniform(low, high)
    world_to_body = np.empty(4)
    mujoco.mju_negQuat(world_to_body, quat)
    p_body_com, spin = np.empty(3), np.empty(3)
    mujoco.mju_rotVecQuat(p_body_com, -arm, world_to_body)
    mujoco.mju_rotVecQuat(spin, 0.5 * axis, world_to_body)
    values = (com + arm, quat, p_body_com, 0.5 * np.cross(axis, arm), spin)
    return tuple(list(map(float, v)) for v in values)  # type: ignore[return-value]


def make_room(name: str, floor_z: float = -0.75) -> Any:
    """An empty room: options as in `handover.xml`, sky, checker floor at `floor_z`, two lights."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.compiler.degree = False
    spec.option.timestep = 0.002
    spec.option.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    spec.option.cone = int(mujoco.mjtCone.mjCONE_ELLIPTIC)
    spec.option.impratio = 10
    spec.option.noslip_iterations = 3
    spec.visual.global_.offwidth = 1280
    spec.visual.global_.offheight = 960
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.35, 0.35, 0.35]
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.72, 0.82],
        rgb2=[0.93, 0.94, 0.95],
        width=256,
        height=1536,
    )
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.55, 0.58, 0.61],
        rgb2=[0.62, 0.65, 0.68],
        width=300,
        height=300,
    )
    floor = spec.add_material(name="floor", texrepeat=[1, 1], texuniform=True)
    floor.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "floor"
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[8, 8, 0.1], pos=[0, 0, floor_z], material="floor"
    )
    for light, pos, direction in (
        ("key", [0.8, -1.6, 2.4], [-0.3, 0.6, -0.9]),
        ("fill", [-1.5, 1, 2.2], [0.6, -0.4, -0.9]),
    ):
        spec.worldbody.add_light(
            name=light,
            pos=pos,
            dir=direction,
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            castshadow=light == "key",
            diffuse=[0.5, 0.5, 0.5] if light == "key" else [0.25, 0.25, 0.27],
        )
    return spec


def add_object(spec: Any, k: int, count: int, distance: float) -> list[float]:
    """Add a hammer (even `k`) or board (odd) on the table, `distance` [m] from its middle; returns its home `qpos`."""
    import mujoco

    box = mujoco.mjtGeom.mjGEOM_BOX
    bearing = math.pi + 2.0 * math.pi * k / max(count, 1)
    height = 0.012 if k % 2 else 0.016
    pos = [distance * math.cos(bearing), distance * math.sin(bearing), height]
    body = spec.worldbody.add_body(name=f"object{k + 1}", pos=pos)
    body.add_freejoint()
    parts: list[dict[str, Any]]
    if k % 2:
        parts = [{"size": [0.150, 0.028, 0.012], "mass": 0.26, "rgba": [0.66, 0.46, 0.27, 1]}]
    else:
        parts = [
            {"size": [0.140, 0.012, 0.015], "mass": 0.13, "rgba": [0.66, 0.46, 0.27, 1]},
            {"size": [0.016, 0.055, 0.016], "pos": [-0.148, 0, 0], "mass": 0.37, "rgba": [0.55, 0.57, 0.60, 1]},
        ]
    for part in parts:
        body.add_geom(type=box, condim=4, friction=[0.7, 0.005, 0.0001], **part)
    turn = bearing + math.pi / 2  # along the rim: across the way of the nearest arm
    return [*pos, math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]


def compute_hue(x: float) -> tuple[float, float, float]:
    """Return a distinct, muted colour for `x` in 0 to 1."""
    return (
        0.5 + 0.35 * math.cos(2 * math.pi * (x + 0.55)),
        0.5 + 0.35 * math.cos(2 * math.pi * (x + 0.22)),
        0.5 + 0.35 * math.cos(2 * math.pi * (x - 0.11)),
    )
