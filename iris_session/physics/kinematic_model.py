"""A kinematic model: a compiled model of bodies that are moved externally, so that their poses can be a plant's state.

A world that is not MuJoCo's is streamed, journaled and verified through it. It has one mocap body per moving body, and
neither shapes nor dynamics: to show a state takes some tens of microseconds for hundreds of bodies.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.physics.errors import ModelInvalidError, one_line
from iris_session.physics.world import STATE
from iris_session.protocol.common import Pose

#: A tick is a millisecond of the world's own time.
TICK_S: Final = 0.001


class KinematicModel:
    """Bodies with the ids 1..n, in the order of `names`. `model`: the model of a `World` of them.

    `poses`: T_world_body of each at the beginning. Raises `ModelInvalidError` for names that repeat, or that MuJoCo
    reserves (`world`).
    """

    def __init__(self, names: Sequence[str], poses: Sequence[Pose]) -> None:
        spec = mujoco.MjSpec()
        spec.modelname = "carrier"
        spec.option.timestep = TICK_S
        try:
            for name, pose in zip(names, poses, strict=True):
                spec.worldbody.add_body(name=name, pos=pose.p, quat=pose.q, mocap=True)
            self.model: mujoco.MjModel = spec.compile()
        except ValueError as error:
            raise ModelInvalidError(f"these bodies cannot be published: {one_line(error)}") from error
        self._data: Any = mujoco.MjData(self.model)
        self._state: NDArray[np.float64] = np.empty(mujoco.mj_stateSize(self.model, STATE))

    def encode_state(self, time_s: float, poses: NDArray[np.float64]) -> bytes:
        """Return the plant's state (`mjSTATE_INTEGRATION`) at that time, with T_world_body (n, 7), `x y z qw qx qy
        qz`.
        """
        data = self._data
        data.time = time_s
        data.mocap_pos[:] = poses[:, :3]
        data.mocap_quat[:] = poses[:, 3:]
        mujoco.mj_getState(self.model, data, self._state, STATE)
        return self._state.tobytes()
