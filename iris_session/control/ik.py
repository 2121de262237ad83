"""One differential inverse-kinematics step of one arm: mink's frame and posture tasks, joint bounds, daqp.

The quadratic program is min |J dq - e|^2 + posture + damping over box bounds on `dq`. For hinge and slide joints mink's
`ConfigurationLimit` and `VelocityLimit` are exactly such boxes, but stated as 4 n general inequalities that become
infeasible when a joint stands outside its range; given as simple bounds the program always has a solution and costs
half. Stateless: the result depends on the arguments alone, no warm start.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from anchors.pose import PoseTuple
from iris_session.control.arm_model import ArmModel, Floats
from iris_session.control.config import ControlConfig


class IkStep(NamedTuple):
    """`q`: new joint positions, shape (n,). `singular`: the Jacobian was near singular where it was evaluated."""

    q: Floats
    singular: bool


def require_solver() -> tuple[Any, Any]:
    """The mink and daqp modules. Raises `ImportError` that names the extra."""
    try:
        import daqp
        import mink
    except ImportError as error:
        raise ImportError(
            f"inverse kinematics needs mink and daqp ({error.name} is missing): pip install 'iris-session[control]'"
        ) from None
    return mink, daqp


class IkSolver:
    """Inverse kinematics of one arm. `rest`: posture that the null space drifts to, shape (n,)."""

    def __init__(self, arm: ArmModel, config: ControlConfig) -> None:
        self._mink, self._daqp = require_solver()
        mink = self._mink
        self._arm = arm
        self._configuration = mink.Configuration(arm.model)
        self._frame = mink.FrameTask(
            "tip", "site", config.position_cost, config.orientation_cost, lm_damping=config.lm_damping
        )
        self._posture = mink.PostureTask(arm.model, cost=config.posture_cost, gain=config.posture_gain)
        n = arm.model.nv
        self._no_rows = np.zeros((0, n))
        self._sense = np.zeros(n, dtype=np.int32)
        self._rank = min(n, 6)
        self._singular = config.singular_value**2

    def step(self, q: Floats, rest: Floats, T_root_target: PoseTuple, lower: Floats, upper: Floats) -> IkStep:
        """One step from `q` towards the target, with `lower <= dq <= upper` per joint (arrays of shape (n,))."""
        arm = self._arm
        (x, y, z), quat = T_root_target
        self._configuration.update(q[arm.to_chain])
        self._frame.set_target(self._mink.SE3(np.array((*quat, x, y, z))))
        self._posture.set_target(rest[arm.to_chain])
        H, c = self._frame.compute_qp_objective(self._configuration)
        singular = bool(np.linalg.eigvalsh(H)[-self._rank] < self._singular)
        H_posture, c_posture = self._posture.compute_qp_objective(self._configuration)
        dq, _, flag, _ = self._daqp.solve(
            H + H_posture, c + c_posture, self._no_rows, upper[arm.to_chain], lower[arm.to_chain], self._sense
        )
        if flag != 1 or not math.isfinite(float(dq.sum())):
            return IkStep(q.copy(), True)
        return IkStep(q + dq[arm.from_chain], singular)
