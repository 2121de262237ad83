"""Fixtures of the front's tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.front.harness import FrontSession
from tests.front.lab import Lab, Open


@pytest.fixture
def open_session() -> Iterator[Callable[..., FrontSession]]:
    """Start front processes with a configuration; they end with the test."""
    opened: list[FrontSession] = []

    def start(**config: object) -> FrontSession:
        opened.append(FrontSession(**config))  # type: ignore[arg-type]
        return opened[-1]

    yield start
    for front in opened:
        front.close()


@pytest.fixture
def session(open_session: Callable[..., FrontSession]) -> FrontSession:
    """A front process on free ports with a minimal authority."""
    return open_session()


@pytest.fixture
def lab(open_session: Open, tmp_path: Path) -> Lab:
    """An encrypted session with a home of keys of its own."""
    return Lab(open_session, tmp_path / "home")
