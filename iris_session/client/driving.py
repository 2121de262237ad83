"""`ClientDriving`: samples of a client, whether the clutch of a robot may be closed, and motions to a pose."""

from __future__ import annotations

import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Any, Final

from anchors.pose import distance
from iris_session.client.arguments import PoseLike, to_names, to_numbers, to_pose, to_python_scalar
from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.samples import SampleBuilder
from iris_session.client.errors import ClientError, InvalidMessageError, UnreachedError
from iris_session.client.scene import ClientScene
from iris_session.protocol.client_messages import ClientMessage, Sample, Samples
from iris_session.protocol.common import Pose
from iris_session.protocol.names import CommandKind, Device, HoldReason
from iris_session.protocol.server_messages import Feedback

#: Fields of `Sample` that are lists of numbers, and their lengths.
ARRAYS: Final[dict[str, int | None]] = {"q": None, "qd": None, "hand_joints": None, "twist": 6}
#: Samples of `move_to`: as often as a headset sends, and well within the 150 ms after which a robot holds.
SAMPLE_PERIOD_S: Final = 1.0 / 60.0
#: Limits that nothing but another pose, or another robot that makes way, takes away.
DEAD_ENDS: Final = frozenset({"reach", "proximity"})
#: Progress of `move_to`: so much nearer [m], [rad] than ever before.
PROGRESS_M: Final = 0.001
PROGRESS_RAD: Final = 0.01
#: What was said before `move_to` began is known by then: later stops and pauses interrupt it only.
BEGIN_NS: Final = 250_000_000
#: Of the length of a quaternion, as the session takes it.
UNIT_TOLERANCE: Final = 1e-3
_STOPPED: Final = "the session is stopped (e-stop): a director ends that with clear_estop()"
_PAUSED: Final = "the session is paused: a director goes on with control('resume')"


