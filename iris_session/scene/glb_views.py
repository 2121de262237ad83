"""Cameras and lights of a scene as nodes of a glTF document. Those that follow something stand as they do at first."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from anchors.lie import quat_from_matrix
from anchors.pose import PoseTuple, apply, quat_conj, quat_mul, quat_rotate
from iris_session.protocol.common import Quat, Vec3
from iris_session.protocol.names import Follow, LightKind
from iris_session.protocol.scene import Camera, Light, SceneSpec
from iris_session.scene.parts import vec3

_LIGHTS: Final = {LightKind.DIRECTIONAL: "directional", LightKind.SPOT: "spot", LightKind.POINT: "point"}
#: Looked at is the place of the body: centres of mass are not in a specification.
_WATCHING: Final = (Follow.TARGET_BODY, Follow.TARGET_BODY_COM)
_EXTENSION: Final = "KHR_lights_punctual"
#: Nearest that an exported camera sees [m].
_NEAR: Final = 0.01
#: Width over height where the scene does not say.
_ASPECT: Final = 4 / 3
#: Widest cone that glTF has [rad].
_WIDEST: Final = math.pi / 2


def add_viewpoints(document: dict[str, Any], spec: SceneSpec, nodes: Mapping[int, int]) -> None:
    """Adds them below the nodes of their bodies; `nodes`: of bodies, by their ids."""
    for k, camera in enumerate(spec.cameras):
        document["cameras"].append(_lens(camera))
        p, (w, x, y, z) = camera.T_body_camera.p, _seeing(camera, spec)
        node = {"name": camera.name or f"camera_{k}", "translation": list(p), "rotation": [x, y, z, w], "camera": k}
        _hang(document, nodes[camera.body], node)
    lights = [light for light in spec.lights if light.active and light.kind in _LIGHTS]
    if not lights:
        return
    document["extensionsUsed"] = [_EXTENSION]
    document["extensions"] = {_EXTENSION: {"lights": [_lamp(light) for light in lights]}}
    for k, light in enumerate(lights):
        node = {
            "name": light.name or f"light_{k}",
            "translation": list(light.p_body),
            "rotation": _looking(light, spec),
            "extensions": {_EXTENSION: {"light": k}},
        }
        _hang(document, nodes[light.body], node)


def _hang(document: dict[str, Any], parent: int, node: dict[str, Any]) -> None:
    document["nodes"].append(node)
    document["nodes"][parent].setdefault("children", []).append(len(document["nodes"]) - 1)


def _lens(camera: Camera) -> dict[str, Any]:
    width, height = camera.resolution
    aspect = width / height if (width, height) != (1, 1) and height else _ASPECT
    if camera.focal[0] > 0 and camera.focal[1] > 0:  # of pixels that are no squares
        aspect *= camera.focal[1] / camera.focal[0]
    if camera.orthographic:
        lens = {"xmag": aspect * camera.fovy / 2, "ymag": camera.fovy / 2, "znear": _NEAR, "zfar": 1_000.0}
        return {"type": "orthographic", "orthographic": lens}
    return {
        "type": "perspective",
        "perspective": {"yfov": math.radians(camera.fovy), "aspectRatio": aspect, "znear": _NEAR},
    }


def _lamp(light: Light) -> dict[str, Any]:
    """As bright as it is drawn: intensity 1 where the scene does not say, and the colour (sRGB) as a linear one."""
    color = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in np.clip(light.diffuse, 0, 1).tolist()]
    lamp: dict[str, Any] = {"type": _LIGHTS[light.kind], "color": color, "intensity": light.intensity or 1.0}
    if light.range > 0 and light.kind != LightKind.DIRECTIONAL:
        lamp["range"] = light.range
    if light.kind == LightKind.SPOT:
        lamp["spot"] = {"outerConeAngle": min(max(math.radians(light.cutoff), 1e-3), _WIDEST)}
    return lamp


def _seeing(camera: Camera, spec: SceneSpec) -> Quat:
    """Of T_body_camera, as the scene begins: one that follows a body with its eyes is turned to it, upright."""
    T_world_body = _place(camera.body, spec)
    back = -_to_target(camera, apply(T_world_body, camera.T_body_camera.p), spec)
    across = np.cross([0.0, 0.0, 1.0], back)
    if not across.any():  # it follows nothing, or it looks straight up or down
        return camera.T_body_camera.q
    across /= np.linalg.norm(across)
    w, x, y, z = quat_from_matrix(np.stack([across, np.cross(back, across), back], axis=1)).tolist()
    return quat_mul(quat_conj(T_world_body[1]), (w, x, y, z))


def _to_target(watcher: Light | Camera, p_world: Vec3, spec: SceneSpec) -> NDArray[np.float64]:
    """Unit vector from `p_world` to the body that it follows with its eyes; zero where there is none."""
    if watcher.follow not in _WATCHING or watcher.target < 0:
        return np.zeros(3)
    way = np.subtract(_place(watcher.target, spec)[0], p_world)
    return np.asarray(way / (np.linalg.norm(way) or 1.0))


def _place(body: int, spec: SceneSpec) -> PoseTuple:
    """T_world_body as the scene begins."""
    pose = next(one.T_world_body for one in spec.bodies if one.id == body)
    return pose.p, pose.q


def _looking(light: Light, spec: SceneSpec) -> list[float]:
    """`[x, y, z, w]` of a frame whose -z is the light's direction, in that of its body."""
    T_world_body = _place(light.body, spec)
    to_target = _to_target(light, apply(T_world_body, light.p_body), spec)
    watched = quat_rotate(quat_conj(T_world_body[1]), vec3(to_target))
    back = -np.array(watched if to_target.any() else light.direction_body, np.float64)
    back /= np.linalg.norm(back) or 1.0
    side = np.cross([0.0, 1.0, 0.0] if abs(back[1]) < 0.9 else [1.0, 0.0, 0.0], back)
    side /= np.linalg.norm(side) or 1.0
    w, x, y, z = quat_from_matrix(np.stack([side, np.cross(back, side), back], axis=1)).tolist()
    return [x, y, z, w]
