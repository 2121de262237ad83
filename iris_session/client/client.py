"""The client: `ClientConnection` with sockets and a clock.

It has no thread of its own: `poll` drives everything, and every waiting call polls. `start` makes a thread: from then
on only that thread touches the sockets, and callbacks run in it.
"""

from __future__ import annotations

import dataclasses
import os
import secrets
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final, Self

import msgspec
import zmq
from numpy.typing import NDArray

from anchors.pose import PoseTuple
from iris_session.client.arguments import Numbers, PoseLike, to_names, to_numbers, to_pose, to_python_scalar, to_text
from iris_session.client.assets import ClientAssets
from iris_session.client.core.arrival_meter import ArrivalMeter
from iris_session.client.core.connection import ClientConnection, InboxMessage
from iris_session.client.core.outbox import encode_checked
from iris_session.client.core.samples import SampleBuilder
from iris_session.client.core.state_stream import SceneState
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.endpoint_resolver import SessionJoiner, parse_connect_request
from iris_session.client.errors import (
    ClientError,
    DeniedError,
    InvalidMessageError,
    NotConnectedError,
    RequestTimeoutError,
)
from iris_session.client.identity import Identity
from iris_session.client.media import ClientMedia
from iris_session.client.scene import ClientScene
from iris_session.client.sheet_observer import CAMERA_SIGMA, SheetObserver, to_observation
from iris_session.client.sockets import ClientSockets, CurveKeys, to_milliseconds
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
    Hello,
    Marker,
    MoveAnchor,
    Observation,
    PlaceAlignment,
    Release,
    Sample,
    Samples,
    SetMode,
    SetScale,
    TrackingEpoch,
)
from iris_session.protocol.common import Alignment, Denial, Lease, Target
from iris_session.protocol.names import AlignmentKind, AnchorKind, Role, TargetKind
from iris_session.protocol.server_messages import Event, Feedback, Reply
from iris_session.protocol.session_mirror import MissedEvents, SessionMirror
from iris_session.protocol.status import StatusReport

if TYPE_CHECKING:
    from anchors.camera import CameraModel
    from anchors.detection import SheetDetection
    from anchors.sheet import Sheet

DEFAULT_TIMEOUT_S: Final = 5.0
#: A status request without an answer is repeated; twice a second is below the limit of its type.
STATUS_RETRY_S: Final = 0.5
#: Roles that have no headset, so nothing to align.
UNALIGNED_ROLES: Final = frozenset({Role.AGENT, Role.LEADER, Role.GATEWAY, Role.RECORDER, Role.CAMERA, Role.SOURCE})
#: Fields of `Sample` that are lists of numbers, and their lengths.
ARRAYS: Final[dict[str, int | None]] = {"q": None, "qd": None, "hand_joints": None, "twist": 6}


