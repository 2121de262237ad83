"""Errors of a running session. Every text is one line that says what would be right.

SessionError
├── ConfigError          a value in the configuration cannot be used
├── StartError           a process of the session did not come up (port in use, unwritable folder)
├── ResumeError          a recording that cannot be continued
├── OwnershipError       the call does not fit the way this session is driven
└── PublishError         a pose, joint, mesh or time that cannot be published
"""

from __future__ import annotations

import reprlib

from iris_session.protocol.errors import IrisError


class SessionError(IrisError):
    """Base of all errors that a session raises to its owner."""


class ConfigError(SessionError):
    """A value in the configuration cannot be used."""


class StartError(SessionError):
    """A process of the session did not come up."""


class ResumeError(SessionError):
    """The recording cannot be continued."""


class OwnershipError(SessionError):
    """The call does not fit the way this session is driven."""


class PublishError(SessionError):
    """A pose, joint, mesh or time that cannot be published; nothing has changed."""


def short_repr(value: object) -> str:
    """Return a one-line repr of a value, truncated for error messages."""
    return " ".join(reprlib.repr(value).split())