class ClientDriving(ABC):
    """The part of a `Client` that drives robots."""

    connection: ClientConnection
    scene: ClientScene
    _samples: SampleBuilder
    _lock: threading.RLock

    @property
    @abstractmethod
    def ready(self) -> bool: ...

    @property
    @abstractmethod
    def feedback(self) -> dict[str, Feedback]: ...

    @abstractmethod
    def send(self, message: ClientMessage) -> bool: ...

    @abstractmethod
    def lease_version(self, target: str) -> int | None: ...

    @abstractmethod
    def session_now_ns(self) -> int: ...

    @abstractmethod
    def sleep(self, seconds: float) -> None: ...

    # --- motions ------------------------------------------------------------------------------------------------------

    def move_to(
        self,
        robot: str,
        pose: PoseLike,
        *,
        gripper: float | None = None,
        timeout_s: float = 15.0,
        stall_s: float = 1.0,
        settle_s: float = 0.0,
        tolerance_m: float = 0.003,
        tolerance_rad: float = 0.03,
    ) -> None:
        """Move the end effector of a robot that we hold to a pose, and wait until it is there.

        The session moves it within its limits. After a disturbance the clutch is opened and closed again, so that the
        motion goes on. When this returns nothing is sent any more, so the robot holds.

        Args:
            robot: Name of the robot.
            pose: `T_world_tip`, `((x, y, z) [m], (w, x, y, z))`, its quaternion of length 1.
            gripper: 0 open to 1 closed; `None` leaves it as it is.
            timeout_s: Seconds to wait at most.
            stall_s: Seconds without progress after which it gives up a pose that is out of reach, or to which another
                robot is in the way.
            settle_s: Seconds to stay there, as a gripper needs to close.
            tolerance_m: Distance within which it is there [m].
            tolerance_rad: Angle within which it is there [rad].

        Raises:
            UnreachedError: It is not there within `timeout_s`, comes no nearer, or the session is stopped or paused
                when it should start; the text says how far it is away, and what prevents it.
            InvalidMessageError: A number is not finite, or the quaternion is not of length 1.
            ClientError: We do not hold the robot, or the client was made without the device `target`.
            NotConnectedError: The thread of `start` has ended.
        """
        goal = to_pose("pose", pose)
        self._check_move(robot, goal, gripper)
        begin_ns = moved_ns = self.session_now_ns()
        rejected = self._count_rejected(robot)
        there_ns: int | None = None
        away_m = away_rad = best_m = best_rad = math.inf
        while there_ns is None or self.session_now_ns() < there_ns + int(settle_s * 1e9):
            now_ns, why = self.session_now_ns(), ""
            begins = math.isinf(away_m) or now_ns < begin_ns + BEGIN_NS
            if begins and self.ready and (self.connection.mirror.estop or self.connection.mirror.paused):
                why = _STOPPED if self.connection.mirror.estop else _PAUSED
            elif there_ns is None and now_ns > moved_ns + int(stall_s * 1e9):
                why = f"it came no nearer for {stall_s:g} s"
            if why or now_ns > begin_ns + int(timeout_s * 1e9):
                reasons = [name for name, n in self._count_rejected(robot).items() if n > rejected.get(name, 0)]
                raise UnreachedError(
                    robot, timeout_s, away_m, away_rad, self.feedback.get(robot), why=why, rejected=reasons
                )
            self.send_target(robot, goal, gripper=gripper)
            self.sleep(SAMPLE_PERIOD_S)
            tip, feedback = self.scene.tip_pose(robot), self.feedback.get(robot)
            if tip is None or feedback is None or feedback.state == CommandKind.HOLD:
                there_ns, moved_ns = None, self.session_now_ns()
                continue
            away_m = distance(tip[0], goal.p)
            away_rad = 2.0 * math.acos(min(1.0, abs(sum(a * b for a, b in zip(tip[1], goal.q, strict=True)))))
            if away_m > tolerance_m or away_rad > tolerance_rad:
                there_ns = None
            elif there_ns is None:
                there_ns = self.session_now_ns()
            nearer = away_m < best_m - PROGRESS_M or away_rad < best_rad - PROGRESS_RAD
            if nearer or self.connection.mirror.paused or DEAD_ENDS.isdisjoint(feedback.limits):
                best_m, best_rad, moved_ns = min(best_m, away_m), min(best_rad, away_rad), self.session_now_ns()

    def _check_move(self, robot: str, goal: Pose, gripper: float | None) -> None:
        """Raise for what would not move a robot, however long one waits."""
        if not all(map(math.isfinite, (*goal.p, *goal.q, gripper or 0.0))):
            raise InvalidMessageError(f"pose {goal.p}, {goal.q} and gripper {gripper} must be finite numbers")
        length = math.hypot(*goal.q)
        if abs(length - 1.0) > UNIT_TOLERANCE:
            raise InvalidMessageError(f"pose: the quaternion {goal.q} has the length {length:.4g}; it must be 1")
        devices = self.connection.hello.devices
        if devices and Device.TARGET not in devices:
            raise ClientError(
                f"move_to sends samples of the device {Device.TARGET!r}, and this client was made with "
                f"{', '.join(devices)}: make it with devices={Device.TARGET!r}"
            )
        if self.ready and self.lease_version(robot) is None:
            raise ClientError(f"we do not hold the robot {robot!r}: acquire it first")

    def _count_rejected(self, robot: str) -> dict[str, int]:
        feedback = self.feedback.get(robot)
        return {} if feedback is None else feedback.rejected

    def is_armed(self, robot: str) -> bool:
        """Return whether the clutch may be closed in the next sample for a robot: it is armed, or drives already.

        A robot moves only after the session has seen the clutch open, also after every disturbance (guide,
        re-arming). With `clutch=client.is_armed(robot)` in every sample of a program, it is open until then, and closed
        from then on.

        Args:
            robot: Name of the robot.

        Returns:
            False while the session has not reported an open clutch for our lease.
        """
        feedback = self.feedback.get(robot)
        if feedback is None or self.lease_version(robot) is None:
            return False
        return feedback.state != CommandKind.HOLD or feedback.hold_reason == HoldReason.CLUTCH_OPEN

    # --- samples ------------------------------------------------------------------------------------------------------

    def send_target(self, robot: str, pose: PoseLike, *, gripper: float | None = None) -> bool:
        """Send one sample of the device `target`: the pose that the end effector is to have, with the clutch as
        `is_armed` says.

        Send at least ten a second: after 150 ms without one the robot holds.

        Args:
            robot: Name of the robot.
            pose: `T_world_tip`, `((x, y, z) [m], (w, x, y, z))`.
            gripper: 0 open to 1 closed; `None` leaves it as it is.

        Returns:
            False: dropped for want of a connection, and counted.

        Raises:
            InvalidMessageError: A value does not fit the protocol, or the session has no such robot.
        """
        more = {} if gripper is None else {"gripper": gripper}
        return self.send_sample(Device.TARGET, pose, robots=robot, clutch=self.is_armed(robot), **more)

    def send_sample(self, device: str, pose: PoseLike | None = None, **fields: Any) -> bool:
        """Make one sample of a device with `make_sample`, and send it.

        Args:
            device: Name of the device, one of `devices`.
            pose: `T_tracking_device`, `((x, y, z) [m], (w, x, y, z))`.
            fields: As in `make_sample`.

        Returns:
            False: dropped for want of a connection, and counted.

        Raises:
            InvalidMessageError: A value does not fit the protocol; the text names the field.
        """
        return self.send(self.make_sample(device, pose, **fields))

    def send_samples(self, samples: Iterable[Sample]) -> bool:
        """Send samples of several devices as one message.

        For devices that are sampled together: one packet instead of three, and a third of the work on both sides.

        Args:
            samples: At most 8, from `make_sample`.

        Returns:
            False: dropped for want of a connection, and counted.

        Raises:
            InvalidMessageError: A value does not fit the protocol.
        """
        return self.send(Samples(tuple(samples)))

    def make_sample(
        self,
        device: str,
        pose: PoseLike | None = None,
        *,
        robots: str | Iterable[str] = (),
        objects: str | Iterable[str] = (),
        kind: str | None = None,
        capture_ns: int | None = None,
        tracking_epoch: int | None = None,
        **fields: Any,
    ) -> Sample:
        """Make a sample of a device as of now; epochs, versions, fencing tokens and `seq` are filled in.

        Args:
            device: Name of the device, one of `devices`.
            pose: `T_tracking_device`, `((x, y, z) [m], (w, x, y, z))`.
            robots: Robots that it drives, one name or several. Those that are not ours are left out (counter
                `samples_without_lease`), so the sample is mere presence when none is.
            objects: Objects that it moves, in the same way.
            kind: A `SampleKind`; by default `joints` with `q`, `twist` with `twist`, else `pose`.
            capture_ns: Session time of capture [ns], default now.
            tracking_epoch: Epoch of the tracking frame, default the present one.
            fields: Other fields of `Sample` (`clutch`, `gripper`, `q` [rad or m], `twist`, ...); arrays are fine.

        Returns:
            The sample.

        Raises:
            InvalidMessageError: A value does not fit the protocol, or the session has no such robot or object.
        """
        for name, length in ARRAYS.items():
            if fields.get(name) is not None:
                fields[name] = to_numbers(name, fields[name], length)
        fields = {name: to_python_scalar(value) for name, value in fields.items()}
        own_pose = None if pose is None else to_pose("pose", pose)
        robots, objects = to_names("robots", robots), to_names("objects", objects)
        with self._lock:
            return self._samples.make_sample(
                device,
                own_pose,
                capture_ns=self.session_now_ns() if capture_ns is None else capture_ns,
                robots=robots,
                objects=objects,
                kind=kind,
                tracking_epoch=tracking_epoch,
                **fields,
            )
