"""Grippers found in a model: the actuator that moves the fingers of an arm, and its open ctrl value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.physics.fingers import Fingers, are_alike, find_fingers
from iris_session.physics.limbs import HAND_FINGERS
from iris_session.physics.names import get_reference
from iris_session.physics.tree import KinematicTree

#: Fingers without a joint range are tried this far from their reference [m or rad].
_TRIAL = 0.02
#: Smallest change of the aperture between the two ends that decides which one is open [m].
_MIN_CHANGE = 1e-4
#: Why an actuator of a hand is no member of its gripper, which is clear without it.
SPREADS: Final = "spreads the fingers"


@dataclass(frozen=True)
class FoundGripper:
    """Ids in the model. `members`: actuators with their `ctrl` open and closed. `unclear`: others, with the reason.
    `others`: actuators of branches on the same link that are no fingers.
    """

    members: tuple[tuple[int, float, float], ...]
    unclear: dict[int, str]
    finger_bodies: tuple[int, ...]
    others: tuple[int, ...] = ()


def find_gripper(tree: KinematicTree, palm: int, fingers: Fingers) -> FoundGripper | None:
    """Return the gripper on the link `palm`, None when nothing there is driven.

    An actuator belongs to it when all joints it drives, directly or by a tendon, are joints of fingers. The fingers of
    a hand with several joints each close towards the end of their range that is far from zero; joints that spread them
    to both sides alike stay where they are.
    """
    bodies = [b for root in fingers.roots for b in tree.list_subtree(root)]
    everything = _list_actuators(tree, [b for root in tree.list_jointed_below(palm) for b in tree.list_subtree(root)])
    if not everything:
        return None
    joints = {j for b in bodies for j in tree.list_joints(b)}
    actuators = _list_actuators(tree, bodies)
    others = tuple(a for a in everything if joints.isdisjoint(tree.driven[a]))
    with_geoms = tuple(b for b in bodies if int(tree.model.body_geomnum[b]))
    if not fingers.is_clear:
        return FoundGripper((), dict.fromkeys(everything, "moves one of several parts, which may be no finger"), ())
    is_hand = len(actuators) > max(2, len(fingers.roots))
    unclear = {a: "also moves what is no finger" for a in everything if a not in actuators and a not in others}
    if is_hand and fingers.number < HAND_FINGERS:
        count = f"{fingers.number} finger{'s' * (fingers.number > 1)}"
        unclear |= dict.fromkeys(actuators, f"is one of {len(actuators)} that move {count}")
    unclear |= _find_shared(tree, actuators)
    members = []
    for actuator in actuators:
        if actuator in unclear:
            continue
        ctrl_range = _find_ctrl_range(tree, actuator)
        if ctrl_range is None or ctrl_range[0] >= ctrl_range[1]:
            unclear[actuator] = "has no ctrlrange"
            continue
        low, high = ctrl_range
        opens = _find_far_end(low, high) if is_hand else _larger_ctrl_opens(tree, actuator, palm, fingers.roots)
        if opens is None:
            unclear[actuator] = SPREADS if is_hand else "has an unknown open end"
        elif is_hand:
            members.append((actuator, min(max(0.0, low), high), low if opens else high))
        else:
            members.append((actuator, high, low) if opens else (actuator, low, high))
    return FoundGripper(tuple(members), unclear, with_geoms, others)


def _find_shared(tree: KinematicTree, actuators: list[int]) -> dict[int, str]:
    """Return the actuators that drive a joint together with another one, and the reason why that is unclear."""
    shared = {}
    for actuator in actuators:
        for joint in tree.driven[actuator]:
            count = sum(joint in tree.driven[a] for a in actuators)
            if count > 1:
                name = get_reference(tree.model, "joint", joint)
                shared[actuator] = f"is one of {count} that drive joint {name!r}"
    return shared


def find_partners(tree: KinematicTree, link: int, actuators: list[int]) -> list[int]:
    """Return the actuators that are missing in `actuators`, which move one of the two fingers on a link."""
    roots = find_fingers(tree, link).roots
    if len(roots) != 2 or not are_alike(tree, *([root] for root in roots)):
        return []
    sides = [_list_actuators(tree, tree.list_subtree(root)) for root in roots]
    everything = _list_actuators(tree, [b for root in roots for b in tree.list_subtree(root)])
    if [len(side) for side in sides] != [1, 1] or len(everything) != 2:
        return []
    return [a for a in everything if a not in actuators] if set(actuators) & set(everything) else []


def _list_actuators(tree: KinematicTree, bodies: list[int]) -> list[int]:
    """Return the actuators that drive joints of these bodies only."""
    below = set(bodies)
    return [a for a, driven in enumerate(tree.driven) if driven and all(tree.joint_body[j] in below for j in driven)]


def _find_far_end(low: float, high: float) -> bool | None:
    """Return false when a larger `ctrl` goes away from zero, true when a smaller one does; None for a range to both
    sides.
    """
    if max(abs(low), abs(high)) < 1.5 * min(abs(low), abs(high)) and low < 0.0 < high:
        return None
    return abs(low) > abs(high)


def _find_ctrl_range(tree: KinematicTree, actuator: int) -> tuple[float, float] | None:
    model = tree.model
    if int(model.actuator_ctrllimited[actuator]):
        low, high = model.actuator_ctrlrange[actuator].tolist()
        return low, high
    driven = tree.driven[actuator]
    if len(driven) == 1:
        ((joint, gear),) = driven.items()
        position = float(model.actuator_gainprm[actuator, 0]) == -float(model.actuator_biasprm[actuator, 1])
        if position and gear == 1.0 and int(model.jnt_limited[joint]):
            low, high = model.jnt_range[joint].tolist()
            return low, high
    return None


def _find_directions(tree: KinematicTree, actuator: int) -> dict[int, float]:
    """Return how each finger joint moves when ctrl grows: driven joints, and those coupled to them by equalities."""
    sign = 1.0 if float(tree.model.actuator_gainprm[actuator, 0]) >= 0.0 else -1.0
    moves = {joint: sign * ratio for joint, ratio in tree.driven[actuator].items() if ratio}
    for _ in tree.couplings:  # a chain of n couplings is complete after n passes
        for dependent, leading, slope in tree.couplings:
            if leading in moves and dependent not in moves and slope:
                moves[dependent] = slope * moves[leading]
            elif dependent in moves and leading not in moves and slope:
                moves[leading] = moves[dependent] / slope
    return moves


def _larger_ctrl_opens(tree: KinematicTree, actuator: int, palm: int, finger_roots: list[int]) -> bool | None:
    """Compare the aperture at both ends of the finger joints. None: it does not change."""
    model = tree.model
    data = mujoco.MjData(model)
    apertures = []
    for end in (-1.0, 1.0):
        data.qpos[:] = model.qpos0
        for joint, direction in _find_directions(tree, actuator).items():
            address = int(model.jnt_qposadr[joint])
            if int(model.jnt_limited[joint]):
                data.qpos[address] = model.jnt_range[joint][int(direction * end > 0.0)]
            else:
                data.qpos[address] += _TRIAL * np.sign(direction * end)
        mujoco.mj_kinematics(model, data)
        apertures.append(_measure_aperture(tree, data, palm, finger_roots))
    change = apertures[1] - apertures[0]
    return None if abs(change) < _MIN_CHANGE else change > 0.0


def _measure_aperture(tree: KinematicTree, data: mujoco.MjData, palm: int, finger_roots: list[int]) -> float:
    """Return the mean distance [m] of the fingers' centres; of the tip of a single finger to the palm."""
    if len(finger_roots) == 1:
        return _jaw_aperture(tree, data, palm, finger_roots[0])
    centres = [_find_centre(tree, data, root) for root in finger_roots]
    pairs = [(a, b) for i, a in enumerate(centres) for b in centres[i + 1 :]]
    return float(np.mean([np.linalg.norm(a - b) for a, b in pairs]))


