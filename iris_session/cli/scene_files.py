"""The file that `scene inspect`, `scene export` and `serve` are given: which it is, what it needs, what is wrong.

MuJoCo reads MJCF and MJB, and scenes with a name; every other file is composed without it (`SceneBuilder`).
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from iris_session.cli.common import CommandError

if TYPE_CHECKING:
    from iris_session.protocol.scene import SceneSpec
    from iris_session.scene.compose import SceneBuilder

#: Endings of files that MuJoCo simulates; any other file is composed, and shown as it is.
SIMULATED: Final = (".xml", ".mjcf", ".mjb")
_ROBOT: Final = ".urdf"
#: How meshes in a model that are too large or too small are mended.
_OF_MESHES: Final = 'scale="{factor} {factor} {factor}" at its <mesh>, times the one that it has,'
#: From when on it is told that something takes its time: about a second.
_LARGE_BYTES: Final = 5_000_000
_MANY_TRIANGLES: Final = 100_000


def add_file_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--package-dir",
        action="append",
        default=[],
        metavar="DIR",
        help="folder of packages that the file refers to by package://, or may refer into; may be repeated",
    )
    parser.add_argument(
        "--scale",
        type=_factor,
        default=None,
        metavar="FACTOR",
        help="how large the file is drawn: 0.001 for one in millimetres; not of MJCF and MJB, which are simulated",
    )


def _factor(text: str) -> float:
    try:
        factor = float(text)
    except ValueError:
        factor = math.nan
    if not (math.isfinite(factor) and factor > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is no factor: a number above 0, 0.001 for a file in millimetres")
    return factor


def path_of(text: str | Path) -> Path:
    """A path that may begin with `~`."""
    try:
        return Path(text).expanduser()
    except RuntimeError:  # of a user who is not there
        raise CommandError(f"{text}: there is no such home folder") from None


def file_of(scene: str) -> Path | None:
    """The file that is meant, if MuJoCo does not read it; else `None`, and others say what is wrong.

    Raises `CommandError` for a folder, a file that is not there, and endings that nobody reads.
    """
    from iris_session.scene import SceneBuildError
    from iris_session.scene.files import ENDINGS, present, xacro_advice

    path = path_of(scene)
    kind = path.suffix.lower()
    if kind in SIMULATED and not path.is_dir():
        return None
    if not kind and not path.is_file() and (_is_name(scene) or not path.is_dir()):
        return None
    try:
        present(path)
    except SceneBuildError as error:
        raise CommandError(str(error)) from None
    if kind == ".xacro":
        raise CommandError(f"{path.name}: {xacro_advice(path)}")
    if kind.lstrip(".") not in ENDINGS:
        what = f"files that end in {kind} are not read" if kind else "a file without an ending"
        raise CommandError(f"{path.name}: {what}. These are: {', '.join(ENDINGS)}")
    return path


def _is_name(scene: str) -> bool:
    """Whether a scene is called so: a folder of that name is not in its way."""
    from iris_session.demo.scene_names import SCENE_NAMES

    return scene.rstrip("0123456789") in SCENE_NAMES


def check_file_options(arguments: argparse.Namespace, path: Path | None) -> None:
    """Raises `CommandError` for options that make no sense. `path`: see `file_of`."""
    for folder in arguments.package_dir:
        if not os.path.isdir(os.path.expanduser(folder)):
            raise CommandError(f"--package-dir {folder}: no such folder")
    if path is None and arguments.package_dir:
        raise CommandError("--package-dir goes with a file to show: MuJoCo's files say themselves where theirs lie")
    if path is None and arguments.scale is not None:
        raise CommandError(
            f"--scale: MuJoCo simulates {arguments.scene or 'the scene'}, and in another size it would move otherwise; "
            "a mesh is scaled in the file, by <mesh scale=...>"
        )


def builder_of(path: Path, name: str, arguments: argparse.Namespace) -> SceneBuilder:
    """A scene called `name` with what is in a file that MuJoCo does not read."""
    from iris_session.scene import SceneBuildError
    from iris_session.scene.compose import SceneBuilder

    builder, scale = SceneBuilder(name), 1.0 if arguments.scale is None else arguments.scale
    if (size := path.stat().st_size) > _LARGE_BYTES:
        _tell(f"reading {path.name} ({size / 1e6:.1f} MB)")
    try:
        if path.suffix.lower() == _ROBOT:
            builder.add_urdf(path, package_dirs=arguments.package_dir, scale=scale)
        else:
            builder.add_file(path, package_dirs=arguments.package_dir, scale=scale)
    except SceneBuildError as error:
        advice = " (here: --package-dir DIR)" if "package_dirs" in str(error) else ""
        raise CommandError(f"{error}{advice}") from None
    if builder.triangles > _MANY_TRIANGLES:
        _tell(f"preparing meshes of {path.name} ({builder.triangles:,} triangles; the next time they are there)")
    return builder


def _tell(text: str) -> None:
    """What keeps people waiting, at once, and not among what is read by programs."""
    print(text, file=sys.stderr, flush=True)


def notes_on_model(spec: SceneSpec) -> tuple[str, ...]:
    """What is to be done where lengths of a model of MuJoCo seem to be no metres; nothing where they do not.

    Its largest mesh is judged: its places are in metres, and halls may be large.
    """
    from iris_session.scene.extent import largest_mesh, unit_hint

    hint = unit_hint(largest_mesh(spec), _OF_MESHES)
    return (f"its largest mesh is {hint}",) if hint else ()
