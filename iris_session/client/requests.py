"""The requests of a client, one method each. Each waits for the answer; a denial raises `DeniedError`."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, Self

import msgspec

from iris_session.client.arguments import Numbers, PoseLike, to_names, to_numbers, to_pose, to_text
from iris_session.client.core.connection import ClientConnection
from iris_session.client.errors import DeniedError, InvalidMessageError, NotConnectedError, RequestTimeoutError
from iris_session.protocol.client_messages import (
    Acquire,
    Align,
    Assign,
    ClearEStop,
    ClientMessage,
    Consent,
    Control,
    Episode,
    EStop,
    Grasp,
    Marker,
    MoveAnchor,
    Observation,
    PlaceAlignment,
    Release,
    SetMode,
    SetScale,
    TrackingEpoch,
)
from iris_session.protocol.common import Denial, Lease, Target
from iris_session.protocol.names import AnchorKind, TargetKind
from iris_session.protocol.server_messages import Reply


class Requests:
    """Mixin of `Client`: everything a participant can ask for."""

    connection: ClientConnection
    _lock: threading.RLock

    @abstractmethod
    def wait_for(self, condition: Callable[[Self], bool], timeout_s: float = 5.0) -> bool: ...

    @abstractmethod
    def _send_soon(self) -> None: ...

    @abstractmethod
    def _check_thread(self) -> None: ...

    @abstractmethod
    def send(self, message: ClientMessage) -> bool: ...

    @abstractmethod
    def session_now_ns(self) -> int: ...

    @abstractmethod
    def lease_version(self, target: str) -> int | None: ...

    def submit(self, message: Any) -> int:
        """Sends a message that has a `request_id` (which is filled in) without waiting; `answer` has the reply."""
        with self._lock:
            self._check_thread()
            request_id = self.connection.request(message)
            self._send_soon()
            return request_id

    def answer(self, request_id: int) -> Reply | None:
        """The reply to a submitted request, once; `None` while there is none. Look at its `denial`."""
        with self._lock:
            return self.connection.requests.pop_reply(request_id)

    def request(self, message: Any, timeout_s: float = 5.0) -> Reply:
        """Sends a message that has a `request_id` (which is filled in) and waits for its answer.

        Raises `DeniedError`, `RequestTimeoutError`, `InvalidMessageError` when the protocol does not take it, or
        `NotConnectedError` when the connection is lost meanwhile.
        """
        with self._lock:
            generation = self.connection.generation
            fault_before = self.connection.last_protocol_fault
            request_id = self.submit(message)
        replies: list[Reply] = []

        def answered(client: Requests) -> bool:
            reply = client.answer(request_id)
            if reply is not None:
                replies.append(reply)
            lost = client.connection.generation != generation or not client.connection.is_joined
            return reply is not None or client.connection.last_protocol_fault is not fault_before or lost

        self.wait_for(answered, timeout_s)
        with self._lock:
            self.connection.requests.discard(request_id)
        kind = type(message).__name__
        if not replies:
            if self.connection.generation != generation or not self.connection.is_joined:
                raise NotConnectedError(f"connection lost while waiting for the answer to {kind}")
            if self.connection.last_protocol_fault is not fault_before and self.connection.last_protocol_fault is not None:
                raise InvalidMessageError(f"{kind} was not taken: {self.connection.last_protocol_fault.message}")
            raise RequestTimeoutError(f"no answer to {kind} within {timeout_s:g} s")
        if replies[0].denial is not None:
            raise DeniedError(self._with_name(replies[0].denial))
        return replies[0]

    def _with_name(self, denial: Denial) -> Denial:
        holder = self.connection.mirror.participants.get(denial.holder)
        if holder is None or denial.holder_name:
            return denial
        return msgspec.structs.replace(denial, holder_name=holder.name)

    def acquire(
        self,
        robots: str | Iterable[str] = (),
        *,
        objects: str | Iterable[str] = (),
        wait: bool = False,
        weight: float = 1.0,
        timeout_s: float = 5.0,
    ) -> tuple[Lease, ...]:
        """Takes leases, all or none; without names the assignment policy chooses one robot.

        `wait`: queue when somebody holds them. The answer then comes with the lease, as it does after a holder's
        consent in mode `request`: `RequestTimeoutError` after `timeout_s` leaves us in the queue, `release()` leaves
        it. `weight`: share in mode `shared`.
        """
        return self.request(
            Acquire(0, to_names("robots", robots), to_names("objects", objects), wait, weight), timeout_s
        ).leases

    def release(self, *names: str) -> None:
        """Gives robots and objects back; without names all, and leaves every queue. Denied for what is not ours."""
        names = to_names("release", names)
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

    def assign(self, robots: str | Iterable[str], participant: str = "") -> tuple[Lease, ...]:
        """Director: gives robots to a participant, or frees them."""
        return self.request(Assign(0, to_names("robots", robots), participant)).leases

    def set_mode(self, robot: str, mode: str) -> None:
        """Director: changes the lease mode of a robot."""
        self.request(SetMode(0, robot, mode))

    def set_scale(self, robots: str | Iterable[str] = (), scale: float = 1.0) -> tuple[Lease, ...]:
        """How far robots that we hold move as our hand moves: 1 as far, 0.1 a tenth. Without names, all that we hold.

        A director may set it for whoever holds them. Back to 1 with the next holder. Raises `DeniedError`: not ours, or
        out of range.
        """
        return self.request(SetScale(0, to_names("robots", robots), scale)).leases

    def place_alignment(self, participant: str, T_world_tracking: PoseLike, *, offset: bool = False) -> None:
        """Director: aligns a participant by hand, or adds an offset to the measured alignment."""
        self.request(PlaceAlignment(0, participant, to_pose("T_world_tracking", T_world_tracking), offset))

    def align(self, action: str, participant: str = "") -> None:
        """`start`: measures the alignment anew, from nothing; `stop`: keeps what is in force, whatever is seen.

        Our own; a director may do so for every `participant`. What is in force stays until there is a better one.
        """
        self.request(Align(0, action, participant))

    def move_anchor(self, anchor_id: str, T_world_anchor: PoseLike, *, force: bool = False) -> None:
        """Director: says where an anchor of the session is; the scene moves for everyone who is aligned to it.

        `force`: also further than 5 m from where it was. Raises `DeniedError` (`too_far`) without it.
        """
        self.request(MoveAnchor(0, anchor_id, to_pose("T_world_anchor", T_world_anchor), force))

    def estop(self, reason: object = "") -> bool:
        """Stops everything, at once and latched. Does not wait for an answer. Not a safety-rated stop.

        It is sent again after every reconnect, until the session says that it is stopped or `clear_estop` is called.
        False: there is no connection now, it leaves with the next one. `reason`: anything; its text is cut to what the
        protocol takes. Raises only `NotConnectedError`: this client was never opened, was closed, refused, or its
        thread has ended (it is sent nevertheless while the socket stands).
        """
        return self.send(EStop(to_text(reason)))

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
        if self.connection.is_joined:  # else the next welcome is answered with it
            self.send(TrackingEpoch(epoch))
        return epoch

    def observe(
        self,
        anchor_id: str,
        T_tracking_anchor: PoseLike,
        *,
        kind: str = AnchorKind.QR,
        capture_ns: int | None = None,
        viewpoint_id: int = 0,
        size_m: float = 0.0,
        quality: float = 1.0,
        device: str = "head",
        covariance: Numbers = (),
        tracking_epoch: int | None = None,
    ) -> None:
        """Reports that a device saw an anchor, in the tracking frame.

        `viewpoint_id`: the same for what was seen from one place. `covariance`: 36 values, 6x6 row-major, (x, y, z [m],
        rx, ry, rz [rad]), tracking axes; without it the session assumes that of a headset's camera. `tracking_epoch`:
        of the tracking frame that it was seen in, by default the present one.
        """
        stated = to_numbers("covariance", covariance)
        if len(stated) not in (0, 36):
            raise InvalidMessageError(f"covariance: expected 36 numbers, 6x6 row-major, or none, got {len(stated)}")
        self.send(
            Observation(
                anchor_id=anchor_id,
                kind=kind,
                T_tracking_anchor=to_pose("T_tracking_anchor", T_tracking_anchor),
                capture_ns=self.session_now_ns() if capture_ns is None else capture_ns,
                tracking_epoch=self.connection.tracking_epoch if tracking_epoch is None else tracking_epoch,
                viewpoint_id=viewpoint_id,
                size_m=size_m,
                quality=quality,
                device=device,
                covariance=stated,
            )
        )
