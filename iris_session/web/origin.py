"""Protection against other sites: `Host` and `Origin` of requests, security headers of answers. No sockets."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Collection
from typing import Final
from urllib.parse import urlsplit

from iris_session.web.certificate import normalise_name

_HOST: Final = re.compile(r"(?P<name>\[[0-9A-Fa-f:.%]+\]|[A-Za-z0-9._-]{1,253})(:(?P<port>\d{1,5}))?")


def make_security_headers(host: str) -> dict[str, str]:
    """Return the headers of every answer. `host`: value of `Host`, checked by `HostCheck`; empty if it is not allowed.

    `connect-src` names the WebSockets too, because not every browser counts them as `'self'`.
    """
    sockets = f" ws://{host} wss://{host}" if host else ""
    policy = (
        f"default-src 'self'; connect-src 'self'{sockets}; script-src 'self' 'wasm-unsafe-eval'; "
        "worker-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
        "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return {
        "Content-Security-Policy": policy,
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Permissions-Policy": "camera=(), microphone=(), geolocation=(), payment=()",
        "Server": "iris-session",
    }


class HostCheck:
    """Check of `Host` and `Origin`, against pages of other sites that speak to a gateway in a private network.

    A page of another site has another origin. It can have its own name point to this machine (DNS rebinding); so a name
    must be one of this machine, while an address needs no resolver and is always right. What is not encrypted is for
    programs on this machine only: `localhost` and loopback addresses.

    Args:
        names: Names of this machine.
        secure: The gateway speaks HTTPS.
    """

    def __init__(self, names: Collection[str], *, secure: bool) -> None:
        known = map(normalise_name, names) if secure else ()
        self._names = frozenset(filter(None, (*known, "localhost")))
        self._scheme = "https" if secure else "http"

    def find_host(self, host: str | None) -> str:
        """Return the value of a `Host` header if it names this machine, else an empty text."""
        match = _HOST.fullmatch(host or "")
        if match is None or host is None:
            return ""
        name = normalise_name(match["name"])
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return host if name in self._names else ""
        return host if address.is_loopback or self._scheme == "https" else ""

    def is_own_origin(self, origin: str | None, host: str) -> bool:
        """Return whether a request comes from our own page, or from no page at all (an app sends no `Origin`)."""
        if origin is None:
            return True
        try:
            parts = urlsplit(origin)
        except ValueError:
            return False
        return parts.scheme == self._scheme and parts.netloc.lower() == host.lower() and not parts.path
