"""The parts of a scene specification that refer to assets: materials, textures, meshes, height fields."""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from iris_session.protocol.common import Count, Name, Text, Vec3
from iris_session.protocol.scene_names import AssetEncoding, TextureRole

#: SHA-256 of the bytes of an asset, as 64 hex digits.
Address = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
#: Index into a list of the specification, or -1 for none.
Ref = Annotated[int, msgspec.Meta(ge=-1, le=2**31 - 1)]
#: A small number: of a group, of pixels.
Int32 = Annotated[int, msgspec.Meta(ge=-(2**31), le=2**31 - 1)]
#: Levels of detail of a mesh or texture: each halves the sides, so 32 are more than any image has.
MAX_LEVELS: Final = 32
Rgb = tuple[float, float, float]
Rgba = tuple[float, float, float, float]
Vec2 = tuple[float, float]


class TextureUse(msgspec.Struct, frozen=True):
    """A texture in one `TextureRole`."""

    role: Name
    texture: Ref


class Material(msgspec.Struct, frozen=True):
    """How a surface looks, in MuJoCo's terms. `specular`, `shininess` (times 128: exponent), `reflectance`: 0..1.

    `emission`: light of its own, times the colour. `metallic`, `roughness`: -1 where the scene does not say. The
    texture's colour multiplies that of the visual. `repeat`: times that a 2d texture is laid over the shape, or over
    one metre when `uniform` (docs/scene.md, texture coordinates).
    """

    name: Text
    rgba: Rgba
    emission: float = 0.0
    specular: float = 0.5
    shininess: float = 0.5
    reflectance: float = 0.0
    metallic: float = -1.0
    roughness: float = -1.0
    textures: Annotated[tuple[TextureUse, ...], msgspec.Meta(max_length=16)] = ()
    repeat: Vec2 = (1.0, 1.0)
    uniform: bool = False

    def texture(self, *roles: str) -> int:
        """The texture in the first of `roles` that is there, -1 for none. Without roles: the colour."""
        for role in roles or (TextureRole.RGB, TextureRole.RGBA):
            for use in self.textures:
                if use.role == role:
                    return use.texture
        return -1


class TextureLevel(msgspec.Struct, frozen=True):
    """One size of a texture. `max_error`: largest difference of a channel to the exact pixels of this size, 0..255."""

    address: Address
    bytes: Count
    encoding: Name
    width: Count
    height: Count
    max_error: Int32 = 0


class Texture(msgspec.Struct, frozen=True):
    """An image. `height` of cube and skybox is that of one face; their assets hold six, one below the other, in the
    order right, left, up, down, front, back. Level 0 is the whole image, each further one has half its sides.
    """

    name: Text
    kind: Name
    width: Count
    height: Count
    channels: Count
    colorspace: Name
    levels: Annotated[tuple[TextureLevel, ...], msgspec.Meta(max_length=MAX_LEVELS)]


class MeshLevel(msgspec.Struct, frozen=True):
    """One level of detail. `max_error_m`: how far its points lie from the exact mesh at most [m], 0: exact. Parts of
    the exact mesh that are smaller than this may be missing.
    """

    address: Address
    bytes: Count
    encoding: Name
    vertices: Count
    triangles: Count
    max_error_m: float = 0.0


class Mesh(msgspec.Struct, frozen=True):
    """Triangles. Level 0 is exact, each further one coarser. `low`, `high`: the box around it in its frame [m]."""

    name: Text
    low: Vec3
    high: Vec3
    textured: bool
    levels: Annotated[tuple[MeshLevel, ...], msgspec.Meta(max_length=MAX_LEVELS)]


class HeightField(msgspec.Struct, frozen=True):
    """Elevations on a grid, rows along y, columns along x, in 0..1.

    `size` [m]: half length along x, along y, height of elevation 1, depth of the base below 0.
    """

    name: Text
    rows: Count
    columns: Count
    size: tuple[float, float, float, float]
    address: Address
    bytes: Count
    encoding: Name = AssetEncoding.ARRAYS
