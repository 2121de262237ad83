"""Formats of data sets: what each needs, and the classes that write it, which are imported when one is wanted."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from iris_session.dataset.cameras import PictureSpec
    from iris_session.dataset.episodes import Plan
    from iris_session.dataset.files import PictureSink, SetWriter
    from iris_session.dataset.frames import Schema


class Format(NamedTuple):
    """A format.

    Attributes:
        writer, sink: Module below `iris_session.dataset` and class.
        packages: What it imports, with the names of the distributions: their versions change the bytes of a set.
        has_layers: It has depth and masks. Its writer finds the model of an episode with its pictures, `MODEL`.
    """

    writer: tuple[str, str]
    sink: tuple[str, str]
    packages: Mapping[str, str]
    has_layers: bool


FORMATS: Final = {
    "lerobot": Format(("lerobot", "LeRobotWriter"), ("video", "VideoSink"), {"pyarrow": "pyarrow", "av": "av"}, False),
    "robomimic": Format(("robomimic", "RobomimicWriter"), ("robomimic", "ArraySink"), {"h5py": "h5py"}, True),
    "mcap": Format(("mcap", "McapWriter"), ("mcap", "McapSink"), {"foxglove": "foxglove-sdk", "av": "av"}, True),
}
#: Model of an episode (MJB).
MODEL: Final = "model.mjb"


def make_sink(to: str, folder: Path, schema: Schema, pictures: PictureSpec) -> PictureSink:
    """Return what takes the pictures of an episode in a format."""
    sink: PictureSink = _load(FORMATS[to].sink)(folder, schema, pictures)
    return sink


def open_writer(
    to: str, folder: Path, plan: Plan, schema: Schema, pictures: PictureSpec, request: Mapping[str, Any]
) -> SetWriter:
    """Begin or continue a set. Arguments and errors as of `SetWriter`."""
    writer: SetWriter = _load(FORMATS[to].writer)(folder, plan, schema, pictures, request)
    return writer


def _load(where: tuple[str, str]) -> Any:
    return getattr(import_module(f"iris_session.dataset.{where[0]}"), where[1])
