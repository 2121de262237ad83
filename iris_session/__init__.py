"""Put several people with XR headsets into one robot scene.

The names of this package are the public API; everything below it may change.

- Share a MuJoCo program or a model file: `share`, `Session`, `SessionConfig`, with `AuthorityConfig` and
  `ControlConfig`.
- Share another world: `SceneBuilder` composes a scene, `ScenePublisher` moves it.
- Join a session: `Client`, `find_sessions`, `fetch_scene`, `Deformables`.
- Read a recording: `Recording`.

Names are imported on first use, so that a light client does not load MuJoCo.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from anchors.camera import CameraModel
    from iris_session.assets.errors import AssetMissingError, AssetStoreError
    from iris_session.assets.store import AssetStore
    from iris_session.authority.config import AuthorityConfig
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
        UnreachedError,
        find_sessions,
        wait_any,
    )
    from iris_session.client.deformables import Deformables
    from iris_session.client.fetched_scene import FetchedScene, fetch_scene
    from iris_session.client.robot_env import RobotEnv
    from iris_session.cloud.voxels import DepthLimits, PointSet, Rays, VoxelFilter, choose_voxel_m, make_rays
    from iris_session.control.config import ControlConfig
    from iris_session.demo.named_scenes import scene_by_name
    from iris_session.demo.scenes import n_arms_scene, scene_path
    from iris_session.physics import load_model, load_robots_toml
    from iris_session.protocol.common import Pose
    from iris_session.protocol.errors import IrisError
    from iris_session.protocol.media import StreamCamera, StreamInfo
    from iris_session.protocol.names import HoldReason
    from iris_session.protocol.scene import (
        AddMaterial,
        AddMesh,
        AddVisual,
        Geometry,
        RemoveVisual,
        SetVisual,
        Visual,
    )
    from iris_session.protocol.server_messages import ParticipantJoined, RobotState
    from iris_session.protocol.specs import ObjectSpec, RobotSpec
    from iris_session.recording import RecordingError
    from iris_session.replay.recorded_session import Recording
    from iris_session.scene.budget import QUEST_3, Budget
    from iris_session.scene.builder import SceneBuilder
    from iris_session.scene.errors import SceneBuildError
    from iris_session.scene.mujoco_scene import parse_mujoco
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
    from iris_session.session.share import share
    from iris_session.session.status import DataFault
    from iris_session.session.stepper import OwnerRequest
    from iris_session.streams.cloud import CloudFrame, decode_cloud, encode_cloud
    from iris_session.streams.deformable import DeformableDecoder, DeformableEncoder
    from iris_session.streams.deformable_topology import DeformableTopology

#: Module -> public names that live there.
_PUBLIC: Final = {
    "iris_session.session.share": ("share",),
    "iris_session.session.session": ("Session",),
    "iris_session.session.config": ("SessionConfig",),
    "iris_session.session.errors": (
        "SessionError",
        "ConfigError",
        "StartError",
        "ResumeError",
        "OwnershipError",
        "PublishError",
    ),
    "iris_session.session.scene_publisher": ("ScenePublisher",),
    "iris_session.session.stepper": ("OwnerRequest",),
    "iris_session.session.status": ("DataFault",),
    "iris_session.authority.config": ("AuthorityConfig",),
    "iris_session.control.config": ("ControlConfig",),
    "iris_session.protocol.specs": ("RobotSpec", "ObjectSpec"),
    "iris_session.physics": ("load_model", "load_robots_toml"),
    "iris_session.demo.scenes": ("scene_path", "n_arms_scene"),
    "iris_session.demo.named_scenes": ("scene_by_name",),
    "iris_session.scene.builder": ("SceneBuilder",),
    "iris_session.scene.errors": ("SceneBuildError",),
    "iris_session.scene.mujoco_scene": ("parse_mujoco",),
    "iris_session.scene.budget": ("Budget", "QUEST_3"),
    "iris_session.assets.store": ("AssetStore",),
    "iris_session.assets.errors": ("AssetStoreError", "AssetMissingError"),
    "iris_session.protocol.common": ("Pose",),
    "iris_session.protocol.errors": ("IrisError",),
    "iris_session.protocol.media": ("StreamInfo", "StreamCamera"),
    "iris_session.protocol.scene": (
        "Geometry",
        "Visual",
        "SetVisual",
        "AddVisual",
        "RemoveVisual",
        "AddMesh",
        "AddMaterial",
    ),
    "iris_session.protocol.names": ("HoldReason",),
    "iris_session.protocol.server_messages": ("ParticipantJoined", "RobotState"),
    "iris_session.client": (
        "Client",
        "ClientGroup",
        "wait_any",
        "Identity",
        "CurveKeys",
        "SceneState",
        "PoseBuffer",
        "ClientError",
        "NotConnectedError",
        "RefusedError",
        "DeniedError",
        "RequestTimeoutError",
        "InvalidMessageError",
        "TrustError",
        "UnreachedError",
        "AssetError",
        "FoundSession",
        "find_sessions",
    ),
    "iris_session.client.fetched_scene": ("fetch_scene", "FetchedScene"),
    "iris_session.client.deformables": ("Deformables",),
    "iris_session.client.robot_env": ("RobotEnv",),
    "iris_session.streams.cloud": ("encode_cloud", "decode_cloud", "CloudFrame"),
    "iris_session.cloud.voxels": ("VoxelFilter", "PointSet", "Rays", "DepthLimits", "make_rays", "choose_voxel_m"),
    "anchors.camera": ("CameraModel",),
    "iris_session.streams.deformable": ("DeformableEncoder", "DeformableDecoder"),
    "iris_session.streams.deformable_topology": ("DeformableTopology",),
    "iris_session.recording": ("RecordingError",),
    "iris_session.replay.recorded_session": ("Recording",),
}
_HOME: Final = {name: module for module, names in _PUBLIC.items() for name in names}

__all__ = [
    "share",
    "Session",
    "SessionConfig",
    "AuthorityConfig",
    "ControlConfig",
    "RobotSpec",
    "ObjectSpec",
    "IrisError",
    "SessionError",
    "ConfigError",
    "StartError",
    "ResumeError",
    "OwnershipError",
    "OwnerRequest",
    "DataFault",
    "load_model",
    "load_robots_toml",
    "scene_path",
    "scene_by_name",
    "n_arms_scene",
    # scenes
    "SceneBuilder",
    "SceneBuildError",
    "ScenePublisher",
    "PublishError",
    "parse_mujoco",
    "AssetStore",
    "AssetStoreError",
    "AssetMissingError",
    "Pose",
    "Geometry",
    "Visual",
    "SetVisual",
    "AddVisual",
    "RemoveVisual",
    "AddMesh",
    "AddMaterial",
    # clients
    "Client",
    "ClientGroup",
    "wait_any",
    "Identity",
    "CurveKeys",
    "SceneState",
    "RobotState",
    "PoseBuffer",
    "ClientError",
    "NotConnectedError",
    "RefusedError",
    "DeniedError",
    "RequestTimeoutError",
    "InvalidMessageError",
    "TrustError",
    "UnreachedError",
    "AssetError",
    "FoundSession",
    "find_sessions",
    "HoldReason",
    "fetch_scene",
    "FetchedScene",
    "Budget",
    "QUEST_3",
    "RobotEnv",
    "Deformables",
    "DeformableEncoder",
    "DeformableDecoder",
    "DeformableTopology",
    "encode_cloud",
    "decode_cloud",
    "CloudFrame",
    "StreamInfo",
    "StreamCamera",
    "CameraModel",
    "VoxelFilter",
    "PointSet",
    "Rays",
    "DepthLimits",
    "make_rays",
    "choose_voxel_m",
    # recordings
    "Recording",
    "RecordingError",
    "ParticipantJoined",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'iris_session' has no attribute {name!r}. Public names: {', '.join(__all__)}")
    return getattr(import_module(_HOME[name]), name)
