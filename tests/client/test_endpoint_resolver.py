"""Resolving, trusting and pairing without a network: introductions and beacons come from the test."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import zmq

from iris_session.client import (
    ClientError,
    NotConnectedError,
    RefusedError,
    SessionNameError,
    TrustError,
    endpoint_resolver,
    server_trust,
)
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.discovery import Address, pairing_uri
from iris_session.client.endpoint_resolver import (
    Endpoint,
    EndpointResolver,
    SessionJoiner,
    parse_connect_request,
    resolve_blocking,
)
from iris_session.link.discovery import FoundSession
from iris_session.protocol import pairing
from iris_session.protocol.codec import encode_server
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.names import RefusalCode
from iris_session.protocol.server_messages import Paired, Refused, ServerEnvelope
from iris_session.security import KeyHome, KeyPair
from tests.client.core.test_connection import MS, Wire

HOST, PORT = "10.0.0.5", 7721
ADDRESS = f"{HOST}:{PORT}"
NAME = "lab-1"
CODE = "7KQ2-M4XD-9PTR"
SERVER, OTHER = KeyPair.generate(), KeyPair.generate()


class Clock:
    """In place of the module `time`: every look at it takes a while."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        self.now_s += 0.05
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(self.monotonic() * 1e9)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


class Network:
    """What a client hears: introductions by address, beacons; and what it asks.

    Attributes:
        introductions: Answers by address; without one the connection is refused.
        heard: Sessions whose beacons are heard.
        code: The join code that the session accepts, empty for none.
        paired: Own keys that have paired.
    """

    def __init__(self) -> None:
        beacon = Beacon(1, "s1", NAME, "live", HOST, PORT, PORT + 1, 0, 0, 0, "mark")
        self.introductions: dict[str, Introduction] = {ADDRESS: Introduction(beacon, SERVER.public)}
        self.heard = [FoundSession(NAME, ADDRESS, "s1", "live", "mark", (ADDRESS,))]
        self.code = ""
        self.paired: list[str] = []

    def request_introduction(self, host: str, port: int, _: float) -> Generator[None, None, Introduction]:
        yield
        if f"{host}:{port}" not in self.introductions:
            raise ConnectionRefusedError(111, "refused")
        return self.introductions[f"{host}:{port}"]

    def change_introduction(self, change: Callable[[Beacon], Beacon], key: str = SERVER.public) -> None:
        self.introductions[ADDRESS] = Introduction(change(self.introductions[ADDRESS].beacon), key)

    def open_listener(self) -> Network:
        return self

    def __enter__(self) -> Network:
        return self

    def __exit__(self, *_: object) -> None: ...

    def poll_sessions(self) -> list[FoundSession]:
        return self.heard

    def pair_key(self, _address: Address, _key: str, own: KeyPair, code: str, _: str) -> Generator[None, None, None]:
        yield
        if code != pairing.normalise_code(self.code or "0000-0000-0000"):
            raise RefusedError(Refused(RefusalCode.CODE, "wrong"))
        self.code = ""
        self.paired.append(own.public)


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Network:
    network = Network()
    for name in ("request_introduction", "open_listener", "pair_key"):
        monkeypatch.setattr(endpoint_resolver, name, getattr(network, name))
    monkeypatch.setattr(endpoint_resolver, "time", Clock())
    return network


def resolve(address: str = "", session: str = "", code: str = "", *, force_pairing: bool = False) -> Endpoint:
    request = parse_connect_request(address, session, None, code)
    resolver = EndpointResolver(request, force_pairing=force_pairing)
    for _ in range(100):
        endpoint = resolver.step()
        if endpoint is not None:
            return endpoint
    resolver.close()
    raise NotConnectedError(resolver.note)


def test_code_is_needed_once(network: Network, home: KeyHome) -> None:
    first = resolve(ADDRESS)
    assert (first.session_id, first.session, first.store) == ("s1", NAME, True)
    assert first.curve is not None
    assert first.curve.server_public == SERVER.public.encode()
    assert home.known_servers.read() == [], "not before the session has welcomed us"
    network.code = CODE
    resolve(ADDRESS, code=CODE.lower())
    (stored,) = home.known_servers.read()
    assert (stored.address, stored.session, stored.key) == (ADDRESS, NAME, SERVER.public)
    assert network.paired == [home.load_identity().public]
    resolve(ADDRESS)
    resolve(ADDRESS, code=CODE)  # the same command again: its code is ignored now
    assert len(network.paired) == 1
    network.code = CODE
    resolve(ADDRESS, code=CODE, force_pairing=True)
    assert len(network.paired) == 2


