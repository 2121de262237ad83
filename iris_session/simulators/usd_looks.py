"""Looks of USD prims: what the material that is bound to them, or their display colour, gives `SceneBuilder`.

Colours of USD are linear and become sRGB. Read are the inputs of `UsdPreviewSurface` and those of Isaac Sim's OmniPBR,
which mean the same.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.scene.builder import AppearanceOptions
from iris_session.simulators.adapter import Floats

#: Inputs of surface shaders by our words; the first that has a value counts.
_COLOR: Final = ("diffuseColor", "diffuse_color_constant", "baseColor", "base_color")
_TEXTURE: Final = ("diffuseColor", "diffuse_texture")
_STRENGTHS: Final = {
    "metallic": ("metallic", "metallic_constant"),
    "roughness": ("roughness", "reflection_roughness_constant"),
    "opacity": ("opacity", "opacity_constant"),
}


def read_look(prim: Any, colored: Any) -> AppearanceOptions:
    """Return the appearance of the material bound to `prim`, else the constant display colour of `colored`."""
    from pxr import UsdGeom, UsdShade

    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
    shader = _find_surface(material) if material else None
    if shader is not None:
        return _read_shader(shader)
    primvar = UsdGeom.PrimvarsAPI(colored).FindPrimvarWithInheritance("displayColor")
    if primvar and primvar.HasValue() and primvar.GetInterpolation() == UsdGeom.Tokens.constant:
        values = np.array(primvar.ComputeFlattened(), np.float64).reshape(-1, 3)
        if len(values):
            return {"rgba": to_srgb(values[0])}
    return {}


def _find_surface(material: Any) -> Any:
    for contexts in ([], ["mdl"]):
        shader = material.ComputeSurfaceSource(contexts)[0] if contexts else material.ComputeSurfaceSource()[0]
        if shader:
            return shader
    return None


def _read_shader(shader: Any) -> AppearanceOptions:
    look: AppearanceOptions = {}
    texture = next((path for name in _TEXTURE if (path := _read_texture(shader, name))), "")
    if texture:
        look["texture"] = texture
    values = {word: _read_number(shader, names) for word, names in _STRENGTHS.items()}
    color = next((value for name in _COLOR if (value := _read_value(shader, name)) is not None), None)
    alpha = 1.0 if values["opacity"] is None else min(max(values["opacity"], 0.0), 1.0)
    if color is not None and not texture:
        look["rgba"] = to_srgb(np.array(color, np.float64)[:3], alpha)
    elif alpha < 1.0:
        look["rgba"] = (1.0, 1.0, 1.0, alpha)
    if values["metallic"] is not None:
        look["metallic"] = min(max(values["metallic"], 0.0), 1.0)
    if values["roughness"] is not None:
        look["roughness"] = min(max(values["roughness"], 0.0), 1.0)
    glow = _read_value(shader, "emissiveColor")
    if glow is not None and max(glow) > 0.0 and color is not None and max(color) > 0.0:
        look["emission"] = min(float(max(glow)) / float(max(color)), 1.0)
    return look


def _read_value(shader: Any, name: str) -> Any:
    """Return the value of an input, also of a material's or node graph's input that it is connected to."""
    given = shader.GetInput(name)
    if not given:
        return None
    for attribute in given.GetValueProducingAttributes():
        if attribute.GetName().startswith("inputs:"):
            return attribute.Get()
    return None


def _read_number(shader: Any, names: tuple[str, ...]) -> float | None:
    for name in names:
        value = _read_value(shader, name)
        if isinstance(value, int | float):
            return float(value)
    return None


def _read_texture(shader: Any, name: str) -> str:
    """Return the path of the picture behind an input, empty for none."""
    from pxr import Sdf, UsdShade

    given = shader.GetInput(name)
    if not given:
        return ""
    for attribute in given.GetValueProducingAttributes():
        value = attribute.Get() if attribute.GetName().startswith("inputs:") else None
        if value is None:  # an output: that of a UsdUVTexture
            file = UsdShade.Shader(attribute.GetPrim()).GetInput("file")
            value = file.Get() if file else None
        if isinstance(value, Sdf.AssetPath):
            return value.resolvedPath or ""
    return ""


def to_srgb(linear: Floats, alpha: float = 1.0) -> tuple[float, float, float, float]:
    """Return a colour of linear values as sRGB with alpha."""
    red, green, blue = _encode_srgb(np.asarray(linear, np.float64)).tolist()
    return red, green, blue, alpha


def to_srgb_bytes(linear: Floats) -> NDArray[np.uint8]:
    return np.rint(255.0 * _encode_srgb(linear)).astype(np.uint8)


def _encode_srgb(linear: Floats) -> Floats:
    c = np.clip(linear, 0.0, 1.0)
    return np.where(c <= 0.0031308, 12.92 * c, 1.055 * np.power(c, 1.0 / 2.4) - 0.055)
