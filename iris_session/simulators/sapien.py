"""SAPIEN: a scene, and the first scene of a ManiSkill environment.

Bodies are drawn as their render bodies, or as their collision shapes where a scene has no render system. Textures are
not read. SAPIEN has no clock: time is the number of steps that were followed. Robots are moved by the inverse
kinematics of Pinocchio, which SAPIEN brings, and the drives of their joints; without `set_drive_properties` they stay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from anchors.pose import PoseTuple, compose, inverse
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import RobotSpec
from iris_session.scene.builder import AppearanceOptions, SceneBuilder, check_mesh
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.nodes import to_matrix
from iris_session.simulators.adapter import Adapter, Floats, Names, SimulationState, TipTarget, find_gripper, make_robot
from iris_session.simulators.joint_targets import Joints, JointTargets, place_fingers
from iris_session.simulators.wrapping import SimulatorError, wrap_method

#: Rotation from z, along which our shapes lie, to x, along which those of PhysX do.
_Z_TO_X: Final[PoseTuple] = ((0.0, 0.0, 0.0), (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0))


class _Arm(NamedTuple):
    """A robot: articulation, model for inverse kinematics, link of the tip, active joints of its arm and fingers."""

    articulation: Any
    model: Any
    tip: int
    joints: list[int]
    fingers: list[int]


class SapienAdapter(Adapter):
    """A scene."""

    drives = True
    name = "sapien"

    def __init__(self, simulation: Any) -> None:
        owner = getattr(simulation, "scene", simulation)  # of an environment
        scene = owner.sub_scenes[0] if getattr(owner, "sub_scenes", None) else owner  # ManiSkill has several in one
        if not hasattr(scene, "entities") or not hasattr(scene, "timestep"):
            raise SimulatorError(f"{type(simulation).__name__} is no scene of SAPIEN: give the sapien.Scene")
        self._owner, self._scene = owner, scene
        self._entities: list[Any] = []
        self._arms: dict[str, _Arm] = {}
        self._targets = JointTargets()
        self._time_s = 0.0

    # --- the scene ----------------------------------------------------------------------------------------------------

    def build(self, scene: SceneBuilder) -> None:
        """Add all entities."""
        names, notes, bodies = Names(), [], []
        of_link = {
            link.entity: f"{articulation.name or 'robot'}/{link.name}"
            for articulation in self._scene.get_all_articulations()
            for link in articulation.links
        }
        for entity in self._scene.entities:
            shapes = list(_list_shapes(entity))
            link = of_link.get(entity, "")
            if not shapes and not link:  # lights, cameras
                continue
            name = names.add(link or entity.name or "entity")
            scene.add_body(name, position=entity.pose.p.tolist(), quaternion=entity.pose.q.tolist())
            self._entities.append(entity)
            bodies.append(name)
            for shape in shapes:
                try:
                    _add_shape(scene, name, shape)
                except SceneBuildError as error:
                    notes.append(f"{name}: {error}")
        self.bodies, self.notes = bodies, tuple(dict.fromkeys(notes))
        self.robots = tuple(self._find_robots(dict(zip(self._entities, bodies, strict=True))))

    def _find_robots(self, bodies: Mapping[Any, str]) -> Iterator[RobotSpec]:
        for articulation in self._scene.get_all_articulations():
            links = articulation.links
            at = {link.index: i for i, link in enumerate(links)}
            parents = [at[link.parent.index] if link.parent is not None else -1 for link in links]
            active = {joint.name: i for i, joint in enumerate(articulation.active_joints)}
            moves = [link.joint.name in active for link in links]
            gripper = find_gripper(parents, moves)
            if gripper is None:
                continue
            chain, link = [], gripper[0]
            while link > 0:
                chain += [active[links[link].joint.name]] if moves[link] else []
                link = parents[link]
            fingers = [active[links[finger].joint.name] for finger in gripper[1]]
            own = [bodies[link.entity] for link in links]
            name = articulation.name or own[0].split("/")[0]
            name = name if name not in self._arms else own[0]
            model = articulation.create_pinocchio_model()
            self._arms[name] = _Arm(articulation, model, links[gripper[0]].index, chain[::-1], fingers)
            yield make_robot(name, own, gripper)

    # --- every state --------------------------------------------------------------------------------------------------

    def read_state(self) -> SimulationState:
        """Return the poses of all entities."""
        poses = [entity.pose for entity in self._entities]
        return SimulationState(
            self._time_s,
            np.array([pose.p for pose in poses], np.float64).reshape(-1, 3),
            np.array([pose.q for pose in poses], np.float64).reshape(-1, 4),
        )

    def wrap_step(self, before: Callable[[], None], after: Callable[[], None]) -> Callable[[], None]:
        """Follow `scene.step`."""

        def on_after(*_: Any, **__: Any) -> None:
            self._time_s += float(self._scene.timestep)
            after()

        return wrap_method(self._owner, "step", lambda *_, **__: before(), on_after)

    # --- robots -------------------------------------------------------------------------------------------------------

    def apply_targets(self, targets: Mapping[str, TipTarget]) -> None:
        """Set the drive targets of the robots' joints."""
        for name, target in targets.items():
            arm = self._arms[name]
            joints, own = arm.articulation.active_joints, arm.joints
            limits = np.array([np.asarray(joint.limits).reshape(-1, 2)[0] for joint in joints], np.float64)
            found = None if target.stops else _solve(arm, target.pose)
            if target.stops or found is not None:
                q, v = np.asarray(arm.articulation.qpos)[own], np.asarray(arm.articulation.qvel)[own]
                in_force = [float(np.ravel(joints[i].drive_target)[0]) for i in own]
                speeds = [joints[i].max_velocity for i in own]
                moved = Joints(q, v, in_force, limits[own, 0], limits[own, 1], speeds)
                goal = self._targets.limit(name, (self._time_s, float(self._scene.timestep)), moved, found)
                for joint, place in zip(own, goal.tolist(), strict=True):
                    joints[joint].set_drive_target(place)
            if target.gripper is not None:
                fingers = [(i, *limits[i].tolist(), str(joints[i].type) == "prismatic") for i in arm.fingers]
                for joint, place in place_fingers(fingers, target.gripper).items():
                    joints[joint].set_drive_target(place)


