"""iris-session: several people with XR headsets in one robot scene.

Public API, nothing else is public:

- `Session`, `SessionConfig`: share a MuJoCo scene from your own process. Errors: `SessionError` and its subclasses.
- `Client`: join a session from any process. Errors: `ClientError` and its subclasses. `find_sessions`: those on this
  network, as `FoundSession`.

Names are imported on first use, so that a light client does not load MuJoCo.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from iris_session.client import Client, ClientError, FoundSession, find_sessions
    from iris_session.runtime.config import SessionConfig
    from iris_session.runtime.errors import ConfigError, OwnershipError, ResumeError, SessionError, StartError
    from iris_session.runtime.session import Session

_HOME: Final = {
    "Session": "iris_session.runtime.session",
    "SessionConfig": "iris_session.runtime.config",
    "SessionError": "iris_session.runtime.errors",
    "ConfigError": "iris_session.runtime.errors",
    "StartError": "iris_session.runtime.errors",
    "ResumeError": "iris_session.runtime.errors",
    "OwnershipError": "iris_session.runtime.errors",
    "Client": "iris_session.client",
    "ClientError": "iris_session.client",
    "FoundSession": "iris_session.client",
    "find_sessions": "iris_session.client",
}

__all__ = [
    "Session",
    "SessionConfig",
    "SessionError",
    "ConfigError",
    "StartError",
    "ResumeError",
    "OwnershipError",
    "Client",
    "ClientError",
    "FoundSession",
    "find_sessions",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'iris_session' has no attribute {name!r}. Public names: {', '.join(__all__)}")
    return getattr(import_module(_HOME[name]), name)
