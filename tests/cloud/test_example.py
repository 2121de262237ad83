"""The commented camera file: it can be read for every source, and its comments state what is so without them."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from iris_session.cloud.camera_file import CloudSettings, load_camera_file
from iris_session.cloud.example import SOURCES, make_example

CALIBRATION = """error_mm_p95 = 10.0
[T_base_camera]
position_m = [0.0, 0.0, 1.0]
quaternion_wxyz = [0.5, -0.5, 0.5, -0.5]
"""
INTRINSICS = "width = 640\nheight = 480\nfx = 585.0\nfy = 585.0\ncx = 319.5\ncy = 239.5\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "calibration.toml").write_text(CALIBRATION)
    (tmp_path / "intrinsics.toml").write_text(INTRINSICS)
    for name in ("recording.rrd", "recording.mcap"):
        (tmp_path / name).touch()
    (tmp_path / "pictures").mkdir()
    cv2.imwrite(str(tmp_path / "pictures" / "a.depth.png"), np.ones((480, 640), np.uint16))
    return tmp_path


def load(folder: Path, text: str) -> CloudSettings:
    path = folder / "camera.toml"
    path.write_text(text)
    return load_camera_file(path)


@pytest.mark.parametrize("source", sorted(SOURCES))
def test_what_is_commented_out_is_as_it_would_be_without(folder: Path, source: str) -> None:
    """Keys whose default depends on other things are said to."""
    text = make_example(source)
    without = load(folder, text)
    lines = [line for line in text.splitlines() if re.match(r"# [a-z_]+ = ", line)]
    assert len(lines) > 8
    for line in lines:
        if line.startswith(("# pose ", "# intrinsics ", "# depth_scale_m ", "# hz ", "# error_mm ")):
            continue
        shown = load(folder, text.replace(line, line.removeprefix("# ")))
        assert shown == without, line
