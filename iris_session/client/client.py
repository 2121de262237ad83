"""The client: the thin shell of `Connection` with sockets and a clock, and the calls people use.

It has no thread of its own: `poll` drives everything, and every waiting call polls. `start` is for those who want a
thread: from then on only that thread touches the sockets, and callbacks run in it.
"""

from __future__ import annotations

import os
import secrets
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Self

import zmq

from iris_session.client.connection import Connection
from iris_session.client.errors import ClientError, NotConnectedError
from iris_session.client.identity import Identity
from iris_session.client.joining import Joining, wanted
from iris_session.client.reporting import ArrivalMeter, Reporting
from iris_session.client.requests import Requests
from iris_session.client.sampling import Sampling
from iris_session.client.scene_view import SceneView
from iris_session.client.sockets import ClientSockets, CurveKeys
from iris_session.client.state_stream import SceneState
from iris_session.client.status import Phase
from iris_session.client.values import checked_bytes, names_of
from iris_session.client.waiting import milliseconds
from iris_session.protocol.client_messages import ClientMessage, EStop, Hello
from iris_session.protocol.common import Denial
from iris_session.protocol.names import AlignmentKind, Role
from iris_session.protocol.server_messages import Event, Feedback, ProtocolFault, Reply

#: Roles that have no headset, so nothing to align.
UNALIGNED_ROLES = frozenset({Role.AGENT, Role.LEADER, Role.GATEWAY, Role.RECORDER})
DEFAULT_TIMEOUT_S = 5.0


