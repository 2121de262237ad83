"""Fixtures of the client tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from iris_session.client import Client
from tests.client.harness import PATIENCE_NS, LiveSession, let_clients_wait
from tests.loopback import make_loopback_address

#: Default of the client's waits in these tests: a busy machine may stop a process for seconds.
DEADLINE_S = 30.0


@pytest.fixture(autouse=True)
def _wait_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    let_clients_wait(monkeypatch, DEADLINE_S)


@pytest.fixture
def session(request: pytest.FixtureRequest) -> Iterator[LiveSession]:
    """Front process and authority on free ports, which they keep when the front is replaced. Parameter: the longest
    silence of a client [ns]."""
    live = LiveSession(host=make_loopback_address(), silence_ns=getattr(request, "param", PATIENCE_NS))
    yield live
    live.close()


@pytest.fixture
def join(session: LiveSession) -> Iterator[Callable[..., Client]]:
    """Return a function that makes connected clients, closed after the test."""
    clients: list[Client] = []

    def make(name: str = "ann", *, connect: bool = True, **settings: object) -> Client:
        settings.setdefault("alignment", "not_needed")
        client = Client(session.address, name=name, **settings)  # type: ignore[arg-type]
        clients.append(client)
        return client.connect() if connect else client

    yield make
    for client in clients:
        client.close()
