"""Conversations of `fuzz.py`: a client's connection, state stream and asset loader, a real front, and the core.

Each target keeps its state over many inputs, so a finding is reproduced by seed and number, not by its bytes alone.
"""

from __future__ import annotations

import socket
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random
from typing import Any, Final

import msgspec
import numpy as np
import psutil
import zmq
from fuzz_decoders import (
    HONEST,
    PICTURE,
    Corpus,
    asset_address,
    check_media_topic,
    client_messages,
    encoded,
    make_asset_request,
    make_media_push,
    make_media_topic,
    rigid_frames,
    server_messages,
)

from iris_session.client.core.asset_loader import WINDOW_BYTES, WINDOW_REQUESTS, AssetLoader, ChunkRequest
from iris_session.client.core.connection import MAX_INBOX, ClientConnection
from iris_session.client.core.state_stream import StateStream
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.identity import Identity
from iris_session.link import FrontLimits
from iris_session.protocol import codec
from iris_session.protocol.assets import MAX_ASSET_CHUNK_BYTES, AssetChunk, AssetRefused, AssetRequest
from iris_session.protocol.client_messages import ClientEnvelope, ClockPing, EStop, Hello, Marker, Sample, wrap_message
from iris_session.protocol.codec import (
    CLIENT_TYPES,
    decode_client,
    decode_server,
    encode_client,
    encode_server,
    peek_on_behalf_of,
)
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.limits import KeyLimits
from iris_session.protocol.media import make_topic
from iris_session.protocol.names import PROTOCOL_VERSION, AssetRefusal
from iris_session.protocol.server_messages import (
    TOPIC_PRESENCE,
    TOPIC_RIGID,
    ClockPong,
    Endpoints,
    Presence,
    ServerEnvelope,
    StateHeader,
    Welcome,
)
from iris_session.web import wire
from iris_session.web.hub import Hub, HubLimits

# --- client, front and core -------------------------------------------------------------------------------------------


ROOT: Final = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # the harness and the random entries are those of the tests
MS: Final = 1_000_000


class HostileSession:
    """Client connection that talks to a hostile session; some of its welcomes are valid."""

    def __init__(self, rng: Random) -> None:
        self._rng = rng
        self._corpus = Corpus(rng, server_messages())
        self._now_ns = 10**12
        self._left = 0

    def make(self) -> bytes:
        if not self._left:
            self._left = self._rng.choice((20, 300))
            self.connection = ClientConnection(Hello("operator", "Ann"), Identity(b"s" * 16))
            self.connection.open(self._now_ns)
        self._left -= 1
        rng, connection = self._rng, self.connection
        if connection.phase is ConnectionPhase.JOINING and rng.random() < 0.3:
            welcome = Welcome(
                "s", "lab", "live", "p1", 7, "operator", b"t" * 16, False, 0, 500 * MS, 2 * MS, 16 * MS, Endpoints(1, 2)
            )
            return encode_server(ServerEnvelope(PROTOCOL_VERSION, 7, welcome))
        if connection.is_joined and rng.random() < 0.05:
            return encode_server(ServerEnvelope(PROTOCOL_VERSION, 7, ClockPong(self._now_ns - MS, 0, 0)))
        return self._corpus.damaged()

    def feed(self, data: bytes) -> bool:
        rng, connection = self._rng, self.connection
        malformed = connection.counters.malformed
        bulk = [rng.randbytes(rng.choice((0, 56, 57, 112)))] if rng.random() < 0.3 else []
        connection.receive([data, *bulk], self._now_ns)
        self._now_ns += rng.choice((0, 1, 20, 3000)) * MS
        connection.tick(self._now_ns)
        assert connection.next_deadline_ns(self._now_ns) > 0
        if rng.random() < 0.1 and connection.is_joined:
            connection.send(Sample("head", "pose", 1, 0, 0, 0, 0, pose=IDENTITY))
            connection.request(Marker(0, "x"))
        while (waiting := connection.peek_outgoing()) is not None:
            decode_client(waiting[1])
            connection.pop_outgoing(sent=rng.random() < 0.9)
        assert len(connection.inbox) <= MAX_INBOX
        if rng.random() < 0.01:
            connection.inbox.clear()
            connection.describe()
        return connection.counters.malformed == malformed

    def close(self) -> None:
        """Nothing to close."""


