"""Fixtures of the client tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from iris_session.client import Client
from tests.client.harness import LiveSession


@pytest.fixture
def session() -> Iterator[LiveSession]:
    """Front process and authority on free ports."""
    live = LiveSession()
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
