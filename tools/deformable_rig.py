"""Demos with deformables without a network: real physics and control, operators with delayed and noisy views.

`python -m tools.deformable_rig 10 cloth` runs many seeds and prints the share of successes.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from iris_session.demo.demos import Demo, make_demo
from iris_session.demo.goals import GoalMonitor
from iris_session.emulator.behaviours import make_behaviour
from iris_session.emulator.behaviours.deformables import list_observed_vertices
from tools.handover_rig import Rig

#: Deformables start up to so far from their places, rotated by up to so much.
MOVED_M, TURNED_RAD = 0.015, math.radians(8.0)


@dataclass
class SoftRig(Rig):
    """A rig whose goals are those of a demo, judged by the product's own detector after every tick."""

    watches: list[GoalMonitor] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__post_init__()
        for view in self.views.values():
            view.freezes = True
        for name in self.world.flexes.names if self.shift else ():
            self._shift_deformable(name)

    def _receive(self) -> None:
        super()._receive()
        for watch in self.watches:
            name = watch.goal.deformable
            watch.update(
                self.now_s, self.world.flexes.read_vertices(name), self.world.flexes.find_touching_robots(name)
            )

    def _shift_deformable(self, name: str) -> None:
        """Move and rotate it about its centre by the slides of its vertices or nodes."""
        model, data = self.world.model, self.world.data
        flex = self.world.flexes.names.index(name)
        first, count = int(model.flex_nodeadr[flex]), int(model.flex_nodenum[flex])
        bodies = model.flex_nodebodyid[first : first + count]
        if not count:
            first, count = int(model.flex_vertadr[flex]), int(model.flex_vertnum[flex])
            bodies = model.flex_vertbodyid[first : first + count]
        yaw = self.rng.uniform(-TURNED_RAD, TURNED_RAD)
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        at = data.xpos[bodies][:, :2]
        middle = at.mean(axis=0)
        moved = (at - middle) @ turn.T + middle + [self.rng.uniform(-MOVED_M, MOVED_M) for _ in "xy"]
        joints = model.body_jntadr[bodies]
        data.qpos[model.jnt_qposadr[joints]] += moved[:, 0] - at[:, 0]
        data.qpos[model.jnt_qposadr[joints + 1]] += moved[:, 1] - at[:, 1]
        self.moved_by_hand()

    def _list_missed_goals(self) -> Iterator[str]:
        yield from (f"{w.goal.deformable} is not {w.goal.name}" for w in self.watches if w.at_s is None)

    def over(self) -> bool:
        """Return whether every operator is done and every goal is reached, or an operator has stopped trying."""
        reached = all(watch.at_s is not None for watch in self.watches)
        return any(b.failed for b in self.behaviours.values()) or (reached and super().over())


def soft_demo(play: Demo, seed: int, *, shift: bool = True) -> SoftRig:
    """Return a rig with the cast of a demo."""
    behaviours = {
        task.robot: make_behaviour(task.behaviour, task.robot, task.object, task.partner, task.device, seed)
        for person in play.headsets
        for task in person.tasks
    }
    vertices = {goal.deformable: list_observed_vertices(goal.deformable) for goal in play.goals}
    watches = [GoalMonitor(goal) for goal in play.goals]
    return SoftRig(behaviours, seed, "", vertices=vertices, watches=watches, model=play.model, shift=shift)


def main(runs: int, name: str = "cloth", first: int = 0) -> None:
    """Count successes over `runs` seeds."""
    good, times = 0, []
    play = make_demo(name)
    for seed in range(first, first + runs):
        began = time.process_time()
        rig = soft_demo(play, seed)
        rig.run(130.0, until=SoftRig.over)  # time limit of a demo
        wrong = rig.verdict()
        good += not wrong
        times.append(rig.now_s)
        tries = [b.attempts for b in rig.behaviours.values()]
        cost = (time.process_time() - began) / rig.now_s
        notes = f"attempts {tries}, trouble {rig.world.dropped_counts}, {cost:.2f} CPU s/s"
        print(f"seed {seed}: {wrong or 'ok'}, {rig.now_s:.1f} s, {notes}", flush=True)
    print(f"{name}: {good}/{runs} succeeded, {min(times):.1f} to {max(times):.1f} s each")


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:3], *map(int, sys.argv[3:4]))
