"""USD stages, as Isaac Sim lays them out: rigid bodies, meshes, shapes, instances and point instancers.

What moves: prims with `PhysicsRigidBodyAPI` and prims whose transform is animated; in a stage without any of them, the
transforms below its default prim. Meshes whose points are animated, and deformables of PhysX, are streams of vertices.
Lengths are converted by `metersPerUnit`, and a y axis that points up becomes z. Textures need Pillow.

`sync()` reads the stage as it is then, `sync(time_code)` an animation at a time. In Isaac Sim, whose physics writes the
stage while it plays, `sync()` belongs into a callback of the physics step; see docs/simulators.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from os import PathLike, fspath
from typing import Any, Final

import numpy as np

from iris_session.scene.builder import SceneBuilder
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.nodes import split_rigid, to_matrix
from iris_session.simulators import usd_content as content
from iris_session.simulators.adapter import Adapter, Floats, Names, SimulationState, find_gripper, make_robot
from iris_session.simulators.usd_looks import read_look
from iris_session.simulators.wrapping import SimulatorError

SUFFIXES: Final = (".usd", ".usda", ".usdc", ".usdz")
#: Rotation of a stage with y up: 90 degrees around x.
_FROM_Y_UP: Final = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
#: Purposes of prims that people see; collision shapes of Isaac Sim are guides.
_SHOWN: Final = ("default", "render")


class UsdAdapter(Adapter):
    """A stage of OpenUSD, or the path of one."""

    def __init__(self, stage: Any) -> None:
        if isinstance(stage, str | PathLike):
            stage = _open_stage(fspath(stage))
        from pxr import Usd, UsdGeom

        self._usd, self._geom, self._stage = Usd, UsdGeom, stage
        self._time: Any = Usd.TimeCode.EarliestTime()  # values without time, too
        self._time_s: float | None = None
        default = stage.GetDefaultPrim()
        self.name = default.GetName() if default else "stage"
        up, unit = str(UsdGeom.GetStageUpAxis(stage)), float(UsdGeom.GetStageMetersPerUnit(stage))
        self._T_world_stage = (_FROM_Y_UP if up == "Y" else np.eye(4)) @ np.diag([unit, unit, unit, 1.0])
        self._moving: dict[Any, str] = {}  # names by the paths of the prims
        self._T_body_world: dict[str, Floats] = {}  # of moving bodies, as the scene is built
        self._swarms: list[tuple[Any, int]] = []  # point instancers that are animated, and how many instances they have
        self._soft: dict[str, Any] = {}
        self._notes: list[str] = []

    # --- the scene ----------------------------------------------------------------------------------------------------

    def build(self, scene: SceneBuilder) -> None:
        """Add what people see of the stage."""
        names, cache = Names(), self._geom.XformCache(self._time)
        for prim in self._find_moving():
            name = names.add(prim.GetName())
            self._moving[prim.GetPath()] = name
            self._add_body(scene, name, self._read_matrix(cache, prim))
        swarm_names: list[str] = []
        for prim in self._traverse(self._stage.GetPseudoRoot()):
            if prim.IsA(self._geom.PointInstancer):
                swarm_names += self._add_instances(scene, cache, prim, names)
            elif self._is_soft(prim):
                self._add_soft(scene, cache, prim, names)
            else:
                self._add_prim(scene, prim, self._read_matrix(cache, prim), self._find_body(prim))
        self.bodies = [*self._moving.values(), *swarm_names]
        robots = Names()
        for root, links, parents, moves in content.find_joint_trees(self._stage, self._moving):
            if (gripper := find_gripper(parents, moves)) is not None:
                name = robots.add(root.GetParentPath().name or root.name)
                self.robots = (*self.robots, make_robot(name, [self._moving[p] for p in links], gripper))
        self.notes = tuple(dict.fromkeys(self._notes))

    def _traverse(self, root: Any) -> Iterator[Any]:
        """Yield prims that are drawn, those of instances too; of point instancers not their prototypes."""
        prims = iter(self._usd.PrimRange(root, self._usd.TraverseInstanceProxies(self._usd.PrimDefaultPredicate)))
        for prim in prims:
            imageable = self._geom.Imageable(prim)
            if imageable and imageable.GetVisibilityAttr().Get(self._time) == self._geom.Tokens.invisible:
                prims.PruneChildren()
                continue
            if imageable and str(imageable.ComputePurpose()) not in _SHOWN:
                continue
            yield prim
            if prim.IsA(self._geom.PointInstancer):
                prims.PruneChildren()

    def _find_moving(self) -> list[Any]:
        from pxr import UsdPhysics

        prims = [prim for prim in self._stage.Traverse() if prim.IsA(self._geom.Xformable)]
        found = [
            prim
            for prim in prims
            if prim.HasAPI(UsdPhysics.RigidBodyAPI) or self._geom.Xformable(prim).TransformMightBeTimeVarying()
        ]
        if found:
            return found
        root = self._stage.GetDefaultPrim() or self._stage.GetPseudoRoot()
        others = [prim for prim in root.GetChildren() if not prim.IsA(self._geom.PointInstancer)]
        return [prim for prim in others if prim.IsA(self._geom.Xformable) and not self._is_soft(prim)]

    def _add_body(self, scene: SceneBuilder, name: str, T_world_prim: Floats) -> None:
        pose, _ = split_rigid(T_world_prim)
        scene.add_body(name, position=pose.p, quaternion=pose.q)
        self._T_body_world[name] = np.asarray(np.linalg.inv(to_matrix(pose)), np.float64)

    def _find_body(self, prim: Any) -> str:
        """Return the name of the moving body that a prim belongs to, empty for the world."""
        path = prim.GetPath()
        while not path.isEmpty and path != path.absoluteRootPath:
            if path in self._moving:
                return self._moving[path]
            path = path.GetParentPath()
        return ""

    def _read_matrix(self, cache: Any, prim: Any) -> Floats:
        """Return T_world_prim (4, 4) in metres, with scale."""
        return self._T_world_stage @ np.array(cache.GetLocalToWorldTransform(prim), np.float64).T

    def _add_prim(self, scene: SceneBuilder, prim: Any, T_world_prim: Floats, on: str) -> None:
        """Add the shape or mesh of one prim to a body, or to the world."""
        T_body_prim = T_world_prim
        if on:
            T_body_prim = self._T_body_world[on] @ T_world_prim
        name, time = prim.GetName(), self._time
        try:
            if prim.IsA(self._geom.Mesh):
                for part in content.read_mesh_parts(prim, time):
                    scene.add_mesh_arrays(name, part.mesh, transform=T_body_prim, on=on, **part.look)
            elif prim.GetTypeName() == "Cone":
                look = read_look(prim, prim)
                scene.add_mesh_arrays(name, content.read_cone(prim, time), transform=T_body_prim, on=on, **look)
            elif (shape := content.read_shape(prim, time)) is not None:
                content.add_shape(scene, name, shape, T_body_prim @ shape.turn, on, read_look(prim, prim))
            elif prim.IsA(self._geom.Gprim):
                self._notes.append(f"{prim.GetPath()}: a {prim.GetTypeName()} is not shown")
            elif prim.GetTypeName() == "DistantLight":
                direction = -T_world_prim[:3, 2]
                scene.add_light(name, direction=direction.tolist())
        except (SceneBuildError, OSError) as error:
            self._notes.append(f"{prim.GetPath()}: {error}")

    def _add_instances(self, scene: SceneBuilder, cache: Any, prim: Any, names: Names) -> list[str]:
        """Add the instances of a point instancer; return the names of those that move."""
        instancer = self._geom.PointInstancer(prim)
        matrices, kinds = self._read_instances(cache, prim), instancer.GetProtoIndicesAttr().Get(self._time) or []
        prototypes = [self._stage.GetPrimAtPath(path) for path in instancer.GetPrototypesRel().GetForwardedTargets()]
        moves = any(
            attribute.ValueMightBeTimeVarying()
            for attribute in (instancer.GetPositionsAttr(), instancer.GetOrientationsAttr())
        )
        mask = instancer.ComputeMaskAtTime(self._time)
        found = []
        for number, (matrix, kind) in enumerate(zip(matrices, kinds, strict=False)):
            root = prototypes[kind]
            on = self._find_body(prim)
            if moves:
                on = names.add(f"{prim.GetName()}_{number}")
                self._add_body(scene, on, matrix)
                found.append(on)
            if len(mask) and not mask[number]:
                continue
            T_root = np.linalg.inv(np.array(cache.GetLocalToWorldTransform(root), np.float64).T)
            for part in self._usd.PrimRange(root, self._usd.TraverseInstanceProxies()):
                T_root_part = T_root @ np.array(cache.GetLocalToWorldTransform(part), np.float64).T
                self._add_prim(scene, part, matrix @ T_root_part, on)
        if moves:
            self._swarms.append((prim, len(found)))
        return found

    def _read_instances(self, cache: Any, prim: Any) -> list[Floats]:
        """Return T_world_instance (4, 4) of every instance, with that of its prototype's root."""
        instancer = self._geom.PointInstancer(prim)
        all_of_them = self._geom.PointInstancer.IgnoreMask
        given = instancer.ComputeInstanceTransformsAtTime(
            self._time, self._time, self._geom.PointInstancer.IncludeProtoXform, all_of_them
        )
        T_world_prim = self._read_matrix(cache, prim)
        return [T_world_prim @ np.array(matrix, np.float64).T for matrix in given]

    def _is_soft(self, prim: Any) -> bool:
        if not prim.IsA(self._geom.Mesh):
            return False
        points = self._geom.PointBased(prim).GetPointsAttr()
        return points.ValueMightBeTimeVarying() or any(
            "Deformable" in name for name in prim.GetPrimTypeInfo().GetAppliedAPISchemas()
        )

    def _add_soft(self, scene: SceneBuilder, cache: Any, prim: Any, names: Names) -> None:
        triangles, _, _ = content.read_triangles(prim, self._time)
        name = names.add(prim.GetName())
        try:
            scene.add_deformable(name, self._read_vertices(cache, prim), triangles, **read_look(prim, prim))
        except (SceneBuildError, OSError) as error:
            self._notes.append(f"{prim.GetPath()}: {error}")
        else:
            self._soft[name] = prim

    # --- every state --------------------------------------------------------------------------------------------------

    def read_state(self, time_code: float | None = None) -> SimulationState:
        """Return the state of the stage now, or at a time of its animation."""
        if time_code is not None:
            self._time = self._usd.TimeCode(time_code)
            start = self._stage.GetStartTimeCode() if self._stage.HasAuthoredTimeCodeRange() else 0.0
            self._time_s = max(0.0, (float(time_code) - start) / self._stage.GetTimeCodesPerSecond())
        cache = self._geom.XformCache(self._time)
        matrices = [self._read_matrix(cache, self._stage.GetPrimAtPath(path)) for path in self._moving]
        for prim, count in self._swarms:
            matrices += self._read_instances(cache, prim)[:count]
        poses = [split_rigid(matrix)[0] for matrix in matrices]
        vertices: Mapping[str, Floats] = {name: self._read_vertices(cache, prim) for name, prim in self._soft.items()}
        return SimulationState(
            self._time_s,
            np.array([pose.p for pose in poses]).reshape(-1, 3),
            np.array([pose.q for pose in poses]).reshape(-1, 4),
            vertices,
        )

    def _read_vertices(self, cache: Any, prim: Any) -> Floats:
        T_world_prim = self._read_matrix(cache, prim)
        return content.read_points(prim, self._time) @ T_world_prim[:3, :3].T + T_world_prim[:3, 3]


def _open_stage(path: str) -> Any:
    try:
        from pxr import Tf, Usd
    except ImportError:
        raise SimulatorError(f"{path!r}: USD files need the package usd-core: pip install usd-core") from None
    try:
        return Usd.Stage.Open(path)
    except Tf.ErrorException as error:
        raise SimulatorError(f"{path!r} cannot be opened as a USD stage: {str(error).splitlines()[0]}") from None
