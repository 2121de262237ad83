"""Materials and textures of a glTF file as looks.

Factors of glTF are linear, colours of the specification are as they are seen: they are converted (sRGB). Pictures stay
as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.names import ColorSpace, TextureRole
from iris_session.protocol.scene import Rgba
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.gltf_data import GltfData
from iris_session.scene.images import Pixels
from iris_session.scene.parts import Look, Picture, cut
from iris_session.scene.pictures import PixelBudget, read_pixels, without_alpha

_REPEAT: Final = 10497
Doubles = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Dress:
    """A look, whether it is drawn from both sides, and which texture coordinates it takes: `uv_set`, turned by
    `uv_matrix` (3, 3) unless that is `None`; `uv_set` is -1 without textures. `opaque`: alpha says nothing."""

    look: Look
    both_sides: bool = False
    uv_set: int = -1
    uv_matrix: Doubles | None = None
    opaque: bool = True


class GltfLooks:
    """Looks by the number of their material; `skipped` takes what has no form."""

    def __init__(self, data: GltfData, skipped: dict[str, None]) -> None:
        self._data = data
        self._skipped = skipped
        self._dresses: dict[object, Dress] = {}
        self._pictures: dict[tuple[object, ...], Picture] = {}
        self._budget = PixelBudget(data.name)

    def dress(self, material: object) -> Dress:
        """Of a primitive that names `material`, or none: then as glTF has it, white and rough."""
        entry = {} if material is None else self._data.item("materials", material)
        if material not in self._dresses:
            self._dresses[material] = self._dress(entry)
        return self._dresses[material]

    def _dress(self, entry: dict[str, Any]) -> Dress:
        pbr = _map(entry.get("pbrMetallicRoughness"))
        factor = self.numbers(pbr.get("baseColorFactor", (1, 1, 1, 1)), 4)
        mode = entry.get("alphaMode", "OPAQUE")
        alpha = 1.0 if mode == "OPAQUE" else factor[3]
        red, green, blue = (seen(v) for v in factor[:3])
        rgba: Rgba = (red, green, blue, min(max(alpha, 0.0), 1.0))
        roughness = self.number(pbr.get("roughnessFactor", 1.0))
        rgba, emission = self._emission(entry, rgba)
        uses: list[tuple[dict[str, Any], str, Picture]] = []
        base, cutoff = _map(pbr.get("baseColorTexture")), self.number(entry.get("alphaCutoff", 0.5))
        if base:
            picture = self._picture(base, f"{mode} {cutoff}", lambda pixels: _alpha(pixels, mode, cutoff))
            if picture is not None:
                role = TextureRole.RGBA if picture.pixels.shape[2] == 4 else TextureRole.RGB
                uses.append((base, role, picture))
        uses += self._others(entry, pbr)
        look = Look(
            rgba=rgba,
            name=cut(entry.get("name", "")),
            emission=emission,
            specular=0.5 * (1.0 - min(max(roughness, 0.0), 1.0)),
            shininess=1.0 - min(max(roughness, 0.0), 1.0),
            metallic=min(max(self.number(pbr.get("metallicFactor", 1.0)), 0.0), 1.0),
            roughness=min(max(roughness, 0.0), 1.0),
            pictures=tuple((role, picture) for _, role, picture in uses),
        )
        uv_set, uv_matrix = self._mapping([use for use, _, _ in uses])
        return Dress(look, bool(entry.get("doubleSided", False)), uv_set, uv_matrix, mode == "OPAQUE")

    def _emission(self, entry: dict[str, Any], rgba: Rgba) -> tuple[Rgba, float]:
        """The specification has light of a material's own colour: how much, and the colour where it has none else."""
        strength = _map(_map(entry.get("extensions")).get("KHR_materials_emissive_strength"))
        factor = np.array([seen(v) for v in self.numbers(entry.get("emissiveFactor", (0, 0, 0)), 3)])
        glow = factor * self.number(strength.get("emissiveStrength", 1.0))
        if not glow.any():
            return rgba, 0.0
        own = np.array(rgba[:3])
        if own.max() < 0.01:  # black that glows: the glow is its colour
            red, green, blue = (glow / max(1.0, glow.max())).tolist()
            return (red, green, blue, rgba[3]), float(max(1.0, glow.max()))
        emission = float(glow @ own / (own @ own))
        if np.abs(glow - emission * own).max() > 0.02 * glow.max():
            self._skip(f"the colour in which material {entry.get('name', '')!r} glows: it glows in its own")
        return rgba, emission

    def _others(self, entry: dict[str, Any], pbr: dict[str, Any]) -> list[tuple[dict[str, Any], str, Picture]]:
        """Pictures other than the colour."""
        found = []
        rough, shade = _map(pbr.get("metallicRoughnessTexture")), _map(entry.get("occlusionTexture"))
        packed = bool(rough) and rough.get("index") == shade.get("index")
        for use, role, change in (
            (rough, TextureRole.ORM, None if packed else _no_occlusion),
            ({} if packed else shade, TextureRole.OCCLUSION, None),
            (_map(entry.get("normalTexture")), TextureRole.NORMAL, None),
            (_map(entry.get("emissiveTexture")), TextureRole.EMISSIVE, None),
        ):
            space = ColorSpace.AUTO if role == TextureRole.EMISSIVE else ColorSpace.LINEAR
            picture = self._picture(use, role, change, space) if use else None
            if picture is not None:
                found.append((use, role, picture))
        return found

    def _picture(self, use: dict[str, Any], key: str, change: Any, space: str = ColorSpace.AUTO) -> Picture | None:
        """The picture that `use` names, changed by `change`; `None`, and noted, where it is in a form of its own."""
        texture = self._data.item("textures", use.get("index"))
        webp = _map(_map(texture.get("extensions")).get("EXT_texture_webp"))
        source = webp.get("source", texture.get("source"))
        if source is None:
            self._skip("textures in a compressed form (KTX2): export them as PNG, JPEG or WebP")
            return None
        if "sampler" in texture:
            sampler = self._data.item("samplers", texture["sampler"])
            if {sampler.get("wrapS", _REPEAT), sampler.get("wrapT", _REPEAT)} != {_REPEAT}:
                self._skip("textures that are not repeated beyond their borders: they are")
        image = self._data.item("images", source)
        kept = (source, key, space)
        if kept not in self._pictures:
            name = cut(image.get("name") or texture.get("name") or "")
            pixels = read_pixels(self._data.picture_bytes(source), f"image {source} of {self._data.name}")
            self._budget.spend(pixels)
            self._pictures[kept] = Picture(pixels if change is None else change(pixels), name, colorspace=space)
        return self._pictures[kept]

    def _mapping(self, uses: list[dict[str, Any]]) -> tuple[int, Doubles | None]:
        """Texture coordinates are those of the first texture, the colour where there is one."""
        ways = []
        for use in uses:
            turn = _map(_map(use.get("extensions")).get("KHR_texture_transform"))
            x, y = self.numbers(turn.get("offset", (0, 0)), 2)
            a, b = self.numbers(turn.get("scale", (1, 1)), 2)
            angle = self.number(turn.get("rotation", 0.0))
            uv_set = turn.get("texCoord", use.get("texCoord", 0))
            if type(uv_set) is not int or not 0 <= uv_set < 16:
                raise SceneBuildError(f"{self._data.name}: texture coordinates number {uv_set!r}")
            ways.append((uv_set, x, y, a, b, angle))
        if not ways:
            return -1, None
        if len(set(ways)) > 1:
            self._skip("a second set of texture coordinates on one material: all its textures take the first one's")
        uv_set, x, y, a, b, angle = ways[0]
        if (x, y, a, b, angle) == (0, 0, 1, 1, 0):
            return uv_set, None
        c, s = np.cos(angle), np.sin(angle)
        return uv_set, np.array([[c * a, s * b, x], [-s * a, c * b, y], [0, 0, 1]])

    def number(self, value: object) -> float:
        """A finite number. Raises `SceneBuildError`."""
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise SceneBuildError(f"{self._data.name}: {value!r} stands where a finite number is needed")
        return float(value)

    def numbers(self, values: object, count: int) -> list[float]:
        """As many finite numbers."""
        if not isinstance(values, list | tuple) or len(values) != count:
            raise SceneBuildError(f"{self._data.name}: {count} numbers are needed, not {str(values)[:80]}")
        return [self.number(value) for value in values]

    def _skip(self, text: str) -> None:
        self._skipped[f"{self._data.name}: {text}"] = None


def _alpha(pixels: Pixels, mode: object, cutoff: float) -> Pixels:
    """Alpha as the material has it: not at all, cut, or blended."""
    if mode == "OPAQUE":
        return without_alpha(pixels, always=True)
    if mode == "MASK" and pixels.shape[2] == 4:
        pixels = pixels.copy()
        pixels[:, :, 3] = np.where(pixels[:, :, 3] >= cutoff * 255, 255, 0)
    return pixels


def _no_occlusion(pixels: Pixels) -> Pixels:
    """Roughness and metallic in green and blue, with nothing shaded in red."""
    packed = np.full((*pixels.shape[:2], 3), 255, np.uint8)
    packed[:, :, 1:] = pixels[:, :, 1:3] if pixels.shape[2] >= 3 else pixels[:, :, :1]
    return packed


def _map(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def seen(value: float) -> float:
    """A linear factor of glTF as a colour (sRGB)."""
    v = min(max(float(value), 0.0), 1.0)
    if v >= 1.0:
        return 1.0  # which the formula misses by a bit
    return v * 12.92 if v <= 0.0031308 else 1.055 * v ** (1 / 2.4) - 0.055
