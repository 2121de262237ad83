"""How cameras whose pictures are published are written."""

from __future__ import annotations

import pytest

from iris_session.cloud.model_camera import ModelCamera, parse_model_camera
from iris_session.session.config import SessionConfig
from iris_session.session.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "camera"),
    [
        ("wrist", ModelCamera("wrist", 320, 240, 30.0)),
        ("top:640x480", ModelCamera("top", 640, 480, 30.0)),
        ("top@12.5", ModelCamera("top", 320, 240, 12.5)),
        ("left/wrist:96x64@10", ModelCamera("left/wrist", 96, 64, 10.0)),
    ],
)
def test_size_and_rate_have_defaults(text: str, camera: ModelCamera) -> None:
    assert parse_model_camera(text) == camera
    assert camera.stream == camera.camera.replace("/", "_")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "write CAMERA"),
        ("wrist:8x240", "16 to 2048 pixels"),
        ("wrist@0", "0.1 to 120"),
        ("wrist@", "letters, digits"),
        ("my camera", "letters, digits"),
    ],
)
def test_what_cannot_be_drawn_is_refused_with_the_settings(text: str, expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        SessionConfig(pictures=(text,))
