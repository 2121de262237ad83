"""Joint-space control by leader robots: the follower takes the leader's joints, ramped when they are apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from iris_session.control.arm_model import Floats
from iris_session.control.clutch import Latch
from iris_session.control.config import ControlConfig
from iris_session.control.errors import ControlError
from iris_session.protocol.steps import CommandSource


def leader_goal(state: Latch, sources: Sequence[CommandSource], goal: Floats, config: ControlConfig) -> Floats:
    """New joint goal, shape (n,). One source of full weight: its joints, predicted by `qd` across the interpolation
    delay. Several (mode `shared`): the present `goal` plus their weighted increments."""
    n = len(goal)
    single = len(sources) == 1 and sources[0].weight == 1.0
    for old, new in zip(state.sources, sources, strict=True):
        if len(new.q) != n or len(new.qd) not in (0, n):
            raise ControlError(f"joint sample of {new.participant!r} has {len(new.q)} joints; it must have {n}")
        q = np.array(new.q)
        if single:
            goal = q
            if new.qd:
                bound = config.leader_lookahead_max
                goal = q + np.clip(np.array(new.qd) * config.leader_lookahead_s, -bound, bound)
        else:
            goal = goal + new.weight * (q - np.array(old.q or new.q))
        old.q = new.q
    return goal


def ramping(active: bool, apart: float, config: ControlConfig) -> bool:
    """Whether the follower is ramped: from `leader_apart` [rad] on, until it has caught up."""
    return apart > (config.leader_caught_up if active else config.leader_apart)
