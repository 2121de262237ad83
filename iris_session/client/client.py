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
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any, Final, Self

from iris_session.client.alignment import ClientAlignment
from iris_session.client.arguments import to_devices, to_names, to_text
from iris_session.client.assets import ClientAssets
from iris_session.client.cameras import CameraFeed, open_camera
from iris_session.client.core.arrival_meter import ArrivalMeter
from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.outbox import encode_checked
from iris_session.client.core.samples import SampleBuilder
from iris_session.client.core.state_stream import SceneState
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.driving import ClientDriving
from iris_session.client.endpoint_resolver import SessionJoiner, parse_connect_request
from iris_session.client.errors import (
    ClientError,
    DeniedError,
    NotConnectedError,
    RequestTimeoutError,
)
from iris_session.client.identity import Identity
from iris_session.client.loop import ClientLoop
from iris_session.client.media import ClientMedia
from iris_session.client.requests import ClientRequests
from iris_session.client.scene import ClientScene
from iris_session.client.sockets import ClientSockets, CurveKeys
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
    Hello,
    Marker,
    Release,
    SetMode,
    SetScale,
)
from iris_session.protocol.common import Denial, Lease, Target
from iris_session.protocol.names import AlignmentKind, DenialReason, EpisodeAction, EpisodeState, Role, TargetKind
from iris_session.protocol.server_messages import ROBOT_STATES, EpisodeChanged, Event, Feedback, Reply
from iris_session.protocol.session_mirror import SessionMirror
from iris_session.protocol.status import StatusReport

DEFAULT_TIMEOUT_S: Final = 5.0
#: Longest wait of `start_episode`: a countdown has at most 60 s.
START_S: Final = 65.0
#: A status request without an answer is repeated; twice a second is below the limit of its type.
STATUS_RETRY_S: Final = 0.5
#: Roles that have no headset, so nothing to align.
UNALIGNED_ROLES: Final = frozenset({Role.AGENT, Role.LEADER, Role.GATEWAY, Role.RECORDER, Role.CAMERA, Role.SOURCE})