class Client(SceneView, Requests, Sampling, Reporting, Joining):
    """A participant of a session.

    `address`: `HOST:PORT` of the control channel, or the `iris://` URI of a pairing code; `session`: name of a session
    to find on the network instead. Neither: the session on this machine. `join_code`: from `iris-session pair`, for
    the first time at an encrypted session. `devices`: tracked sources of input that samples will name.
    `alignment`: `measured` or `not_needed` (default: by role). `identity`: an `Identity`, a file that keeps one across
    restarts, or `None` for this process only. `curve`: keys of your own instead of those in the home of keys.
    `on_state(state)`, `on_event(event)`, `on_feedback(feedback)`: called from `poll` (or the thread of `start`).
    `on_denial(denial)`: of a message that waits for no answer.

        with Client("127.0.0.1:7721", role="agent", name="policy", devices=("target",)) as client:
            client.acquire(["left"])
            client.wait_for(lambda c: c.tip_pose("left") is not None)
            target = client.tip_pose("left")  # T_world_tip: move it
            for i in range(90):  # the clutch must be seen open once; after 150 ms without a sample the robot holds
                client.send_sample("target", target, robots=["left"], clutch=i > 0)
                client.sleep(1 / 60)
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
        on_feedback: Callable[[Feedback], None] | None = None,
        on_denial: Callable[[Denial], None] | None = None,
    ) -> None:
        self._wanted = wanted(address, session, curve, join_code)
        #: `HOST:PORT`, as soon as it is known.
        self.address = str(self._wanted.address or f"session {session!r}")
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
            devices=names_of("devices", devices),
            # The session keeps our alignment over a lost connection only while this `run` lasts.
            capabilities=(*capabilities, f"run:{secrets.token_hex(8)}"),
            alignment=alignment,
        )
        checked_bytes(hello)
        self.connection = Connection(hello, identity)
        self.on_state = on_state
        self.on_event = on_event
        self.on_feedback = on_feedback
        self.on_denial = on_denial
        self.feedback: dict[str, Feedback] = {}
        self._state: SceneState | None = None
        self._session_id = ""
        self._seq = {}
        self._arrivals = ArrivalMeter()
        self._generation = 0
        self._sockets = ClientSockets()
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._thread: threading.Thread | None = None
        self._stopping = False
        self._crash: BaseException | None = None

    # --- life ---------------------------------------------------------------------------------------------------------

    def connect(self, timeout_s: float = DEFAULT_TIMEOUT_S) -> Self:
        """Joins the session and waits for snapshot and clock.

        Raises `RefusedError` (or `VersionError`) when the session says no, `TrustError` when its key is not the one
        that is trusted, `NotConnectedError` when nobody answers.
        """
        self.open()
        if not self.wait_for(lambda client: client.ready, timeout_s):
            raise NotConnectedError(f"no session let us in at {self.why_not_in(f'within {timeout_s:g} s')}")
        return self

    def open(self) -> None:
        """Begins to join, without waiting: `poll` goes on with it until `ready`."""
        with self._lock:
            if self.connection.phase is Phase.CLOSED:
                raise NotConnectedError(self.connection.describe())
            if self.connection.phase in (Phase.IDLE, Phase.REFUSED) and self._meeting is None:
                self._begin_meeting()
                self._step_meeting()

    def close(self) -> None:
        """Leaves at once: leases are released without grace. Stops the thread of `start`."""
        with self._lock:
            self._stopping = True
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            self._sockets.wake()
            thread.join()
        with self._lock:
            if self.connection.phase is not Phase.CLOSED:
                self._end_meeting()
                self.connection.close()
                self._flush()
                self._sockets.close()
            self._changed.notify_all()

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
        """Starts the only thread there is: it polls until `close`. `poll` must not be called from then on."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=f"iris-client-{self.name}", daemon=True)
                self._thread.start()
        return self

    # --- driving ------------------------------------------------------------------------------------------------------

    def poll(self, timeout_s: float = 0.0) -> bool:
        """Receives, answers, keeps the connection alive. Waits up to `timeout_s` for something to come.

        True when anything came or the connection's phase changed. Raises `RefusedError` after the session refused us
        for good.
        """
        if not self._polls_here:
            raise ClientError("poll() while the thread of start() polls: use wait_for(), callbacks and attributes")
        deadline = time.monotonic_ns() + int(timeout_s * 1e9)
        while True:
            progressed = self._pump()
            now = time.monotonic_ns()
            if progressed or now >= deadline:
                break
            self._wait(min(deadline, self.connection.next_deadline_ns(now)) - now)
        if self.connection.failure is not None:
            raise self.connection.failure
        return progressed

    def sleep(self, seconds: float) -> None:
        """Polls for the whole time, where `poll` returns as soon as anything came: for the pace of a loop."""
        if self._polls_here:
            self.poll()
        self.wait_for(lambda client: False, seconds)

    def poll_state(self) -> bool:
        """Only takes the state that waits, and hands it to `on_state`; everything else is left to `poll`.

        For a loop with several clients: all of them have their picture before the rest of any is looked at.
        """
        with self._lock:
            state, progressed = self._drain_state()
        if state is not None and self.on_state is not None:
            self.on_state(state)
        return progressed

    @property
    def state_waits(self) -> bool:
        """Whether state came that `poll_state` would take."""
        return self._sockets.state_waits

    @property
    def registration(self) -> tuple[int, bool]:
        """Changes when `register` would add something else than before."""
        return self._sockets.version, self.connection.peek_outgoing() is not None

    def register(self, poller: zmq.Poller) -> zmq.Socket[bytes] | None:
        """Adds our sockets to `poller`; `poll` is due when they wake it and at `connection.next_deadline_ns`.

        Returns the one that state comes by: `poll_state` is enough when only that wakes.
        """
        if self.connection.phase is Phase.CLOSED:
            return None
        return self._sockets.register(poller, sending=self.connection.peek_outgoing() is not None)

    def wait_for(self, condition: Callable[[Self], bool], timeout_s: float = DEFAULT_TIMEOUT_S) -> bool:
        """Polls (or waits for the thread) until `condition(client)` is true; false after `timeout_s`."""
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

    @property
    def _polls_here(self) -> bool:
        return self._thread is None or threading.current_thread() is self._thread

    @property
    def ready(self) -> bool:
        """Joined, with snapshot and clock. False while reconnecting, and after the thread of `start` ended."""
        return self.connection.phase is Phase.READY and self._crash is None

    @property
    def name(self) -> str:
        return self.connection.hello.name

    @property
    def worn(self) -> bool:
        """Whether somebody wears the headset. Set it; heartbeats and samples tell it."""
        return self.connection.worn

    @worn.setter
    def worn(self, worn: bool) -> None:
        self.connection.worn = worn

    @property
    def tracking_epoch(self) -> int:
        """Jumps of our tracking frame so far; `new_tracking_frame` counts one more."""
        return self.connection.tracking_epoch

    # --- sending ------------------------------------------------------------------------------------------------------

    def send(self, message: ClientMessage) -> bool:
        """Sends any message. Samples without a connection are dropped and counted (false); others then raise."""
        with self._lock:
            if not isinstance(message, EStop):  # that one leaves as long as there is a socket
                self._check_thread()
            queued = self.connection.send(message)
            self._send_soon()
            self._check_thread()
            return queued

    # --- inside -------------------------------------------------------------------------------------------------------

    def _check_thread(self) -> None:
        """Raises what ended the thread of `start`: nobody would send, receive or notice anything."""
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
        """One round without waiting: state first, then control, timers, sending, callbacks."""
        with self._lock:
            if self.connection.phase is Phase.CLOSED:
                raise NotConnectedError(self.connection.describe())
            phase = self.connection.phase
            self._step_meeting()
        progressed = self.poll_state()
        with self._lock:
            gone = self._sockets.disconnected() and self._generation == self.connection.generation
            progressed |= self._drain_control()  # the last words of a session before its end
            if gone and self._generation == self.connection.generation:
                self.connection.lost(time.monotonic_ns())
            self._look_who_answered()
            self.connection.tick(time.monotonic_ns())
            report = self._arrivals.take(self.connection, time.monotonic_ns())
            if report is not None:
                self.connection.send(report)
            self._flush()
            if self.connection.phase is Phase.REFUSED:
                self._sockets.hang_up()
            progressed |= self.connection.phase is not phase
            inbox = [self.connection.inbox.popleft() for _ in range(len(self.connection.inbox))]
            for message in inbox:
                if isinstance(message, Feedback):
                    self.feedback[message.robot] = message
            if self.feedback and not self.connection.joined:
                self.feedback = {}  # nobody tells what the robots do now
        for message in inbox:
            self._call_back(message)
        return progressed

    def _drain_state(self) -> tuple[SceneState | None, bool]:
        messages = self._sockets.drain_state()
        local_ns = time.monotonic_ns()
        state = self.connection.stream.drain(messages, self.connection.clock.session_ns(local_ns), local_ns)
        if state is not None:
            now_ns = self.session_now_ns()  # decoding is part of the age
            state = SceneState(state.header, state.poses, now_ns, now_ns - state.header.session_time)
            self._state = state
            self._arrivals.delivered(state)
        return state, bool(messages)

    def _drain_control(self) -> bool:
        messages = self._sockets.drain_control()
        now_ns = time.monotonic_ns()  # after receiving: a pong stamped too early would understate its round trip
        for frames in messages:
            self.connection.receive(frames, now_ns)
        if self.connection.joined and self.connection.welcome is not None:
            if self.connection.welcome.session_id != self._session_id:
                self._session_id, self._state = self.connection.welcome.session_id, None
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

    def _call_back(self, message: Event | Feedback | ProtocolFault | Reply) -> None:
        if isinstance(message, Event) and self.on_event is not None:
            self.on_event(message)
        elif isinstance(message, Feedback) and self.on_feedback is not None:
            self.on_feedback(message)
        elif isinstance(message, Reply) and self.on_denial is not None and message.denial is not None:
            self.on_denial(message.denial)

    def _wait(self, timeout_ns: int) -> None:
        poller = zmq.Poller()
        self.register(poller)
        self._sockets.register_wake(poller)
        poller.poll(milliseconds(timeout_ns))
        self._sockets.clear_wake()

    def _run(self) -> None:
        try:
            while not self._stopping:
                self.poll(0.1)
                with self._changed:
                    self._changed.notify_all()
        except BaseException as error:  # whatever ends the thread is raised where somebody waits
            if not isinstance(error, ClientError):  # those say what happened in one line, where somebody waits
                traceback.print_exception(error)
            with self._changed:
                self._crash = error
                self._changed.notify_all()
