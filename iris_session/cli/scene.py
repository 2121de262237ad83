"""`iris-session scene inspect`, `scene export`: what clients are given of a scene, and a file for viewers."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from iris_session.cli.common import CommandError, add_json, open_scene, print_json
from iris_session.cli.scene_files import (
    add_file_options,
    builder_of,
    check_file_options,
    file_of,
    notes_on_model,
    path_of,
)

if TYPE_CHECKING:
    from iris_session.protocol.scene import SceneSpec
    from iris_session.scene import AssetStore
    from iris_session.scene.report import SceneReport


class _Found(NamedTuple):
    """A scene. `skipped`: what clients will not see. `notes`: what looks like a mistake."""

    spec: SceneSpec
    scene_hash: str
    skipped: tuple[str, ...]
    notes: tuple[str, ...]


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "scene",
        help="what clients are given of a scene, what is heavy in it; export to GLB",
        epilog="examples:\n  iris-session scene inspect scene.xml\n  iris-session scene inspect arm.urdf\n"
        "  iris-session scene inspect part.stl --scale 0.001    (a part in millimetres)\n"
        "  iris-session scene export handover handover.glb",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    inspect = actions.add_parser(
        "inspect",
        help="tree, extent, sizes, what is heavy and why, what a headset will struggle with",
        description="Shows what clients are given of a scene, what is heavy in it, what a Quest 3 will struggle with.",
    )
    _add_scene(inspect)
    add_json(inspect)
    inspect.set_defaults(run=run_inspect)
    export = actions.add_parser(
        "export",
        help="write the scene as a GLB file",
        description="Writes the scene as it stands at first as GLB (glTF 2.0): meshes, textures and colours, y up.",
    )
    _add_scene(export)
    export.add_argument("out", type=Path, metavar="OUT.glb", help="file to write")
    add_json(export)
    export.set_defaults(run=run_export)


def _add_scene(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scene",
        metavar="FILE",
        help="MJCF or MJB file, URDF, GLB, glTF, OBJ, STL, PLY, DAE or another file with geometry, or the name of a "
        "scene (see `iris-session serve --help`)",
    )
    add_file_options(parser)
    parser.add_argument(
        "--assets", default=None, metavar="DIR", help="where assets are kept (default: ~/.cache/iris-session/assets)"
    )


def run_inspect(arguments: argparse.Namespace) -> int:
    """Prints the report; status 0 whatever it says."""
    import msgspec

    from iris_session.scene.extent import extent_of
    from iris_session.scene.report import report

    parsed, store = _parse(arguments)
    extent = extent_of(parsed.spec, store)
    found = report(parsed.spec, parsed.scene_hash, parsed.skipped, extent)
    if arguments.json:
        print_json({**msgspec.to_builtins(found), "notes": parsed.notes})
    else:
        _print_report(parsed.spec, found, parsed.notes)
    return 0


def _print_report(spec: SceneSpec, found: SceneReport, notes: tuple[str, ...]) -> None:
    from iris_session.scene.extent import coordinates, size_text
    from iris_session.scene.report import tree

    for line in tree(spec):
        print(line)
    totals = found.totals
    print(
        f"\n{found.bodies} bodies ({found.moving} can move), {totals.objects} objects, {totals.triangles:,} triangles, "
        f"{len(spec.lights)} lights, {len(spec.deformables)} deformables"
    )
    if found.extent is not None:
        box = found.extent
        low, high = (", ".join(coordinates(box, corner)) for corner in (box.low, box.high))
        print(f"extent: {size_text(box)} along x, y, z, from ({low}) to ({high}), planes not counted")
    for text in notes:
        print(f"note: {text}")
    print(
        f"{_size(totals.asset_bytes)} of assets: {_size(totals.mesh_bytes)} meshes and {_size(totals.texture_bytes)} "
        f"textures, the rest coarser levels; {_size(totals.texture_memory)} of textures on a graphics card"
    )
    print("\nheaviest:")
    for heavy in found.heavy:
        print(f"  {heavy.kind} {heavy.name}: {heavy.why}; {_size(heavy.bytes)}, {heavy.levels} levels")
    for text in found.skipped:
        print(f"left out: {text}")
    for text in found.simplified:
        print(f"in recordings and GLB: {text}")
    for text in found.struggles:
        print(f"headset: {text}")
    if not found.struggles:
        print("headset: nothing here that a Quest 3 would struggle with")


def run_export(arguments: argparse.Namespace) -> int:
    """Writes the file and says how large it is, and what is not in it."""
    from iris_session.assets.errors import AssetStoreError
    from iris_session.scene import SceneBuildError
    from iris_session.scene.glb import write_glb
    from iris_session.scene.references import files_read
    from iris_session.scene.report import not_in_glb

    out = path_of(arguments.out)
    if out.suffix.lower() != ".glb":
        raise CommandError(f"{out} does not end in .glb: GLB is the only format of `scene export`")
    if _same_file(path_of(arguments.scene), out):
        raise CommandError(f"{out} is the file that is read: name another one to write")
    with files_read() as files:
        parsed, store = _parse(arguments)
    if any(_same_file(path, out) for path in (*files, *_files_of_model(arguments.scene))):
        raise CommandError(f"{out} is a file that {arguments.scene} is made of: name another one to write")
    try:
        size = write_glb(parsed.spec, store, out)
    except (SceneBuildError, AssetStoreError) as error:
        raise CommandError(str(error)) from None
    except OSError as error:
        raise CommandError(f"{out} cannot be written: {error.strerror or error}") from None
    simplified = not_in_glb(parsed.spec)
    if arguments.json:
        lists = {"skipped": parsed.skipped, "simplified": simplified, "notes": parsed.notes}
        print_json({"file": str(out), "bytes": size, "scene_hash": parsed.scene_hash, **lists})
        return 0
    for text in parsed.notes:
        print(f"note: {text}", file=sys.stderr)
    for text in parsed.skipped:
        print(f"left out: {text}", file=sys.stderr)
    for text in simplified:
        print(f"in the GLB: {text}", file=sys.stderr)
    print(f"{out}: {_size(size)}")
    return 0


def _files_of_model(scene: str) -> list[Path]:
    """What an MJCF file refers to."""
    path = path_of(scene)
    if path.suffix.lower() not in (".xml", ".mjcf") or not path.is_file():
        return []
    import mujoco

    names = getattr(mujoco, "mju_getXMLDependencies", None)  # since MuJoCo 3.3.7
    return [] if names is None else [Path(name) for name in names(str(path))]


def _same_file(a: Path, b: Path) -> bool:
    """Whether both are one file, also by a link, or in another spelling."""
    try:
        return a.samefile(b)
    except OSError:
        return False


def _parse(arguments: argparse.Namespace) -> tuple[_Found, AssetStore]:
    """The scene, with its assets in a store."""
    from iris_session.protocol.scene import SceneError
    from iris_session.scene import AssetStore

    path = file_of(arguments.scene)
    check_file_options(arguments, path)
    try:
        store = AssetStore(arguments.assets)
        return _parse_model(arguments.scene, store) if path is None else _compose(path, arguments, store), store
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
    return _Found(parsed.spec, parsed.scene_hash, parsed.skipped, notes_on_model(parsed.spec))


def _compose(path: Path, arguments: argparse.Namespace, store: AssetStore) -> _Found:
    from iris_session.scene import SceneBuildError

    builder = builder_of(path, path.stem, arguments)
    try:
        made = builder.build(store)
    except SceneBuildError as error:
        raise CommandError(str(error)) from None
    return _Found(made.spec, made.scene_hash, made.skipped, made.notes)


def _size(n_bytes: int) -> str:
    return f"{n_bytes / 1e6:.1f} MB" if n_bytes >= 100_000 else f"{n_bytes / 1e3:.1f} kB"
