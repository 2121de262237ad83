"""Address of a session: `HOST:PORT` as typed, or the URI of a pairing QR code, which also carries key and join code."""

from __future__ import annotations

import base64
import binascii
from dataclasses import dataclass, replace
from typing import Final
from urllib.parse import parse_qs, quote, urlsplit

from iris_session.client.errors import ClientError
from iris_session.link.discovery import host_port, is_host
from iris_session.protocol.pairing import KEY_BYTES, normalise_code
from iris_session.security import KeysError, decode_key

DEFAULT_CONTROL_PORT: Final = 7721
SCHEME: Final = "iris"
_EXAMPLE: Final = f"127.0.0.1:{DEFAULT_CONTROL_PORT}"


@dataclass(frozen=True, slots=True)
class Address:
    """Control channel of a session.

    `host`: without brackets. `server_key`: Z85; like `join_code` and `session` only from a URI, else empty.
    """

    host: str
    port: int
    server_key: str = ""
    join_code: str = ""
    session: str = ""

    def __str__(self) -> str:
        return host_port(self.host, self.port)

    @classmethod
    def parse(cls, address: object) -> Address:
        """Parse `host`, `host:port`, `[ipv6]:port`, the same after `tcp://`, or `iris://host:port/?k=...&c=...&n=...`.

        Raises `ClientError` with examples of valid addresses.
        """
        if not isinstance(address, str):
            raise ClientError(f"address {address!r} is a {type(address).__name__}, not text like {_EXAMPLE!r}")
        if address.lower().startswith(f"{SCHEME}://"):
            return _from_uri(address.strip())
        return _from_text(address)


def pairing_uri(host: str, port: int, server_key: str, join_code: str = "", session: str = "") -> str:
    """Return `iris://HOST:CONTROL/?k=KEY&c=CODE&n=NAME`, the content of a pairing QR code.

    `server_key`: Z85; in the URI its 32 raw bytes in base64url without padding.
    """
    key = base64.urlsafe_b64encode(decode_key(server_key)).decode().rstrip("=")
    fields = {"k": key, "c": join_code, "n": session}
    query = "&".join(f"{name}={quote(value, safe='')}" for name, value in fields.items() if value)
    return f"{SCHEME}://{host_port(host, port)}/?{query}"


def _from_text(address: str) -> Address:
    text = address.removeprefix("tcp://").rstrip("/")
    host, separator, port = text.rpartition(":")
    if not separator or (text.count(":") > 1 and not text.startswith("[")) or text.endswith("]"):
        host, port = text, str(DEFAULT_CONTROL_PORT)
    if not is_host(host.strip("[]")) or not _is_port(port):
        raise ClientError(f"address {address!r} is not HOST:PORT, for example {_EXAMPLE}")
    return Address(host.strip("[]"), int(port))


def _is_port(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= 5 and 0 < int(text) < 65536


def _from_uri(address: str) -> Address:
    try:
        parts = urlsplit(address)
        fields = {name: values[-1] for name, values in parse_qs(parts.query).items()}
        where = _from_text(parts.netloc)
        code = fields.get("c", "")
        return replace(
            where,
            server_key=_key_from_uri(fields["k"]) if "k" in fields else "",
            join_code=normalise_code(code) if code else "",
            session=fields.get("n", ""),
        )
    except (ValueError, ClientError, KeysError) as error:
        raise ClientError(
            f"address {address!r} is not the URI of a session, iris://HOST:PORT/?k=KEY&c=CODE: {error}"
        ) from None


def _key_from_uri(text: str) -> str:
    from zmq.utils import z85

    try:
        key = base64.b64decode(text + "=" * (-len(text) % 4), altchars=b"-_", validate=True)
    except binascii.Error as error:
        raise ValueError(f"k={text} is not base64url ({error})") from None
    if len(key) != KEY_BYTES:
        raise ValueError(f"k={text} has {len(key)} bytes, a key has {KEY_BYTES}")
    return z85.encode(key).decode()