def test_uri_is_complete_and_a_name_resolves(network: Network, home: KeyHome) -> None:
    network.code = CODE
    resolve(pairing_uri(HOST, PORT, SERVER.public, CODE, NAME))
    assert len(network.paired) == 1
    found = resolve(session=NAME)
    assert (str(found.address), found.store) == (ADDRESS, False)


def test_wrong_code_stores_nothing(network: Network, home: KeyHome) -> None:
    with pytest.raises(RefusedError):
        resolve(ADDRESS, code=CODE)
    assert home.known_servers.read() == []


def test_changed_server_key_is_an_error(network: Network, home: KeyHome) -> None:
    home.known_servers.pin(ADDRESS, NAME, OTHER.public)
    for options in ({"address": ADDRESS}, {"address": ADDRESS, "code": CODE}, {"session": NAME}):
        with pytest.raises(TrustError):
            resolve(**options)
    assert [one.key for one in home.known_servers.read()] == [OTHER.public]
    home.known_servers.remove(ADDRESS)
    with pytest.raises(TrustError):
        resolve(pairing_uri(HOST, PORT, OTHER.public, CODE))


def test_unknown_key_under_a_known_name_needs_a_code(network: Network, home: KeyHome) -> None:
    home.known_servers.pin("10.0.0.7:7721", NAME, OTHER.public)
    with pytest.raises(TrustError):
        resolve(session=NAME)
    network.code = CODE
    resolve(session=NAME, code=CODE)


def test_names_must_be_unique_and_unknown_ones_list_what_is_heard(network: Network, home: KeyHome) -> None:
    with pytest.raises(NotConnectedError, match=rf"'no-such'.*{NAME} \({ADDRESS}\)"):
        resolve(session="no-such")
    with pytest.raises(NotConnectedError, match="no-such"):
        resolve_blocking(parse_connect_request("", "no-such", None, ""), 1.0)
    network.heard.append(FoundSession(NAME, "10.0.0.6:7721", "s2", "live", "", ("10.0.0.6:7721",)))
    with pytest.raises(SessionNameError) as error:
        resolve(session=NAME)
    assert ADDRESS in str(error.value)
    assert "10.0.0.6:7721" in str(error.value)


def test_introduction_of_another_session_is_no_answer(network: Network, home: KeyHome) -> None:
    network.change_introduction(lambda beacon: msgspec.structs.replace(beacon, session_id="other"))
    with pytest.raises(SessionNameError):
        resolve(session=NAME)
    home.known_servers.pin(ADDRESS, NAME, SERVER.public)
    network.change_introduction(lambda beacon: msgspec.structs.replace(beacon, control=PORT + 1), OTHER.public)
    endpoint = resolve(ADDRESS)
    assert endpoint.curve is not None
    assert (endpoint.session_id, endpoint.curve.server_public) == ("", SERVER.public.encode()), "by the stored key"


def test_unknown_session_is_awaited_and_a_local_one_needs_no_keys(network: Network, home: KeyHome) -> None:
    introduction = network.introductions.pop(ADDRESS)
    with pytest.raises(NotConnectedError, match=str(PORT - 1)):
        resolve(ADDRESS)
    resolver = EndpointResolver(parse_connect_request(ADDRESS, "", None, ""))
    assert all(resolver.step() is None for _ in range(20))
    network.introductions[ADDRESS] = introduction
    assert any(resolver.step() is not None for _ in range(20))
    (local,) = {resolve(), resolve("127.0.0.1", code=CODE)}
    assert (str(local.address), local.curve, local.store) == ("127.0.0.1:7721", None, False)
    assert network.paired == []


@pytest.mark.parametrize(
    "arguments", [("127.0.0.1:1", "lab", None, ""), ("", "lab", object(), ""), (ADDRESS, "", None, "ABC")]
)
def test_contradicting_arguments_are_rejected(arguments: Any) -> None:
    with pytest.raises(ClientError):
        parse_connect_request(*arguments)


# --- joining ----------------------------------------------------------------------------------------------------------


class Joining:
    """A joiner with a connection whose messages come from the test."""

    def __init__(self, address: str, code: str = "") -> None:
        self.wire = Wire()
        self.connection = self.wire.connection
        self.targets: list[tuple[str, int, Any]] = []
        sockets: Any = SimpleNamespace(set_target=lambda *target: self.targets.append(target))
        self.joiner = SessionJoiner(parse_connect_request(address, "", None, code), self.connection, sockets)
        self.joiner.begin()
        self.resolve()

    def resolve(self) -> None:
        for _ in range(50):
            self.joiner.step()
            if not self.joiner.is_resolving:
                return
        raise AssertionError(self.joiner.describe_failure("now"))

    def refuse(self, code: str) -> None:
        self.wire.receive(Refused(code, "no"), MS)
        self.joiner.check_answer()


