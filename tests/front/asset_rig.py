"""A store of assets on disk, and a raw client of the assets channel."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

import msgspec
import zmq

from iris_session.link import SceneInfo
from iris_session.protocol.assets import AssetChunk, AssetRefused, AssetRequest
from iris_session.protocol.codec import decode_asset_chunk, decode_asset_refused, encode_asset_request
from tests.front.harness import scene

Curve = tuple[bytes, bytes, bytes]


def put(root: Path, data: bytes) -> str:
    """Store an asset. Return its address."""
    address = hashlib.sha256(data).hexdigest()
    path = root / address[:2] / address
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return address


def with_assets(root: Path, *assets: str) -> SceneInfo:
    return msgspec.structs.replace(scene(), asset_root=str(root), assets=assets)


class Fetcher:
    """A DEALER on the assets port; keeps the answers to its requests by number."""

    def __init__(self, session: Any, epoch: int, curve: Curve | None = None, **options: int) -> None:
        self.session = session
        self.epoch = epoch
        self.socket = session.context.socket(zmq.DEALER)
        self.socket.linger = 0
        self.socket.rcvhwm = options.get("hwm", 1000)
        if "rcvbuf" in options:
            self.socket.setsockopt(zmq.RCVBUF, options["rcvbuf"])
        if curve:
            self.socket.curve_serverkey, self.socket.curve_publickey, self.socket.curve_secretkey = curve
        self.socket.connect(f"tcp://{session.host}:{session.ports.assets}")
        self.chunks: dict[int, tuple[AssetChunk, bytes]] = {}
        self.refusals: dict[int, AssetRefused] = {}
        self._next = 0

    def ask(self, address: str, offset: int = 0, length: int = 1 << 20, version: int = 1) -> int:
        self._next += 1
        request = AssetRequest(version, self.epoch, self._next, address, offset, length)
        self.socket.send(encode_asset_request(request))
        return self._next

    def take(self) -> int:
        """Read what arrived. Return the number of answers."""
        while self.socket.poll(0):
            frames = self.socket.recv_multipart()
            if len(frames) == 2:
                chunk = decode_asset_chunk(frames[0], len(frames[1]))
                self.chunks[chunk.request_id] = chunk, frames[1]
            else:
                refused = decode_asset_refused(frames[0])
                self.refusals[refused.request_id] = refused
        return len(self.chunks) + len(self.refusals)

    def answer(self, request_id: int) -> bytes | str:
        """Wait for a chunk, or for the reason of its refusal."""

        def there() -> bool:
            self.take()
            return request_id in self.chunks or request_id in self.refusals

        self.session.pump(there, f"answer {request_id}")
        return self.chunks[request_id][1] if request_id in self.chunks else self.refusals[request_id].reason

    def close(self) -> None:
        self.socket.close(linger=0)


def noise(n: int) -> bytes:
    return os.urandom(n)
