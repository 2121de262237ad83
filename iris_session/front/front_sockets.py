"""The sockets of the front: opened together, or not at all. What comes by them is for `loop`."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import msgspec
import zmq

from iris_session.front.announce import choose_address_host, list_reachable_hosts
from iris_session.front.asset_server import AssetSockets, open_asset_sockets
from iris_session.front.introduction import Listeners, open_with_introduction
from iris_session.link import messages as link
from iris_session.link.config import FrontError, FrontStart, Ports
from iris_session.link.sockets import (
    IO_THREADS,
    bound_port,
    open_control,
    open_ingest,
    open_local_ingest,
    open_media,
    open_state,
    watch_tcp,
)
from iris_session.protocol.limits import Drops
from iris_session.security import KeysError
from iris_session.security.keyring import Keyring, open_keyring
from iris_session.security.zap import Authenticator


class Watched(NamedTuple):
    """A socket, and what tells of its TCP connections."""

    socket: zmq.Socket[bytes]
    monitor: zmq.Socket[bytes]


class FrontSockets:
    """`link`: to the authority. `control`, `state`, `media`: for clients. `ingest`, `local_ingest`: for media sources,
    on other machines and of this session. `assets`: theirs is a context of its own. `listeners`: of the introduction.

    Raises `FrontError` when one cannot be opened; the authority has been told why then, and all are closed. `refused`:
    told the fingerprint and the address of every key that was not let in.
    """

    def __init__(self, start: FrontStart, drops: Drops, refused: Callable[[str, str], None]) -> None:
        self._config = start.config
        self._drops = drops
        self._state_sockets = 0
        self.assets: AssetSockets
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context(IO_THREADS)
        self.link = self.context.socket(zmq.PAIR)
        self.link.setsockopt(zmq.LINGER, 1000)
        self.link_monitor = watch_tcp(self.link, "link", zmq.EVENT_DISCONNECTED)
        self.link.connect(start.link_endpoint)
        try:
            self._open(refused)
        except FrontError as error:
            self.link.send_multipart((link.FAILED, str(error).encode()))
            self.close()
            raise

    def _open(self, refused: Callable[[str, str], None]) -> None:
        config = self._config
        self.keyring = self._open_keyring()
        key = self.keyring.key
        self.authenticator = Authenticator(self.context, self.keyring, self._drops, refused) if key else None
        self.listeners: Listeners
        control, self.listeners = open_with_introduction(
            config.hosts, config.control_port, lambda port: open_control(self.context, config, key, port)
        )
        try:
            self.state = self.open_state(config.state_port)
            media = open_media(self.context, config, key)
            ingest = open_ingest(self.context, config, key)
            self.assets = open_asset_sockets(config, key)
        except FrontError:
            for listener in self.listeners:
                listener.close()
            raise
        self.media = Watched(media, watch_tcp(media, "media"))
        self.ingest = Watched(ingest, watch_tcp(ingest, "ingest"))
        endpoint = config.media_endpoint
        self.local_ingest = open_local_ingest(self.context, endpoint) if endpoint else None
        self.control = Watched(control, watch_tcp(control, "control"))
        self.ports = Ports(
            choose_address_host(config),
            bound_port(control),
            bound_port(self.state.socket),
            key.fingerprint if key else "",
            list_reachable_hosts(config),
            bound_port(media),
            bound_port(ingest),
            bound_port(self.assets.socket),
        )

    def _open_keyring(self) -> Keyring:
        """Return the session's keyring, an empty one on plain loopback. Raises `FrontError`."""
        config = self._config
        if config.loopback and not (config.curve or config.curve_secret_file):
            return Keyring(drops=self._drops)
        try:
            return open_keyring(config.key_home, config.curve_secret_file, config.curve_clients_dir, self._drops)
        except KeysError as error:
            raise FrontError(str(error)) from error

    def open_state(self, port: int) -> Watched:
        """A state socket; the one before must be closed. Raises `FrontError` while its port is not free yet."""
        state = open_state(self.context, msgspec.structs.replace(self._config, state_port=port), self.keyring.key)
        self._state_sockets += 1
        return Watched(state, watch_tcp(state, f"state-{self._state_sockets}"))

    def close(self) -> None:
        """Closes every socket; what was sent leaves within its linger time."""
        self.context.destroy()
