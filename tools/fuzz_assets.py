"""What `fuzz.py` gives to assets: the decoders of both ends, a client's loader, and a real front's assets port."""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any, Final

import msgspec
import zmq
from fuzz_decoders import Decoder
from fuzz_inputs import Corpus, encoded
from fuzz_machines import FrontControl

from iris_session.client.core.asset_loader import WINDOW_BYTES, WINDOW_REQUESTS, AssetLoader, ChunkRequest
from iris_session.protocol import codec
from iris_session.protocol.assets import MAX_ASSET_CHUNK_BYTES, AssetChunk, AssetRefused, AssetRequest
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.names import AssetRefusal
from tests.front.harness import scene

#: What somebody honest fetches all the while.
PICTURE: Final = bytes(range(256)) * 1000
_REASONS: Final = ("unknown_asset", "bad_range", "busy", "rate", "too_many_outstanding", "not_allowed", "of_tomorrow")


def _address(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _requests(rng: Random) -> bytes:
    """As a client sends it, often enough for the hub to take it."""
    if rng.random() < 0.3:
        return encoded(rng, AssetRequest)
    address = rng.choice((_address(PICTURE), _address(PICTURE), _address(b""), "0" * 64, "../../etc/passwd", ""))
    offset = rng.choice((0, 0, 1000, len(PICTURE), len(PICTURE) + 1, 2**62))
    length = rng.choice((1, 1000, MAX_ASSET_CHUNK_BYTES, MAX_ASSET_CHUNK_BYTES + 1, 0, 2**62))
    epoch = rng.choice((2, 2, 2, 3, 0, 2**62))  # the second to come is nobody honest; the first is let alone
    return codec.encode_asset_request(AssetRequest(1, epoch, rng.getrandbits(30), address, offset, length))


def _versioned(rng: Random, kind: type[msgspec.Struct]) -> bytes:
    """Bytes of a struct, more often than not of our version."""
    data = encoded(rng, kind)
    return data[:1] + b"\x01" + data[2:] if rng.random() < 0.7 else data


class LoaderMachine:
    """The client's loader, and a session that answers anything to anything."""

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

    def take(self, data: bytes) -> bool:
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
        """An answer that fits its request says that those before it were lost."""
        if number in {ask.request_id for ask in self._asks}:
            self._asks = [
                ask for ask in self._asks if ask.request_id > number or (ask.request_id < number and not fits)
            ]

    def close(self) -> None:
        """Nothing was opened."""


class FrontAssets(FrontControl):
    """The assets port of a real front: requests for anything, in any number of parts.

    Every `BARRIER` inputs an honest client must get its picture, byte for byte.
    """

    BARRIER: Final = 1000
    LIFE: Final = 300

    def __init__(self, rng: Random) -> None:
        super().__init__(rng)
        self._corpus = Corpus(rng, [_requests])
        self._store = tempfile.TemporaryDirectory(prefix="fuzz-assets-")
        for data in (PICTURE, b""):
            path = Path(self._store.name) / _address(data)[:2] / _address(data)
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(data)
        shown = msgspec.structs.replace(
            scene(), asset_root=self._store.name, assets=(_address(PICTURE), _address(b""), "../../etc/passwd")
        )
        self.session.process.set_scene(shown)
        self._reader = self._connected()
        self.session.client().join()

    def make(self) -> bytes:
        return self._corpus.damaged()

    def take(self, data: bytes) -> bool:
        rng = self._rng
        self._sent += 1
        peer = self._peer_of(rng.randrange(self.PEERS))
        parts = [rng.randbytes(rng.choice((0, 1, 100))) for _ in range(rng.choice((0, 0, 0, 0, 1, 3)))]
        deadline = time.monotonic() + 10.0
        while True:
            try:
                peer.send_multipart([data, *parts], zmq.DONTWAIT)
                break
            except zmq.Again:  # it is being cut off, or the front is busy
                assert time.monotonic() < deadline, "the front takes nothing"
                while peer.poll(0):  # libzmq connects again only after somebody has made room for what came
                    peer.recv_multipart()
                self._turn()
        if self._sent % 50 == 0:
            self._turn()
        if self._sent % self.BARRIER == 0:
            self._fetch()
            self._check()
        try:
            codec.decode_asset_request(data)
        except ProtocolError:
            return False
        return True

    def _peer_of(self, i: int) -> zmq.Socket[bytes]:
        while len(self._peers) <= i:
            self._peers.append(self._connected())
            self._lives.append(self.LIFE)
        self._lives[i] -= 1
        if self._lives[i] < 0:
            self._peers[i].close(linger=0)
            self._peers[i], self._lives[i] = self._connected(), self.LIFE
        return self._peers[i]

    def _connected(self) -> zmq.Socket[bytes]:
        new = self.session.context.socket(zmq.DEALER)
        new.linger = 0
        new.sndhwm = new.rcvhwm = 100
        new.connect(f"tcp://127.0.0.1:{self.session.ports.assets}")
        return new

    def _fetch(self) -> None:
        """The honest client gets its picture."""
        deadline, asked_s = time.monotonic() + 20.0, 0.0
        self._sent_request = getattr(self, "_sent_request", 0)
        while True:
            assert time.monotonic() < deadline, "the honest client gets nothing"
            if time.monotonic() > asked_s + 0.5:
                asked_s = time.monotonic()
                self._sent_request += 1
                request = AssetRequest(
                    1, self._honest.epoch, self._sent_request, _address(PICTURE), 0, MAX_ASSET_CHUNK_BYTES
                )
                self._reader.send(codec.encode_asset_request(request))
            self._turn()
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
        for peer in self._peers:  # what they asked for, and need not be read
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


_OURS: Final = (ProtocolError,)
ASSET_DECODERS: Final[dict[str, Callable[[Random], Any]]] = {
    "asset-request": lambda rng: Decoder(rng, [_requests], codec.decode_asset_request, _OURS),
    "asset-chunk": lambda rng: Decoder(
        rng, [lambda r: _versioned(r, AssetChunk)], lambda data: codec.decode_asset_chunk(data, 0), _OURS
    ),
    "asset-refused": lambda rng: Decoder(
        rng, [lambda r: _versioned(r, AssetRefused)], codec.decode_asset_refused, _OURS
    ),
}
ASSET_MACHINES: Final[dict[str, Callable[[Random], Any]]] = {
    "asset-loader": LoaderMachine,
    "front-assets": FrontAssets,
}
