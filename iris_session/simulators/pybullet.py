"""PyBullet: the bodies of one physics client.

Give the module `pybullet`, whose first connected client is shared, or a `BulletClient`. Its `stepSimulation` is
followed. Mesh files are read again as the simulation names them, which needs `pip install 'iris-session[files]'`.
Bodies that are loaded later are not shown. PyBullet has no clock: time is the number of steps that were followed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import ModuleType
from typing import Any, Final, NamedTuple

import numpy as np

from anchors.pose import PoseTuple, compose, inverse
from iris_session.scene.builder import SceneBuilder
from iris_session.scene.errors import SceneBuildError
from iris_session.simulators.adapter import (
    Adapter,
    Names,
    SimulationState,
    TipTarget,
    find_gripper,
    from_xyzw,
    make_robot,
)
from iris_session.simulators.joint_targets import Joints, JointTargets, place_fingers
from iris_session.simulators.wrapping import SimulatorError, wrap_method

#: Clients that one process can have.
_MAX_CLIENTS: Final = 1024
#: Most force of a motor whose joint has no limit of it, PyBullet's default [N or Nm].
_UNLIMITED_FORCE: Final = 100_000.0
#: Clients of which a session needs `_keep_clients_apart`.
_apart: list[int] = []


class _Joint(NamedTuple):
    """Limits of a joint: position, force and speed, of which 0 is none; and whether it slides."""

    low: float
    high: float
    force: float
    speed: float
    slides: bool


class _Arm(NamedTuple):
    """A robot: body, link of the tip, all joints that move, those of the arm among them, and those of the fingers."""

    body: int
    tip: int
    movable: dict[int, _Joint]
    driven: list[int]
    fingers: list[int]


class PyBulletAdapter(Adapter):
    """A physics client."""

    drives = True
    name = "pybullet"

    def __init__(self, simulation: Any) -> None:
        import pybullet

        self._owner = simulation if not isinstance(simulation, type) else pybullet
        self._client = _find_client(pybullet, simulation)
        self._p = pybullet
        self._links: dict[int, int] = {}  # number of links by body
        self._arms: dict[str, _Arm] = {}
        self._targets = JointTargets()
        self._T_com_base: dict[int, PoseTuple] = {}
        self._time_s = 0.0

    def _call(self, function: str, *args: Any, **kwargs: Any) -> Any:
        return getattr(self._p, function)(*args, **kwargs, physicsClientId=self._client)

    # --- the scene ----------------------------------------------------------------------------------------------------

    def build(self, scene: SceneBuilder) -> None:
        """Add all bodies with their links."""
        names, notes = Names(), []
        bodies: list[str] = []
        robots = []
        for number in range(self._call("getNumBodies")):
            body = self._call("getBodyUniqueId", number)
            base, label = (text.decode() for text in self._call("getBodyInfo", body))
            joints = [self._call("getJointInfo", body, i) for i in range(self._call("getNumJoints", body))]
            label = label or base or f"body_{body}"
            own = [names.add(label), *(names.add(f"{label}/{joint[12].decode()}") for joint in joints)]
            self._links[body] = len(joints)
            frame = self._call("getDynamicsInfo", body, -1)
            self._T_com_base[body] = inverse((frame[3], _to_wxyz(frame[4])))
            for link, (p, q) in zip(own, self._read_body(body), strict=True):
                scene.add_body(link, position=p, quaternion=q)
            for shape in self._call("getVisualShapeData", body):
                try:
                    self._add_shape(scene, own[shape[1] + 1], shape)
                except (SceneBuildError, ImportError) as error:
                    notes.append(f"{own[shape[1] + 1]}: {error}")
            parents = [-1, *(joint[16] + 1 for joint in joints)]
            moves = [False, *(joint[2] != self._p.JOINT_FIXED for joint in joints)]
            if (gripper := find_gripper(parents, moves)) is not None:
                robots.append(make_robot(label if label not in self._arms else own[0], own, gripper))
                kinds = {j[0]: _Joint(j[8], j[9], j[10], j[11], j[2] == self._p.JOINT_PRISMATIC) for j in joints}
                self._arms[robots[-1].name] = _make_arm(body, parents, moves, gripper, kinds)
            bodies += own
        self.bodies, self.robots, self.notes = bodies, tuple(robots), tuple(dict.fromkeys(notes))
        if not bodies:
            raise SimulatorError("this PyBullet client has no bodies: load them before the session begins")

    def _add_shape(self, scene: SceneBuilder, on: str, shape: tuple[Any, ...]) -> None:
        kind, size, file, rgba = shape[2], shape[3], shape[4].decode(), shape[7]
        place: dict[str, Any] = {"on": on, "position": shape[5], "quaternion": _to_wxyz(shape[6])}
        look: dict[str, Any] = {"rgba": tuple(min(max(float(v), 0.0), 1.0) for v in rgba)}
        if kind == self._p.GEOM_BOX:
            scene.add_box(half_size=[0.5 * v for v in size], **place, **look)
        elif kind == self._p.GEOM_SPHERE:
            scene.add_sphere(radius=size[0], **place, **look)
        elif kind == self._p.GEOM_CYLINDER:
            scene.add_cylinder(radius=size[1], half_length=0.5 * size[0], **place, **look)
        elif kind == self._p.GEOM_CAPSULE:
            scene.add_capsule(radius=size[1], half_length=0.5 * size[0], **place, **look)
        elif kind == self._p.GEOM_PLANE:
            scene.add_plane(**place, **look)
        elif kind == self._p.GEOM_MESH and file and "unknown" not in file:
            own = look if look["rgba"][:3] != (1.0, 1.0, 1.0) else {}  # white: as the file has it
            scene.add_file(file, scale=size, up="z", **place, **own)
        else:
            raise SceneBuildError("a visual mesh that is in no file is not shown")

    # --- every state --------------------------------------------------------------------------------------------------

    def read_state(self) -> SimulationState:
        """Return the poses of all links. Raises PyBullet's error when a body was removed."""
        poses = [pose for body in self._links for pose in self._read_body(body)]
        return SimulationState(self._time_s, np.array([p for p, _ in poses]), np.array([q for _, q in poses]))

    def _read_body(self, body: int) -> list[PoseTuple]:
        """Return T_world_link of the base and all links."""
        p, q = self._call("getBasePositionAndOrientation", body)
        poses = [compose((p, _to_wxyz(q)), self._T_com_base[body])]
        if self._links[body]:
            states = self._call("getLinkStates", body, list(range(self._links[body])), computeForwardKinematics=1)
            poses += [(state[4], _to_wxyz(state[5])) for state in states]
        return poses

    def wrap_step(self, before: Callable[[], None], after: Callable[[], None]) -> Callable[[], None]:
        """Follow `stepSimulation` of this client until it is disconnected: the next one may have its number."""

        def is_ours(args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> bool:
            given = args[0] if args else kwargs.get("physicsClientId", 0 if self._owner is self._p else self._client)
            return bool(given == self._client)

        def on_before(*args: Any, **kwargs: Any) -> None:
            if is_ours(args, kwargs):
                before()

        def on_after(*args: Any, **kwargs: Any) -> None:
            if is_ours(args, kwargs):
                self._time_s += self._call("getPhysicsEngineParameters")["fixedTimeStep"]
                after()

        def on_disconnect(*args: Any, **kwargs: Any) -> None:
            if is_ours(args, kwargs):
                wraps.close()

        with ExitStack() as ends:
            key = ("pybullet", self._client)  # a client, whether by the module or by a BulletClient
            ends.callback(wrap_method(self._owner, "stepSimulation", on_before, on_after, key))
            ends.callback(wrap_method(self._owner, "disconnect", lambda *_, **__: None, on_disconnect, key))
            if self._owner is self._p:
                ends.callback(_keep_clients_apart(self._p, self._client))
            wraps = ends.pop_all()
            return wraps.close

    # --- robots -------------------------------------------------------------------------------------------------------

    def apply_targets(self, targets: Mapping[str, TipTarget]) -> None:
        """Move the robots by PyBullet's inverse kinematics and position control of their joints."""
        for name, target in targets.items():
            arm = self._arms[name]
            w, x, y, z = target.pose.q
            now, v = np.array([state[:2] for state in self._call("getJointStates", arm.body, list(arm.movable))]).T
            low, high, _, speeds, _ = np.array(list(arm.movable.values()), np.float64).T
            lowest, highest = np.where(low < high, low, now - np.pi), np.where(low < high, high, now + np.pi)
            spans = {"lowerLimits": lowest, "upperLimits": highest, "jointRanges": highest - lowest, "restPoses": now}
            near = {key: value.tolist() for key, value in spans.items()}
            found = None  # stays
            if not target.stops:
                found = self._call("calculateInverseKinematics", arm.body, arm.tip, target.pose.p, (x, y, z, w), **near)
            at = (self._time_s, self._call("getPhysicsEngineParameters")["fixedTimeStep"])
            joints = Joints(now, v, now, low, high, speeds)  # motors of PyBullet hold without a lead
            goal = self._targets.limit(name, at, joints, found)
            goals = {joint: q for joint, q in zip(arm.movable, goal.tolist(), strict=True) if joint in arm.driven}
            if target.gripper is not None:
                fingers = [(i, arm.movable[i].low, arm.movable[i].high, arm.movable[i].slides) for i in arm.fingers]
                goals |= place_fingers(fingers, target.gripper)
            forces = [arm.movable[joint].force or _UNLIMITED_FORCE for joint in goals]
            how = {"targetPositions": list(goals.values()), "forces": forces}
            self._call("setJointMotorControlArray", arm.body, list(goals), self._p.POSITION_CONTROL, **how)


def _make_arm(
    body: int, parents: list[int], moves: list[bool], gripper: tuple[int, tuple[int, ...]], joints: dict[int, _Joint]
) -> _Arm:
    """Return a robot; links are counted from the base, joints of PyBullet from the first link."""
    chain, at = [], gripper[0]
    while at > 0:
        if moves[at]:
            chain.append(at - 1)
        at = parents[at]
    movable = {i - 1: joints[i - 1] for i, is_moving in enumerate(moves) if is_moving}
    return _Arm(body, gripper[0] - 1, movable, chain[::-1], [finger - 1 for finger in gripper[1]])


def _to_wxyz(q: Any) -> tuple[float, float, float, float]:
    w, x, y, z = from_xyzw(q).tolist()
    return w, x, y, z


def _find_client(pybullet: Any, simulation: Any) -> int:
    if not isinstance(simulation, ModuleType):
        client = getattr(simulation, "_client", None)
        if client is None:
            raise SimulatorError(f"{type(simulation).__name__} is no physics client: give pybullet or a BulletClient")
        return int(client)
    for client in range(_MAX_CLIENTS):
        if pybullet.getConnectionInfo(client)["isConnected"]:
            return client
    raise SimulatorError("pybullet is not connected: call pybullet.connect(pybullet.DIRECT) before")


def _keep_clients_apart(pybullet: Any, number: int) -> Callable[[], None]:
    """Let `BulletClient` give its number to our functions too, which it does for compiled functions only.

    Returns:
        A function that ends this, with the last session that needs it.
    """
    from pybullet_utils.bullet_client import BulletClient

    def step(client: Any, *args: Any, **kwargs: Any) -> None:
        pybullet.stepSimulation(*args, physicsClientId=client._client, **kwargs)

    def disconnect(client: Any) -> None:
        pybullet.disconnect(physicsClientId=client._client)

    def end() -> None:
        _apart.remove(number)
        if not _apart:
            del BulletClient.stepSimulation, BulletClient.disconnect

    if not _apart:
        BulletClient.stepSimulation, BulletClient.disconnect = step, disconnect
    _apart.append(number)
    return end
