"""Synthetic motion of people for `bench hands`: hands and heads, as their devices report them.

A stroke has minimum jerk (Flash and Hogan 1985): of length D in time T, its speed is at most 1.875 D / T, its
acceleration 5.7735 D / T^2. The limits of hands, 8 m/s and 100 m/s^2, are those of table tennis. Assumed are the limits
of heads and of turning, the shares of strokes, pauses and shakes, the tremor, and the noise of hands.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from anchors.pose import quat_from_rotvec, quat_mul
from iris_session.protocol.common import Pose
from iris_session.protocol.names import Device

Array = NDArray[np.float64]
PEAK_SPEED: Final = 1.875
PEAK_ACCELERATION: Final = 5.7735


class Mover(msgspec.Struct, frozen=True):
    """Limits of a person who moves a device, and the noise of its tracking, per axis, in every pose."""

    speed: float  # [m/s]
    acceleration: float  # [m/s^2]
    turn_speed: float  # [rad/s]
    turn_acceleration: float  # [rad/s^2]
    noise_m: float
    noise_rad: float
    reach_m: float = 0.6


#: Noise of controllers and heads: that of the emulated headset (`emulator.headset.HeadsetModel`); of hands: assumed.
_CONTROLLER: Final = Mover(8.0, 100.0, 30.0, 1000.0, 0.0004, math.radians(0.08))
_HAND: Final = Mover(8.0, 100.0, 30.0, 1000.0, 0.001, math.radians(0.5))
PEOPLE: Final = {
    Device.HEAD: Mover(3.0, 50.0, 12.0, 500.0, 0.0004, math.radians(0.08), reach_m=0.4),
    Device.CONTROLLER_LEFT: _CONTROLLER,
    Device.CONTROLLER_RIGHT: _CONTROLLER,
    Device.HAND_LEFT: _HAND,
    Device.HAND_RIGHT: _HAND,
}


def move_minimum_jerk(share: Array) -> Array:
    """Return how much of a stroke is done after a share of its time."""
    s = np.clip(share, 0.0, 1.0)
    done: Array = s**3 * (10.0 + s * (6.0 * s - 15.0))
    return done


def make_fast_motion(person: Mover, rate_hz: float, seconds: float, rng: np.random.Generator) -> Array:
    """Return positions [m] and turns [rad] of a person who moves as fast as people can, shape (n, 6), without noise.

    Half of the strokes are at the limit of acceleration or speed, the others take up to twice as long; a third follows
    the one before without a pause, and one in five is a shake of 2 to 5 Hz instead.
    """
    times = np.arange(0.0, seconds, 1.0 / rate_hz)
    out = np.zeros((len(times), 6))
    at, begin = np.zeros(6), 0.0
    limits = np.repeat([(person.speed, person.acceleration), (person.turn_speed, person.turn_acceleration)], 3, axis=0)
    while begin < seconds:
        if rng.random() < 0.2:
            way, duration, moved = _make_shake(person, rng, times - begin)
        else:
            target = np.append(_draw_in_ball(person.reach_m, rng), _draw_in_ball(1.2, rng))
            way = target - at
            lengths = np.repeat([np.linalg.norm(way[:3]), np.linalg.norm(way[3:])], 3)
            least = max(
                float((PEAK_SPEED * lengths / limits[:, 0]).max()),
                math.sqrt(float((PEAK_ACCELERATION * lengths / limits[:, 1]).max())),
                0.05,
            )
            duration = least * (1.0 if rng.random() < 0.5 else rng.uniform(1.0, 2.0))
            moved = move_minimum_jerk((times - begin) / duration)
        now = times >= begin
        out[now] = at + moved[now, None] * way
        at = at + float(move_minimum_jerk(np.array(1.0)) if moved[-1] == 1.0 else 0.0) * way
        begin += duration + (0.0 if rng.random() < 1.0 / 3.0 else rng.uniform(0.0, 0.3))
    tremor = 0.0005 * np.sin(2.0 * np.pi * 9.0 * times)  # physiological tremor: 8 to 12 Hz, under a millimetre
    out[:, :3] += tremor[:, None] * np.array([1.0, 0.5, -0.5])
    return out


def _make_shake(person: Mover, rng: np.random.Generator, t: Array) -> tuple[Array, float, Array]:
    """Return direction, duration and motion of whole periods of a sine that begin and end smoothly."""
    frequency = rng.uniform(2.0, 5.0)
    omega = 2.0 * np.pi * frequency
    amplitude = min(rng.uniform(0.03, 0.1), 0.8 * person.acceleration / omega**2, 0.8 * person.speed / omega)
    duration = 8.0 / frequency
    envelope = move_minimum_jerk(t / (2.0 / frequency)) * move_minimum_jerk((duration - t) / (2.0 / frequency))
    direction = _draw_in_ball(1.0, rng)
    way = np.append(amplitude * direction / np.linalg.norm(direction), np.zeros(3))
    return way, duration, np.asarray(envelope * np.sin(omega * t))


def _draw_in_ball(radius: float, rng: np.random.Generator) -> Array:
    direction = rng.standard_normal(3)
    return np.asarray(radius * rng.random() ** (1.0 / 3.0) * direction / np.linalg.norm(direction))


def report_pose(numbers: Array, person: Mover, rng: np.random.Generator) -> Pose:
    """Return a pose from position and turn (6), with the noise of the device."""
    x, y, z = (numbers[:3] + person.noise_m * rng.standard_normal(3)).tolist()
    a, b, c = numbers[3:].tolist()
    i, j, k = (person.noise_rad * rng.standard_normal(3)).tolist()
    return Pose((x, y, z), quat_mul(quat_from_rotvec((a, b, c)), quat_from_rotvec((i, j, k))))
