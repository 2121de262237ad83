"""The plant of a session: MuJoCo worlds that are saved and restored exactly, robots found in a model, pacing.

Imports only `protocol`. No sockets, no clock: `Pacer` is told the time.
"""

from iris_session.physics.errors import (
    AmbiguousModelError,
    ModelInvalidError,
    ModelNotFoundError,
    ModelUnsupportedError,
    PhysicsError,
    RobotsFileError,
    SimulationDivergedError,
    SnapshotError,
    SpecError,
    UnknownNameError,
)
from iris_session.physics.load import load_model, model_bytes, model_from_bytes, scene_hash
from iris_session.physics.objects import find_objects
from iris_session.physics.pacer import Pacer, PacerStats
from iris_session.physics.robots import find_robots
from iris_session.physics.robots_toml import dump_robots_toml, load_robots_toml
from iris_session.physics.world import World

__all__ = [
    "World",
    "Pacer",
    "PacerStats",
    "load_model",
    "model_bytes",
    "model_from_bytes",
    "scene_hash",
    "find_robots",
    "find_objects",
    "load_robots_toml",
    "dump_robots_toml",
    "PhysicsError",
    "AmbiguousModelError",
    "ModelInvalidError",
    "ModelNotFoundError",
    "ModelUnsupportedError",
    "RobotsFileError",
    "SimulationDivergedError",
    "SnapshotError",
    "SpecError",
    "UnknownNameError",
]
