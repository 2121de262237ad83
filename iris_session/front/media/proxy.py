"""The media proxy: takes frames of sources, sends each subscriber the newest at its level. A thread of the front.

Its sockets have an I/O thread of their own, so that what media cost in encryption and copying delays neither control
nor state. Subscribers are told apart by their topic, which names their connection: what one link does not take is
dropped for that subscriber alone, and what somebody gets is decided here, not there.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, Final

import zmq

from iris_session.front.connection_guard import ChannelGuard
from iris_session.front.media.scheduler import MediaScheduler
from iris_session.protocol.codec import decode_media_push
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.media import CLASSES, parse_topic

log = logging.getLogger(__name__)

#: While a connection is full it is tried again after so long; else somebody comes to wake us.
RETRY_MS: Final = 4
IDLE_MS: Final = 50
#: Messages taken of one socket before the others are looked at.
ROUND: Final = 16
#: Keys of sources that nobody has decided about yet.
MAX_UNDECIDED: Final = 64
#: When memory runs short, nothing is taken for so long.
PAUSE_NS: Final = 2_000_000_000
#: After a fault of ours nothing is done for so long: one that comes back must not take a whole processor.
FAULT_S: Final = 0.25
_SUBSCRIBE: Final = 1


class MediaProxy:
    """`hub`, `sources` and `asking` belong to `lock`.

    `sources`: keys that may hand in frames (the empty one: who needs none). `asking`: keys that try to, and that nobody
    has decided about yet; `refused`: those that may not. `guard`, `back_doors`: of `out` and of `remote`.
    """

    def __init__(
        self,
        out: zmq.Socket[bytes],
        subscriber_guard: ChannelGuard,
        source_guard: ChannelGuard,
        local: zmq.Socket[bytes] | None,
        remote: zmq.Socket[bytes],
        now_ns: Callable[[], int],
        *,
        encrypted: bool,
    ) -> None:
        self._out = out
        self._subscriber_guard = subscriber_guard
        self._source_guard = source_guard
        self._local = local
        self._remote = remote
        self._now_ns = now_ns
        self._encrypted = encrypted
        self._stopping = False
        self._reported_fault = ""
        self._thread = threading.Thread(target=self._run, name="iris-media", daemon=True)
        self.lock = threading.Lock()
        self.scheduler = MediaScheduler()
        self.sources: set[str] = set()
        self.undecided: set[str] = set()
        self.refused: set[str] = set()

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def start(self) -> None:
        self._thread.start()

    def release_memory(self) -> str:
        """Memory runs short: media are the first to go. What was closed; empty when there was nothing to be had."""
        with self.lock:
            return "all media for 2 s" if self.scheduler.release_frames(self._now_ns() + PAUSE_NS) else ""

    def close(self) -> None:
        """Waits for the end of the thread; the sockets are free then."""
        self._stopping = True
        if self._thread.ident is not None:
            self._thread.join()
        self._subscriber_guard.close()
        self._source_guard.close()
        for one in (self._out, self._local, self._remote):
            if one is not None:
                one.close(linger=0)

    def _run(self) -> None:
        while not self._stopping:
            try:
                self._serve()
            except Exception as error:  # a fault of ours: it costs what was under way, and media alone
                self._recover(error)

    def _recover(self, error: Exception) -> None:
        """Counts every fault, and tells each the first time in a row."""
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
            ready = dict(poller.poll(RETRY_MS if waits else IDLE_MS))
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
                waits = self.scheduler.flush(self._send, self._now_ns())

    def _read_connection_events(self) -> None:
        now_ns = self._now_ns()
        self._source_guard.read_events(now_ns)
        changed = self._subscriber_guard.read_events(now_ns)
        if changed:
            with self.lock:
                for descriptor in changed:
                    self.scheduler.remove_reader(descriptor)

    def _count_reasons(self, reasons: Iterable[str]) -> None:
        for reason in filter(None, reasons):
            self.scheduler.count_drop(reason)

    def _send(self, topic: bytes, header: bytes, frame: Any) -> bool:
        try:
            self._out.send_multipart((topic, header, frame), zmq.DONTWAIT, copy=False)
        except zmq.Again:
            return False
        return True

    # --- who wants what ----------------------------------------------------------------------------------------------

    def _receive_subscriptions(self) -> None:
        for _ in range(ROUND):
            try:
                frame = self._out.recv(zmq.DONTWAIT, copy=False)
            except zmq.Again:
                return
            data = frame.bytes
            wanted = parse_topic(data[1:]) if data[:1] in (b"\0", b"\1") else None
            descriptor = _read_descriptor(frame)
            if descriptor < 0:
                continue  # libzmq takes back what a connection had that has ended: we noticed that end
            self._read_connection_events()
            user = self._read_user_id(frame)
            cut = self._subscriber_guard.record_message(descriptor, user, (len(data),), counts=True)
            with self.lock:
                if cut:
                    self.scheduler.count_drop(cut)
                elif wanted is None:
                    self.scheduler.count_drop("media_topic_unknown")
                elif data[0] != _SUBSCRIBE:
                    self.scheduler.unsubscribe(*wanted, descriptor)
                    self._out.setsockopt(zmq.UNSUBSCRIBE, data[1:])
                elif self.scheduler.subscribe(*wanted, user, descriptor):
                    self._out.setsockopt(zmq.SUBSCRIBE, data[1:])

    def _read_user_id(self, frame: zmq.Frame) -> str:
        return str(frame.get("User-Id")) if self._encrypted else ""

    # --- what comes in -----------------------------------------------------------------------------------------------

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
                self._push_frames(frames, "")

    def _handle_remote_frames(self, frames: list[zmq.Frame], lengths: list[int]) -> None:
        user = self._read_user_id(frames[0])
        with self.lock:
            welcome = not user or user in self.sources
            if not welcome:
                self.scheduler.count_drop("media_source_refused" if user in self.refused else "media_source_undecided")
                if user not in self.refused and len(self.undecided) < MAX_UNDECIDED:
                    self.undecided.add(user)
        self._source_guard.read_events(self._now_ns())
        cut = self._source_guard.record_message(_read_descriptor(frames[0]), user, lengths, counts=not welcome)
        with self.lock:
            self._count_reasons((cut,))
        if welcome:
            self._push_frames(frames, user)

    def _push_frames(self, frames: list[zmq.Frame], user: str) -> None:
        try:
            push = decode_media_push(frames[0].buffer)
        except ProtocolError:
            push = None
        with self.lock:
            if push is None:
                self.scheduler.count_drop("media_malformed")
            else:
                self.scheduler.push(push, frames[1:], user, self._now_ns())


def _read_descriptor(frame: zmq.Frame) -> int:
    """Of the TCP connection that it came by, -1 where libzmq does not tell."""
    try:
        return int(frame.get(zmq.SRCFD))
    except zmq.ZMQError:
        return -1
