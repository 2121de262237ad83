"""`ModelLooks`: what a program changes in the looks of its MuJoCo model while it runs, as operations on a scene.

Followed are colours, materials, shapes, sizes, poses and groups of geoms and sites, and colours of materials; not
meshes, textures and lights. Looking costs some comparisons of arrays; nothing is done where they are equal.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.common import Pose, Vec3
from iris_session.protocol.scene import (
    FIRST_SITE_VISUAL,
    AddVisual,
    PatchOp,
    RemoveVisual,
    SceneSpec,
    SetVisual,
    Visual,
)
from iris_session.scene.mujoco_visuals import Shown, read_geom, read_site, read_visuals, to_floats

#: Fields of geoms and sites that are compared; older versions of MuJoCo lack some.
_FIELDS: Final = ("rgba", "size", "pos", "quat", "group", "matid", "type", "dataid")
#: Fields of a visual that `SetVisual` changes.
_SETTABLE: Final = ("rgba", "group", "material", "T_body_visual")
#: A site that a program has put elsewhere is further than this from where its model has it [m].
_MOVED_M: Final = 1e-6
#: A quaternion that a program wrote by hand may have another length.
_UNIT: Final = 1e-6


class ModelLooks:
    """The visuals of a model as clients have them.

    Args:
        model: The model, as it is when the scene is made.
        shown: What clients see of it.

    Attributes:
        model: The model of the scene.
        source: The model that the program changes: the same, or one that it has built anew and that was equal.
    """

    def __init__(self, model: mujoco.MjModel, shown: Shown) -> None:
        self.model = self.source = model
        self._shown, self._groups = shown, shown.choose_groups(model)
        self._visuals = {visual.id: visual for visual in read_visuals(model, shown, self._groups)}
        self._arrays = {name: np.array(getattr(model, name)) for name in _list_arrays(model)}
        fixed = (model.body_weldid == 0) & (model.body_mocapid < 0)
        self._fixed_sites = np.flatnonzero(fixed[model.site_bodyid])
        self._places: dict[int, Vec3] = {}  # sites that are not where the model has them, body frame [m]
        self._due: set[int] = set()  # ids of visuals that may have changed since `accept`

    def find_changes(
        self, data: Any = None, goals: Mapping[int, NDArray[np.floating]] | None = None
    ) -> dict[int, Visual | None]:
        """Return the visuals that differ from those that clients have, by id; `None` for one that is gone.

        Args:
            data: The program's data: sites on bodies that do not move are where it has them, as a renderer shows them.
                `None`: where they were at the call before.
            goals: Positions [m] of sites in the world that are known from elsewhere.
        """
        self._due.update(self._find_changed())
        if data is not None and data.xquat[0, 0] == 1.0:  # kinematics were computed
            self._place_sites(data, goals or {})
        found = {}
        for number in self._due:
            visual = self._read(number)
            if visual != self._visuals.get(number) and (visual is None or _is_finite(visual)):
                found[number] = visual
        self._due = set(found)
        return found

    def accept(self, changes: Mapping[int, Visual | None]) -> None:
        """Note that clients have these changes."""
        for number, visual in changes.items():
            self._due.discard(number)
            if visual is None:
                self._visuals.pop(number, None)
            else:
                self._visuals[number] = visual

    def list_operations(self, changes: Mapping[int, Visual | None], spec: SceneSpec) -> Iterator[PatchOp]:
        """Yield the operations that bring `spec` up to date. What its owner has removed stays away."""
        there = {visual.id for visual in spec.visuals}
        for number, after in sorted(changes.items()):
            before = self._visuals.get(number)
            if before is None and after is not None and number not in there:
                yield AddVisual(after)
            elif number in there and after is None:
                yield RemoveVisual(number)
            elif number in there and before is not None and after is not None:
                if before.geometry != after.geometry:
                    yield from (RemoveVisual(number), AddVisual(after))
                else:
                    values = {name: getattr(after, name) for name in _SETTABLE}
                    yield SetVisual(number, **{k: v for k, v in values.items() if v != getattr(before, k)})

    def _find_changed(self) -> Iterator[int]:
        """Yield ids of visuals whose arrays have changed since the last call."""
        model = self.source
        changed: dict[str, NDArray[np.bool_]] = {}
        for name, before in self._arrays.items():
            now = getattr(model, name)
            if not np.array_equal(before, now):
                rows = (before != now).reshape(len(now), -1).any(axis=1)
                kind = name.partition("_")[0]
                changed[kind] = changed.get(kind, np.zeros(len(now), bool)) | rows
                if name == "site_pos":
                    for index in np.flatnonzero(rows).tolist():
                        self._places.pop(index, None)
                before[:] = now
        for kind, first in (("geom", 0), ("site", FIRST_SITE_VISUAL)) if changed else ():
            if kind in changed:
                yield from (first + np.flatnonzero(changed[kind])).tolist()
            if "mat" in changed:
                wearing = np.isin(getattr(model, f"{kind}_matid"), np.flatnonzero(changed["mat"]))
                yield from (first + np.flatnonzero(wearing)).tolist()

    def _place_sites(self, data: Any, goals: Mapping[int, NDArray[np.floating]]) -> None:
        """Note where sites are that the program has moved in its data, without its model."""
        model, sites = self.source, self._fixed_sites
        bodies = model.site_bodyid[sites]
        R_world_body = data.xmat[bodies].reshape(-1, 3, 3)
        offset = data.site_xpos[sites] - data.xpos[bodies]
        p_body = np.einsum("nji,nj->ni", R_world_body, offset)
        moved = np.abs(p_body - model.site_pos[sites]).max(axis=1, initial=0.0) > _MOVED_M
        places = {int(sites[k]): to_floats(p_body[k]) for k in np.flatnonzero(moved)}
        for site, p_world in goals.items():
            body = model.site_bodyid[site]
            places[site] = to_floats(data.xmat[body].reshape(3, 3).T @ (p_world - data.xpos[body]))
        if places != self._places:
            self._due.update(FIRST_SITE_VISUAL + site for site in {*places, *self._places})
            self._places = places

    def _read(self, number: int) -> Visual | None:
        """Return a visual as it is now, with values that an operation may have."""
        index = number - FIRST_SITE_VISUAL
        visual = (
            read_geom(self.source, number) if index < 0 else read_site(self.source, index, self._shown, self._groups)
        )
        if visual is None:
            return None
        pose = visual.T_body_visual
        q, length = pose.q, math.hypot(*pose.q)
        if abs(length - 1.0) > _UNIT:
            q = to_floats(np.array(q) / length) if length > 0.0 else (1.0, 0.0, 0.0, 0.0)
        place = self._places.get(index, pose.p)
        rgba = tuple(min(max(value, 0.0), 1.0) for value in visual.rgba)
        return msgspec.structs.replace(visual, T_body_visual=Pose(place, q), rgba=rgba)


def _list_arrays(model: mujoco.MjModel) -> list[str]:
    names = [f"{kind}_{field}" for kind in ("geom", "site") for field in _FIELDS]
    return [name for name in (*names, "mat_rgba") if hasattr(model, name)]


def _is_finite(visual: Visual) -> bool:
    pose = visual.T_body_visual
    return all(map(math.isfinite, (*visual.rgba, *visual.geometry.size, *pose.p, *pose.q)))