class Client(ClientDriving):
    """A participant of a session.

        with Client("127.0.0.1:7721", role="agent", name="policy", devices="target") as client:
            client.acquire("left")
            client.wait_for(lambda c: c.scene.tip_pose("left") is not None)
            (x, y, z), q = client.scene.tip_pose("left")  # T_world_tip
            client.move_to("left", ((x, y, z + 0.05), q))  # in a loop of your own: send_target

    Attributes:
        scene: The scene as it is now: newest state, poses by name, presence.
        media: Media streams: subscribe, point clouds, publish.
        assets: Assets: fetch, cancel, cache.
        alignment: Alignment: the present one, observations of anchors, jumps of the tracking frame.
        connection: The connection without I/O: phase, counters, clock.
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
        robot_states: bool = False,
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
            devices: Tracked sources of input that samples will name, each a `Device`: `target` for `move_to`.
            capabilities: Further capabilities for `Hello`.
            robot_states: Receive joints, grippers, forces and commands of the robots with every state:
                `scene.robot_state`.
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
            devices=to_devices(devices),
            # The session keeps our alignment over a lost connection only while this `run` lasts.
            capabilities=(*capabilities, *((ROBOT_STATES,) if robot_states else ()), f"run:{secrets.token_hex(8)}"),
            alignment=alignment,
        )
        encode_checked(hello)
        self.connection = ClientConnection(hello, identity)
        self.on_state = on_state
        self.on_event = on_event
        self.on_missed = on_missed
        self.on_feedback = on_feedback
        self.on_denial = on_denial
        self._samples = SampleBuilder(self.connection)
        self._sockets = ClientSockets()
        self._lock = threading.RLock()
        self._requests = ClientRequests(self.connection, self._lock, self.submit, self.answer, self.wait_for)
        self._joiner = SessionJoiner(request, self.connection, self._sockets)
        self.scene = ClientScene(self.connection, self._lock)
        arrivals = ArrivalMeter()
        self.media = ClientMedia(self.connection, self._sockets, self._lock, lambda: self._loop.polls_here, arrivals)
        self.assets = ClientAssets(self.connection, self._sockets, self._lock)
        self.alignment = ClientAlignment(self.connection, self.send, self.request)
        self._loop = ClientLoop(self, self._sockets, self._joiner, self._lock, arrivals)

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
        self._loop.stop_thread()
        workers = None
        with self._lock:
            if self.connection.phase is not ConnectionPhase.CLOSED:
                self._joiner.cancel()
                workers = self.assets.close()
                self.connection.close()
                self._loop.send_pending()
                self._sockets.close()
            self._loop.changed.notify_all()
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
        self._loop.start_thread(f"iris-client-{self.name}")
        return self

    # --- identity and session -----------------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Joined, with snapshot and clock. False while reconnecting, and after the thread of `start` ended."""
        return self.connection.phase is ConnectionPhase.READY and self._loop.crash is None

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
    def mirror(self) -> SessionMirror:
        """The shared session state: `participants`, `leases`, `robots`, `bodies`, `paused`, `estop`, `event_seq`."""
        return self.connection.mirror

    @property
    def feedback(self) -> dict[str, Feedback]:
        """Newest `Feedback` by robot; empty without a connection."""
        return self._loop.feedback

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
                    client._loop.send_soon()
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
        if not self._loop.polls_here:
            raise ClientError("poll() while the thread of start() polls: use wait_for(), callbacks and attributes")
        return self._loop.poll(timeout_s)

    def sleep(self, seconds: float) -> None:
        """Poll for the whole time, where `poll` returns as soon as anything came: for the pace of a loop.

        Args:
            seconds: Time to wait [s].
        """
        if self._loop.polls_here:
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
            if self._loop.polls_here:
                self.poll(remaining)
                continue
            self._loop.wait_for_thread(min(remaining, 0.1))
        return True

    def camera(self, name: str, timeout_s: float = 10.0) -> CameraFeed:
        """Subscribe to the pictures of a camera: one of the model (`serve --picture`), or a real one.

        Args:
            name: Name of the camera in the model; of a real one, that of its stream.
            timeout_s: Seconds to wait for a camera that is not offered yet: its process needs some to start.

        Raises:
            ClientError: The session offers no such camera; the text lists those that it does.
            MissingExtraError: Pillow, which decodes pictures, is not installed.
        """
        return open_camera(self.media, self.wait_for, self.session_now_ns, name, timeout_s)

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
                self._loop.check_thread()
            queued = self.connection.send(message)
            self._loop.send_soon()
            self._loop.check_thread()
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
            self._loop.check_thread()
            request_id = self.connection.request(message)
            self._loop.send_soon()
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
        return self._requests.request(message, timeout_s)

    # --- requests: leases ---------------------------------------------------------------------------------------------

    def acquire(
        self,
        robots: str | Iterable[str] = (),
        *,
        objects: str | Iterable[str] = (),
        wait: bool = False,
        weight: float = 1.0,
        timeout_s: float | None = None,
    ) -> tuple[Lease, ...]:
        """Request control of robots and objects, all or none.

        A call that gives up withdraws its request, so that nothing is granted unnoticed later. To wait without
        blocking, `submit` an `Acquire` and look for its `answer`.

        Args:
            robots: Names of robots; without any names the assignment policy chooses one robot.
            objects: Names of objects.
            wait: Queue when another participant holds them. The reply then comes with the lease, as it does after a
                holder's consent in mode `request`.
            weight: Our share in mode `shared`.
            timeout_s: Seconds to wait for the reply, by default 5; when the holder of one of the robots may be asked
                for consent (mode `request`), 5 more than it may take to answer.

        Returns:
            The leases.

        Raises:
            DeniedError: They are not to be had; `denial` has reason, holder and advice.
            RequestTimeoutError: No reply within `timeout_s`, so the request was withdrawn; `denial` has the place in
                the queue and the holder.
        """
        message = Acquire(0, to_names("robots", robots), to_names("objects", objects), wait, weight)
        if timeout_s is None:
            timeout_s = DEFAULT_TIMEOUT_S + self._requests.compute_consent_s(message)
        return self._requests.acquire(message, timeout_s).leases

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

    def clear_estop(self, stop_seq: int | None = None) -> None:
        """As director, end the e-stop; robots hold until they are clutched again.

        Args:
            stop_seq: Number of the newest stop that was looked at, by default of the newest that has arrived here
                (`mirror.stop_seq`).

        Raises:
            DeniedError: We are not a director, or the session was stopped again since (reason `estop`): `denial` says
                by which participant, and why.
        """
        self.request(ClearEStop(0, self.mirror.stop_seq if stop_seq is None else stop_seq))

    def control(self, action: str, ticks: int = 1) -> None:
        """As director, control the simulation.

        Args:
            action: `pause`, `resume`, `step` or `reset`.
            ticks: Number of ticks for `step`.

        Raises:
            DeniedError: We are not a director.
        """
        self.request(Control(0, action, ticks))

    def episode(self, action: str, label: str = "", countdown_s: float | None = None) -> None:
        """Send one action on an episode; the methods below also wait for what comes of it.

        Args:
            action: `start`, `stop`, `success`, `failure`, `unknown`, `discard`, `rerecord`, `take_over` or `reset`. The
                first `discard` or `rerecord` asks, a second one within 3 s does it.
            label: Free text about the episode.
            countdown_s: Of `start`, at most 60 [s]; `None` for that of the session.

        Raises:
            DeniedError: We may not, or the episode is not in a state for it.
        """
        self.request(Episode(0, action, label, None if countdown_s is None else round(countdown_s * 1e9)))

    def start_episode(self, label: str = "", *, countdown_s: float | None = None) -> EpisodeChanged:
        """Start an episode and wait until it is recorded.

        Args:
            label: Free text about the episode.
            countdown_s: As of `episode`.

        Returns:
            The running episode: number, task, instruction, robots.

        Raises:
            DeniedError: We may not, an episode is running, or the countdown was cancelled.
        """
        before = self.mirror.episode
        self.episode(EpisodeAction.START, label, countdown_s)
        episode = self._wait_for_episode(before, EpisodeState.ALL - {EpisodeState.COUNTDOWN}, START_S)
        if episode.state == EpisodeState.CANCELLED:
            text = f"the countdown of episode {episode.number} was cancelled"
            raise DeniedError(Denial(DenialReason.EPISODE_STATE, text, "start it again"))
        return episode

    def stop_episode(self) -> EpisodeChanged:
        """End the recording of the episode: robots hold until its verdict is given.

        Returns:
            The closing episode.

        Raises:
            DeniedError: We may not, or no episode runs.
        """
        before = self.mirror.episode
        self.episode(EpisodeAction.STOP)
        return self._wait_for_episode(before, EpisodeState.ALL)

    def end_episode(self, verdict: str = EpisodeAction.SUCCESS, label: str = "") -> EpisodeChanged:
        """Give the verdict of the episode, and wait until the scene is ready for the next one.

        Args:
            verdict: `success`, `failure` or `unknown`.
            label: Free text instead of the one from the start.

        Returns:
            The episode as it ended, with the number of successes so far.

        Raises:
            DeniedError: We may not, or no episode runs.
        """
        before = self.mirror.episode
        self.episode(verdict, label)
        return self._wait_for_episode(before, EpisodeState.OVER)

    def discard_episode(self, *, again: bool = False) -> EpisodeChanged:
        """Discard the episode, or cancel its countdown. The session asks twice: this confirms at once.

        Args:
            again: Count down to the same number again.

        Returns:
            The discarded episode, or the one that counts down.

        Raises:
            DeniedError: We may not, or no episode runs.
        """
        before = self.mirror.episode
        action = EpisodeAction.RERECORD if again else EpisodeAction.DISCARD
        self.episode(action)
        asked = self._wait_for_episode(before, EpisodeState.ALL)
        if asked.state != EpisodeState.CONFIRM:
            return asked  # of a countdown, or confirmed what was asked before
        self.episode(action)
        begun = {EpisodeState.COUNTDOWN, EpisodeState.RUNNING}
        return self._wait_for_episode(asked, begun if again else EpisodeState.OVER)

    def take_over_episode(self) -> EpisodeChanged:
        """Lead the episode from now on: as director, or when its leader is disconnected or has the headset off.

        Returns:
            The episode.

        Raises:
            DeniedError: Its leader is there, or no episode runs.
        """
        before = self.mirror.episode
        self.episode(EpisodeAction.TAKE_OVER)
        return self._wait_for_episode(before, EpisodeState.ALL)

    def _wait_for_episode(
        self, before: EpisodeChanged | None, states: Collection[str], timeout_s: float = DEFAULT_TIMEOUT_S
    ) -> EpisodeChanged:
        """Wait until an event after `before` has the episode in one of `states`: it may come after the reply."""
        self.wait_for(
            lambda client: (now := client.mirror.episode) is not None and now is not before and now.state in states,
            timeout_s,
        )
        now = self.mirror.episode
        if now is None:
            raise RequestTimeoutError("the session has accepted the request, but announced no episode")
        return now

    def marker(self, text: str) -> None:
        """Put a note into the recording.

        Args:
            text: The note.

        Raises:
            DeniedError: We may not.
        """
        self.request(Marker(0, text))
