"""Scripted operators: closed loops from what a headset shows to what the hands do. No MuJoCo, no network, no clock.

`base` (the interface), `phases` (task phases), `handover` (giver and receiver), `plan` and `planned` (the same by a
plan, for any object and arms), `folder` (folds a cloth with a
partner), `stower` (stows a soft body), `wander` (motion without a task), `hand` (clutched motion), `perception`,
`objects` (objects and arms).
"""

from __future__ import annotations

from iris_session.emulator.behaviours.base import Behaviour, CombinedBehaviour, HandInput, OperatorView
from iris_session.emulator.behaviours.folder import Folder
from iris_session.emulator.behaviours.handover import Giver, Receiver
from iris_session.emulator.behaviours.objects import get_arm_kind
from iris_session.emulator.behaviours.plan import HandoverPlan
from iris_session.emulator.behaviours.planned import PlannedGiver, PlannedReceiver
from iris_session.emulator.behaviours.stower import Stower
from iris_session.emulator.behaviours.wander import Idle, Wander
from iris_session.protocol.names import Device

__all__ = [
    "Behaviour",
    "Folder",
    "Giver",
    "HandInput",
    "CombinedBehaviour",
    "Idle",
    "OperatorView",
    "PlannedGiver",
    "PlannedReceiver",
    "Receiver",
    "Stower",
    "Wander",
    "make_behaviour",
]

NAMES = ("giver", "receiver", "folder", "stower", "wander", "idle")
_WITH_PARTNER = ("giver", "receiver", "folder")


def make_behaviour(
    name: str,
    robot: str,
    object: str = "hammer",
    partner: str = "",
    device: str = Device.CONTROLLER_RIGHT,
    seed: int = 0,
    arm: str = "arm",
    place: tuple[float, float] | None = None,
    plan: HandoverPlan | None = None,
) -> Behaviour:
    """Return the behaviour `name` for `robot`. `partner`: the other robot of a handover or fold; default the other of
    left and
    right. `object`: a thing, or a deformable. `arm`: kind of both arms. `place`: where a receiver or stower lays it
    (x, y [m], world); default before its robot. `plan`: how giver and receiver hand over a thing that is not one of
    `objects`; it names thing and robots.

    Raises `ValueError` listing the available behaviours.
    """
    if name in _WITH_PARTNER and not partner:
        if robot not in {"left", "right"}:
            raise ValueError(f"the {name} of '{robot}' needs a partner: the name of the other robot")
        partner = "right" if robot == "left" else "left"
    match name:
        case "giver" if plan is not None:
            return PlannedGiver(plan, device)
        case "receiver" if plan is not None:
            return PlannedReceiver(plan, device)
        case "giver":
            return Giver(robot, object, partner, device, get_arm_kind(arm))
        case "receiver":
            return Receiver(robot, object, partner, device, get_arm_kind(arm), place)
        case "folder":
            return Folder(robot, object, partner, device, get_arm_kind(arm))
        case "stower":
            return Stower(robot, object, device, get_arm_kind(arm), place)
        case "wander":
            return Wander(robot, device, seed)
        case "idle":
            return Idle(robot, device)
    raise ValueError(f"no behaviour '{name}'. Available behaviours: {', '.join(NAMES)}, observer")
