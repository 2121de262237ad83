"""Limbs found in a model: serial chains of actuated joints, and what they are: arms, legs, fingers, hands, heads.

A chain follows the actuated hinges and slides from the root of the tree. It ends at a leaf, or where the tree branches
into fingers; it is cut where it branches into several limbs: the part before (a torso) is no limb. Names decide first
(`hip`, `wrist`, `thumb`), those of joints or of most links, then shape: a finger is short, the feet of a robot without
a fixed base are its lowest parts.
"""

from __future__ import annotations

import re
from collections.abc import Callable
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
_HAND_JOINTS: Final = 6
HAND_FINGERS: Final = 3
#: A finger has at most so many actuated joints, and is at most so long [m] from its first joint to its end.
_FINGER_JOINTS, _FINGER_LENGTH, _NAMED_FINGER_LENGTH = 5, 0.2, 0.35
#: Feet end within this share of the height of their robot from its lowest point.
_FOOT_HEIGHT = 0.15
#: A head has at most so many actuated joints.
_HEAD_JOINTS = 4
#: Joints or links named alike that make a head, and a leg of a robot with a fixed base.
_AGREEING = 2

_ARM_WORDS = frozenset({"arm", "shoulder", "sho", "elbow", "el", "wrist", "forearm", "humerus"})
_LEG_WORDS = frozenset(
    {"hip", "hips", "leg", "legs", "knee", "ankle", "ank", "foot", "feet", "thigh", "shin", "calf", "shank", "toe"}
)
_LEG_ENDINGS = ("leg", "knee", "ankle", "foot", "thigh", "shin")
FINGER_WORDS: Final = frozenset(
    {"finger", "fngr", "thumb", "pinky", "knuckle", "phalanx", "distal", "proximal", "mcp", "pip", "dip"}
)
_HEAD_WORDS = frozenset({"head", "neck", "eye", "eyes"})
_TORSO_WORDS = frozenset({"torso", "waist", "abdomen", "spine", "lumbar", "chest", "pelvis"})


@dataclass
class Limb:
    """A chain, or a hand. `joints`, `fingers` and `link` are ids; `link`: body that the last joint of a chain moves, or
    the palm; `fingers`: the first moving bodies of a hand's fingers; `is_by_name`: a leg or head by its names alone.
    """

    joints: list[int]
    kind: str = ARM
    link: int = 0
    fingers: list[int] = field(default_factory=list)
    is_by_name: bool = False


def find_limbs(tree: KinematicTree) -> list[Limb]:
    """Return all limbs of a model with at least three actuated joints, by their first joint."""
    limbs: list[Limb] = []
    for base in tree.children[0]:
        roots = [base] if tree.list_scalar_joints(base) else tree.list_jointed_below(base)
        fingers = [root for root in roots if len(roots) > 1 and _is_finger(tree, root)]
        if _add_hand(tree, [], fingers, limbs):
            roots = [root for root in roots if root not in fingers]
        for root in roots:
            _walk_chain(tree, root, limbs)
    for limb in limbs:
        if limb.kind != HAND:
            limb.link = tree.joint_body[limb.joints[-1]]
            limb.kind = limb.kind if limb.kind == FINGER else _classify(tree, limb)
            limb.is_by_name = limb.kind in (LEG, HEAD) and not _stands_on(tree, limb)
    return limbs


def list_actuated(tree: KinematicTree, body: int) -> list[int]:
    """Return the hinges and slides of a body that something drives."""
    return [j for j in tree.list_scalar_joints(body) if tree.is_driven(j)]


def _walk_chain(tree: KinematicTree, root: int, limbs: list[Limb]) -> None:
    """Follow the chain down from `root`; add it to `limbs` where it ends, and the chains it splits into."""
    left: list[tuple[int, list[int]]] = [(root, [])]
    while left:
        body, before = left.pop()
        chain = before + list_actuated(tree, body)
        branches = tree.list_jointed_below(body)
        fingers = [b for b in branches if len(branches) > 1 and _is_finger(tree, b)]
        long = [b for b in branches if b not in fingers and tree.reach[b] >= MIN_JOINTS]
        if len(branches) == 1 or len(long) == 1:
            left.append(((long or branches)[0], chain))
        elif long:
            left.extend((branch, []) for branch in reversed(long))
        elif len(chain) >= MIN_JOINTS:
            limbs.append(Limb(chain))
        else:
            _add_hand(tree, chain, fingers, limbs)


def _add_hand(tree: KinematicTree, wrist: list[int], fingers: list[int], limbs: list[Limb]) -> bool:
    """Add the hand of these fingers to `limbs`, and its fingers by themselves. Returns false for too few joints."""
    if len(fingers) < HAND_FINGERS or sum(tree.reach[b] for b in fingers) < _HAND_JOINTS:
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
    joints, at = list_actuated(tree, body), tree.list_jointed_below(body)
    while at:
        longest = max(at, key=lambda b: tree.reach[b])
        joints += list_actuated(tree, longest)
        at = tree.list_jointed_below(longest)
    return joints


