"""Videos of data sets: the same pictures are the same bytes, on every processor and whatever is in memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from iris_session.dataset import video
from iris_session.dataset.video import VideoWriter


def make_pictures(width: int, height: int) -> np.ndarray:
    """Return moving waves with noise, shape (12, height, width, 3)."""
    y, x, k = np.mgrid[0:height, 0:width, 0:12]
    waves = 127.0 + 60.0 * np.sin((x + 2 * k) / 23.0) + 40.0 * np.cos((y - k) / 17.0)
    noise = np.random.default_rng(0).normal(0.0, 4.0, waves.shape)
    grey = np.moveaxis(np.clip(waves + noise, 0.0, 255.0).astype(np.uint8), 2, 0)
    return np.stack([grey, np.roll(grey, 9, axis=2), 255 - grey], axis=-1)


def write(path: Path, pictures: np.ndarray) -> bytes:
    writer = VideoWriter(path, 30, *pictures.shape[2:0:-1])
    for picture in pictures:
        writer.add(picture)
    writer.close()
    return path.read_bytes()


@pytest.mark.parametrize("size", [(64, 48), (320, 240)])
def test_bytes_do_not_depend_on_the_processor(
    size: tuple[int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = make_pictures(*size)
    here = write(tmp_path / "here.mp4", pictures)
    params = ":".join(filter(None, (video.OPTIONS.get("x264-params"), "asm=0")))
    monkeypatch.setattr(video, "OPTIONS", {**video.OPTIONS, "x264-params": params})
    assert write(tmp_path / "plain.mp4", pictures) == here