class ClientState:
    """State stream of a client that receives from a hostile session."""

    def __init__(self, rng: Random) -> None:
        self._rng = rng
        frames = rigid_frames(7)
        self._rigid = Corpus(rng, [lambda rng: frames(rng)[16:]])
        self._headers = Corpus(rng, [lambda rng: encoded(rng, StateHeader)])
        self._presence = Corpus(rng, [lambda rng: encoded(rng, Presence)])
        self._now_ns = 10**12
        self.stream = StateStream()

    def make(self) -> bytes:
        rng = self._rng
        if rng.random() < 0.3:
            frames = [TOPIC_PRESENCE, self._presence.damaged()]
        else:
            header = self._headers.damaged()
            if rng.random() < 0.5:
                seq = rng.randrange(1, 1000)
                header = msgspec.msgpack.encode(
                    StateHeader(0, 0, 0, 0.0, self._now_ns, self._now_ns, seq, rng.randrange(seq))
                )
            frames = [TOPIC_RIGID, header, self._rigid.damaged()]
        if not rng.randrange(50):
            frames = rng.choice(([b""], [TOPIC_RIGID], [b"x", b"y"], [*frames, b"more"]))
        return msgspec.msgpack.encode(frames)

    def feed(self, data: bytes) -> bool:
        rng, stream = self._rng, self.stream
        if not rng.randrange(100):
            stream.reset()
            stream.load_keyframe(0, np.zeros((7, 7)))
        malformed = stream.counters.malformed
        self._now_ns += 16 * MS
        stream.drain([msgspec.msgpack.decode(data)], self._now_ns, self._now_ns)
        if rng.random() < 0.1:
            len(stream.presence)
        return stream.counters.malformed == malformed

    def close(self) -> None:
        """Nothing to close."""


class FrontControl:
    """Control port of a real front process. Peers send hello, and then any messages, intact or damaged.

    Every `BARRIER` inputs an honest client sends a ping: the front must answer, and stay within its memory limit.
    """

    BARRIER: Final = 2000
    PEERS: Final = 8
    #: Inputs of one peer before a new one replaces it.
    LIFE: Final = 400
    #: Further settings of the front.
    SETTINGS: Final[Mapping[str, Any]] = {}

    def __init__(self, rng: Random) -> None:
        from tests.front.process_harness import ProcessSession

        self._rng = rng
        many = dict.fromkeys(("messages", "requests", "events", "handshakes", "estops"), 10**6)
        bursts = {name[:-1] + "_burst": 10**6 for name in many}
        key = KeyLimits(connections=1000, bytes=1e9, byte_burst=10**9, **many, **bursts)
        limits = FrontLimits(hellos_per_second=1e4, hello_burst=10_000, excess_per_s=1e6, excess_burst=10**6, key=key)
        self.session = ProcessSession(limits=limits, silence_ns=10**12, **self.SETTINGS)
        self.process = psutil.Process(self.session.process.pid)
        self._corpus = Corpus(rng, client_messages())
        self._peers: list[zmq.Socket[bytes]] = []
        self._lives: list[int] = []
        self._honest = self.session.client()
        self._honest.join()
        self._sent = 0
        self._newest = 1
        self.base = self.process.memory_info().rss
        self.peak = self.base
        self.types: set[str] = set()

    def make(self) -> bytes:
        return self._corpus.damaged()

    def feed(self, data: bytes) -> bool:
        """Send an input. Return whether the protocol passes it to the front's state machine."""
        rng = self._rng
        self._sent += 1
        peer = self._peer(rng.randrange(self.PEERS))
        try:
            accepted = decode_client(data)
        except ProtocolError:
            accepted = None
        else:
            self.types.add(str(accepted.message.__struct_config__.tag))
            if rng.random() < 0.7:  # as a peer that knows its connection epoch
                data = encode_client(msgspec.structs.replace(accepted, connection_epoch=self._newest))
        extra = [b"extra"] if not rng.randrange(200) else []
        deadline = time.monotonic() + 10.0
        while True:
            try:
                peer.send_multipart([data, *extra], zmq.DONTWAIT)
                break
            except zmq.Again:
                assert time.monotonic() < deadline, "the front accepts nothing"
                self._poll_session()
        if self._sent % 50 == 0:
            self._poll_session()
            self._newest = max((self._newest, *(entry.connection for entry in self.session.entries)))
            self.session.entries.clear()
        if self._sent % self.BARRIER == 0:
            self._check()
        return accepted is not None

    def _poll_session(self) -> None:
        """Poll the session, and check that the front was not replaced."""
        self.session.once()
        assert self.session.process.pid == self.process.pid, "the front ended"

    def _peer(self, i: int) -> zmq.Socket[bytes]:
        if i < len(self._peers) and self._lives[i] > 0:
            self._lives[i] -= 1
            return self._peers[i]
        new = self.session.context.socket(zmq.DEALER)
        new.linger = 0
        new.sndhwm = 100
        new.connect(f"tcp://{self.session.host}:{self.session.ports.control}")
        if self._rng.random() < 0.9:
            new.send(encode_client(wrap_message(Hello("operator", "Ann", secret=self._rng.randbytes(16)))))
        if i < len(self._peers):
            self._peers[i].close(linger=0)
            self._peers[i], self._lives[i] = new, self.LIFE
        else:
            i = len(self._peers)
            self._peers.append(new)
            self._lives.append(self.LIFE)
        return self._peers[i]

    def _check(self) -> None:
        for peer in self._peers:
            while peer.poll(0):
                decode_server(peer.recv_multipart()[0])
        honest = self._honest
        honest.inbox.clear()
        honest.send(ClockPing(self._sent))
        honest.wait_for(ClockPong)
        self._poll_session()
        rss = self.process.memory_info().rss
        self.peak = max(self.peak, rss)
        assert rss - self.base < self.session.config.limits.memory_bytes, f"the front holds {rss >> 20} MiB"

    def close(self) -> None:
        for peer in self._peers:
            peer.close(linger=0)
        self.session.close()


