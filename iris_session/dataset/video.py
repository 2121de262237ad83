"""Videos of a data set: one MP4 per episode and camera, and statistics of its pictures, made while they are drawn."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.dataset.cameras import PictureSpec
from iris_session.dataset.episodes import DatasetError
from iris_session.dataset.files import PictureSink, Stats
from iris_session.dataset.frames import Schema
from iris_session.replay.pictures import Layer
from iris_session.system.extras import require_package

CODEC: Final = "libx264"
#: Name of the codec in files and descriptions.
CODEC_NAME: Final = "h264"
PIXELS: Final = "yuv420p"
#: Every second picture is whole, as in LeRobot's own videos: frames are read in any order. One thread: the same bytes
#: on every machine, and other threads have other episodes to do. Without `cpu-independent`, processors decide
#: differently, and with AVX-512 what lies in memory behind the motion vectors (x264's macroblock tree, core 165).
OPTIONS: Final = {
    "crf": "23",
    "preset": "veryfast",
    "g": "2",
    "bf": "0",
    "threads": "1",
    "x264-params": "cpu-independent=1",
}
#: Quantiles of statistics, by their names.
QUANTILES: Final = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
#: Statistics are of pictures with about so many pixels a side.
_SIDE: Final = 150


class VideoWriter:
    """Writes an MP4, picture by picture.

    Args:
        path: The file, in an existing folder.
        fps: Pictures a second.
        width, height: Of the pictures [px], even.

    Raises:
        DatasetError: This PyAV has no encoder of H.264.
        MissingExtraError: PyAV is not installed.
    """

    def __init__(self, path: Path, fps: int, width: int, height: int) -> None:
        require_package("av", "writing videos")
        import av

        if CODEC not in av.codecs_available:
            raise DatasetError(f"this PyAV has no {CODEC}: pip install av, whose wheels bring it")
        self._av = av
        self._container = av.open(str(path), "w", format="mp4", options={"fflags": "+bitexact"})
        self._stream: Any = self._container.add_stream(CODEC, fps, options=OPTIONS)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, PIXELS
        self._period, self._n = Fraction(1, fps), 0

    def add(self, image: NDArray[np.uint8]) -> None:
        """Add a picture, uint8, shape (height, width, 3), RGB."""
        frame = self._av.VideoFrame.from_ndarray(image, "rgb24")
        frame.pts, frame.time_base = self._n, self._period
        self._n += 1
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Finish the file."""
        self._container.mux(self._stream.encode())
        self._container.close()

    def abort(self) -> None:
        """Close a file that is not needed any more."""
        self._container.close()


class VideoSink(PictureSink):
    """Pictures of one episode on their way into videos: `make_video_name`."""

    def __init__(self, folder: Path, schema: Schema, pictures: PictureSpec) -> None:
        self._folder, self._fps = folder, schema.fps
        self._writers: dict[tuple[int, str], VideoWriter] = {}
        self._stats: dict[tuple[int, str], PictureStats] = {}

    def add(self, look: int, camera: str, image: Layer) -> None:
        key = look, camera
        if key not in self._writers:
            path = self._folder / make_video_name(look, camera)
            self._writers[key] = VideoWriter(path, self._fps, image.shape[1], image.shape[0])
            self._stats[key] = PictureStats()
        self._writers[key].add(image)
        self._stats[key].add(image)

    def close(self) -> dict[tuple[int, str], Stats]:
        for writer in self._writers.values():
            writer.close()
        return {key: stats.make() for key, stats in self._stats.items()}

    def abort(self) -> None:
        for writer in self._writers.values():
            writer.abort()


def make_video_name(look: int, camera: str) -> str:
    """Return the name of the video of a look and camera."""
    return f"{look}-{camera}.mp4"


class PictureStats:
    """Statistics of pictures, per channel, with values from 0 to 1: over every picture, at about 150 pixels a side."""

    def __init__(self) -> None:
        self._counts = np.zeros((3, 256), np.int64)
        self._n = 0

    def add(self, image: NDArray[np.uint8]) -> None:
        """Add a picture, uint8, shape (height, width, 3)."""
        every = max(1, max(image.shape[:2]) // _SIDE)
        small = image[::every, ::every]
        for channel in range(3):
            self._counts[channel] += np.bincount(small[..., channel].reshape(-1), minlength=256)
        self._n += 1

    def make(self) -> Stats:
        """Return the statistics, each of shape (3, 1, 1); `count`: of pictures."""
        levels = np.arange(256) / 255.0
        total = self._counts.sum(axis=1)
        mean = self._counts @ levels / total
        seen = self._counts > 0
        found = {
            "min": levels[seen.argmax(axis=1)],
            "max": levels[255 - seen[:, ::-1].argmax(axis=1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(0.0, self._counts @ levels**2 / total - mean**2)),
        }
        below = self._counts.cumsum(axis=1)
        for name, share in QUANTILES.items():
            found[name] = levels[(below >= share * total[:, None]).argmax(axis=1)]
        return {name: value.reshape(3, 1, 1) for name, value in found.items()} | {"count": np.array([float(self._n)])}


def compute_stats(values: NDArray[Any]) -> Stats:
    """Return statistics of numbers, shape (n, k): each of shape (k,); `count`: of rows."""
    numbers = values.astype(np.float64)
    found = {
        "min": numbers.min(axis=0),
        "max": numbers.max(axis=0),
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
        "count": np.array([float(len(numbers))]),
    }
    quantiles = np.quantile(numbers, list(QUANTILES.values()), axis=0)
    return found | dict(zip(QUANTILES, quantiles, strict=True))


def merge_stats(one: Stats, other: Stats) -> Stats:
    """Return the statistics of both. Quantiles are means that count frames, as LeRobot makes them."""
    n_one, n_other = one["count"], other["count"]
    total = n_one + n_other
    mean = (one["mean"] * n_one + other["mean"] * n_other) / total
    spread_one = one["std"] ** 2 + (one["mean"] - mean) ** 2
    spread_other = other["std"] ** 2 + (other["mean"] - mean) ** 2
    found = {
        "min": np.minimum(one["min"], other["min"]),
        "max": np.maximum(one["max"], other["max"]),
        "mean": mean,
        "std": np.sqrt((spread_one * n_one + spread_other * n_other) / total),
        "count": total,
    }
    return found | {name: (one[name] * n_one + other[name] * n_other) / total for name in QUANTILES}
