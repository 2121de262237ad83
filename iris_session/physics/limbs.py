"""Limbs found in a model: serial chains of actuated joints, and what they are: arms, legs, fingers, hands, heads.

A chain follows the actuated hinges and slides from the root of the tree. It ends at a leaf, or where the tree branches
into fingers; it is cut where it branches into several limbs: the part before (a torso) is no limb. Names decide first
(`hip`, `wrist`, `thumb`), then shape: a finger is short, the feet of a robot without a fixed base are its lowest parts.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.physics.names import get_element_name
from iris_session.physics.tree import KinematicTree

MIN_JOINTS: Final = 3
ARM, HAND, LEG, FINGER, HEAD, TORSO, BASE = "arm", "hand", "leg", "finger", "head", "torso", "base"
#: Actuated joints and fingers of a hand; what has fewer is a gripper.
_HAND_JOINTS, _HAND_FINGERS = 6, 3
#: A finger has at most so many actuated joints, and is at most so long [m] from its first joint to its end.
_FINGER_JOINTS, _FINGER_LENGTH, _NAMED_FINGER_LENGTH = 5, 0.2, 0.35
#: Feet end within this share of the height of their robot from its lowest point.
_FOOT_HEIGHT = 0.15

_ARM_WORDS = frozenset({"arm", "shoulder", "sho", "elbow", "el", "wrist", "forearm", "humerus"})
_LEG_WORDS = frozenset(
    {"hip", "hips", "leg", "legs", "knee", "ankle", "ank", "foot", "feet", "thigh", "shin", "calf", "shank", "toe"}
)
_LEG_ENDINGS = ("leg", "knee", "ankle", "foot", "thigh", "shin")
_FINGER_WORDS = frozenset(
    {"finger", "fngr", "thumb", "pinky", "knuckle", "phalanx", "distal", "proximal", "mcp", "pip", "dip"}
)
_HEAD_WORDS = frozenset({"head", "neck", "eye", "eyes"})
_TORSO_WORDS = frozenset({"torso", "waist", "abdomen", "spine", "lumbar", "chest", "pelvis"})


@dataclass
class Limb:
    """A chain, or a hand. `joints`, `fingers` and `link` are ids; `link`: body that the last joint of a chain moves, or
    the palm; `fingers`: the moving bodies right below it.
    """

    joints: list[int]
    kind: str = ARM
    link: int = 0
    fingers: list[int] = field(default_factory=list)


def find_limbs(tree: KinematicTree) -> list[Limb]:
    """Return all limbs of a model with at least three actuated joints, by their first joint."""
    limbs: list[Limb] = []
    for base in tree.children[0]:
        roots = [base] if tree.list_scalar_joints(base) else tree.list_jointed_below(base)
        fingers = [root for root in roots if len(roots) > 1 and _is_finger(tree, root)]
        if _add_hand(tree, [], fingers, limbs):
            roots = [root for root in roots if root not in fingers]
        for root in roots:
            _walk_chain(tree, root, [], limbs)
    for limb in limbs:
        if limb.kind != HAND:
            limb.link = tree.joint_body[limb.joints[-1]]
            limb.fingers = tree.list_jointed_below(limb.link)
            limb.kind = limb.kind if limb.kind == FINGER else _classify(tree, limb)
    return limbs


def list_actuated(tree: KinematicTree, body: int) -> list[int]:
    """Return the hinges and slides of a body that have an actuator of their own."""
    return [j for j in tree.list_scalar_joints(body) if tree.actuators_of_joint[j]]


def _count_reach(tree: KinematicTree, body: int) -> int:
    """Return the most directly actuated joints on any path down from `body`, its own included."""
    own = len(list_actuated(tree, body))
    return own + max((_count_reach(tree, b) for b in tree.list_jointed_below(body)), default=0)


def _walk_chain(tree: KinematicTree, body: int, chain: list[int], limbs: list[Limb]) -> None:
    """Follow one chain down from `body`; add it to `limbs` where it ends, and the chains it splits into."""
    chain = chain + list_actuated(tree, body)
    branches = tree.list_jointed_below(body)
    fingers = [b for b in branches if len(branches) > 1 and _is_finger(tree, b)]
    long = [b for b in branches if b not in fingers and _count_reach(tree, b) >= MIN_JOINTS]
    if len(branches) == 1 or len(long) == 1:
        _walk_chain(tree, (long or branches)[0], chain, limbs)
    elif long:
        for branch in long:
            _walk_chain(tree, branch, [], limbs)
    elif len(chain) >= MIN_JOINTS:
        limbs.append(Limb(chain))
    else:
        _add_hand(tree, chain, fingers, limbs)


def _add_hand(tree: KinematicTree, wrist: list[int], fingers: list[int], limbs: list[Limb]) -> bool:
    """Add the hand of these fingers to `limbs`, and its fingers by themselves. Returns false for too few joints."""
    if len(fingers) < _HAND_FINGERS or sum(_count_reach(tree, b) for b in fingers) < _HAND_JOINTS:
        return False
    joints = wrist + [j for f in fingers for b in tree.list_subtree(f) for j in list_actuated(tree, b)]
    paths = [tree.list_ancestors(tree.parent[finger]) for finger in fingers]
    palm = next((b for b in paths[0] if all(b in path for path in paths)), 0)
    limbs.append(Limb(joints, HAND, palm, fingers))
    chains = [_follow_finger(tree, finger) for finger in fingers]
    limbs += [Limb(chain, FINGER) for chain in chains if len(chain) >= MIN_JOINTS]
    return True


def _follow_finger(tree: KinematicTree, body: int) -> list[int]:
    """Return the actuated joints along the longest path of a finger."""
    below = max(tree.list_jointed_below(body), key=lambda b: _count_reach(tree, b), default=None)
    return list_actuated(tree, body) + ([] if below is None else _follow_finger(tree, below))


def _is_finger(tree: KinematicTree, body: int) -> bool:
    """Return true for a branch that is short, or named like a finger, and neither an arm nor a leg by its name."""
    if _count_reach(tree, body) > _FINGER_JOINTS:
        return False
    words = list_words(tree, tree.list_subtree(body))
    named = bool(words & _FINGER_WORDS)
    if not named and (words & _ARM_WORDS or has_leg_word(words)):
        return False
    return measure_length(tree, body) < (_NAMED_FINGER_LENGTH if named else _FINGER_LENGTH)


# --- what a chain is --------------------------------------------------------------------------------------------------


def _classify(tree: KinematicTree, limb: Limb) -> str:
    bodies = list(dict.fromkeys(tree.joint_body[j] for j in limb.joints))
    words = list_words(tree, bodies)
    named_arm = bool(words & _ARM_WORDS)
    if has_leg_word(words) and not named_arm:
        return LEG
    if words & _HEAD_WORDS and not named_arm:
        return HEAD
    joints = [split_words(get_element_name(tree.model, "joint", j)) for j in limb.joints]
    if all(one & _TORSO_WORDS for one in joints):
        return TORSO
    if _is_planar_base(tree, bodies[0]) and sum(tree.joint_body[j] != bodies[0] for j in limb.joints) < MIN_JOINTS:
        return BASE
    if not named_arm and _stands_on(tree, limb):
        return LEG
    return ARM


def split_words(name: str) -> frozenset[str]:
    """Return the words of a name, lower case: `FR_hipJoint2` has fr, hip and joint."""
    return frozenset(w.lower() for w in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name))


def list_words(tree: KinematicTree, bodies: list[int]) -> frozenset[str]:
    """Return the words in the names of bodies and their joints."""
    names = [get_element_name(tree.model, "body", b) for b in bodies]
    names += [get_element_name(tree.model, "joint", j) for b in bodies for j in tree.list_joints(b)]
    return frozenset().union(*map(split_words, names))


def has_leg_word(words: frozenset[str]) -> bool:
    """Return true for names of legs, as `hip` and `bthigh`."""
    return bool(words & _LEG_WORDS) or any(word.endswith(_LEG_ENDINGS) for word in words)


def _is_planar_base(tree: KinematicTree, body: int) -> bool:
    """Return true for a body that rolls on the floor: two slides, and perhaps a hinge."""
    kinds = [tree.joint_type[j] for j in tree.list_joints(body)]
    slides = kinds.count(int(mujoco.mjtJoint.mjJNT_SLIDE))
    return slides == 2 and len(kinds) - slides <= 1


def _stands_on(tree: KinematicTree, limb: Limb) -> bool:
    """Return true when a limb of a robot without a fixed base ends at the lowest part of it."""
    root = tree.list_ancestors(tree.joint_body[limb.joints[0]])[-1]
    joints = list(tree.list_joints(root))
    if not joints or any(tree.actuators_of_joint[j] for j in joints):
        return False
    heights = [p for body in tree.list_subtree(root) if (p := tree.list_corners(body)[:, 2]).size]
    own = [p for body in tree.list_subtree(limb.link) if (p := tree.list_corners(body)[:, 2]).size]
    if not own:
        return False
    low, high = min(float(p.min()) for p in heights), max(float(p.max()) for p in heights)
    return min(float(p.min()) for p in own) < low + _FOOT_HEIGHT * (high - low)


def measure_length(tree: KinematicTree, body: int) -> float:
    """Return the length [m] of the longest path of joints from `body` on, to the end of its last link."""
    here: NDArray[np.float64] = tree.rest.xanchor[tree.list_scalar_joints(body)[0]]
    below = tree.list_jointed_below(body)
    if below:
        return max(
            float(np.linalg.norm(tree.rest.xanchor[tree.list_scalar_joints(b)[0]] - here)) + measure_length(tree, b)
            for b in below
        )
    ends = [tree.list_corners(b) for b in tree.list_subtree(body)]
    return max((float(np.linalg.norm(p - here, axis=1).max()) for p in ends if p.size), default=0.0)
