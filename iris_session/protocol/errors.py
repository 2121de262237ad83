"""Errors in the bytes of a peer. Each text names the fault and what would have been right.

ProtocolError                base; `code` (a `RefusalCode`) goes into `Refused` or `ProtocolFault` with the text
|-- MalformedError           not MessagePack, or not a message of the schema (unknown type, missing or wrong field)
|-- ProtocolVersionError     another protocol version; `version` is the peer's
|-- TooLargeError            more bytes than the limit of its type
`-- RateError                more messages of a type than its rate allows
"""

from __future__ import annotations

from typing import ClassVar

from iris_session.protocol.names import PROTOCOL_VERSION, RefusalCode

#: Characters of an error text: fits the `Text` of the message that carries it to the peer.
MAX_ERROR_TEXT = 400


class ProtocolError(Exception):
    """Base of all errors of this module. `str(error)` has at most `MAX_ERROR_TEXT` characters: fit for the peer."""

    code: ClassVar[str]

    def __init__(self, text: str) -> None:
        super().__init__(text if len(text) <= MAX_ERROR_TEXT else text[: MAX_ERROR_TEXT - 3] + "...")


class MalformedError(ProtocolError):
    """The bytes are not a message of this protocol."""

    code = RefusalCode.MALFORMED


class ProtocolVersionError(ProtocolError):
    """The peer uses protocol version `version`."""

    code = RefusalCode.VERSION

    def __init__(self, version: int) -> None:
        super().__init__(f"protocol version {version}, this side speaks {PROTOCOL_VERSION}: update the older side")
        self.version = version


class TooLargeError(ProtocolError):
    """A message of `size` bytes, where `limit` are allowed."""

    code = RefusalCode.TOO_LARGE

    def __init__(self, what: str, size: int, limit: int) -> None:
        super().__init__(f"{what} of {size} bytes, at most {limit} are allowed")
        self.size = size
        self.limit = limit


class RateError(ProtocolError):
    """More messages of type `what` than `per_second` (and a burst of `burst`)."""

    code = RefusalCode.RATE

    def __init__(self, what: str, per_second: float, burst: int) -> None:
        super().__init__(f"too many {what} messages: at most {per_second:g} per second, {burst} at once")
