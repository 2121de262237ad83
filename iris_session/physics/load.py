"""Models in and out: files (MJCF, URDF, MJB) and bytes (MJB), with one-line errors.

The bytes of a model are MuJoCo's own binary format with the asset paths blanked, because those name folders of the
machine that compiled it. MJB is readable by the same MuJoCo version only; recordings keep that version beside it.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import mujoco
import numpy as np

from iris_session.physics.errors import ModelInvalidError, ModelNotFoundError, one_line

TEXT_SUFFIXES: Final = (".xml", ".mjcf", ".urdf")
#: MuJoCo has one handler of warnings per process.
_handler_lock = threading.Lock()
_BUFFER_NAME: Final = "model.mjb"


def load_model(path: str | Path) -> mujoco.MjModel:
    """Compile an MJCF or URDF file, or load an MJB.

    Args:
        path: Path of the file; `~` is expanded.

    Returns:
        The compiled model.

    Raises:
        ModelNotFoundError: The file is missing, or has an unknown suffix.
        ModelInvalidError: MuJoCo cannot compile or load it; the message is MuJoCo's, or in plain words.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise ModelNotFoundError(f"model file {str(path)!r} does not exist{_list_siblings(path)}")
    suffix = path.suffix.lower()
    if suffix not in (*TEXT_SUFFIXES, ".mjb"):
        raise ModelNotFoundError(
            f"model file {path.name!r} must end in one of {', '.join((*TEXT_SUFFIXES, '.mjb'))}; other files are "
            "shown, not simulated: ScenePublisher with SceneBuilder.add_file"
        )
    try:
        model = _load_binary(str(path)) if suffix == ".mjb" else mujoco.MjModel.from_xml_path(str(path))
        bytes(model.names).decode()
    except UnicodeDecodeError as error:  # MuJoCo takes any bytes, and then cannot give the name
        raise ModelInvalidError(f"{path.name}: a name in it is not UTF-8: save the file as UTF-8") from error
    except (ValueError, mujoco.FatalError) as error:
        advice = f"; damaged, or not of MuJoCo {mujoco.__version__}: save it again" if suffix == ".mjb" else ""
        raise ModelInvalidError(f"{path.name}: {_explain_error(error)}{advice}") from error
    return model


def _explain_error(error: Exception) -> str:
    """Return MuJoCo's message in one line, or what would be right where it does not say so."""
    text = one_line(error)
    if "mass and inertia of moving bodies" not in text:
        return text
    name = re.search(r"Element name '([^']+)'", text)
    body = f"body {name[1]!r}" if name else "a body"
    return f"{body} moves and has no mass: give it an <inertial>, or in MJCF a geom with a density"


def _load_binary(name: str, assets: dict[str, bytes] | None = None) -> mujoco.MjModel:
    """Load an MJB. Raises `ValueError` with the reason, which MuJoCo itself gives as a warning beside its error."""
    with catch_warnings() as why:
        try:
            return mujoco.MjModel.from_binary_path(name, assets)
        except (ValueError, mujoco.FatalError) as error:
            raise ValueError("; ".join(why) or one_line(error)) from error


def _list_siblings(path: Path) -> str:
    """Return the model files beside a path that does not exist, for the error text."""
    if not path.parent.is_dir():
        return f"; neither does its folder {str(path.parent)!r}"
    found = sorted(p.name for p in path.parent.iterdir() if p.suffix.lower() in (*TEXT_SUFFIXES, ".mjb"))
    return f"; its folder has {', '.join(found) or 'no model file'}"


def encode_model(model: mujoco.MjModel) -> bytearray:
    """Return the MJB bytes of `model`, asset paths blanked. Same model, same MuJoCo, same lengths of paths: same
    bytes.
    """
    data = bytearray(mujoco.mj_sizeModel(model))
    mujoco.mj_saveModel(model, None, np.frombuffer(data, np.uint8))
    paths = bytes(model.paths)
    if paths.strip(b"\0"):
        # The paths are among the last of the model's arrays, so the last occurrence is the array itself.
        at = data.rfind(paths)
        data[at : at + len(paths)] = bytes(len(paths))
    return data


def decode_model(data: bytes | bytearray) -> mujoco.MjModel:
    """Return the model of `encode_model`. Raises `ModelInvalidError` for bytes of another format or MuJoCo version."""
    try:
        return _load_binary(_BUFFER_NAME, {_BUFFER_NAME: bytes(data)})
    except (ValueError, mujoco.FatalError) as error:
        raise ModelInvalidError(
            f"these {len(data)} bytes are no model of MuJoCo {mujoco.__version__}: {one_line(error)}"
        ) from error


def compute_scene_hash(data: bytes | bytearray) -> str:
    """Return the identity of a scene: BLAKE2b of its model bytes, 32 hex characters."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


@contextlib.contextmanager
def catch_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings of this thread, a line each. Those of other threads go to the earlier handler or to
    stderr.

    Without a handler MuJoCo prints a line and writes MUJOCO_LOG.TXT into the current folder.
    """
    caught: list[str] = []
    ours = threading.get_ident()
    with _handler_lock:
        before = mujoco.get_mju_user_warning()

        def handle(text: str) -> None:
            if threading.get_ident() == ours:
                caught.append(one_line(text))
            elif before is not None:
                before(text)
            else:
                print(f"WARNING: {one_line(text)}", file=sys.stderr)

        mujoco.set_mju_user_warning(handle)
        try:
            yield caught
        finally:
            mujoco.set_mju_user_warning(before)
