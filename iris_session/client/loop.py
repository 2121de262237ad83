"""`ClientLoop`: the rounds of a client, run by `Client.poll`, by `ClientGroup`, or by the thread of `Client.start`.

A round takes state first, then control messages, timers, sending, and the callbacks.
"""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from typing import Protocol

import zmq

from iris_session.client.assets import ClientAssets
from iris_session.client.core.arrival_meter import ArrivalMeter
from iris_session.client.core.connection import ClientConnection, InboxMessage
from iris_session.client.core.state_stream import SceneState
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.endpoint_resolver import SessionJoiner
from iris_session.client.errors import ClientError, NotConnectedError
from iris_session.client.media import ClientMedia
from iris_session.client.scene import ClientScene
from iris_session.client.sockets import ClientSockets
from iris_session.protocol.common import Denial
from iris_session.protocol.server_messages import ROBOT_STATES, Event, Feedback, Reply
from iris_session.protocol.session_mirror import MissedEvents


class LoopClient(Protocol):
    """The parts of a `Client` that its loop works on, and the callbacks that it calls."""

    connection: ClientConnection
    scene: ClientScene
    media: ClientMedia
    assets: ClientAssets
    on_state: Callable[[SceneState], None] | None
    on_event: Callable[[Event], None] | None
    on_missed: Callable[[int, int], None] | None
    on_feedback: Callable[[Feedback], None] | None
    on_denial: Callable[[Denial], None] | None


