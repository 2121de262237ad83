"""The session's side of the gateway process: listening sockets, start with the first connection, restart, end.

The session opens the port, so that it is known from the beginning and stays the same whatever happens to the process.
The process is started when a first connection waits: a session that no browser looks at pays nothing for it. Without
the packages of the extra `web` there is no port, and the session runs as without a gateway.
"""

from __future__ import annotations

import importlib.util
import os
import select
import socket
from collections.abc import Callable, Sequence
from typing import Final

import msgspec

from iris_session.link.sockets import host_in_address
from iris_session.system.process import PIPE, ChildProcess
from iris_session.system.supervised import SupervisedProcess
from iris_session.web.config import GatewayConfig, GatewayReport, GatewayStart

PACKAGES: Final = ("aiohttp", "cryptography")
#: Time for browsers to read that the session has ended.
EXIT_S: Final = 1.5
_MODULE: Final = "iris_session.web.gateway"


def has_packages() -> bool:
    """Return whether the packages of the extra `web` are installed."""
    return all(importlib.util.find_spec(package) is not None for package in PACKAGES)


def format_page_address(host: str, port: int, *, secure: bool) -> str:
    """Return the address of the page, as people type it."""
    return f"{'https' if secure else 'http'}://{host_in_address(host)}:{port}/"


class _GatewayChild(ChildProcess):
    """The process, which inherits the listening sockets."""

    def __init__(self, start: GatewayStart) -> None:
        self.inherited = start.config.descriptors
        super().__init__(_MODULE, config=msgspec.msgpack.encode(start), stdout=PIPE, own_session=True)


class GatewayProcess:
    """The gateway of one session, and its successors after a restart.

    Args:
        sockets: Listening sockets; closed by `close`.
        make_config: Returns the configuration, in the thread that starts the process.
    """

    def __init__(self, sockets: Sequence[socket.socket], make_config: Callable[[], GatewayConfig]) -> None:
        self._sockets = tuple(sockets)
        self._make_config = make_config
        self._supervised = SupervisedProcess("the web gateway", self._spawn, GatewayReport)

    @property
    def port(self) -> int:
        """TCP port of the page."""
        return int(self._sockets[0].getsockname()[1])

    @property
    def pid(self) -> int:
        """Process id of the gateway, 0 while there is none."""
        return self._supervised.pid

    @property
    def restarts(self) -> int:
        """Number of its restarts."""
        return self._supervised.restarts

    @property
    def drops(self) -> dict[str, int]:
        """Counters of what this gateway and those before it have refused or dropped, by reason."""
        return self._supervised.drops

    def poll(self, now_ns: int) -> list[str]:
        """Start the process when a connection waits, and again when it has ended. Never waits.

        Args:
            now_ns: A monotonic time.

        Returns:
            What is to be announced, one line each.
        """
        if self._supervised.is_started:
            return self._supervised.poll(now_ns)
        if self._is_connection_waiting():
            self._supervised.start(now_ns)
        return []

    def _is_connection_waiting(self) -> bool:
        waiting = select.poll()
        for one in self._sockets:
            waiting.register(one, select.POLLIN)
        return bool(waiting.poll(0))

    def _spawn(self) -> ChildProcess:
        descriptors = tuple(one.fileno() for one in self._sockets)
        config = msgspec.structs.replace(self._make_config(), descriptors=descriptors)
        return _GatewayChild(GatewayStart(config, os.getpid()))

    def close(self, timeout_s: float = EXIT_S) -> None:
        """End the process, after its browsers have read that the session ends. May be called twice."""
        self._supervised.close(timeout_s)
        for one in self._sockets:
            one.close()
