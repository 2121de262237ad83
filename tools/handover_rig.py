"""A closed loop in one process: the real `World` and `Controller`, operators with delayed and noisy views.

Replaces network, headset and authority only: states reach the operators 30 to 60 ms old with 1 mm and 0.3 deg of
noise and stalls, their samples reach the session 8 to 25 ms later with the same noise on the hand. `Referee` judges the
handover from contacts alone. `python -m tools.handover_rig 50 panda` counts successes over 50 seeds of a demo
(`handover`, `panda`, `aloha`; a third argument is the number of operators), or of `board`.
"""

from __future__ import annotations

import itertools
import math
import random
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import mujoco

from anchors.pose import (
    IDENTITY_QUAT,
    PoseTuple,
    Vec3,
    distance,
    quat_from_rotvec,
    quat_from_yaw,
    quat_mul,
    quat_normalize,
)
from iris_session.control.controller import Controller
from iris_session.demo.demos import Demo, make_demo
from iris_session.demo.scenes import scene_path
from iris_session.emulator.behaviours import Behaviour, Giver, HandInput, PlannedGiver, Receiver, make_behaviour
from iris_session.physics.robots import find_objects, find_robots
from iris_session.physics.world import World
from iris_session.protocol.common import Pose
from iris_session.protocol.names import CommandKind, HoldReason
from iris_session.protocol.steps import Command, CommandSource, Decision

NOISE = (0.001, math.radians(0.3))  # per axis: m, rad
STATE_S = 1.0 / 60.0
SAMPLE_S = 1.0 / 72.0


def add_noise(pose: PoseTuple, rng: random.Random, noise: tuple[float, float]) -> PoseTuple:
    (x, y, z), q = pose
    metres, radians = noise
    turn = quat_from_rotvec((rng.gauss(0, radians), rng.gauss(0, radians), rng.gauss(0, radians)))
    return ((x + rng.gauss(0, metres), y + rng.gauss(0, metres), z + rng.gauss(0, metres)), quat_mul(turn, q))


class LateView:
    """`OperatorView` of one person: the newest delivered state, with noise; the picture stalls now and then."""

    def __init__(self, rng: random.Random, noise: tuple[float, float] = NOISE, stalls: bool = True) -> None:
        self.session_time_ns = 0
        self.estop = False
        self.lease: int | None = 1
        self.hand: PoseTuple = ((rng.uniform(-1, 1), -1.2, 0.3), quat_normalize(tuple(rng.gauss(0, 1) for _ in "wxyz")))
        self._rng, self._noise, self._stalls = rng, noise, stalls
        self._frames: deque[tuple[float, float, dict[str, PoseTuple]]] = deque(maxlen=16)
        self._stalled_until_s = 0.0
        self._frame: dict[str, PoseTuple] = {}
        self._shown: dict[str, PoseTuple] = {}  # of the frame, with noise: only what was queried
        #: Deformables of the whole frame. A cloth is folded for most seeds, not for all: they keep their noise.
        self.sees_all = False
        #: The picture of deformables stalls for up to 1.5 s, about every four seconds.
        self.freezes = False
        self._frozen_until_s = 0.0
        self._bent: dict[str, PoseTuple] = {}
        self._vertices: dict[str, PoseTuple] = {}
        self._vertices_s = 0.0

    def publish(self, now_s: float, poses: dict[str, PoseTuple]) -> None:
        self._frames.append((now_s + self._rng.uniform(0.030, 0.060), now_s, poses))

    def stalled(self, now_s: float) -> bool:
        """Return whether this operator's computer stalls: 30 ms in every hundredth frame."""
        if now_s >= self._stalled_until_s and self._stalls and self._rng.random() < 0.01:
            self._stalled_until_s = now_s + 0.030
        return now_s < self._stalled_until_s

    def receive_frame(self, now_s: float) -> None:
        self.session_time_ns = round(now_s * 1e9)
        arrived = [(of_s, poses) for arrives_s, of_s, poses in self._frames if arrives_s <= now_s]
        if not arrived:
            return
        of_s, poses = arrived[-1]
        self._frame, self._shown = poses, {}
        for name in poses if self.sees_all else ():
            self._seen(name, poses, self._shown)
        if self.freezes and now_s >= self._frozen_until_s and self._rng.random() < 0.003:
            self._frozen_until_s = now_s + self._rng.uniform(0.2, 1.5)
        if now_s >= self._frozen_until_s:
            self._vertices_s, self._bent, self._vertices = of_s, poses, self._shown

    def _seen(self, name: str, frame: dict[str, PoseTuple], shown: dict[str, PoseTuple]) -> PoseTuple | None:
        """Repeated queries within one picture return the same pose."""
        if name not in shown and name in frame:
            shown[name] = add_noise(frame[name], self._rng, self._noise)
        return shown.get(name)

    def body_pose(self, name: str) -> PoseTuple | None:
        return self._seen(name, self._frame, self._shown)

    def tip_pose(self, robot: str) -> PoseTuple | None:
        return self._seen(f"tip:{robot}", self._frame, self._shown)

    def vertex(self, deformable: str, index: int) -> Vec3 | None:
        seen = self._seen(f"vertex:{deformable}:{index}", self._bent, self._vertices)
        return None if seen is None else seen[0]

    def vertices_ns(self, deformable: str) -> int:
        return round(self._vertices_s * 1e9)

    def lease_version(self, robot: str) -> int | None:
        return self.lease

    def device_pose(self, device: str) -> PoseTuple:
        return self.hand


