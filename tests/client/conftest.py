"""Fixtures of the client tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from iris_session.client import Client
from tests.client.session import ClientSession


@pytest.fixture
def session() -> Iterator[ClientSession]:
    """A session in simulated time."""
    with ClientSession() as session:
        yield session


@pytest.fixture
def join(session: ClientSession) -> Callable[..., Client]:
    """Return the function that makes connected clients, closed after the test."""
    return session.join
