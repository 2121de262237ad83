"""Errors of a running session. Every text is one line that says what would be right.

SessionError
├── ConfigError          a value in the configuration cannot be used
├── StartError           a process of the session did not come up (port in use, unwritable folder)
├── ResumeError          a recording that the session cannot go on from
├── OwnershipError       the call does not fit the way this session is driven
└── PublishError         what a publisher was given cannot be shown
"""

from __future__ import annotations

import reprlib


class SessionError(Exception):
    """Base of all errors that a session raises to its owner."""


class ConfigError(SessionError):
    """A value in the configuration cannot be used."""


class StartError(SessionError):
    """A process of the session did not come up."""


class ResumeError(SessionError):
    """The session cannot go on from this recording."""


class OwnershipError(SessionError):
    """The call does not fit the way this session is driven."""


class PublishError(SessionError):
    """What a publisher was given cannot be shown; nothing has changed."""


def brief(given: object) -> str:
    """What somebody gave, for an error text: on one line, however large it is."""
    return " ".join(reprlib.repr(given).split())
