"""Host lookups that do not block a client."""

from __future__ import annotations

import errno
import socket
import threading
import time
from collections.abc import Generator, Iterator

import pytest

from iris_session.client import host_lookup as resolving
from iris_session.client.host_lookup import MAX_LOOKUPS, resolve_host

PATIENCE_S = 30.0


class NameServer:
    """Replaces the system's resolver: answers when the test allows it."""

    def __init__(self) -> None:
        self.may_answer = threading.Event()
        self.asked: list[str] = []
        self.error: Exception | None = None

    def getaddrinfo(self, host: str, *_: object) -> list[tuple[int, int, int, str, tuple[str, int]]]:
        self.asked.append(host)
        assert self.may_answer.wait(PATIENCE_S)
        if self.error is not None:
            raise self.error
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("192.0.2.1", 0))]


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Iterator[NameServer]:
    server = NameServer()
    monkeypatch.setattr(resolving, "_lookups", {})
    monkeypatch.setattr(resolving.socket, "getaddrinfo", server.getaddrinfo)
    yield server
    server.may_answer.set()


def steps(host: str, patience_s: float = PATIENCE_S) -> Generator[None, None, str]:
    return resolve_host(host, time.monotonic() + patience_s)


def end(asking: Generator[None, None, str]) -> str:
    while True:
        try:
            next(asking)
        except StopIteration as done:
            return str(done.value)
        time.sleep(0.001)


def test_addresses_need_no_lookup(names: NameServer) -> None:
    assert [end(steps(host)) for host in ("10.0.0.5", "::1", "fe80::1%eth0")] == ["10.0.0.5", "::1", "fe80::1%eth0"]
    assert names.asked == []


def test_hanging_name_server_blocks_nothing(names: NameServer) -> None:
    first, second = steps("lab"), steps("lab")
    for _ in range(5):
        next(first)  # would not return if it waited
        next(second)
    names.may_answer.set()
    assert end(first) == end(second) == "192.0.2.1"
    assert names.asked == ["lab"]


def test_late_answer_is_used_at_the_next_attempt(names: NameServer) -> None:
    with pytest.raises(TimeoutError, match="name lab"):
        end(steps("lab", 0.0))
    names.may_answer.set()
    assert end(steps("lab")) == "192.0.2.1"
    assert end(steps("lab")) == "192.0.2.1"
    assert names.asked == ["lab"]


def test_hanging_lookups_are_bounded(names: NameServer) -> None:
    waiting = [steps(f"lab{i}") for i in range(MAX_LOOKUPS)]
    for one in waiting:
        next(one)
    with pytest.raises(OSError, match="too many names") as error:
        next(steps("one-more"))
    assert error.value.errno == errno.EAGAIN


@pytest.mark.parametrize("error", [socket.gaierror(socket.EAI_NONAME, "not known"), UnicodeError("label too long")])
def test_unknown_name_is_a_system_error_and_retried(names: NameServer, error: Exception) -> None:
    names.may_answer.set()
    names.error = error
    for n in (1, 2):
        with pytest.raises(OSError, match=r"not known|too long"):
            end(steps("lab"))
        assert names.asked == ["lab"] * n