def _zmtp(rng: Random) -> bytes:
    """Return the bytes of a ZeroMQ peer: greeting, READY, a message. Mechanism NULL or CURVE."""
    mechanism = rng.choice((b"NULL", b"CURVE", b"PLAIN"))
    greeting = (
        b"\xff" + bytes(8) + b"\x7f\x03" + rng.choice((b"\x00", b"\x01")) + mechanism.ljust(20, b"\0") + bytes(32)
    )
    ready = b"\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER"
    if mechanism == b"CURVE":
        ready = b"\x05HELLO\x01\x00" + bytes(72) + rng.randbytes(120)
    body = encode_client(ClientEnvelope(PROTOCOL_VERSION, 0, "", EStop()))
    return greeting + b"\x04" + bytes((len(ready),)) + ready + b"\x00" + bytes((len(body),)) + body


class FrontTcp(FrontControl):
    """TCP bytes on the ports of control, state and introduction: partial and damaged handshakes."""

    BARRIER: Final = 1000

    def __init__(self, rng: Random) -> None:
        super().__init__(rng)
        self._corpus = Corpus(rng, [_zmtp])
        self._open: list[socket.socket] = []

    def feed(self, data: bytes) -> bool:
        rng, ports = self._rng, self.session.ports
        self._sent += 1
        port = rng.choice((ports.control, ports.control, ports.state, ports.control - 1))
        one = socket.socket()
        one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # leaves no port in TIME_WAIT
        one.settimeout(5.0)
        one.connect((self.session.host, port))
        try:
            one.sendall(data)
        except OSError:
            one.close()  # the connection was refused before all was sent
            return False
        self._open.append(one)
        if len(self._open) > 64:
            self._open.pop(rng.randrange(64)).close()
        if self._sent % self.BARRIER == 0:
            self._check()
        return True

    def close(self) -> None:
        for one in self._open:
            one.close()
        super().close()


class Core:
    """Authority, control and physics under random entries that the schema accepts: `tests/session/fuzz_core.py`."""

    def __init__(self, rng: Random) -> None:
        from tests.session.fuzz_core import Fuzz

        self._fuzz = Fuzz(rng.getrandbits(32))
        self._given = 0

    def make(self) -> bytes:
        return b""

    def feed(self, data: bytes) -> bool:
        """Step the core. One entry is one input: a step gets several, sometimes many."""
        if self._given > 0:
            self._given -= 1
            return True
        rng = self._fuzz.rng
        n = rng.choice([1, 3, 20, 400]) if rng.random() < 0.1 else rng.randrange(4)
        self._fuzz.step(n)
        self._given = n - 1
        return True

    def close(self) -> None:
        """Nothing to close."""


# --- media ports ------------------------------------------------------------------------------------------------------