class Referee:
    """Follows one object by contacts: every interval in the air, and its holders."""

    def __init__(self, object: str) -> None:
        self.object = object
        self.flights: list[list[tuple[float, tuple[str, ...]]]] = []  # per flight: (start, holders)
        self.other_robots: set[str] = set()  # robots that touched it in the air without holding it
        self._in_air = False
        self.resting = True

    def tick(self, world: World) -> None:
        contact = next((c for c in world.view().object_contacts() if c.object == self.object), None)
        others = contact.others if contact else ()
        holders = contact.grippers if contact else ()
        if others:
            self._in_air = False
        else:
            if not self._in_air:
                self.flights.append([])
            self._in_air = True
            flight = self.flights[-1]
            if not flight or flight[-1][1] != holders:
                flight.append((world.view().sim_time, holders))
        self.resting = bool(others) and not (contact and contact.touching)

    def handed_over(self, giver: str, receiver: str) -> bool:
        """Return whether one flight began in `giver`'s grip, passed through both, ended in `receiver`'s, never free."""
        return any(_is_handover(flight, giver, receiver) for flight in self.flights)


def _is_handover(flight: Sequence[tuple[float, tuple[str, ...]]], giver: str, receiver: str) -> bool:
    held = [set(holders) for _, holders in flight]
    free_s = max(
        (after - since for (since, holders), (after, _) in itertools.pairwise(flight) if not holders), default=0.0
    )
    return (
        free_s < 0.012  # a pad may lose contact for a few ticks
        and next((h for h in held if h), set()) == {giver}
        and {giver, receiver} in held
        and next((h for h in reversed(held) if h), set()) == {receiver}
    )


