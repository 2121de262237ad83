"""`ModelFollower`: keeps what clients see of a MuJoCo model up to date while a program changes its looks.

Goals and targets of benchmark suites are sites and geoms that a program moves and recolours in its `MjModel`, at a
reset or while it runs. They become patches of the scene, as those of `Session.patch_scene`: journaled, recorded, drawn
by every client. Some suites put goals elsewhere; see `_list_goals`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from itertools import islice
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.scene import MAX_OPS
from iris_session.session.errors import ConfigError
from iris_session.session.shared_scene import SharedScenes
from iris_session.session.simulation import read_attribute
from iris_session.session.stepper import Stepper

#: Distance of looks at the model; a reset is looked at when its first state is published.
PERIOD_NS: Final = 100_000_000
#: Every patch makes clients fetch the scene's description again. After so many in a row one a second is left.
BURST: Final = 10
REFILL_NS: Final = 1_000_000_000

_log = logging.getLogger(__name__)


class ModelFollower:
    """Looks at the model of a session after published states, and patches the scene where its looks have changed.

    `patch`: `Session.patch_scene`.
    """

    def __init__(self, scenes: SharedScenes, stepper: Stepper, patch: Callable[..., None]) -> None:
        self._scenes, self._stepper, self._patch = scenes, stepper, patch
        self._next_ns = 0
        self._epoch = -1
        self._left, self._counted_ns = float(BURST), 0
        self._failed: object = None  # looks that can be followed no further

    def follow_publish(self, scene_epoch: int, end_ns: int, shown_ns: int) -> None:
        """Look at the model after a state was published, for `Stepper.on_publish`."""
        if end_ns >= self._next_ns or scene_epoch != self._epoch:
            self._epoch = scene_epoch
            self._look(end_ns)

    def follow_environment(self, environment: Any, data: mujoco.MjData, *, is_reset: bool) -> None:
        """Look at the model and data of an environment after its step or reset, where goals are as it draws them."""
        now_ns = self._stepper.clock()
        if is_reset or now_ns >= self._next_ns:
            self._look(now_ns, data, environment)

    def follow_model(self, model: mujoco.MjModel) -> None:
        """Look at another model from now on, which the program has built and which is that of the present scene."""
        with self._scenes.lock:
            if self._scenes.newest is not None and self._scenes.newest.looks is not None:
                self._scenes.newest.looks.source = model

    def _look(self, now_ns: int, data: Any = None, environment: Any = None) -> None:
        self._next_ns = now_ns + PERIOD_NS
        with self._scenes.lock:
            newest = self._scenes.newest
            looks = None if newest is None else newest.looks
            # A scene that is about to be loaded is followed once it is there.
            if looks is None or looks is self._failed or looks.model is not self._stepper.core.world.model:
                return
            goals = {} if environment is None else _list_goals(environment, looks.source)
            changes = looks.find_changes(data, goals)
            if not changes or not self._take_turn(now_ns):
                return
            assert newest is not None
            assert newest.spec is not None
            operations = looks.list_operations(changes, newest.spec)
            try:
                while some := tuple(islice(operations, MAX_OPS)):
                    self._patch(*some)
            except ConfigError as error:
                if isinstance(error.__cause__, RuntimeError):  # too many wait for their step: the next look finds it
                    return
                self._failed = looks
                self._scenes.add_note(f"clients do not see further changes of colours, sizes and sites: {error}")
                _log.warning("changes of the model's looks are followed no further: %s", error)
                return
            looks.accept(changes)

    def _take_turn(self, now_ns: int) -> bool:
        """Return whether a patch may be made now: some at once, then one a second."""
        self._left = min(float(BURST), self._left + (now_ns - self._counted_ns) / REFILL_NS)
        self._counted_ns = now_ns
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


def _list_goals(environment: Any, model: mujoco.MjModel) -> dict[int, NDArray[np.float64]]:
    """Return positions [m] of goal sites that an environment puts into its model only when it renders.

    Gymnasium-Robotics' Fetch and HandReach: the sites `target0`, `target1`, ... are at `goal`.
    """
    owner = read_attribute(environment, "unwrapped")
    owner = environment if owner is None else owner
    goal = read_attribute(owner, "goal")
    if read_attribute(owner, "_render_callback") is None or not isinstance(goal, np.ndarray) or goal.size % 3:
        return {}
    if not np.issubdtype(goal.dtype, np.number):
        return {}
    found = {}
    for k, p_world in enumerate(goal.reshape(-1, 3)):
        site = mujoco.mj_name2id(model, int(mujoco.mjtObj.mjOBJ_SITE), f"target{k}")
        if site >= 0 and np.isfinite(p_world).all():
            found[site] = np.array(p_world, np.float64)
    return found