class FrontMedia(FrontControl):
    """Media ports of a real front: any subscriptions, and any frames in any number of parts.

    Every `BARRIER` inputs an honest viewer must get a frame that the session published after the last of them.
    """

    BARRIER: Final = 1000
    LIFE: Final = 300
    #: Frames are published faster than by any source; adaptive delivery would reduce them for seconds, by design.
    SETTINGS: Final = {"adapt_media": False}

    def __init__(self, rng: Random) -> None:
        super().__init__(rng)
        self._corpora = (Corpus(rng, [make_media_topic]), Corpus(rng, [make_media_push]))
        self._viewer = self.session.context.socket(zmq.SUB)
        self._viewer.linger = 0
        self._viewer.connect(f"tcp://{self.session.host}:{self.session.ports.media}")
        self._viewer.subscribe(make_topic(self._honest.epoch, HONEST))

    def make(self) -> bytes:
        """Return an input; its first byte selects the port."""
        which = self._rng.randrange(2)
        return bytes((which,)) + self._corpora[which].damaged()

    def feed(self, data: bytes) -> bool:
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
            except zmq.Again:  # the peer is being disconnected, or the front is busy
                assert time.monotonic() < deadline, "the front accepts nothing"
                self._poll_session()
        if self._sent % 50 == 0:
            self._poll_session()
        if self._sent % self.BARRIER == 0:
            self._check_viewer()
            self._check()
        try:
            codec.decode_media_push(data) if which else check_media_topic(data)
        except (ProtocolError, ValueError):
            return False
        return True

    def _media_peer(self, which: int, i: int) -> zmq.Socket[bytes]:
        i += which * self.PEERS
        while len(self._peers) <= i:
            self._peers.append(self._connect(len(self._peers)))
            self._lives.append(self.LIFE)
        self._lives[i] -= 1
        if self._lives[i] < 0:
            self._peers[i].close(linger=0)
            self._peers[i], self._lives[i] = self._connect(i), self.LIFE
        return self._peers[i]

    def _connect(self, i: int) -> zmq.Socket[bytes]:
        ports = self.session.ports
        kind, port = (zmq.XSUB, ports.media) if i < self.PEERS else (zmq.PUSH, ports.media_ingest)
        new = self.session.context.socket(kind)
        new.linger = 0
        new.sndhwm = 100
        new.connect(f"tcp://{self.session.host}:{port}")
        return new

    def _check_viewer(self) -> None:
        """Check that the honest viewer gets a frame that is newer than all before."""
        while self._viewer.poll(0):
            self._viewer.recv_multipart()
        deadline = time.monotonic() + 10.0
        while not self._viewer.poll(0):
            assert time.monotonic() < deadline, "the honest viewer receives nothing"
            now_ns = self.session.process.link.now_ns
            self.session.process.publish_media(HONEST, b"picture", now_ns, 1, "bytes")
            self._poll_session()
        topic, head, frame = self._viewer.recv_multipart()
        assert topic.startswith(make_topic(self._honest.epoch, HONEST)), topic
        assert codec.decode_media_header(head).stream == HONEST
        assert frame == b"picture"

    def _check(self) -> None:
        for i in range(self.PEERS):  # discard what they subscribed to
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


# --- asset loader and asset port --------------------------------------------------------------------------------------


_REASONS: Final = ("unknown_asset", "bad_range", "busy", "rate", "too_many_outstanding", "not_allowed", "of_tomorrow")


