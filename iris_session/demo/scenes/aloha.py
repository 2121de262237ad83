"""Two ALOHA stations face to face: the scene of `iris-session demo aloha`.

World: Z up, table tops at z = 0, room floor at z = -0.75. The stations touch at y = 0; `south` is worked from -y,
`north` from +y, and left and right are those of the operator who sits there. Robots: `south/left`, `south/right`,
`north/left`, `north/right`; what is across from `south/right` is `north/left`. Two light boards, red and blue, lie on
one table each; a printed sheet lies where the tables meet.
"""

from __future__ import annotations

import math
from typing import Any, Final

from iris_session.demo.scenes.generators import make_room
from iris_session.demo.scenes.models import find_model_file, load_model_spec
from iris_session.demo.scenes.parts import add_board, add_sheet

STATIONS: Final = ("south", "north")
#: From the middle of a station to the edge at which the two touch, frame included [m].
HALF_DEPTH: Final = 0.39
#: Height of the sheet on its bridge over the frames of the two tables [m].
SHEET_Z: Final = 0.024
#: Half extents of a board [m], so long that the cameras above two grippers clear each other; its mass [kg]: poplar,
#: 0.35 kg/dm3.
BOARD_SIZE: Final = (0.145, 0.016, 0.0125)
BOARD_MASS: Final = 0.08
#: Waist to wrist of an arm at home [rad], for the left arm: half turned to the other station, gripper leaning forward.
ARM_HOME: Final = (0.9, -0.3768, 0.0629, 0.0, 1.5357, 0.0)
FINGER_OPEN: Final = 0.037  # m, of one finger along its rail
#: Where the fingers hold best, a centimetre behind their tips, in the frame of the gripper link [m].
P_LINK_TCP: Final = (0.134, 0.0, 0.0)
#: Capsules of the fingers in newer versions of the model: radius and half length [m], position [m], quaternion.
_FINGERS: Final = {
    "left_finger_link": ((0.01373, 0.04606), (0.01415, -0.0347, 0.0119), (0.544446, 0.455511, 0.456118, -0.536698)),
    "right_finger_link": ((0.01373, 0.04606), (0.01417, 0.0347, 0.01176), (0.538959, -0.458738, -0.452903, -0.542183)),
}
#: Where the boards lie, seen by their owner: in front of the right arm, the long side pointing at it.
_BOARD_FROM_BASE: Final = (0.47, math.radians(165.0))  # m from the right base, bearing


def aloha_scene() -> Any:
    """Return the scene as an `mujoco.MjSpec`, keyframe `home`. Raises `ModelNotFoundError` without the model."""
    import mujoco

    spec = make_room("aloha")
    path = find_model_file("aloha", "scene.xml")
    qpos: list[float] = []
    ctrl: list[float] = []
    for index, name in enumerate(STATIONS):
        sign = -1.0 if index == 0 else 1.0
        frame = spec.worldbody.add_frame(
            pos=[0.0, sign * HALF_DEPTH, 0.0009], quat=[1, 0, 0, 0] if index == 0 else [0, 0, 0, 1]
        )
        spec.attach(_station(path), prefix=f"{name}/", frame=frame)
        for side in (1.0, -1.0):
            arm = [side * ARM_HOME[0], *ARM_HOME[1:]]
            qpos += [*arm, FINGER_OPEN, FINGER_OPEN]
            ctrl += [*arm, FINGER_OPEN]
    if hasattr(spec, "dedup_assets"):  # MuJoCo 4: the meshes of the stations once
        spec.dedup_assets()
    for index, (name, rgba) in enumerate((("red_board", (0.78, 0.10, 0.08)), ("blue_board", (0.10, 0.28, 0.72)))):
        x, y, yaw = _board_place(index)
        qpos += add_board(spec, name, (x, y, BOARD_SIZE[2]), yaw, BOARD_SIZE, BOARD_MASS, rgba)
    add_sheet(spec, (0.0, 0.0, SHEET_Z))
    spec.worldbody.add_geom(  # bridges the low frames of the two tables, for the sheet to lie on
        name="bridge",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.115, 0.11, 0.002],
        pos=[0, 0, SHEET_Z - 0.002],
        rgba=[0.66, 0.67, 0.66, 1],
    )
    spec.add_key(name="home", qpos=qpos, ctrl=ctrl)
    return spec


def _station(path: Any) -> Any:
    """Return one station without the parts of a complete scene: floor, lights, sky, targets."""
    import mujoco

    spec = load_model_spec(path)
    spec.option.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    spec.delete(spec.geom("floor"))
    for thing in [*spec.lights, *(b for b in spec.bodies if b.mocap)]:
        spec.delete(thing)
    for texture in [t for t in spec.textures if int(t.type) == int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)]:
        spec.delete(texture)
    for side in ("left", "right"):
        _fit_capsules(spec.body(f"{side}/base_link"))
    for side in ("left", "right"):
        spec.body(f"{side}/gripper_link").add_site(
            name=f"{side}/tcp",  # z along the fingers, y the closing direction
            pos=list(P_LINK_TCP),
            quat=[math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0],
            size=[0.004, 0.004, 0.004],
            group=4,
        )
    return spec


def _fit_capsules(arm: Any) -> None:
    """Let an arm collide with capsules, as in newer versions of the model; older ones have the hulls of its meshes,
    between which a board slips."""
    import mujoco

    for body in (arm, *arm.find_all("body")):
        for geom in body.geoms:
            if geom.classname.name != "collision" or int(geom.type) != int(mujoco.mjtGeom.mjGEOM_MESH):
                continue
            geom.type = mujoco.mjtGeom.mjGEOM_CAPSULE  # by default fitted to the mesh
            for finger, (size, pos, quat) in _FINGERS.items():
                if body.name.endswith(finger):
                    geom.meshname = ""
                    geom.size, geom.pos, geom.quat = [*size, 0.0], pos, quat


def _board_place(index: int) -> tuple[float, float, float]:
    """Return x, y [m] and yaw [rad] of the board of station `index`: its +x end points away from the right arm's
    base."""
    reach, bearing = _BOARD_FROM_BASE
    x, y = 0.469 + reach * math.cos(bearing), -0.019 - HALF_DEPTH + reach * math.sin(bearing)
    return (x, y, bearing) if index == 0 else (-x, -y, bearing + math.pi)
