"""Simulated headsets for `bench alignment --worlds`: how a head moves, and what a source of sheet poses reports.

A headset's motion is true; from it, one look (some seconds at one sheet) is computed at once with arrays. A source is
described by `SheetSource`, a person at one headset by `HeadsetMotion`. Nothing here knows the product.

Sources of the numbers: jitter of detections is that of docs/anchors.md. Rates, smoothing and remembered poses are those
of MRUK ("most of our trackers update at about 1 Hz", comment in MRUK.Trackers.cs 85), OpenXR's spatial markers, which
report no time of last sight, and HoloLens 2, which remembers codes for the boot session and may report wrong poses at
first (MicrosoftDocs/mixed-reality issue 436, Microsoft-OpenXR-Unreal issues 87 and 88). What says "assumed" was never
measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from anchors.lie import (
    Array,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_to_matrix,
    skew,
    to_quat,
    to_vec3,
)
from anchors.pose import IDENTITY_POSE, PoseTuple, Vec3, compose, inverse, quat_from_yaw
from iris_session.emulator.sheet_noise import SheetNoise, mix_viewpoint_noise
from iris_session.protocol.names import ObservationSource

SHEET_M: Final = 0.16
ONE: Final[dict[str, PoseTuple]] = {"a": IDENTITY_POSE}
#: Three sheets, 1.5 m from each other, with different headings.
TRIANGLE: Final[dict[str, PoseTuple]] = {
    name: (
        (1.5 / math.sqrt(3.0) * math.cos(turn), 1.5 / math.sqrt(3.0) * math.sin(turn), 0.0),
        quat_from_yaw(0.4 + 1.1 * k),
    )
    for k, (name, turn) in enumerate(zip("abc", (0.0, 2.0 * math.pi / 3.0, -2.0 * math.pi / 3.0), strict=True))
}
#: Marks near the corners of a table top; no two sides are equal, so that swapped marks show.
MARKS: Final[dict[str, Vec3]] = {
    "a": (-0.30, -0.20, 0.0),
    "b": (0.32, -0.17, 0.0),
    "c": (0.25, 0.25, 0.0),
    "d": (-0.27, 0.12, 0.0),
}
TIP_SIGMA_M: Final = 0.0015
HOLDER_SIGMA_RAD: Final = math.radians(0.3)  # assumed: a tracked controller is turned as well as a sheet at 0.5 m
#: Of the head's own pose from frame to frame; assumed.
HEAD_SIGMA_M: Final = 0.0005
TILT_SIGMA_RAD: Final = math.radians(0.2)
#: Drift of the tracking frame where a world names no other; of Microsoft's and Meta's headsets none is published.
DRIFT_M_PER_MIN: Final = 0.003
#: Sway of a standing head: 5 mm and 1 degree rms per axis at 0.2 to 0.6 Hz; assumed, after quiet standing (Winter 1995,
#: Human balance and posture control during standing and walking: 4 to 6 mm rms of the centre of mass).
SWAY_M: Final = 0.005
SWAY_RAD: Final = math.radians(1.0)
_SWAY_HZ: Final = (0.2, 0.35, 0.6)
#: Detection of a code at 640x480 with a horizontal field of view of 65 degrees.
FOCAL_PX: Final = 500.0
_CORNERS: Final = 0.5 * SHEET_M * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


@dataclass(frozen=True)
class SheetSource:
    """Properties of a kind of source of sheet poses. Each headset draws its own constant errors from it.

    `hz`: rate of new poses, each reported `repeats` times at `hz * repeats`. `late_s`: by how much later than its
    picture an observation is stamped, uniform. `size_sigma`: of the source's own measure of the sheet, as share;
    `focal`: share by which its focal length is wrong. `corner_px`: constant error of each detected corner, per axis.
    `shake_m`: of the head from frame to frame, per axis, which moves what it sees. `weight`: of a new pose in a
    smoothing filter. `remembers`: the first second repeats a pose of an earlier session. `viewpoints`: `head` (a new
    number at every place), `each` (a new one at every observation), `zero`. `reported_as`: `ObservationSource`.
    """

    hz: float = 10.0
    repeats: int = 1
    late_s: tuple[float, float] = (0.0, 0.0)
    size_sigma: float = 0.0
    focal: float = 0.0
    corner_px: float = 0.0
    shake_m: float = HEAD_SIGMA_M
    weight: float = 1.0
    remembers: bool = False
    viewpoints: str = "head"
    reported_as: str = ObservationSource.QR_CAMERA
    noise: SheetNoise = field(default_factory=SheetNoise)


class Glance(NamedTuple):
    """Reports of a headset in one look: times in seconds, `T_tracking_head` and `T_tracking_sheet`."""

    head_s: list[float]
    heads: list[PoseTuple]
    seen_s: list[float]
    poses: list[PoseTuple]


class HeadsetMotion:
    """True motion and constant errors of one headset; `now_s`: present time of its own run."""

    def __init__(self, rng: np.random.Generator, source: SheetSource, drift_m_per_min: float = DRIFT_M_PER_MIN) -> None:
        self.rng = rng
        self.source = source
        yaw = quat_exp(np.array([0.0, 0.0, rng.uniform(-math.pi, math.pi)]))
        tilt = quat_exp(np.append(rng.normal(0.0, TILT_SIGMA_RAD, 2), 0.0))
        self._q0 = quat_multiply(tilt, yaw)
        self._p0 = np.append(rng.uniform(-3.0, 3.0, 2), rng.uniform(-1.5, 0.5))
        way = rng.normal(size=3)
        self.velocity = drift_m_per_min / 60.0 * way / float(np.linalg.norm(way))
        self.yaw_rad_per_s = 0.0
        self._turned_about = np.zeros(3)
        self._turned_from_s = 0.0
        self._late_s = rng.uniform(*source.late_s)
        self._size = rng.normal(0.0, 1.0) * source.size_sigma
        self._focal = source.focal * rng.choice([-1.0, 1.0])
        self._corners = rng.normal(0.0, 1.0, 8) * source.corner_px
        self._smooth: dict[str, tuple[Array, Array]] = {}
        self._remembered: set[str] = set()
        self.last: dict[str, PoseTuple] = {}

    # --- truth ---

    def compute_frames(self, at_s: Array) -> tuple[Array, Array]:
        """Return the true `T_world_tracking` at times (n,): positions (n, 3) and quaternions (n, 4)."""
        p = self._p0 + at_s[:, None] * self.velocity
        q = np.broadcast_to(self._q0, (len(at_s), 4))
        if self.yaw_rad_per_s:
            turn = np.zeros((len(at_s), 3))
            turn[:, 2] = self.yaw_rad_per_s * np.maximum(at_s - self._turned_from_s, 0.0)
            dq = quat_exp(turn)
            p = self._turned_about + np.einsum("nij,nj->ni", quat_to_matrix(dq), p - self._turned_about)
            q = quat_multiply(dq, self._q0)
        return p, q

    def T_world_tracking(self, at_s: float) -> tuple[Array, Array]:
        """Return the true pose of the tracking frame at a time."""
        p, q = self.compute_frames(np.array([at_s]))
        return p[0], q[0]

    def shift_frame(self, by: Array) -> None:
        """Move the tracking frame at once, without a word."""
        self._p0 = self._p0 + by

    def begin_at(self, p_world: Array, at_s: float) -> None:
        """Put the origin of the tracking frame at a point: where the head was when the app began (OpenXR `LOCAL`)."""
        self._p0 = p_world - at_s * self.velocity

    def turn_frame(self, rad_per_s: float, from_s: float, about: Array) -> None:
        """Let the tracking frame turn about the vertical through a point of the world."""
        self.yaw_rad_per_s, self._turned_from_s, self._turned_about = rad_per_s, from_s, about

    def to_tracking(self, at_s: Array, p: Array, q: Array) -> tuple[Array, Array]:
        """Return poses of the world (n, 3), (n, 4) in the tracking frame of their times."""
        origin, turn = self.compute_frames(at_s)
        back = quat_conjugate(turn)
        return np.einsum("nij,nj->ni", quat_to_matrix(back), p - origin), quat_multiply(back, q)

    def place(self, at_s: float, pose: PoseTuple) -> PoseTuple:
        """Return one pose of the world in the tracking frame of a time."""
        p, q = self.T_world_tracking(at_s)
        return compose(inverse((to_vec3(p), to_quat(q))), pose)

    # --- looks ---

    def look(
        self,
        name: str,
        sheet: tuple[Array, Array],
        start_s: float,
        seconds: float,
        *,
        head_hz: float,
        distance_m: tuple[float, float] = (0.4, 1.2),
        azimuth: float | None = None,
        walk_m_per_s: float = 0.0,
        print_scale: float = 0.0,
    ) -> Glance:
        """Return what the headset reports while its wearer looks at one sheet from a new place.

        Args:
            name: Name of the sheet, for what the source remembers of it.
            sheet: True `T_world_sheet`.
            start_s: Session time at which it begins.
            head_hz: Rate of head poses.
            distance_m: Range of the distance of the head.
            azimuth: Direction of the head from the sheet [rad]; default: any.
            walk_m_per_s: Speed of the head on a circle round the sheet.
            print_scale: Share by which the print is larger than it should be.
        """
        s, rng = self.source, self.rng
        path = _HeadPath(rng, sheet[0], distance_m, azimuth, walk_m_per_s, start_s)
        n = max(1, round(seconds * s.hz))
        stamped: Array = np.asarray(start_s + (np.arange(n) + rng.uniform(0.2, 0.8)) / s.hz, dtype=np.float64)
        p, q = path.place_sheet(stamped - self._late_s, sheet)
        p, q = self._detect(p, q, print_scale)
        head_p, head_q = path.compute(stamped)
        head_p = head_p + rng.normal(0.0, s.shake_m, (n, 3))
        world_p = head_p + np.einsum("nij,nj->ni", quat_to_matrix(head_q), p)
        p, q = self.to_tracking(stamped, world_p, quat_multiply(head_q, q))
        p, q = self._filter(name, p, q)
        times = np.repeat(stamped, s.repeats) + np.tile(np.arange(s.repeats) / (s.hz * s.repeats), n)
        p, q = np.repeat(p, s.repeats, axis=0), np.repeat(q, s.repeats, axis=0)
        head_s = start_s + np.arange(max(1, round(seconds * head_hz))) / head_hz
        at_p, at_q = path.compute(head_s)
        at_p = at_p + rng.normal(0.0, HEAD_SIGMA_M, at_p.shape)
        heads = to_poses(*self.to_tracking(head_s, at_p, at_q))
        poses = to_poses(p, q)
        self.last[name] = poses[-1]
        return Glance(head_s.tolist(), heads, times.tolist(), poses)

    def _detect(self, p: Array, q: Array, print_scale: float) -> tuple[Array, Array]:
        """Return detections (n) of a sheet at `p`, `q` in the frame of the head (x ahead)."""
        s, rng, n = self.source, self.rng, len(p)
        if s.corner_px:
            dp, turn = _solve_corner_errors(p, q, self._corners)
            p, q = p + dp, quat_multiply(quat_exp(turn), q)
        # A larger print looks nearer, and so it does to a source that takes it for smaller than it is.
        p = p * ((1.0 + self._size) / (1.0 + print_scale))
        p = p * np.array([1.0 + self._focal, 1.0, 1.0])
        d = np.linalg.norm(p, axis=1)[:, None]
        view = p / d
        shake = mix_viewpoint_noise(rng.normal(size=3), rng.normal(size=(n, 3)))
        turns = mix_viewpoint_noise(rng.normal(size=3), rng.normal(size=(n, 3)))
        along = s.noise.along_m + s.noise.along_m_per_m2 * d * d
        ahead = np.sum(shake * view, axis=1)[:, None] * view
        p = p + along * (ahead + s.noise.across * (shake - ahead)) + rng.normal() * s.noise.scale * d * view
        q = quat_multiply(quat_exp(s.noise.turn_rad * d / 0.5 * turns), q)
        for i in np.flatnonzero(rng.random(n) < s.noise.wrong_share):
            p[i], q[i] = s.noise.make_wrong_detection(p[i], q[i], view[i], rng)
        return p, q

    def _filter(self, name: str, p: Array, q: Array) -> tuple[Array, Array]:
        """Return the poses as the runtime reports them: remembered ones first, then smoothed."""
        s = self.source
        if s.remembers and name not in self._remembered:
            # From an earlier session: 20 mm and 1 degree off per axis, assumed.
            self._remembered.add(name)
            k = min(len(p), max(1, round(s.hz)))
            p[:k] = p[k - 1] + self.rng.normal(0.0, 0.02, 3)
            q[:k] = quat_multiply(quat_exp(self.rng.normal(0.0, math.radians(1.0), 3)), q[k - 1])
            first = k
        else:
            first = 0
        if s.weight < 1.0:
            for i in range(first, len(p)):
                was = self._smooth.get(name)
                if was is not None:
                    turn = quat_log(quat_multiply(q[i], quat_conjugate(was[1])))
                    p[i] = was[0] + s.weight * (p[i] - was[0])
                    q[i] = quat_multiply(quat_exp(s.weight * turn), was[1])
                self._smooth[name] = (p[i].copy(), q[i].copy())
        return p, q


class _HeadPath:
    """Path of a head that looks at one point: it stands (or walks on a circle) and sways."""

    def __init__(
        self,
        rng: np.random.Generator,
        target: Array,
        distance_m: tuple[float, float],
        azimuth: float | None,
        walk_m_per_s: float,
        start_s: float,
    ) -> None:
        self._target = target
        self._d = rng.uniform(*distance_m)
        self._elevation = math.radians(rng.uniform(40.0, 80.0))
        self._azimuth = rng.uniform(-math.pi, math.pi) if azimuth is None else azimuth
        circle = self._d * math.cos(self._elevation)
        self._rate = walk_m_per_s / max(circle, 0.2) * rng.choice([-1.0, 1.0])
        self._start_s = start_s
        self._phase = rng.uniform(-math.pi, math.pi, (len(_SWAY_HZ), 6))
        self._size = rng.normal(0.0, 1.0, (len(_SWAY_HZ), 6)) * math.sqrt(2.0 / len(_SWAY_HZ))

    def compute(self, at_s: Array) -> tuple[Array, Array]:
        """Return `T_world_head` at times (n,), x ahead."""
        azimuth = self._azimuth + self._rate * (at_s - self._start_s)
        c, k = math.cos(self._elevation), math.sin(self._elevation)
        away = np.stack([c * np.cos(azimuth), c * np.sin(azimuth), np.full(len(at_s), k)], axis=1)
        angles = 2.0 * math.pi * np.array(_SWAY_HZ)[None, :, None] * at_s[:, None, None] + self._phase
        sway = np.sum(self._size * np.sin(angles), axis=1)
        # Yaw to face the sheet, pitch down to it.
        yaw = quat_exp(np.stack([np.zeros_like(azimuth), np.zeros_like(azimuth), azimuth + math.pi], axis=1))
        pitch = quat_exp(np.array([0.0, self._elevation, 0.0]))
        q = quat_multiply(yaw, quat_multiply(quat_exp(SWAY_RAD * sway[:, 3:]), pitch))
        return self._target + self._d * away + SWAY_M * sway[:, :3], q

    def place_sheet(self, at_s: Array, sheet: tuple[Array, Array]) -> tuple[Array, Array]:
        """Return the true `T_head_sheet` at times (n,)."""
        p, q = self.compute(at_s)
        back = quat_conjugate(q)
        return np.einsum("nij,nj->ni", quat_to_matrix(back), sheet[0] - p), quat_multiply(
            back, np.broadcast_to(sheet[1], (len(at_s), 4))
        )


def _solve_corner_errors(p: Array, q: Array, corners_px: Array) -> tuple[Array, Array]:
    """Return the errors of poses (n, 3), (n, 3) by constant errors of the four corners in the picture (8,) [px].

    Least squares, linear: the pose whose projection differs by these errors. With gravity unknown to the detector.
    """
    arms = np.einsum("nij,kj->nki", quat_to_matrix(q), _CORNERS)  # (n, 4, 3)
    x, y, z = np.moveaxis(p[:, None, :] + arms, 2, 0)
    zero = np.zeros_like(x)
    rows = np.stack([np.stack([-y / x, 1.0 + zero, zero], -1), np.stack([-z / x, zero, 1.0 + zero], -1)], -2)
    rows *= (FOCAL_PX / x)[:, :, None, None]  # (n, 4, 2, 3) by the position of the corner
    J = np.concatenate([rows, -rows @ skew(arms)], axis=3).reshape(len(p), 8, 6)
    Jt = np.swapaxes(J, 1, 2)
    step = np.linalg.solve(Jt @ J, (Jt @ corners_px)[:, :, None])[:, :, 0]
    return step[:, :3], step[:, 3:]


def to_poses(p: Array, q: Array) -> list[PoseTuple]:
    """Return poses (n, 3), (n, 4) as tuples."""
    return [(to_vec3(a), to_quat(b)) for a, b in zip(p, q, strict=True)]


def to_array_pose(T: PoseTuple) -> tuple[Array, Array]:
    """Return a pose as arrays (3,) and (4,)."""
    return np.array(T[0]), np.array(T[1])


def draw_held_poses(rng: np.random.Generator, held: tuple[Array, Array], n: int) -> tuple[Array, Array]:
    """Return `n` observations, in the frame of `held`, of a controller in its holder: the noise of docs/anchors.md."""
    noise = mix_viewpoint_noise(rng.normal(size=6), rng.normal(size=(n, 6)))
    turns = quat_exp(HOLDER_SIGMA_RAD * noise[:, 3:])
    return held[0] + TIP_SIGMA_M * noise[:, :3], quat_multiply(turns, np.broadcast_to(held[1], (n, 4)))


def draw_level(rng: np.random.Generator, size: float) -> Array:
    """Return a level vector (3,) of this length in a random direction."""
    turn = rng.uniform(-math.pi, math.pi)
    return size * np.array([math.cos(turn), math.sin(turn), 0.0])


def draw_vector(rng: np.random.Generator, size: float) -> Vec3:
    """Return a vector of this length in a random direction."""
    v = rng.normal(size=3)
    return to_vec3(size * v / float(np.linalg.norm(v)))
