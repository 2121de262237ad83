"""Open enumerations of the scene specification and of its assets, as `names` has those of messages."""

from __future__ import annotations

from typing import Final

#: Version of `SceneSpec` that this package writes and reads.
SCENE_VERSION: Final = 1


class GeometryKind:
    """Shape of a visual. Sizes are those of `Geometry.size`."""

    PLANE: Final = "plane"
    HFIELD: Final = "hfield"
    SPHERE: Final = "sphere"
    CAPSULE: Final = "capsule"
    ELLIPSOID: Final = "ellipsoid"
    CYLINDER: Final = "cylinder"
    BOX: Final = "box"
    MESH: Final = "mesh"
    SDF: Final = "sdf"  # a signed distance field, which comes as the mesh of its surface
    ALL: Final = frozenset({"plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf"})


class TextureKind:
    """How a texture covers what wears it."""

    IMAGE: Final = "2d"
    CUBE: Final = "cube"  # looked up by the direction from the visual's centre
    SKYBOX: Final = "skybox"  # around the whole scene
    ALL: Final = frozenset({"2d", "cube", "skybox"})


class TextureRole:
    """What a texture gives to a material. `rgb`, `rgba`: its colour, the only one that every client must draw."""

    RGB: Final = "rgb"
    OCCLUSION: Final = "occlusion"
    ROUGHNESS: Final = "roughness"
    METALLIC: Final = "metallic"
    NORMAL: Final = "normal"
    OPACITY: Final = "opacity"
    EMISSIVE: Final = "emissive"
    RGBA: Final = "rgba"
    ORM: Final = "orm"  # occlusion, roughness, metallic in r, g, b
    USER: Final = "user"


class ColorSpace:
    """How the numbers of a texture are meant. `auto`: as they are, without conversion."""

    AUTO: Final = "auto"
    LINEAR: Final = "linear"
    SRGB: Final = "srgb"


class LightKind:
    SPOT: Final = "spot"
    DIRECTIONAL: Final = "directional"
    POINT: Final = "point"
    IMAGE: Final = "image"  # a texture lights the scene from all around
    ALL: Final = frozenset({"spot", "directional", "point", "image"})


class Follow:
    """How a light or camera moves. Unknown values: like `fixed`."""

    FIXED: Final = "fixed"  # with its body, by its pose in the body
    TRACK: Final = "track"  # position with its body, orientation fixed in the world
    TRACK_COM: Final = "trackcom"  # as `track`, with the centre of mass of the body's subtree
    TARGET_BODY: Final = "targetbody"  # position with its body, looks at the target's frame
    TARGET_BODY_COM: Final = "targetbodycom"  # as `targetbody`, at the centre of mass of the target's subtree


class AssetEncoding:
    """What the bytes of an asset are."""

    ARRAYS: Final = "arrays"  # `protocol.arrays`: a header and compressed arrays
    PNG: Final = "png"
    JPEG: Final = "jpeg"
    OPAQUE: Final = "opaque"  # a texture in a form of its own, for example KTX: as the simulator has it


class ArrayKind:
    """What the arrays of an asset are together."""

    MESH: Final = "mesh"
    IMAGE: Final = "image"
    GRID: Final = "grid"  # a height field
    DEFORMABLE: Final = "deformable"  # the topology and rest shape of a deformable


class ArrayName:
    """What an array of an asset is; which ones a kind has is in docs/scene.md."""

    INDEX: Final = "index"  # of a mesh: three corners a triangle
    POSITION: Final = "position"
    NORMAL: Final = "normal"
    UV: Final = "uv"
    COLOR: Final = "color"  # of corners, 0..255: multiplies the colour of what wears the mesh
    PIXELS: Final = "pixels"
    ELEVATION: Final = "elevation"
    ELEMENTS: Final = "elements"  # of a deformable: two vertices an edge, three a triangle
    VERTEX: Final = "vertex"  # of a deformable: numbers in the simulator
    PLAN: Final = "plan"  # of a deformable's stream


class ArrayFilter:
    """What was done to an array before it was compressed."""

    NONE: Final = "none"
    SHUFFLE: Final = "shuffle"  # first bytes of all elements, then second bytes, ...
    DELTA: Final = "delta"  # differences of consecutive elements modulo 2^bits, then `shuffle`
    UP: Final = "up"  # bytes minus the byte one row above, modulo 256


class ArrayCodec:
    NONE: Final = "none"
    ZSTD: Final = "zstd"  # one Zstandard frame (RFC 8878), without a dictionary
