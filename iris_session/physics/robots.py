"""Robots and objects found in any model: arms and hands; free bodies.

Arms are serial chains of at least three actuated joints that are no legs, fingers, heads or bases (`limbs`). Trailing
joints that are named like a jaw belong to the gripper. A hand without an arm is one robot, controlled in joint space.
Nothing here raises for a model that MuJoCo compiles: what is unclear about a robot is a notice with the lines of a
robots file (`robots_toml`) to edit. An arm with an unclear gripper is found without it, a hand without the joints that
have several actuators; an arm of which a joint has several is left out, so that it can only be watched.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Final, NamedTuple

import msgspec
import mujoco

from iris_session.physics.end_effector import TIP_WORDS, find_end_effector, list_tip_sites, rank_name
from iris_session.physics.fingers import Fingers, find_fingers
from iris_session.physics.gripper import SPREADS, FoundGripper, find_gripper
from iris_session.physics.limbs import ARM, FINGER, HAND, LEG, MIN_JOINTS, Limb, find_limbs
from iris_session.physics.names import (
    get_element_name,
    get_reference,
    is_wire_name,
    list_body_names,
    list_element_names,
)
from iris_session.physics.robots_toml import dump_robots_toml
from iris_session.physics.tree import KinematicTree
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import GripperActuator, ObjectSpec, RobotSpec

_JAW = re.compile(r"jaw|finger|fngr|grip", re.IGNORECASE)
#: A link called gripper may be the last one of the arm, which carries the fingers.
_JAW_LINK = re.compile(r"jaw|finger|fngr", re.IGNORECASE)
_GENERIC_BASES: Final = frozenset(
    {"base", "base_link", "link0", "link_0", "pedestal", "mount", "root", "torso", "body", "palm", "hand"}
)
_SEPARATORS = "/_-.:"
#: Problems of a robot that its notice names.
_SHOWN: Final = 3
#: Kinds of limbs that are offered; others are on request.
_OFFERED: Final = (ARM, HAND)
#: By key of the robots file with a comment: what the robot is found without.
_WITHOUT: Final = {"gripper_actuator": "its gripper", "joints": "some joints"}
_FIXED, _NO_BIAS, _NO_DYNAMICS = (
    int(mujoco.mjtGain.mjGAIN_FIXED),
    int(mujoco.mjtBias.mjBIAS_NONE),
    int(mujoco.mjtDyn.mjDYN_NONE),
)


class RobotNotice(NamedTuple):
    """Something unclear about a robot. `text`: one line; `spec`: what is known of it; `notes`: what is open, by key of
    the robots file.
    """

    text: str
    spec: RobotSpec
    notes: Mapping[str, str] = {}

    @property
    def toml(self) -> str:
        """Lines of a robots file for a person to complete; it is accepted as it is."""
        return dump_robots_toml([self.spec], [self.notes])


class FoundRobots(NamedTuple):
    """Robots of a model by their first joint, and what is unclear. `notices` may be of robots that are not found.
    `hidden`: names of limbs that are not offered because they are named like legs or heads.
    """

    robots: tuple[RobotSpec, ...]
    notices: tuple[RobotNotice, ...] = ()
    hidden: tuple[str, ...] = ()

    @property
    def texts(self) -> tuple[str, ...]:
        """Lines about what is unclear."""
        texts = tuple(notice.text for notice in self.notices)
        if not self.hidden:
            return texts
        limbs = (
            "1 limb named as a leg or head is"
            if len(self.hidden) == 1
            else f"{len(self.hidden)} limbs named as legs or heads are"
        )
        return (*texts, f"{limbs} not offered: {', '.join(self.hidden)}")

    def to_toml(self) -> str:
        """Return the robots file of all robots, those that can only be watched last; it is accepted as it is."""
        notes = {notice.spec.name: notice.notes for notice in self.notices}
        watched = {notice.spec.name: notice.spec for notice in self.notices}
        specs = {**watched, **{robot.name: robot for robot in self.robots}}
        order = dict.fromkeys([*(robot.name for robot in self.robots), *watched])
        return dump_robots_toml([specs[name] for name in order], [notes.get(name, {}) for name in order])


def find_robots(model: mujoco.MjModel, *, all_limbs: bool = False) -> FoundRobots:
    """Return the robots of a model; there may be none. Raises nothing for a compiled model.

    Args:
        model: The model.
        all_limbs: Also legs, heads, and the fingers of hands (instead of the hands), which are not offered otherwise.
    """
    tree = KinematicTree(model)
    limbs = find_limbs(tree)
    for limb in limbs:
        if limb.kind == ARM:
            _split_jaw(tree, limb)
    robots, notices, hidden = [], [], []
    for limb, name in zip(limbs, _name_robots(tree, limbs), strict=True):
        if not (limb.kind != HAND if all_limbs else limb.kind in _OFFERED):
            if limb.is_by_name:
                hidden.append(name)
            continue
        spec, problems, notes = _build_spec(tree, limb, name, limbs)
        is_clear = "actuators" not in notes
        if is_clear:
            robots.append(spec)
        if problems:
            without = [text for key, text in _WITHOUT.items() if key in notes]
            how = f"is found{f' without {without[0]}' if without else ''}" if is_clear else "can only be watched"
            more = f"; and {len(problems) - _SHOWN} more" if len(problems) > _SHOWN else ""
            text = f"robot {name!r} {how}: {'; '.join(problems[:_SHOWN])}{more}"
            notices.append(RobotNotice(text, spec, notes))
    return FoundRobots(tuple(robots), tuple(notices), tuple(hidden))


def _split_jaw(tree: KinematicTree, arm: Limb) -> None:
    """Move trailing jaw joints to the gripper."""
    while len(arm.joints) > MIN_JOINTS and _is_jaw(tree, arm.joints[-1], arm.joints[-2]):
        arm.joints.pop()
    arm.link = tree.joint_body[arm.joints[-1]]


def _is_jaw(tree: KinematicTree, last: int, before: int) -> bool:
    """Return true for a jaw, by its names, or because the end-effector site sits on the link before it."""
    if tree.joint_body[last] == tree.joint_body[before]:
        return False
    names = [get_element_name(tree.model, "joint", last)]
    names += [get_element_name(tree.model, "actuator", a) for a in tree.actuators_of_joint[last]]
    link = get_element_name(tree.model, "body", tree.joint_body[last])
    if any(_JAW.search(n) for n in names) or _JAW_LINK.search(link):
        return True
    on_last, on_before = (list_tip_sites(tree, tree.joint_body[j]) for j in (last, before))
    ranks = [rank_name(get_element_name(tree.model, "site", s))[0] for s in on_before]
    return not on_last and any(rank < len(TIP_WORDS) for rank in ranks)


# --- one robot --------------------------------------------------------------------------------------------------------


def _build_spec(
    tree: KinematicTree, limb: Limb, name: str, limbs: list[Limb]
) -> tuple[RobotSpec, list[str], dict[str, str]]:
    """Return the robot of a limb, what is unclear about it, and comments on keys of its lines in a robots file."""
    model = tree.model
    bodies = list_body_names(model)
    problems: list[str] = []
    notes: dict[str, str] = {}
    joints, is_hand = limb.joints, limb.kind == HAND
    several = [j for j in joints if len(tree.actuators_of_joint[j]) > 1]
    problems += [_describe_actuators(tree, j) for j in several]
    if is_hand and len(several) < len(joints):
        joints = [j for j in joints if j not in several]
        if several:
            notes["joints"] = f"left out: {'; '.join(problems)}"
    elif several:
        notes["actuators"] = f"one per joint; candidates: {_list_candidates(tree, joints)}"
    is_pulled = tree.mocap_joints.issuperset(joints)
    actuators = () if "actuators" in notes or is_pulled else tuple(tree.actuators_of_joint[j][0] for j in joints)
    fingers = Fingers(limb.fingers, len(limb.fingers), True) if is_hand else find_fingers(tree, limb.link)
    tip = find_end_effector(tree, limb.joints[-1], limb.link, fingers.roots)
    if tip.note:
        notes["tip_body"] = tip.note
    gripper = None if is_hand else find_gripper(tree, limb.link, fingers)
    members = _choose_gripper(tree, gripper, problems, notes)
    site = "" if tip.site is None else get_element_name(model, "site", tip.site)
    spec = RobotSpec(
        name=name,
        joints=tuple(get_reference(model, "joint", j) for j in joints),
        actuators=tuple(get_reference(model, "actuator", a) for a in actuators),
        site=site,
        base_body=bodies[_find_base(tree, limb, limbs)],
        finger_bodies=tuple(bodies[b] for b in gripper.finger_bodies) if gripper and members else (),
        hold="gravity_pd" if any(_is_torque(model, a) for a in actuators) else "",
        tip_body="" if site else bodies[tip.body],
        T_body_tip=Pose(tip.offset, (1.0, 0.0, 0.0, 0.0)),
        gripper_partners=tuple(members[1:]),
        kind=HAND if is_hand else ARM,
    )
    if members:
        first = members[0]
        spec = msgspec.structs.replace(
            spec, gripper_actuator=first.actuator, gripper_open=first.open, gripper_closed=first.closed
        )
    return spec, problems, notes


def _describe_actuators(tree: KinematicTree, joint: int) -> str:
    listed = [get_reference(tree.model, "actuator", a) for a in tree.actuators_of_joint[joint]]
    return f"joint {get_reference(tree.model, 'joint', joint)!r} has {len(listed)} actuators ({', '.join(listed)})"


def _list_candidates(tree: KinematicTree, joints: list[int]) -> str:
    """Return the actuators of joints for a person to choose from: `j0: m0 or p0; j1: m1`."""
    actuators = [[get_reference(tree.model, "actuator", a) for a in tree.actuators_of_joint[j]] for j in joints]
    names = [get_reference(tree.model, "joint", j) for j in joints]
    return "; ".join(f"{name}: {' or '.join(found)}" for name, found in zip(names, actuators, strict=True))


def _choose_gripper(
    tree: KinematicTree, gripper: FoundGripper | None, problems: list[str], notes: dict[str, str]
) -> list[GripperActuator]:
    """Return the actuators of a gripper; none where one of them is unclear, as half a gripper would move half of it."""
    if gripper is None:
        return []
    if gripper.others:
        listed = ", ".join(get_reference(tree.model, "actuator", a) for a in gripper.others)
        notes["finger_bodies"] = f"not driven, as they move no finger: {listed}"
        problems.append(f"actuators that move no finger are not driven: {listed}")
    reasons = [
        f"gripper actuator {get_reference(tree.model, 'actuator', a)!r} {why}" for a, why in gripper.unclear.items()
    ]
    if not gripper.members and not gripper.unclear:
        return []
    if gripper.members and all(why == SPREADS for why in gripper.unclear.values()):
        return [GripperActuator(get_reference(tree.model, "actuator", a), *ends) for a, *ends in gripper.members]
    problems.extend(reasons)
    actuators = sorted([*(a for a, *_ in gripper.members), *gripper.unclear])
    listed = ", ".join(get_reference(tree.model, "actuator", a) for a in actuators)
    notes["gripper_actuator"] = (
        f"{'; '.join(reasons)}; candidates: {listed}; give them with their gripper_open and gripper_closed"
    )
    return []


def _is_torque(model: mujoco.MjModel, actuator: int) -> bool:
    """Return true for an actuator whose `ctrl` is a force or torque, which cannot hold by itself."""
    return (
        int(model.actuator_gaintype[actuator]) == _FIXED
        and int(model.actuator_biastype[actuator]) == _NO_BIAS
        and int(model.actuator_dyntype[actuator]) == _NO_DYNAMICS
    )


def _find_base(tree: KinematicTree, limb: Limb, limbs: list[Limb]) -> int:
    """Return the highest body that carries the limb and no other one, a named one where there is."""
    moved = [tree.list_ancestors(tree.joint_body[j]) for j in limb.joints]
    path = [b for b in moved[0] if all(b in one for one in moved)]
    own = set(limb.joints)
    others = {tree.joint_body[one.joints[0]] for one in limbs if one is not limb and own.isdisjoint(one.joints)}
    free = [b for b in path if not others.intersection(tree.list_subtree(b))] or path[:1]
    named = [b for b in free if is_wire_name(get_element_name(tree.model, "body", b))]
    return (named or free)[-1]


# --- names ------------------------------------------------------------------------------------------------------------


def _name_robots(tree: KinematicTree, limbs: list[Limb]) -> list[str]:
    """Return per limb the prefix of its joints' names, else the base body, else the model's name, else `robot`; made
    unique. Those that are offered choose first, so that a name means one robot whether or not all limbs are listed.
    """
    offered = [limb for limb in limbs if limb.kind in _OFFERED]
    names: dict[int, str] = {}
    for limb in sorted(limbs, key=lambda limb: limb.kind not in _OFFERED):
        stem = _find_prefix([get_element_name(tree.model, "joint", j) for j in limb.joints])
        base = get_element_name(tree.model, "body", _find_base(tree, limb, limbs))
        folder, _, base = base.rpartition("/")
        if not stem:
            stem = folder or ("" if base.lower() in _GENERIC_BASES else base)
        if not stem and (offered or limbs) == [limb]:
            stem = _model_name(tree.model)
        stem = stem or (limb.kind if limb.kind != ARM else "robot")
        if limb.kind in (LEG, FINGER) and limb.kind not in stem.lower():
            stem += f"_{limb.kind}"
        names[id(limb)] = _make_unique(stem[:60], names.values())
    return [names[id(limb)] for limb in limbs]


def _make_unique(stem: str, taken: Collection[str]) -> str:
    name, number = stem, 1
    while name in taken:
        number += 1
        name = f"{stem}_{number}"
    return name


def _find_prefix(names: list[str]) -> str:
    """Return the common prefix up to its last separator: `left/waist, left/elbow` -> `left`; empty when there is
    none.
    """
    first, last = min(names), max(names)
    common = first[: next((i for i, c in enumerate(first) if last[i : i + 1] != c), len(first))]
    cut = max(common.rfind(s) for s in _SEPARATORS)
    return re.sub(r"(^|[/_.-]+)(joint|j)?$", "", common[:cut]) if cut > 0 else ""


def _model_name(model: mujoco.MjModel) -> str:
    """Return the first word of the model's own name, empty for MuJoCo's default."""
    name = bytes(model.names).split(b"\0", 1)[0].decode(errors="replace")
    words = name.split()
    return words[0] if words and name != "MuJoCo Model" and is_wire_name(words[0]) else ""


def find_objects(model: mujoco.MjModel) -> tuple[ObjectSpec, ...]:
    """Return the free bodies that nothing drives, by body id: the objects that people and robots can take.

    A free body with an actuated joint in its subtree is a robot. An object is requested by its name, so a free body
    without one (or with more than 64 characters) is streamed, but is no object.
    """
    tree = KinematicTree(model)
    names = list_element_names(model, "body")
    objects = []
    for body in tree.free_bodies:
        driven = any(tree.actuators_of_joint[j] for b in tree.list_subtree(body) for j in tree.list_joints(b))
        if not driven and is_wire_name(names[body]):
            objects.append(ObjectSpec(name=names[body], body=names[body]))
    return tuple(objects)
