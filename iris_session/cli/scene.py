"""`iris-session robots`, `scene inspect`, `scene export`: the robots of a model, what clients receive of a scene, GLB.

Also the scene arguments that `serve` shares: MuJoCo reads MJCF, MJB and named scenes; every other file is composed
without it (`SceneBuilder`).
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from iris_session.cli.common import (
    ABOVE_0,
    CommandError,
    Commands,
    add_actions,
    add_command,
    make_number_type,
    open_scene,
    print_json,
    print_result,
    to_printable,
)

if TYPE_CHECKING:
    from iris_session.protocol.scene import SceneSpec
    from iris_session.scene import AssetStore
    from iris_session.scene.builder import SceneBuilder
    from iris_session.scene.report import SceneReport


class _ParsedScene(NamedTuple):
    """Scene for inspection. `skipped`: what clients will not see. `notes`: probable mistakes."""

    spec: SceneSpec
    scene_hash: str
    skipped: tuple[str, ...]
    notes: tuple[str, ...]


def register(commands: Commands) -> None:
    _register_robots(commands)
    actions = add_actions(
        commands,
        "scene",
        help="inspect what clients receive of a scene, or export it to GLB",
    )
    inspect = add_command(
        actions,
        "inspect",
        run_inspect,
        help="tree, extent, sizes, heavy parts, warnings for headsets",
        description="Show what clients receive of a scene, which parts are heavy, and what is too much for a Quest 3.",
        examples="""
            iris-session scene inspect scene.xml
            iris-session scene inspect part.stl --scale 0.001    (a part in millimetres)
        """,
    )
    _add_scene_arguments(inspect)
    export = add_command(
        actions,
        "export",
        run_export,
        help="write the scene as a GLB file",
        description="Write the initial scene as GLB (glTF 2.0): meshes, textures and colours, y up.",
        examples="iris-session scene export handover handover.glb",
    )
    _add_scene_arguments(export)
    export.add_argument("out", type=Path, metavar="OUT.glb", help="file to write")


def _register_robots(commands: Commands) -> None:
    parser = add_command(
        commands,
        "robots",
        run_robots,
        help="show the robots found in a model, as TOML to edit",
        description="Print the robots found in a model. Edit the output and pass it as `serve --robots FILE`. Where "
        "something about a robot is unclear, a comment says so.",
        examples="""
            iris-session robots scene.xml > robots.toml
            iris-session robots quadruped.xml --all
            iris-session robots handover
        """,
    )
    parser.add_argument("scene", help="MJCF or MJB file, or the name of a scene (see `iris-session serve --help`)")
    parser.add_argument("--all", action="store_true", help="also legs, heads and fingers, which are not offered")


def run_robots(arguments: argparse.Namespace) -> int:
    """Print the robots that a session offers, and those that can only be watched."""
    from iris_session.control.config import ControlConfig
    from iris_session.physics import find_objects
    from iris_session.session.robots import explain_no_robots, find_drivable_robots

    model = open_scene(arguments.scene).model
    found = find_drivable_robots(model, ControlConfig(), all_limbs=arguments.all)
    robots, objects, notices = found.robots, find_objects(model), found.texts
    if not robots:
        print(explain_no_robots(model), file=sys.stderr)
    for text in notices:
        print(to_printable(text), file=sys.stderr)
    first = f"# {len(robots)} robots, {len(objects)} free objects: {', '.join(o.name for o in objects) or 'none'}"
    if arguments.json:
        print_json({"robots": robots, "objects": objects, "notices": notices})
    else:
        print(f"{first}\n{found.to_toml()}", flush=True)  # a file: names as they are
    return 0


def _add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    text = (
        "MJCF or MJB file, URDF, GLB, glTF, OBJ, STL, PLY, DAE or another file with geometry, or the name of a "
        "scene (see `iris-session serve --help`)"
    )
    parser.add_argument("scene", metavar="FILE", help=text)
    add_file_options(parser)
    parser.add_argument("--assets", metavar="DIR", help="folder of assets (default: ~/.cache/iris-session/assets)")


def run_inspect(arguments: argparse.Namespace) -> int:
    """Print the report of a scene."""
    import msgspec

    from iris_session.scene.report import build_report, compute_extent

    parsed, store = _parse_scene(arguments)
    extent = compute_extent(parsed.spec, store)
    found = build_report(parsed.spec, parsed.scene_hash, parsed.skipped, extent)
    result = {**msgspec.to_builtins(found), "notes": parsed.notes}
    return print_result(arguments, result, _format_report(parsed.spec, found, parsed.notes))


def _format_report(spec: SceneSpec, found: SceneReport, notes: tuple[str, ...]) -> Iterator[str]:
    from iris_session.scene.report import format_coordinates, format_size, format_tree

    yield from format_tree(spec)
    totals = found.totals
    yield ""
    yield (
        f"{found.bodies} bodies ({found.moving} can move), {totals.objects} objects, {totals.triangles:,} triangles, "
        f"{len(spec.lights)} lights, {len(spec.deformables)} deformables"
    )
    if found.extent is not None:
        box = found.extent
        low, high = (", ".join(format_coordinates(box, corner)) for corner in (box.low, box.high))
        yield f"extent: {format_size(box)} along x, y, z, from ({low}) to ({high}), planes not counted"
    yield from (f"note: {text}" for text in notes)
    yield (
        f"{_format_size(totals.asset_bytes)} of assets: {_format_size(totals.mesh_bytes)} meshes and "
        f"{_format_size(totals.texture_bytes)} textures, the rest coarser levels; "
        f"{_format_size(totals.texture_memory)} of textures on a graphics card"
    )
    yield from ("", "heaviest:")
    for heavy in found.heavy:
        yield f"  {heavy.kind} {heavy.name}: {heavy.why}; {_format_size(heavy.bytes)}, {heavy.levels} levels"
    yield from (f"skipped: {text}" for text in found.skipped)
    yield from (f"in recordings and GLB: {text}" for text in found.simplified)
    yield from (f"headset: {text}" for text in found.struggles or ("nothing is too much for a Quest 3",))


def run_export(arguments: argparse.Namespace) -> int:
    """Write the file, and print its size and what it does not contain."""
    from iris_session.assets.errors import AssetStoreError
    from iris_session.scene.glb import write_glb
    from iris_session.scene.importers.references import files_read
    from iris_session.scene.report import list_glb_differences

    out = expand_path(arguments.out)
    if out.suffix.lower() != ".glb":
        raise CommandError(f"{out}: the file must end in .glb, the only format of `scene export`")
    if _is_same_file(expand_path(arguments.scene), out):
        raise CommandError(f"{out} is the input file: give another output file")
    with files_read() as files:
        parsed, store = _parse_scene(arguments)
    if any(_is_same_file(path, out) for path in files):
        raise CommandError(f"{out} is part of {arguments.scene}: give another output file")
    try:
        size = write_glb(parsed.spec, store, out)
    except AssetStoreError:
        raise
    except OSError as error:
        raise CommandError(f"{out} cannot be written: {error.strerror or error}") from None
    simplified = list_glb_differences(parsed.spec)
    lists = {"note": parsed.notes, "skipped": parsed.skipped, "in the GLB": simplified}
    if not arguments.json:
        print(
            *(f"{kind}: {text}\n" for kind, texts in lists.items() for text in texts), sep="", end="", file=sys.stderr
        )
    result = {"file": str(out), "bytes": size, "scene_hash": parsed.scene_hash, "skipped": parsed.skipped}
    print_result(
        arguments,
        {**result, "simplified": simplified, "notes": parsed.notes},
        [f"{out}: {_format_size(size)}"],
    )
    return 0


def _is_same_file(a: Path, b: Path) -> bool:
    """Return whether both paths are one file, also by a link or in another spelling."""
    try:
        return a.samefile(b)
    except OSError:
        return False


def _parse_scene(arguments: argparse.Namespace) -> tuple[_ParsedScene, AssetStore]:
    """Return the scene, and the store of its assets."""
    from iris_session.scene import AssetStore

    path = find_scene_file(arguments.scene)
    check_file_options(arguments, path)
    try:
        store = AssetStore(arguments.assets)
        if path is None:
            return _parse_model(arguments.scene, store), store
        made = make_builder(path, path.stem, arguments).build(store)
        return _ParsedScene(made.spec, made.scene_hash, made.skipped, made.notes), store
    except OSError as error:
        raise CommandError(f"assets cannot be stored: {error} (choose another folder with --assets DIR)") from None


def _parse_model(scene: str, store: AssetStore) -> _ParsedScene:
    from iris_session.physics import World
    from iris_session.scene.mujoco_scene import parse_mujoco
    from iris_session.scene.report import check_model_units

    model = open_scene(scene).model
    # The initial state of a session: the keyframe `home`, if there is one.
    parsed = parse_mujoco(model, store, data=World(model, (), ()).make_initial_data(), name=Path(scene).stem)
    return _ParsedScene(parsed.spec, parsed.scene_hash, parsed.skipped, check_model_units(parsed.spec))


def _format_size(n_bytes: int) -> str:
    return f"{n_bytes / 1e6:.1f} MB" if n_bytes >= 100_000 else f"{n_bytes / 1e3:.1f} kB"


#: Suffixes of files that MuJoCo simulates; any other file is composed and shown as it is.
SIMULATED: Final = (".xml", ".mjcf", ".mjb")


def add_file_options(parser: argparse.ArgumentParser) -> None:
    text = "folder of packages that the file refers to by package://, or may refer into; repeatable"
    parser.add_argument("--package-dir", action="append", default=[], metavar="DIR", help=text)
    wanted = "a factor: give a number above 0, for example 0.001 for a file in millimetres"
    text = "scale of the file: 0.001 for millimetres; not for MJCF and MJB, which are simulated"
    parser.add_argument("--scale", type=make_number_type(float, wanted, ABOVE_0), metavar="FACTOR", help=text)
    parser.add_argument("--collisions", action="store_true", help="of a URDF: draw collision shapes, not visuals")


def expand_path(text: str | Path) -> Path:
    """Return a path with `~` expanded."""
    try:
        return Path(text).expanduser()
    except RuntimeError:  # an unknown user
        raise CommandError(f"{text}: no such home folder") from None


def find_scene_file(scene: str) -> Path | None:
    """Return the file to show, `None` if the scene is for MuJoCo: a model, or a name. Raises `CommandError`."""
    from iris_session.demo.scene_names import SCENE_NAMES
    from iris_session.scene.importers.references import ENDINGS, check_present, xacro_advice

    path = expand_path(scene)
    kind = path.suffix.lower()
    if kind in SIMULATED and not path.is_dir():
        return None
    has_name = scene.rstrip("0123456789") in SCENE_NAMES  # a folder of the same name does not hide it
    if not kind and not path.is_file() and (has_name or not path.is_dir()):
        return None
    check_present(path)
    if kind == ".xacro":
        raise CommandError(f"{path.name}: {xacro_advice(path)}")
    if kind.lstrip(".") not in ENDINGS:
        what = f"files that end in {kind} cannot be read" if kind else "a file without a suffix cannot be read"
        raise CommandError(f"{path.name}: {what}; supported are {', '.join(ENDINGS)}")
    return path


def check_file_options(arguments: argparse.Namespace, path: Path | None) -> None:
    """Raise `CommandError` for options that do not apply. `path`: from `find_scene_file`."""
    for folder in arguments.package_dir:
        if not os.path.isdir(os.path.expanduser(folder)):
            raise CommandError(f"--package-dir {folder}: no such folder")
    if path is None and arguments.package_dir:
        raise CommandError("--package-dir applies to files to show only: MuJoCo's models name their folders themselves")
    if arguments.collisions and (path is None or path.suffix.lower() != ".urdf"):
        raise CommandError("--collisions applies to URDF files only; --groups shows those of MuJoCo's models")
    if path is None and arguments.scale is not None:
        raise CommandError(
            f"--scale cannot be used with {arguments.scene or 'the scene'}: MuJoCo simulates it, and its dynamics "
            "depend on its size; scale meshes in the file, by <mesh scale=...>"
        )


def make_builder(path: Path, name: str, arguments: argparse.Namespace) -> SceneBuilder:
    """Return a scene called `name` with the content of a file that MuJoCo does not read."""
    from iris_session.scene import SceneBuildError
    from iris_session.scene.builder import SceneBuilder

    builder, scale = SceneBuilder(name), 1.0 if arguments.scale is None else arguments.scale
    if (size := path.stat().st_size) > 5_000_000:  # more than about a second
        print(f"reading {path.name} ({size / 1e6:.1f} MB)", file=sys.stderr, flush=True)
    try:
        if path.suffix.lower() == ".urdf":
            builder.add_urdf(path, package_dirs=arguments.package_dir, scale=scale, collisions=arguments.collisions)
        else:
            builder.add_file(path, package_dirs=arguments.package_dir, scale=scale)
    except SceneBuildError as error:
        advice = " (here: --package-dir DIR)" if "package_dirs" in str(error) else ""
        raise CommandError(f"{error}{advice}") from None
    if builder.triangles > 100_000:
        text = f"preparing meshes of {path.name} ({builder.triangles:,} triangles; cached for the next time)"
        print(text, file=sys.stderr, flush=True)
    return builder
