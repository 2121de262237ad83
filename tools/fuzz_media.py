"""What `fuzz.py` gives to media: the decoders of both ends, and a real front's subscription and ingest ports."""

from __future__ import annotations

import time
from collections.abc import Callable
from random import Random
from typing import Any, Final

import zmq
from fuzz_decoders import Decoder
from fuzz_inputs import Corpus, encoded
from fuzz_machines import FrontControl

from iris_session.protocol import codec
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.media import CLASSES, MediaHeader, MediaPush, media_topic, parse_topic

#: What somebody honest publishes and watches all the while.
HONEST: Final = "honest"


def _topics(rng: Random) -> bytes:
    stream = rng.choice((HONEST, "cloud", "a", "x" * 48, "Ärger", "", "a/b"))
    return rng.choice((b"\1", b"\1", b"\0")) + media_topic(rng.choice((0, 1, 2, 7, 2**63, 10**30)), stream)


def _pushes(rng: Random) -> bytes:
    """As a source sends it, often enough for the hub to take it: stream names and classes of the protocol."""
    if rng.random() < 0.3:
        return encoded(rng, MediaPush)
    classes = tuple(rng.sample(CLASSES, rng.randrange(1, len(CLASSES))))
    push = MediaPush(rng.choice(("cloud", "a", f"s{rng.randrange(100)}", "")), 1, rng.getrandbits(40), classes)
    return codec.encode_media_push(push)


def _take_topic(data: bytes) -> None:
    if parse_topic(data[1:]) is None:
        raise ValueError


class FrontMedia(FrontControl):
    """The media ports of a real front: subscriptions to anything, frames of anything, in any number of parts.

    Every `BARRIER` inputs an honest viewer must get a frame that this session published after the last of them.
    """

    BARRIER: Final = 1000
    LIFE: Final = 300
    #: Frames are handed in faster than by any source: whoever is sent so many is sent fewer for seconds, by design.
    SETTINGS: Final = {"adapt_media": False}

    def __init__(self, rng: Random) -> None:
        super().__init__(rng)
        self._corpora = (Corpus(rng, [_topics]), Corpus(rng, [_pushes]))
        self._viewer = self.session.context.socket(zmq.SUB)
        self._viewer.linger = 0
        self._viewer.connect(f"tcp://127.0.0.1:{self.session.ports.media}")
        self._viewer.subscribe(media_topic(self._honest.epoch, HONEST))

    def make(self) -> bytes:
        """The first byte says which port it is for."""
        which = self._rng.randrange(2)
        return bytes((which,)) + self._corpora[which].damaged()

    def take(self, data: bytes) -> bool:
        rng = self._rng
        self._sent += 1
        which, data = data[0], data[1:]
        peer = self._media_peer(which, rng.randrange(self.PEERS))
        parts = [rng.randbytes(rng.choice((0, 1, 100, 5000))) for _ in range(rng.choice((0, 1, 1, 2, 3, 3, 40)))]
        deadline = time.monotonic() + 10.0
        while True:
            try:
                peer.send_multipart([data, *parts] if which else [data], zmq.DONTWAIT)
                break
            except zmq.Again:  # it is being cut off, or the front is busy
                assert time.monotonic() < deadline, "the front takes nothing"
                self._turn()
        if self._sent % 50 == 0:
            self._turn()
        if self._sent % self.BARRIER == 0:
            self._see()
            self._check()
        try:
            codec.decode_media_push(data) if which else _take_topic(data)
        except (ProtocolError, ValueError):
            return False
        return True

    def _media_peer(self, which: int, i: int) -> zmq.Socket[bytes]:
        i += which * self.PEERS
        while len(self._peers) <= i:
            self._peers.append(self._connected(len(self._peers)))
            self._lives.append(self.LIFE)
        self._lives[i] -= 1
        if self._lives[i] < 0:
            self._peers[i].close(linger=0)
            self._peers[i], self._lives[i] = self._connected(i), self.LIFE
        return self._peers[i]

    def _connected(self, i: int) -> zmq.Socket[bytes]:
        ports = self.session.ports
        kind, port = (zmq.XSUB, ports.media) if i < self.PEERS else (zmq.PUSH, ports.media_ingest)
        new = self.session.context.socket(kind)
        new.linger = 0
        new.sndhwm = 100
        new.connect(f"tcp://127.0.0.1:{port}")
        return new

    def _see(self) -> None:
        """The honest viewer gets a frame that is newer than everything before."""
        while self._viewer.poll(0):
            self._viewer.recv_multipart()
        deadline = time.monotonic() + 10.0
        while not self._viewer.poll(0):
            assert time.monotonic() < deadline, "the honest viewer gets nothing"
            now_ns = self.session.process.link.now_ns
            self.session.process.publish_media(HONEST, b"picture", now_ns, 1, "bytes")
            self._turn()
        topic, head, frame = self._viewer.recv_multipart()
        assert topic.startswith(media_topic(self._honest.epoch, HONEST)), topic
        assert codec.decode_media_header(head).stream == HONEST
        assert frame == b"picture"

    def _check(self) -> None:
        for i in range(self.PEERS):  # what they subscribed to, and need not be read
            while i < len(self._peers) and self._peers[i].poll(0):
                self._peers[i].recv_multipart()
        peers, self._peers = self._peers, []
        try:
            super()._check()
        finally:
            self._peers = peers

    def close(self) -> None:
        self._viewer.close(linger=0)
        super().close()


_OURS: Final = (ProtocolError,)
MEDIA_DECODERS: Final[dict[str, Callable[[Random], Any]]] = {
    "media-header": lambda rng: Decoder(rng, [lambda r: encoded(r, MediaHeader)], codec.decode_media_header, _OURS),
    "media-push": lambda rng: Decoder(rng, [_pushes], codec.decode_media_push, _OURS),
    "media-topic": lambda rng: Decoder(rng, [_topics], _take_topic, (ValueError,)),
}
MEDIA_MACHINES: Final[dict[str, Callable[[Random], Any]]] = {"front-media": FrontMedia}
