"""Cameras and lights of a scene as nodes of a glTF document. Those that follow something stand as they do at first."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from anchors.lie import matrix_quat
from iris_session.protocol.scene import Camera, Light, SceneSpec
from iris_session.protocol.scene_names import LightKind

_LIGHTS: Final = {LightKind.DIRECTIONAL: "directional", LightKind.SPOT: "spot", LightKind.POINT: "point"}
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
        p, (w, x, y, z) = camera.T_body_camera.p, camera.T_body_camera.q
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
            "rotation": _looking(light),
            "extensions": {_EXTENSION: {"light": k}},
        }
        _hang(document, nodes[light.body], node)


def _hang(document: dict[str, Any], parent: int, node: dict[str, Any]) -> None:
    document["nodes"].append(node)
    document["nodes"][parent].setdefault("children", []).append(len(document["nodes"]) - 1)


def _lens(camera: Camera) -> dict[str, Any]:
    width, height = camera.resolution
    aspect = width / height if (width, height) != (1, 1) and height else _ASPECT
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


def _looking(light: Light) -> list[float]:
    """`[x, y, z, w]` of a frame whose -z is the light's direction."""
    back = -np.array(light.direction_body, np.float64)
    back /= np.linalg.norm(back) or 1.0
    side = np.cross([0.0, 1.0, 0.0] if abs(back[1]) < 0.9 else [1.0, 0.0, 0.0], back)
    side /= np.linalg.norm(side) or 1.0
    w, x, y, z = matrix_quat(np.stack([side, np.cross(back, side), back], axis=1)).tolist()
    return [x, y, z, w]
