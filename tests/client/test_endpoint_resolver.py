"""From an address, a name or a code to a session that admits the client: against a real front with its own keys."""

from __future__ import annotations

import secrets
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import msgspec
import pytest
import zmq

from iris_session.cli.main import main
from iris_session.client import (
    Client,
    ClientError,
    NotConnectedError,
    RefusedError,
    SessionNameError,
    TrustError,
    key_pairing,
)
from iris_session.client import endpoint_resolver as meeting_module
from iris_session.client.address import Address, pairing_uri
from iris_session.client.discovery import request_introduction
from iris_session.client.endpoint_resolver import parse_connect_request, resolve_blocking
from iris_session.protocol import pairing
from iris_session.protocol.codec import encode_server
from iris_session.protocol.discovery import DISCOVERY_PORT, Introduction
from iris_session.protocol.names import RefusalCode
from iris_session.protocol.server_messages import Paired, Refused, ServerEnvelope
from iris_session.security import KeyHome, KeyPair
from tests.client.harness import LiveSession
from tests.loopback import make_loopback_address


class Lab:
    """A session with keys, and the key home of a new user."""

    def __init__(self, folder: Path) -> None:
        self.server = KeyHome(folder / "server")
        self.mine = KeyHome(folder / "mine")
        self.name = f"lab-{secrets.token_hex(4)}"
        self.session = LiveSession(
            host=make_loopback_address(),  # no other test takes its ports between two sessions
            curve=True,
            key_home=str(folder / "server"),
            session_name=self.name,
            session_id=self.name,
            beacon_port=DISCOVERY_PORT,
        )
        self.address = self.session.address

    def code(self) -> str:
        return self.server.join_codes.create(self.server.load_server_key())[0]

    def join(self, address: str = "", **options: str) -> Client:
        client = Client(address, name="ann", **options)  # type: ignore[arg-type]
        try:
            return client.connect(30.0)
        finally:
            if not client.ready:
                client.close()


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "mine"))
    lab = Lab(tmp_path)
    yield lab
    lab.session.close()


def test_code_is_needed_once(lab: Lab) -> None:
    with pytest.raises(RefusedError, match="iris-session pair") as refused:
        lab.join(lab.address)
    assert refused.value.code == RefusalCode.UNPAIRED
    code = lab.code()
    lab.join(lab.address, join_code=code.lower()).close()
    (stored,) = lab.mine.known_servers.read()
    assert (stored.address, stored.session, stored.key) == (lab.address, lab.name, lab.server.load_server_key().public)
    assert [entry.key for entry in lab.server.clients.read().values()] == [lab.mine.load_identity().public]
    lab.join(lab.address).close()
    lab.join(lab.address, join_code=code).close()  # the same command again: its code is ignored now


def test_uri_is_complete_and_a_name_resolves(lab: Lab) -> None:
    host = Address.parse(lab.address)
    lab.join(pairing_uri(host.host, host.port, lab.server.load_server_key().public, lab.code(), lab.name)).close()
    client = lab.join(session=lab.name)
    assert client.address == lab.address
    client.close()


def test_revoked_key_pairs_again_with_a_new_code_only(lab: Lab) -> None:
    lab.join(lab.address, join_code=lab.code()).close()
    lab.server.clients.revoke_key(lab.mine.load_identity().fingerprint)
    with pytest.raises(RefusedError) as refused:
        lab.join(lab.address)
    assert refused.value.code == RefusalCode.UNPAIRED
    lab.join(lab.address, join_code=lab.code()).close()


