"""Scenes to share: MuJoCo models as specifications with content-addressed assets, their encodings, levels of detail.

Imports only `protocol`. `parse_mujoco` makes, `AssetStore` keeps, `decode_mesh`, `decode_image` and `decode_arrays` read
(layouts in docs/scene.md); `choose_levels` fits a scene to what a client can draw. MuJoCo is imported by `parse_mujoco`
alone: take it from `iris_session.scene.mujoco_scene`.
"""

from iris_session.scene.arrays import decode_arrays, encode_arrays
from iris_session.scene.build import Builder, EncodeOptions
from iris_session.scene.errors import AssetError, AssetMissingError, SceneBuildError, SceneUnsupportedError
from iris_session.scene.images import decode_image, encode_image
from iris_session.scene.meshes import MeshArrays, decode_mesh, encode_mesh, encode_mesh_quantised
from iris_session.scene.store import AssetStore, Hold, default_root

__all__ = [
    "AssetStore",
    "Hold",
    "default_root",
    "Builder",
    "EncodeOptions",
    "MeshArrays",
    "encode_mesh",
    "encode_mesh_quantised",
    "decode_mesh",
    "encode_image",
    "decode_image",
    "encode_arrays",
    "decode_arrays",
    "SceneBuildError",
    "AssetError",
    "AssetMissingError",
    "SceneUnsupportedError",
]
