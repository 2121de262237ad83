"""Scenes by name: drawn from primitives, or built around models of real robots of MuJoCo Menagerie.

Each comes with the pose of its alignment sheet. Names like `arms4` say how many arms there are.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import mujoco

from anchors.pose import IDENTITY_QUAT, PoseTuple
from iris_session.demo.scene_names import list_scene_names
from iris_session.demo.scenes import free_bodies_scene, n_arms_scene, scene_path
from iris_session.demo.scenes.aloha import SHEET_Z, aloha_scene
from iris_session.demo.scenes.deformables import cloth_scene, soft_scene
from iris_session.demo.scenes.panda import panda_scene
from iris_session.demo.scenes.parts import add_sheet, get_sheet_position
from iris_session.physics import load_model
from iris_session.protocol.errors import IrisError
from iris_session.session.config import DEFAULT_ANCHORS, DEFAULT_SHEET_M
from iris_session.session.errors import ConfigError

#: Id of the sheet in every scene here.
ANCHOR_ID: Final = next(iter(DEFAULT_ANCHORS))


@dataclass(frozen=True)
class NamedScene:
    """A scene ready to be served.

    Attributes:
        anchors: Poses of its sheets; the default is for scenes that do not specify one.
        cameras: Camera files of the depth cameras that look at it.
    """

    model: mujoco.MjModel
    anchors: Mapping[str, PoseTuple] = field(default_factory=lambda: DEFAULT_ANCHORS)
    cameras: tuple[Path, ...] = ()

    @property
    def anchor_sizes(self) -> dict[str, float]:
        """Edge of the code on each sheet [m]."""
        return dict.fromkeys(self.anchors, DEFAULT_SHEET_M)


def _around_table(spec: Any, n: int) -> NamedScene:
    """Return a scene of `n` arms around a round table, whose sheet lies on it."""
    return NamedScene(spec.compile(), {ANCHOR_ID: (get_sheet_position(n), IDENTITY_QUAT)})


def _make_arms(n: int) -> NamedScene:
    spec = n_arms_scene(n)
    add_sheet(spec, get_sheet_position(n))
    return _around_table(spec, n)


def _load_packaged(name: str, cameras: tuple[Path, ...] = ()) -> NamedScene:
    return NamedScene(load_model(scene_path(name)), cameras=cameras)


#: Endings of files in place of a name, for the error text; `serve` shows those that MuJoCo does not simulate.
FILES: Final = ".xml, .mjcf, .mjb; to be shown: .urdf, .glb, .gltf, .stl, .obj, .ply, .off, .dae"
#: Constructors of the scenes of `SCENE_NAMES`.
SCENES: Final[dict[str, Callable[[], NamedScene]]] = {
    "handover": lambda: _load_packaged("handover"),
    "arm": lambda: _load_packaged("arm"),
    "arms": lambda: _make_arms(8),
    "panda": lambda: _around_table(panda_scene(2), 2),
    "aloha": lambda: NamedScene(aloha_scene().compile(), {ANCHOR_ID: ((0.0, 0.0, SHEET_Z), IDENTITY_QUAT)}),
    "cloth": lambda: _around_table(cloth_scene(), 2),
    "soft": lambda: _around_table(soft_scene(), 2),
    "cloud": lambda: _load_packaged("handover", (scene_path("cloud").with_suffix(".toml"),)),
    "bodies": lambda: NamedScene(free_bodies_scene().compile()),
}
NUMBERED: Final[dict[str, Callable[[int], NamedScene]]] = {
    "arms": _make_arms,
    "panda": lambda n: _around_table(panda_scene(n), n),
}


def scene_by_name(name: str) -> NamedScene:
    """Return a scene by name.

    Args:
        name: A key of `SCENES`, or a key of `NUMBERED` followed by a number of one to three digits.

    Returns:
        The scene.

    Raises:
        ConfigError: Unknown name, or number out of range; the message lists the names. Or this version of MuJoCo is too
            old for the scene.
        ModelNotFoundError: The model of a real robot is not installed.
    """
    match = re.fullmatch(r"([a-z]+)([0-9]{1,3})", name)
    if name not in SCENES and (match is None or match[1] not in NUMBERED):
        raise ConfigError(f"unknown scene '{name}'; expected one of {list_scene_names()}, or a file ({FILES})")
    try:
        return SCENES[name]() if match is None else NUMBERED[match[1]](int(match[2]))
    except IrisError:
        raise
    except (AttributeError, ValueError) as error:
        is_range = match is not None and isinstance(error, ValueError)
        advice = "" if is_range else f"; it needs a newer MuJoCo than {mujoco.__version__}"
        raise ConfigError(f"scene '{name}': {' '.join(str(error).split())}{advice}") from error
