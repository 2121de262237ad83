"""People behind gateways in a whole encrypted session: pairing, a lost socket within the grace period, a new role.

The gateways here are bare sockets: what a gateway itself does is tested in its own room.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import pytest
import zmq
from msgspec.structs import replace

from iris_session.client import Client, CurveKeys, DeniedError
from iris_session.protocol import pairing
from iris_session.protocol.client_messages import (
    Acquire,
    ClientMessage,
    Disconnected,
    GetSnapshot,
    Heartbeat,
    Hello,
    Pair,
    SetRole,
    wrap_message,
)
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.common import Message
from iris_session.protocol.names import FaultCode, RefusalCode
from iris_session.protocol.server_messages import Paired, ProtocolFault, Refused, Reply, Snapshot, Welcome
from iris_session.security import KeyHome, KeyPair, compute_fingerprint
from tests.e2e.session_process import DEADLINE_S, SessionProcess, wait_until

pytestmark = pytest.mark.e2e

CERTIFICATE = hashlib.sha256(b"certificate").digest()
M = TypeVar("M", bound=Message)


class Gateway:
    """A gateway without a web side. `epochs`: connections of those behind it.

    It is silent while its test is, so that a machine that stands still for 2 s costs it its connection. As any gateway
    does, it then says hello again, for itself and for those behind it, and asks again what was not answered.
    """

    def __init__(self, server: SessionProcess, home: KeyHome, name: str) -> None:
        pair = KeyPair.generate()
        home.clients.allow_key(name, pair.public)
        self.keys = CurveKeys(home.load_server_key().public.encode(), pair.public.encode(), pair.secret.encode())
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        self._socket.linger = 0
        self._socket.curve_serverkey, self._socket.curve_publickey = self.keys.server_public, self.keys.public
        self._socket.curve_secretkey = self.keys.secret
        self._socket.connect(f"tcp://{server.address}")
        self.epochs: dict[str, int] = {}
        self.inbox: dict[str, list[Message]] = {}
        self._hellos: dict[str, Hello] = {}
        self._asked: dict[str, ClientMessage] = {}
        self._beat_s = 0.0
        self.losses = 0
        self.ask("", Hello("gateway", name, certificate_hash=CERTIFICATE), Welcome)

    def send(self, name: str, message: ClientMessage) -> None:
        self._socket.send(encode_client(wrap_message(message, self.epochs.get(name, 0), name)))

    def receive(self) -> None:
        while self._socket.poll(0):
            frames = self._socket.recv_multipart()
            self._handle(frames[-1].decode() if len(frames) > 1 else "", decode_server(frames[0]).message)
        if time.monotonic() > self._beat_s:
            self._beat_s = time.monotonic() + 0.3
            for name in self.epochs:
                self.send(name, Heartbeat())

    def _handle(self, name: str, message: Message) -> None:
        if isinstance(message, ProtocolFault | Refused) and message.code in (FaultCode.HELLO, RefusalCode.GATEWAY_ONLY):
            if not name and self.epochs:  # a person who alone is disconnected is not helped
                self.losses += 1
                self.epochs.clear()
                self.send("", self._hellos[""])
            return
        self.inbox.setdefault(name, []).append(message)
        if isinstance(message, Welcome):
            self.epochs[name] = message.connection_epoch
            self._hellos[name] = replace(self._hellos[name], resume_token=message.resume_token)
            self._ask_again(name)
        elif isinstance(message, Refused | ProtocolFault):
            self._hellos.pop(name, None)
            self.epochs.pop(name, None)

    def _ask_again(self, welcomed: str) -> None:
        """Once the gateway is welcome, say hello for those behind it; once those are, ask what they had asked."""
        if not welcomed:
            for name, hello in self._hellos.items():
                if name:
                    self.send(name, hello)
        for name, message in self._asked.items():
            if not isinstance(message, Hello) and welcomed == (name if name in self._hellos else ""):
                self.send(name, message)

    def has_everyone(self) -> bool:
        """Return whether the gateway and all behind it are connected."""
        self.receive()
        return self._hellos.keys() == self.epochs.keys()

    def got(self, name: str, kind: type[M]) -> list[M]:
        self.receive()
        return [message for message in self.inbox.get(name, []) if isinstance(message, kind)]

    def ask(self, name: str, message: ClientMessage, kind: type[M]) -> M:
        if isinstance(message, Hello):
            self.epochs.pop(name, None)
            self._hellos[name] = message
        n = len(self.got(name, kind))
        self._asked[name] = message
        self.send(name, message)
        wait_until(lambda: len(self.got(name, kind)) > n, f"{kind.__name__} for {name}")
        del self._asked[name]
        wait_until(self.has_everyone, "the gateway and those behind it are connected")
        return self.got(name, kind)[-1]

    def lose(self, name: str) -> Hello:
        """Report that the socket of one behind it was closed. Return the hello that resumes."""
        self.send(name, Disconnected())
        self.epochs.pop(name, None)
        return self._hellos.pop(name)

    def close(self) -> None:
        self._socket.close()


class Lab:
    def __init__(self, serve: Callable[..., SessionProcess], folder: Path) -> None:
        self.home = KeyHome(folder)
        self.key = self.home.load_server_key()
        self.server = serve("handover", "--curve", "--no-beacon")
        self.gateways = [Gateway(self.server, self.home, f"gateway {n}") for n in range(2)]
        pair = KeyPair.generate()
        self.home.clients.allow_key("dora", pair.public)
        keys = CurveKeys(self.key.public.encode(), pair.public.encode(), pair.secret.encode())
        self.dora = Client(self.server.address, role="director", name="dora", alignment="not_needed", curve=keys)
        self.dora.connect(DEADLINE_S).start()

    def wait(self, holds: Callable[[Client], bool], what: str) -> None:
        """Wait for what the director sees, while everyone is alive."""

        def is_so() -> bool:
            alive = [gateway.has_everyone() for gateway in self.gateways]
            return all(alive) and holds(self.dora)

        wait_until(is_so, what)

    def pair(self, gateway: Gateway, secret: bytes, *roles: str) -> None:
        code, _ = self.home.join_codes.create(self.key, roles=roles, web_key=CERTIFICATE)
        identity = hashlib.sha256(secret).digest()
        stretched = pairing.stretch_code(code, CERTIFICATE)
        proof = pairing.make_client_proof(stretched, CERTIFICATE, identity)
        paired = gateway.ask("ada", Pair("ada", proof, identity=identity), Paired)
        assert paired == Paired(pairing.make_server_proof(stretched, CERTIFICATE, identity), roles)

    def close(self) -> None:
        for gateway in self.gateways:
            gateway.close()
        self.dora.close()


@pytest.fixture
def lab(serve: Callable[..., SessionProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "server-home"))
    lab = Lab(serve, tmp_path / "server-home")
    yield lab
    lab.close()


@pytest.mark.long
def test_person_behind_gateways(lab: Lab) -> None:
    first, second = lab.gateways
    secret = os.urandom(32)
    assert first.ask("ada", Hello("operator", "ada", secret=secret), Refused).code == "unpaired"
    lab.pair(first, secret, "operator", "observer")
    ada = first.ask("ada", Hello("operator", "ada", secret=secret), Welcome).participant_id

    assert first.ask("ada", Acquire(1, ("left",)), Reply).ok
    lab.wait(lambda c: c.mirror.leases["left"].holder == ada, "ada holds the robot")
    version = lab.dora.mirror.leases["left"].lease_version
    again = first.lose("ada")
    lab.wait(lambda c: not c.mirror.participants[ada].connected, "ada is disconnected")
    lab.wait(lambda c: c.mirror.leases["left"].expires_ns > 0, "the grace period of the lease begins")
    lease = lab.dora.mirror.leases["left"]
    assert lease.holder == ada, "the lease is kept for the grace period"
    assert lease.expires_ns > 0

    resumed = second.ask("tab", again, Welcome)
    assert (resumed.participant_id, resumed.resumed) == (ada, True)
    lab.wait(lambda c: c.mirror.participants[ada].connected, "ada is back")
    lab.wait(lambda c: c.mirror.leases["left"].expires_ns == 0, "the lease is resumed")
    lease = lab.dora.mirror.leases["left"]
    assert (lease.holder, lease.expires_ns, lease.lease_version > version) == (ada, 0, True)

    snapshot = second.ask("tab", GetSnapshot(1), Snapshot)
    assert [(a.id, a.size_m) for a in snapshot.anchors] == [(a, 0.16) for a in lab.dora.mirror.anchors]
    assert snapshot.anchors
    assert lab.dora.mirror.anchors == {a.id: a for a in snapshot.anchors}

    with pytest.raises(DeniedError) as caught:
        lab.dora.request(SetRole(0, ada, "director"))
    assert caught.value.denial.reason == "role"
    lab.dora.request(SetRole(0, ada, "observer"))
    lab.wait(lambda c: not c.mirror.leases["left"].holder, "an observer holds nothing")

    losses = second.losses
    lab.home.clients.revoke_key(compute_fingerprint(hashlib.sha256(secret).digest()))
    wait_until(lambda: second.got("tab", ProtocolFault) or second.got("tab", Refused), "ada receives the revocation")
    answer = [*second.got("tab", ProtocolFault), *second.got("tab", Refused)][0]
    assert answer.code == FaultCode.REVOKED or (answer.code == "unpaired" and second.losses > losses)
    lab.wait(lambda c: ada not in c.mirror.participants, "ada is removed without grace")
    assert first.ask("ada", Hello("observer", "ada", secret=secret), Refused).code == "unpaired"
    lab.dora.close()
    assert lab.server.finish()["ok"]


@pytest.mark.long
def test_grace_period_ends(lab: Lab) -> None:
    first, _ = lab.gateways
    secret = os.urandom(32)
    lab.pair(first, secret, "operator")
    ada = first.ask("ada", Hello("operator", "ada", secret=secret), Welcome).participant_id
    assert first.ask("ada", Acquire(1, ("left",)), Reply).ok
    first.lose("ada")
    lab.wait(lambda c: ada not in c.mirror.participants, "the grace period ends")
    assert not lab.dora.mirror.leases["left"].holder
