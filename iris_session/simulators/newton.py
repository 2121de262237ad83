"""Newton: a solver, whose `step` is followed: the state that it has written is what is shown.

Of several worlds the first is shown, with what belongs to all of them. Triangles between particles (cloths, surfaces of
soft bodies) are streams of vertices. The targets of robots are for the program: `session.targets()` has them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.common import Pose
from iris_session.protocol.specs import RobotSpec
from iris_session.scene.builder import AppearanceOptions, SceneBuilder, check_mesh
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.nodes import to_matrix, to_pose
from iris_session.simulators.adapter import Adapter, Floats, Names, SimulationState, find_gripper, from_xyzw, make_robot
from iris_session.simulators.wrapping import SimulatorError, wrap_method

#: Rotation of a world whose x or y axis points up, to z.
_TO_Z_UP: Final = {
    "X": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    "Y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "Z": np.eye(3),
}


_CAPTURED: Final = "steps in a captured graph are not followed: call session.sync() after each launch"


class NewtonAdapter(Adapter):
    """A solver with its model."""

    name = "newton"

    def __init__(self, solver: Any) -> None:
        import newton

        model = getattr(solver, "model", None)
        if model is None or not callable(getattr(solver, "step", None)):
            kind = type(solver).__name__
            raise SimulatorError(f"{kind} of Newton has no step: give the solver, iris_session.share(solver)")
        self._newton, self._solver, self._model = newton, solver, model
        self._R_world_model = _TO_Z_UP[newton.Axis(int(model.up_axis)).name]
        self._state: Any = None
        self._rows: NDArray[np.int64] = np.zeros(0, np.int64)
        self._soft: dict[str, NDArray[np.int64]] = {}
        self._time_s = 0.0

    # --- the scene ----------------------------------------------------------------------------------------------------

    def build(self, scene: SceneBuilder) -> None:
        """Add all bodies with their visible shapes, and what deforms."""
        model, names, notes = self._model, Names(), []
        self._state = model.state()
        if model.joint_count:
            self._newton.eval_fk(model, model.joint_q, model.joint_qd, self._state)
        worlds = _read(model.body_world, model.body_count, -1)
        self._rows = np.nonzero(worlds <= 0)[0]
        labels = [str(model.body_label[row]) for row in self._rows]
        p, q = self._read_bodies()
        bodies = [names.add("/".join(label.split("/")[-2:])) for label in labels]
        for name, position, quaternion in zip(bodies, p, q, strict=True):
            scene.add_body(name, position=position, quaternion=quaternion)
        of_row = dict(zip(self._rows.tolist(), bodies, strict=True))
        owners, flags = _read(model.shape_body, model.shape_count, -1), _read(model.shape_flags, model.shape_count, 1)
        in_world = _read(model.shape_world, model.shape_count, -1)
        for shape in np.nonzero(flags & int(self._newton.ShapeFlags.VISIBLE))[0]:
            owner = int(owners[shape])
            if in_world[shape] > 0 or (owner >= 0 and owner not in of_row):
                continue
            try:
                self._add_shape(scene, int(shape), of_row.get(owner, ""))
            except SceneBuildError as error:
                notes.append(f"{model.shape_label[shape]}: {error}")
        for label, triangles in self._list_surfaces():
            used, index = np.unique(triangles, return_inverse=True)
            name = names.add(label)
            self._soft[name] = used
            scene.add_deformable(name, self._read_particles(used), index.reshape(-1, 3))
        self.bodies, self.notes = bodies, tuple(dict.fromkeys(notes))
        self.robots = tuple(self._find_robots(of_row))

    def _add_shape(self, scene: SceneBuilder, shape: int, on: str) -> None:
        model, kinds = self._model, self._newton.GeoType
        kind, source = kinds(int(model.shape_type.numpy()[shape])), model.shape_source[shape]
        row, scale = model.shape_transform.numpy()[shape].astype(float), model.shape_scale.numpy()[shape].astype(float)
        p, q = row[:3], from_xyzw(row[3:])
        transform = to_matrix(Pose(tuple(p.tolist()), tuple(q.tolist())))
        if not on:  # in the frame of the model
            turn = np.eye(4)
            turn[:3, :3] = self._R_world_model
            transform = turn @ transform
        look: AppearanceOptions = {}
        if model.shape_color is not None:
            look["rgba"] = np.clip(model.shape_color.numpy()[shape].astype(float), 0.0, 1.0).tolist()[:4]
        if kind in (kinds.MESH, kinds.CONVEX_MESH):
            triangles = np.asarray(source.indices, np.int64).reshape(-1, 3)
            mesh = check_mesh(f"mesh of {on!r}", np.asarray(source.vertices), triangles, None, None, None)
            scene.add_mesh_arrays("", mesh, transform=transform @ np.diag([*scale, 1.0]), on=on, **look)
            return
        pose = _to_pose(transform)
        place: dict[str, Any] = {"position": pose.p, "quaternion": pose.q, "on": on, **look}
        if kind == kinds.PLANE:
            scene.add_plane(half_size=(0.5 * scale[:2]).tolist(), **place)
        elif kind == kinds.SPHERE:
            scene.add_sphere(radius=scale[0], **place)
        elif kind == kinds.BOX:
            scene.add_box(half_size=scale.tolist(), **place)
        elif kind == kinds.ELLIPSOID:
            scene.add_ellipsoid(half_size=scale.tolist(), **place)
        elif kind == kinds.CAPSULE:
            scene.add_capsule(radius=scale[0], half_length=scale[1], **place)
        elif kind == kinds.CYLINDER:
            scene.add_cylinder(radius=scale[0], half_length=scale[1], **place)
        else:
            raise SceneBuildError(f"a shape of the kind {kind.name} is not shown")

    def _list_surfaces(self) -> Iterator[tuple[str, NDArray[np.int64]]]:
        """Yield labels and triangles of what deforms, one for each surface of the model that has a range of its own."""
        model = self._model
        triangles = _read(model.tri_indices, model.tri_count, 0).reshape(-1, 3)
        left = np.ones(len(triangles), bool)
        for number in range(int(getattr(model, "surface_count", 0))):
            begin, end = int(_at(model.surface_tri_start, number)), int(_at(model.surface_tri_end, number))
            if end > begin:
                left[begin:end] = False
                yield str(model.surface_label[number] or "surface"), triangles[begin:end]
        if left.any():
            yield "soft", triangles[left]

    def _find_robots(self, of_row: dict[int, str]) -> Iterator[RobotSpec]:
        """Yield the arms among the trees of joints."""
        model, kinds = self._model, self._newton.JointType
        parents = _read(model.joint_parent, model.joint_count, -1)
        children = _read(model.joint_child, model.joint_count, -1)
        types = _read(model.joint_type, model.joint_count, 0)
        single, names = (int(kinds.REVOLUTE), int(kinds.PRISMATIC)), Names()
        roots = [int(c) for c, parent in zip(children, parents, strict=True) if parent < 0 and int(c) in of_row]
        seen = set(roots)
        for root in dict.fromkeys(roots):
            links, above, moves = [root], [-1], [False]
            for at, link in enumerate(links):  # grows
                for joint in np.nonzero(parents == link)[0]:
                    if int(children[joint]) in seen:  # a joint that closes a loop
                        continue
                    seen.add(int(children[joint]))
                    links.append(int(children[joint]))
                    above.append(at)
                    moves.append(int(types[joint]) in single)
            if (gripper := find_gripper(above, moves)) is not None:
                yield make_robot(names.add(of_row[root].split("/")[0]), [of_row[link] for link in links], gripper)

    # --- every state --------------------------------------------------------------------------------------------------

    def read_state(self, state: Any = None) -> SimulationState:
        """Return the poses of bodies and the vertices of what deforms, of `state` or of the newest that was written."""
        if state is not None:
            self._state = state
        p, q = self._read_bodies()
        vertices = {name: self._read_particles(used) for name, used in self._soft.items()}
        return SimulationState(self._time_s, p, q, vertices)

    def _read_bodies(self) -> tuple[Floats, Floats]:
        if not len(self._rows):
            return np.zeros((0, 3)), np.zeros((0, 4))
        rows = self._state.body_q.numpy()[self._rows].astype(np.float64)
        p, q = rows[:, :3], from_xyzw(rows[:, 3:])
        if (self._R_world_model == np.eye(3)).all():
            return p, q
        T = np.eye(4)
        T[:3, :3] = self._R_world_model
        poses = [_to_pose(T @ to_matrix(Pose(tuple(a), tuple(b)))) for a, b in zip(p.tolist(), q.tolist(), strict=True)]
        return np.array([pose.p for pose in poses]), np.array([pose.q for pose in poses])

    def _read_particles(self, used: NDArray[np.int64]) -> Floats:
        p: Floats = np.asarray(self._state.particle_q.numpy()[used], np.float64) @ self._R_world_model.T
        return p

    def wrap_step(self, before: Callable[[], None], after: Callable[[], None]) -> Callable[[], None]:
        """Follow `solver.step(state_in, state_out, control, contacts, dt)`, but not while a graph is captured."""

        def on_after(state_in: Any, state_out: Any, control: Any, contacts: Any, dt: float, **_: Any) -> None:
            self._state = state_out
            if self._model.device.is_capturing:  # nothing is computed yet, and reading would break the capture
                self.notes = tuple(dict.fromkeys((*self.notes, _CAPTURED)))
                return
            self._time_s += float(dt)
            after()

        return wrap_method(self._solver, "step", lambda *_, **__: before(), on_after)


def _read(array: Any, count: int, default: int) -> NDArray[np.int64]:
    """Return an array of the model, filled with a default where it has none."""
    if array is None or not count:
        return np.full(count, default, np.int64)
    return np.asarray(array.numpy() if hasattr(array, "numpy") else array, np.int64)


def _at(array: Any, number: int) -> Any:
    return array.numpy()[number] if hasattr(array, "numpy") else array[number]


def _to_pose(transform: Floats) -> Pose:

    return to_pose(transform[:3, :3], transform[:3, 3])
