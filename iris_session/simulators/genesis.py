"""Genesis: a built scene, with rigid and articulated entities, cloths and soft bodies; of many environments the first.

What deforms (PBD, FEM, MPM) is shown where its surface has the mode `visual`, which has a mesh; liquids and other
clouds of particles have none. Robots are moved by the inverse kinematics and position control of their entities.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from typing import Any, Final, NamedTuple

import numpy as np

from iris_session.protocol.common import Pose
from iris_session.scene.builder import AppearanceOptions, SceneBuilder, check_mesh
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.nodes import to_matrix
from iris_session.simulators.adapter import Adapter, Floats, Names, SimulationState, TipTarget
from iris_session.simulators.genesis_robots import GenesisRobots
from iris_session.simulators.wrapping import SimulatorError, wrap_method

#: End of the name that Genesis gives to an entity without one.
_OWN_NAME: Final = re.compile(r"_[0-9a-f]{7}$")
#: Pictures of ground planes repeat so often per metre.
_TILE_M: Final = 1.0


class _Soft(NamedTuple):
    """A deformable: its solver, and the rows of its vertices there."""

    solver: Any
    rows: slice


class GenesisAdapter(Adapter):
    """A scene."""

    drives = True
    name = "genesis"

    def __init__(self, scene: Any) -> None:
        if not hasattr(scene, "rigid_solver"):
            raise SimulatorError(f"{type(scene).__name__} of Genesis has no scene in it: give the gs.Scene")
        if not scene.is_built:
            raise SimulatorError("this Genesis scene is not built yet: call scene.build() before")
        self._scene = scene
        self._rows: list[tuple[Any, list[int]]] = []  # solvers, and the links of them that move
        self._robots = GenesisRobots(scene)
        self._soft: dict[str, _Soft] = {}
        self._notes: list[str] = []

    # --- the scene ----------------------------------------------------------------------------------------------------

    def build(self, scene: SceneBuilder) -> None:
        """Add all entities."""
        names, bodies, robots = Names(), [], []
        for solver in (self._scene.rigid_solver, self._scene.kinematic_solver):
            rows: list[int] = []
            for entity in solver.entities if solver.n_links else ():
                label = _OWN_NAME.sub("", entity.name)
                if type(entity.morph).__name__ == "Plane":
                    self._add_plane(scene, entity, label)
                    continue
                own = self._add_entity(scene, solver, entity, label, names)
                rows += [link.idx for link in entity.links]
                bodies += own
                robot = self._robots.find(entity, own, label)
                robots += [robot] if robot is not None else []
            self._rows.append((solver, rows))
        for name, entity, part, solver in self._list_soft():
            self._add_soft(scene, names.add(name), entity, part, solver)
        self.bodies, self.robots, self.notes = bodies, tuple(robots), tuple(dict.fromkeys(self._notes))

    def _add_entity(self, scene: SceneBuilder, solver: Any, entity: Any, label: str, names: Names) -> list[str]:
        p, q = _read_links(solver)
        single = len(entity.links) == 1
        own = []
        for link in entity.links:
            name = names.add(label if single else f"{label}/{link.name}")
            scene.add_body(name, position=p[link.idx].tolist(), quaternion=q[link.idx].tolist())
            own.append(name)
            for geom in link.vgeoms:
                (x, y, z), (w, i, j, k) = np.asarray(geom.init_pos).tolist(), np.asarray(geom.init_quat).tolist()
                self._add_mesh(scene, f"{name}_{geom.idx}", geom, to_matrix(Pose((x, y, z), (w, i, j, k))), name)
        return own

    def _add_mesh(self, scene: SceneBuilder, name: str, geom: Any, transform: Floats, on: str) -> None:
        uvs = None if geom.uvs is None or not len(geom.uvs) else np.array([1.0, -1.0]) * geom.uvs + np.array([0.0, 1.0])
        try:
            mesh = check_mesh(f"mesh {name!r}", geom.init_vverts, geom.init_vfaces, None, uvs, None)
            scene.add_mesh_arrays(name, mesh, transform=transform, on=on, **_read_look(geom.surface, uvs is not None))
        except SceneBuildError as error:
            self._notes.append(f"{name}: {error}")

    def _add_plane(self, scene: SceneBuilder, entity: Any, label: str) -> None:
        look = _read_look(entity.surface, True)
        if "texture" in look:
            look |= {"repeat": (1.0 / _TILE_M, 1.0 / _TILE_M), "uniform": True}
        p, q = (np.asarray(value.cpu(), np.float64).reshape(-1) for value in (entity.get_pos(), entity.get_quat()))
        scene.add_plane(label, position=p[:3].tolist(), quaternion=q[:4].tolist(), **look)

    def _list_soft(self) -> Iterator[tuple[str, Any, Any, Any]]:
        """Yield names, entities, parts with a mesh, and solvers of what deforms."""
        for solver in (self._scene.pbd_solver, self._scene.mpm_solver, self._scene.fem_solver):
            for entity in solver.entities if solver.is_active else ():
                label = _OWN_NAME.sub("", entity.name)
                if entity.surface.vis_mode != "visual":
                    self._notes.append(f"{label}: particles are not shown; gs.surfaces.Default(vis_mode='visual') is")
                    continue
                for part in getattr(entity, "vgeoms", None) or [entity]:
                    yield label, entity, part, solver

    def _add_soft(self, scene: SceneBuilder, name: str, entity: Any, part: Any, solver: Any) -> None:
        soft = _Soft(solver, slice(part.vvert_start, part.vvert_end))
        look = _read_look(getattr(part, "surface", entity.surface), False)
        try:
            scene.add_deformable(name, self._read_vertices(soft), np.asarray(part.vmesh.faces), **look)
        except SceneBuildError as error:
            self._notes.append(f"{name}: {error}")
        else:
            self._soft[name] = soft

    # --- every state --------------------------------------------------------------------------------------------------

    def read_state(self) -> SimulationState:
        """Return the poses of all links and the vertices of what deforms."""
        poses = [(*_read_links(solver), rows) for solver, rows in self._rows if rows]
        positions = np.concatenate([np.zeros((0, 3)), *(p[rows] for p, _, rows in poses)])
        quaternions = np.concatenate([np.zeros((0, 4)), *(q[rows] for _, q, rows in poses)])
        vertices = {name: self._read_vertices(soft) for name, soft in self._soft.items()}
        return SimulationState(self._read_time(), positions, quaternions, vertices)

    def _read_time(self) -> float:
        return float(np.asarray(self._scene.get_time().cpu(), np.float64).reshape(-1)[0])

    def _read_vertices(self, soft: _Soft) -> Floats:
        from genesis.utils.misc import qd_to_numpy

        if hasattr(soft.solver, "vverts_render"):
            soft.solver.update_render_fields()
            field = soft.solver.vverts_render.pos
        else:
            field = soft.solver.get_state_render(self._scene.sim.cur_substep_local)[0]
        given = qd_to_numpy(field)
        return np.asarray(given[soft.rows, 0], np.float64)

    def wrap_step(self, before: Callable[[], None], after: Callable[[], None]) -> Callable[[], None]:
        """Follow `scene.step` and `scene.reset`."""
        with ExitStack() as ends:
            ends.callback(wrap_method(self._scene, "step", lambda *_, **__: before(), lambda *_, **__: after()))
            ends.callback(wrap_method(self._scene, "reset", lambda *_, **__: None, lambda *_, **__: after()))
            return ends.pop_all().close

    def apply_targets(self, targets: Mapping[str, TipTarget]) -> None:
        """Move the robots by the inverse kinematics of their entities and position control of their joints."""
        self._robots.apply_targets(targets, self._read_time())


def _read_links(solver: Any) -> tuple[Floats, Floats]:
    """Return positions (n, 3) and quaternions (n, 4) of all links of a solver, in the first environment."""
    p, q = solver.get_links_pos(), solver.get_links_quat()
    return (
        np.asarray(p.cpu(), np.float64).reshape(-1, solver.n_links, 3)[0],
        np.asarray(q.cpu(), np.float64).reshape(-1, solver.n_links, 4)[0],
    )


def _read_look(surface: Any, has_uvs: bool) -> AppearanceOptions:
    """Return the colour or picture of a surface."""
    rgba = surface.get_rgba()
    image = getattr(rgba, "image_array", None)
    if image is not None and has_uvs:
        factor = [float(v) for v in np.ravel(rgba.image_color)]
        look: AppearanceOptions = {"texture": np.ascontiguousarray(image, np.uint8)}
        if len(factor) in (3, 4):
            look["rgba"] = factor
        return look
    color = (
        getattr(rgba, "color", None) if image is None else np.asarray(image).reshape(-1, image.shape[-1]).mean(0) / 255
    )
    if color is None or len(color) not in (3, 4):
        return {}
    return {"rgba": [min(max(float(v), 0.0), 1.0) for v in color]}