@dataclass
class Rig:
    """The scene, its controller and one operator per robot in `behaviours`."""

    behaviours: Mapping[str, Behaviour]
    seed: int = 0
    object: str = "hammer"
    also: tuple[str, ...] = ()  # other objects that change hands
    vertices: Mapping[str, tuple[int, ...]] = field(default_factory=dict)  # of deformables that operators watch
    shift: bool = True  # start the objects up to 30 mm and 20 deg from their places
    noise: tuple[float, float] = NOISE
    views: dict[str, LateView] = field(default_factory=dict)
    fastest_hand: float = 0.0  # m/s
    model: Any = None

    def __post_init__(self) -> None:
        self.rng = random.Random(self.seed)
        model = self.model or mujoco.MjModel.from_xml_path(str(scene_path("handover")))
        self.robots, self.objects = find_robots(model).robots, find_objects(model)
        self.world = World(model, self.robots, self.objects)
        objects = tuple(filter(None, (self.object, *self.also)))
        for name in objects if self.shift else ():
            self._shift_object(name)
        self.controller = Controller(model, self.robots, self.objects)
        self.controller.reset(self.world.data)
        self.referees = {name: Referee(name) for name in objects}
        self.views = {robot: LateView(random.Random(self.rng.random()), self.noise) for robot in self.behaviours}
        for view in self.views.values():
            view.sees_all = bool(self.vertices)
        self._commands = {spec.name: Command(spec.name, CommandKind.HOLD, HoldReason.NO_SAMPLE) for spec in self.robots}
        self._on_the_way: deque[tuple[float, HandInput]] = deque()
        self._engagements = dict.fromkeys(self.behaviours, 0)
        self._next_sample_s = {robot: self.rng.uniform(0, SAMPLE_S) for robot in self.behaviours}
        self._next_state_s = 0.0
        self._seq = 0

    @property
    def now_s(self) -> float:
        return self.world.view().sim_time

    def run(self, seconds: float, until: Callable[[Rig], bool] | None = None) -> None:
        """Run until `until` holds (default: every operator is done), for at most `seconds` more."""
        stop = until or (lambda rig: all(b.done for b in rig.behaviours.values()))
        end_s = self.now_s + seconds
        while self.now_s < end_s and not stop(self):
            self._publish()
            for robot in self.behaviours:
                if self.now_s >= self._next_sample_s[robot]:
                    self._next_sample_s[robot] += SAMPLE_S
                    self._operate(robot)
            self._receive()
            decision = Decision(tuple(self._commands.values()))
            self.controller.begin(round(self.now_s * 1e9), 1, decision, self.world.view())
            self._commands = {name: _seen(command) for name, command in self._commands.items()}
            self.controller.tick(self.world.data)
            self.world.tick()
            for referee in self.referees.values():
                referee.tick(self.world)

    def verdict(self) -> str:
        """Return an empty text when every operator is done and every goal is reached, else the fault."""
        wrong = [
            f"{robot} ({b.phase}): {b.failed or 'not done'}"
            for robot, b in self.behaviours.items()
            if b.failed or not b.done
        ]
        return "; ".join([*wrong, *self._list_missed_goals()])

    def over(self) -> bool:
        """Return whether every operator is done, or one has stopped trying."""
        behaviours = self.behaviours.values()
        return all(b.done for b in behaviours) or any(b.failed for b in behaviours)

    def _list_missed_goals(self) -> Iterator[str]:
        for giver in (b for b in self.behaviours.values() if isinstance(b, Giver)):
            referee = self.referees[giver.object]
            if not referee.handed_over(giver.robot, giver.partner):
                yield f"no clean handover of {giver.object}: {referee.flights}"
            elif isinstance(giver, PlannedGiver):
                if referee.flights[-1][-1][1] != (giver.partner,):
                    yield f"{giver.object} is not in the gripper of {giver.partner}"
            elif not referee.resting:
                yield f"{giver.object} does not rest on the table alone"

    def moved_by_hand(self) -> None:
        """Update poses and contacts after a write to `qpos`."""
        self.world.restore_state(self.world.save_state())

    def _publish(self) -> None:
        if self.now_s < self._next_state_s:
            return
        self._next_state_s += STATE_S
        data = self.world.data
        poses: dict[str, PoseTuple] = {
            body.name: (tuple(data.xpos[body.id].tolist()), tuple(data.xquat[body.id].tolist()))
            for body in self.world.bodies
        }
        for spec in self.robots:
            tip = self.world.view().tip_pose(spec.name)
            poses[f"tip:{spec.name}"] = (tip.p, tip.q)
        for name, watched in self.vertices.items():
            p_world = self.world.flexes.read_vertices(name)
            for index in watched:
                poses[f"vertex:{name}:{index}"] = (tuple(p_world[index].tolist()), IDENTITY_QUAT)
        for view in self.views.values():
            view.publish(self.now_s, poses)

    def _operate(self, robot: str) -> None:
        view, behaviour = self.views[robot], self.behaviours[robot]
        if view.stalled(self.now_s):
            return
        before = view.session_time_ns
        view.receive_frame(self.now_s)
        for hand in behaviour.update(view):
            if hand.clutch and view.session_time_ns > before:
                speed = distance(hand.pose_world[0], view.hand[0]) / ((view.session_time_ns - before) * 1e-9)
                self.fastest_hand = max(self.fastest_hand, speed)
            view.hand = hand.pose_world
            noisy = HandInput(
                hand.device, hand.robot, add_noise(hand.pose_world, self.rng, self.noise), hand.clutch, hand.gripper
            )
            self._on_the_way.append((self.now_s + self.rng.uniform(0.008, 0.025), noisy))

    def _receive(self) -> None:
        while self._on_the_way and self._on_the_way[0][0] <= self.now_s:
            hand = self._on_the_way.popleft()[1]
            engaged = self._commands[hand.robot].kind == CommandKind.POSE
            if not hand.clutch:
                self._commands[hand.robot] = Command(hand.robot, CommandKind.HOLD, HoldReason.CLUTCH_OPEN)
                continue
            self._engagements[hand.robot] += not engaged
            self._seq += 1
            now_ns = round(self.now_s * 1e9)
            engagement, pose = self._engagements[hand.robot], Pose(*hand.pose_world)
            source = CommandSource(hand.robot, hand.device, engagement, self._seq, now_ns, now_ns, pose_world=pose)
            self._commands[hand.robot] = Command(hand.robot, CommandKind.POSE, "", (source,), hand.gripper)

    def _shift_object(self, name: str) -> None:
        data = self.world.data
        at = int(self.world.model.jnt_qposadr[self.world.model.body(name).jntadr[0]])
        data.qpos[at : at + 2] += (self.rng.uniform(-0.03, 0.03), self.rng.uniform(-0.03, 0.03))
        turn = quat_from_yaw(self.rng.uniform(-0.35, 0.35))
        data.qpos[at + 3 : at + 7] = quat_mul(turn, tuple(data.qpos[at + 3 : at + 7].tolist()))
        self.moved_by_hand()


