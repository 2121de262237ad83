"""Proximity of robots: the speed at which two robots approach each other is bounded by their distance.

The distance is that of the robots where they are measured, and that where they come to a stop if they brake from the
next check on: servos follow with a delay (0.1 s of a Panda), and brakes take time, so fast arms have centimetres before
them that no later command takes back. Each bounds the speed.

Distances are measured on the whole scene between the robots' geoms, finger bodies exempt: grippers must meet to hand
objects over. Broad phase: boxes around each robot's geoms; then bounding spheres; then `mj_geomDistance` for the
nearest pairs. Where many bounding spheres overlap (long links), oriented boxes bound the distances, and the nearest
pair of all is always measured. Only motion that closes the gap is slowed; a joint that turns round to open it waits for
the next check.
"""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.control.arm_model import Floats, find_id
from iris_session.control.config import ControlConfig
from iris_session.protocol.specs import RobotSpec

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_HFIELD = int(mujoco.mjtGeom.mjGEOM_HFIELD)

#: Of two robots, this many geom pairs, nearest by their bounds, are measured, and beyond them only those that may be
#: the nearest of all; this many of the nearest bound the speed. Both bound the cost of a check.
_MEASURED_PAIRS = 32
_BOUNDED_PAIRS = 6
#: Sweeps over all pairs in which joints that retreat make up for others; after those they no longer do.
_SWEEPS = 4
_SETTLED = 1e-9  # change of a factor that is rounding


class _Approach(NamedTuple):
    """Two robots at their places on one pair of geoms.

    `allowed`: closing speed [m/s]. `robots`: index, and the closing speed due to each of its joints, shape (n,).
    """

    allowed: float
    robots: tuple[tuple[int, Floats], tuple[int, Floats]]


class Motion(NamedTuple):
    """Joint velocities of one robot besides those that it wants, shape (n,) each [rad/s].

    `now`: as they are: a joint that approaches counts, although it wants to retreat, as the next sample may want
    something else. `next`: as near to the wanted ones as they can be at the next check: no joint retreats faster.
    """

    now: Floats
    next: Floats


class SpeedFactors(NamedTuple):
    """Factors 0..1 on the joint speeds of each robot: one per joint, or one for all, shape (n_i,) or (1,).

    `near`: indices of robots that are near another one, slowed or not.
    """

    robots: list[Floats]
    near: frozenset[int]


