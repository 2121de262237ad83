"""Interface of scripted operators: their input and output. Independent of the network, the headset and MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from anchors.pose import PoseTuple, Vec3


class OperatorView(Protocol):
    """The scene as displayed in the headset: the state stream in the world frame, delayed and noisy."""

    @property
    def session_time_ns(self) -> int:
        """The present session time by the client's clock; never goes back."""
        ...

    @property
    def estop(self) -> bool: ...

    def body_pose(self, name: str) -> PoseTuple | None:
        """Pose of a body of the scene; `None`: not in the stream."""
        ...

    def tip_pose(self, robot: str) -> PoseTuple | None:
        """Pose of the robot's end-effector site; `None`: not in the stream."""
        ...

    def vertex(self, deformable: str, index: int) -> Vec3 | None:
        """Position of vertex `index` of a deformable [m]; `None`: not in the stream."""
        ...

    def vertices_ns(self, deformable: str) -> int:
        """Session time of the displayed vertices of a deformable; 0: not in the stream. They may be late: media have
        lower priority on a busy link or computer."""
        ...

    def lease_version(self, robot: str) -> int | None:
        """Version of the own lease on `robot`; `None` without one."""
        ...

    def device_pose(self, device: str) -> PoseTuple:
        """Present pose of the own hand."""
        ...


@dataclass(frozen=True, slots=True)
class HandInput:
    """Input of one hand. `gripper`: trigger, 0 open to 1 closed."""

    device: str
    robot: str
    pose_world: PoseTuple
    clutch: bool
    gripper: float


class Behaviour(Protocol):
    """A closed loop from the displayed scene to hand inputs.

    `phase`: present task phase, one word. `done`: the task has ended. `failed`: reason of a failure, else "".
    """

    phase: str
    done: bool
    failed: str

    def update(self, view: OperatorView) -> tuple[HandInput, ...]:
        """Return the inputs of the hands; called once per headset frame or input sample (60-90 Hz)."""
        ...


class CombinedBehaviour:
    """Several behaviours as one: done when all are, failed when one is. `phase`: that of the first not yet done."""

    def __init__(self, hands: Sequence[Behaviour]) -> None:
        self._hands = tuple(hands)
        self.phase = self._hands[0].phase
        self.done = False
        self.failed = ""

    def update(self, view: OperatorView) -> tuple[HandInput, ...]:
        """Return the inputs of all hands; see `Behaviour.update`."""
        inputs = tuple(hand_input for hand in self._hands for hand_input in hand.update(view))
        self.phase = next((hand.phase for hand in self._hands if not hand.done), "done")
        self.done = all(hand.done for hand in self._hands)
        self.failed = next((hand.failed for hand in self._hands if hand.failed), "")
        return inputs
