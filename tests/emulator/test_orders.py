"""Orders to emulated people from a file: non-blocking, whole lines only, invalid lines are reported."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from iris_session.emulator.runner import MAX_LINE, DisturbanceReader


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


def test_orders_are_read_in_order_and_whole(pipe: tuple[int, int]) -> None:
    orders = DisturbanceReader(pipe[0], ["ann", "bob b"])
    assert orders() == []
    os.write(pipe[1], b"bump ann\nrecentre bob b\nbu")
    assert orders() == [("bump", "ann"), ("recentre", "bob b")]
    assert orders() == []
    os.write(pipe[1], b"mp ann\r\n\n")
    assert orders() == [("bump", "ann")]


def test_invalid_orders_are_reported(pipe: tuple[int, int], capsys: pytest.CaptureFixture[str]) -> None:
    orders = DisturbanceReader(pipe[0], ["ann"])
    os.write(pipe[1], b"kick ann\nbump eve\n\xff\n" + b"x" * (3 * MAX_LINE) + b"\nbump ann\n")
    assert orders() == [("bump", "ann")]
    error = capsys.readouterr().err
    assert "kick ann" in error
    assert "recentre or steady" in error
    assert len(error) < 2000


def test_end_of_file_ends_the_orders() -> None:
    reader, writer = os.pipe()
    orders = DisturbanceReader(reader, ["ann"])
    os.write(writer, b"bump ann\n")
    os.close(writer)
    assert orders() == [("bump", "ann")]
    assert orders() == []
    os.close(reader)
