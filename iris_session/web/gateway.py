"""The gateway process: `python -m iris_session.web.gateway`, with `GatewayStart` on standard input.

It composes the hub, the sockets to the session (`session_link`) and the web server, and reports to its parent.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import gc
import logging
import os
import secrets
import signal
import socket
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Final

import msgspec

from iris_session.assets.store import AssetStore, default_root
from iris_session.client.core.status import ConnectionPhase
from iris_session.link.sockets import raise_descriptor_limit
from iris_session.protocol.limits import Drops
from iris_session.system.log import RepetitionFilter, configure_logging
from iris_session.system.process import die_with_parent, is_parent
from iris_session.web.assets import GatewayAssets
from iris_session.web.certificate import list_host_names, make_tls_context
from iris_session.web.config import GatewayReport, GatewayStart
from iris_session.web.hub import TICKET_BYTES, Hub
from iris_session.web.listener import Listener, open_listening_sockets
from iris_session.web.origin import HostCheck
from iris_session.web.page import PageFiles
from iris_session.web.server import WebServer
from iris_session.web.session_link import SessionLink
from iris_session.web.wire import CLOSE_RESTART

log = logging.getLogger(__name__)

TICK_S: Final = 0.02
REPORT_S: Final = 1.0
#: Period in which the C library gives free memory back: what many slow readers leave is in pieces between other blocks.
TRIM_S: Final = 10.0
#: Time for browsers to read why they are closed.
FAREWELL_S: Final = 0.5
#: Longest time for which another thread (files of assets) keeps the loop from running.
SWITCH_S: Final = 0.0005


class Gateway:
    """One gateway: the hub, the session's side and the web server."""

    def __init__(self, start: GatewayStart) -> None:
        self._config = start.config
        self._parent_pid = start.parent_pid
        self._ending = asyncio.Event()
        self._drops = Drops()
        self._hub = Hub(start.config.limits, self._drops)
        self._superseded = 0
        self._written = GatewayReport()
        self._report_at = 0.0
        self._port = 0
        self.fault = ""

    def end(self) -> None:
        """Let `run` return."""
        self._ending.set()

    async def run(self) -> None:
        """Serve until `end`, or until the parent process ends. Raises `OSError` for a port or file that is no use."""
        config = self._config
        tls = make_tls_context(Path(config.certificate_path), Path(config.key_path)) if config.key_path else None
        sockets = [socket.socket(fileno=one) for one in config.descriptors]
        sockets = sockets or open_listening_sockets(config.hosts, config.port)
        self._port = sockets[0].getsockname()[1]
        link = SessionLink(config, self._hub)
        store = AssetStore(config.asset_root or default_root("client-assets"))
        assets = GatewayAssets(store, link.connection, link.make_asset_sockets(), link.open_assets, self._drops)
        names = (*config.names, *list_host_names())
        server = WebServer(self._hub, link, assets, HostCheck(names, secure=tls is not None), PageFiles())
        listener = Listener(await server.start(), tls, self._drops)
        server.attach(listener)
        link.open()
        listener.listen(sockets)
        try:
            await self._work(link, assets, listener)
        finally:
            self._hub.close_all(CLOSE_RESTART, "the gateway ends: come again")
            await asyncio.sleep(FAREWELL_S if len(self._hub) else 0.0)
            for one in sockets:
                one.close()
            await listener.close()
            await server.close()
            await assets.close()
            link.close()

    async def _work(self, link: SessionLink, assets: GatewayAssets, listener: Listener) -> None:
        """Do what is due, until the end."""
        hub = self._hub
        epoch, trim_at = 0, 0.0
        while not self._ending.is_set():
            link.tick()
            now_ns = time.monotonic_ns()
            if link.find_epoch() != epoch:
                epoch = link.find_epoch()
                assets.close_link()
            for browser in hub:
                if hub.needs_ticket(browser, now_ns):
                    hub.issue_ticket(browser, secrets.token_bytes(TICKET_BYTES), now_ns)
                self._superseded += browser.superseded
                browser.superseded = 0
            hub.tick(now_ns)
            if time.monotonic() >= trim_at:
                trim_at = time.monotonic() + TRIM_S
                with contextlib.suppress(OSError, AttributeError):  # another library than that of GNU
                    ctypes.CDLL(None).malloc_trim(0)
            if self._parent_pid and not is_parent(self._parent_pid):
                return
            if link.connection.phase is ConnectionPhase.REFUSED:
                self.fault = f"the session does not admit the gateway: {link.fault}"
                self._report(assets, listener, force=True)
                return
            self._report(assets, listener)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(TICK_S):
                    await self._ending.wait()

    def _report(self, assets: GatewayAssets, listener: Listener, *, force: bool = False) -> None:
        """Write a report if something has changed. A parent that does not read it is not waited for."""
        now = time.monotonic()
        if not self._parent_pid or (now < self._report_at and not force):
            return
        self._report_at = now + REPORT_S
        report = GatewayReport(
            self._port,
            len(self._hub),
            len(listener),
            self._superseded,
            assets.fetched,
            assets.fetched_bytes,
            dict(self._drops.by_reason),
            self.fault,
        )
        if report != self._written:
            self._written = report
            with contextlib.suppress(OSError):
                os.write(sys.stdout.fileno(), msgspec.json.encode(report) + b"\n")


async def serve(start: GatewayStart) -> str:
    """Run a gateway until a signal or the end of its parent. Return why it ended by itself, empty otherwise."""
    gateway = Gateway(start)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, gateway.end)
    gc.collect()
    gc.freeze()
    try:
        await gateway.run()
    except OSError as error:
        return f"the gateway cannot start: {error.strerror or error}"
    return gateway.fault


def main() -> int:
    """Run the gateway of one session. Exit status 1 if it cannot start, or is not admitted."""
    configure_logging()
    if logging.lastResort is not None:  # of asyncio: a line for every write to a closed connection
        logging.lastResort.addFilter(RepetitionFilter())
    start = msgspec.msgpack.decode(sys.stdin.buffer.read(), type=GatewayStart)
    raise_descriptor_limit()
    sys.setswitchinterval(SWITCH_S)
    os.set_blocking(sys.stdout.fileno(), False)
    if start.parent_pid:

        def on_hangup(_number: int, _frame: FrameType | None) -> None:
            return  # the loop looks for its parent

        signal.signal(signal.SIGHUP, on_hangup)
        die_with_parent(signal.SIGHUP)
    fault = asyncio.run(serve(start))
    if fault:
        with contextlib.suppress(OSError):
            os.write(sys.stdout.fileno(), msgspec.json.encode(GatewayReport(fault=fault)) + b"\n")
        log.error("%s", fault)
    return 1 if fault else 0


if __name__ == "__main__":
    sys.exit(main())
