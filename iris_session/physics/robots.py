"""Robots found in any model: serial chains of at least three actuated joints, their site, gripper and name.

Rules, in order. A chain follows the actuated hinges and slides from the root of the tree; it ends at a leaf, or where
the tree branches into fingers (fewer than three actuated joints; behind a chain of three, fewer than six). It is cut
where it branches into several longer parts: what comes before (a torso) is no part of a robot. Trailing joints that
are named like a jaw belong to the gripper. The end-effector site is on the last link, preferred by name. What these
rules leave open is never guessed: `AmbiguousModelError` says it and carries a robots file (`robots_toml`) to complete.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Final

import mujoco

from iris_session.physics.errors import AmbiguousModelError
from iris_session.physics.gripper import describe, find_gripper
from iris_session.physics.names import body_names, element_name, wire_name
from iris_session.physics.robots_toml import dump_robots_toml
from iris_session.physics.tree import Tree
from iris_session.protocol.specs import RobotSpec

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
    """All robots of the model by their first joint; none is fine.

    Raises `AmbiguousModelError` when a chain has no single end-effector site, actuator or gripper, or lacks names.
    """
    tree = Tree(model)
    arms: list[_Arm] = []
    for root in tree.jointed_below(0):
        _walk(tree, root, [], arms)
    for arm in arms:
        _split_jaw(tree, arm)
    names = _robot_names(tree, arms)
    specs = tuple(_spec(tree, arm, name, arms) for arm, name in zip(arms, names, strict=True))
    problems = [f"robot {s.name!r}: {p}" for s, arm in zip(specs, arms, strict=True) for p in arm.problems]
    if problems:
        raise AmbiguousModelError("; ".join(problems), dump_robots_toml(specs, [arm.notes for arm in arms]))
    return specs


# --- chains -----------------------------------------------------------------------------------------------------------


def _reach(tree: Tree, body: int) -> int:
    """Most directly actuated joints on any path down from `body`, its own included."""
    own = len(_actuated(tree, body))
    return own + max((_reach(tree, b) for b in tree.jointed_below(body)), default=0)


def _actuated(tree: Tree, body: int) -> list[int]:
    return [j for j in tree.scalar_joints_of(body) if tree.actuators_of_joint[j]]


def _walk(tree: Tree, body: int, chain: list[int], arms: list[_Arm]) -> None:
    """Follows one chain down from `body`; adds it to `arms` where it ends, and the chains it splits into."""
    chain = chain + _actuated(tree, body)
    branches = tree.jointed_below(body)
    # Behind an arm only another arm goes on; several shorter branches are fingers.
    least = ARM_JOINTS if len(chain) >= MIN_JOINTS and len(branches) > 1 else MIN_JOINTS
    long = [b for b in branches if _reach(tree, b) >= least]
    if len(branches) == 1 or len(long) == 1:
        _walk(tree, (long or branches)[0], chain, arms)
    elif long:
        for branch in [b for b in branches if _reach(tree, b) >= MIN_JOINTS]:
            _walk(tree, branch, [], arms)
    elif len(chain) >= MIN_JOINTS:
        arms.append(_Arm(chain))


def _split_jaw(tree: Tree, arm: _Arm) -> None:
    """Gives trailing jaw joints to the gripper, and notes the last link and what moves below it."""
    while len(arm.joints) > MIN_JOINTS and _is_jaw(tree, arm.joints[-1], arm.joints[-2]):
        arm.joints.pop()
    arm.link = tree.joint_body[arm.joints[-1]]
    arm.fingers = tree.jointed_below(arm.link)


def _is_jaw(tree: Tree, last: int, before: int) -> bool:
    """By its names, or because the end-effector site sits on the link before it."""
    names = [element_name(tree.model, "joint", last)]
    names += [element_name(tree.model, "actuator", a) for a in tree.actuators_of_joint[last]]
    if any(_JAW.search(n) for n in names):
        return True
    on_last, on_before = _sites_on(tree, tree.joint_body[last]), _sites_on(tree, tree.joint_body[before])
    return not on_last and any(_rank(element_name(tree.model, "site", s))[0] < len(SITE_WORDS) for s in on_before)


# --- one robot --------------------------------------------------------------------------------------------------------


def _spec(tree: Tree, arm: _Arm, name: str, arms: list[_Arm]) -> RobotSpec:
    """The robot of `arm`; what is missing goes into its problems and notes."""
    model = tree.model
    bodies = body_names(model)
    site = _choose_site(tree, arm)
    actuators = _choose_actuators(tree, arm)
    gripper = find_gripper(tree, arm.link, arm.fingers) if arm.fingers else None
    base = _base(tree, arm, arms)
    if not base:
        arm.problems.append(f"body {tree.joint_body[arm.joints[0]]} needs a name of 1 to 64 characters in the model")
    gripper_actuator, opened, closed = "", 0.0, 0.0
    if gripper:
        problem = describe(tree, gripper)
        if problem:
            arm.problems.append(problem)
            choices = ", ".join(element_name(model, "actuator", a) for a in gripper.actuators)
            arm.notes["gripper_actuator"] = f"{problem}; choices: {choices}"
        gripper_actuator = _named(tree, arm, "actuator", gripper.actuators[0])
        low, high = gripper.range or (0.0, 0.0)
        opened = high if gripper.open is None else gripper.open
        closed = low if gripper.closed is None else gripper.closed
    return RobotSpec(
        name=name,
        joints=tuple(_named(tree, arm, "joint", j) for j in arm.joints),
        actuators=actuators,
        site=element_name(model, "site", site) if site is not None else "",
        base_body=base,
        gripper_actuator=gripper_actuator,
        gripper_open=opened,
        gripper_closed=closed,
        finger_bodies=tuple(bodies[b] for b in gripper.finger_bodies) if gripper else (),
    )


def _named(tree: Tree, arm: _Arm, kind: str, index: int) -> str:
    name = element_name(tree.model, kind, index)
    if not wire_name(name):
        arm.problems.append(f"{kind} {index} needs a name of 1 to 64 characters in the model")
    return name


def _choose_actuators(tree: Tree, arm: _Arm) -> tuple[str, ...]:
    chosen = []
    for joint in arm.joints:
        candidates = tree.actuators_of_joint[joint]
        if len(candidates) > 1:
            listed = ", ".join(element_name(tree.model, "actuator", a) or f"number {a}" for a in candidates)
            problem = f"joint {element_name(tree.model, 'joint', joint)!r} has {len(candidates)} actuators ({listed})"
            arm.problems.append(problem)
            arm.notes["actuators"] = f"one per joint; {problem}"
        chosen.append(_named(tree, arm, "actuator", candidates[0]))
    return tuple(chosen)


def _sites_on(tree: Tree, link: int) -> list[int]:
    """Named sites on the rigid link that body `link` belongs to."""
    model = tree.model
    return [
        s
        for s in range(model.nsite)
        if tree.weld[int(model.site_bodyid[s])] == tree.weld[link] and wire_name(element_name(model, "site", s))
    ]


def _rank(site: str) -> tuple[int, int]:
    """Position of the best `SITE_WORDS` word in a site's name (beyond the last: none), then its number of words."""
    words = [w for w in re.split(r"[^a-z]+", site.lower()) if w]
    return min((SITE_WORDS.index(w) for w in words if w in SITE_WORDS), default=len(SITE_WORDS)), len(words)


