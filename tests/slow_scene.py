"""The scene of the handover with ten milliseconds a tick, for what must not depend on how busy the machine is.

Used by tests and tools, so it does not import pytest.
"""

from __future__ import annotations

import re
from pathlib import Path

from iris_session.demo.scenes import scene_path


def write_slow_scene(folder: Path) -> Path:
    """Write the scene of the handover at 100 Hz: a machine that is busy for some ms makes no tick late.

    Args:
        folder: Existing folder for its files.

    Returns:
        The file of the scene.
    """
    for file in (scene_path("handover"), scene_path("arm")):
        text, n = re.subn(r'timestep="[\d.]+"', 'timestep="0.01"', file.read_text())
        assert n == 1, file
        (folder / file.name).write_text(text)
    return folder / "handover.xml"
