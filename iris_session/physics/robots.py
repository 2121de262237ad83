"""Robots and objects found in any model: serial chains of at least three actuated joints; free bodies.

Rules, in order. A chain follows the actuated hinges and slides from the root of the tree; it ends at a leaf, or where
the tree branches into fingers (fewer than three actuated joints; behind a chain of three, fewer than six). It is cut
where it branches into several longer parts: the part before (a torso) is no part of a robot. Trailing joints that are
named like a jaw belong to the gripper. The end-effector site is on the last link, preferred by name. Cases that these
rules leave open are never guessed: `AmbiguousModelError` names them and carries a robots file (`robots_toml`) to
complete.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Final

import mujoco

from iris_session.physics.errors import AmbiguousModelError
from iris_session.physics.gripper import describe_problem, find_gripper
from iris_session.physics.names import get_element_name, is_wire_name, list_body_names, list_element_names
from iris_session.physics.robots_toml import dump_robots_toml
from iris_session.physics.tree import KinematicTree
from iris_session.protocol.specs import ObjectSpec, RobotSpec

MIN_JOINTS: Final = 3
#: A branch with this many actuated joints is an arm on a torso; a finger has at most five.
ARM_JOINTS: Final = 6
#: Words in the names of end-effector sites, best first: the grasp point before the flange that carries a gripper.
SITE_WORDS: Final = (
    *("tcp", "pinch", "grasp", "grip", "ee", "eef", "effector", "endeffector", "gripper"),
    *("tool", "hand", "attachment", "flange"),
)
_JAW = re.compile(r"jaw|finger|grip", re.IGNORECASE)
_GENERIC_BASES = frozenset({"base", "base_link", "link0", "link_0", "pedestal", "mount", "root", "torso", "body"})
_SEPARATORS = "/_-."


@dataclass
class _Arm:
    """A chain on its way to a `RobotSpec`. `link`: body that the last joint moves. `notes`: field -> TOML comment."""

    joints: list[int]
    fingers: list[int] = field(default_factory=list)
    link: int = 0
    problems: list[str] = field(default_factory=list)
    notes: dict[str, str] = field(default_factory=dict)


def find_robots(model: mujoco.MjModel) -> tuple[RobotSpec, ...]:
    """Return all robots of the model by their first joint; there may be none.

    Raises `AmbiguousModelError` when a chain has no single end-effector site, actuator or gripper, or lacks names.
    """
    tree = KinematicTree(model)
    arms: list[_Arm] = []
    for root in tree.list_jointed_below(0):
        _walk_chain(tree, root, [], arms)
    for arm in arms:
        _split_jaw(tree, arm)
    names = _robot_names(tree, arms)
    specs = tuple(_build_spec(tree, arm, name, arms) for arm, name in zip(arms, names, strict=True))
    problems = [f"robot {s.name!r}: {p}" for s, arm in zip(specs, arms, strict=True) for p in arm.problems]
    if problems:
        raise AmbiguousModelError("; ".join(problems), dump_robots_toml(specs, [arm.notes for arm in arms]))
    return specs


# --- chains -----------------------------------------------------------------------------------------------------------


def _count_reach(tree: KinematicTree, body: int) -> int:
    """Return the most directly actuated joints on any path down from `body`, its own included."""
    own = len(_list_actuated(tree, body))
    return own + max((_count_reach(tree, b) for b in tree.list_jointed_below(body)), default=0)


def _list_actuated(tree: KinematicTree, body: int) -> list[int]:
    return [j for j in tree.list_scalar_joints(body) if tree.actuators_of_joint[j]]


def _walk_chain(tree: KinematicTree, body: int, chain: list[int], arms: list[_Arm]) -> None:
    """Follow one chain down from `body`; add it to `arms` where it ends, and the chains it splits into."""
    chain = chain + _list_actuated(tree, body)
    branches = tree.list_jointed_below(body)
    # Behind an arm only another arm goes on; several shorter branches are fingers.
    least = ARM_JOINTS if len(chain) >= MIN_JOINTS and len(branches) > 1 else MIN_JOINTS
    long = [b for b in branches if _count_reach(tree, b) >= least]
    if len(branches) == 1 or len(long) == 1:
        _walk_chain(tree, (long or branches)[0], chain, arms)
    elif long:
        for branch in [b for b in branches if _count_reach(tree, b) >= MIN_JOINTS]:
            _walk_chain(tree, branch, [], arms)
    elif len(chain) >= MIN_JOINTS:
        arms.append(_Arm(chain))


def _split_jaw(tree: KinematicTree, arm: _Arm) -> None:
    """Move trailing jaw joints to the gripper, and record the last link and the moving bodies below it."""
    while len(arm.joints) > MIN_JOINTS and _is_jaw(tree, arm.joints[-1], arm.joints[-2]):
        arm.joints.pop()
    arm.link = tree.joint_body[arm.joints[-1]]
    arm.fingers = tree.list_jointed_below(arm.link)


def _is_jaw(tree: KinematicTree, last: int, before: int) -> bool:
    """Return true for a jaw, by its names, or because the end-effector site sits on the link before it."""
    names = [get_element_name(tree.model, "joint", last)]
    names += [get_element_name(tree.model, "actuator", a) for a in tree.actuators_of_joint[last]]
    if any(_JAW.search(n) for n in names):
        return True
    on_last, on_before = _sites_on(tree, tree.joint_body[last]), _sites_on(tree, tree.joint_body[before])
    ranks = [_rank_site(get_element_name(tree.model, "site", s))[0] for s in on_before]
    return not on_last and any(rank < len(SITE_WORDS) for rank in ranks)


# --- one robot --------------------------------------------------------------------------------------------------------


def _build_spec(tree: KinematicTree, arm: _Arm, name: str, arms: list[_Arm]) -> RobotSpec:
    """Return the robot of `arm`; missing parts go into its problems and notes."""
    model = tree.model
    bodies = list_body_names(model)
    site = _choose_site(tree, arm)
    actuators = _choose_actuators(tree, arm)
    gripper = find_gripper(tree, arm.link, arm.fingers) if arm.fingers else None
    base = _find_base(tree, arm, arms)
    if not base:
        arm.problems.append(f"body {tree.joint_body[arm.joints[0]]} needs a name of 1 to 64 characters in the model")
    gripper_actuator, opened, closed = "", 0.0, 0.0
    if gripper:
        problem = describe_problem(tree, gripper)
        if problem:
            arm.problems.append(problem)
            choices = ", ".join(get_element_name(model, "actuator", a) for a in gripper.actuators)
            arm.notes["gripper_actuator"] = f"{problem}; choices: {choices}"
        gripper_actuator = _get_wire_name(tree, arm, "actuator", gripper.actuators[0])
        low, high = gripper.range or (0.0, 0.0)
        opened = high if gripper.open is None else gripper.open
        closed = low if gripper.closed is None else gripper.closed
    return RobotSpec(
        name=name,
        joints=tuple(_get_wire_name(tree, arm, "joint", j) for j in arm.joints),
        actuators=actuators,
        site=get_element_name(model, "site", site) if site is not None else "",
        base_body=base,
        gripper_actuator=gripper_actuator,
        gripper_open=opened,
        gripper_closed=closed,
        finger_bodies=tuple(bodies[b] for b in gripper.finger_bodies) if gripper else (),
    )


def _get_wire_name(tree: KinematicTree, arm: _Arm, kind: str, index: int) -> str:
    name = get_element_name(tree.model, kind, index)
    if not is_wire_name(name):
        arm.problems.append(f"{kind} {index} needs a name of 1 to 64 characters in the model")
    return name


def _choose_actuators(tree: KinematicTree, arm: _Arm) -> tuple[str, ...]:
    chosen = []
    for joint in arm.joints:
        candidates = tree.actuators_of_joint[joint]
        if len(candidates) > 1:
            listed = ", ".join(get_element_name(tree.model, "actuator", a) or f"number {a}" for a in candidates)
            problem = (
                f"joint {get_element_name(tree.model, 'joint', joint)!r} has {len(candidates)} actuators ({listed})"
            )
            arm.problems.append(problem)
            arm.notes["actuators"] = f"one per joint; {problem}"
        chosen.append(_get_wire_name(tree, arm, "actuator", candidates[0]))
    return tuple(chosen)


def _sites_on(tree: KinematicTree, link: int) -> list[int]:
    """Return the named sites on the rigid link that body `link` belongs to."""
    model = tree.model
    return [
        s
        for s in range(model.nsite)
        if tree.weld[int(model.site_bodyid[s])] == tree.weld[link] and is_wire_name(get_element_name(model, "site", s))
    ]


def _rank_site(site: str) -> tuple[int, int]:
    """Return the position of the best `SITE_WORDS` word in a site's name (beyond the last: none), then its number of
    words.
    """
    words = [w for w in re.split(r"[^a-z]+", site.lower()) if w]
    return min((SITE_WORDS.index(w) for w in words if w in SITE_WORDS), default=len(SITE_WORDS)), len(words)


def _choose_site(tree: KinematicTree, arm: _Arm) -> int | None:
    sites = _sites_on(tree, arm.link)
    names = {s: get_element_name(tree.model, "site", s) for s in sites}
    best = min((_rank_site(n) for n in names.values()), default=(0, 0))
    chosen = [s for s in sites if _rank_site(names[s]) == best]
    if len(chosen) == 1:
        return chosen[0]
    link = list_body_names(tree.model)[arm.link]
    if not sites:
        arm.problems.append(f"there is no end-effector site on its last link {link!r}")
        arm.notes["site"] = f"add a site to body {link} in the model and name it here"
    else:
        listed = ", ".join(names[s] for s in chosen)
        arm.problems.append(f"{len(chosen)} sites on its last link {link!r} could be the end effector ({listed})")
        arm.notes["site"] = f"choose one of: {listed}"
    return None


def _find_base(tree: KinematicTree, arm: _Arm, arms: list[_Arm]) -> str:
    """Return the highest named body above the first joint whose subtree holds no other robot."""
    path = tree.list_ancestors(tree.joint_body[arm.joints[0]])
    others = {tree.joint_body[a.joints[0]] for a in arms if a is not arm}
    names = [get_element_name(tree.model, "body", b) for b in path]
    free = [
        n for b, n in zip(path, names, strict=True) if is_wire_name(n) and not others.intersection(tree.list_subtree(b))
    ]
    return free[-1] if free else ""


# --- names ------------------------------------------------------------------------------------------------------------


def _robot_names(tree: KinematicTree, arms: list[_Arm]) -> list[str]:
    """Return per arm the prefix of its joints' names, else the base body, else the model's name, else `robot`; made
    unique.
    """
    names: list[str] = []
    for arm in arms:
        stem = _find_prefix([get_element_name(tree.model, "joint", j) for j in arm.joints])
        folder, _, base = _find_base(tree, arm, arms).rpartition("/")
        if not stem:
            stem = folder or ("" if base.lower() in _GENERIC_BASES else base)
        if not stem and len(arms) == 1:
            stem = _model_name(tree.model)
        stem = (stem or "robot")[:60]
        name, number = stem, 1
        while name in names:
            number += 1
            name = f"{stem}_{number}"
        names.append(name)
    return names


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
