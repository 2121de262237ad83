"""The requests of a client, one method each. Each waits for the answer; a denial raises `DeniedError`."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

from anchors.pose import PoseTuple
from iris_session.client.connection import Connection
from iris_session.protocol.client_messages import (
    Acquire,
    Assign,
    ClearEStop,
    ClientMessage,
    Consent,
    Control,
    Episode,
    EStop,
    Grasp,
    Marker,
    Observation,
    PlaceAlignment,
    Release,
    SetMode,
    SetScale,
    TrackingEpoch,
)
from iris_session.protocol.common import Lease, Pose, Target
from iris_session.protocol.names import AnchorKind, TargetKind
from iris_session.protocol.server_messages import Reply


class Requests:
    """Mixin of `Client`: everything a participant can ask for."""

    connection: Connection

    @abstractmethod
    def request(self, message: Any, timeout_s: float = 5.0) -> Reply: ...

    @abstractmethod
    def send(self, message: ClientMessage) -> bool: ...

    @abstractmethod
    def session_now_ns(self) -> int: ...

    @abstractmethod
    def lease_version(self, target: str) -> int | None: ...

    def acquire(
        self,
        robots: Sequence[str] = (),
        *,
        objects: Sequence[str] = (),
        wait: bool = False,
        weight: float = 1.0,
        timeout_s: float = 5.0,
    ) -> tuple[Lease, ...]:
        """Takes leases, all or none; without names the assignment policy chooses one robot.

        `wait`: queue when somebody holds them. The answer then comes with the lease, as it does after a holder's
        consent in mode `request`: `RequestTimeoutError` after `timeout_s` leaves us in the queue, `release()` leaves
        it. `weight`: share in mode `shared`.
        """
        return self.request(Acquire(0, tuple(robots), tuple(objects), wait, weight), timeout_s).leases

    def release(self, *names: str) -> None:
        """Gives robots and objects back; without names all, and leaves every queue. Denied for what is not ours."""
        leases = self.connection.mirror.leases
        kinds = [leases[name].kind if name in leases else TargetKind.ROBOT for name in names]
        tokens = [self.lease_version(name) or 0 for name in names]
        self.request(Release(0, tuple(map(Target, names, tokens, kinds))))

    def grasp(self, name: str, device: str) -> tuple[Lease, ...]:
        """Takes a free object with a hand that has no robot."""
        return self.request(Grasp(0, name, device)).leases

    def consent(self, consent_id: int, grant: bool) -> None:
        """Answers a `ConsentRequested` event."""
        self.request(Consent(0, consent_id, grant))

    def assign(self, robots: Sequence[str], participant: str = "") -> tuple[Lease, ...]:
        """Director: gives robots to a participant, or frees them."""
        return self.request(Assign(0, tuple(robots), participant)).leases

    def set_mode(self, robot: str, mode: str) -> None:
        """Director: changes the lease mode of a robot."""
        self.request(SetMode(0, robot, mode))

    def set_scale(self, robots: Sequence[str] = (), scale: float = 1.0) -> tuple[Lease, ...]:
        """How far robots that we hold move as our hand moves: 1 as far, 0.1 a tenth. Without names, all that we hold.

        A director may set it for whoever holds them. Back to 1 with the next holder. Raises `DeniedError`: not ours, or
        out of range.
        """
        return self.request(SetScale(0, tuple(robots), scale)).leases

    def place_alignment(self, participant: str, T_world_tracking: PoseTuple, *, offset: bool = False) -> None:
        """Director: aligns a participant by hand, or adds an offset to the measured alignment."""
        self.request(PlaceAlignment(0, participant, Pose(*T_world_tracking), offset))

    def estop(self, reason: str = "") -> None:
        """Stops everything, at once and latched. Does not wait for an answer. Not a safety-rated stop."""
        self.send(EStop(reason))

    def clear_estop(self) -> None:
        """Ends the e-stop; robots hold until clutched again."""
        self.request(ClearEStop(0))

    def control(self, action: str, ticks: int = 1) -> None:
        """Director: `pause`, `resume`, `step` (by `ticks`) or `reset`."""
        self.request(Control(0, action, ticks))

    def episode(self, action: str, label: str = "") -> None:
        """`start`, `success`, `failure`, `discard`, `rerecord` or `reset`."""
        self.request(Episode(0, action, label))

    def marker(self, text: str) -> None:
        """Puts a note into the recording."""
        self.request(Marker(0, text))

    def new_tracking_frame(self) -> int:
        """The tracking frame jumped: our alignment is void. Returns the new tracking epoch."""
        epoch = self.connection.tracking_epoch = self.connection.tracking_epoch + 1
        if self.connection.joined:  # else the next welcome is answered with it
            self.send(TrackingEpoch(epoch))
        return epoch

    def observe(
        self,
        anchor_id: str,
        T_tracking_anchor: PoseTuple,
        *,
        kind: str = AnchorKind.QR,
        capture_ns: int | None = None,
        viewpoint_id: int = 0,
        size_m: float = 0.0,
        quality: float = 1.0,
        device: str = "head",
    ) -> None:
        """Reports that a device saw an anchor, in the tracking frame."""
        self.send(
            Observation(
                anchor_id=anchor_id,
                kind=kind,
                T_tracking_anchor=Pose(*T_tracking_anchor),
                capture_ns=self.session_now_ns() if capture_ns is None else capture_ns,
                tracking_epoch=self.connection.tracking_epoch,
                viewpoint_id=viewpoint_id,
                size_m=size_m,
                quality=quality,
                device=device,
            )
        )
