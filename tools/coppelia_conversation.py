"""A conversation with CoppeliaSim's ZeroMQ remote API, by hand: no CoppeliaSim takes part.

The forms of requests and answers are those of the client package `coppeliasim-zmqremoteapi-client` 2.0.4 and of the
simulator's add-on, as their sources have them: CBOR maps `{func, args, argsL, uuid}` (the first also `ver`, `lang`,
`timeout`), answered by `{ret: [...]}` or `{err: text}`; `nil` is an empty `ret`; `zmqRemoteApi.info` describes a name
space by `{name: {func: {}} | {const: value}}`. The scene is made up: a floor, a crate and an arm of one model with a
tip and a target.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

IDENTITY = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
#: Constants of `sim` by name, with the numbers of version 4.6.
CONSTANTS = {
    "handle_scene": -12,
    "handle_world": -1,
    "object_shape_type": 0,
    "object_joint_type": 1,
    "object_dummy_type": 4,
    "objintparam_visible": 17,
    "shapeintparam_static": 3003,
}
BOX = [s * h for x in (-1, 1) for y in (-1, 1) for z in (-1, 1) for s, h in ((x, 0.05), (y, 0.05), (z, 0.05))]
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
TRIANGLES = [v for a, b, c, d in QUADS for v in (a, b, c, a, c, d)]


@dataclass
class Object:
    """An object of the scene: its type, alias, parent, world pose as `x y z qx qy qz qw`, and parts of a shape."""

    kind: int
    alias: str
    parent: int = -1
    pose: list[float] = field(default_factory=lambda: list(IDENTITY))
    static: bool = False
    visible: bool = True
    parts: list[dict[str, Any]] = field(default_factory=list)


def part(r: float, g: float, b: float) -> dict[str, Any]:
    """Return a part of a shape, as `sim.getShapeViz` describes it."""
    colors = [r, g, b, 0.25, 0.25, 0.25, 0.0, 0.0, 0.0]
    return {"vertices": BOX, "indices": TRIANGLES, "normals": [], "colors": colors, "shadingAngle": 0.5, "options": 0}


class Conversation:
    """Answers requests to the remote API, from a scene that moves with `sim.step`.

    Attributes:
        objects: Objects by handle.
        time: Of the simulation [s].
        requests: Names of the functions that were called, in their order.
    """

    def __init__(self) -> None:
        shape, dummy = CONSTANTS["object_shape_type"], CONSTANTS["object_dummy_type"]
        self.objects = {
            10: Object(shape, "Floor", pose=[0, 0, -0.05, 0, 0, 0, 1], static=True, parts=[part(0.5, 0.5, 0.5)]),
            11: Object(shape, "Crate", pose=[0.5, 0, 0.5, 0, 0, 0, 1], parts=[part(1, 0, 0), part(0, 0, 1)]),
            12: Object(shape, "Arm", static=True, parts=[part(0.8, 0.8, 0.8)]),
            13: Object(shape, "link", 12, [0.0, 0.0, 0.3, 0, 0, 0, 1], parts=[part(0.8, 0.8, 0.8)]),
            14: Object(shape, "link_respondable", 12, visible=False, parts=[part(0, 1, 0)]),
            15: Object(dummy, "tip", 13, [0.0, 0.0, 0.4, 0, 0, 0, 1]),
            16: Object(dummy, "target", 12, [0.0, 0.0, 0.4, 0, 0, 0, 1]),
        }
        self.time = 0.0
        self.requests: list[str] = []
        self._functions: Mapping[str, Callable[..., list[Any]]] = {
            "getObjectsInTree": lambda _, kind, options=0: [[h for h, o in self.objects.items() if o.kind == kind]],
            "getObjectAlias": lambda handle, options=-1: [self.objects[handle].alias],
            "getObjectParent": lambda handle: [self.objects[handle].parent],
            "getObjectInt32Param": self._get_int_param,
            "getObjectPose": lambda handle, frame=-1: [list(self.objects[handle].pose)],
            "setObjectPose": self._set_pose,
            "getShapeViz": self._get_part,
            "getSimulationTime": lambda: [self.time],
            "setStepping": lambda enable=True: [0],
            "step": self._step,
        }

    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return the answer to a request."""
        name, args = request["func"], request.get("args") or []
        self.requests.append(name)
        if name == "zmqRemoteApi.require":
            return {"ret": []}
        if name == "zmqRemoteApi.info":
            functions: dict[str, Any] = {function: {"func": {}} for function in self._functions}
            return {"ret": [functions | {constant: {"const": value} for constant, value in CONSTANTS.items()}]}
        function = self._functions.get(name.removeprefix("sim."))
        if function is None:
            return {"err": f"No such function: {name}"}
        return {"ret": function(*args)}

    def _get_int_param(self, handle: int, param: int) -> list[Any]:
        one = self.objects[handle]
        return [int(one.visible if param == CONSTANTS["objintparam_visible"] else one.static)]

    def _get_part(self, handle: int, index: int) -> list[Any]:
        parts = self.objects[handle].parts
        return [parts[index]] if index < len(parts) else []

    def _set_pose(self, handle: int, pose: list[float], frame: int = -1) -> list[Any]:
        self.objects[handle].pose = list(pose)
        return []

    def _step(self, wait: bool = True) -> list[Any]:
        """Move the crate on a circle, and the tip half of the way to its target."""
        self.time += 0.05
        half = 0.5 * self.time
        self.objects[11].pose = [
            0.5 * math.cos(self.time),
            0.5 * math.sin(self.time),
            0.5,
            0,
            0,
            math.sin(half),
            math.cos(half),
        ]
        tip, target = self.objects[15].pose, self.objects[16].pose
        tip[:3] = [a + 0.5 * (b - a) for a, b in zip(tip[:3], target[:3], strict=True)]
        return []
