"""An encrypted session with allowed and unknown keys, in this process or with a front process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from iris_session.protocol import pairing
from iris_session.protocol.client_messages import EStop, Hello, Marker, Pair
from iris_session.protocol.entries import Audit
from iris_session.protocol.server_messages import Refused
from iris_session.security import KeyHome, KeyPair
from tests.front.harness import FrontSession, RawClient

Open = Callable[..., FrontSession]
Curve = tuple[bytes, bytes, bytes]


class Lab:
    """An encrypted session on loopback and its home of keys."""

    def __init__(self, open_session: Open, folder: Path) -> None:
        self.home = KeyHome(folder)
        self.server = self.home.load_server_key()
        self.session = open_session(curve=True, key_home=str(folder))

    def curve(self, pair: KeyPair) -> Curve:
        return self.server.public.encode(), pair.public.encode(), pair.secret.encode()

    def client(self, pair: KeyPair) -> RawClient:
        return self.session.client(curve=self.curve(pair))

    def allowed(self, name: str, *roles: str) -> tuple[KeyPair, RawClient]:
        """Allow a new key, and join a client with it."""
        pair = KeyPair.generate()
        self.home.clients.allow_key(name, pair.public, roles)
        client = self.client(pair)
        client.join(name=name)
        return pair, client

    def proof(self, code: str, pair: KeyPair) -> bytes:
        secret = pairing.stretch_code(code, self.server.raw_public)
        return pairing.make_client_proof(secret, self.server.raw_public, pair.raw_public)

    def refused(self, client: RawClient, message: Hello | Pair | EStop | Marker, n: int = 1) -> Refused:
        client.send(message)
        return client.wait_for(Refused, n)

    def audits(self, kind: str, n: int = 1) -> list[Audit]:
        """Wait for audits of a kind that count at least `n` in all."""

        def found() -> list[Audit]:
            messages = [e.message for e in self.session.entries]
            return [m for m in messages if isinstance(m, Audit) and m.kind == kind]

        self.session.pump(lambda: sum(a.count for a in found()) >= n, f"audit {kind}")
        return found()
