"""The media proxy: takes frames of sources, sends each subscriber the newest at its level. A thread of the front.

Its sockets have an I/O thread of their own, so that what media cost in encryption and copying delays neither control
nor state. Subscribers are told apart by their topic, which names their connection: what one link does not take is
dropped for that subscriber alone, and what somebody gets is decided here, not there.
"""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from typing import Any, Final

import zmq

from iris_session.front.media.connection_guard import MediaDoors
from iris_session.front.media.scheduler import MediaHub
from iris_session.protocol.codec import decode_media_push
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.media import CLASSES, parse_topic

#: While a connection is full it is tried again after so long; else somebody comes to wake us.
RETRY_MS: Final = 4
IDLE_MS: Final = 50
#: Messages taken of one socket before the others are looked at.
ROUND: Final = 16
#: Keys of sources that nobody has decided about yet.
MAX_ASKING: Final = 64
#: When memory runs short, nothing is taken for so long.
PAUSE_NS: Final = 2_000_000_000
#: After a fault of ours nothing is done for so long: one that comes back must not take a whole processor.
FAULT_S: Final = 0.25
_SUBSCRIBE: Final = 1


class MediaProxy:
    """`hub`, `sources` and `asking` belong to `lock`.

    `sources`: keys that may hand in frames (the empty one: who needs none). `asking`: keys that try to, and that nobody
    has decided about yet; `refused`: those that may not. `doors`, `back_doors`: of `out` and of `remote`.
    """

    def __init__(
        self,
        out: zmq.Socket[bytes],
        doors: MediaDoors,
        back_doors: MediaDoors,
        local: zmq.Socket[bytes] | None,
        remote: zmq.Socket[bytes],
        now_ns: Callable[[], int],
        *,
        encrypted: bool,
    ) -> None:
        self._out = out
        self._doors = doors
        self._back_doors = back_doors
        self._local = local
        self._remote = remote
        self._now_ns = now_ns
        self._encrypted = encrypted
        self._stopping = False
        self._said = ""
        self._thread = threading.Thread(target=self._run, name="iris-media", daemon=True)
        self.lock = threading.Lock()
        self.hub = MediaHub()
        self.sources: set[str] = set()
        self.asking: set[str] = set()
        self.refused: set[str] = set()

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def start(self) -> None:
        self._thread.start()

    def give_way(self) -> str:
        """Memory runs short: media are the first to go. What was closed; empty when there was nothing to be had."""
        with self.lock:
            return "all media for 2 s" if self.hub.give_way(self._now_ns() + PAUSE_NS) else ""

    def close(self) -> None:
        """Waits for the end of the thread; the sockets are free then."""
        self._stopping = True
        if self._thread.ident is not None:
            self._thread.join()
        self._doors.close()
        self._back_doors.close()
        for one in (self._out, self._local, self._remote):
            if one is not None:
                one.close(linger=0)

    def _run(self) -> None:
        while not self._stopping:
            try:
                self._serve()
            except Exception as error:  # a fault of ours: it costs what was under way, and media alone
                self._begin_anew(error)

    def _begin_anew(self, error: Exception) -> None:
        """Counts every fault, and tells each the first time in a row."""
        with self.lock:
            self.hub.begin_anew()
            self.hub.count("media_fault")
        if repr(error) != self._said:
            self._said = repr(error)
            text = f"iris-session: a fault in the media thread, which goes on: {self._said}\n"
            print(text + "".join(traceback.format_exception(error)), end="", file=sys.stderr, flush=True)
        time.sleep(FAULT_S)

    def _serve(self) -> None:
        poller = zmq.Poller()
        for one in (self._out, self._local, self._remote):
            if one is not None:
                poller.register(one, zmq.POLLIN)
        waits = False
        while not self._stopping:
            ready = dict(poller.poll(RETRY_MS if waits else IDLE_MS))
            self._come_and_gone()
            closed = [*self._doors.turn(self._now_ns()), *self._back_doors.turn(self._now_ns())]
            if self._out in ready:
                self._take_subscriptions()
            for one in (self._local, self._remote):
                if one is not None and one in ready:
                    self._take_frames(one)
            with self.lock:
                closed += [self._doors.close_one(fd, "media_memory") for fd in self.hub.take_stuck()]
                self._count(closed)
                waits = self.hub.flush(self._send, self._now_ns())

    def _come_and_gone(self) -> None:
        now_ns = self._now_ns()
        self._back_doors.read(now_ns)
        changed = self._doors.read(now_ns)
        if changed:
            with self.lock:
                for descriptor in changed:
                    self.hub.left(descriptor)

    def _count(self, reasons: Iterable[str]) -> None:
        for reason in filter(None, reasons):
            self.hub.count(reason)

    def _send(self, topic: bytes, header: bytes, frame: Any) -> bool:
        try:
            self._out.send_multipart((topic, header, frame), zmq.DONTWAIT, copy=False)
        except zmq.Again:
            return False
        return True

    # --- who wants what ----------------------------------------------------------------------------------------------

    def _take_subscriptions(self) -> None:
        for _ in range(ROUND):
            try:
                frame = self._out.recv(zmq.DONTWAIT, copy=False)
            except zmq.Again:
                return
            data = frame.bytes
            wanted = parse_topic(data[1:]) if data[:1] in (b"\0", b"\1") else None
            descriptor = _descriptor(frame)
            if descriptor < 0:
                continue  # libzmq takes back what a connection had that has ended: we noticed that end
            self._come_and_gone()
            user = self._user_of(frame)
            cut = self._doors.heard(descriptor, user, (len(data),), counts=True)
            with self.lock:
                if cut:
                    self.hub.count(cut)
                elif wanted is None:
                    self.hub.count("media_topic_unknown")
                elif data[0] != _SUBSCRIBE:
                    self.hub.unsubscribe(*wanted, descriptor)
                    self._out.setsockopt(zmq.UNSUBSCRIBE, data[1:])
                elif self.hub.subscribe(*wanted, user, descriptor):
                    self._out.setsockopt(zmq.SUBSCRIBE, data[1:])

    def _user_of(self, frame: zmq.Frame) -> str:
        return str(frame.get("User-Id")) if self._encrypted else ""

    # --- what comes in -----------------------------------------------------------------------------------------------

    def _take_frames(self, socket: zmq.Socket[bytes]) -> None:
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
                self._take_of_others(frames, lengths)
            else:
                self._take(frames, "")

    def _take_of_others(self, frames: list[zmq.Frame], lengths: list[int]) -> None:
        user = self._user_of(frames[0])
        with self.lock:
            welcome = not user or user in self.sources
            if not welcome:
                self.hub.count("media_source_refused" if user in self.refused else "media_source_undecided")
                if user not in self.refused and len(self.asking) < MAX_ASKING:
                    self.asking.add(user)
        self._back_doors.read(self._now_ns())
        cut = self._back_doors.heard(_descriptor(frames[0]), user, lengths, counts=not welcome)
        with self.lock:
            self._count((cut,))
        if welcome:
            self._take(frames, user)

    def _take(self, frames: list[zmq.Frame], user: str) -> None:
        try:
            push = decode_media_push(frames[0].buffer)
        except ProtocolError:
            push = None
        with self.lock:
            if push is None:
                self.hub.count("media_malformed")
            else:
                self.hub.push(push, frames[1:], user, self._now_ns())


def _descriptor(frame: zmq.Frame) -> int:
    """Of the TCP connection that it came by, -1 where libzmq does not tell."""
    try:
        return int(frame.get(zmq.SRCFD))
    except zmq.ZMQError:
        return -1
