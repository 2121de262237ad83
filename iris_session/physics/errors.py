"""Errors of the physics room: one line each, saying what is wrong and what would have been right.

PhysicsError
├── ModelNotFoundError        the file does not exist or has an unknown suffix
├── ModelInvalidError         MuJoCo refuses the file or the bytes
├── ModelUnsupportedError     MuJoCo runs the model, but not so that it can be replayed bit for bit
├── UnknownNameError          a joint, actuator, site, body or keyframe that the model does not have
├── RobotsFileError           a mistake in a robots TOML
├── SpecError                 robots or objects that contradict each other
├── SnapshotError             bytes that are no snapshot, or one of another model
└── SimulationDivergedError   the state became NaN, infinite or huge
"""

from __future__ import annotations

from collections.abc import Iterable

from iris_session.protocol.errors import IrisError


class PhysicsError(IrisError):
    """Base of every error of this room."""


class ModelNotFoundError(PhysicsError):
    """The model file does not exist, or is not one that MuJoCo loads."""


class ModelInvalidError(PhysicsError):
    """MuJoCo refuses the model; the text is MuJoCo's message on one line."""


class ModelUnsupportedError(PhysicsError):
    """The model uses a feature whose state MuJoCo cannot save and restore exactly."""


class UnknownNameError(PhysicsError):
    """A name that the model does not have. `available`: the names that would have been right."""

    def __init__(self, kind: str, name: str, available: Iterable[str], where: str = "") -> None:
        self.kind = kind
        self.name = name
        self.available = tuple(available)
        listed = ", ".join(self.available) or "none"
        kinds = "bodies" if kind == "body" else f"{kind}s"
        super().__init__(f"{where}{kind} {name!r} does not exist in the model. Available {kinds}: {listed}.")


class RobotsFileError(PhysicsError):
    """A robots TOML that cannot be used: syntax, unknown key, wrong type, joint of two robots."""


class SpecError(PhysicsError):
    """Robots or objects that cannot be used together: a joint, actuator, body or name of two of them."""


class SnapshotError(PhysicsError):
    """Bytes that are no snapshot of this world."""


class SimulationDivergedError(PhysicsError):
    """The simulation produced NaN, infinite or huge numbers; the world must be reset or restored.

    `tick`: the tick that diverged. MuJoCo may already have put the default state in place of the broken one.
    """

    def __init__(self, tick: int, sim_time: float, what: str) -> None:
        self.tick = tick
        super().__init__(f"the simulation diverged at tick {tick} ({sim_time:.4f} s): {what}")


def one_line(text: object) -> str:
    """Return MuJoCo's message or another text on one line."""
    return " ".join(str(text).split())
