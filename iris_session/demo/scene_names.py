"""Names of the scenes with descriptions, for help texts without heavy imports. `named_scenes` builds them."""

from __future__ import annotations

from typing import Final

SCENE_NAMES: Final = {
    "handover": "two arms, a hammer, a board",
    "arm": "one arm",
    "arms": "eight arms around a table; arms1 to arms12 for another number",
    "panda": "two Franka Panda arms around a table; panda1 to panda8 for another number",
    "aloha": "two ALOHA stations face to face, four arms",
    "cloth": "two arms and a cloth",
    "soft": "two arms, two soft bodies, an open box",
    "cloud": "the scene handover, two drawn depth cameras and what they see of a room around it",
    "bodies": "300 bodies that fly about, no robot",
}
#: Of those, what must be said with their names.
SCENE_NOTE: Final = "the robots of panda and aloha are downloaded on first use"


def list_scene_names() -> str:
    """Return the names in one line, for error texts."""
    return f"{', '.join(SCENE_NAMES)} ({SCENE_NOTE})"
