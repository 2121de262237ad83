"""`iris-session scene inspect`, `scene export`: what clients are given of a scene, and a file for viewers.

MuJoCo reads MJCF and MJB, and scenes with a name; every other file is composed without it (`SceneBuilder`).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from iris_session.cli.common import CommandError, add_json, open_scene, print_json

if TYPE_CHECKING:
    from iris_session.protocol.scene import SceneSpec
    from iris_session.scene import AssetStore
    from iris_session.scene.compose import SceneBuilder

#: Endings of files that MuJoCo simulates; any other file is composed, and shown as it is.
SIMULATED: Final = (".xml", ".mjcf", ".mjb")


class _Found(NamedTuple):
    spec: SceneSpec
    scene_hash: str
    skipped: tuple[str, ...]


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "scene",
        help="what clients are given of a scene, what is heavy in it; export to GLB",
        epilog="examples:\n  iris-session scene inspect scene.xml\n  iris-session scene inspect arm.urdf\n"
        "  iris-session scene export handover handover.glb",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    inspect = actions.add_parser(
        "inspect",
        help="tree, sizes, what is heavy and why, what a headset will struggle with",
        description="Shows what clients are given of a scene, what is heavy in it, what a Quest 3 will struggle with.",
    )
    _add_scene(inspect)
    add_json(inspect)
    inspect.set_defaults(run=run_inspect)
    export = actions.add_parser(
        "export",
        help="write the scene as a GLB file",
        description="Writes the scene as it stands at first as GLB (glTF 2.0): meshes, 2d textures and colours, y up.",
    )
    _add_scene(export)
    export.add_argument("out", type=Path, metavar="OUT.glb", help="file to write")
    export.set_defaults(run=run_export)


def _add_scene(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scene",
        metavar="FILE",
        help="MJCF or MJB file, URDF, GLB, glTF, OBJ, STL, PLY, DAE or another file with geometry, or the name of a "
        "scene (see `iris-session serve --help`)",
    )
    add_package_dir(parser)
    parser.add_argument(
        "--assets", default=None, metavar="DIR", help="where assets are kept (default: ~/.cache/iris-session/assets)"
    )


def add_package_dir(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--package-dir",
        action="append",
        default=[],
        metavar="DIR",
        help="folder of packages that the file refers to by package://, or may refer into; may be repeated",
    )


def run_inspect(arguments: argparse.Namespace) -> int:
    """Prints the report; status 0 whatever it says."""
    import msgspec

    from iris_session.scene.report import report, tree

    parsed, _ = _parse(arguments)
    found = report(parsed.spec, parsed.scene_hash, parsed.skipped)
    if arguments.json:
        print_json(msgspec.to_builtins(found))
        return 0
    for line in tree(parsed.spec):
        print(line)
    totals = found.totals
    print(
        f"\n{found.bodies} bodies ({found.moving} move), {totals.objects} objects, {totals.triangles:,} triangles, "
        f"{len(parsed.spec.lights)} lights, {len(parsed.spec.deformables)} deformables"
    )
    print(
        f"{_size(totals.asset_bytes)} of assets: {_size(totals.mesh_bytes)} meshes and {_size(totals.texture_bytes)} "
        f"textures, the rest coarser levels; {_size(totals.texture_memory)} of textures on a graphics card"
    )
    print("\nheaviest:")
    for heavy in found.heavy:
        print(f"  {heavy.kind} {heavy.name}: {heavy.why}; {_size(heavy.bytes)}, {heavy.levels} levels")
    for text in found.skipped:
        print(f"left out: {text}")
    for text in found.struggles:
        print(f"headset: {text}")
    if not found.struggles:
        print("headset: nothing here that a Quest 3 would struggle with")
    return 0


def run_export(arguments: argparse.Namespace) -> int:
    """Writes the file and says how large it is."""
    from iris_session.scene import SceneBuildError
    from iris_session.scene.glb import write_glb

    if arguments.out.suffix.lower() != ".glb":
        raise CommandError(f"{arguments.out} does not end in .glb: GLB is the only format of `scene export`")
    parsed, store = _parse(arguments)
    try:
        size = write_glb(parsed.spec, store, arguments.out)
    except SceneBuildError as error:
        raise CommandError(str(error)) from None
    except OSError as error:
        raise CommandError(f"{arguments.out} cannot be written: {error.strerror or error}") from None
    for text in parsed.skipped:
        print(f"left out: {text}", file=sys.stderr)
    print(f"{arguments.out}: {_size(size)}")
    return 0


def _parse(arguments: argparse.Namespace) -> tuple[_Found, AssetStore]:
    """The scene, with its assets in a store."""
    from iris_session.protocol.scene import SceneError
    from iris_session.scene import AssetStore

    path = Path(arguments.scene)
    try:
        store = AssetStore(arguments.assets)
        composed = path.suffix.lower() not in ("", *SIMULATED)  # without an ending it is a name
        return _compose(path, arguments.package_dir, store) if composed else _parse_model(arguments.scene, store), store
    except OSError as error:
        raise CommandError(f"assets cannot be kept: {error} (another place: --assets DIR)") from None
    except SceneError as error:  # more than clients read
        raise CommandError(str(error)) from None


def _parse_model(scene: str, store: AssetStore) -> _Found:
    from iris_session.physics import World
    from iris_session.scene.mujoco_scene import parse_mujoco

    model = open_scene(scene).model
    beginning = World(model, (), ()).initial_data()  # as a session begins: in the keyframe `home`, if there is one
    parsed = parse_mujoco(model, store, data=beginning, name=Path(scene).stem)
    return _Found(parsed.spec, parsed.scene_hash, parsed.skipped)


def _compose(path: Path, package_dirs: list[str], store: AssetStore) -> _Found:
    from iris_session.scene import SceneBuildError

    builder = builder_of(path, path.stem, package_dirs)
    try:
        made = builder.build(store)
    except SceneBuildError as error:
        raise CommandError(str(error)) from None
    return _Found(made.spec, made.scene_hash, made.skipped)


def builder_of(path: Path, name: str, package_dirs: list[str]) -> SceneBuilder:
    """A scene called `name` with what is in a file that MuJoCo does not read."""
    from iris_session.scene import SceneBuildError
    from iris_session.scene.compose import SceneBuilder

    builder = SceneBuilder(name)
    try:
        if path.suffix.lower() == ".urdf":
            builder.add_urdf(path, package_dirs=package_dirs)
        else:
            builder.add_file(path, package_dirs=package_dirs)
    except SceneBuildError as error:
        advice = " (here: --package-dir DIR)" if "package_dirs" in str(error) else ""
        raise CommandError(f"{error}{advice}") from None
    return builder


def _size(n_bytes: int) -> str:
    return f"{n_bytes / 1e6:.1f} MB" if n_bytes >= 100_000 else f"{n_bytes / 1e3:.1f} kB"
