"""The demos: for each its scene, the pose of its sheet, and its cast of emulated operators. Nothing runs here.

`handover`: two arms drawn from primitives and a hammer, or up to eight around a round table; needs no data.
`panda`: the same with Franka Panda arms. `aloha`: two ALOHA stations, two operators with two arms each. `cloth`: two
operators fold a cloth. `soft`: two operators stow a soft body each. `cloud`: `handover` before two depth cameras, whose
cloud and pictures observers watch. `make_planned_handover`: an object of any scene.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import msgspec
import mujoco

from anchors.pose import IDENTITY_QUAT, PoseTuple, Vec3
from iris_session.cloud.camera_file import load_camera_file
from iris_session.control.config import ControlConfig
from iris_session.demo.goals import FoldGoal, Goal, StowGoal
from iris_session.demo.handover_plan import plan_handover
from iris_session.demo.named_scenes import NamedScene, scene_by_name
from iris_session.demo.scenes.deformables import BOX_HIGH, BOX_LOW, FOLD_PAIRS, RADIUS
from iris_session.demo.scenes.generators import arm_names, compute_bearing, compute_circle_radius
from iris_session.demo.scenes.panda import compute_panda_radius
from iris_session.emulator.headset import DEFAULT_ANCHOR_ID, DEFAULT_SHEET_M
from iris_session.emulator.specs import HandTask, HeadsetSpec
from iris_session.physics import find_objects
from iris_session.protocol.names import Device
from iris_session.protocol.specs import ObjectRange, TaskSpec
from iris_session.session.errors import ConfigError
from iris_session.session.robots import find_drivable_robots

MAX_OPERATORS: Final = 8
MAX_OBSERVERS: Final = 16
MORE_PEOPLE: Final = "For more people: iris-session demo handover --operators N"
#: Names of operators, in the order in which they join.
NAMES: Final = ("ann", "bob", "cem", "dia", "eli", "fay", "gus", "hoa")
#: Distance of an operator behind the arm, and height of the eyes above the table [m].
_BEHIND, _EYES = 0.45, 0.55


#: How far from its place in the scene an object of a planned handover lies in each episode [m] along both axes, [rad].
PLACES_M, PLACES_RAD = 0.02, math.radians(10.0)


@dataclass(frozen=True)
class Demo:
    """A demo ready to run.

    Attributes:
        objects: Objects that must be handed over.
        notes: Remarks about the cast for the reader of the result.
        goals: Goals for deformables.
        cameras: Camera files of the depth cameras of the scene.
        streams: Media streams of these cameras, which every observer watches.
        task: Of a planned handover: every attempt is an episode of it.
    """

    name: str
    model: mujoco.MjModel
    anchors: Mapping[str, PoseTuple]
    headsets: tuple[HeadsetSpec, ...]
    objects: tuple[str, ...]
    notes: tuple[str, ...] = ()
    anchor_sizes: Mapping[str, float] = field(default_factory=dict)
    goals: tuple[Goal, ...] = ()
    cameras: tuple[Path, ...] = ()
    streams: tuple[str, ...] = ()
    task: TaskSpec | None = None


def make_demo(name: str, operators: int = 2, observers: int = 0, seed: int = 0) -> Demo:
    """Return the demo `name`. Raises `ConfigError` for an unusable cast, `ModelNotFoundError` without its models."""
    if name not in DEMOS:
        raise ConfigError(f"there is no demo '{name}': {', '.join(DEMOS)}")
    _check_observers(observers)
    return _add_observers(DEMOS[name](operators, seed), observers, seed)


def _add_observers(play: Demo, observers: int, seed: int) -> Demo:
    if play.streams:
        observers = max(1, observers)
    sheet = play.anchors[DEFAULT_ANCHOR_ID]
    watching = tuple(
        msgspec.structs.replace(_make_observer(i, observers, sheet, seed), streams=play.streams)
        for i in range(observers)
    )
    return dataclasses.replace(play, headsets=(*play.headsets, *watching))


# --- any object of any scene ------------------------------------------------------------------------------------------


def make_planned_handover(
    scene: NamedScene,
    thing: str = "",
    giver: str = "",
    receiver: str = "",
    *,
    episodes: int = 1,
    observers: int = 0,
    seed: int = 0,
) -> Demo:
    """Return the demo in which two people hand an object of a scene over, once for each episode.

    Args:
        scene: The scene, with two arms that have grippers of two fingers.
        thing: The object; empty: the only free body.
        giver: The robot that gives; empty: the nearest that reaches the object.
        receiver: The robot that takes; empty: the nearest other one.
        episodes: Number of handovers that are wanted. The object lies a little elsewhere in each, if there are several.
        observers: Number of observers.
        seed: Of people and places.

    Raises:
        ConfigError: It cannot be done; one line says why.
    """
    _check_observers(observers)
    model, control = scene.model, ControlConfig()
    plan = plan_handover(
        model, find_drivable_robots(model, control).robots, find_objects(model), thing, giver, receiver
    )
    (x, y, z), _ = plan.T_world_lying
    sheet: PoseTuple = ((plan.T_world_meeting[0][0], plan.T_world_meeting[0][1], z), IDENTITY_QUAT)
    people = tuple(
        HeadsetSpec(
            name=NAMES[i],
            behaviour=behaviour,
            robot=robot,
            object=plan.object,
            partner=partner,
            plan=plan,
            stays=True,
            seed=seed + i,
            eye=(sheet[0][0] + 0.35 * (2 * i - 1), sheet[0][1] - 0.5, z + _EYES),
            T_world_anchor=sheet,
        )
        for i, (behaviour, robot, partner) in enumerate(
            (
                ("giver", plan.giver.robot, plan.receiver.robot),
                ("receiver", plan.receiver.robot, plan.giver.robot),
            )
        )
    )
    aside, turn = (PLACES_M, PLACES_RAD) if episodes > 1 else (0.0, 0.0)
    task = TaskSpec(
        name=f"handover-{plan.object}"[:64],
        instruction=f"Hand the {plan.object} over from {plan.giver.robot} to {plan.receiver.robot}.",
        wanted=episodes,
        robots=(plan.giver.robot, plan.receiver.robot),
        objects=(
            (ObjectRange(plan.object, (x - aside, x + aside), (y - aside, y + aside), yaw=(-turn, turn)),)
            if episodes > 1
            else ()
        ),
        seed=seed,
    )
    play = Demo("handover", model, {DEFAULT_ANCHOR_ID: sheet}, people, (plan.object,), task=task)
    play = dataclasses.replace(play, anchor_sizes=dict.fromkeys(play.anchors, DEFAULT_SHEET_M))
    return _add_observers(play, observers, seed)


# --- arms around a table ----------------------------------------------------------------------------------------------


def _make_handover(operators: int, seed: int) -> Demo:
    _check_operators("handover", operators)
    if operators == 2:
        return _cast_around_table(_make_without_cast("handover", "handover", ("hammer",)), operators, 0.6, "arm", seed)
    play = _make_without_cast("handover", f"arms{operators}", _list_objects(operators))
    return _cast_around_table(play, operators, compute_circle_radius(operators), "arm", seed)


def _make_panda(operators: int, seed: int) -> Demo:
    _check_operators("panda", operators)
    play = _make_without_cast("panda", f"panda{operators}", _list_objects(operators))
    return _cast_around_table(play, operators, compute_panda_radius(operators), "panda", seed)


def _make_without_cast(name: str, scene_name: str, objects: tuple[str, ...]) -> Demo:
    """Return a demo in the named scene, without its cast."""
    scene: NamedScene = scene_by_name(scene_name)
    return Demo(name, scene.model, scene.anchors, (), objects, anchor_sizes=scene.anchor_sizes, cameras=scene.cameras)


def _check_observers(observers: int) -> None:
    if not 0 <= observers <= MAX_OBSERVERS:
        raise ConfigError(f"--observers {observers} is out of range: 0 to {MAX_OBSERVERS}")


def _check_operators(demo: str, operators: int) -> None:
    if not 2 <= operators <= MAX_OPERATORS:
        raise ConfigError(
            f"demo {demo} takes 2 to {MAX_OPERATORS} operators, not {operators}: each has an arm, and it "
            "takes two to hand something over"
        )


def _require_two(demo: str, operators: int, places: str, advice: str) -> None:
    if operators != 2:
        raise ConfigError(f"demo {demo} has {places}: 2 operators, not {operators}. {advice}")


def _list_objects(operators: int) -> tuple[str, ...]:
    return tuple(f"object{k + 1}" for k in range(operators // 2))


def _cast_around_table(play: Demo, operators: int, radius: float, arm: str, seed: int) -> Demo:
    """Cast adjacent operators as pairs: the first gives to the second, the third to the fourth. With an odd number the
    last one has no partner."""
    sheet = play.anchors[DEFAULT_ANCHOR_ID]
    robots = arm_names(operators)
    people = []
    notes = []
    for i, robot in enumerate(robots):
        partner = robots[i ^ 1] if (i ^ 1) < operators else ""
        behaviour = "wander" if not partner else "receiver" if i % 2 else "giver"
        if not partner:
            notes.append(f"{NAMES[i]} has no partner and only moves {robot}: an even number of operators pairs up")
        people.append(
            HeadsetSpec(
                name=NAMES[i],
                behaviour=behaviour,
                robot=robot,
                partner=partner,
                object=play.objects[min(i // 2, len(play.objects) - 1)],
                arm=arm,
                seed=seed + i,
                eye=_compute_seat(i, operators, radius, sheet[0]),
                T_world_anchor=sheet,
            )
        )
    return dataclasses.replace(play, headsets=tuple(people), notes=tuple(notes))


def _compute_seat(i: int, operators: int, radius: float, sheet: Vec3) -> Vec3:
    """Return the eye position: two operators stand side by side before the sheet, more of them behind their arms."""
    if operators == 2:
        return (0.35 * (2 * i - 1), sheet[1] - 0.5, _EYES)
    bearing = compute_bearing(i, operators)
    return ((radius + _BEHIND) * math.cos(bearing), (radius + _BEHIND) * math.sin(bearing), _EYES)


def _make_cloud(operators: int, seed: int) -> Demo:
    _require_two("cloud", operators, "two arms at one table", "More people may watch: --observers N")
    play = _make_without_cast("cloud", "cloud", ("hammer",))
    streams = tuple(name for path in play.cameras for name in load_camera_file(path).list_streams())
    return dataclasses.replace(_cast_around_table(play, operators, 0.6, "arm", seed), streams=streams)


# --- two ALOHA stations -----------------------------------------------------------------------------------------------


def _make_aloha(operators: int, seed: int) -> Demo:
    _require_two("aloha", operators, "two stations with two arms each", MORE_PEOPLE)
    play = _make_without_cast("aloha", "aloha", ("red_board", "blue_board"))
    sheet = play.anchors[DEFAULT_ANCHOR_ID]

    def hand(station: str, side: str, behaviour: str, thing: str, partner: str, place: tuple[float, float]) -> HandTask:
        return HandTask(
            behaviour=behaviour,
            robot=f"{station}/{side}",
            device=Device.CONTROLLER_LEFT if side == "left" else Device.CONTROLLER_RIGHT,
            object=thing,
            partner=partner,
            arm="viperx",
            place=place,
        )

    far, near = (0.015, 0.53), (-0.015, -0.53)  # where a receiver lays the board: on its own table, out of the way
    ann = (
        hand("south", "right", "giver", "red_board", "north/left", far),
        hand("south", "left", "receiver", "blue_board", "north/right", near),
    )
    bob = (
        hand("north", "left", "receiver", "red_board", "south/right", far),
        hand("north", "right", "giver", "blue_board", "south/left", near),
    )
    people = tuple(
        HeadsetSpec(name=name, hands=hands, seed=seed + i, eye=(0.0, y, 0.6), T_world_anchor=sheet)
        for i, (name, hands, y) in enumerate((("ann", ann, -1.25), ("bob", bob, 1.25)))
    )
    return dataclasses.replace(play, headsets=people)


# --- deformables ------------------------------------------------------------------------------------------------------


def _make_cloth(operators: int, seed: int) -> Demo:
    goals = (FoldGoal("cloth", FOLD_PAIRS),)
    return _cast_at_table("cloth", operators, seed, goals, "folder", ("cloth", "cloth"))


def _make_soft(operators: int, seed: int) -> Demo:
    things = ("rose", "mint")
    goals = tuple(StowGoal(name, BOX_LOW, BOX_HIGH) for name in things)
    return _cast_at_table("soft", operators, seed, goals, "stower", things)


def _cast_at_table(
    name: str, operators: int, seed: int, goals: tuple[Goal, ...], behaviour: str, things: tuple[str, str]
) -> Demo:
    """Cast two operators side by side before the sheet, one arm each."""
    _require_two(name, operators, "two arms at one table", MORE_PEOPLE)
    play = _make_without_cast(name, name, ())
    sheet = play.anchors[DEFAULT_ANCHOR_ID]
    left, right = arm_names(2)
    people = tuple(
        HeadsetSpec(
            name=NAMES[i],
            behaviour=behaviour,
            robot=robot,
            partner=partner,
            object=things[i],
            seed=seed + i,
            eye=_compute_seat(i, operators, RADIUS, sheet[0]),
            T_world_anchor=sheet,
        )
        for i, (robot, partner) in enumerate(((left, right), (right, left)))
    )
    return dataclasses.replace(play, headsets=people, goals=goals)


DEMOS: Final[dict[str, Callable[[int, int], Demo]]] = {
    "handover": _make_handover,
    "panda": _make_panda,
    "aloha": _make_aloha,
    "cloth": _make_cloth,
    "soft": _make_soft,
    "cloud": _make_cloud,
}


def _make_observer(i: int, count: int, sheet: PoseTuple, seed: int) -> HeadsetSpec:
    """Return an observer 1.2 m from the sheet."""
    x, y, z = sheet[0]
    bearing = -0.5 * math.pi + 2.0 * math.pi * (i + 0.5) / count
    eye = (x + 1.2 * math.cos(bearing), y + 1.2 * math.sin(bearing), z + _EYES)
    return HeadsetSpec(name=f"watcher{i + 1}", seed=seed + 100 + i, eye=eye, T_world_anchor=sheet)