class ClientLoop:
    """Rounds of one client, and the thread that may run them. Sockets are used by the thread that polls only.

    Attributes:
        feedback: Newest `Feedback` by robot.
        changed: Notified after every round of the thread; its lock is that of the client.
        crash: The error that ended the thread.
    """

    def __init__(
        self,
        client: LoopClient,
        sockets: ClientSockets,
        joiner: SessionJoiner,
        lock: threading.RLock,
        arrivals: ArrivalMeter,
    ) -> None:
        self.feedback: dict[str, Feedback] = {}
        self.changed = threading.Condition(lock)
        self.crash: BaseException | None = None
        self._client = client
        self._connection = client.connection
        self._sockets = sockets
        self._joiner = joiner
        self._lock = lock
        self._arrivals = arrivals
        self._generation = 0
        self._just_progressed = False
        self._thread: threading.Thread | None = None
        self._stopping = False

    # --- rounds -------------------------------------------------------------------------------------------------------

    def poll(self, timeout_s: float) -> bool:
        """Run rounds until anything came or the phase changed, at most for `timeout_s`; see `Client.poll`."""
        deadline = time.monotonic_ns() + int(timeout_s * 1e9)
        # Assets arrive all the time: one round per call is enough, and anything that came since ends the wait.
        skip_round = self._just_progressed and timeout_s > 0.0
        while True:
            progressed = not skip_round and self._run_round()
            self._just_progressed = progressed and self._connection.is_joined and self._client.assets.is_loading
            skip_round = False
            now = time.monotonic_ns()
            if progressed or now >= deadline:
                break
            wait_ns = min(deadline, self._connection.next_deadline_ns(now)) - now
            self._sockets.wait(wait_ns, sending=self._connection.peek_outgoing() is not None)
        self._raise_failure()
        return progressed

    def poll_state(self) -> bool:
        """Take only the state that has come, and pass it to `on_state`; everything else is left to `poll`.

        Returns:
            True when state came.
        """
        with self._lock:
            state, progressed = self._drain_state()
        if state is not None and self._client.on_state is not None:
            self._client.on_state(state)
        return progressed

    @property
    def has_state(self) -> bool:
        """True when state has arrived that `poll_state` would take."""
        return self._sockets.has_state

    def register(self, poller: zmq.Poller) -> zmq.Socket[bytes] | None:
        """Add our sockets to a poller; `poll` is due when they wake it and at `connection.next_deadline_ns`.

        Returns:
            The state socket: `poll_state` is enough when only that wakes.
        """
        return self._sockets.register(poller, sending=self._connection.peek_outgoing() is not None)

    def send_pending(self) -> None:
        """Send what the connection has queued, as far as the socket takes it."""
        if self._generation != self._connection.generation:
            self._sockets.open_control()
            self._generation = self._connection.generation
        while (item := self._connection.peek_outgoing()) is not None:
            droppable, data = item
            sent = self._sockets.send_control(data)
            if not sent and not droppable:
                return
            self._connection.pop_outgoing(sent=sent)

    # --- the thread ---------------------------------------------------------------------------------------------------

    @property
    def polls_here(self) -> bool:
        """True when the thread that asks may poll, and so use the sockets."""
        return self._thread is None or threading.current_thread() is self._thread

    def start_thread(self, name: str) -> None:
        """Start the thread unless it was started."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=name, daemon=True)
                self._thread.start()

    def stop_thread(self) -> None:
        """Stop the thread, if there is one, and wait for its end unless it is the one that asks."""
        with self._lock:
            self._stopping = True
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            self._sockets.wake()
            thread.join()

    def check_thread(self) -> None:
        """Raise the error that ended the thread: nothing is sent or received without it."""
        if isinstance(self.crash, ClientError):
            raise self.crash
        if self.crash is not None:
            text = f"the thread of start() was ended by {type(self.crash).__name__}: {self.crash}"
            raise NotConnectedError(text) from self.crash

    def wait_for_thread(self, timeout_s: float) -> None:
        """Wait for the next round of the thread. Raises the error that ended the thread or the connection."""
        with self.changed:
            self.check_thread()
            self._raise_failure()
            self.changed.wait(timeout_s)

    def send_soon(self) -> None:
        """Send what is queued here, or wake the thread that polls: no two threads may use a socket."""
        if self.polls_here or self.crash is not None:
            self.send_pending()
        else:
            self._sockets.wake()

    # --- inside -------------------------------------------------------------------------------------------------------

    def _run_round(self) -> bool:
        """Run one round without waiting. Return whether anything came or the phase changed."""
        connection, client = self._connection, self._client
        with self._lock:
            if connection.phase is ConnectionPhase.CLOSED:
                raise NotConnectedError(connection.describe())
            phase = connection.phase
            if client.assets.has_workers:
                self._sockets.clear_wake()  # before its reason is checked, so that a later one is not lost
            self._joiner.step()
        progressed = self.poll_state()
        with self._lock:
            disconnected = self._sockets.poll_disconnect() and self._generation == connection.generation
            progressed |= self._drain_control()  # the last messages of a session before its end
            if disconnected and self._generation == connection.generation:
                connection.handle_disconnect(time.monotonic_ns())
            self._joiner.check_answer()
            connection.tick(time.monotonic_ns())
            limit = client.media.limit_mbit_per_s
            report = self._arrivals.poll_report(connection, time.monotonic_ns(), limit)
            if report is not None:
                connection.send(report)
            self.send_pending()
            progressed |= client.media.poll()
            progressed |= client.assets.poll()
            if connection.phase is ConnectionPhase.REFUSED:
                self._sockets.disconnect()
            progressed |= connection.phase is not phase
            inbox = [connection.inbox.popleft() for _ in range(len(connection.inbox))]
            for message in inbox:
                if isinstance(message, Feedback):
                    self.feedback[message.robot] = message
            if self.feedback and not connection.is_joined:
                self.feedback = {}  # it would be out of date
        for message in inbox:
            self._call_back(message)
        client.assets.call_back()
        return progressed

    def _drain_state(self) -> tuple[SceneState | None, bool]:
        messages = self._sockets.drain_state()
        local_ns = time.monotonic_ns()
        stream, clock = self._connection.stream, self._connection.clock
        state = stream.drain(messages, clock.session_ns(local_ns), local_ns)
        local_ns = time.monotonic_ns()
        if state is not None and not stream.check_fresh(local_ns):
            state = None
        if state is not None:
            now_ns = clock.session_ns(local_ns)  # decoding is part of the age
            state = SceneState(state.header, state.poses, now_ns, now_ns - state.header.session_time)
            self._client.scene.on_state(state)
            self._arrivals.record(state)
        return state, bool(messages)

    def _drain_control(self) -> bool:
        messages = self._sockets.drain_control()
        now_ns = time.monotonic_ns()  # after receiving: a pong stamped too early would understate its round trip
        for frames in messages:
            self._connection.receive(frames, now_ns)
        if self._connection.is_joined and self._connection.welcome is not None:
            self._client.scene.on_welcome()
            port, capabilities = self._connection.welcome.endpoints.state, self._connection.hello.capabilities
            self._sockets.open_state(port, self._generation, ROBOT_STATES in capabilities)
        return bool(messages)

    def _call_back(self, message: InboxMessage) -> None:
        client = self._client
        if isinstance(message, Event) and client.on_event is not None:
            client.on_event(message)
        elif isinstance(message, MissedEvents) and client.on_missed is not None:
            client.on_missed(message.first, message.last)
        elif isinstance(message, Feedback) and client.on_feedback is not None:
            client.on_feedback(message)
        elif isinstance(message, Reply) and client.on_denial is not None and message.denial is not None:
            client.on_denial(message.denial)

    def _raise_failure(self) -> None:
        if self._connection.failure is not None:
            raise self._connection.failure

    def _run(self) -> None:
        try:
            while not self._stopping:
                self.poll(0.1)
                with self.changed:
                    self.changed.notify_all()
        except BaseException as error:  # raised again in the calls that wait
            if not isinstance(error, ClientError):  # those are one line, raised in the calls that wait
                traceback.print_exception(error)
            with self.changed:
                self.crash = error
                self.changed.notify_all()
