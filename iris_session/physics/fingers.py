"""Fingers on the last link of an arm: the branches that actuators move, without cameras that tilt and cables."""

from __future__ import annotations

import re
from typing import Final, NamedTuple

import mujoco

from iris_session.physics.limbs import FINGER_WORDS, HAND_FINGERS, split_words
from iris_session.physics.names import get_element_name
from iris_session.physics.tree import KinematicTree

#: Two fingers of a gripper have the same mass, to this share.
_ALIKE = 0.1
#: A branch of a hand that is not like the other fingers, its thumb, has so many actuated joints.
_THUMB_JOINTS = 2
_FINGER: Final = re.compile(r"jaw|finger|fngr|thumb|knuckle", re.IGNORECASE)
_GRIP: Final = re.compile(r"grip", re.IGNORECASE)
_CAMERA_WORDS: Final = frozenset({"cam", "camera", "lidar", "lamp", "flashlight"})
_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
_SITE_WRAP = int(mujoco.mjtWrap.mjWRAP_SITE)
_BODY, _SITE = int(mujoco.mjtObj.mjOBJ_BODY), int(mujoco.mjtObj.mjOBJ_SITE)
_LOOPS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


class Fingers(NamedTuple):
    """`roots`: first moving bodies of the fingers. `number`: fingers; one that is a closed linkage has several roots.
    `is_clear`: false where several branches move and nothing tells the fingers; there are no roots then.
    """

    roots: list[int]
    number: int
    is_clear: bool


def find_fingers(tree: KinematicTree, link: int) -> Fingers:
    """Return the fingers on a link: branches that an actuator moves, by a joint, a tendon or an equality.

    Of several branches those are fingers that are named so or are like these, else those that are alike.
    """
    moved = _find_moved_bodies(tree)
    groups = [group for group in _group_branches(tree, link) if any(b in moved for b in _list_bodies(tree, group))]
    chosen = _choose(tree, groups)
    if chosen is None:
        return Fingers([], 0, False)
    return Fingers(sorted(root for group in chosen for root in group), len(chosen), True)


def are_alike(tree: KinematicTree, a: list[int], b: list[int]) -> bool:
    """Return true for fingers (their roots) with the same joints and mass: not a jaw and a camera that tilts."""
    kinds = [
        [tree.joint_type[j] for body in _list_bodies(tree, roots) for j in tree.list_joints(body)] for roots in (a, b)
    ]
    masses = [sum(float(tree.model.body_subtreemass[root]) for root in roots) for roots in (a, b)]
    return kinds[0] == kinds[1] and abs(masses[0] - masses[1]) <= _ALIKE * max(masses)


def _list_bodies(tree: KinematicTree, roots: list[int]) -> list[int]:
    return [body for root in roots for body in tree.list_subtree(root)]


def _choose(tree: KinematicTree, groups: list[list[int]]) -> list[list[int]] | None:
    """Return the fingers among branches that move; `None` where that is unclear."""
    rest = [group for group in groups if not _is_camera(tree, group)]
    if len(rest) <= 1:
        return rest
    for pattern in (_FINGER, _GRIP):
        named = [group for group in rest if _is_named(tree, group, pattern)]
        # A prefix that all names have says nothing; `finger` does.
        if named and (pattern is _FINGER or len(named) < len(rest)):
            return [group for group in rest if any(are_alike(tree, group, one) for one in named)]
    classes: list[list[list[int]]] = []
    for group in rest:
        same = next((one for one in classes if are_alike(tree, one[0], group)), None)
        if same is None:
            classes.append([group])
        else:
            same.append(group)
    several = [one for one in classes if len(one) > 1]
    if len(several) != 1:
        return None
    if len(several[0]) < HAND_FINGERS:
        return several[0]
    return [group for group in rest if group in several[0] or _is_thumb(tree, group)]


def _is_thumb(tree: KinematicTree, group: list[int]) -> bool:
    return max(tree.reach[root] for root in group) >= _THUMB_JOINTS


def _list_names(tree: KinematicTree, bodies: list[int]) -> list[str]:
    """Return the names of bodies and their joints, without the folders that attached models have."""
    names = [get_element_name(tree.model, "body", b) for b in bodies]
    names += [get_element_name(tree.model, "joint", j) for b in bodies for j in tree.list_joints(b)]
    return [name.rpartition("/")[2] for name in names]


def _is_camera(tree: KinematicTree, group: list[int]) -> bool:
    """Return true for a branch named so at its root: further on, a finger may carry a camera."""
    return any(split_words(name) & _CAMERA_WORDS for name in _list_names(tree, group))


def _is_named(tree: KinematicTree, group: list[int], pattern: re.Pattern[str]) -> bool:
    names = _list_names(tree, _list_bodies(tree, group))
    return any(pattern.search(name) or (pattern is _FINGER and split_words(name) & FINGER_WORDS) for name in names)


def _find_moved_bodies(tree: KinematicTree) -> set[int]:
    """Return the bodies whose joints an actuator drives, or that a tendon pulls at."""
    joints = {joint for driven in tree.driven for joint, ratio in driven.items() if ratio}
    for _ in tree.couplings:  # a chain of n couplings is complete after n passes
        for one, other, slope in tree.couplings:
            if slope and (one in joints or other in joints):
                joints |= {one, other}
    model, bodies = tree.model, {tree.joint_body[joint] for joint in joints}
    for actuator in range(model.nu):
        if int(model.actuator_trntype[actuator]) == _TENDON:
            tendon = int(model.actuator_trnid[actuator, 0])
            first = int(model.tendon_adr[tendon])
            wraps = range(first, first + int(model.tendon_num[tendon]))
            sites = [int(model.wrap_objid[w]) for w in wraps if int(model.wrap_type[w]) == _SITE_WRAP]
            bodies |= {int(model.site_bodyid[site]) for site in sites}
    return bodies


def _group_branches(tree: KinematicTree, link: int) -> list[list[int]]:
    """Return the branches below a link; those that a closed linkage joins (connect, weld) are one."""
    model, groups = tree.model, [[root] for root in tree.list_jointed_below(link)]
    branch_of = {body: group[0] for group in groups for body in tree.list_subtree(group[0])}
    for equality in range(model.neq):
        kind = int(model.eq_objtype[equality])
        if int(model.eq_type[equality]) not in _LOOPS or kind not in (_BODY, _SITE):
            continue
        ends = [int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])]
        bodies = [int(model.site_bodyid[end]) for end in ends] if kind == _SITE else ends
        joined = [group for group in groups if any(branch_of.get(body) in group for body in bodies)]
        if len(joined) == 2:
            joined[0].extend(joined[1])
            groups.remove(joined[1])
    return groups
