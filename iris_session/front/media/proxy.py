"""The media proxy: receives frames of sources and sends each subscriber the newest at its level. A thread of the front.

Its sockets have an I/O thread of their own, so that encrypting and copying media delays neither control nor state.
Subscribers have topics of their own, which name their connection: a frame that one link has no room for is dropped for
that subscriber alone, and levels are decided here instead of by the subscriber. The levels come from `service`.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, Final

import zmq

from iris_session.front.media.recorder import MediaRecorder
from iris_session.front.media.scheduler import LOCAL, MediaScheduler
from iris_session.link.sockets import read_peer
from iris_session.link.tcp_guard import PendingConnection, TcpFlood, TcpGuard
from iris_session.protocol.codec import decode_media_push
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.media import CLASSES, parse_topic

log = logging.getLogger(__name__)

#: Retry period while a connection is full; otherwise a message wakes the thread.
RETRY_MS: Final = 4
IDLE_MS: Final = 50
#: Messages read of one socket per pass.
ROUND: Final = 16
#: When memory is short, frames are dropped for so long.
PAUSE_NS: Final = 2_000_000_000
#: Pause after a fault of the proxy: a repeated fault must not use a whole processor.
FAULT_S: Final = 0.25
#: A subscription to a topic that does not exist counts as so many: libzmq keeps it as long as the connection lives.
UNKNOWN_TOPIC_WEIGHT: Final = 64
_SUBSCRIBE: Final = 1
_SUBSCRIPTIONS: Final = (b"\0", b"\1")


class MediaProxy:
    """Receive, schedule and send media in a thread.

    Attributes:
        lock: Protects all attributes below.
        scheduler: Streams, subscriptions and due frames.
        is_source: Returns whether a key may hand in frames; called by the thread. Without encryption every source may.

    Args:
        out: XPUB socket of the subscribers.
        subscriber_guard: Guards `out`.
        source_guard: Guards `remote`.
        local: Socket for frames of this machine's processes.
        remote: Socket for frames of other machines.
        now_ns: Returns session time.
        encrypted: Whether subscribers and remote sources have keys.
        recorder: Sends clouds and pictures to the recorder, `None` when they are not recorded.
    """

    def __init__(
        self,
        out: zmq.Socket[bytes],
        subscriber_guard: TcpGuard,
        source_guard: TcpGuard,
        local: zmq.Socket[bytes] | None,
        remote: zmq.Socket[bytes],
        now_ns: Callable[[], int],
        *,
        encrypted: bool,
        recorder: MediaRecorder | None = None,
    ) -> None:
        self._out = out
        self._subscriber_guard = subscriber_guard
        self._source_guard = source_guard
        self._local = local
        self._remote = remote
        self._now_ns = now_ns
        self._encrypted = encrypted
        self._recorder = recorder
        self._stopping = False
        self._order_lost = False
        self._reported_fault = ""
        self._thread = threading.Thread(target=self._run, name="iris-media", daemon=True)
        self.lock = threading.Lock()
        self.scheduler = MediaScheduler()
        self.is_source: Callable[[str], bool] = lambda _key: True

    def start(self) -> None:
        self._thread.start()

    def release_memory(self) -> str:
        """Release all frames because memory is short. Return what was released, empty if there was nothing."""
        with self.lock:
            return "all media for 2 s" if self.scheduler.release_frames(self._now_ns() + PAUSE_NS) else ""

    def list_pending(self) -> list[PendingConnection]:
        """Return the connections of subscribers and sources and what is unread of them."""
        return [*self._subscriber_guard.list_pending(), *self._source_guard.list_pending()]

    def pop_floods(self) -> list[TcpFlood]:
        """Return the connections of sources that were closed for a flood since the last call."""
        return self._source_guard.pop_floods()

    def close(self) -> None:
        """Wait for the end of the thread, then close the sockets."""
        self._stopping = True
        if self._thread.ident is not None:
            self._thread.join()
        self._subscriber_guard.close()
        self._source_guard.close()
        for one in (self._out, self._local, self._remote):
            if one is not None:
                one.close(linger=0)
        if self._recorder is not None:
            self._recorder.close()

    def _run(self) -> None:
        while not self._stopping:
            try:
                self._serve()
            except Exception as error:  # a fault of the proxy costs frames under way, and affects media alone
                self._recover(error)

    def _recover(self, error: Exception) -> None:
        """Count a fault, and log it unless it repeats the last one."""
        with self.lock:
            self.scheduler.reset()
            self.scheduler.count_drop("media_fault")
        if repr(error) != self._reported_fault:
            self._reported_fault = repr(error)
            log.error("fault in the thread of media, which continues: %s", self._reported_fault, exc_info=error)
        time.sleep(FAULT_S)

    def _serve(self) -> None:
        poller = zmq.Poller()
        for one in (self._out, self._local, self._remote):
            if one is not None:
                poller.register(one, zmq.POLLIN)
        waits = False
        while not self._stopping:
            ready = dict(poller.poll(RETRY_MS if waits or self._source_guard.has_unread else IDLE_MS))
            self._read_connection_events()
            closed = [*self._subscriber_guard.tick(self._now_ns()), *self._source_guard.tick(self._now_ns())]
            if self._out in ready:
                self._receive_subscriptions()
            for one in (self._local, self._remote):
                if one is not None and one in ready:
                    self._receive_frames(one)
            with self.lock:
                closed += [self._subscriber_guard.evict(fd, "media_memory") for fd in self.scheduler.pop_stuck()]
                self._count_reasons(closed)
                for descriptor, bytes_per_s in self.scheduler.pop_paces().items():
                    self._subscriber_guard.pace(descriptor, bytes_per_s)
                waits = self.scheduler.flush(self._send, self._now_ns())
                if self._recorder is not None:
                    self._recorder.tick(self.scheduler, self._now_ns())

    def _read_connection_events(self) -> None:
        now_ns = self._now_ns()
        sources, readers = self._source_guard.read_events(now_ns), self._subscriber_guard.read_events(now_ns)
        if sources or readers:
            with self.lock:
                for event in sources:
                    self.scheduler.release_streams(event.descriptor)
                for event in readers:
                    self.scheduler.remove_reader(event.descriptor)

    def _count_reasons(self, reasons: Iterable[str]) -> None:
        for reason in filter(None, reasons):
            self.scheduler.count_drop(reason)

    def _send(self, topic: bytes, header: bytes, frame: Any) -> bool:
        try:
            self._out.send_multipart((topic, header, frame), zmq.DONTWAIT, copy=False)
        except zmq.Again:
            return False
        return True

    # --- subscriptions -----------------------------------------------------------------------------------------------

    def _receive_subscriptions(self) -> None:
        """Apply subscriptions.

        libzmq applies one to the connection that it believes the last message came from. A message that is none, which
        no client sends, shifts that by one connection until its queue is empty (4.3.5, `xpub_t::xrecv`): subscribers
        would get the frames of others. So what follows such a message is not applied; its senders are disconnected, and
        subscribe again when they reconnect.
        """
        for _ in range(ROUND):
            try:
                frame = self._out.recv(zmq.DONTWAIT, copy=False)
            except zmq.Again:
                self._order_lost = False
                return
            data = frame.bytes
            is_subscription = data[:1] in _SUBSCRIPTIONS
            self._order_lost |= not is_subscription
            descriptor, user = read_peer(frame, encrypted=self._encrypted)
            if descriptor < 0:
                continue  # libzmq unsubscribes a connection that has ended: its monitor reported that
            self._read_connection_events()
            if not is_subscription:
                weight = 1 + self._subscriber_guard.bounds.counted_messages
            else:
                weight = 1 if parse_topic(data[1:]) is not None else UNKNOWN_TOPIC_WEIGHT
            self._subscriber_guard.establish(descriptor, user)
            cut = self._subscriber_guard.record_message(descriptor, (len(data),), weight)
            if is_subscription and self._order_lost and not cut:
                cut = self._subscriber_guard.evict(descriptor, "media_order_lost")
            with self.lock:
                if cut or self._order_lost:
                    self._count_reasons((cut,))
                else:
                    self._apply_subscription(data, user, descriptor)

    def _apply_subscription(self, data: bytes, user: str, descriptor: int) -> None:
        """Apply the last message that was received, a subscription or its end. The lock is held."""
        topic = parse_topic(data[1:])
        if topic is None:
            self.scheduler.count_drop("media_topic_unknown")
        elif data[0] != _SUBSCRIBE:
            self.scheduler.unsubscribe(*topic, descriptor)
            self._out.setsockopt(zmq.UNSUBSCRIBE, data[1:])
        elif self.scheduler.subscribe(*topic, user, descriptor, self._now_ns()):
            self._out.setsockopt(zmq.SUBSCRIBE, data[1:])

    # --- frames ------------------------------------------------------------------------------------------------------

    def _receive_frames(self, socket: zmq.Socket[bytes]) -> None:
        for _ in range(ROUND):
            try:
                frame = socket.recv(zmq.DONTWAIT, copy=False)
            except zmq.Again:
                return
            frames, lengths = [frame], [len(frame)]
            while frame.more:
                frame = socket.recv(zmq.DONTWAIT, copy=False)
                lengths.append(len(frame))
                if len(frames) <= len(CLASSES):
                    frames.append(frame)
            if socket is self._remote:
                self._handle_remote_frames(frames, lengths)
            else:
                self._push_frames(frames, "", LOCAL)

    def _handle_remote_frames(self, frames: list[zmq.Frame], lengths: list[int]) -> None:
        descriptor, user = read_peer(frames[0], encrypted=self._encrypted)
        allowed = not user or self.is_source(user)
        self._read_connection_events()
        self._source_guard.establish(descriptor, user)
        cut = self._source_guard.record_message(descriptor, lengths, int(not allowed))
        with self.lock:
            self._count_reasons((cut, "" if allowed else "media_source_refused"))
        if allowed:
            self._push_frames(frames, user, descriptor if self._source_guard.find(descriptor) else None)

    def _push_frames(self, frames: list[zmq.Frame], user: str, connection: int | None) -> None:
        try:
            push = decode_media_push(frames[0].buffer)
        except ProtocolError:
            push = None
        with self.lock:
            if push is None:
                self.scheduler.count_drop("media_malformed")
            else:
                self.scheduler.push(push, frames[1:], user, self._now_ns(), connection)