@pytest.mark.parametrize("form", ["code", "uri"])
def test_emulated_headsets_pair_again_after_a_revocation(
    lab: Lab, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lab.join(lab.address, join_code=lab.code()).close()
    lab.server.clients.revoke_key(lab.mine.load_identity().fingerprint)
    host = Address.parse(lab.address)
    uri = pairing_uri(host.host, host.port, lab.server.load_server_key().public, lab.code(), lab.name)
    where = [lab.address, "--code", lab.code()] if form == "code" else [uri]
    options = ["--behaviour", "observer", "--count", "2", "--seconds", "5", "--join-timeout", "30"]
    assert main(["emulate", *where, *options]) == 0, capsys.readouterr()
    assert [one.key for one in lab.server.clients.read().values()] == [lab.mine.load_identity().public]


def test_wrong_code_stores_nothing(lab: Lab) -> None:
    lab.code()
    with pytest.raises(RefusedError) as refused:
        lab.join(lab.address, join_code="0000-0000-0000")
    assert refused.value.code == RefusalCode.CODE
    assert lab.mine.known_servers.read() == []
    with pytest.raises(ClientError, match="join code"):
        Client(lab.address, join_code="ABC")


def test_changed_server_key_is_an_error(lab: Lab) -> None:
    other = KeyPair.generate().public
    lab.mine.known_servers.pin(lab.address, lab.name, other)
    for options in ({}, {"join_code": lab.code()}):
        with pytest.raises(TrustError, match="keys forget"):
            lab.join(lab.address, **options)
    with pytest.raises(TrustError, match="keys forget"):
        lab.join(session=lab.name)
    assert [one.key for one in lab.mine.known_servers.read()] == [other]
    lab.mine.known_servers.remove(lab.address)
    host = Address.parse(lab.address)
    with pytest.raises(TrustError, match="with the key"):
        lab.join(pairing_uri(host.host, host.port, other, lab.code()))


def test_unknown_key_under_a_known_name_needs_a_code(lab: Lab) -> None:
    lab.mine.known_servers.pin("10.0.0.7:7721", lab.name, KeyPair.generate().public)
    with pytest.raises(TrustError, match="another key"):
        lab.join(session=lab.name)
    lab.join(session=lab.name, join_code=lab.code()).close()


def test_two_sessions_of_one_name_need_an_address(lab: Lab) -> None:
    twin = LiveSession(session_name=lab.name, session_id=f"twin of {lab.name}", beacon_port=DISCOVERY_PORT)
    try:
        with pytest.raises(SessionNameError) as error:
            lab.join(session=lab.name)
        assert lab.address in str(error.value)
        assert twin.address in str(error.value)
    finally:
        twin.close()


def test_unknown_name_lists_the_sessions_heard(lab: Lab) -> None:
    with pytest.raises(NotConnectedError, match=rf"'no-such'.*{lab.name} \({lab.address}\)"):
        resolve_blocking(parse_connect_request("", "no-such", None, ""), 2.0)
    client = Client(session="no-such")
    with pytest.raises(NotConnectedError, match="was not heard"):
        client.connect(0.3)
    client.close()


Ask = Callable[[str, int, float], Generator[None, None, Introduction]]


def introduce_as(change: Callable[[Introduction], Introduction]) -> Ask:
    """Return an `ask_introduction` with another answer, as of another program below the control port."""

    def ask(host: str, port: int, timeout_s: float) -> Generator[None, None, Introduction]:
        return change((yield from request_introduction(host, port, timeout_s)))

    return ask


def test_admitting_session_must_be_the_introduced_one(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.join(lab.address, join_code=lab.code()).close()

    def other_id(message: Introduction) -> Introduction:
        return msgspec.structs.replace(message, beacon=msgspec.structs.replace(message.beacon, session_id="other"))

    monkeypatch.setattr(meeting_module, "request_introduction", introduce_as(other_id))
    with pytest.raises(SessionNameError, match="another introduced itself"):
        lab.join(lab.address)
    with pytest.raises(SessionNameError, match="heard there"):
        lab.join(session=lab.name)


def test_introduction_for_another_port_is_ignored(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.join(lab.address, join_code=lab.code()).close()

    def other_port(message: Introduction) -> Introduction:
        beacon = msgspec.structs.replace(message.beacon, control=message.beacon.control + 1, session_id="other")
        return Introduction(beacon, KeyPair.generate().public)

    monkeypatch.setattr(meeting_module, "request_introduction", introduce_as(other_port))
    lab.join(lab.address).close()  # by the stored key


def test_session_must_prove_the_code_too(tmp_path: Path) -> None:
    server, own = KeyPair.generate(), KeyPair.generate()
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    impostor = context.socket(zmq.ROUTER)
    impostor.curve_server = True
    impostor.curve_publickey, impostor.curve_secretkey = server.public.encode(), server.secret.encode()
    port = impostor.bind_to_random_port("tcp://127.0.0.1")

    def say_yes() -> None:
        route, _ = impostor.recv_multipart()
        impostor.send_multipart([route, encode_server(ServerEnvelope(1, 0, Paired(bytes(32))))])

    thread = threading.Thread(target=say_yes)
    thread.start()
    steps = key_pairing.pair_key(Address("127.0.0.1", port), server.public, own, "7KQ2-M4XD-9PTR", "ann")
    with pytest.raises(TrustError, match="join code"):
        deque(steps, maxlen=0)
    thread.join()
    context.destroy(linger=0)


def test_busy_pairing_is_retried(monkeypatch: pytest.MonkeyPatch) -> None:
    """As when a class puts on its headsets: the code need not be typed again."""
    monkeypatch.setattr(key_pairing, "PAIR_RETRY_S", 0.01)
    monkeypatch.setattr(key_pairing, "ANSWER_S", 1.0)
    monkeypatch.setattr(pairing, "ITERATIONS", 1)
    server, own, code = KeyPair.generate(), KeyPair.generate(), "7KQ2-M4XD-9PTR"
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    session = context.socket(zmq.ROUTER)
    session.curve_server = True
    session.curve_publickey, session.curve_secretkey = server.public.encode(), server.secret.encode()
    port = session.bind_to_random_port("tcp://127.0.0.1")
    proof = pairing.make_server_proof(pairing.stretch_code(code, server.raw_public), server.raw_public, own.raw_public)
    busy, yes = Refused(RefusalCode.RATE, "many pair at once", "try again in a second"), Paired(proof)
    asked: list[bytes] = []

    def answer() -> None:
        for message in (busy, None, busy, yes):
            route, request = session.recv_multipart()
            asked.append(request)
            if message is not None:
                session.send_multipart([route, encode_server(ServerEnvelope(1, 0, message))])

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    deque(key_pairing.pair_key(Address("127.0.0.1", port), server.public, own, code, "ann"), maxlen=0)
    thread.join()
    assert len(asked) == 4
    assert len(set(asked)) == 1
    context.destroy(linger=0)


def test_local_session_needs_no_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "mine"))
    plain = LiveSession()
    try:
        with Client(plain.address, name="ann", join_code="7KQ2-M4XD-9PTR"):
            pass
    finally:
        plain.close()
    assert not (tmp_path / "mine").exists()


def test_client_may_start_before_its_session(lab: Lab) -> None:
    lab.join(lab.address, join_code=lab.code()).close()
    port = Address.parse(lab.address).port
    lab.session.close()
    client = Client(lab.address, name="ann")
    try:
        client.open()
        client.wait_for(lambda c: False, 0.5)
        assert not client.ready
        lab.session = LiveSession(
            host=Address.parse(lab.address).host,
            curve=True,
            key_home=str(lab.server.path),
            control_port=port,
            session_name="later",
            session_id="s2",
        )
        assert client.wait_for(lambda c: c.ready)
    finally:
        client.close()


def test_contradicting_arguments_are_rejected() -> None:
    with pytest.raises(ClientError, match="not both"):
        Client("127.0.0.1:1", session="lab")