def _find_centre(tree: KinematicTree, data: mujoco.MjData, root: int) -> NDArray[np.float64]:
    """Return the mean position [m] of the geoms below `root`, of its body frames when it has none."""
    bodies = tree.list_subtree(root)
    geoms = np.flatnonzero(np.isin(tree.model.geom_bodyid, bodies))
    points = data.geom_xpos[geoms] if len(geoms) else data.xpos[bodies]
    centre: NDArray[np.float64] = points.mean(axis=0)
    return centre


def _jaw_aperture(tree: KinematicTree, data: mujoco.MjData, palm: int, root: int) -> float:
    """Return the distance [m] from the tip of a jaw, its box corner farthest from its joint, to the boxes of the palm's
    geoms.
    """
    model = tree.model
    anchor = data.xanchor[tree.list_scalar_joints(root)[0]]
    corners = np.concatenate([tree.list_corners(b, data) for b in tree.list_subtree(root)])
    if not len(corners):
        return 0.0
    # Rounded, so that among corners equally far the same one is taken at both ends.
    tip = corners[int(np.argmax(np.round(np.linalg.norm(corners - anchor, axis=1), 6)))]
    rigid = [b for b, weld in enumerate(tree.weld) if weld == tree.weld[palm]]
    distances = []
    for geom in np.flatnonzero(np.isin(model.geom_bodyid, rigid)):
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        local = data.geom_xmat[geom].reshape(3, 3).T @ (tip - data.geom_xpos[geom]) - centre
        distances.append(float(np.linalg.norm(np.maximum(np.abs(local) - half, 0.0))))
    return min(distances, default=float(np.linalg.norm(tip - data.xpos[palm])))
