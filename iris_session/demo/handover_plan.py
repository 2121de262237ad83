"""Planner of handovers: for any free object and any two arms with grippers of two fingers, who gives, who takes, how
each grasps, and where they meet.

Geometry and inverse kinematics only. Every movement of the plan is followed from where the arms stand, as people will
move them, within joint limits and without a clash. Candidates are tried in the order of the turns that they ask for,
up to fixed numbers, so that the same scene gives the same plan. Where there is none, one line says what failed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import mujoco
import numpy as np

from anchors.pose import (
    IDENTITY_QUAT,
    PoseTuple,
    Quat,
    Vec3,
    compose,
    distance,
    inverse,
    quat_angle,
    quat_conj,
    quat_from_rotvec,
    quat_mul,
    quat_rotate,
)
from iris_session.demo.planning_scene import (
    ARRIVED_M,
    ARRIVED_RAD,
    Floats,
    PlanningScene,
    compute_error,
    make_state,
)
from iris_session.emulator.behaviours.objects import raise_pose
from iris_session.emulator.behaviours.plan import ArmPlan, HandoverPlan
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.session.errors import ConfigError

#: Straight way to a grasp and back; and straight up after the first one [m].
BACK_M: Final = 0.10
LIFT_M: Final = 0.10
#: A grasp whose direction falls at least so steeply is one from above.
FROM_ABOVE: Final = -0.9
#: A gripper is opened wider than what it takes by this [m].
SPARE_M: Final = 0.008
#: Nearer to a grasp than this, an error says what turn is missing [m].
NEAR_M: Final = 0.05
#: How deep a grip is below the face from which an object is approached, at most [m].
DEPTH_M: Final = 0.020
#: Fingers that would stand on the table take it higher by this [m].
SHALLOWER_M: Final = 0.006
#: A box that is longer than this may also be taken near its ends [m].
LONG_M: Final = 0.10
#: Grasps of the giver, turns of both grippers at the meeting, and meetings that are tried.
MAX_GRASPS: Final = 4
MAX_TURNS: Final = 300
MAX_MEETINGS: Final = 4000
#: Greatest turn of a wrist [rad].
MAX_TURN: Final = math.radians(150.0)
#: Places of the meeting about the middle between the bases: along the line between them (shares of their distance),
#: across it and above the mean height of the tips at rest [m].
ALONG: Final = (0.0, -0.12, 0.12)
ACROSS: Final = (0.0, 0.15, -0.15, 0.28, -0.28)
ABOVE: Final = (0.0, 0.12, -0.10, 0.22)
#: Directions of the giver's gripper there: turns about the vertical from the way to the receiver, and pitch [rad].
YAWS: Final = tuple(math.radians(a) for a in (0, 45, -45, 90, -90, 135, -135))
PITCHES: Final = tuple(math.radians(a) for a in (0, 35, -35, 85))
ROLLS: Final = tuple(math.radians(a) for a in range(0, 360, 45))
#: What counts as much as a turn of one radian: 0.4 m from the middle; grippers that do not face each other.
PLACE_COST: Final = 2.5
ASIDE_COST: Final = 2.0


class ObjectGrasp(NamedTuple):
    """A grasp: `T_object_grip`, grip frame as of `Gripper`, and the width between the pads [m]."""

    T_object_grip: PoseTuple
    width: float


class GivenGrasp(NamedTuple):
    """A grasp that the giver reaches: with joint positions at the end of each movement up to the lift."""

    grasp: ObjectGrasp
    q: Floats


class Meeting(NamedTuple):
    """A candidate: the giver's grasp, where the object is offered, and the receiver's grasp."""

    cost: float
    given: GivenGrasp
    T_world_object: PoseTuple
    taken: ObjectGrasp


def plan_handover(
    model: mujoco.MjModel,
    robots: Sequence[RobotSpec],
    objects: Sequence[ObjectSpec],
    name: str = "",
    giver: str = "",
    receiver: str = "",
) -> HandoverPlan:
    """Return the plan of a handover from the state in which a session of the model begins.

    Args:
        model: The scene.
        robots: Its robots.
        objects: Its free bodies.
        name: The object; empty: the only one.
        giver: The robot that gives; empty: the one nearest to the object that reaches it.
        receiver: The robot that takes; empty: the nearest other one.

    Raises:
        ConfigError: There is no plan; one line says why.
    """
    thing = _choose_object(objects, name)
    scene = PlanningScene(model, robots, thing, make_state(model, robots, objects))
    reasons = []
    for give, take in _list_pairs(scene, robots, giver, receiver):
        try:
            return _Planner(scene, thing, give, take).plan()
        except ConfigError as error:
            reasons += str(error).split("; ")
    raise ConfigError(f"{thing.name} cannot be handed over: {'; '.join(dict.fromkeys(reasons))}")


def _choose_object(objects: Sequence[ObjectSpec], name: str) -> ObjectSpec:
    listed = ", ".join(one.name for one in objects) or "none"
    if not name and len(objects) != 1:
        raise ConfigError(f"--object says which object is handed over. Free bodies of this scene: {listed}")
    for one in objects:
        if name in ("", one.name):
            return one
    raise ConfigError(f"the scene has no free body '{name}'. Free bodies: {listed}")


def _list_pairs(scene: PlanningScene, robots: Sequence[RobotSpec], giver: str, receiver: str) -> list[tuple[str, str]]:
    """Return pairs of giver and receiver, the arm nearest to the object first."""
    listed = ", ".join(robot.name for robot in robots) or "none"
    for name in filter(None, (giver, receiver)):
        if name in scene.without:
            raise ConfigError(f"'{name}' {scene.without[name]}")
        if name not in scene.arms:
            raise ConfigError(f"the scene has no robot '{name}'. Robots: {listed}")
    if giver and giver == receiver:
        raise ConfigError(f"'{giver}' cannot give to itself: --from and --to are two robots")
    if len(scene.arms) < 2:
        why = "".join(f"; '{name}' {reason}" for name, reason in scene.without.items())
        raise ConfigError(f"a handover takes two arms with grippers, the scene has {len(scene.arms)}{why}")
    p = scene.T_world_object[0]
    near = sorted(scene.arms, key=lambda name: distance(scene.arms[name].T_world_root[0], p))
    return [(a, b) for a, b in itertools.permutations(near, 2) if giver in ("", a) and receiver in ("", b)][
        : 2 if not giver or not receiver else 1
    ]


class _Planner:
    """Planner for one pair of arms."""

    def __init__(self, scene: PlanningScene, thing: ObjectSpec, giver: str, receiver: str) -> None:
        self._scene = scene
        self._thing = thing.name
        self._names = giver, receiver
        self._giver, self._receiver = scene.arms[giver], scene.arms[receiver]
        self._clash = ""

    def plan(self) -> HandoverPlan:
        """Return the plan. Raises `ConfigError` with one line."""
        for name in self._names:
            self._scene.check_grip(name)
        given = self._find_given_grasps()
        takes: dict[PoseTuple, Floats | None] = {}
        gives: dict[tuple[int, PoseTuple], Floats | None] = {}
        offers: dict[tuple[int, PoseTuple], list[Floats] | None] = {}
        (give, take), scene, weak = self._names, self._scene, ""
        for meeting in self._list_meetings(given)[:MAX_MEETINGS]:
            at, key = meeting.T_world_object, (id(meeting.given), meeting.T_world_object)
            T_take = compose(at, self._to_tip(take, meeting.taken))
            if T_take not in takes:
                takes[T_take] = self._receiver.jump(self._receiver.rest, T_take)
            if key not in gives:
                T_give = compose(at, self._to_tip(give, meeting.given.grasp))
                gives[key] = self._giver.jump(meeting.given.q, T_give)
            q_give, q_take = gives[key], takes[T_take]
            if q_give is None or q_take is None:
                continue
            both = {give: (q_give, meeting.given.grasp.width), take: (q_take, meeting.taken.width)}
            if self._meets(scene.find_clash(both, at, self._names)):
                continue
            if key not in offers:
                offers[key] = self._follow_offer(meeting)
            offer = offers[key]
            if offer is not None and self._check_exchange(meeting, offer):
                postures = (give, meeting.given.q), (give, q_give), (take, q_take)
                found = next(filter(None, (scene.find_weak_motor(name, q) for name, q in postures)), "")
                if not found:
                    return self._make_plan(meeting)
                weak = weak or found
        if weak:
            raise ConfigError(weak)
        clash = f", or come too close ({self._clash})" if self._clash else ""
        apart = distance(self._giver.T_world_root[0], self._receiver.T_world_root[0])
        causes = "".join(self._explain(name) for name in self._names)
        raise ConfigError(
            f"'{give}' and '{take}', {apart:.2f} m apart, find no place where both reach it{clash}{causes}"
        )

    def _explain(self, name: str, goal: PoseTuple | None = None) -> str:
        """Return what keeps an arm from a goal, or from a place of the meeting: its start, or too few joints."""
        arm, n = self._scene.arms[name], len(self._scene.arms[name].rest)
        is_singular = arm.is_singular()
        if arm.can_reach(goal) if goal is not None else n >= 6 and is_singular:
            start = (
                "begins straight or with aligned axes (singular)" if is_singular else "gets there in another posture"
            )
            return f"; '{name}' {start}: a keyframe 'home' with bent joints and its gripper down may help"
        return f"; '{name}' has {n} joints, to turn a gripper every way takes 6" if n < 6 else ""

    # --- the first grasp ----------------------------------------------------------------------------------------------

    def _find_given_grasps(self) -> list[GivenGrasp]:
        """Return grasps with which the giver takes the object from where it lies, those from above first."""
        scene, arm, name = self._scene, self._giver, self._names[0]
        grasps = self._list_grasps(name)
        at = scene.T_world_object
        turn = arm.tip_at_rest[1]

        def rise(grasp: ObjectGrasp) -> float:
            """Return -1 for a grasp from above."""
            return _ahead(compose(at, grasp.T_object_grip)[1])[2]

        def cost(grasp: ObjectGrasp) -> float:
            return quat_angle(compose(at, self._to_tip(name, grasp))[1], turn) + 4.0 * (1.0 + rise(grasp))

        found = []
        ends: list[tuple[PoseTuple, PoseTuple]] = []  # of ways to grasps from above: where they end, and should
        clashes: dict[bool, str] = {}  # by whether it is from above
        for grasp in sorted(grasps, key=cost):
            T_grasp = compose(at, self._to_tip(name, grasp))
            ways = []
            q, missing = arm.rest, 0.0
            for goal in (self._back_off(name, T_grasp), T_grasp, raise_pose(T_grasp, LIFT_M)):
                way, missing = arm.follow(q, goal)
                ways.append(way)
                q = way[-1]
                if missing:
                    break
            from_above = rise(grasp) < FROM_ABOVE
            if missing:
                ends += [(arm.find_tip(q), goal)] if from_above else []
            elif self._is_free(name, ways, at, grasp):
                found.append(GivenGrasp(grasp, q))
                if len(found) == MAX_GRASPS:
                    break
            else:
                clashes[from_above] = self._clash
        self._clash = ""
        if found:
            return found
        why, cause = [], ""
        if ends:
            tip, goal = min(ends, key=lambda end: compute_error(*end))
            away, off = distance(tip[0], goal[0]), quat_angle(tip[1], goal[1])
            missed = [f"{1e3 * away:.0f} mm"] if away > ARRIVED_M else []
            missed += [f"{math.degrees(off):.0f} degrees of turn"] if off > ARRIVED_RAD and away < NEAR_M else []
            why, cause = [f"{' and '.join(missed)} are missing from above"], self._explain(name, goal)
        why += [
            f"{clash} come too close {'' if above else 'from the side'}".strip() for above, clash in clashes.items()
        ]
        raise ConfigError(
            f"'{name}' does not reach it where it lies: {', '.join(why) or 'it cannot be taken from above'}{cause}"
        )

    def _is_free(self, name: str, ways: Sequence[Sequence[Floats]], at: PoseTuple, grasp: ObjectGrasp) -> bool:
        approach, reach, lift = ways
        for q in (*approach[::2], *reach):
            if self._meets(self._scene.find_clash({name: (q, None)}, at, rests=True)):
                return False
        for k, q in enumerate(lift):
            held = self._carry(name, q, grasp)
            low = k < len(lift) // 2
            if self._meets(self._scene.find_clash({name: (q, grasp.width)}, held, (name,), rests=low)):
                return False
        return True

    def _list_grasps(self, name: str) -> list[ObjectGrasp]:
        """Return the grasps of the object for a gripper, each face of each box in turn."""
        opening = self._scene.grippers[name].opening
        grasps = []
        narrowest = math.inf
        for T_object_box, half in self._scene.boxes:
            for closing, approach in itertools.permutations(range(3), 2):
                width = 2.0 * half[closing]
                narrowest = min(narrowest, width)
                if width + SPARE_M > opening:
                    continue
                along = 3 - closing - approach
                ends = (0.6 * half[along], -0.6 * half[along]) if 2.0 * half[along] > LONG_M else ()
                deep = half[approach] - min(half[approach], DEPTH_M)
                depths = (deep, deep + SHALLOWER_M) if half[approach] > 1.5 * SHALLOWER_M else (deep,)
                for side, turn, end, depth in itertools.product((1.0, -1.0), (1.0, -1.0), (0.0, *ends), depths):
                    p = [0.0, 0.0, 0.0]
                    p[approach], p[along] = -side * depth, end
                    q = _make_frame(approach, side, closing, turn)
                    grasps.append(ObjectGrasp(compose(T_object_box, ((p[0], p[1], p[2]), q)), width))
        if not grasps:
            raise ConfigError(
                f"the gripper of '{name}' opens to {1e3 * opening:.0f} mm; it is {1e3 * narrowest:.0f} mm wide, and "
                f"{1e3 * SPARE_M:.0f} mm are needed beside it"
            )
        return grasps

    # --- the meeting --------------------------------------------------------------------------------------------------

    def _list_meetings(self, given: Sequence[GivenGrasp]) -> list[Meeting]:
        """Return what is tried, by its cost: the turns of both wrists, and the way from the middle [rad]."""
        give, take = (self._scene.grippers[name].T_tip_grip for name in self._names)
        at_rest = self._receiver.tip_at_rest[1]
        grasps = self._list_grasps(self._names[1])
        turns: list[tuple[float, Quat, GivenGrasp, ObjectGrasp]] = []
        for one, (q_grip, aside) in itertools.product(given, self._list_turns()):
            turned = quat_angle(quat_mul(q_grip, quat_conj(give[1])), self._giver.find_tip(one.q)[1])
            if turned > MAX_TURN:
                continue
            q_object = quat_mul(q_grip, quat_conj(one.grasp.T_object_grip[1]))
            for taken in grasps:
                q_take = quat_mul(q_object, taken.T_object_grip[1])
                facing = -_dot(_ahead(q_grip), _ahead(q_take))
                crossing = abs(_dot(_across(q_grip), _across(q_take)))
                turn = quat_angle(quat_mul(q_take, quat_conj(take[1])), at_rest)
                if facing > -0.3 and turn < MAX_TURN:
                    cost = turned + turn + ASIDE_COST * (1.0 - facing + crossing) + 0.3 * aside
                    turns.append((cost, q_grip, one, taken))
        turns.sort(key=lambda turn: turn[0])
        meetings = []
        for (p, place), (cost, q_grip, one, taken) in itertools.product(self._list_places(), turns[:MAX_TURNS]):
            T_world_object = compose((p, q_grip), inverse(one.grasp.T_object_grip))
            meetings.append(Meeting(cost + place, one, T_world_object, taken))
        return sorted(meetings, key=lambda meeting: meeting.cost)

    def _list_places(self) -> Iterator[tuple[Vec3, float]]:
        """Return places of the giver's grip [m], world, with their cost."""
        a, b = self._giver, self._receiver
        (ax, ay, _), (bx, by, _) = a.T_world_root[0], b.T_world_root[0]
        (tx, ty, tz), (ux, uy, uz) = a.tip_at_rest[0], b.tip_at_rest[0]
        apart = max(math.hypot(bx - ax, by - ay), 1e-6)
        dx, dy = (bx - ax) / apart, (by - ay) / apart
        # Sideways where both arms reach at rest: arms that stand side by side meet in front of them.
        side = (0.5 * (tx + ux - ax - bx)) * -dy + (0.5 * (ty + uy - ay - by)) * dx
        z = max(0.5 * (tz + uz), self._scene.T_world_object[0][2] + LIFT_M + 0.05)
        for along, across, above in itertools.product(ALONG, ACROSS, ABOVE):
            s, t = along * apart, across + side
            p = (0.5 * (ax + bx) + s * dx - t * dy, 0.5 * (ay + by) + s * dy + t * dx, z + above)
            yield p, PLACE_COST * math.hypot(s, across, above)

    def _list_turns(self) -> Iterator[tuple[Quat, float]]:
        """Return turns of the giver's grip, with how far they point aside of the receiver [rad]."""
        (ax, ay, _), (bx, by, _) = self._giver.T_world_root[0], self._receiver.T_world_root[0]
        ahead = math.atan2(by - ay, bx - ax)
        for yaw, pitch, roll in itertools.product(YAWS, PITCHES, ROLLS):
            level = quat_mul(_about(2, ahead + yaw), _about(1, math.pi / 2.0 + pitch))
            yield quat_mul(level, _about(2, roll)), abs(yaw)

    def _follow_offer(self, meeting: Meeting) -> list[Floats] | None:
        """Return the joints of the giver on the way from the lift to the meeting, `None` when it does not get there."""
        goal = compose(meeting.T_world_object, self._to_tip(self._names[0], meeting.given.grasp))
        way, missing = self._giver.follow(meeting.given.q, goal)
        if missing:
            return None
        name, grasp = self._names[0], meeting.given.grasp
        for q in way[::-3]:
            held = self._carry(name, q, grasp)
            if self._meets(self._scene.find_clash({name: (q, grasp.width)}, held, (name,))):
                return None
        return way

    def _check_exchange(self, meeting: Meeting, offer: list[Floats]) -> bool:
        """Return whether the receiver can take the object there, and both can leave."""
        (give, take), scene, at = self._names, self._scene, meeting.T_world_object
        T_take = compose(at, self._to_tip(take, meeting.taken))
        start, missing = self._receiver.follow(self._receiver.rest, self._back_off(take, T_take))
        if missing:
            return False
        reach, missing = self._receiver.follow(start[-1], T_take)
        if missing:
            return False
        holding = (offer[-1], meeting.given.grasp.width)
        both = {give: holding, take: (reach[-1], meeting.taken.width)}
        if self._meets(scene.find_clash(both, at, self._names)):
            return False
        for q in (*reach[::-2], *start[::-3]):
            if self._meets(scene.find_clash({give: holding, take: (q, None)}, at, (give,))):
                return False
        leave, missing = self._giver.follow(offer[-1], self._back_off(give, self._giver.find_tip(offer[-1])))
        back, missing_home = self._giver.follow(leave[-1], self._giver.tip_at_rest)
        if missing or missing_home:
            return False
        held = (reach[-1], meeting.taken.width)
        for q in (*leave[::2], *back[::3]):
            if self._meets(scene.find_clash({give: (q, None), take: held}, at, (take,))):
                return False
        for q in reach[::-3]:
            kept = self._carry(take, q, meeting.taken)
            if self._meets(scene.find_clash({take: (q, meeting.taken.width)}, kept, (take,))):
                return False
        return True

    # --- poses --------------------------------------------------------------------------------------------------------

    def _make_plan(self, meeting: Meeting) -> HandoverPlan:
        return HandoverPlan(
            object=self._thing,
            giver=self._make_arm_plan(self._names[0], meeting.given.grasp),
            receiver=self._make_arm_plan(self._names[1], meeting.taken),
            T_world_lying=self._scene.T_world_object,
            T_world_meeting=meeting.T_world_object,
            lift=LIFT_M,
        )

    def _make_arm_plan(self, name: str, grasp: ObjectGrasp) -> ArmPlan:
        gripper = self._scene.grippers[name]
        return ArmPlan(
            robot=name,
            fingers=gripper.fingers,
            pads=gripper.pads,
            T_object_tip=self._to_tip(name, grasp),
            back=self._compute_back(name),
            width=grasp.width,
        )

    def _to_tip(self, name: str, grasp: ObjectGrasp) -> PoseTuple:
        """Return `T_object_tip` of a grasp."""
        return compose(grasp.T_object_grip, inverse(self._scene.grippers[name].T_tip_grip))

    def _compute_back(self, name: str) -> Vec3:
        return quat_rotate(self._scene.grippers[name].T_tip_grip[1], (0.0, 0.0, -BACK_M))

    def _back_off(self, name: str, T_world_tip: PoseTuple) -> PoseTuple:
        return compose(T_world_tip, (self._compute_back(name), IDENTITY_QUAT))

    def _carry(self, name: str, q: Floats, grasp: ObjectGrasp) -> PoseTuple:
        """Return where the object is in the gripper of an arm with these joints."""
        return compose(self._scene.arms[name].find_tip(q), inverse(self._to_tip(name, grasp)))

    def _meets(self, clash: str) -> bool:
        self._clash = clash or self._clash
        return bool(clash)


def _make_frame(approach: int, side: float, closing: int, turn: float) -> Quat:
    """Return the turn of a grip frame whose z is `side` times one axis, and whose y is `turn` times another."""
    axes = np.eye(3)
    z, y = side * axes[approach], turn * axes[closing]
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.stack([np.cross(y, z), y, z], axis=1).ravel())
    w, i, j, k = quat.tolist()
    return (w, i, j, k)


def _about(axis: int, angle: float) -> Quat:
    rotvec = [0.0, 0.0, 0.0]
    rotvec[axis] = angle
    return quat_from_rotvec((rotvec[0], rotvec[1], rotvec[2]))


def _ahead(q: Quat) -> Vec3:
    return quat_rotate(q, (0.0, 0.0, 1.0))


def _across(q: Quat) -> Vec3:
    return quat_rotate(q, (0.0, 1.0, 0.0))


def _dot(a: Vec3, b: Vec3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