class ProximityLimiter:
    """Speed factors per robot from their distances. Everything follows from the arguments."""

    def __init__(self, model: mujoco.MjModel, robots: Sequence[RobotSpec], config: ControlConfig) -> None:
        self._model = model
        self._config = config
        self._geoms = [_guarded_geoms(model, robot) for robot in robots]
        self._dofs = [
            np.array(
                [model.jnt_dofadr[find_id(model, "joint", j)] for j in robot.joints],
                dtype=np.intp,
            )
            for robot in robots
        ]
        self._all = np.concatenate(self._geoms) if robots else np.zeros(0, dtype=np.intp)
        self._radius = np.asarray(model.geom_rbound)[self._all]
        self._starts = np.cumsum([0, *(len(g) for g in self._geoms)])
        self._jacobian = np.zeros((3, model.nv))
        self._segment = np.zeros(6)
        self.active = config.proximity_margin > 0.0 and sum(len(g) > 0 for g in self._geoms) > 1
        self._stopped = mujoco.MjData(model) if self.active and config.proximity_stopped else None

    def compute_speed_factors(
        self,
        data: mujoco.MjData,
        wanted: Sequence[Floats],
        motions: Sequence[Motion] | None = None,
        stops: Floats | None = None,
    ) -> SpeedFactors:
        """Return by which factors robots are slowed.

        `wanted`: joint velocities [rad/s] each robot would take, (n_i,). `motions`: how each moves meanwhile. `stops`:
        `qpos` where the robots come to a stop if they brake at the next check, shape (nq,). Without these two it is the
        law of earlier recordings.
        """
        per_joint = self._config.proximity_per_joint
        factors = [np.ones(len(joints) if per_joint else 1) for joints in wanted]
        approaches = self._list_approaches(data, wanted, motions)
        if self._stopped is not None and stops is not None:
            self._stopped.qpos[:] = stops
            self._stopped.mocap_pos[:], self._stopped.mocap_quat[:] = data.mocap_pos, data.mocap_quat
            mujoco.mj_kinematics(self._model, self._stopped)
            mujoco.mj_comPos(self._model, self._stopped)  # for Jacobians
            approaches += self._list_approaches(self._stopped, wanted, motions)
        near = frozenset(i for approach in approaches for i, _ in approach.robots)
        for _ in range(_SWEEPS if per_joint else 1):
            before, factors = factors, _slow_approaches(approaches, factors)
            if all(float((b - f).max()) < _SETTLED for b, f in zip(before, factors, strict=True)):
                return SpeedFactors(factors, near)
        if per_joint:
            factors = _slow_approaches(approaches, factors, share=False)
        return SpeedFactors(factors, near)

    def _list_approaches(
        self, data: mujoco.MjData, wanted: Sequence[Floats], motions: Sequence[Motion] | None = None
    ) -> list[_Approach]:
        """Return the nearest pairs of robots, without `motions` only those of which one moves."""
        approaches = []
        moves = [bool(joints.any()) for joints in wanted]
        for a, b in self._near_robots(data):
            if motions is None and not (moves[a] or moves[b]):  # neither robot approaches
                continue
            for distance, geom_a, geom_b, p_a, p_b in self._near_geoms(data, a, b):
                gap = p_b - p_a
                # Points of penetrating geoms are swapped: the direction from a to b stays the same.
                normal = gap / math.copysign(max(float(np.linalg.norm(gap)), 1e-9), distance)
                allowed = max(0.0, self._config.proximity_gain * (distance - self._config.proximity_stop))
                motion_a, motion_b = (motions[a], motions[b]) if motions else (None, None)
                closing_a = self._closing_speeds(data, a, geom_a, p_a, normal, wanted[a], motion_a)
                closing_b = self._closing_speeds(data, b, geom_b, p_b, -normal, wanted[b], motion_b)
                approaches.append(_Approach(allowed, ((a, closing_a), (b, closing_b))))
        return approaches

    def _near_robots(self, data: mujoco.MjData) -> list[tuple[int, int]]:
        """Return pairs of robots whose boxes are within the margin, in index order."""
        present = [i for i, g in enumerate(self._geoms) if len(g)]
        centre = data.geom_xpos[self._all]
        starts = self._starts[present]
        low = np.minimum.reduceat(centre - self._radius[:, None], starts)
        high = np.maximum.reduceat(centre + self._radius[:, None], starts)
        gap = np.maximum(low[None, :, :] - high[:, None, :], low[:, None, :] - high[None, :, :]).max(axis=2)
        rows, columns = np.nonzero(np.triu(gap < self._config.proximity_margin, k=1))
        return [(present[r], present[c]) for r, c in zip(rows.tolist(), columns.tolist(), strict=True)]

    def _near_geoms(self, data: mujoco.MjData, a: int, b: int) -> list[tuple[float, int, int, Floats, Floats]]:
        """Return the nearest geom pairs of two robots within the margin: distance [m], geoms, nearest points in the
        world.
        """
        margin = self._config.proximity_margin
        geoms_a, geoms_b = self._geoms[a], self._geoms[b]
        centre_a, centre_b = data.geom_xpos[geoms_a], data.geom_xpos[geoms_b]
        between = np.linalg.norm(centre_a[:, None, :] - centre_b[None, :, :], axis=2)
        radius = np.asarray(self._model.geom_rbound)
        bound = between - radius[geoms_a][:, None] - radius[geoms_b][None, :]
        order = np.argsort(bound, axis=None, kind="stable")
        near = order[bound.ravel()[order] < margin]
        if len(near) > _MEASURED_PAIRS:
            rows, columns = np.divmod(near, len(geoms_b))
            boxes = compute_box_bounds(self._model, data, geoms_a[rows], geoms_b[columns])
            bound[rows, columns] = np.maximum(bound[rows, columns], boxes)
            refined = bound[rows, columns]
            order = np.argsort(refined, kind="stable")
            near = near[order[refined[order] < margin]]
        found: list[tuple[float, int, int, Floats, Floats]] = []
        nearest: list[float] = []  # of those found, ascending
        for n, flat in enumerate(near.tolist()):
            i, j = divmod(flat, len(geoms_b))
            if n >= _MEASURED_PAIRS and nearest and bound[i, j] >= nearest[0]:
                break  # none of those that follow is the nearest
            if len(nearest) >= _BOUNDED_PAIRS and bound[i, j] > nearest[_BOUNDED_PAIRS - 1]:
                break  # nor is any of those that follow nearer than the ones that count
            geom_a, geom_b = int(geoms_a[i]), int(geoms_b[j])
            distance = float(mujoco.mj_geomDistance(self._model, data, geom_a, geom_b, margin, self._segment))
            if distance < margin:
                found.append((distance, geom_a, geom_b, self._segment[:3].copy(), self._segment[3:].copy()))
                insort(nearest, distance)
        found.sort(key=lambda pair: pair[:3])
        return found[:_BOUNDED_PAIRS]

    def _closing_speeds(
        self,
        data: mujoco.MjData,
        robot: int,
        geom: int,
        point: Floats,
        normal: Floats,
        wanted: Floats,
        motion: Motion | None,
    ) -> Floats:
        """Return the speed of a point along `normal` due to each joint, shape (n,); due to all, shape (1,)."""
        mujoco.mj_jac(self._model, data, self._jacobian, None, point, int(self._model.geom_bodyid[geom]))
        J = self._jacobian[:, self._dofs[robot]]
        if motion is None and not self._config.proximity_per_joint:
            return np.array([normal @ (J @ wanted)])
        speeds: Floats = normal @ J * wanted
        if motion is not None:
            now = normal @ J * motion.now
            speeds = np.maximum(np.maximum(speeds, normal @ J * motion.next), np.where(now > 0.0, now, -np.inf))
        return speeds if self._config.proximity_per_joint else np.array([speeds.sum()])


