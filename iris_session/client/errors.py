"""Everything the client raises.

    ClientError
    +-- NotConnectedError      no connection to a session now; the client keeps trying unless it was closed or refused
    +-- RefusedError           the session said no to `hello`: `code`, `message`, `advice`
    |   +-- VersionError       it speaks other protocol versions: `supported_versions`
    +-- DeniedError            the session said no to one request: `denial` (reason, holder, advice); nothing changed
    +-- RequestTimeoutError    no answer in time (also a `TimeoutError`); the request may still take effect
    +-- InvalidMessageError    what was to be sent is not of the protocol (also a `ValueError`); nothing was sent
    +-- IdentityError          the identity file cannot be used
    +-- TrustError             the session's key is not the one that is trusted, or it could not prove the join code
    +-- AssetError             an asset could not be fetched: `address`, `reason`
    +-- SessionNameError       no single session can be meant by that name

Bytes that a server sends and that do not fit the protocol never raise: they are counted in `Client.counters`.
"""

from __future__ import annotations

from iris_session.assets.errors import AssetStoreError
from iris_session.protocol.common import Denial
from iris_session.protocol.server_messages import Refused


class ClientError(Exception):
    """Base of all errors of the client."""


def join_parts(*parts: str) -> str:
    """Those that say something, as one line."""
    return "; ".join(part for part in parts if part)


class NotConnectedError(ClientError):
    """There is no connection to a session."""


class RefusedError(ClientError):
    """The session refused `hello`. `code` is a `RefusalCode` or a `DenialReason`."""

    def __init__(self, refused: Refused) -> None:
        super().__init__(f"refused ({refused.code}): {join_parts(refused.message, refused.advice)}")
        self.code = refused.code
        self.message = refused.message
        self.advice = refused.advice


class VersionError(RefusedError):
    """The session speaks other protocol versions than this client."""

    def __init__(self, refused: Refused) -> None:
        super().__init__(refused)
        self.supported_versions = refused.supported_versions


class DeniedError(ClientError):
    """The session denied a request, and changed nothing."""

    def __init__(self, denial: Denial) -> None:
        name = denial.holder_name or denial.holder
        who = "" if not name or name in denial.message.split() else f"held by {name}"
        super().__init__(f"denied ({denial.reason}): {join_parts(denial.message, who, denial.advice)}")
        self.denial = denial


class RequestTimeoutError(ClientError, TimeoutError):
    """No answer came in time. The request may still take effect: check the leases before you ask again."""


class InvalidMessageError(ClientError, ValueError):
    """The protocol does not take this message, or a value cannot be what its field needs. Nothing was sent."""


class IdentityError(ClientError):
    """The identity file is unreadable, damaged, or readable by others."""


class TrustError(ClientError):
    """The session at an address is not, or cannot be shown to be, the one that is meant. Nothing was said to it."""


class SessionNameError(ClientError):
    """Several sessions have that name, or another one answers where it was heard."""


class AssetError(ClientError):
    """An asset could not be fetched. `address`: empty when it concerns all of them.

    `reason`: an `AssetRefusal`, `hash` (twice the bytes were others than its address says), `protocol`, `decode`,
    `cache` (the folder of the cache cannot be used), `gone` (taken away since), `no_channel`, `cancelled` or `closed`.
    """

    def __init__(self, address: str, reason: str, text: str) -> None:
        super().__init__(text)
        self.address = address
        self.reason = reason

    @classmethod
    def from_store(cls, error: AssetStoreError) -> AssetError:
        """Return the error of a client whose asset store failed."""
        return cls(error.address, error.reason, str(error))
