"""The page of a session: its port, its certificate, and the gateway process that serves it.

The session opens the port, so that it is known from the beginning. Without the extra `web`, or where the port is in
use, the session runs without a page and says so in a note.
"""

from __future__ import annotations

import importlib.util
import os
import select
import socket
from collections.abc import Sequence
from typing import Any, Final

import msgspec

from iris_session.link import Ports, addresses_of
from iris_session.link.config import is_loopback
from iris_session.security import KeyHome, KeyPair, KeysError, load_secret
from iris_session.session.config import SessionConfig
from iris_session.session.errors import StartError
from iris_session.system.extras import MissingExtraError
from iris_session.system.process import PIPE, ChildProcess
from iris_session.system.supervised import SupervisedProcess
from iris_session.web.certificate import Certificate, load_certificate, load_or_make_certificate
from iris_session.web.config import WEB_FROM_STATE, GatewayConfig, GatewayReport, GatewayStart, format_page_address
from iris_session.web.listener import open_listening_sockets
from iris_session.web.page import describe_missing_page

#: Time for browsers to read that the session has ended.
EXIT_S: Final = 1.5


class _GatewayChild(ChildProcess):
    """The process, which inherits the listening sockets."""

    def __init__(self, start: GatewayStart) -> None:
        self.inherited = start.config.descriptors
        config = msgspec.msgpack.encode(start)
        super().__init__("iris_session.web.gateway", config=config, stdout=PIPE, own_session=True)


class WebPage:
    """The page of one session; without a port when it has none.

    The gateway process is started when a first connection waits: a session that no browser looks at pays nothing.

    Attributes:
        port: TCP port, 0 for no page. It stays the same whatever happens to the process.
        public_key: Public key (Z85) of the gateway, which the front admits; empty without encryption.
        address: Address of the page, empty before `start` and without a page.
        certificate: Of HTTPS, `None` without encryption.
    """

    def __init__(self, config: SessionConfig, name: str, sockets: Sequence[socket.socket] = (), note: str = "") -> None:
        self._config = config
        self._name = name
        self._sockets = tuple(sockets)
        self._supervised = SupervisedProcess("the web gateway", self._spawn, GatewayReport)
        self._note = note
        self._gateway = GatewayConfig()
        self._keys = KeyPair.generate() if sockets and needs_encryption(config) else None
        self.port = int(sockets[0].getsockname()[1]) if sockets else 0
        self.public_key = "" if self._keys is None else self._keys.public
        self.address = ""
        self.certificate: Certificate | None = None

    def start(self, ports: Ports, asset_root: str) -> list[str]:
        """Let the process start with the first connection; the front listens at `ports`.

        Returns:
            Notes for people about where the page is.

        Raises:
            StartError: The certificate that was given cannot be used.
        """
        if not self._sockets:
            return [self._note] if self._note else []
        config = self._config
        names = tuple(filter(None, (*ports.reachable, config.advertise)))
        note = ""
        secured: dict[str, Any] = {}
        if self._keys is not None:
            try:
                self.certificate = certificate = find_certificate(config, names)
            except (KeysError, MissingExtraError) as error:
                if config.web_cert:
                    raise StartError(str(error)) from None
                self.close()
                return [f"no page for browsers: {error}"]
            note, names = f" (certificate {certificate.fingerprint})", (*names, *certificate.names)
            secured = {
                "server_key": load_server_key(config),
                "public_key": self._keys.public,
                "secret_key": self._keys.secret,
                "certificate_path": str(certificate.certificate_path),
                "key_path": str(certificate.key_path),
                "certificate_hash": certificate.spki_hash,
            }
        self.address = format_page_address(ports.reachable[0], self.port, secure=self._keys is not None)
        self._gateway = GatewayConfig(
            host=find_connect_host(ports),
            control_port=ports.control,
            names=names,
            session_name=self._name,
            asset_root=asset_root,
            **secured,
        )
        return [f"in a browser: {self.address}{note}{describe_missing_page()}"]

    @property
    def pid(self) -> int:
        """Process id of the gateway, 0 while it does not run."""
        return self._supervised.pid

    @property
    def restarts(self) -> int:
        """Restarts of the gateway."""
        return self._supervised.restarts

    @property
    def drops(self) -> dict[str, int]:
        """Counters of what the gateway has refused or dropped, by reason."""
        return self._supervised.drops

    def poll(self, now_ns: int) -> list[str]:
        """Start the process when a browser comes, restart it when it has ended; return what is to be announced."""
        if self._supervised.is_started:
            return self._supervised.poll(now_ns)
        waiting = select.poll()
        for one in self._sockets:
            waiting.register(one, select.POLLIN)
        if self._sockets and waiting.poll(0):
            self._supervised.start(now_ns)
        return []

    def _spawn(self) -> ChildProcess:
        descriptors = tuple(one.fileno() for one in self._sockets)
        return _GatewayChild(GatewayStart(msgspec.structs.replace(self._gateway, descriptors=descriptors), os.getpid()))

    def close(self) -> None:
        """End the process, after its browsers have read that the session ends, and free the port."""
        self._supervised.close(EXIT_S)
        for one in self._sockets:
            one.close()
        self._sockets, self.port, self.address = (), 0, ""


def open_web_page(config: SessionConfig, name: str) -> WebPage:
    """Open the port of a session's page, before its front starts, which tells clients the port.

    Raises:
        StartError: A port that was asked for by number is not free, or a certificate was given that is not used.
    """
    if not config.web:
        return WebPage(config, name)
    if config.web_cert and not needs_encryption(config):
        raise StartError("web_cert: this session is not encrypted, so its page is plain HTTP: add --curve")
    if any(importlib.util.find_spec(package) is None for package in ("aiohttp", "cryptography")):
        return WebPage(config, name, note="no page for browsers: pip install 'iris-session[web]'")
    if config.curve_clients and needs_encryption(config):  # such a folder holds no identities of browsers
        return WebPage(config, name, note="no page for browsers: --curve-clients admits certificates only")
    port = config.web_port
    if port is None:
        port = config.state_port + WEB_FROM_STATE if config.state_port else 0
    try:
        sockets = open_listening_sockets(find_hosts(config), port)
    except OSError as error:
        text = f"port {port} (web) cannot be used: {error.strerror}"
        if config.web_port is not None:
            raise StartError(f"{text}; give another web_port (--web-port), 0 for any free one") from None
        return WebPage(config, name, note=f"no page for browsers: {text}")
    return WebPage(config, name, sockets)


def find_hosts(config: SessionConfig) -> tuple[str, ...]:
    """Return the addresses on which a session listens."""
    return addresses_of(config.interfaces) if config.interfaces else (config.host,)


def find_connect_host(ports: Ports) -> str:
    """Return the address by which processes of this machine reach the front."""
    host = ports.host.strip("[]")
    return "127.0.0.1" if host == "localhost" else host


def load_server_key(config: SessionConfig) -> str:
    """Return the public key (Z85) of a session. The front has read it before."""
    given = config.curve_key
    return (load_secret(given) if given else KeyHome().load_server_key()).public


def needs_encryption(config: SessionConfig) -> bool:
    """Return whether a session is encrypted: always off loopback."""
    return bool(config.curve or config.curve_key) or not all(is_loopback(host) for host in find_hosts(config))


def find_certificate(config: SessionConfig, names: Sequence[str]) -> Certificate:
    """Return the certificate for HTTPS: the one that was given, else that of the key home. Raises `KeysError`."""
    if config.web_cert:
        return load_certificate(config.web_cert, config.web_key)
    return load_or_make_certificate(KeyHome(), names)