class LoaderMachine:
    """Asset loader of a client whose session sends arbitrary answers."""

    def __init__(self, rng: Random) -> None:
        self._rng = rng
        self._loader = AssetLoader()
        self._asks: list[ChunkRequest] = []
        self._unstored = 0
        self._now_ns = 0

    def make(self) -> bytes:
        rng, asked = self._rng, self._rng.choice(self._asks) if self._asks and self._rng.random() < 0.8 else None
        number = rng.getrandbits(8) if asked is None else asked.request_id
        address = rng.choice(("a", "b", "zz")) if asked is None or rng.random() < 0.05 else asked.address
        if rng.random() < 0.2:
            return codec.encode_asset_header(AssetRefused(1, number, address, rng.choice(_REASONS)))
        offset = asked.offset if asked is not None and rng.random() < 0.9 else rng.choice((0, 5, 2**62))
        total = rng.choice((10, 2_000_000, 2**62))
        return codec.encode_asset_header(AssetChunk(1, number, address, offset, total))

    def feed(self, data: bytes) -> bool:
        rng, loader = self._rng, self._loader
        self._now_ns += rng.choice((0, 1_000_000, 3_000_000_000))
        try:
            taken = self._answer(data)
        except ProtocolError:
            taken = False
        loader.add(rng.choice("abcdefgh"))
        for address in list(loader.next_lookups()):
            loader.on_missing(address, rng.choice((0, 0, 7)))
        if rng.random() < 0.01:
            rng.choice((loader.on_link_closed, lambda: loader.on_link_lost(self._now_ns)))()
            self._asks.clear()
        asks = list(loader.next_requests(self._now_ns))
        self._asks += asks
        if rng.random() < 0.5:
            loader.on_stored(self._unstored)
            self._unstored = 0
        assert sum(ask.length for ask in self._asks) + self._unstored <= WINDOW_BYTES + WINDOW_BYTES // 2
        assert len(self._asks) <= WINDOW_REQUESTS
        return taken

    def _answer(self, data: bytes) -> bool:
        loader, rng = self._loader, self._rng
        try:
            refused = codec.decode_asset_refused(data)
        except ProtocolError:
            chunk = codec.decode_asset_chunk(data, 0)
            size = min(rng.choice((0, 5, 524_288)), max(0, chunk.total - chunk.offset))
            outcome = loader.process_chunk(chunk, size, self._now_ns)
            self._answered(chunk.request_id, fits=outcome is not False)
            if outcome is True:
                self._unstored += size
                if loader.is_complete(chunk.address):
                    loader.restart_asset(chunk.address) if rng.random() < 0.5 else loader.remove(chunk.address)
            return outcome is True
        outcome_ = loader.process_refusal(refused, self._now_ns)
        self._answered(refused.request_id, fits=True)
        if isinstance(outcome_, str) and outcome_:
            loader.on_missing(outcome_, 0)
        return outcome_ == ""

    def _answered(self, number: int, *, fits: bool) -> None:
        """Remove an answered request. An answer that fits shows that earlier requests were lost."""
        if number in {ask.request_id for ask in self._asks}:
            self._asks = [
                ask for ask in self._asks if ask.request_id > number or (ask.request_id < number and not fits)
            ]

    def close(self) -> None:
        """Nothing to close."""


class FrontAssets(FrontControl):
    """Assets port of a real front: any requests, in any number of parts.

    Every `BARRIER` inputs an honest client must get its asset, byte for byte.
    """

    BARRIER: Final = 1000
    LIFE: Final = 300

    def __init__(self, rng: Random) -> None:
        from tests.front.process_harness import scene

        super().__init__(rng)
        self._corpus = Corpus(rng, [make_asset_request])
        self._store = tempfile.TemporaryDirectory(prefix="fuzz-assets-")
        for data in (PICTURE, b""):
            path = Path(self._store.name) / asset_address(data)[:2] / asset_address(data)
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(data)
        shown = msgspec.structs.replace(
            scene(),
            asset_root=self._store.name,
            assets=(asset_address(PICTURE), asset_address(b""), "../../etc/passwd"),
        )
        self.session.process.set_scene(shown)
        self._reader = self._connect()
        self.session.client().join()

    def make(self) -> bytes:
        return self._corpus.damaged()

    def feed(self, data: bytes) -> bool:
        rng = self._rng
        self._sent += 1
        peer = self._asset_peer(rng.randrange(self.PEERS))
        parts = [rng.randbytes(rng.choice((0, 1, 100))) for _ in range(rng.choice((0, 0, 0, 0, 1, 3)))]
        deadline = time.monotonic() + 10.0
        while True:
            try:
                peer.send_multipart([data, *parts], zmq.DONTWAIT)
                break
            except zmq.Again:  # the peer is being disconnected, or the front is busy
                assert time.monotonic() < deadline, "the front accepts nothing"
                while peer.poll(0):  # libzmq reconnects only after received messages were read
                    peer.recv_multipart()
                self._poll_session()
        if self._sent % 50 == 0:
            self._poll_session()
        if self._sent % self.BARRIER == 0:
            self._check_fetch()
            self._check()
        try:
            codec.decode_asset_request(data)
        except ProtocolError:
            return False
        return True

    def _asset_peer(self, i: int) -> zmq.Socket[bytes]:
        while len(self._peers) <= i:
            self._peers.append(self._connect())
            self._lives.append(self.LIFE)
        self._lives[i] -= 1
        if self._lives[i] < 0:
            self._peers[i].close(linger=0)
            self._peers[i], self._lives[i] = self._connect(), self.LIFE
        return self._peers[i]

    def _connect(self) -> zmq.Socket[bytes]:
        new = self.session.context.socket(zmq.DEALER)
        new.linger = 0
        new.sndhwm = new.rcvhwm = 100
        new.connect(f"tcp://{self.session.host}:{self.session.ports.assets}")
        return new

    def _check_fetch(self) -> None:
        """Check that the honest client gets its asset."""
        deadline, asked_s = time.monotonic() + 20.0, 0.0
        self._sent_request = getattr(self, "_sent_request", 0)
        while True:
            assert time.monotonic() < deadline, "the honest client receives nothing"
            if time.monotonic() > asked_s + 0.5:
                asked_s = time.monotonic()
                self._sent_request += 1
                request = AssetRequest(
                    1, self._honest.epoch, self._sent_request, asset_address(PICTURE), 0, MAX_ASSET_CHUNK_BYTES
                )
                self._reader.send(codec.encode_asset_request(request))
            self._poll_session()
            if not self._reader.poll(0):
                continue
            frames = self._reader.recv_multipart()
            if len(frames) == 1:
                assert codec.decode_asset_refused(frames[0]).reason in AssetRefusal.PASSING
                continue
            chunk = codec.decode_asset_chunk(frames[0], len(frames[1]))
            assert (chunk.total, frames[1]) == (len(PICTURE), PICTURE)
            if chunk.request_id == self._sent_request:
                return

    def _check(self) -> None:
        for peer in self._peers:  # discard what they requested
            while peer.poll(0):
                peer.recv_multipart()
        peers, self._peers = self._peers, []
        try:
            super()._check()
        finally:
            self._peers = peers

    def close(self) -> None:
        self._reader.close(linger=0)
        super().close()
        self._store.cleanup()


