"""Scenes to share: specifications with content-addressed assets, their encodings, levels of detail.

`AssetStore` keeps assets; `decode_mesh`, `decode_image`, `decode_arrays` read them (layouts in docs/scene.md).
`mujoco_scene.parse_mujoco` makes a scene of a MuJoCo model, `builder.SceneBuilder` one of shapes and files;
`budget.choose_levels` fits it to what a client draws. Only modules named `mujoco_*` import MuJoCo.
"""

from iris_session.assets.errors import AssetMissingError
from iris_session.assets.store import AssetStore, Hold, default_root
from iris_session.scene.arrays import decode_arrays, encode_arrays
from iris_session.scene.asset_builder import AssetBuilder, EncodeOptions
from iris_session.scene.errors import AssetDecodeError, SceneBuildError
from iris_session.scene.images import decode_image, encode_image
from iris_session.scene.meshes import MeshArrays, decode_mesh, encode_mesh, encode_mesh_quantised

__all__ = [
    "AssetStore",
    "Hold",
    "default_root",
    "AssetBuilder",
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
    "AssetDecodeError",
    "AssetMissingError",
]
