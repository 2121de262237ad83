"""End effectors of chains: a site, else the middle between the finger tips, else the end of the last link.

The choice between sites goes by their names. Without one, the end effector is a body with an offset in its frame, and
has the directions of that body.
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.physics.limbs import split_words
from iris_session.physics.names import get_element_name, is_wire_name
from iris_session.physics.tree import KinematicTree
from iris_session.protocol.common import Vec3

#: Words in the names of end-effector sites and frames, best first: the grasp point before the flange that carries a
#: gripper.
TIP_WORDS: Final = (
    *("tcp", "pinch", "grasp", "grip", "ee", "eef", "effector", "endeffector", "gripper"),
    *("tool", "hand", "attachment", "flange"),
)
#: Words of sites that are sensors, cameras, goals or contact pads.
_OTHER_WORDS: Final = frozenset(
    {"imu", "cam", "camera", "cali", "gyro", "accel", "acc", "force", "torque", "ft", "sensor", "touch", "light"}
    | {"focus", "com", "target", "goal", "marker", "tch", "center"}
)
#: The grasp point lies so far before the ends of the fingers [m].
_INSIDE = 0.01
#: A direction this close to an axis is that axis (cosine of 20 degrees).
_ALIGNED = 0.94
#: A last link that extends within 45 degrees of its joint's axis extends along it.
_ALONG = 0.7


class EndEffector(NamedTuple):
    """Ids in the model: a site, or else a body and the offset [m] in its frame. `note`: what else it could be."""

    site: int | None
    body: int = 0
    offset: Vec3 = (0.0, 0.0, 0.0)
    note: str = ""


def find_end_effector(tree: KinematicTree, joint: int, link: int, fingers: list[int]) -> EndEffector:
    """Return the end effector of a chain that ends with `joint` on `link`; `fingers`: moving bodies below the link."""
    sites = list_tip_sites(tree, link)
    names = {s: get_element_name(tree.model, "site", s) for s in sites}
    best = min((rank_name(n) for n in names.values()), default=(0, 0))
    chosen = [s for s in sites if rank_name(names[s]) == best]
    if len(chosen) == 1 and (best[0] < len(TIP_WORDS) or not fingers):
        return EndEffector(chosen[0])
    note = f"or site = one of: {', '.join(names.values())}" if names else ""
    if fingers:
        return EndEffector(None, *find_grip_point(tree, fingers), note)
    return EndEffector(None, *_find_link_end(tree, joint, link), note)


def list_tip_sites(tree: KinematicTree, link: int) -> list[int]:
    """Return the named sites on body `link` and what is fixed on it, without those of sensors and goals."""
    model = tree.model
    # Not all of the same weld id: everything that is fixed to the world has one.
    rigid = {b for b in tree.list_subtree(link) if tree.weld[b] == tree.weld[link]}
    return [
        s
        for s in range(model.nsite)
        if int(model.site_bodyid[s]) in rigid
        and is_wire_name(name := get_element_name(model, "site", s))
        and not split_words(name) & _OTHER_WORDS
    ]


def rank_name(name: str) -> tuple[int, int]:
    """Return the position of the best of `TIP_WORDS` in a name (beyond the last: none), then its number of words."""
    words = [w for w in re.split(r"[^a-z]+", name.lower()) if w]
    return min((TIP_WORDS.index(w) for w in words if w in TIP_WORDS), default=len(TIP_WORDS)), len(words)


def find_grip_point(tree: KinematicTree, fingers: list[int]) -> tuple[int, Vec3]:
    """Return the body that carries the fingers, and the middle between their tips in its frame [m].

    Of a single jaw: the middle between it and the link that it closes on.
    """
    paths = [tree.list_ancestors(tree.parent[finger]) for finger in fingers]
    palm = next((b for b in paths[0] if all(b in path for path in paths)), 0)
    boxes = [_list_corners_in(tree, palm, tree.list_subtree(finger)) for finger in fingers]
    boxes = [corners for corners in boxes if len(corners)]
    if not boxes:
        return palm, (0.0, 0.0, 0.0)
    centres = np.array([corners.mean(axis=0) for corners in boxes])
    direction = _snap(centres.mean(axis=0))
    reach = min(float((corners @ direction).max()) for corners in boxes)
    if len(boxes) == 1:
        rigid = [b for b in tree.list_subtree(palm) if tree.weld[b] == tree.weld[palm]]
        facing = _list_corners_in(tree, palm, rigid)
        facing = facing[facing @ direction > 0.5 * reach]
        if len(facing):
            centres = np.array([centres[0], facing.mean(axis=0)])
    middle = centres.mean(axis=0)
    depth = max(reach - _INSIDE, float(middle @ direction))
    return palm, _to_vector(middle + direction * (depth - float(middle @ direction)))


def _find_link_end(tree: KinematicTree, joint: int, link: int) -> tuple[int, Vec3]:
    """Return a frame without geoms on the last link that is named like an end effector, else the far end of the link
    as an offset along its joint's axis, or along the way it extends.
    """
    model = tree.model
    rigid = [b for b in tree.list_subtree(link) if tree.weld[b] == tree.weld[link]]
    frames = [b for b in rigid if b != link and not int(model.body_geomnum[b])]
    ranks = {b: rank_name(get_element_name(model, "body", b)) for b in frames}
    named = [b for b in frames if ranks[b][0] < len(TIP_WORDS)]
    if named:
        return min(named, key=lambda b: ranks[b]), (0.0, 0.0, 0.0)
    anchor: NDArray[np.float64] = model.jnt_pos[joint]
    corners = _list_corners_in(tree, link, rigid)
    if not len(corners):
        return link, _to_vector(anchor)
    out, axis = corners.mean(axis=0) - anchor, model.jnt_axis[joint]
    along = float(out @ axis)
    direction = axis * np.sign(along) if abs(along) > _ALONG * float(np.linalg.norm(out)) else _snap(out)
    return link, _to_vector(anchor + direction * max(0.0, float(((corners - anchor) @ direction).max())))


def _list_corners_in(tree: KinematicTree, frame: int, bodies: list[int]) -> NDArray[np.float64]:
    """Return the corners of the geoms of some bodies in the frame of another one [m], shape (n, 3)."""
    corners = np.concatenate([tree.list_corners(b) for b in bodies])
    local: NDArray[np.float64] = (corners - tree.rest.xpos[frame]) @ tree.rest.xmat[frame].reshape(3, 3)
    return local


def _snap(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the direction of a vector, that of an axis where it is close to one; z for no direction."""
    length = float(np.linalg.norm(vector))
    if length < mujoco.mjMINVAL:
        return np.array([0.0, 0.0, 1.0])
    direction: NDArray[np.float64] = vector / length
    k = int(np.argmax(np.abs(direction)))
    if abs(direction[k]) > _ALIGNED:
        direction = np.eye(3)[k] * np.sign(direction[k])
    return direction


def _to_vector(p: NDArray[np.float64]) -> Vec3:
    """Return a position rounded to 0.1 mm, as a person would write it."""
    x, y, z = (round(float(v), 4) + 0.0 for v in p)
    return (x, y, z)
