"""iris-session: several people with XR headsets in one robot scene.

Public API, nothing else is public:

- `Session`, `SessionConfig`: share a MuJoCo scene from your own process. Errors: `SessionError` and its subclasses.
- `SceneBuilder`: compose a scene without MuJoCo, from shapes and files (glTF, URDF, OBJ, STL, ...). Error:
  `SceneBuildError`.
- `ScenePublisher`: share such a scene, moved by another simulator or a real robot. Error: `PublishError`.
- `Client`: join a session from any process. `ClientGroup`, `wait_any`: several clients in one loop. `Identity`,
  `CurveKeys`: who a client is. `SceneState`, `PoseBuffer`: newest and interpolated poses. Errors: `ClientError` and its
  subclasses `NotConnectedError`, `RefusedError`, `DeniedError`, `RequestTimeoutError`, `InvalidMessageError`,
  `TrustError`, `AssetError`. `find_sessions`: sessions on this network, as `FoundSession`.
- `fetch_scene`: specification, meshes and textures of the scene, as `FetchedScene`; `Budget`, `QUEST_3` choose levels
  of detail, `AssetCache` keeps assets. `Deformables`: vertices and triangles of cloths, ropes and soft bodies.

Names are imported on first use, so that a light client does not load MuJoCo.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from iris_session.assets.cache import AssetCache
    from iris_session.client import (
        AssetError,
        Client,
        ClientError,
        ClientGroup,
        CurveKeys,
        DeniedError,
        FoundSession,
        Identity,
        InvalidMessageError,
        NotConnectedError,
        PoseBuffer,
        RefusedError,
        RequestTimeoutError,
        SceneState,
        TrustError,
        find_sessions,
        wait_any,
    )
    from iris_session.client.deformables import Deformables
    from iris_session.client.fetched_scene import FetchedScene, fetch_scene
    from iris_session.scene.budget import QUEST_3, Budget
    from iris_session.scene.compose import SceneBuilder
    from iris_session.scene.errors import SceneBuildError
    from iris_session.session.config import SessionConfig
    from iris_session.session.errors import (
        ConfigError,
        OwnershipError,
        PublishError,
        ResumeError,
        SessionError,
        StartError,
    )
    from iris_session.session.scene_publisher import ScenePublisher
    from iris_session.session.session import Session

_HOME: Final = {
    "Session": "iris_session.session.session",
    "SessionConfig": "iris_session.session.config",
    "SessionError": "iris_session.session.errors",
    "ConfigError": "iris_session.session.errors",
    "StartError": "iris_session.session.errors",
    "ResumeError": "iris_session.session.errors",
    "OwnershipError": "iris_session.session.errors",
    "SceneBuilder": "iris_session.scene.compose",
    "SceneBuildError": "iris_session.scene.errors",
    "ScenePublisher": "iris_session.session.scene_publisher",
    "PublishError": "iris_session.session.errors",
    "Client": "iris_session.client",
    "ClientError": "iris_session.client",
    "DeniedError": "iris_session.client",
    "RefusedError": "iris_session.client",
    "NotConnectedError": "iris_session.client",
    "RequestTimeoutError": "iris_session.client",
    "InvalidMessageError": "iris_session.client",
    "TrustError": "iris_session.client",
    "AssetError": "iris_session.client",
    "ClientGroup": "iris_session.client",
    "wait_any": "iris_session.client",
    "CurveKeys": "iris_session.client",
    "Identity": "iris_session.client",
    "SceneState": "iris_session.client",
    "PoseBuffer": "iris_session.client",
    "AssetCache": "iris_session.assets.cache",
    "FoundSession": "iris_session.client",
    "find_sessions": "iris_session.client",
    "fetch_scene": "iris_session.client.fetched_scene",
    "FetchedScene": "iris_session.client.fetched_scene",
    "Budget": "iris_session.scene.budget",
    "QUEST_3": "iris_session.scene.budget",
    "Deformables": "iris_session.client.deformables",
}

__all__ = [
    "Session",
    "SessionConfig",
    "SessionError",
    "ConfigError",
    "StartError",
    "ResumeError",
    "OwnershipError",
    "SceneBuilder",
    "SceneBuildError",
    "ScenePublisher",
    "PublishError",
    "Client",
    "ClientError",
    "DeniedError",
    "RefusedError",
    "NotConnectedError",
    "RequestTimeoutError",
    "InvalidMessageError",
    "TrustError",
    "AssetError",
    "ClientGroup",
    "wait_any",
    "CurveKeys",
    "Identity",
    "SceneState",
    "PoseBuffer",
    "AssetCache",
    "FoundSession",
    "find_sessions",
    "fetch_scene",
    "FetchedScene",
    "Budget",
    "QUEST_3",
    "Deformables",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'iris_session' has no attribute {name!r}. Public names: {', '.join(__all__)}")
    return getattr(import_module(_HOME[name]), name)
