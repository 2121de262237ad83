"""An emulated XR headset: its own tracking frame, its detections of a printed sheet, its sampling, and its link.

It knows the true poses (`T_world_...`) and reports only what a real headset would: poses in its tracking frame, with
noise. Random numbers come from one seeded generator, time is passed in: the same calls give the same readings.

Frames: world as in the session (Z up). A head pose has X forward, Y left, Z up. The anchor frame lies in the sheet,
Z out of it towards the viewer. The tracking frame is gravity-aligned but for a small tilt.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final, Generic, TypeVar

import msgspec
import numpy as np

from anchors.lie import Array
from anchors.pose import (
    IDENTITY_POSE,
    PoseTuple,
    Quat,
    Vec3,
    compose,
    distance,
    inverse,
    quat_from_rotvec,
    quat_from_yaw,
    quat_mul,
    quat_normalize,
    quat_rotate,
)
from iris_session.emulator.sheet_noise import SheetNoise, mix_viewpoint_noise

#: Pose of the sheet in the demo scene: on the table in front of the operators, facing up (body `sheet`).
DEFAULT_T_WORLD_ANCHOR: Final[PoseTuple] = ((0.0, -0.45, 0.0), (1.0, 0.0, 0.0, 0.0))
DEFAULT_ANCHOR_ID: Final = "table"
DEFAULT_SHEET_M: Final = 0.15
T = TypeVar("T")
MAX_VIEWPOINTS: Final = 256  # viewpoints whose systematic error is remembered


class LinkModel(msgspec.Struct, frozen=True):
    """Delay of one direction of a wireless link.

    `latency_s`: tracking run time and radio, least. `jitter_s`: mean of the exponential part on top. `stall_every_s`:
    mean time between stalls (0: none), in which nothing passes for `stall_s`; then everything arrives at once.
    """

    latency_s: float = 0.008
    jitter_s: float = 0.002
    stall_every_s: float = 0.0
    stall_s: float = 0.03


class HeadsetModel(msgspec.Struct, frozen=True):
    """Properties of a headset model. The defaults are those of a good standalone headset of 2024.

    `sheet`: the noise that docs/anchors.md fixes. `near_share`: sheets seem nearer by this share of their distance, as
    prints that are too large do. Tracking noise and drift: our assumption for inside-out tracking in a textured room.
    """

    rate_hz: float = 72.0
    position_sigma_m: float = 0.0004
    rotation_sigma_rad: float = math.radians(0.08)
    drift_m_per_min: float = 0.001
    drift_rad_per_min: float = math.radians(0.02)
    tilt_sigma_rad: float = math.radians(0.2)
    detection_hz: float = 10.0
    sheet: SheetNoise = SheetNoise()
    near_share: float = 0.0
    field_of_view_rad: float = math.radians(80.0)  # full cone of the cameras
    max_distance_m: float = 1.5
    max_incidence_rad: float = math.radians(65.0)
    link: LinkModel = LinkModel()


class EmulatedHeadset:
    """One headset on one head. `tracking_epoch` counts the jumps of its tracking frame; `worn` is up to the user."""

    def __init__(self, model: HeadsetModel, seed: int, start_ns: int = 0) -> None:
        self.model = model
        self.rng = np.random.default_rng(seed)
        self.tracking_epoch = 0
        self.worn = True
        self.late_samples = 0  # sampling instants that were missed because the loop was late
        self._T_world_tracking0: PoseTuple = IDENTITY_POSE
        self._drift: Vec3 = (0.0, 0.0, 0.0)  # m/min, world
        self._biases: dict[tuple[int, int], Array] = {}
        self._period_ns = int(1e9 / model.rate_hz)
        self._detect_ns = int(1e9 / model.detection_hz)
        self._next_sample_ns = start_ns + int(self.rng.uniform(0.0, self._period_ns))
        self._next_detection_ns = start_ns
        self._start_frame(start_ns)

    # --- tracking frame -----------------------------------------------------------------------------------------------

    def get_T_world_tracking(self, now_ns: int) -> PoseTuple:
        """Return the true pose, drift included. Only for measuring alignment errors."""
        minutes = (now_ns - self._epoch_ns) / 60e9
        (x, y, z), q = self._T_world_tracking0
        dx, dy, dz = self._drift
        yaw = quat_from_yaw(self._yaw_drift * minutes)
        return ((x + dx * minutes, y + dy * minutes, z + dz * minutes), quat_mul(yaw, q))

    def recentre_frame(self, now_ns: int) -> None:
        """Start another tracking frame and epoch, as after recentring or after tracking was lost."""
        self.tracking_epoch += 1
        self._biases.clear()
        self._start_frame(now_ns)

    def bump_frame(self, shift_m: Vec3, yaw_rad: float, p_world: Vec3, now_ns: int) -> PoseTuple:
        """Move the tracking frame without a new epoch, as the headset does not detect it: by `shift_m` (world), turned
        about the vertical
        through `p_world`. Returns `T_new_old`: a pose x in the old frame is `T_new_old * x` in the new one."""
        old = self.get_T_world_tracking(now_ns)
        turn = quat_from_yaw(yaw_rad)
        arm = quat_rotate(turn, (old[0][0] - p_world[0], old[0][1] - p_world[1], old[0][2] - p_world[2]))
        x, y, z = (p_world[i] + arm[i] + shift_m[i] for i in range(3))
        self._T_world_tracking0 = ((x, y, z), quat_mul(turn, old[1]))
        self._epoch_ns = now_ns  # the drift so far is in the new pose
        return compose(inverse(self._T_world_tracking0), old)

    def start_drift(self, m_per_min: float, now_ns: int) -> None:
        """Let the tracking frame drift at this speed from now on, in its own direction."""
        self._T_world_tracking0 = self.get_T_world_tracking(now_ns)
        self._epoch_ns = now_ns
        x, y, z = self._way
        self._drift = (m_per_min * x, m_per_min * y, m_per_min * z)

    def track(self, T_world_device: PoseTuple, now_ns: int) -> PoseTuple:
        """Return `T_tracking_device` as the headset reports a device that truly is at `T_world_device`."""
        return self.add_noise(compose(inverse(self.get_T_world_tracking(now_ns)), T_world_device))

    def add_noise(self, T_tracking_device: PoseTuple) -> PoseTuple:
        """Return a tracked pose with the noise of one reading."""
        p, q = T_tracking_device
        noise = self._draw_normals(6)
        s, r = self.model.position_sigma_m, self.model.rotation_sigma_rad
        turn = quat_from_rotvec((r * noise[3], r * noise[4], r * noise[5]))
        return ((p[0] + s * noise[0], p[1] + s * noise[1], p[2] + s * noise[2]), quat_mul(q, turn))

    # --- sampling -----------------------------------------------------------------------------------------------------

    def is_sample_due(self, now_ns: int) -> bool:
        """Return True once per passed sampling instant. Missed ones are counted, not made up for."""
        if now_ns < self._next_sample_ns:
            return False
        missed = (now_ns - self._next_sample_ns) // self._period_ns
        self.late_samples += missed
        self._next_sample_ns += (missed + 1) * self._period_ns
        return True

    @property
    def next_sample_ns(self) -> int:
        return self._next_sample_ns

    def is_detection_due(self, now_ns: int) -> bool:
        """Return True when the detector has a new camera image."""
        if now_ns < self._next_detection_ns:
            return False
        self._next_detection_ns = max(self._next_detection_ns + self._detect_ns, now_ns)
        return True

    # --- the sheet ----------------------------------------------------------------------------------------------------

    def can_see(self, T_world_head: PoseTuple, T_world_anchor: PoseTuple) -> bool:
        """Return True if the sheet is in the field of view, near enough, and not too oblique."""
        d = distance(T_world_head[0], T_world_anchor[0])
        if not 0.05 < d <= self.model.max_distance_m:
            return False
        forward, normal = quat_rotate(T_world_head[1], (1.0, 0.0, 0.0)), quat_rotate(T_world_anchor[1], (0.0, 0.0, 1.0))
        view = _direction(T_world_head[0], T_world_anchor[0])
        ahead, facing = float(np.dot(forward, view)), -float(np.dot(normal, view))
        return ahead >= math.cos(0.5 * self.model.field_of_view_rad) and facing >= math.cos(
            self.model.max_incidence_rad
        )

    def observe(
        self, T_world_head: PoseTuple, T_world_anchor: PoseTuple, now_ns: int, viewpoint_id: int
    ) -> PoseTuple | None:
        """Return `T_tracking_anchor` as detected from here, `None` when the sheet is not visible."""
        if not self.can_see(T_world_head, T_world_anchor):
            return None
        noise, view = self.model.sheet, _direction(T_world_head[0], T_world_anchor[0])
        p, q = np.array([T_world_anchor[0]]), np.array([T_world_anchor[1]])
        if self.rng.random() < noise.wrong_share:
            p[0], q[0] = noise.make_wrong_detection(p[0], q[0], np.array(view), self.rng)
        else:
            d = distance(T_world_head[0], T_world_anchor[0])
            units, scale_unit = self._draw_sheet_units(viewpoint_id)
            e1 = np.array(view)
            e2 = np.cross(e1, (0.0, 0.0, 1.0) if abs(view[2]) < 0.9 else (1.0, 0.0, 0.0))
            e2 /= np.linalg.norm(e2)
            p, q = noise.observe(p, q, np.array((e1, e2, np.cross(e1, e2))), d, units[None], scale_unit)
        p[0] -= self.model.near_share * (p[0] - np.array(T_world_head[0]))
        (x, y, z), (w, a, b, c) = p[0].tolist(), q[0].tolist()
        return compose(inverse(self.get_T_world_tracking(now_ns)), ((x, y, z), quat_normalize((w, a, b, c))))

    # --- inside -------------------------------------------------------------------------------------------------------

    def _start_frame(self, now_ns: int) -> None:
        """Start a random tracking frame: within 3 m, any yaw, slightly tilted, drifting in a random direction."""
        tilt = self._draw_normals(2)
        level = quat_from_yaw(self.rng.uniform(-math.pi, math.pi))
        tilted = quat_from_rotvec((self.model.tilt_sigma_rad * tilt[0], self.model.tilt_sigma_rad * tilt[1], 0.0))
        x, y = self.rng.uniform(-3.0, 3.0, 2).tolist()
        z = float(self.rng.uniform(-1.0, 0.2))  # floor or eye level, which differs between runtimes
        self._T_world_tracking0 = ((x, y, z), quat_mul(tilted, level))
        way = self._draw_normals(3)
        length = max(1e-9, math.hypot(*way))
        self._way: Vec3 = (way[0] / length, way[1] / length, way[2] / length)
        self._yaw_drift = self.model.drift_rad_per_min * (1.0 if self.rng.random() < 0.5 else -1.0)
        self._epoch_ns = now_ns
        self.start_drift(self.model.drift_m_per_min, now_ns)

    def _draw_sheet_units(self, viewpoint_id: int) -> tuple[Array, float]:
        """Return six unit normals, half of whose variance is that of the viewpoint, and the viewpoint's error of
        scale."""
        key = (self.tracking_epoch, viewpoint_id)
        if key not in self._biases:
            if len(self._biases) >= MAX_VIEWPOINTS:
                del self._biases[next(iter(self._biases))]
            self._biases[key] = self.rng.standard_normal(7)
        common = self._biases[key]
        return mix_viewpoint_noise(common[:6], self.rng.standard_normal(6)), float(common[6])

    def _draw_normals(self, n: int) -> list[float]:
        return [float(x) for x in self.rng.standard_normal(n)]


def compute_look_at(eye: Vec3, target: Vec3) -> PoseTuple:
    """Return the head pose at `eye` with X towards `target` and no roll. They must not be one above the other."""
    x = _direction(eye, target)
    yaw = math.atan2(x[1], x[0])
    pitch = math.atan2(-x[2], math.hypot(x[0], x[1]))
    down: Quat = (math.cos(0.5 * pitch), 0.0, math.sin(0.5 * pitch), 0.0)
    return (eye, quat_mul(quat_from_yaw(yaw), down))


def _direction(a: Vec3, b: Vec3) -> Vec3:
    d = distance(a, b)
    return ((b[0] - a[0]) / d, (b[1] - a[1]) / d, (b[2] - a[2]) / d)


# --- the link ---------------------------------------------------------------------------------------------------------


class DelayLine(Generic[T]):
    """A queue that releases items when they arrive, in order: a late item delays those behind it."""

    def __init__(self, model: LinkModel, rng: np.random.Generator) -> None:
        self.model = model
        self.stalls = 0
        self._rng = rng
        self._items: deque[tuple[int, T]] = deque()
        self._last_ns = 0
        self._next_stall_ns: int | None = None

    def __len__(self) -> int:
        return len(self._items)

    def push(self, item: T, now_ns: int) -> None:
        """Send an item at `now_ns`."""
        model = self.model
        arrives = now_ns + int((model.latency_s + self._rng.exponential(1.0) * model.jitter_s) * 1e9)
        arrives = max(arrives, self._last_ns, self._compute_stall_end_ns(now_ns))
        self._last_ns = arrives
        self._items.append((arrives, item))

    def pop(self, now_ns: int) -> list[T]:
        """Return and remove the items that have arrived by `now_ns`."""
        arrived: list[T] = []
        while self._items and self._items[0][0] <= now_ns:
            arrived.append(self._items.popleft()[1])
        return arrived

    @property
    def next_arrival_ns(self) -> int | None:
        """Arrival time of the next item, `None` when the line is empty."""
        return self._items[0][0] if self._items else None

    def _compute_stall_end_ns(self, now_ns: int) -> int:
        model = self.model
        if model.stall_every_s <= 0.0:
            return 0
        if self._next_stall_ns is None:
            self._next_stall_ns = now_ns + self._draw_wait_ns()
        if now_ns < self._next_stall_ns:
            return 0
        end = self._next_stall_ns + int(model.stall_s * 1e9)
        if now_ns >= end:
            self._next_stall_ns = now_ns + self._draw_wait_ns()
            self.stalls += 1
        return end

    def _draw_wait_ns(self) -> int:
        return int(self._rng.exponential(self.model.stall_every_s) * 1e9)