class Client:
    """A participant of a session.

        with Client("127.0.0.1:7721", role="agent", name="policy", devices=("target",)) as client:
            client.acquire(["left"])
            client.wait_for(lambda c: c.scene.tip_pose("left") is not None)
            target = client.scene.tip_pose("left")  # T_world_tip: move it
            for i in range(90):  # the clutch must be seen open once; after 150 ms without a sample the robot holds
                client.send_sample("target", target, robots=["left"], clutch=i > 0)
                client.sleep(1 / 60)

    Attributes:
        scene: The scene as it is now: newest state, poses by name, presence.
        media: Media streams: subscribe, publish.
        assets: Assets: fetch, cancel, cache.
        connection: The connection without I/O: phase, counters, clock.
        feedback: Newest `Feedback` by robot.
        on_state: Called with every `SceneState`; callbacks run in `poll`, or in the thread of `start`.
        on_event: Called with every `Event`.
        on_missed: Called with the first and last number of events that this client missed between two events, because
            its link was blocked for a while or was another one; their effects are known.
        on_feedback: Called with every `Feedback`.
        on_denial: Called with the `Denial` of a message that expects no reply.
    """

    def __init__(
        self,
        address: str = "",
        *,
        session: str = "",
        role: str = Role.OPERATOR,
        name: str = "",
        devices: str | Sequence[str] = (),
        capabilities: Sequence[str] = (),
        alignment: str | None = None,
        identity: Identity | str | os.PathLike[str] | None = None,
        curve: CurveKeys | None = None,
        join_code: str = "",
        software: str = "iris-session",
        on_state: Callable[[SceneState], None] | None = None,
        on_event: Callable[[Event], None] | None = None,
        on_missed: Callable[[int, int], None] | None = None,
        on_feedback: Callable[[Feedback], None] | None = None,
        on_denial: Callable[[Denial], None] | None = None,
    ) -> None:
        """Make a client; `connect`, `open` or a `with` block joins the session.

        Args:
            address: `HOST:PORT` of the control channel, or the `iris://` URI of a pairing code. Without address and
                `session`: the session on this machine.
            session: Name of a session to find on the network instead.
            role: A `Role`.
            name: Name that other participants see, by default the role.
            devices: Tracked sources of input that samples will name.
            capabilities: Further capabilities for `Hello`.
            alignment: `measured` or `not_needed`, by default by role.
            identity: An `Identity`, a file that keeps one across restarts, or `None` for this process only.
            curve: Keys of your own instead of those in the home of keys.
            join_code: From `iris-session pair`, for the first time at an encrypted session.
            software: Name of the program, for status.
            on_state: See the attributes of the class, as for the other callbacks.
            on_event: Callback.
            on_missed: Callback.
            on_feedback: Callback.
            on_denial: Callback.

        Raises:
            ClientError: An argument cannot be used; a subclass says why.
        """
        request = parse_connect_request(address, session, curve, join_code)
        if alignment is None:
            alignment = AlignmentKind.NOT_NEEDED if role in UNALIGNED_ROLES else AlignmentKind.MEASURED
        if identity is None:
            identity = Identity.in_memory()
        elif not isinstance(identity, Identity):
            identity = Identity.from_file(os.fspath(identity))
        hello = Hello(
            role=role,
            name=name or role,
            software=software,
            devices=to_names("devices", devices),
            # The session keeps our alignment over a lost connection only while this `run` lasts.
            capabilities=(*capabilities, f"run:{secrets.token_hex(8)}"),
            alignment=alignment,
        )
        encode_checked(hello)
        self.connection = ClientConnection(hello, identity)
        self.on_state = on_state
        self.on_event = on_event
        self.on_missed = on_missed
        self.on_feedback = on_feedback
        self.on_denial = on_denial
        self.feedback: dict[str, Feedback] = {}
        self._samples = SampleBuilder(self.connection)
        self._arrivals = ArrivalMeter()
        self._generation = 0
        self._sockets = ClientSockets()
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._joiner = SessionJoiner(request, self.connection, self._sockets)
        self.scene = ClientScene(self.connection, self._lock)
        self.media = ClientMedia(self.connection, self._sockets, self._lock, lambda: self._polls_here)
        self.assets = ClientAssets(self.connection, self._sockets, self._lock)
        self._sheets = SheetObserver()
        self._thread: threading.Thread | None = None
        self._stopping = False
        self._crash: BaseException | None = None
        self._just_pumped = False

    # --- life ---------------------------------------------------------------------------------------------------------

    def connect(self, timeout_s: float = DEFAULT_TIMEOUT_S) -> Self:
        """Join the session, and wait for snapshot and clock.

        Args:
            timeout_s: Seconds to wait at most.

        Returns:
            This client.

        Raises:
            RefusedError: The session refused us; `VersionError` when it speaks other protocol versions.
            TrustError: The session's key is not the trusted one.
            NotConnectedError: No session answered within `timeout_s`.
        """
        self.open()
        if not self.wait_for(lambda client: client.ready, timeout_s):
            raise NotConnectedError(f"no session let us in at {self.describe_failure(f'within {timeout_s:g} s')}")
        return self

    def open(self) -> None:
        """Start to join without waiting; `poll` continues it until `ready`.

        Raises:
            NotConnectedError: The client was closed.
        """
        with self._lock:
            if self.connection.phase is ConnectionPhase.CLOSED:
                raise NotConnectedError(self.connection.describe())
            idle = self.connection.phase in (ConnectionPhase.IDLE, ConnectionPhase.REFUSED)
            if idle and not self._joiner.is_resolving:
                self._joiner.begin()
                self._joiner.step()

    def describe_failure(self, when: str) -> str:
        """Return a line for people: the address at which no session has welcomed us, and the reason if it is known.

        Args:
            when: Words for the time, as `within 5 s`.

        Returns:
            The line.
        """
        return self._joiner.describe_failure(when)

    def close(self) -> None:
        """Leave the session: leases are released at once, without grace. Stops the thread of `start`."""
        with self._lock:
            self._stopping = True
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            self._sockets.wake()
            thread.join()
        workers = None
        with self._lock:
            if self.connection.phase is not ConnectionPhase.CLOSED:
                self._joiner.cancel()
                workers = self.assets.close()
                self.connection.close()
                self._flush()
                self._sockets.close()
            self._changed.notify_all()
        if workers is not None:
            workers.close()

    def __enter__(self) -> Self:
        if self.ready:
            return self
        try:
            return self.connect()
        except BaseException:
            self.close()
            raise

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> Self:
        """Start a thread that polls until `close`. `poll` must not be called from then on.

        Returns:
            This client.
        """
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=f"iris-client-{self.name}", daemon=True)
                self._thread.start()
        return self

    # --- identity and session -----------------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Joined, with snapshot and clock. False while reconnecting, and after the thread of `start` ended."""
        return self.connection.phase is ConnectionPhase.READY and self._crash is None

    @property
    def address(self) -> str:
        """`HOST:PORT` of the session, as soon as it is known; before, its name."""
        return self._joiner.address

    @property
    def name(self) -> str:
        """Our name in the session."""
        return self.connection.hello.name

    @property
    def participant_id(self) -> str:
        """Our id in the session, empty before the first welcome."""
        return self.connection.participant_id

    @property
    def worn(self) -> bool:
        """True while the headset is worn. Set it; heartbeats and samples carry it."""
        return self.connection.worn

    @worn.setter
    def worn(self, worn: bool) -> None:
        self.connection.worn = worn

    @property
    def tracking_epoch(self) -> int:
        """Number of jumps of our tracking frame so far; `new_tracking_frame` counts one more."""
        return self.connection.tracking_epoch

    @property
    def mirror(self) -> SessionMirror:
        """The shared session state: `participants`, `leases`, `robots`, `bodies`, `paused`, `estop`, `event_seq`."""
        return self.connection.mirror

    @property
    def alignment(self) -> Alignment | None:
        """Our own `T_world_tracking` as accepted by the session, `None` before."""
        return self.connection.mirror.find_alignment(self.participant_id)

    def lease_version(self, target: str) -> int | None:
        """Return our fencing token for a robot or object.

        Args:
            target: Name of the robot or object.

        Returns:
            The token, or `None` when we do not hold it.
        """
        return self.connection.lease_version(target)

    def session_now_ns(self) -> int:
        """Return session time now [ns], by our estimate; its error is at most `clock_error_ns()`."""
        return self.connection.clock.session_ns(time.monotonic_ns())

    def clock_error_ns(self) -> int:
        """Return the bound of the error of `session_now_ns()` [ns]."""
        return self.connection.clock.error_bound_ns(time.monotonic_ns())

    def counters(self) -> dict[str, Any]:
        """Return every count of something received, dropped, rejected or lost, by part."""
        connection, mirror = self.connection, self.connection.mirror
        return {
            "control": dataclasses.asdict(connection.counters),
            "state": dataclasses.asdict(connection.stream.counters),
            "events": {
                "gaps": mirror.gaps,
                "discarded": mirror.discarded,
                "held_overflow": mirror.held_overflow,
            },
            "clock": {"rejected": connection.clock.rejected, "rtt_ns": connection.clock.rtt_ns},
        }

    def status(self, timeout_s: float = DEFAULT_TIMEOUT_S) -> StatusReport:
        """Ask the session for its status: participants, robots, late ticks, ages by stage, recorder, drops.

        Works while the session stands still too, for a client that it has not welcomed yet (after `open`).

        Args:
            timeout_s: Seconds to wait for the answer.

        Returns:
            The report.

        Raises:
            RequestTimeoutError: No answer within `timeout_s`.
            NotConnectedError: There is no session to ask.
        """
        asked, asked_s = -1, 0.0

        def has_answer(client: Client) -> bool:
            nonlocal asked, asked_s
            with client._lock:
                connection, now_s = client.connection, time.monotonic()
                again = connection.generation != asked or now_s - asked_s > STATUS_RETRY_S
                if again and StatusReport not in connection.latest and connection.request_status():
                    asked, asked_s = connection.generation, now_s
                    client._send_soon()
                return StatusReport in connection.latest

        with self._lock:
            self.connection.latest.pop(StatusReport, None)
        self.wait_for(has_answer, timeout_s)
        with self._lock:
            report = self.connection.latest.pop(StatusReport, None)
        if isinstance(report, StatusReport):
            return report
        if asked < 0:
            raise NotConnectedError(self.connection.describe())
        raise RequestTimeoutError(f"no status within {timeout_s:g} s")

    # --- polling ------------------------------------------------------------------------------------------------------

    def poll(self, timeout_s: float = 0.0) -> bool:
        """Receive, answer, and keep the connection alive.

        Args:
            timeout_s: Seconds to wait at most for something to come.

        Returns:
            True when anything came or the connection's phase changed.

        Raises:
            RefusedError: The session has refused us for good.
            ClientError: The thread of `start` polls.
        """
        if not self._polls_here:
            raise ClientError("poll() while the thread of start() polls: use wait_for(), callbacks and attributes")
        deadline = time.monotonic_ns() + int(timeout_s * 1e9)
        # Assets arrive all the time: one round per call is enough, and anything that came since ends the wait.
        pumped = self._just_pumped and timeout_s > 0.0
        while True:
            progressed = not pumped and self._pump()
            self._just_pumped = progressed and self.connection.is_joined and self.assets.is_loading
            pumped = False
            now = time.monotonic_ns()
            if progressed or now >= deadline:
                break
            self._wait(min(deadline, self.connection.next_deadline_ns(now)) - now)
        if self.connection.failure is not None:
            raise self.connection.failure
        return progressed

    def sleep(self, seconds: float) -> None:
        """Poll for the whole time, where `poll` returns as soon as anything came: for the pace of a loop.

        Args:
            seconds: Time to wait [s].
        """
        if self._polls_here:
            self.poll()
        self.wait_for(lambda client: False, seconds)

    def wait_for(self, condition: Callable[[Self], bool], timeout_s: float = DEFAULT_TIMEOUT_S) -> bool:
        """Poll (or wait for the thread of `start`) until a condition is true.

        Args:
            condition: Called with this client.
            timeout_s: Seconds to wait at most.

        Returns:
            False after `timeout_s`.

        Raises:
            RefusedError: The session has refused us for good.
            NotConnectedError: The thread of `start` has ended.
        """
        deadline = time.monotonic() + timeout_s
        while not condition(self):
            remaining = deadline - time.monotonic()
            if remaining <= 0.0:
                return False
            if self._polls_here:
                self.poll(remaining)
                continue
            with self._changed:
                self._check_thread()
                if self.connection.failure is not None:
                    raise self.connection.failure
                self._changed.wait(min(remaining, 0.1))
        return True

    def poll_state(self) -> bool:
        """Take only the state that has come, and pass it to `on_state`; everything else is left to `poll`.

        For a loop with several clients, as `ClientGroup`: all of them have their state before the rest of any.

        Returns:
            True when state came.
        """
        with self._lock:
            state, progressed = self._drain_state()
        if state is not None and self.on_state is not None:
            self.on_state(state)
        return progressed

    @property
    def has_state(self) -> bool:
        """True when state has arrived that `poll_state` would take."""
        return self._sockets.has_state

    @property
    def registration(self) -> tuple[int, bool]:
        """Changes when `register` would add something else than before."""
        return self._sockets.version, self.connection.peek_outgoing() is not None

    def register(self, poller: zmq.Poller) -> zmq.Socket[bytes] | None:
        """Add our sockets to a poller; `poll` is due when they wake it and at `connection.next_deadline_ns`.

        Args:
            poller: The poller of your loop.

        Returns:
            The state socket: `poll_state` is enough when only that wakes.
        """
        if self.connection.phase is ConnectionPhase.CLOSED:
            return None
        return self._sockets.register(poller, sending=self.connection.peek_outgoing() is not None)

    # --- messages -----------------------------------------------------------------------------------------------------

    def send(self, message: ClientMessage) -> bool:
        """Send any message that expects no reply.

        Args:
            message: The message.

        Returns:
            False: the message was dropped, and counted: the send queue is full, or it is a sample and there is no
            connection. An e-stop is never dropped; False means that it waits for a connection.

        Raises:
            InvalidMessageError: A value does not fit the protocol.
            NotConnectedError: There is no connection, and the message is neither sample nor e-stop.
        """
        with self._lock:
            if not isinstance(message, EStop):  # that one leaves as long as there is a socket
                self._check_thread()
            queued = self.connection.send(message)
            self._send_soon()
            self._check_thread()
            return queued

    def submit(self, message: Any) -> int:
        """Send a request without waiting.

        Args:
            message: A message with a field `request_id`, which is filled in.

        Returns:
            The `request_id`, for `answer`.

        Raises:
            InvalidMessageError: A value does not fit the protocol.
            NotConnectedError: There is no connection.
        """
        with self._lock:
            self._check_thread()
            request_id = self.connection.request(message)
            self._send_soon()
            return request_id

    def answer(self, request_id: int) -> Reply | None:
        """Return the reply to a submitted request, once.

        Args:
            request_id: As returned by `submit`.

        Returns:
            The reply, whose `denial` may be set, or `None` while there is none.
        """
        with self._lock:
            return self.connection.requests.pop_reply(request_id)

    def request(self, message: Any, timeout_s: float = DEFAULT_TIMEOUT_S) -> Reply:
        """Send a request and wait for its reply.

        Args:
            message: A message with a field `request_id`, which is filled in.
            timeout_s: Seconds to wait for the reply.

        Returns:
            The reply, which is not a denial.

        Raises:
            DeniedError: The session denied the request.
            RequestTimeoutError: No reply within `timeout_s`; the request may still take effect.
            InvalidMessageError: A value does not fit the protocol.
            NotConnectedError: There is no connection, or it was lost meanwhile.
        """
        with self._lock:
            generation = self.connection.generation
            fault_before = self.connection.last_protocol_fault
            request_id = self.submit(message)
        replies: list[Reply] = []

        def is_over(client: Client) -> bool:
            reply = client.answer(request_id)
            if reply is not None:
                replies.append(reply)
            lost = client.connection.generation != generation or not client.connection.is_joined
            return reply is not None or client.connection.last_protocol_fault is not fault_before or lost

        self.wait_for(is_over, timeout_s)
        with self._lock:
            self.connection.requests.discard(request_id)
        kind = type(message).__name__
        if not replies:
            if self.connection.generation != generation or not self.connection.is_joined:
                raise NotConnectedError(f"connection lost while waiting for the answer to {kind}")
            fault = self.connection.last_protocol_fault
            if fault is not None and fault is not fault_before:
                raise InvalidMessageError(f"the session rejected {kind}: {fault.message}")
            raise RequestTimeoutError(f"no answer to {kind} within {timeout_s:g} s")
        if replies[0].denial is not None:
            raise DeniedError(self._add_holder_name(replies[0].denial))
        return replies[0]

    # --- requests: leases ---------------------------------------------------------------------------------------------

    def acquire(
        self,
        robots: str | Iterable[str] = (),
        *,
        objects: str | Iterable[str] = (),
        wait: bool = False,
        weight: float = 1.0,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> tuple[Lease, ...]:
        """Request control of robots and objects, all or none.

        Args:
            robots: Names of robots; without any names the assignment policy chooses one robot.
            objects: Names of objects.
            wait: Queue when another participant holds them. The reply then comes with the lease, as it does after a
                holder's consent in mode `request`.
            weight: Our share in mode `shared`.
            timeout_s: Seconds to wait for the reply.

        Returns:
            The leases.

        Raises:
            DeniedError: They are not to be had; `denial` has reason, holder and advice.
            RequestTimeoutError: No reply within `timeout_s`. With `wait` we stay in the queue; `release()` leaves it.
        """
        message = Acquire(0, to_names("robots", robots), to_names("objects", objects), wait, weight)
        return self.request(message, timeout_s).leases

    def release(self, *names: str) -> None:
        """Give robots and objects back.

        Args:
            names: Robots and objects; without any all, and every queue is left.

        Raises:
            DeniedError: One of them is not ours.
        """
        names = to_names("release", names)
        leases = self.connection.mirror.leases
        kinds = [leases[name].kind if name in leases else TargetKind.ROBOT for name in names]
        tokens = [self.lease_version(name) or 0 for name in names]
        self.request(Release(0, tuple(map(Target, names, tokens, kinds))))

    def grasp(self, name: str, device: str) -> tuple[Lease, ...]:
        """Take a free object with a hand that drives no robot.

        Args:
            name: Name of the object.
            device: Our device that takes it.

        Returns:
            The lease.

        Raises:
            DeniedError: The object is not free.
        """
        return self.request(Grasp(0, name, device)).leases

    def consent(self, consent_id: int, grant: bool) -> None:
        """Answer a `ConsentRequested` event.

        Args:
            consent_id: Number in the event.
            grant: Whether the other participant gets the lease.

        Raises:
            DeniedError: There is no such question any more.
        """
        self.request(Consent(0, consent_id, grant))

    def assign(self, robots: str | Iterable[str], participant: str = "") -> tuple[Lease, ...]:
        """As director, give robots to a participant, or free them.

        Args:
            robots: Names of robots.
            participant: Id of the participant; empty: free the robots.

        Returns:
            The leases.

        Raises:
            DeniedError: We are not a director, or there is no such robot or participant.
        """
        return self.request(Assign(0, to_names("robots", robots), participant)).leases

    def set_mode(self, robot: str, mode: str) -> None:
        """As director, change the lease mode of a robot.

        Args:
            robot: Name of the robot.
            mode: A `LeaseMode`.

        Raises:
            DeniedError: We are not a director, or there is no such robot.
        """
        self.request(SetMode(0, robot, mode))

    def set_scale(self, robots: str | Iterable[str] = (), scale: float = 1.0) -> tuple[Lease, ...]:
        """Set how far robots move as our hand moves; it is 1 again with the next holder.

        Args:
            robots: Robots that we hold, without names all of them. A director may name others.
            scale: 1: as far as the hand, 0.1: a tenth.

        Returns:
            The leases.

        Raises:
            DeniedError: A robot is not ours, or `scale` is out of range.
        """
        return self.request(SetScale(0, to_names("robots", robots), scale)).leases

    # --- requests: alignment ------------------------------------------------------------------------------------------

    def align(self, action: str, participant: str = "") -> None:
        """Start or stop a measurement of the alignment. The one in force stays until there is a better one.

        Args:
            action: `start`: measure again from the beginning; `stop`: keep the one in force.
            participant: Id of another participant, as director; empty: ourselves.

        Raises:
            DeniedError: We may not.
        """
        self.request(Align(0, action, participant))

    def place_alignment(self, participant: str, T_world_tracking: PoseLike, *, offset: bool = False) -> None:
        """As director, align a participant by hand.

        Args:
            participant: Id of the participant.
            T_world_tracking: Pose of its tracking frame in the world, `((x, y, z) [m], (w, x, y, z))`.
            offset: The pose is an offset to the measured alignment.

        Raises:
            DeniedError: We are not a director, or there is no such participant.
        """
        self.request(PlaceAlignment(0, participant, to_pose("T_world_tracking", T_world_tracking), offset))

    def move_anchor(self, anchor_id: str, T_world_anchor: PoseLike, *, force: bool = False) -> None:
        """As director, set the pose of an anchor; the scene moves for every participant aligned to it.

        Args:
            anchor_id: Id of the anchor.
            T_world_anchor: Its pose in the world, `((x, y, z) [m], (w, x, y, z))`.
            force: Also further than 5 m from where it was.

        Raises:
            DeniedError: We are not a director, or it is too far (`too_far`).
        """
        self.request(MoveAnchor(0, anchor_id, to_pose("T_world_anchor", T_world_anchor), force))

    def new_tracking_frame(self) -> int:
        """Report that the tracking frame jumped: our alignment is void.

        Returns:
            The new tracking epoch.
        """
        epoch = self.connection.tracking_epoch = self.connection.tracking_epoch + 1
        if self.connection.is_joined:  # else it follows the next welcome
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
        """Report the observation of an anchor, in the tracking frame.

        Args:
            anchor_id: Id of the anchor.
            T_tracking_anchor: Its pose in the tracking frame, `((x, y, z) [m], (w, x, y, z))`.
            kind: An `AnchorKind`.
            capture_ns: Session time of the observation [ns], default now.
            viewpoint_id: The same number for observations from one place.
            size_m: Measured edge length [m], 0 when not measured.
            quality: 0 to 1.
            device: The device that observed it.
            covariance: 36 values, 6x6 row-major, (x, y, z [m], rx, ry, rz [rad]), tracking axes; without it the
                session assumes that of a headset's camera.
            tracking_epoch: Epoch of the tracking frame, default the present one.

        Raises:
            InvalidMessageError: A value does not fit the protocol.
            NotConnectedError: There is no connection.
        """
        values = to_numbers("covariance", covariance)
        if len(values) not in (0, 36):
            raise InvalidMessageError(f"covariance: expected 36 numbers, 6x6 row-major, or none, got {len(values)}")
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
                covariance=values,
            )
        )

    def observe_image(
        self,
        image: NDArray[Any],
        camera: CameraModel,
        sheets: Sequence[Sheet],
        T_tracking_camera: PoseLike,
        *,
        capture_ns: int | None = None,
        viewpoint_id: int | None = None,
        device: str = "head",
        camera_sigma: tuple[float, float] = CAMERA_SIGMA,
        tracking_epoch: int | None = None,
    ) -> list[SheetDetection]:
        """Detect sheets in an image and report them as observations.

        Sheets with an ambiguous pose (both poses of a plane fit) are left out. Takes tenths of a second: not for the
        loop that sends samples.

        Args:
            image: (height, width[, 3]) uint8.
            camera: Intrinsics of the camera.
            sheets: Sheets to look for.
            T_tracking_camera: Pose of the camera at `capture_ns` (x right, y down, z into the scene),
                `((x, y, z) [m], (w, x, y, z))`.
            capture_ns: Session time of the image [ns], default now.
            viewpoint_id: By default counted by where the camera goes.
            device: The device that observed it.
            camera_sigma: Standard deviations ([m], [rad]) of `T_tracking_camera`.
            tracking_epoch: Epoch of the tracking frame, default the present one at the call.

        Returns:
            The sightings that were reported.

        Raises:
            InvalidMessageError: Image, camera or pose cannot be.
            NotConnectedError: There is no connection.
            ClientError: OpenCV or SciPy is missing.
        """
        epoch = self.connection.tracking_epoch if tracking_epoch is None else tracking_epoch  # before the detection
        now_ns = self.session_now_ns() if capture_ns is None else capture_ns
        pose = to_pose("T_tracking_camera", T_tracking_camera)
        T: PoseTuple = (pose.p, pose.q)
        found = self._sheets.detect(image, camera, sheets)
        if viewpoint_id is None:
            with self._lock:
                viewpoint_id = self._sheets.viewpoints.number_at(epoch, T)
        for sighting in found:
            self.send(
                to_observation(
                    sighting,
                    T,
                    capture_ns=now_ns,
                    tracking_epoch=epoch,
                    viewpoint_id=viewpoint_id,
                    device=device,
                    camera_sigma=camera_sigma,
                )
            )
        return found

    # --- requests: session --------------------------------------------------------------------------------------------

    def estop(self, reason: object = "") -> bool:
        """Stop everything, at once and latched, without waiting for an answer. Not a safety-rated stop.

        It is sent again after every reconnect, until the session reports that it is stopped or `clear_estop` is called.

        Args:
            reason: Anything; its text is cut to what the protocol takes.

        Returns:
            False: there is no connection now, it leaves with the next one.

        Raises:
            NotConnectedError: This client was never opened, was closed or refused, or its thread has ended (the e-stop
                is sent nevertheless while the socket stands). Nothing else is raised.
        """
        return self.send(EStop(to_text(reason)))

    def clear_estop(self) -> None:
        """End the e-stop; robots hold until they are clutched again.

        Raises:
            DeniedError: We may not.
        """
        self.request(ClearEStop(0))

    def control(self, action: str, ticks: int = 1) -> None:
        """As director, control the simulation.

        Args:
            action: `pause`, `resume`, `step` or `reset`.
            ticks: Number of ticks for `step`.

        Raises:
            DeniedError: We are not a director.
        """
        self.request(Control(0, action, ticks))

    def episode(self, action: str, label: str = "") -> None:
        """Mark an episode in the recording.

        Args:
            action: `start`, `success`, `failure`, `discard`, `rerecord` or `reset`.
            label: Label of the episode.

        Raises:
            DeniedError: We may not, or no episode runs.
        """
        self.request(Episode(0, action, label))

    def marker(self, text: str) -> None:
        """Put a note into the recording.

        Args:
            text: The note.

        Raises:
            DeniedError: We may not.
        """
        self.request(Marker(0, text))

    # --- samples ------------------------------------------------------------------------------------------------------

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

    # --- inside -------------------------------------------------------------------------------------------------------

    def _add_holder_name(self, denial: Denial) -> Denial:
        holder = self.connection.mirror.participants.get(denial.holder)
        if holder is None or denial.holder_name:
            return denial
        return msgspec.structs.replace(denial, holder_name=holder.name)

    @property
    def _polls_here(self) -> bool:
        return self._thread is None or threading.current_thread() is self._thread

    def _check_thread(self) -> None:
        """Raise the error that ended the thread of `start`: nothing is sent or received without it."""
        if isinstance(self._crash, ClientError):
            raise self._crash
        if self._crash is not None:
            text = f"the thread of start() was ended by {type(self._crash).__name__}: {self._crash}"
            raise NotConnectedError(text) from self._crash

    def _send_soon(self) -> None:
        if self._polls_here or self._crash is not None:
            self._flush()
        else:
            self._sockets.wake()

    def _pump(self) -> bool:
        """Take one round without waiting: state first, then control, timers, sending, callbacks."""
        with self._lock:
            if self.connection.phase is ConnectionPhase.CLOSED:
                raise NotConnectedError(self.connection.describe())
            phase = self.connection.phase
            if self.assets.has_workers:
                self._sockets.clear_wake()  # before its reason is checked, so that a later one is not lost
            self._joiner.step()
        progressed = self.poll_state()
        with self._lock:
            disconnected = self._sockets.poll_disconnect() and self._generation == self.connection.generation
            progressed |= self._drain_control()  # the last messages of a session before its end
            if disconnected and self._generation == self.connection.generation:
                self.connection.handle_disconnect(time.monotonic_ns())
            self._joiner.check_answer()
            self.connection.tick(time.monotonic_ns())
            report = self._arrivals.poll_report(self.connection, time.monotonic_ns())
            if report is not None:
                self.connection.send(self.media.extend_report(report, time.monotonic_ns()))
            self._flush()
            progressed |= self.media.poll()
            progressed |= self.assets.poll()
            if self.connection.phase is ConnectionPhase.REFUSED:
                self._sockets.disconnect()
            progressed |= self.connection.phase is not phase
            inbox = [self.connection.inbox.popleft() for _ in range(len(self.connection.inbox))]
            for message in inbox:
                if isinstance(message, Feedback):
                    self.feedback[message.robot] = message
            if self.feedback and not self.connection.is_joined:
                self.feedback = {}  # it would be out of date
        for message in inbox:
            self._call_back(message)
        self.assets.call_back()
        return progressed

    def _drain_state(self) -> tuple[SceneState | None, bool]:
        messages = self._sockets.drain_state()
        local_ns = time.monotonic_ns()
        state = self.connection.stream.drain(messages, self.connection.clock.session_ns(local_ns), local_ns)
        local_ns = time.monotonic_ns()
        if state is not None and not self.connection.stream.check_fresh(local_ns):
            state = None
        if state is not None:
            now_ns = self.connection.clock.session_ns(local_ns)  # decoding is part of the age
            state = SceneState(state.header, state.poses, now_ns, now_ns - state.header.session_time)
            self.scene.on_state(state)
            self._arrivals.record(state)
        return state, bool(messages)

    def _drain_control(self) -> bool:
        messages = self._sockets.drain_control()
        now_ns = time.monotonic_ns()  # after receiving: a pong stamped too early would understate its round trip
        for frames in messages:
            self.connection.receive(frames, now_ns)
        if self.connection.is_joined and self.connection.welcome is not None:
            self.scene.on_welcome()
            self._sockets.open_state(self.connection.welcome.endpoints.state, self._generation)
        return bool(messages)

    def _flush(self) -> None:
        if self._generation != self.connection.generation:
            self._sockets.open_control()
            self._generation = self.connection.generation
        while (item := self.connection.peek_outgoing()) is not None:
            droppable, data = item
            sent = self._sockets.send_control(data)
            if not sent and not droppable:
                return
            self.connection.pop_outgoing(sent=sent)

    def _call_back(self, message: InboxMessage) -> None:
        if isinstance(message, Event) and self.on_event is not None:
            self.on_event(message)
        elif isinstance(message, MissedEvents) and self.on_missed is not None:
            self.on_missed(message.first, message.last)
        elif isinstance(message, Feedback) and self.on_feedback is not None:
            self.on_feedback(message)
        elif isinstance(message, Reply) and self.on_denial is not None and message.denial is not None:
            self.on_denial(message.denial)

    def _wait(self, timeout_ns: int) -> None:
        poller = zmq.Poller()
        self.register(poller)
        self._sockets.register_wake(poller)
        poller.poll(to_milliseconds(timeout_ns))
        self._sockets.clear_wake()

    def _run(self) -> None:
        try:
            while not self._stopping:
                self.poll(0.1)
                with self._changed:
                    self._changed.notify_all()
        except BaseException as error:  # raised again in the calls that wait
            if not isinstance(error, ClientError):  # those are one line, raised in the calls that wait
                traceback.print_exception(error)
            with self._changed:
                self._crash = error
                self._changed.notify_all()
