"""Start configuration of the gateway process, the report that it writes, and ports. Plain data, no behaviour.

The gateway reads `GatewayStart` as MessagePack from its standard input, never from its arguments, and writes
`GatewayReport`s to its standard output, a line of JSON each.
"""

from __future__ import annotations

from typing import Final

import msgspec

from iris_session.link.sockets import host_in_address
from iris_session.web.hub import HubLimits

#: Port of the page by default.
WEB_PORT: Final = 7725
#: Port of the page, from those of control and state, in every block of ports.
WEB_FROM_CONTROL: Final = 4
WEB_FROM_STATE: Final = 3


class GatewayConfig(msgspec.Struct, frozen=True):
    """Configuration of a gateway.

    Attributes:
        host, control_port: Control channel of the session.
        server_key, public_key, secret_key: CURVE keys as Z85 text, of the session and of the gateway; empty for a
            session without encryption.
        hosts, port: Addresses to listen on, and the port, unless listening sockets are handed over.
        descriptors: Listening sockets that the process inherits.
        certificate_path, key_path: PEM files for HTTPS; empty: plain HTTP.
        certificate_hash: SHA-256 of the SubjectPublicKeyInfo of the certificate.
        names: Host names by which browsers may reach this machine, besides its addresses.
        session_name: Name of the session, until its `welcome` says it.
        asset_root: Folder of the session's asset store on this machine, empty for one of the user's cache.
        limits: Of browsers.
    """

    host: str = "127.0.0.1"
    control_port: int = 7721
    server_key: str = ""
    public_key: str = ""
    secret_key: str = ""
    hosts: tuple[str, ...] = ("127.0.0.1",)
    port: int = WEB_PORT
    descriptors: tuple[int, ...] = ()
    certificate_path: str = ""
    key_path: str = ""
    certificate_hash: bytes = b""
    names: tuple[str, ...] = ()
    session_name: str = ""
    asset_root: str = ""
    limits: HubLimits = HubLimits()


class GatewayStart(msgspec.Struct, frozen=True):
    """Standard input of the gateway process. `parent_pid` 0: it ends by a signal only."""

    config: GatewayConfig
    parent_pid: int = 0


class GatewayReport(msgspec.Struct, frozen=True):
    """State of a gateway, written when it has changed, at most once a second.

    Attributes:
        port: TCP port on which it listens.
        browsers, connections: WebSockets for control, and TCP connections, now.
        superseded: Messages of state that were replaced by newer ones before they were sent.
        fetched, fetched_bytes: Assets that were fetched from the session, and bytes of them.
        drops: Refused and dropped messages, requests and connections, by reason.
        fault: Why it ended or has no session, empty while all is well.
    """

    port: int = 0
    browsers: int = 0
    connections: int = 0
    superseded: int = 0
    fetched: int = 0
    fetched_bytes: int = 0
    drops: dict[str, int] = {}
    fault: str = ""


def format_page_address(host: str, port: int, *, secure: bool) -> str:
    """Return the address of the page, as people type it."""
    return f"{'https' if secure else 'http'}://{host_in_address(host)}:{port}/"
