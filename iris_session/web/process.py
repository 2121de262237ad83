"""The session's side of the gateway process: listening sockets, start with the first connection, restart, end.

The session opens the port, so that it is known from the beginning and stays the same whatever happens to the process.
The process is started when a first connection waits: a session that no browser looks at pays nothing for it. Without
the packages of the extra `web` there is no port, and the session runs as without a gateway.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import select
import socket
import threading
from collections.abc import Callable, Sequence
from typing import Final

import msgspec

from iris_session.link.sockets import host_in_address
from iris_session.system.backoff import Backoff
from iris_session.system.process import PIPE, ChildProcess
from iris_session.web.config import GatewayConfig, GatewayReport, GatewayStart

PACKAGES: Final = ("aiohttp", "cryptography")
RESTART_DELAYS_NS: Final = (0, 500_000_000, 1_000_000_000, 2_000_000_000, 5_000_000_000)
#: A gateway that lived this long counts as healthy again.
HEALTHY_NS: Final = 30_000_000_000
#: Time for browsers to read that the session has ended.
EXIT_S: Final = 1.5
_MODULE: Final = "iris_session.web.gateway"
log = logging.getLogger(__name__)


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

    Attributes:
        report: The newest report of the process.
        restarts: How often it was restarted.
    """

    def __init__(self, sockets: Sequence[socket.socket], make_config: Callable[[], GatewayConfig]) -> None:
        self._sockets = tuple(sockets)
        self._make_config = make_config
        self._process: ChildProcess | None = None
        self._thread: threading.Thread | None = None
        self._failure = ""
        self._announced = ""
        self._backoff = Backoff(RESTART_DELAYS_NS)
        self._started_ns = self._due_ns = 0
        self._closed = False
        self._earlier_drops: dict[str, int] = {}
        self.report = GatewayReport()
        self.restarts = 0

    @property
    def port(self) -> int:
        """TCP port of the page."""
        return int(self._sockets[0].getsockname()[1])

    @property
    def pid(self) -> int:
        """Process id of the gateway, 0 while there is none."""
        return self._process.pid if self._process is not None and self._process.is_running else 0

    @property
    def drops(self) -> dict[str, int]:
        """Counters of what this gateway and those before it have refused or dropped, by reason."""
        reasons = {**self._earlier_drops, **self.report.drops}
        return {one: self._earlier_drops.get(one, 0) + self.report.drops.get(one, 0) for one in reasons}

    def poll(self, now_ns: int) -> list[str]:
        """Start the process when a connection waits, and again when it has ended. Never waits.

        Args:
            now_ns: A monotonic time.

        Returns:
            What is to be announced, one line each.
        """
        if self._thread is not None:
            if self._thread.is_alive():
                return []
            self._thread = None
            if self._failure:
                return self._announce(f"the web gateway does not start: {self._failure}", now_ns)
        if self._process is None:
            if self._due_ns:
                if now_ns >= self._due_ns:
                    self._start(now_ns)
            elif self._is_connection_waiting():
                self._start(now_ns)
            return []
        self._read_reports()
        if self._process.is_running:
            return []
        fault = self.report.fault or f"ended with status {self._process.exit_status}"
        self._process.close()
        self._process = None
        self._earlier_drops, self.report = self.drops, GatewayReport()
        if now_ns - self._started_ns > HEALTHY_NS:
            self._backoff.reset()
            self._announced = ""
        return self._announce(f"the web gateway {fault}; it is started again", now_ns)

    def _announce(self, text: str, now_ns: int) -> list[str]:
        """Set when to try again. Return the line, unless it is the last one again."""
        self._due_ns = now_ns + max(1, self._backoff.next_delay())
        self.restarts += 1
        if text == self._announced:
            return []
        self._announced = text
        return [text]

    def _is_connection_waiting(self) -> bool:
        waiting = select.poll()
        for one in self._sockets:
            waiting.register(one, select.POLLIN)
        return bool(waiting.poll(0))

    def _start(self, now_ns: int) -> None:
        self._started_ns, self._due_ns = now_ns, 0
        self._thread = threading.Thread(target=self._spawn, name="iris-web", daemon=True)
        self._thread.start()

    def _spawn(self) -> None:
        self._failure = ""
        try:
            config = msgspec.structs.replace(
                self._make_config(), descriptors=tuple(one.fileno() for one in self._sockets)
            )
            process = _GatewayChild(GatewayStart(config, os.getpid()))
        except Exception as error:  # no process, no memory, no certificate: the session goes on without a page
            self._failure = " ".join(str(error).split()) or type(error).__name__
            return
        if self._closed:
            process.close()
        else:
            self._process = process

    def _read_reports(self) -> None:
        assert self._process is not None
        try:
            lines = self._process.read_available_lines()
        except OSError:
            return
        for line in lines:
            try:
                self.report = msgspec.json.decode(line, type=GatewayReport)
            except msgspec.MsgspecError:
                log.warning("the web gateway wrote a line that is no report")

    def close(self, timeout_s: float = EXIT_S) -> None:
        """End the process, after its browsers have read that the session ends. May be called twice."""
        self._closed = True
        if self._thread is not None:
            self._thread.join(timeout_s)
            self._thread = None
        if self._process is not None:
            self._process.close(terminate_s=timeout_s)
            self._process = None
        for one in self._sockets:
            one.close()
