"""Scene in which a plan of a handover is checked: arms with measured grippers, paths of their tips, and clashes.

Grippers are measured in the simulated scene, opened and closed: how their fingers move, how wide they open, where they
touch. A path is followed by the inverse kinematics of the session, from joint positions to joint positions, so it ends
where the arm would end. A clash is a pair of geoms that is closer than people who look and tremble can do with.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from anchors.pose import PoseTuple, Quat, compose, distance, inverse, quat_angle, quat_conj, quat_mul, quat_to_rotvec
from iris_session.control.arm_model import ArmModel, read_joint_ranges
from iris_session.control.config import SOLVER_NUMPY, ControlConfig
from iris_session.control.solvers import make_solver
from iris_session.emulator.behaviours.hand import TURN, HandMovement
from iris_session.emulator.behaviours.planned import PLANNED_ARM
from iris_session.physics import World
from iris_session.physics.names import find_element_id, list_body_names
from iris_session.physics.tip import Tip
from iris_session.physics.tree import KinematicTree
from iris_session.protocol.common import Vec3
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.session.errors import ConfigError

Floats = NDArray[np.float64]

#: Simulated time in which grippers open or close and objects come to rest [s].
SETTLE_S: Final = 0.8
#: A gripper opens to at least this [m].
MIN_OPENING: Final = 0.005
#: The grip point is this far from the ends of the fingers: least and most [m].
FROM_END: Final = (0.008, 0.020)
#: A direction so close to an axis of the tip is that axis (cosine of 20 degrees).
ALIGNED: Final = 0.94
#: Steps of a path [s]; steps after its end in which the arm may still arrive; error with which it has arrived.
STEP_S: Final = 0.08
LATE_STEPS: Final = 30
ARRIVED_M, ARRIVED_RAD = 0.002, 0.02
#: Steps of a cheap check whether a pose can be reached, their damping, and their greatest turn of a joint [rad].
TRIES: Final = 20
DAMPING: Final = 1e-3
MAX_STEP: Final = 0.5
#: Postures from which that check is made where the one at the start fails.
POSTURES: Final = 24
#: An arm whose tip moves less than this for a unit of joint movement, in some direction, is singular [m, rad].
SINGULAR: Final = 0.01
#: Least distances [m]: between robots beside their fingers, which control keeps apart; of robots from themselves, from
#: fingers of others, from what stands around, and from an object that they approach.
APART_M, SELF_M, FINGERS_M, AROUND_M, OBJECT_M = 0.028, 0.0, 0.003, 0.003, 0.001
ENVIRONMENT, OBJECT = -1, -2


class NoGripperError(ValueError):
    """An arm without a gripper of two fingers that can be measured; the message says why."""


class Gripper(NamedTuple):
    """A gripper as measured.

    `fingers`, `pads`: its two sides: a body, and the point in its frame that touches [m]. `T_tip_grip`: between the
    pads, z along the fingers, y the direction in which they close. `opening`: [m]. `joints`: addresses of its joints in
    `qpos`; `open`, `closed`: their positions; `sides`: the nearest geoms of both sides. `force`: with which each side
    presses when it is driven by motors [N]; infinite with servos, whose force depends on what stops them.
    """

    fingers: tuple[str, str]
    pads: tuple[Vec3, Vec3]
    T_tip_grip: PoseTuple
    opening: float
    joints: NDArray[np.intp]
    open: Floats
    closed: Floats
    sides: tuple[int, int]
    force: float


def compute_error(tip: PoseTuple, goal: PoseTuple) -> float:
    """Return how far a tip is from its goal, in units of what counts as arrived."""
    return max(distance(tip[0], goal[0]) / ARRIVED_M, quat_angle(tip[1], goal[1]) / ARRIVED_RAD)


class PlannedArm:
    """One arm: its kinematics, its gripper, and where it stands."""

    def __init__(self, model: mujoco.MjModel, spec: RobotSpec, data: Any) -> None:
        self.spec = spec
        self.chain = ArmModel(model, spec)
        config = ControlConfig(solver=SOLVER_NUMPY)
        self._solver = make_solver(self.chain, config)
        self.addresses = np.array([model.jnt_qposadr[j] for j in self.chain.joint_ids], dtype=np.intp)
        self.rest: Floats = data.qpos[self.addresses].copy()
        self._lower, self._upper = read_joint_ranges(model, [self.chain])
        slides = [int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_SLIDE) for j in self.chain.joint_ids]
        self._step = STEP_S * np.where(slides, config.slide_velocity, config.joint_velocity)
        self.T_world_root = _read_pose(data, self.chain.root_body)
        self.tip_at_rest = self.find_tip(self.rest)

    def find_tip(self, q: Floats) -> PoseTuple:
        """Return `T_world_tip` at joint positions, shape (n,)."""
        return compose(self.T_world_root, self.chain.forward_kinematics(q))

    def jump(self, q: Floats, goal: PoseTuple) -> Floats | None:
        """Return joint positions at a goal, found by few large steps from others, `None` where that fails: a cheap
        check before `follow`.
        """
        chain = self.chain
        lower, upper = self._lower[chain.to_chain], self._upper[chain.to_chain]
        p_goal, q_goal = compose(inverse(self.T_world_root), goal)
        error = np.empty(6)
        for _ in range(TRIES):
            (x, y, z), quat = chain.forward_kinematics(q)
            error[:3] = p_goal[0] - x, p_goal[1] - y, p_goal[2] - z
            error[3:] = quat_to_rotvec(quat_mul(q_goal, quat_conj(quat)))
            if math.hypot(*error[:3]) < ARRIVED_M and math.hypot(*error[3:]) < ARRIVED_RAD:
                return q
            J = self._compute_jacobian()
            step = J.T @ np.linalg.solve(J @ J.T + DAMPING * np.eye(6), error)
            step *= min(1.0, MAX_STEP / max(float(np.abs(step).max()), 1e-9))
            q = np.clip(q[chain.to_chain] + step, lower, upper)[chain.from_chain]
        return None

    def can_reach(self, goal: PoseTuple) -> bool:
        """Return whether some posture within joint limits reaches a goal, wherever the arm begins."""
        rng, lower, upper = np.random.default_rng(0), np.maximum(self._lower, -3.0), np.minimum(self._upper, 3.0)
        return any(self.jump(rng.uniform(lower, upper), goal) is not None for _ in range(POSTURES))

    def is_singular(self) -> bool:
        """Return whether the tip cannot move or turn every way at rest: joints are straight, or axes aligned."""
        self.find_tip(self.rest)
        return float(np.linalg.svd(self._compute_jacobian(), compute_uv=False)[-1]) < SINGULAR

    def _compute_jacobian(self) -> Floats:
        """Return the Jacobian of the tip at the joints of the last `forward_kinematics`, shape (6, n)."""
        model, data, J = self.chain.model, self.chain.data, np.empty((6, self.chain.model.nv))
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, J[:3], J[3:], 0)
        return J

    def follow(self, q: Floats, goal: PoseTuple) -> tuple[list[Floats], float]:
        """Move the tip straight to a goal as people do.

        Returns:
            Joint positions on the way, the last ones at its end, shape (n,) each; and how far from the goal it ends
            [m], 0 when it arrives.
        """
        movement = HandMovement.plan(self.find_tip(q), goal, 0.0, PLANNED_ARM.speed, TURN)
        steps = math.ceil(movement.duration_s / STEP_S)
        way = []
        missing = off = math.inf  # [m]; in units of what counts as arrived
        for k in range(1, steps + LATE_STEPS + 1):
            target = compose(inverse(self.T_world_root), movement.compute_pose(k * STEP_S))
            lower = np.minimum(np.maximum(self._lower - q, -self._step), 0.0)
            upper = np.maximum(np.minimum(self._upper - q, self._step), 0.0)
            q = self._solver.step(q, self.rest, target, lower, upper).q
            way.append(q)
            if k < steps:
                continue
            tip = self.find_tip(q)
            missing, before = distance(tip[0], goal[0]), off
            off = compute_error(tip, goal)
            if off < 1.0:
                return way, 0.0
            if off > 0.95 * before:
                break
        return way, max(missing, ARRIVED_M)


class PlanningScene:
    """A scene with its arms and one object, at rest, grippers open.

    Attributes:
        arms: Those with a gripper, by name.
        without: Why other robots cannot hold anything, by name.
        T_world_object: Where the object has come to rest.
        boxes: Boxes around the geoms of the object that can touch: pose in its frame, half extents [m].
    """

    def __init__(self, model: mujoco.MjModel, robots: Sequence[RobotSpec], thing: ObjectSpec, state: Any) -> None:
        self._model = copy.copy(model)
        grippers = [robot for robot in robots if robot.gripper_actuator]
        closed = _settle(self._model, state, grippers, opened=False)
        self._data = _settle(self._model, state, grippers, opened=True)
        self.arms: dict[str, PlannedArm] = {}
        self.grippers: dict[str, Gripper] = {}
        self.without = {robot.name: "has no gripper" for robot in robots if not robot.gripper_actuator}
        for robot in grippers:
            try:
                self.grippers[robot.name] = measure_gripper(self._model, robot, self._data, closed)
                self.arms[robot.name] = PlannedArm(self._model, robot, self._data)
            except NoGripperError as error:
                self.without[robot.name] = str(error)
        body = find_element_id(self._model, "body", thing.body)
        self._object_at = int(self._model.jnt_qposadr[self._model.body_jntadr[body]])
        self.T_world_object = _read_pose(self._data, body)
        self._weight = float(model.body_subtreemass[body] * np.linalg.norm(model.opt.gravity))
        self._qpos = self._data.qpos.copy()
        self._widths: dict[tuple[str, float], Floats] = {}
        self._sort_geoms(robots, body)
        self.boxes = [self._measure_box(int(g), body) for g in np.flatnonzero(self._owner == OBJECT)]
        self._model.geom_margin[:] = np.maximum(self._model.geom_margin, APART_M)
        self._usual: set[tuple[int, int]] = set()
        self._usual = set(self._list_close({}, self.T_world_object, (), rests=True))

    def _sort_geoms(self, robots: Sequence[RobotSpec], body: int) -> None:
        """Note the owner of each geom that can touch: index of a robot, `OBJECT` or `ENVIRONMENT`."""
        model, tree = self._model, KinematicTree(self._model)
        self._names = [robot.name for robot in robots]
        owner = np.full(model.nbody, ENVIRONMENT)
        owner[tree.list_subtree(body)] = OBJECT
        for index, robot in enumerate(robots):
            first = int(model.jnt_bodyid[find_element_id(model, "joint", robot.joints[0])])
            owner[tree.list_subtree(first)] = index
        fingers = {find_element_id(model, "body", name) for robot in robots for name in robot.finger_bodies}
        touches = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        self._owner = np.where(touches, owner[model.geom_bodyid], ENVIRONMENT)
        self._is_finger = np.isin(model.geom_bodyid, list(fingers))

    def _measure_box(self, geom: int, body: int) -> tuple[PoseTuple, Vec3]:
        centre, half = self._model.geom_aabb[geom, :3], self._model.geom_aabb[geom, 3:]
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, self._data.geom_xmat[geom])
        p = self._data.geom_xpos[geom] + self._data.geom_xmat[geom].reshape(3, 3) @ centre
        T_world_box = (_to_vector(p), _to_quat(quat))
        return compose(inverse(_read_pose(self._data, body)), T_world_box), _to_vector(half)

    def check_grip(self, name: str) -> None:
        """Raise `ConfigError` if the motors of a gripper are too weak for the object."""
        gripper = self.grippers[name]
        geoms = [*gripper.sides, *np.flatnonzero(self._owner == OBJECT)]
        friction = 2.0 * float(self._model.geom_friction[geoms, 0].max()) * gripper.force
        if friction < self._weight:
            raise ConfigError(
                f"the gripper of '{name}' presses with {gripper.force:.2g} N and holds {friction:.2g} N by friction, "
                f"but the object weighs {self._weight:.2g} N"
            )

    def find_weak_motor(self, name: str, q: Floats) -> str:
        """Return which motor cannot hold an arm at joint positions; empty: none."""
        model, arm = self._model, self.arms[name]
        data = mujoco.MjData(model)
        data.qpos[:] = self._qpos
        data.qpos[arm.addresses] = q
        mujoco.mj_forward(model, data)
        for joint, actuator in zip(arm.chain.joint_ids, arm.spec.actuators, strict=True):
            a, dof = find_element_id(model, "actuator", actuator), model.jnt_dofadr[joint]
            if not (_is_motor(model, a) and model.actuator_ctrllimited[a]):
                continue
            gain = abs(model.actuator_gainprm[a, 0] * model.actuator_gear[a, 0])
            most = gain * np.abs(model.actuator_ctrlrange[a]).max()
            needed = abs(data.qfrc_bias[dof] - data.qfrc_gravcomp[dof])
            if most < needed:
                unit = "N" if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE else "N m"
                takes = f"holding '{name}' on its way takes {needed:.2g} {unit}"
                return f"motor '{actuator}' has {most:.2g} {unit}, but {takes}"
        return ""

    def find_clash(
        self,
        joints: Mapping[str, tuple[Floats, float | None]],
        T_world_object: PoseTuple,
        holders: Sequence[str] = (),
        *,
        rests: bool = False,
    ) -> str:
        """Return what comes too close, empty where nothing does.

        Args:
            joints: By robot, where it is not at rest: joint positions, shape (n,), and the width that its gripper
                holds [m]; `None`: it is open.
            T_world_object: Where the object is.
            holders: Robots whose fingers hold the object.
            rests: The object rests on something.
        """
        pairs = self._list_close(joints, T_world_object, holders, rests=rests)
        names = [tuple(self._describe(g) for g in pair) for pair in pairs if pair not in self._usual]
        return " and ".join(names[0]) if names else ""

    def _describe(self, geom: int) -> str:
        owner = int(self._owner[geom])
        of = int(self._model.geom_bodyid[geom])
        body = self._model.body(of).name if of else self._model.geom(geom).name
        return "the object" if owner == OBJECT else self._names[owner] if owner >= 0 else body or "the surroundings"

    def _list_close(
        self,
        joints: Mapping[str, tuple[Floats, float | None]],
        T_world_object: PoseTuple,
        holders: Sequence[str],
        *,
        rests: bool,
    ) -> list[tuple[int, int]]:
        """Return the pairs of geoms that are too close; see `find_clash`."""
        data = self._data
        data.qpos[:] = self._qpos
        for name, (q, width) in joints.items():
            data.qpos[self.arms[name].addresses] = q
            if width is not None:
                data.qpos[self.grippers[name].joints] = self._find_fingers(name, width)
        data.qpos[self._object_at : self._object_at + 7] = (*T_world_object[0], *T_world_object[1])
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_collision(self._model, data)
        contact = data.contact
        geoms, gaps = contact.geom, contact.dist
        holding = [self._names.index(name) for name in holders]
        a, b = self._owner[geoms].T
        fingers = self._is_finger[geoms]
        either, both_robots = fingers.any(axis=1), (a >= 0) & (b >= 0)
        with_object = (a == OBJECT) | (b == OBJECT)
        robot = np.maximum(a, b)
        limits = np.full(len(gaps), AROUND_M)
        limits[both_robots & (a != b)] = np.where(either, FINGERS_M, APART_M)[both_robots & (a != b)]
        limits[both_robots & (a == b)] = SELF_M
        limits[both_robots & (a == b) & fingers.all(axis=1)] = -math.inf
        limits[with_object] = OBJECT_M
        limits[with_object & either & np.isin(robot, holding)] = -math.inf
        limits[with_object & (robot < 0)] = -math.inf if rests else 0.0
        limits[(a == b) & (a < 0)] = -math.inf
        return [(int(g), int(h)) for g, h in np.sort(geoms[gaps < limits], axis=1)]

    def _find_fingers(self, name: str, width: float) -> Floats:
        """Return the positions of the joints of a gripper whose pads are this far apart [m]."""
        key = (name, width)
        if key not in self._widths:
            one = self.grippers[name]
            low, high = 0.0, 1.0  # share from open to closed
            for _ in range(10):
                middle = 0.5 * (low + high)
                self._data.qpos[one.joints] = one.open + middle * (one.closed - one.open)
                mujoco.mj_kinematics(self._model, self._data)
                gap = mujoco.mj_geomDistance(self._model, self._data, *one.sides, 1.0, np.empty(6))
                low, high = (middle, high) if gap > width else (low, middle)
            self._widths[key] = one.open + low * (one.closed - one.open)
        return self._widths[key]


# --- grippers ---------------------------------------------------------------------------------------------------------


def _settle(model: mujoco.MjModel, state: Any, robots: Sequence[RobotSpec], *, opened: bool) -> Any:
    """Return the state after grippers have opened or closed and objects have come to rest; arms stand still."""
    data = mujoco.MjData(model)
    mujoco.mj_copyData(data, model, state)
    moving = {int(model.jnt_bodyid[find_element_id(model, "joint", robot.joints[-1])]) for robot in robots}
    tree = KinematicTree(model)
    below = {b for link in moving for b in tree.list_subtree(link)} - moving
    free = int(mujoco.mjtJoint.mjJNT_FREE)
    still = [j for j in range(model.njnt) if int(model.jnt_type[j]) != free and int(model.jnt_bodyid[j]) not in below]
    positions, dofs = model.jnt_qposadr[still], model.jnt_dofadr[still]  # of hinges and slides; balls stay by friction
    before = data.qpos[positions].copy()
    for robot in robots:
        for one in robot.gripper_actuators:
            data.ctrl[find_element_id(model, "actuator", one.actuator)] = one.open if opened else one.closed
    for _ in range(math.ceil(SETTLE_S / model.opt.timestep)):
        mujoco.mj_step(model, data)
        data.qpos[positions], data.qvel[dofs] = before, 0.0
    mujoco.mj_kinematics(model, data)
    return data


def measure_gripper(model: mujoco.MjModel, robot: RobotSpec, opened: Any, closed: Any) -> Gripper:
    """Return the gripper of a robot from the scene with it open and closed. Raises `NoGripperError`."""
    tip = Tip(model, robot)
    T_world_tip = tip.read_pose(opened)
    bodies = [find_element_id(model, "body", name) for name in robot.finger_bodies]
    touches = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies) & touches)
    moved = closed.geom_xpos[geoms] - opened.geom_xpos[geoms]
    if not len(geoms) or float(np.abs(moved).max()) < MIN_OPENING / 2.0:
        raise NoGripperError("has fingers that do not move or cannot touch anything")
    across = np.linalg.svd(moved, full_matrices=False)[2][0]
    link = int(model.jnt_bodyid[find_element_id(model, "joint", robot.joints[-1])])
    centre = np.array(T_world_tip[0])
    fingers_at = opened.geom_xpos[geoms].mean(axis=0)
    ahead = centre - opened.xpos[link] + (fingers_at - opened.xpos[link])
    frame = _snap_frame(_to_matrix(T_world_tip[1]), across, ahead)
    z, y = frame[:, 2], frame[:, 1]
    corners = {int(g): _list_corners(model, opened, int(g)) - centre for g in geoms}
    one_side = [g for g, points in corners.items() if float((points @ y).mean()) > 0.0]
    sides = one_side, [g for g in corners if g not in one_side]
    if not all(sides):
        raise NoGripperError("has no two fingers that close on each other")
    end = min(max(float((corners[g] @ z).max()) for g in side) for side in sides)
    ends = [[g for g in side if float((corners[g] @ z).max()) > end - 2.0 * FROM_END[1]] for side in sides]
    points = np.empty(6)
    opening, *pair = min(
        (mujoco.mj_geomDistance(model, opened, a, b, 1.0, points), a, b) for a, b in itertools.product(*ends)
    )
    if opening < MIN_OPENING:
        raise NoGripperError(f"has a gripper that opens to {1e3 * max(opening, 0.0):.0f} mm")
    mujoco.mj_geomDistance(model, opened, *pair, 1.0, points)
    touching = [float((points[:3] - centre) @ y), float((points[3:] - centre) @ y)]
    depth = min(max(0.0, end - FROM_END[1]), end - FROM_END[0])
    grip = centre + depth * z + 0.5 * sum(touching) * y
    names, pads = [], []
    for geom, at in zip(pair, touching, strict=True):
        body = int(model.geom_bodyid[geom])
        local = opened.xmat[body].reshape(3, 3).T @ (centre + depth * z + at * y - opened.xpos[body])
        names.append(list_body_names(model)[body])
        pads.append(_to_vector(local))
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, frame.ravel())
    tree = KinematicTree(model)
    below = [j for b in tree.list_subtree(link) if b != link for j in tree.list_joints(b)]
    joints = np.array([model.jnt_qposadr[j] for j in below], dtype=np.intp)
    T_tip_grip = compose(inverse(T_world_tip), (_to_vector(grip), _to_quat(quat)))
    return Gripper(
        (names[0], names[1]),
        (pads[0], pads[1]),
        T_tip_grip,
        opening,
        joints,
        opened.qpos[joints].copy(),
        closed.qpos[joints].copy(),
        (pair[0], pair[1]),
        _compute_motor_force(
            model, robot, opened, closed, opening - mujoco.mj_geomDistance(model, closed, *pair, 1.0, None)
        ),
    )


def _is_motor(model: mujoco.MjModel, actuator: int) -> bool:
    return not (model.actuator_biastype[actuator] or model.actuator_dyntype[actuator])


def _compute_motor_force(model: mujoco.MjModel, robot: RobotSpec, opened: Any, closed: Any, travel: float) -> float:
    """Return the force between the fingers from the work of their motors over `travel` [m], see `Gripper.force`."""
    work = 0.0
    for one in robot.gripper_actuators:
        a = find_element_id(model, "actuator", one.actuator)
        if not _is_motor(model, a):
            return math.inf
        work += model.actuator_gainprm[a, 0] * one.closed * (closed.actuator_length[a] - opened.actuator_length[a])
    return abs(float(work)) / max(travel, 1e-6)


def _snap_frame(tip: Floats, across: Floats, ahead: Floats) -> Floats:
    """Return the axes of the grip in the world, columns of shape (3, 3): y across, z ahead; axes of the tip where they
    are close to these.
    """
    y = _snap(tip, across)
    z = _snap(tip, ahead - float(ahead @ y) * y)
    z = z - float(z @ y) * y
    z /= np.linalg.norm(z)
    return np.stack([np.cross(y, z), y, z], axis=1)


def _snap(axes: Floats, direction: Floats) -> Floats:
    direction = direction / np.linalg.norm(direction)
    along = axes.T @ direction
    k = int(np.argmax(np.abs(along)))
    nearest: Floats = axes[:, k] * np.sign(along[k])
    return nearest if abs(along[k]) > ALIGNED else direction


def _list_corners(model: mujoco.MjModel, data: Any, geom: int) -> Floats:
    """Return the corners of the box around a geom in the world [m], shape (8, 3)."""
    centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    corners: Floats = data.geom_xpos[geom] + (centre + signs * half) @ data.geom_xmat[geom].reshape(3, 3).T
    return corners


def _to_matrix(q: Quat) -> Floats:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.array(q))
    return matrix.reshape(3, 3)


def _to_vector(p: Floats) -> Vec3:
    x, y, z = p.tolist()
    return (x, y, z)


def _to_quat(q: Floats) -> Quat:
    w, x, y, z = q.tolist()
    return (w, x, y, z)


def _read_pose(data: Any, body: int) -> PoseTuple:
    return _to_vector(data.xpos[body]), _to_quat(data.xquat[body])


def make_state(model: mujoco.MjModel, robots: Sequence[RobotSpec], objects: Sequence[ObjectSpec]) -> Any:
    """Return the state in which a session of this model begins."""
    return World(model, robots, objects).data
