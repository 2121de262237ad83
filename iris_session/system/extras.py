"""Packages of the extras: which extra a missing package belongs to, as one line for users.

The base install publishes and joins; what needs more imports it where it is used, and fails with `MissingExtraError`.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from contextlib import suppress
from typing import Final

#: Extra of each importable package outside of the base install.
EXTRAS: Final[Mapping[str, str]] = {
    "cv2": "opencv",
    "scipy": "anchors",
    "mink": "mink",
    "daqp": "mink",
    "rerun": "recording",
    "rerun_cli": "recording",
    "pyarrow": "recording",
    "av": "dataset",
    "h5py": "dataset",
    "foxglove": "dataset",
    "ray": "ray",
    "rich": "terminal",
    "gymnasium": "env",
    "trimesh": "files",
    "collada": "files",
    "PIL": "files",
    "defusedxml": "files",
    "numba": "cloud",
    "mcap": "mcap",
    "mcap_ros2": "mcap",
    "mcap_protobuf": "mcap",
    "pyrealsense2": "realsense",
    "pyorbbecsdk": "orbbec",
    "aiohttp": "web",
    "cryptography": "web",
}


class MissingExtraError(ImportError):
    """A package of an extra is not installed. The message is one line that names the extra."""


def describe_missing(package: str, purpose: str = "this") -> str:
    """Return one line that names the extra of a package. `purpose`: what needs it."""
    return f"{purpose} needs {package}, which is not installed: pip install 'iris-session[{EXTRAS[package]}]'"


def describe_import_error(error: ImportError) -> str:
    """Return one line for an import that failed for lack of an extra, empty for any other failure."""
    if "iris-session[" in str(error):  # raised by a module that knows its extra
        return " ".join(str(error).split())
    package = (error.name or "").partition(".")[0]
    return describe_missing(package) if package in EXTRAS else ""


def require_package(package: str, purpose: str) -> None:
    """Raise `MissingExtraError` unless a package of an extra is installed. Does not import it."""
    found = None
    with suppress(ImportError):
        found = importlib.util.find_spec(package)
    if found is None:
        raise MissingExtraError(describe_missing(package, purpose), name=package)
