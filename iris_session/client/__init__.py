"""The Python client: what policies, leader robots, emulators and tests join a session with.

A sans-I/O core (`connection`, `session_state`, `state_stream`, `clock`, `interpolation`) and a thin ZeroMQ shell
(`client`, `sockets`). Errors are drawn in `errors`.
"""

from iris_session.assets.store import AssetStore
from iris_session.client.assets import AssetFetch
from iris_session.client.client import Client
from iris_session.client.core.interpolation import PoseBuffer, ShownPoses
from iris_session.client.core.state_stream import SceneState
from iris_session.client.discovery import find_sessions
from iris_session.client.errors import (
    AssetError,
    ClientError,
    DeniedError,
    IdentityError,
    InvalidMessageError,
    NotConnectedError,
    RefusedError,
    RequestTimeoutError,
    SessionNameError,
    TrustError,
    UnreachedError,
    VersionError,
)
from iris_session.client.group import ClientGroup, poll_all, wait_any
from iris_session.client.identity import Identity
from iris_session.client.sockets import CurveKeys
from iris_session.link.discovery import FoundSession
from iris_session.protocol.session_mirror import SessionMirror

__all__ = [
    "AssetStore",
    "AssetFetch",
    "Client",
    "ClientGroup",
    "CurveKeys",
    "FoundSession",
    "Identity",
    "PoseBuffer",
    "SceneState",
    "SessionMirror",
    "ShownPoses",
    "find_sessions",
    "poll_all",
    "wait_any",
    "AssetError",
    "ClientError",
    "DeniedError",
    "IdentityError",
    "InvalidMessageError",
    "NotConnectedError",
    "RefusedError",
    "RequestTimeoutError",
    "SessionNameError",
    "TrustError",
    "UnreachedError",
    "VersionError",
]
