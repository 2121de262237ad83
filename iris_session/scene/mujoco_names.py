"""Names of model elements as they stand in a specification: maybe empty, maybe repeated, cut to what the wire holds."""

from __future__ import annotations

from typing import Final

import mujoco

from iris_session.protocol.common import MAX_TEXT

_TYPES: Final = {
    kind: int(getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"))
    for kind in ("body", "geom", "site", "mesh", "texture", "material", "hfield", "light", "camera", "flex", "tendon")
}


def label(model: mujoco.MjModel, kind: str, index: int) -> str:
    """The name, or an empty text."""
    return (mujoco.mj_id2name(model, _TYPES[kind], index) or "")[:MAX_TEXT]
