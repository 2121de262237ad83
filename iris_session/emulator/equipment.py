"""What a person is given by its `HeadsetSpec`: a behaviour for its hands, and keys."""

from __future__ import annotations

from iris_session.client import CurveKeys
from iris_session.emulator.behaviours import Behaviour, Hands, make_behaviour
from iris_session.emulator.specs import HeadsetSpec


def behaviour_of(spec: HeadsetSpec, robot: str) -> Behaviour | None:
    """The behaviour of one person, `None` for an observer. Raises `ValueError` naming what is available."""
    hands = [
        make_behaviour(
            task.behaviour, task.robot or robot, task.object, task.partner, task.device, spec.seed, task.arm, task.place
        )
        for task in spec.tasks
    ]
    return None if not hands else hands[0] if len(hands) == 1 else Hands(hands)


def curve_of(spec: HeadsetSpec) -> CurveKeys | None:
    """The CURVE keys of one person. Raises `IdentityError` for files that are no keys, `ValueError` for half a pair."""
    if bool(spec.curve_server) != bool(spec.curve_key):
        raise ValueError("the session's public key and our own secret key (curve_server, curve_key) go together")
    return CurveKeys.from_files(spec.curve_server, spec.curve_key) if spec.curve_key else None