def test_welcome_of_the_introduced_session_stores_its_key(network: Network, home: KeyHome) -> None:
    joining = Joining(ADDRESS)
    assert [target[:2] for target in joining.targets] == [(HOST, PORT)]
    assert (joining.joiner.address, joining.connection.phase) == (ADDRESS, ConnectionPhase.JOINING)
    joining.wire.welcome(MS)
    joining.joiner.check_answer()
    assert joining.connection.failure is None
    assert [one.key for one in home.known_servers.read()] == [SERVER.public]


def test_welcome_of_another_session_is_an_error(network: Network, home: KeyHome) -> None:
    joining = Joining(ADDRESS)
    joining.wire.welcome(MS, session="s2")
    joining.joiner.check_answer()
    assert isinstance(joining.connection.failure, SessionNameError)
    assert joining.connection.phase is ConnectionPhase.REFUSED
    assert home.known_servers.read() == []


@pytest.mark.parametrize("form", ["code", "uri"])
def test_revoked_key_pairs_again_once(network: Network, home: KeyHome, form: str) -> None:
    home.known_servers.pin(ADDRESS, NAME, SERVER.public)
    network.code = CODE
    uri = pairing_uri(HOST, PORT, SERVER.public, CODE)
    joining = Joining(ADDRESS, CODE) if form == "code" else Joining(uri)
    assert network.paired == []
    joining.refuse(RefusalCode.UNPAIRED)
    assert joining.joiner.is_resolving
    joining.resolve()
    assert len(network.paired) == 1
    joining.refuse(RefusalCode.UNPAIRED)
    assert not joining.joiner.is_resolving
    assert joining.connection.phase is ConnectionPhase.REFUSED


def test_refusal_without_a_code_is_final(network: Network, home: KeyHome) -> None:
    joining = Joining(ADDRESS)
    joining.refuse(RefusalCode.UNPAIRED)
    assert isinstance(joining.connection.failure, RefusedError)
    assert not joining.joiner.is_resolving


# --- pairing over a socket --------------------------------------------------------------------------------------------


@pytest.fixture
def router(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[zmq.Socket[bytes], Address]]:
    """The control socket of a session, with its address."""
    monkeypatch.setattr(server_trust, "PAIR_RETRY_S", 0.001)
    monkeypatch.setattr(server_trust, "ANSWER_S", 0.2)
    monkeypatch.setattr(pairing, "ITERATIONS", 1)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    router = context.socket(zmq.ROUTER)
    router.curve_server = True
    router.curve_publickey, router.curve_secretkey = SERVER.public.encode(), SERVER.secret.encode()
    yield router, Address("127.0.0.1", router.bind_to_random_port("tcp://127.0.0.1"))
    context.destroy(linger=0)


def pair(router: zmq.Socket[bytes], address: Address, own: KeyPair, *answers: Paired | Refused | None) -> list[bytes]:
    """Pair with a session that gives these answers, `None` for silence; return the requests."""
    requests: list[bytes] = []

    def answer() -> None:
        for message in answers:
            route, request = router.recv_multipart()
            requests.append(request)
            if message is not None:
                router.send_multipart([route, encode_server(ServerEnvelope(1, 0, message))])

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        deque(server_trust.pair_key(address, SERVER.public, own, CODE, "ann"), maxlen=0)
    finally:
        thread.join()
    return requests


def test_session_must_prove_the_code_too(router: tuple[zmq.Socket[bytes], Address]) -> None:
    with pytest.raises(TrustError):
        pair(*router, KeyPair.generate(), Paired(bytes(32)))
    with pytest.raises(RefusedError):
        pair(*router, KeyPair.generate(), Refused(RefusalCode.CODE, "used"))


def test_busy_pairing_is_retried(router: tuple[zmq.Socket[bytes], Address]) -> None:
    """As when a class puts on its headsets: the code need not be typed again."""
    own = KeyPair.generate()
    secret = pairing.stretch_code(CODE, SERVER.raw_public)
    proof = pairing.make_server_proof(secret, SERVER.raw_public, own.raw_public)
    busy = Refused(RefusalCode.RATE, "many pair at once", "try again in a second")
    requests = pair(*router, own, busy, None, busy, Paired(proof))
    assert len(requests) == 4
    assert len(set(requests)) == 1