class WebHub:
    """Hub of a gateway between hostile browsers and a session that answers anything."""

    BROWSERS: Final = 5

    def __init__(self, rng: Random) -> None:
        self._rng = rng
        self._clients = Corpus(rng, client_messages())
        self._servers = Corpus(rng, server_messages())
        self._now_ns = 0
        self.hub = Hub(HubLimits(browsers=self.BROWSERS, queued_messages=50, total_bytes=1 << 20))

    def make(self) -> bytes:
        return bytes((self._rng.randrange(10),)) + self._clients.damaged()

    def feed(self, data: bytes) -> bool:
        rng, hub = self._rng, self.hub
        self._now_ns += rng.choice((0, 1, 20, 500)) * MS
        browser = hub.open_browser(rng.randbytes(6), "a", self._now_ns) if len(hub) < self.BROWSERS else None
        browser = browser or rng.choice(list(hub))
        envelope = None
        if data[0] < 6:
            framed = wire.encode_frames(wire.CONTROL, [data[1:]]) if data[0] else data[1:]
            envelope = hub.receive(browser, framed, self._now_ns)
            if envelope is not None:
                assert peek_on_behalf_of(envelope) == browser.name
        elif data[0] < 9:
            frames = [self._servers.damaged(), *([b"\0" * 56] if data[0] == 8 else []), browser.name.encode()]
            assert hub.deliver(frames, self._now_ns)
        else:
            hub.publish([rng.choice((b"rigid", b"presence")), data[1:]])
        if hub.needs_ticket(browser, self._now_ns):
            hub.issue_ticket(browser, rng.randbytes(32), self._now_ns)
            assert hub.find_ticket(browser.ticket.decode(), self._now_ns) in (browser, None)
        hub.tick(self._now_ns)
        while rng.random() < 0.7 and (hub.take_message(browser) or hub.take_latest(browser)):
            pass
        assert sum(one.queued_bytes for one in hub) <= hub.limits.total_bytes + 1000
        assert all(len(one.latest) <= 2 and (one.epoch or not one.latest) for one in hub)
        for one in hub:
            assert one.queued_bytes == sum(map(len, one.outgoing))
            if one.closing is not None and rng.random() < 0.5:
                hub.close_browser(one)
        return envelope is not None

    def close(self) -> None:
        """Nothing to close."""


MACHINES: Final[dict[str, Callable[[Random], Any]]] = {
    "connection": HostileSession,
    "state-stream": ClientState,
    "web-hub": WebHub,
    "front": FrontControl,
    "front-tcp": FrontTcp,
    "core": Core,
    "front-media": FrontMedia,
    "asset-loader": LoaderMachine,
    "front-assets": FrontAssets,
}
ALL_TYPES: Final = frozenset(CLIENT_TYPES)
