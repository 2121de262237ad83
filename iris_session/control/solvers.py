"""One step of inverse kinematics of one arm: two solvers of the same program.

The program is min |W (J dq - e)|^2 + posture + damping with lower <= dq <= upper. It has one solution, so where a robot
goes does not depend on the solver, but the last bits do: a recording says which one it was made with
(`ControlConfig.solver`). `NumpySolver` needs nothing but MuJoCo and numpy. `MinkSolver` is mink's frame and posture
tasks and daqp, and is used where both are installed.

For hinge and slide joints mink's `ConfigurationLimit` and `VelocityLimit` are exactly such boxes, but stated as 4 n
general inequalities that become infeasible when a joint stands outside its range; given as simple bounds the program
always has a solution and costs half. Both are stateless: the result depends on the arguments alone, no warm start.
"""

from __future__ import annotations

import importlib.metadata
import math
import re
from typing import Any, Final, NamedTuple, Protocol

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from anchors.pose import PoseTuple
from iris_session.control.arm_model import ArmModel, Floats
from iris_session.control.config import OUTPUT_CTRL, SOLVER_AUTO, SOLVER_MINK, SOLVER_NUMPY, ControlConfig

#: A multiplier of a bound counts as negative below this share of the gradient: rounding of sums is far smaller.
_MULTIPLIER_TOLERANCE: Final = 1e-11


class IkStep(NamedTuple):
    """`q`: new joint positions, shape (n,). `singular`: the Jacobian was near singular where it was evaluated."""

    q: Floats
    singular: bool


class IkSolver(Protocol):
    """Inverse kinematics of one arm."""

    def step(self, q: Floats, rest: Floats, T_root_target: PoseTuple, lower: Floats, upper: Floats) -> IkStep:
        """Take one step from `q` towards the target, with `lower <= dq <= upper` per joint (arrays of shape (n,)).

        `rest`: posture that the null space drifts to, shape (n,).
        """
        ...


def name_solver(config: ControlConfig) -> ControlConfig:
    """Return the configuration with the solver that `auto` means here: mink's where mink and daqp can be imported.

    Without inverse kinematics it stays as it is, and mink is not imported.
    """
    if config.solver != SOLVER_AUTO or config.output != OUTPUT_CTRL:
        return config
    try:
        _import_mink()
    except ImportError:
        return msgspec.structs.replace(config, solver=SOLVER_NUMPY)
    return msgspec.structs.replace(config, solver=SOLVER_MINK)


def make_solver(arm: ArmModel, config: ControlConfig) -> IkSolver:
    """Return the solver that the configuration names. Raises `ImportError` for mink's where that is not installed."""
    solver = MinkSolver if name_solver(config).solver == SOLVER_MINK else NumpySolver
    return solver(arm, config)


def _weigh_orientation(n: int, config: ControlConfig) -> tuple[float, int]:
    """Return the orientation cost of an arm with `n` joints, and the rank below which it is near singular.

    An arm with fewer than six joints does not give up its position for a turn that it cannot make.
    """
    if n < 6 and config.few_joints_orientation_cost is not None:
        return config.few_joints_orientation_cost, min(n, 3)
    return config.orientation_cost, min(n, 6)


class NumpySolver:
    """Inverse kinematics of one arm with numpy alone. See `IkSolver`."""

    def __init__(self, arm: ArmModel, config: ControlConfig) -> None:
        n = arm.model.nv
        self._arm = arm
        orientation_cost, self._rank = _weigh_orientation(n, config)
        self._weights = np.repeat((config.position_cost, orientation_cost), 3)
        self._lm_damping = config.lm_damping
        self._posture, self._posture_gain = config.posture_cost**2, config.posture_gain
        self._singular = config.singular_value**2
        self._J = np.zeros((6, n))
        self._diagonal = np.arange(n)

    def step(self, q: Floats, rest: Floats, T_root_target: PoseTuple, lower: Floats, upper: Floats) -> IkStep:
        """Take one step, see `IkSolver.step`."""
        arm, J = self._arm, self._J
        error = self._weights * self._measure_error(q, T_root_target)
        mujoco.mj_comPos(arm.model, arm.data)
        mujoco.mj_jacSite(arm.model, arm.data, J[:3], J[3:], 0)
        WJ = self._weights[:, None] * J
        H = WJ.T @ WJ
        H[self._diagonal, self._diagonal] += self._lm_damping * float(error @ error)
        singular = bool(np.linalg.eigvalsh(H)[-self._rank] < self._singular)
        H[self._diagonal, self._diagonal] += self._posture
        c = self._posture * self._posture_gain * (q - rest)[arm.to_chain] - error @ WJ
        dq = minimize_in_box(H, c, lower[arm.to_chain], upper[arm.to_chain])
        if dq is None:
            return IkStep(q.copy(), True)
        return IkStep(q + dq[arm.from_chain], singular)

    def _measure_error(self, q: Floats, T_root_target: PoseTuple) -> Floats:
        """Return the way from the tip at `q` to the target, shape (6,): translation [m], rotation vector [rad]."""
        (x, y, z), quat = self._arm.forward_kinematics(q)
        p_target, quat_target = T_root_target
        error = np.empty(6)
        error[:3] = p_target[0] - x, p_target[1] - y, p_target[2] - z
        mujoco.mju_subQuat(error[3:], np.array(quat_target), np.array(quat))  # in the frame of the tip
        mujoco.mju_rotVecQuat(error[3:], error[3:].copy(), np.array(quat))
        return error


