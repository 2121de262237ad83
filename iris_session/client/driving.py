"""What drives a client: `poll`, and the thread of `start`. State first, then control, timers, sending, callbacks."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from typing import Self

import zmq

from iris_session.client.assets import Assets
from iris_session.client.core.receiving import InboxMessage
from iris_session.client.core.state_stream import SceneState
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.errors import ClientError, NotConnectedError
from iris_session.client.group import to_milliseconds
from iris_session.client.joining import Joining
from iris_session.client.media import Media
from iris_session.client.reporting import ArrivalMeter
from iris_session.client.scene import SceneView
from iris_session.protocol.common import Denial
from iris_session.protocol.server_messages import Event, Feedback, Reply
from iris_session.protocol.session_mirror import Missed

DEFAULT_TIMEOUT_S = 5.0


class Driving(SceneView, Media, Assets, Joining):
    """Part of `Client`."""

    on_state: Callable[[SceneState], None] | None
    on_event: Callable[[Event], None] | None
    on_missed: Callable[[int, int], None] | None
    on_feedback: Callable[[Feedback], None] | None
    on_denial: Callable[[Denial], None] | None
    feedback: dict[str, Feedback]
    _state: SceneState | None
    _session_id: str
    _arrivals: ArrivalMeter
    _generation: int
    _lock: threading.RLock
    _changed: threading.Condition
    _thread: threading.Thread | None
    _stopping: bool
    _crash: BaseException | None
    _looked: bool = False

    def poll(self, timeout_s: float = 0.0) -> bool:
        """Receives, answers, keeps the connection alive. Waits up to `timeout_s` for something to come.

        True when anything came or the connection's phase changed. Raises `RefusedError` after the session refused us
        for good.
        """
        if not self._polls_here:
            raise ClientError("poll() while the thread of start() polls: use wait_for(), callbacks and attributes")
        deadline = time.monotonic_ns() + int(timeout_s * 1e9)
        # A scene that loads brings something every moment: each time once is enough, what came since ends the wait.
        looked = self._looked and timeout_s > 0.0
        while True:
            progressed = not looked and self._pump()
            self._looked = progressed and self.connection.is_joined and self._loads_assets
            looked = False
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
        if self.connection.phase is ConnectionPhase.CLOSED:
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
            if self.connection.phase is ConnectionPhase.CLOSED:
                raise NotConnectedError(self.connection.describe())
            phase = self.connection.phase
            if self._workers is not None:
                self._sockets.clear_wake()  # before what it was for is looked at: a later one is not lost
            self._step_meeting()
        progressed = self.poll_state()
        with self._lock:
            gone = self._sockets.poll_disconnect() and self._generation == self.connection.generation
            progressed |= self._drain_control()  # the last words of a session before its end
            if gone and self._generation == self.connection.generation:
                self.connection.handle_disconnect(time.monotonic_ns())
            self._look_who_answered()
            self.connection.tick(time.monotonic_ns())
            report = self._arrivals.poll_report(self.connection, time.monotonic_ns())
            if report is not None:
                self.connection.send(self._with_media(report, time.monotonic_ns()))
            self._flush()
            progressed |= self._tend_media()
            progressed |= self._tend_assets()
            if self.connection.phase is ConnectionPhase.REFUSED:
                self._sockets.disconnect()
            progressed |= self.connection.phase is not phase
            inbox = [self.connection.inbox.popleft() for _ in range(len(self.connection.inbox))]
            for message in inbox:
                if isinstance(message, Feedback):
                    self.feedback[message.robot] = message
            if self.feedback and not self.connection.is_joined:
                self.feedback = {}  # nobody tells what the robots do now
        for message in inbox:
            self._call_back(message)
        self._call_back_assets()
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
            self._state = state
            self._arrivals.record(state)
        return state, bool(messages)

    def _drain_control(self) -> bool:
        messages = self._sockets.drain_control()
        now_ns = time.monotonic_ns()  # after receiving: a pong stamped too early would understate its round trip
        for frames in messages:
            self.connection.receive(frames, now_ns)
        if self.connection.is_joined and self.connection.welcome is not None:
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

    def _call_back(self, message: InboxMessage) -> None:
        if isinstance(message, Event) and self.on_event is not None:
            self.on_event(message)
        elif isinstance(message, Missed) and self.on_missed is not None:
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
        except BaseException as error:  # whatever ends the thread is raised where somebody waits
            if not isinstance(error, ClientError):  # those say what happened in one line, where somebody waits
                traceback.print_exception(error)
            with self._changed:
                self._crash = error
                self._changed.notify_all()
