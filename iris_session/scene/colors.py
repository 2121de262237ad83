"""Colours: linear as in glTF, sRGB as in specifications. Both from 0 to 1, values beyond are clipped."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def to_srgb(linear: ArrayLike) -> NDArray[np.float64]:
    """Convert linear values to sRGB."""
    v = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    curved = np.where(v < 1.0, 1.055 * v ** (1 / 2.4) - 0.055, 1.0)  # which is off by one bit at 1
    return np.where(v <= 0.0031308, v * 12.92, curved)


def to_linear(srgb: ArrayLike) -> NDArray[np.float64]:
    """Convert sRGB values to linear ones."""
    v = np.clip(np.asarray(srgb, np.float64), 0.0, 1.0)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
