"""Fixtures of the front's tests: a front in this process, and a front process where that matters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.front.harness import FrontSession
from tests.front.lab import Lab
from tests.front.process_harness import ProcessSession


@pytest.fixture
def open_session() -> Iterator[Callable[..., FrontSession]]:
    """Start fronts with a configuration; they end with the test."""
    opened: list[FrontSession] = []

    def start(**config: object) -> FrontSession:
        opened.append(FrontSession(**config))  # type: ignore[arg-type]
        return opened[-1]

    yield start
    for front in reversed(opened):
        front.close()


@pytest.fixture
def session(open_session: Callable[..., FrontSession]) -> FrontSession:
    """A front with a minimal authority."""
    return open_session()


@pytest.fixture
def lab(open_session: Callable[..., FrontSession], tmp_path: Path) -> Lab:
    """An encrypted session with a home of keys of its own."""
    return Lab(open_session, tmp_path / "home")


@pytest.fixture
def open_process() -> Iterator[Callable[..., ProcessSession]]:
    """Start front processes with a configuration; they end with the test."""
    opened: list[ProcessSession] = []

    def start(**config: object) -> ProcessSession:
        opened.append(ProcessSession(**config))  # type: ignore[arg-type]
        return opened[-1]

    yield start
    for front in opened:
        front.close()


@pytest.fixture
def process_session(open_process: Callable[..., ProcessSession]) -> ProcessSession:
    """A front process on free ports with a minimal authority."""
    return open_process()


@pytest.fixture
def process_lab(open_process: Callable[..., ProcessSession], tmp_path: Path) -> Lab:
    """An encrypted session of a front process, with a home of keys of its own."""
    return Lab(open_process, tmp_path / "home")
