"""Poses for the stream tests, and the errors between two sets of them."""

from __future__ import annotations

import numpy as np

from iris_session.streams.quantise import Floats


def random_poses(rng: np.random.Generator, n: int, room: tuple[float, float, float] = (10.0, 10.0, 3.0)) -> Floats:
    """(n, 7) poses, uniform in `room` [m] and over all rotations."""
    q = rng.normal(size=(n, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    return np.hstack((rng.uniform((0.0, 0.0, 0.0), room, (n, 3)), q))


def moved(rng: np.random.Generator, poses: Floats, step_m: float, step_rad: float) -> Floats:
    """Each pose moved by a random vector of length `step_m` and turned by `step_rad` about a random axis."""
    n = len(poses)
    shift, axis = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    shift *= step_m / np.linalg.norm(shift, axis=1)[:, None]
    axis *= np.sin(step_rad / 2) / np.linalg.norm(axis, axis=1)[:, None]
    w, u = np.cos(step_rad / 2), poses[:, 3:]
    q = np.empty((n, 4))
    q[:, 0] = w * u[:, 0] - np.einsum("ij,ij->i", axis, u[:, 1:])
    q[:, 1:] = w * u[:, 1:] + u[:, :1] * axis + np.cross(axis, u[:, 1:])
    return np.hstack((poses[:, :3] + shift, q / np.linalg.norm(q, axis=1)[:, None]))


def position_errors(a: Floats, b: Floats) -> Floats:
    """Euclidean distances [m]."""
    return np.asarray(np.linalg.norm(a[:, :3] - b[:, :3], axis=1))


def rotation_errors(a: Floats, b: Floats) -> Floats:
    """Angles [rad] between the unit quaternions of two sets, from the chord: exact for small angles."""
    qa, qb = a[:, -4:], b[:, -4:]
    chord = np.minimum(np.linalg.norm(qa - qb, axis=1), np.linalg.norm(qa + qb, axis=1))
    return np.asarray(4.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)))