def _choose_site(tree: Tree, arm: _Arm) -> int | None:
    sites = _sites_on(tree, arm.link)
    names = {s: element_name(tree.model, "site", s) for s in sites}
    best = min((_rank(n) for n in names.values()), default=(0, 0))
    chosen = [s for s in sites if _rank(names[s]) == best]
    if len(chosen) == 1:
        return chosen[0]
    link = body_names(tree.model)[arm.link]
    if not sites:
        arm.problems.append(f"there is no end-effector site on its last link {link!r}")
        arm.notes["site"] = f"add a site to body {link} in the model and name it here"
    else:
        listed = ", ".join(names[s] for s in chosen)
        arm.problems.append(f"{len(chosen)} sites on its last link {link!r} could be the end effector ({listed})")
        arm.notes["site"] = f"choose one of: {listed}"
    return None


def _base(tree: Tree, arm: _Arm, arms: list[_Arm]) -> str:
    """The highest named body above the first joint whose subtree holds no other robot."""
    path = tree.ancestors(tree.joint_body[arm.joints[0]])
    others = {tree.joint_body[a.joints[0]] for a in arms if a is not arm}
    names = [element_name(tree.model, "body", b) for b in path]
    free = [n for b, n in zip(path, names, strict=True) if wire_name(n) and not others.intersection(tree.subtree(b))]
    return free[-1] if free else ""


# --- names ------------------------------------------------------------------------------------------------------------


def _robot_names(tree: Tree, arms: list[_Arm]) -> list[str]:
    """Prefix shared by the joints' names, else the base body, else the model's name, else `robot`; made unique."""
    names: list[str] = []
    for arm in arms:
        stem = _prefix([element_name(tree.model, "joint", j) for j in arm.joints])
        folder, _, base = _base(tree, arm, arms).rpartition("/")
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


def _prefix(names: list[str]) -> str:
    """Common prefix up to its last separator: `left/waist, left/elbow` -> `left`; empty when there is none."""
    first, last = min(names), max(names)
    common = first[: next((i for i, c in enumerate(first) if last[i : i + 1] != c), len(first))]
    cut = max(common.rfind(s) for s in _SEPARATORS)
    return re.sub(r"(^|[/_.-]+)(joint|j)?$", "", common[:cut]) if cut > 0 else ""


def _model_name(model: mujoco.MjModel) -> str:
    """First word of the model's own name, empty for MuJoCo's default."""
    name = bytes(model.names).split(b"\0", 1)[0].decode(errors="replace")
    words = name.split()
    return words[0] if words and name != "MuJoCo Model" and wire_name(words[0]) else ""
