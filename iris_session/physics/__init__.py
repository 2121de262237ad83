"""The plant of a session: MuJoCo worlds that are saved and restored exactly, robots found in a model, pacing.

Imports only `protocol`. No sockets, no clock: `Pacer` takes the time as an argument. Demo scenes live in `demo`.
"""

from iris_session.physics.errors import (
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
from iris_session.physics.load import compute_scene_hash, decode_model, encode_model, load_model
from iris_session.physics.pacer import Pacer, PacerStats
from iris_session.physics.robots import FoundRobots, RobotNotice, find_objects, find_robots
from iris_session.physics.robots_toml import dump_robots_toml, load_robots_toml
from iris_session.physics.world import World

__all__ = [
    "World",
    "Pacer",
    "PacerStats",
    "load_model",
    "encode_model",
    "decode_model",
    "compute_scene_hash",
    "find_robots",
    "FoundRobots",
    "RobotNotice",
    "find_objects",
    "load_robots_toml",
    "dump_robots_toml",
    "PhysicsError",
    "ModelInvalidError",
    "ModelNotFoundError",
    "ModelUnsupportedError",
    "RobotsFileError",
    "SimulationDivergedError",
    "SnapshotError",
    "SpecError",
    "UnknownNameError",
]
