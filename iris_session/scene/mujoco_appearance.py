"""Names, materials, lights, cameras and environment of a compiled MuJoCo model.

Fields that older versions of MuJoCo lack keep their defaults.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np

from anchors.pose import PoseTuple, compose, inverse, quat_rotate
from iris_session.protocol.common import IDENTITY, MAX_TEXT, Pose, Vec3
from iris_session.protocol.names import Follow, LightKind, TextureKind
from iris_session.protocol.scene import Camera, Environment, Headlight, Light, Material, Rgba, Texture, TextureUse

#: MuJoCo's default colour: a geom with it has the colour of its material.
_DEFAULT_RGBA: Final = (0.5, 0.5, 0.5, 1.0)
_ROLES: Final = {
    int(value): name.removeprefix("mjTEXROLE_").lower()
    for name, value in mujoco.mjtTextureRole.__members__.items()
    if name.startswith("mjTEXROLE_")
}
_LIGHTS: Final = {0: LightKind.SPOT, 1: LightKind.DIRECTIONAL, 2: LightKind.POINT, 3: LightKind.IMAGE}
_FOLLOW: Final = {
    0: Follow.FIXED,
    1: Follow.TRACK,
    2: Follow.TRACK_COM,
    3: Follow.TARGET_BODY,
    4: Follow.TARGET_BODY_COM,
}
_ORTHOGRAPHIC: Final = 1
#: Values of `_FOLLOW` for lights and cameras that move with a body without rotating with it.
_TRACKING: Final = frozenset({1, 2})
#: Smaller differences [m, components of unit vectors] are ignored: the values of the model are used unchanged.
_SAME: Final = 1e-6
_TYPES: Final = {
    kind: int(getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"))
    for kind in ("body", "geom", "site", "mesh", "texture", "material", "hfield", "light", "camera", "flex", "tendon")
}


def to_floats(values: Any) -> Any:
    """Return an array as a tuple of floats: a vector or a colour."""
    return tuple(np.asarray(values, np.float64).tolist())


def to_pose(position: Any, quaternion: Any) -> Pose:
    return Pose(to_floats(position), to_floats(quaternion))


def resolve_rgba(model: mujoco.MjModel, own: Any, material: int) -> Rgba:
    """Return the colour that MuJoCo draws: the own colour, unless that is the default and there is a material."""
    color: Rgba = to_floats(own)
    return to_floats(model.mat_rgba[material]) if material >= 0 and color == _DEFAULT_RGBA else color


def read_materials(model: mujoco.MjModel) -> tuple[Material, ...]:
    """Return all materials, by id."""
    return tuple(
        Material(
            name=read_name(model, "material", i),
            rgba=to_floats(model.mat_rgba[i]),
            emission=float(model.mat_emission[i]),
            specular=float(model.mat_specular[i]),
            shininess=float(model.mat_shininess[i]),
            reflectance=float(model.mat_reflectance[i]),
            metallic=_read_optional(model, "mat_metallic", i, -1.0),
            roughness=_read_optional(model, "mat_roughness", i, -1.0),
            textures=tuple(
                TextureUse(_ROLES.get(role, str(role)), int(texture))
                for role, texture in enumerate(model.mat_texid[i])
                if texture >= 0
            ),
            repeat=to_floats(model.mat_texrepeat[i]),
            uniform=bool(model.mat_texuniform[i]),
        )
        for i in range(model.nmat)
    )


def compute_tracked(model: mujoco.MjModel, data: Any) -> Any | None:
    """Return a copy of `data` with poses of lights and cameras, if one moves with its body without rotating with it.

    The pose of such a one in the frame of its body depends on the state. `None`: all poses are those of the model.
    """
    if data is None or not {*model.light_mode.tolist(), *model.cam_mode.tolist()} & _TRACKING:
        return None
    own = copy.copy(data)
    mujoco.mj_kinematics(model, own)
    mujoco.mj_comPos(model, own)
    mujoco.mj_camlight(model, own)
    return own


def _to_body_frame(at: Any, body: int, p_world: Any, q_world: Any = IDENTITY.q) -> PoseTuple:
    """Return T_body_x of something at `p_world` with the orientation `q_world`. `at`: result of `compute_tracked`."""
    T_world_body = to_floats(at.xpos[body]), to_floats(at.xquat[body])
    return compose(inverse(T_world_body), (to_floats(p_world), to_floats(q_world)))


def _find_light_place(model: mujoco.MjModel, i: int, at: Any | None) -> tuple[Vec3, Vec3]:
    """Return position and direction in the frame of the body. `at`: result of `compute_tracked`."""
    rigid = to_floats(model.light_pos[i]), to_floats(model.light_dir[i])
    if at is None or int(model.light_mode[i]) not in _TRACKING:
        return rigid
    body = int(model.light_bodyid[i])
    p_body, q_body_world = _to_body_frame(at, body, at.light_xpos[i])
    found = p_body, quat_rotate(q_body_world, to_floats(at.light_xdir[i]))
    return rigid if np.allclose(rigid, found, rtol=0, atol=_SAME) else found


def _find_camera_pose(model: mujoco.MjModel, i: int, at: Any | None) -> Pose:
    """Return T_body_camera. `at`: result of `compute_tracked`."""
    rigid = to_pose(model.cam_pos[i], model.cam_quat[i])
    if at is None or int(model.cam_mode[i]) not in _TRACKING:
        return rigid
    q_world = np.zeros(4)
    mujoco.mju_mat2Quat(q_world, at.cam_xmat[i])
    found = Pose(*_to_body_frame(at, int(model.cam_bodyid[i]), at.cam_xpos[i], q_world))
    near = abs(np.dot(rigid.q, found.q)) >= 1.0 - _SAME**2 and np.allclose(rigid.p, found.p, rtol=0, atol=_SAME)
    return rigid if near else found


def read_lights(model: mujoco.MjModel, at: Any | None = None) -> tuple[Light, ...]:
    """Return all lights, by id. `at`: result of `compute_tracked`."""
    places = [_find_light_place(model, i, at) for i in range(model.nlight)]
    return tuple(
        Light(
            name=read_name(model, "light", i),
            kind=_read_light_kind(model, i),
            body=int(model.light_bodyid[i]),
            p_body=places[i][0],
            direction_body=places[i][1],
            ambient=to_floats(model.light_ambient[i]),
            diffuse=to_floats(model.light_diffuse[i]),
            specular=to_floats(model.light_specular[i]),
            attenuation=to_floats(model.light_attenuation[i]),
            cutoff=float(model.light_cutoff[i]),
            exponent=float(model.light_exponent[i]),
            range=_read_optional(model, "light_range", i, 0.0),
            intensity=_read_optional(model, "light_intensity", i, 0.0),
            bulb_radius=_read_optional(model, "light_bulbradius", i, 0.0),
            texture=int(_read_optional(model, "light_texid", i, -1)),
            castshadow=bool(model.light_castshadow[i]),
            active=bool(model.light_active[i]),
            follow=_FOLLOW.get(int(model.light_mode[i]), Follow.FIXED),
            target=int(model.light_targetbodyid[i]),
        )
        for i in range(model.nlight)
    )


def _read_light_kind(model: mujoco.MjModel, index: int) -> str:
    if hasattr(model, "light_type"):
        return _LIGHTS.get(int(model.light_type[index]), LightKind.SPOT)
    return LightKind.DIRECTIONAL if model.light_directional[index] else LightKind.SPOT  # before MuJoCo 3.3.3


def read_cameras(model: mujoco.MjModel, at: Any | None = None) -> tuple[Camera, ...]:
    """Return all cameras, by id. `at`: result of `compute_tracked`."""
    found = []
    projection = "cam_projection" if hasattr(model, "cam_projection") else "cam_orthographic"
    for i in range(model.ncam):
        sensor = np.asarray(model.cam_sensorsize[i], np.float64)
        lens = np.zeros((2, 2))
        if (sensor > 0).all():  # convert lengths on the sensor to pixels
            lens = np.reshape(model.cam_intrinsic[i], (2, 2)).astype(np.float64) * (model.cam_resolution[i] / sensor)
        found.append(
            Camera(
                name=read_name(model, "camera", i),
                body=int(model.cam_bodyid[i]),
                T_body_camera=_find_camera_pose(model, i, at),
                fovy=float(model.cam_fovy[i]),
                orthographic=int(getattr(model, projection)[i]) == _ORTHOGRAPHIC,
                focal=to_floats(lens[0]),
                principal=to_floats(lens[1]),
                resolution=tuple(model.cam_resolution[i].tolist()),
                follow=_FOLLOW.get(int(model.cam_mode[i]), Follow.FIXED),
                target=int(model.cam_targetbodyid[i]),
            )
        )
    return tuple(found)


def read_environment(model: mujoco.MjModel, textures: Sequence[Texture]) -> Environment:
    """Return the environment of the scene; MuJoCo draws the first texture of kind skybox."""
    extent = float(model.stat.extent)
    headlight, scale = model.vis.headlight, model.vis.map
    skyboxes = [i for i, texture in enumerate(textures) if texture.kind == TextureKind.SKYBOX]
    return Environment(
        headlight=Headlight(
            bool(headlight.active),
            *(to_floats(light) for light in (headlight.ambient, headlight.diffuse, headlight.specular)),
        ),
        skybox=skyboxes[0] if skyboxes else -1,
        haze_rgba=to_floats(model.vis.rgba.haze),
        haze=float(scale.haze),
        fog_rgba=to_floats(model.vis.rgba.fog),
        fog_start=float(scale.fogstart) * extent,
        fog_end=float(scale.fogend) * extent,
        znear=float(scale.znear) * extent,
        zfar=float(scale.zfar) * extent,
        extent=extent,
        center=to_floats(model.stat.center),
    )


def _read_optional(model: mujoco.MjModel, field: str, index: int, default: float) -> float:
    return float(getattr(model, field)[index]) if hasattr(model, field) else default


# --- names ------------------------------------------------------------------------------------------------------------


def read_name(model: mujoco.MjModel, kind: str, index: int) -> str:
    """Return the name, or an empty text."""
    return (mujoco.mj_id2name(model, _TYPES[kind], index) or "")[:MAX_TEXT]