def _solve(arm: _Arm, pose: Pose) -> Floats | None:
    """Return positions of an arm's joints at which its tip has a pose, `None` when none are found."""
    import sapien

    root = arm.articulation.root_pose
    p, q = compose(inverse((tuple(root.p.tolist()), tuple(root.q.tolist()))), (pose.p, pose.q))
    mask = np.zeros(arm.articulation.dof, np.int32)
    mask[arm.joints] = 1
    now = np.asarray(arm.articulation.qpos)
    found, is_solved, _ = arm.model.compute_inverse_kinematics(
        arm.tip, sapien.Pose(list(p), list(q)), initial_qpos=now, active_qmask=mask, max_iterations=100
    )
    return np.asarray(found, np.float64)[arm.joints] if is_solved else None


def _list_shapes(entity: Any) -> Iterator[Any]:
    """Yield the shapes by which an entity is drawn."""
    drawn = [one for one in entity.components if type(one).__name__ == "RenderBodyComponent"]
    if drawn:
        for component in drawn:
            yield from component.render_shapes
        return
    for component in entity.components:
        yield from getattr(component, "collision_shapes", ())


def _add_shape(scene: SceneBuilder, on: str, shape: Any) -> None:
    pose: PoseTuple = (tuple(shape.local_pose.p.tolist()), tuple(shape.local_pose.q.tolist()))
    kind, look = type(shape).__name__, _read_look(getattr(shape, "material", None))
    p, q = compose(pose, _Z_TO_X)
    along: dict[str, Any] = {"position": p, "quaternion": q, "on": on, **look}
    if kind.endswith("Box"):
        half = np.asarray(shape.half_size).tolist()
        scene.add_box(half_size=half, position=pose[0], quaternion=pose[1], on=on, **look)
    elif kind.endswith("Sphere"):
        scene.add_sphere(radius=float(shape.radius), position=pose[0], on=on, **look)
    elif kind.endswith("Capsule"):
        scene.add_capsule(radius=float(shape.radius), half_length=float(shape.half_length), **along)
    elif kind.endswith("Cylinder"):
        scene.add_cylinder(radius=float(shape.radius), half_length=float(shape.half_length), **along)
    elif kind.endswith("Plane"):
        scene.add_plane(**along)
    elif kind.endswith("Mesh"):
        transform = to_matrix(Pose(*pose)) @ np.diag([*np.asarray(shape.scale, np.float64).reshape(3), 1.0])
        for part in getattr(shape, "parts", [shape]):
            vertices, triangles = np.asarray(part.vertices), np.asarray(part.triangles).reshape(-1, 3)
            mesh = check_mesh(f"mesh of {on!r}", vertices, triangles.astype(np.int64), None, None, None)
            own = _read_look(getattr(part, "material", None)) or look
            scene.add_mesh_arrays("", mesh, transform=transform, on=on, **own)
    else:
        raise SceneBuildError(f"a {kind} is not shown")


def _read_look(material: Any) -> AppearanceOptions:
    color = getattr(material, "base_color", None)
    if color is None:
        return {}
    return {"rgba": [min(max(float(v), 0.0), 1.0) for v in color][:4]}