def _seen(command: Command) -> Command:
    """Return the command for a later step: its sample is not new any more."""
    if command.kind != CommandKind.POSE or not command.sources[0].new:
        return command
    return msgspec.structs.replace(command, sources=(msgspec.structs.replace(command.sources[0], new=False),))


def handover(seed: int, object: str = "hammer", giver: str = "left", receiver: str = "right", **options: Any) -> Rig:
    """Return a rig with one giver and one receiver in the packaged handover scene."""
    behaviours = {giver: Giver(giver, object, receiver), receiver: Receiver(receiver, object, giver)}
    return Rig(behaviours, seed, object, **options)


def demo(play: Demo, seed: int, **options: Any) -> Rig:
    """Return a rig with the cast of a demo, one behaviour per robot; operators without a partner are left out."""
    behaviours = {}
    for task in (task for person in play.headsets for task in person.tasks if task.partner):
        args = (
            task.behaviour,
            task.robot,
            task.object,
            task.partner,
            task.device,
            seed,
            task.arm,
            task.place,
            task.plan,
        )
        behaviours[task.robot] = make_behaviour(*args)
    return Rig(behaviours, seed, play.objects[0], play.objects[1:], model=play.model, **options)


def main(runs: int, name: str = "handover", operators: int = 2, first: int = 0) -> None:
    """Count successes over `runs` seeds."""
    good, times = 0, []
    play = None if name == "board" else make_demo(name, operators)
    for seed in range(first, first + runs):
        rig = handover(seed, "board", "right", "left") if play is None else demo(play, seed)
        rig.run(90.0, until=Rig.over)
        wrong = rig.verdict()
        good += not wrong
        times.append(rig.now_s)
        tries = [b.attempts for b in rig.behaviours.values()]
        again = [b.hand.reclutches for b in rig.behaviours.values()]
        if wrong or max(tries) > 1 or max(again) > 0 or rig.fastest_hand > 0.5:
            notes = f"attempts {tries}, reclutched {again}, {rig.fastest_hand:.2f} m/s"
            print(f"seed {seed}: {wrong or 'ok'}, {rig.now_s:.1f} s, {notes}", flush=True)
    print(f"{name}, {operators} operators: {good}/{runs} succeeded, {min(times):.1f} to {max(times):.1f} s each")


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:3], *map(int, sys.argv[3:5]))
