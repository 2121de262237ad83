"""CoppeliaSim, through its ZeroMQ remote API: the visible shapes of its scene.

Give the `RemoteAPIClient`, or what its `require('sim')` returns. In stepping mode (`sim.setStepping(True)`) its
`sim.step` is followed, otherwise call `sync()` at the rate that you want. A robot is what CoppeliaSim's models have for
inverse kinematics: two dummies called `tip` and `target` in one model. Participants move the target.

Every pose is a request of its own (about 0.2 ms): shapes that stand still on their own are read once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from iris_session.protocol.specs import RobotSpec
from iris_session.scene.builder import AppearanceOptions, SceneBuilder
from iris_session.scene.errors import SceneBuildError
from iris_session.simulators.adapter import Adapter, Names, SimulationState, TipTarget, from_xyzw
from iris_session.simulators.wrapping import SimulatorError, wrap_method

#: Most parts of a compound shape.
_MAX_PARTS: Final = 1000
#: Colours of a part: ambient and diffuse, then specular, then emission.
_COLORS: Final = 9


class _Robot(NamedTuple):
    """A robot: its model, and the dummies that are the end effector and where it is to go."""

    name: str
    model: int
    tip: int
    target: int


class CoppeliaAdapter(Adapter):
    """A scene that is open in CoppeliaSim."""

    drives = True
    name = "coppeliasim"

    def __init__(self, simulation: Any) -> None:
        sim = simulation.require("sim") if hasattr(simulation, "require") else simulation
        if not hasattr(sim, "getObjectsInTree"):
            raise SimulatorError("this is no remote API of CoppeliaSim: give the RemoteAPIClient or its require('sim')")
        self._sim = sim
        self._client = simulation if sim is not simulation else None
        self._handles: list[int] = []  # of what moves
        self._targets: dict[str, int] = {}

    # --- the scene ----------------------------------------------------------------------------------------------------

    def build(self, scene: SceneBuilder) -> None:
        """Add all visible shapes, and the end effectors of robots."""
        sim, names, notes, bodies = self._sim, Names(), [], []
        for handle in self._list_objects("shape"):
            if not sim.getObjectInt32Param(handle, sim.objintparam_visible):
                continue
            alias = sim.getObjectAlias(handle)
            p, q = self._read_pose(handle)
            on = ""
            if not self._stands_still(handle):
                on = scene.add_body(names.add(alias), position=p, quaternion=q)
                self._handles.append(handle)
                bodies.append(on)
            place: dict[str, Any] = {"on": on} if on else {"position": p, "quaternion": q}
            try:
                for part in self._list_parts(handle):
                    scene.add_mesh(alias, **_read_mesh(part), **place)
            except SceneBuildError as error:
                notes.append(f"{alias}: {error}")
        robots = []
        for robot in self._find_robots():
            tip = names.add(f"{robot.name}/tip")
            p, q = self._read_pose(robot.tip)
            scene.add_body(tip, position=p, quaternion=q)
            self._handles.append(robot.tip)
            bodies.append(tip)
            name = robot.name if robot.name not in self._targets else tip
            self._targets[name] = robot.target
            robots.append(RobotSpec(name, (), (), "", base_body=tip, tip_body=tip))
        self.bodies, self.robots, self.notes = bodies, tuple(robots), tuple(dict.fromkeys(notes))

    def _list_objects(self, kind: str) -> list[int]:
        """Return the handles of all shapes or dummies; the type has another name in older versions."""
        sim = self._sim
        number = getattr(sim, f"sceneobject_{kind}", None)
        number = getattr(sim, f"object_{kind}_type", None) if number is None else number
        return list(sim.getObjectsInTree(sim.handle_scene, number, 0) or [])

    def _stands_still(self, handle: int) -> bool:
        """Return whether a shape is fixed in the world: static, and without a parent that could carry it."""
        static = self._sim.getObjectInt32Param(handle, self._sim.shapeintparam_static)
        return bool(static) and self._sim.getObjectParent(handle) == -1

    def _list_parts(self, handle: int) -> Iterator[Mapping[str, Any]]:
        for number in range(_MAX_PARTS):
            part = self._sim.getShapeViz(handle, number)
            if not part or not part.get("vertices"):
                return
            yield part

    def _find_robots(self) -> Iterator[_Robot]:
        """Yield models with a tip and a target."""
        sim = self._sim
        found: dict[int, dict[str, int]] = {}
        for handle in self._list_objects("dummy"):
            alias = sim.getObjectAlias(handle).lower()
            kind = next((word for word in ("target", "tip") if word in alias), "")
            if kind:
                found.setdefault(self._find_model(handle), {}).setdefault(kind, handle)
        for model, dummies in found.items():
            if len(dummies) == 2 and model >= 0:
                yield _Robot(sim.getObjectAlias(model), model, dummies["tip"], dummies["target"])

    def _find_model(self, handle: int) -> int:
        """Return the highest object that a dummy is in, as models stand for themselves."""
        above = handle
        while (parent := self._sim.getObjectParent(above)) != -1:
            above = parent
        return above if above != handle else -1

    # --- every state --------------------------------------------------------------------------------------------------

    def read_state(self) -> SimulationState:
        """Return the poses of what moves."""
        poses = [self._read_pose(handle) for handle in self._handles]
        return SimulationState(
            float(self._sim.getSimulationTime()),
            np.array([p for p, _ in poses]).reshape(-1, 3),
            np.array([q for _, q in poses]).reshape(-1, 4),
        )

    def _read_pose(self, handle: int) -> tuple[list[float], list[float]]:
        pose = np.array(self._sim.getObjectPose(handle, self._sim.handle_world), np.float64)
        return pose[:3].tolist(), from_xyzw(pose[3:]).tolist()

    def wrap_step(self, before: Callable[[], None], after: Callable[[], None]) -> Callable[[], None]:
        """Follow `sim.step`: of every `sim` of a client, which makes another one for each `require`."""
        if self._client is None:
            return wrap_method(self._sim, "step", lambda *_, **__: before(), lambda *_, **__: after())

        def on_before(func: str, *_: Any, **__: Any) -> None:
            if func == "sim.step":
                before()

        def on_after(func: str, *_: Any, **__: Any) -> None:
            if func == "sim.step":
                after()

        return wrap_method(self._client, "call", on_before, on_after)

    def apply_targets(self, targets: Mapping[str, TipTarget]) -> None:
        """Move the dummies that the scene's own inverse kinematics follows."""
        for name, target in targets.items():
            w, x, y, z = target.pose.q
            self._sim.setObjectPose(self._targets[name], [*target.pose.p, x, y, z, w], self._sim.handle_world)


def _read_mesh(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of `add_mesh` for a part of a shape."""
    mesh: dict[str, Any] = {
        "vertices": np.array(part["vertices"], np.float64).reshape(-1, 3),
        "triangles": np.array(part["indices"], np.int64).reshape(-1, 3),
    }
    look: AppearanceOptions = {}
    colors = np.array(part.get("colors") or (), np.float64)
    if len(colors) >= _COLORS:
        opacity = float(part.get("transparency", 0.0))
        look["rgba"] = [*np.clip(colors[:3], 0.0, 1.0).tolist(), min(max(1.0 - opacity, 0.0), 1.0)]
    return {**mesh, **look}
