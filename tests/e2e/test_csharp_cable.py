"""A headset whose cable is plugged in and pulled while it is in a session: it changes the way and keeps all it has."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.csharp.conftest import built as built  # noqa: PLC0414  a fixture
from tests.e2e.command_process import Headset
from tests.e2e.session_process import SessionProcess
from tests.e2e.test_web_gateway import page_of
from tools.csharp.project import Build
from tools.csharp.toolchain import RUNTIMES

pytestmark = [pytest.mark.e2e, pytest.mark.long]


class Cable:
    """A port of this machine that leads to another address, as `adb reverse` makes one, until it is pulled."""

    def __init__(self, port: int, target: tuple[str, int]) -> None:
        self._target = target
        self._listener = socket.create_server(("127.0.0.1", port))
        self._ends = [self._listener]
        self._threads: list[threading.Thread] = []
        self._start(self._accept)

    def pull(self) -> None:
        for _ in range(2):  # the listener first: it adds no ends afterwards
            for end in self._ends:
                with contextlib.suppress(OSError):  # of a connection that has ended
                    end.shutdown(socket.SHUT_RDWR)
            self._threads[0].join()
        for thread in self._threads:
            thread.join()
        for end in self._ends:
            end.close()

    def _start(self, work: Callable[..., None], *arguments: socket.socket) -> None:
        self._threads.append(threading.Thread(target=work, args=arguments, daemon=True))
        self._threads[-1].start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near = self._listener.accept()[0]
                far = socket.create_connection(self._target)
                self._ends += [near, far]
                self._start(self._pass_on, near, far)
                self._start(self._pass_on, far, near)

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                sink.sendall(data)
        with contextlib.suppress(OSError):
            sink.shutdown(socket.SHUT_RDWR)


@pytest.fixture
def plug() -> Iterator[Callable[[int, tuple[str, int]], Cable]]:
    plugged: list[Cable] = []

    def make(port: int, target: tuple[str, int]) -> Cable:
        plugged.append(Cable(port, target))
        return plugged[-1]

    yield make
    for cable in plugged:
        cable.pull()


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_cable_is_preferred_and_wifi_takes_over(
    serve: Callable[..., SessionProcess],
    plug: Callable[[int, tuple[str, int]], Cable],
    built: Build,
    tmp_path: Path,
    runtime: str,
) -> None:
    wifi = page_of(serve()).rstrip("/")
    host, _, port = wifi.removeprefix("http://").partition(":")
    with socket.create_server(("127.0.0.1", 0)) as free:
        cable_port = free.getsockname()[1]
    by_cable = f"http://localhost:{cable_port}"
    program = built.make_command(runtime, "headless")
    options = ("--json", "--identity", str(tmp_path / "identity"), "--address", f"{by_cable},{wifi}")
    headset = Headset([*program, "run", *options], tmp_path, dict(os.environ))

    def wait_for_way(endpoint: str) -> dict[str, Any]:
        return headset.wait_for_view(lambda v: v["endpoint"] == endpoint and v["phase"] == "Ready", endpoint)

    try:
        assert headset.do("join")["ok"]
        assert headset.do("align")["ok"]
        assert headset.do("acquire left")["ok"]
        epochs = [wait_for_way(wifi)["epoch"]]
        cable = None
        for way in (by_cable, wifi, by_cable):
            if way == by_cable:
                cable = plug(cable_port, (host, int(port)))
            elif cable is not None:
                cable.pull()
            view = wait_for_way(way)
            assert (view["ours"], view["alignment"], view["resumed"]) == (["left"], "Aligned", True)
            epochs.append(view["epoch"])
        assert epochs == sorted(set(epochs))
        assert headset.do("move left 0.03 0 0")["ok"]
        assert headset.end() == 0
    finally:
        headset.close()
