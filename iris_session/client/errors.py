"""Everything the client raises.

    ClientError
    +-- NotConnectedError      no connection to a session now; the client keeps trying unless it was closed or refused
    +-- RefusedError           the session said no to `hello`: `code`, `message`, `advice`
    |   +-- VersionError       it speaks other protocol versions: `supported_versions`
    +-- DeniedError            the session said no to one request: `denial` (reason, holder, advice); nothing changed
    +-- RequestTimeoutError    no answer in time (also a `TimeoutError`); the request may still take effect
    +-- IdentityError          the identity file cannot be used

Bytes that a server sends and that do not fit the protocol never raise: they are counted in `Client.counters`.
"""

from __future__ import annotations

from iris_session.protocol.common import Denial
from iris_session.protocol.server_messages import Refused


class ClientError(Exception):
    """Base of all errors of the client."""


class NotConnectedError(ClientError):
    """There is no connection to a session."""


class RefusedError(ClientError):
    """The session refused `hello`. `code` is a `RefusalCode` or a `DenialReason`."""

    def __init__(self, refused: Refused) -> None:
        advice = f" {refused.advice}" if refused.advice else ""
        super().__init__(f"refused ({refused.code}): {refused.message}{advice}")
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
        who = f" (holder: {denial.holder_name or denial.holder})" if denial.holder else ""
        advice = f" {denial.advice}" if denial.advice else ""
        super().__init__(f"denied ({denial.reason}): {denial.message}{who}{advice}")
        self.denial = denial


class RequestTimeoutError(ClientError, TimeoutError):
    """No answer came in time. The request may still take effect: look at the leases before asking again."""


class IdentityError(ClientError):
    """The identity file is unreadable, damaged, or readable by others."""