def _slow_approaches(approaches: Sequence[_Approach], factors: Sequence[Floats], share: bool = True) -> list[Floats]:
    """Return `factors`, lowered so that every pair closes no faster than allowed if the others do not change.

    `share`: joints that retreat make up for those of their own robot that approach. What they make up for may be gone
    once they are slowed themselves, because of another pair.
    """
    slowed = [f.copy() for f in factors]
    for allowed, robots in approaches:
        closing = [speeds * factors[i] for i, speeds in robots]
        if not share:
            closing = [np.maximum(speeds, 0.0) for speeds in closing]
        sums = [float(speeds.sum()) for speeds in closing]
        total = sums[0] + sums[1]
        if total <= allowed:
            continue
        # Only those who approach are slowed; someone who retreats keeps his speed and its benefit is shared.
        approach = max(sums[0], 0.0) + max(sums[1], 0.0)
        factor = max(0.0, (allowed - total + approach) / approach)
        for (i, _), speeds, speed in zip(robots, closing, sums, strict=True):
            if speed > 0.0:
                nearer = speeds > 0.0
                slowed[i][nearer] = np.minimum(slowed[i], factors[i] * factor)[nearer]
    return slowed


def compute_box_bounds(
    model: mujoco.MjModel, data: mujoco.MjData, geoms_a: NDArray[np.intp], geoms_b: NDArray[np.intp]
) -> Floats:
    """Return lower bounds (n,) [m] of the signed distances of geom pairs, from their oriented boxes.

    The bound is the greatest gap along the six face normals of both boxes; a negative one of overlapping boxes is a
    bound too, as a shift by it along that normal separates them.
    """
    rotation_a, rotation_b = (np.asarray(data.geom_xmat)[g].reshape(-1, 3, 3) for g in (geoms_a, geoms_b))
    boxes_a, boxes_b = (np.asarray(model.geom_aabb)[g] for g in (geoms_a, geoms_b))
    centre_a = np.asarray(data.geom_xpos)[geoms_a] + np.einsum("nij,nj->ni", rotation_a, boxes_a[:, :3])
    centre_b = np.asarray(data.geom_xpos)[geoms_b] + np.einsum("nij,nj->ni", rotation_b, boxes_b[:, :3])
    between = centre_b - centre_a
    # Rows: axes of a. Columns: axes of b.
    cosines = np.abs(np.einsum("nki,nkj->nij", rotation_a, rotation_b))
    along_a = np.abs(np.einsum("nki,nk->ni", rotation_a, between))
    along_b = np.abs(np.einsum("nki,nk->ni", rotation_b, between))
    gap_a = along_a - boxes_a[:, 3:] - np.einsum("nij,nj->ni", cosines, boxes_b[:, 3:])
    gap_b = along_b - boxes_b[:, 3:] - np.einsum("nij,ni->nj", cosines, boxes_a[:, 3:])
    bounds: Floats = np.maximum(gap_a.max(axis=1), gap_b.max(axis=1))
    return bounds


def _guarded_geoms(model: mujoco.MjModel, robot: RobotSpec) -> NDArray[np.intp]:
    """Return the geoms of the robot's subtree that may collide, without its fingers."""
    base = find_id(model, "body", robot.base_body)
    fingers = {find_id(model, "body", name) for name in robot.finger_bodies}
    inside, exempt = {base}, set(fingers)
    for body in range(base + 1, model.nbody):  # parents come before their children
        parent = int(model.body_parentid[body])
        if parent in inside:
            inside.add(body)
        if parent in exempt:
            exempt.add(body)
    return np.array(
        [
            g
            for g in range(model.ngeom)
            if int(model.geom_bodyid[g]) in inside
            and int(model.geom_bodyid[g]) not in exempt
            and int(model.geom_type[g]) not in (_PLANE, _HFIELD)
            and (model.geom_contype[g] or model.geom_conaffinity[g])
        ],
        dtype=np.intp,
    )