def minimize_in_box(H: Floats, c: Floats, lower: Floats, upper: Floats) -> Floats | None:
    """Return the x that minimizes 1/2 x' H x + c' x with lower <= x <= upper, None if there is none.

    An active-set method: it begins with the solution without bounds, clipped, and never leaves the box, so that the
    result is a good step even if it is not the end, which a degenerate program might not reach in the bounded number of
    passes. Deterministic.

    Args:
        H: Symmetric positive definite matrix, shape (n, n).
        c: Shape (n,).
        lower: Shape (n,).
        upper: Shape (n,).
    """
    n = len(c)
    if not (lower <= upper).all():
        return None
    try:
        free = np.linalg.solve(H, -c)
        if not math.isfinite(float(free.sum())):
            return None
        x: Floats = np.minimum(np.maximum(free, lower), upper)
        bound = x != free
        tolerance = _MULTIPLIER_TOLERANCE * float(np.abs(c).max(initial=0.0))
        for _ in range(4 * n):
            if not bound.any():
                return x
            blocked = _descend(H, c, lower, upper, x, bound)
            if blocked:
                continue
            gradient = H @ x + c
            # Positive: the bound holds the joint back from where the sum becomes smaller.
            pull = np.where(x == lower, gradient, -gradient)
            pull[~bound | (lower == upper)] = math.inf
            if float(pull.min()) >= -tolerance:
                break
            bound[int(pull.argmin())] = False
    except np.linalg.LinAlgError:
        return None
    return x


def _descend(H: Floats, c: Floats, lower: Floats, upper: Floats, x: Floats, bound: NDArray[np.bool_]) -> bool:
    """Move the elements of `x` that are not `bound` to their minimum, up to the first bound on the way.

    Changes `x` and `bound`. Returns true when a bound was met.
    """
    free = ~bound
    if not free.any():
        return False
    H_free = H[free]
    way = np.zeros(len(x))
    way[free] = np.linalg.solve(H_free[:, free], -(c[free] + H_free @ x))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(way > 0.0, (upper - x) / way, np.where(way < 0.0, (lower - x) / way, math.inf))
    first = int(share.argmin())
    if share[first] >= 1.0:
        x += way
        return False
    x += share[first] * way
    np.clip(x, lower, upper, out=x)
    x[first] = upper[first] if way[first] > 0.0 else lower[first]
    bound[first] = True
    return True


class MinkSolver:
    """Inverse kinematics of one arm with mink and daqp. See `IkSolver`."""

    def __init__(self, arm: ArmModel, config: ControlConfig) -> None:
        mink, self._daqp = _import_mink()
        self._mink = mink
        self._arm = arm
        self._configuration = mink.Configuration(arm.model)
        n = arm.model.nv
        orientation_cost, self._rank = _weigh_orientation(n, config)
        self._frame = mink.FrameTask(
            "tip", "site", config.position_cost, orientation_cost, lm_damping=config.lm_damping
        )
        self._posture = mink.PostureTask(arm.model, cost=config.posture_cost, gain=config.posture_gain)
        self._no_rows = np.zeros((0, n))
        self._sense = np.zeros(n, dtype=np.int32)
        self._singular = config.singular_value**2

    def step(self, q: Floats, rest: Floats, T_root_target: PoseTuple, lower: Floats, upper: Floats) -> IkStep:
        """Take one step, see `IkSolver.step`."""
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


def _import_mink() -> tuple[Any, Any]:
    """Return the mink and daqp modules."""
    advice = "solver 'mink' needs mink >= 1.1, daqp and mujoco >= 3.10: pip install 'iris-session[mink]'"
    try:
        import daqp
        import mink

        version = importlib.metadata.version("mink")
        release = tuple(map(int, re.findall(r"\d+", version)[:2]))  # (1, 1) of "1.1rc1"
    except Exception as error:  # also mink's own, with an older MuJoCo, and libraries built for another numpy
        raise ImportError(f"{advice} ({' '.join(str(error).split())})") from None
    if release < (1, 1):  # robosuite pins 0.0.5
        raise ImportError(f"{advice} (mink {version} is installed)")
    return mink, daqp