def _is_finger(tree: KinematicTree, body: int) -> bool:
    """Return true for a branch that is short, or named like a finger, and neither an arm nor a leg by its name."""
    if tree.reach[body] > _FINGER_JOINTS:
        return False
    words = list_words(tree, tree.list_subtree(body))
    named = bool(words & FINGER_WORDS)
    if not named and (words & _ARM_WORDS or has_leg_word(words)):
        return False
    return measure_length(tree, body) < (_NAMED_FINGER_LENGTH if named else _FINGER_LENGTH)


# --- what a chain is --------------------------------------------------------------------------------------------------


def _classify(tree: KinematicTree, limb: Limb) -> str:
    bodies = list(dict.fromkeys(tree.joint_body[j] for j in limb.joints))
    words = list_words(tree, bodies)
    named_arm = bool(words & _ARM_WORDS)
    joints = [split_words(get_element_name(tree.model, "joint", j)) for j in limb.joints]
    links = [split_words(get_element_name(tree.model, "body", b)) for b in bodies]
    if not named_arm:
        if _is_named(joints, links, has_leg_word, 1 if _can_walk(tree, limb) else _AGREEING):
            return LEG
        if len(limb.joints) <= _HEAD_JOINTS and _is_named(joints, links, _has_head_word, _AGREEING):
            return HEAD
    if all(one & _TORSO_WORDS for one in joints):
        return TORSO
    if _is_planar_base(tree, bodies[0]) and sum(tree.joint_body[j] != bodies[0] for j in limb.joints) < MIN_JOINTS:
        return BASE
    if not named_arm and _stands_on(tree, limb):
        return LEG
    return ARM


def _is_named(
    joints: list[frozenset[str]], links: list[frozenset[str]], has_word: Callable[[frozenset[str]], bool], least: int
) -> bool:
    """Return true when the names of `least` joints or of most links have such a word: one link may have any name."""
    named_links = sum(map(has_word, links))
    return sum(map(has_word, joints)) >= least or (named_links >= least and 2 * named_links > len(links))


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


def _has_head_word(words: frozenset[str]) -> bool:
    return bool(words & _HEAD_WORDS)


def _is_planar_base(tree: KinematicTree, body: int) -> bool:
    """Return true for a body that rolls on the floor: two slides, and perhaps a hinge."""
    kinds = [tree.joint_type[j] for j in tree.list_joints(body)]
    slides = kinds.count(int(mujoco.mjtJoint.mjJNT_SLIDE))
    return slides == 2 and len(kinds) - slides <= 1


def _can_walk(tree: KinematicTree, limb: Limb) -> bool:
    """Return true for a limb of a robot without a fixed base: the root has joints that nothing drives."""
    root = tree.list_ancestors(tree.joint_body[limb.joints[0]])[-1]
    joints = list(tree.list_joints(root))
    return bool(joints) and not any(tree.actuators_of_joint[j] for j in joints)


def _stands_on(tree: KinematicTree, limb: Limb) -> bool:
    """Return true when a limb of a robot without a fixed base ends at the lowest part of it."""
    if not _can_walk(tree, limb):
        return False
    root = tree.list_ancestors(tree.joint_body[limb.joints[0]])[-1]
    heights = [p for body in tree.list_subtree(root) if (p := tree.list_corners(body)[:, 2]).size]
    own = [p for body in tree.list_subtree(limb.link) if (p := tree.list_corners(body)[:, 2]).size]
    if not own:
        return False
    low, high = min(float(p.min()) for p in heights), max(float(p.max()) for p in heights)
    return min(float(p.min()) for p in own) < low + _FOOT_HEIGHT * (high - low)


def measure_length(tree: KinematicTree, body: int) -> float:
    """Return the length [m] of the longest path of joints from `body` on, to the end of its last link."""
    jointed = [body]
    for b in jointed:
        jointed.extend(tree.list_jointed_below(b))
    anchors: dict[int, NDArray[np.float64]] = {b: tree.rest.xanchor[tree.list_scalar_joints(b)[0]] for b in jointed}
    lengths: dict[int, float] = {}
    for b in reversed(jointed):
        below = tree.list_jointed_below(b)
        if below:
            lengths[b] = max(float(np.linalg.norm(anchors[c] - anchors[b])) + lengths[c] for c in below)
        else:
            ends = [tree.list_corners(link) for link in tree.list_subtree(b)]
            far = [float(np.linalg.norm(p - anchors[b], axis=1).max()) for p in ends if p.size]
            lengths[b] = max(far, default=0.0)
    return lengths[body]
