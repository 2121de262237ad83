"""`SceneBuilder`: compose scenes without MuJoCo from shapes, arrays and files.

Lengths are metres; the world frame is right-handed with z up. Nothing is encoded before `build`; files are read when
they are added, so that their errors show there.
"""

from __future__ import annotations

import math
import os
import reprlib
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Final, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from iris_session.assets.store import AssetStore
from iris_session.protocol.common import IDENTITY, Pose, Quat, Vec3
from iris_session.protocol.media import MAX_STREAMS
from iris_session.protocol.names import GeometryKind, LightKind, TextureKind
from iris_session.protocol.scene import Camera, Environment, Light, Rgb, Rgba
from iris_session.scene.arrays import to_array
from iris_session.scene.asset_builder import EncodeOptions
from iris_session.scene.build import ComposedBody, ComposedDeformable, SceneContent, build_scene
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.images import check_pixels, read_pixels
from iris_session.scene.importers.files import load_file
from iris_session.scene.importers.references import read_bounded
from iris_session.scene.importers.urdf import read_urdf
from iris_session.scene.meshes import MeshArrays, compute_creased_normals, index_corners, normalise
from iris_session.scene.nodes import (
    GREY,
    MAX_TRIANGLES,
    Appearance,
    DrawnItem,
    Matrix,
    TextureImage,
    color_images,
    is_solid,
    to_matrix,
    to_vec3,
    truncate_name,
)
from iris_session.scene.result import ComposedScene
from iris_session.streams.deformable_topology import MAX_VERTICES

#: Rotation of a file with y up: 90 degrees around x.
_FROM_Y_UP: Final = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
#: Longest name of a body in the state stream.
_MAX_NAME: Final = 64
#: Name of the root of every scene, also in recordings.
_WORLD: Final = "world"
_STRENGTHS: Final = ("emission", "specular", "shininess", "metallic", "roughness")


class PlacementOptions(TypedDict, total=False):
    """Arguments of `SceneBuilder` that place something; see there."""

    position: Sequence[float]
    quaternion: Sequence[float]
    movable: bool
    on: str


class AppearanceOptions(TypedDict, total=False):
    """Arguments of `SceneBuilder` that say how something looks; see there. `None` is the default."""

    rgba: Sequence[float] | None
    texture: str | PathLike[str] | NDArray[np.uint8] | None
    metallic: float | None
    roughness: float | None
    emission: float | None
    specular: float | None
    shininess: float | None
    repeat: Sequence[float]
    uniform: bool


class DrawingOptions(PlacementOptions, AppearanceOptions, total=False):
    """Arguments of `SceneBuilder` for what is drawn at a place."""


class SceneBuilder:
    """Composer of a scene.

    Methods return the name of what they added. Movable bodies, articulations and deformables need unique names; static
    content may have any name or none. A wrong argument raises `SceneBuildError`, whose message says what would be
    right, and adds nothing.

    Placement of shapes, meshes and files, as keyword arguments:

        position: Position [m] in the world, or in the frame of `on`.
        quaternion: Orientation `(w, x, y, z)`, likewise.
        movable: Publish its pose under its name; otherwise it is static.
        on: Name of a movable body or of a body of an articulation to fix it to.

    Appearance of the same and of deformables, as keyword arguments, as in `protocol.scene.Material`:

        rgba: Colour, 3 or 4 numbers from 0 to 1.
        texture: Path of an image, or pixels (height, width, 1, 3 or 4) uint8, first row on top; multiplied with
            the colour.
        metallic: From 0 to 1, as the following three unless stated otherwise.
        roughness: 0 is a mirror.
        emission: Light it gives off, 0 or more.
        specular: Strength of highlights.
        shininess: Sharpness of highlights; by default `1 - roughness`.
        repeat: Repetitions of the texture over the shape, or per metre with `uniform`.
        uniform: Let `repeat` count per metre.

    Attributes:
        environment: Fog, headlight and viewing distances; by default derived from the content of the scene.
    """

    def __init__(self, name: str = "scene") -> None:
        """Create an empty scene.

        Args:
            name: Name of the scene.
        """
        self.environment: Environment | None = None
        self._content = SceneContent(truncate_name(name))

    @property
    def triangles(self) -> int:
        """Number of triangles of all meshes so far. Encoding takes some seconds per million, once."""
        return sum(item.mesh.triangles for item in self._content.items if item.mesh is not None)

    @property
    def names(self) -> frozenset[str]:
        """Names of movable bodies, articulations with their links, and deformables so far."""
        return frozenset(self._content.names)

    # --- bodies -------------------------------------------------------------------------------------------------------

    def add_body(
        self, name: str, *, position: Sequence[float] = IDENTITY.p, quaternion: Sequence[float] = IDENTITY.q
    ) -> str:
        """Add a movable body without a shape: what is drawn is added `on` it.

        Args:
            name: Unique name.
            position: Position in the world [m].
            quaternion: Orientation in the world, `(w, x, y, z)`.
        """
        self._place(name, {"position": position, "quaternion": quaternion, "movable": True})
        return name

    # --- shapes -------------------------------------------------------------------------------------------------------

    def add_box(self, name: str = "", *, half_size: Sequence[float], **options: Unpack[DrawingOptions]) -> str:
        """Add a box centred on its frame.

        Args:
            name: Name; a movable body needs a unique one.
            half_size: Half lengths along x, y, z [m].
            **options: Placement and appearance; see the class.
        """
        size = check_numbers("half_size", half_size, 3, above=0.0)
        return self._add_shape(GeometryKind.BOX, name, size, options)

    def add_sphere(self, name: str = "", *, radius: float, **options: Unpack[DrawingOptions]) -> str:
        """Add a sphere.

        Args:
            name: Name; a movable body needs a unique one.
            radius: Radius [m].
            **options: Placement and appearance; see the class.
        """
        size = (check_number("radius", radius, above=0.0),) * 3
        return self._add_shape(GeometryKind.SPHERE, name, size, options)

    def add_ellipsoid(self, name: str = "", *, half_size: Sequence[float], **options: Unpack[DrawingOptions]) -> str:
        """Add an ellipsoid.

        Args:
            name: Name; a movable body needs a unique one.
            half_size: Half axes along x, y, z [m].
            **options: Placement and appearance; see the class.
        """
        size = check_numbers("half_size", half_size, 3, above=0.0)
        return self._add_shape(GeometryKind.ELLIPSOID, name, size, options)

    def add_capsule(
        self, name: str = "", *, radius: float, half_length: float, **options: Unpack[DrawingOptions]
    ) -> str:
        """Add a capsule along z: a cylinder with half spheres beyond its ends.

        Args:
            name: Name; a movable body needs a unique one.
            radius: Radius [m].
            half_length: Half length of the cylinder [m].
            **options: Placement and appearance; see the class.
        """
        size = check_numbers("radius and half_length", [radius, radius, half_length], 3, above=0.0)
        return self._add_shape(GeometryKind.CAPSULE, name, size, options)

    def add_cylinder(
        self, name: str = "", *, radius: float, half_length: float, **options: Unpack[DrawingOptions]
    ) -> str:
        """Add a cylinder along z.

        Args:
            name: Name; a movable body needs a unique one.
            radius: Radius [m].
            half_length: Half length [m].
            **options: Placement and appearance; see the class.
        """
        size = check_numbers("radius and half_length", [radius, radius, half_length], 3, above=0.0)
        return self._add_shape(GeometryKind.CYLINDER, name, size, options)

    def add_plane(
        self, name: str = "", *, half_size: Sequence[float] = (0.0, 0.0), **options: Unpack[DrawingOptions]
    ) -> str:
        """Add a rectangle in the plane z = 0, visible from +z.

        Args:
            name: Name; a movable body needs a unique one.
            half_size: Half lengths along x, y [m]; 0 is endless.
            **options: Placement and appearance; see the class.
        """
        size = check_numbers("half_size", half_size, 2)
        if min(size) < 0:
            raise SceneBuildError(f"half_size of a plane is {tuple(half_size)}: expected lengths, or 0 for endless")
        return self._add_shape(GeometryKind.PLANE, name, (*size, 1.0), options)

    def add_mesh(
        self,
        name: str = "",
        *,
        vertices: Any,
        triangles: Any,
        normals: Any = None,
        uvs: Any = None,
        colors: Any = None,
        **options: Unpack[DrawingOptions],
    ) -> str:
        """Add a mesh given as arrays.

        Args:
            name: Name; a movable body needs a unique one.
            vertices: Shape (n, 3) [m].
            triangles: Shape (m, 3), vertex numbers, counter-clockwise seen from outside.
            normals: Shape (n, 3); computed by default.
            uvs: Texture coordinates, shape (n, 2), v down.
            colors: Vertex colours, shape (n, 3 or 4), uint8.
            **options: Placement and appearance; see the class.
        """
        mesh = check_mesh(f"mesh {reprlib.repr(name)}", vertices, triangles, normals, uvs, colors)
        return self.add_mesh_arrays(name, mesh, **options)

    def add_mesh_arrays(
        self, name: str, mesh: MeshArrays, *, transform: Matrix | None = None, **options: Unpack[DrawingOptions]
    ) -> str:
        """Add a mesh that `check_mesh` has made, which may be added any number of times and is sent once per scale.

        Args:
            name: Name; a movable body needs a unique one.
            mesh: The mesh.
            transform: Shape (4, 4), applied to the mesh before its placement: rotation, position [m], scale and shear.
            **options: Placement and appearance; see the class.
        """
        appearance = parse_appearance(options) or Appearance(rgba=GREY if mesh.color is None else (1.0, 1.0, 1.0, 1.0))
        if transform is not None and not is_solid(transform):
            raise SceneBuildError(f"mesh {reprlib.repr(name)} is scaled to nothing: give every axis a scale")
        body, matrix = self._place(name, options)
        matrix = matrix if transform is None else matrix @ transform
        self._content.items.append(DrawnItem(body, truncate_name(name), matrix, appearance, mesh))
        return name

    # --- files --------------------------------------------------------------------------------------------------------

    def add_file(
        self,
        path: str | PathLike[str],
        *,
        scale: float | Sequence[float] = 1.0,
        up: str | None = None,
        package_dirs: Sequence[str | PathLike[str]] = (),
        name: str = "",
        **options: Unpack[DrawingOptions],
    ) -> str:
        """Add a glTF, GLB, OBJ, STL, PLY, OFF or DAE file.

        Nodes of a static file become bodies of the scene; a movable file is one body. If any argument of appearance is
        given, it replaces all materials of the file.

        Args:
            path: The file.
            scale: One unit of the file [m]; one number, or three for x, y, z.
            up: Axis of the file that points up, "y" or "z"; by default that of the format: y for glTF, and for DAE
                unless the file says otherwise.
            package_dirs: Folders that the file may refer into.
            name: Name; by default the stem of the file name.
            **options: Placement and appearance; see the class.

        Returns:
            The name.

        Raises:
            SceneBuildError: The file cannot be read, or an argument is wrong. Nothing is added.
        """
        where = check_path(path)
        if not isinstance(name, str):
            raise SceneBuildError(f"name is {name!r}: text is expected, '' for that of the file")
        name = name or where.stem[:_MAX_NAME]
        loaded = load_file(where, package_dirs, name)
        up_axis = up or loaded.up
        if up_axis not in ("y", "z"):
            wrong = f"{where.name} says that {up_axis} is up" if up is None else f"up is {up!r}"
            raise SceneBuildError(f"{wrong}: give up='y' or up='z', or None for what the format means")
        whole = to_array(scale, "scale").ndim == 0
        factors = (check_number("scale", scale),) * 3 if whole else check_numbers("scale", scale, 3)
        if 0.0 in factors:
            raise SceneBuildError("scale is 0: give one of the file's lengths in metres")
        T_up_file = _FROM_Y_UP if up_axis == "y" else np.eye(4)
        T_body_file = np.diag([*(loaded.unit * f for f in factors), 1.0]) @ T_up_file
        appearance = parse_appearance(options)
        with self._content.atomic(), np.errstate(all="ignore"):  # poses that are not finite are refused
            body, T_parent_body = self._place(name, options, named=True)
            moving = body >= 0 and self._content.bodies[body].moving
            self._content.add_nodes(loaded, body, T_parent_body @ T_body_file, appearance, flat=moving)
        return name

    def add_urdf(
        self,
        path: str | PathLike[str],
        *,
        name: str = "",
        position: Sequence[float] = IDENTITY.p,
        quaternion: Sequence[float] = IDENTITY.q,
        package_dirs: Sequence[str | PathLike[str]] = (),
        collisions: bool = False,
        scale: float = 1.0,
    ) -> str:
        """Add a URDF robot as an articulation; its links become bodies called `name/link`.

        Args:
            path: The file.
            name: Name of the articulation; by default the stem of the file name.
            position: Position of the root link in the world [m].
            quaternion: Orientation of the root link in the world, `(w, x, y, z)`.
            package_dirs: Folders of packages that it refers to; folders above the file are searched too.
            collisions: Draw collision shapes in place of visuals.
            scale: Factor on all drawn lengths; joint positions stay those of the robot, also of prismatic joints.

        Returns:
            The name.

        Raises:
            SceneBuildError: The file cannot be read, or an argument is wrong. Nothing is added.
        """
        where = check_path(path)
        name = name or where.stem[:_MAX_NAME]
        self._check_new_name(name)
        T_world_root = check_pose(position, quaternion)
        factor = check_number("scale", scale, above=0.0)
        robot = read_urdf(where, name, T_world_root, package_dirs, collisions=collisions, scale=factor)
        for body in robot.articulation.bodies:
            self._check_new_name(body)
        self._content.add_robot(robot)
        return name

    # --- deformables, lights, cameras ---------------------------------------------------------------------------------

    def add_deformable(
        self,
        name: str,
        vertices: Any,
        triangles: Any = None,
        *,
        edges: Any = None,
        uvs: Any = None,
        radius: float = 0.005,
        flat: bool = False,
        **appearance: Unpack[AppearanceOptions],
    ) -> str:
        """Add a mesh whose vertices are published: a surface of triangles, or ropes of edges.

        Args:
            name: Unique name.
            vertices: First vertices, shape (n, 3) [m], world frame.
            triangles: Shape (m, 3), vertex numbers. Exactly one of `triangles` and `edges` is needed.
            edges: Shape (m, 2), vertex numbers.
            uvs: Texture coordinates, shape (n, 2), v down.
            radius: Radius of ropes [m].
            flat: Draw one normal per face.
            **appearance: Appearance; see the class.
        """
        self._check_new_name(name)
        if len(self._content.deformables) >= MAX_STREAMS:
            raise SceneBuildError(
                f"deformable {name!r} is one too many: {MAX_STREAMS} are streamed, join some into one mesh"
            )
        if (triangles is None) == (edges is None):
            raise SceneBuildError(f"deformable {name!r} needs triangles (m, 3) or edges (m, 2): one of them")
        whose = f"deformable {name!r}"
        points = check_vertices(f"vertices of {whose}", vertices)
        if len(points) > MAX_VERTICES:
            raise SceneBuildError(
                f"deformable {name!r} has {len(points):,} vertices, at most {MAX_VERTICES:,}: make it coarser"
            )
        what, given, width = ("triangles", triangles, 3) if edges is None else ("edges", edges, 2)
        elements = check_triangles(f"{what} of {whose}", given, len(points), width)
        half = check_number("radius", radius, above=0.0)
        look = parse_appearance(appearance, AppearanceOptions)
        uv = None if uvs is None else check_vertices(f"uvs of {whose}", uvs, 2, len(points))
        self._content.deformables.append(
            ComposedDeformable(name, points, elements, uv, half, flat, look or Appearance())
        )
        self._content.names.add(name)
        return name

    def add_light(
        self,
        name: str = "",
        *,
        kind: str = LightKind.DIRECTIONAL,
        position: Sequence[float] = (0.0, 0.0, 3.0),
        direction: Sequence[float] = (0.0, 0.0, -1.0),
        diffuse: Rgb = (0.7, 0.7, 0.7),
        ambient: Rgb = (0.0, 0.0, 0.0),
        specular: Rgb = (0.3, 0.3, 0.3),
        cutoff: float = 45.0,
        castshadow: bool = True,
        on: str = "",
    ) -> str:
        """Add a light.

        Args:
            name: Name; need not be unique.
            kind: "directional", "spot" or "point".
            position: Position [m] in the world, or in the frame of `on`.
            direction: Direction it shines along, of any length, likewise.
            diffuse: Red, green, blue from 0 to 1; likewise `ambient` and `specular`.
            ambient: Light on surfaces that it does not reach.
            specular: Light of highlights.
            cutoff: Half angle of a spot light [degrees].
            castshadow: Let it cast shadows.
            on: Name of a movable body or of a body of an articulation that it moves with.

        Returns:
            `name`.
        """
        if kind not in (LightKind.DIRECTIONAL, LightKind.SPOT, LightKind.POINT):
            raise SceneBuildError(f"kind is {kind!r}: a light is directional, spot or point")
        along = np.array(check_numbers("direction", direction, 3))
        length = float(np.linalg.norm(along))
        if length < 1e-9:
            raise SceneBuildError("direction of a light is 0 0 0: it shines along one")
        light = Light(
            name=truncate_name(name),
            kind=kind,
            body=0,
            p_body=to_vec3(check_numbers("position", position, 3)),
            direction_body=to_vec3(along / length),
            ambient=to_vec3(check_numbers("ambient", ambient, 3)),
            diffuse=to_vec3(check_numbers("diffuse", diffuse, 3)),
            specular=to_vec3(check_numbers("specular", specular, 3)),
            cutoff=check_number("cutoff", cutoff),
            castshadow=castshadow,
        )
        self._content.lights.append((self._find_movable(on), light))
        return name

    def add_camera(
        self,
        name: str = "",
        *,
        position: Sequence[float] = IDENTITY.p,
        quaternion: Sequence[float] = IDENTITY.q,
        fovy: float = 45.0,
        resolution: tuple[int, int] = (1, 1),
        on: str = "",
    ) -> str:
        """Add a camera that looks along -z of its frame, with y up.

        Args:
            name: Name; need not be unique.
            position: Position [m] in the world, or in the frame of `on`.
            quaternion: Orientation `(w, x, y, z)`, likewise.
            fovy: Vertical field of view [degrees].
            resolution: Width and height [pixels].
            on: Name of a movable body or of a body of an articulation that it moves with.

        Returns:
            `name`.
        """
        angle = check_number("fovy", fovy, above=0.0)
        if angle >= 180.0:
            raise SceneBuildError(f"fovy is {fovy}: degrees below 180")
        camera = Camera(truncate_name(name), 0, check_pose(position, quaternion), angle, resolution=resolution)
        self._content.cameras.append((self._find_movable(on), camera))
        return name

    def set_skybox(self, pixels: Any) -> None:
        """Set the image around the scene.

        Args:
            pixels: Six square faces below one another in the order of docs/scene.md: shape (6 n, n, 3) uint8, or the
                path of such an image.

        Raises:
            SceneBuildError: The pixels are of another shape, or cannot be read.
        """
        faces = check_texture(pixels, "skybox")
        if faces.shape[0] != 6 * faces.shape[1]:
            raise SceneBuildError(f"a skybox of {faces.shape[1]} x {faces.shape[0]}: six squares below one another")
        self._content.skybox = TextureImage(faces, "skybox", TextureKind.SKYBOX)

    def build(self, store: AssetStore, *, options: EncodeOptions | None = None, threads: int = 0) -> ComposedScene:
        """Build the scene as composed so far, and put its assets into a store.

        The same content gives the same `scene_hash` in every process.

        Args:
            store: Store of the session that serves the scene.
            options: Encoding of meshes and textures.
            threads: Number of threads; 0 is one per processor, at most 8.

        Returns:
            The specification, its bodies, articulations and deformables.

        Raises:
            SceneBuildError: The scene is too large, or something in it cannot be drawn.
            OSError: The store cannot be written.
        """
        return build_scene(self._content, self.environment, store, options, threads)

    # --- internal -----------------------------------------------------------------------------------------------------

    def _add_shape(self, kind: str, name: str, size: tuple[float, ...], options: DrawingOptions) -> str:
        appearance = parse_appearance(options) or Appearance()
        body, matrix = self._place(name, options)
        self._content.items.append(
            DrawnItem(body, truncate_name(name), matrix, appearance, kind=kind, size=to_vec3(size))
        )
        return name

    def _place(self, name: str, options: PlacementOptions, *, named: bool = False) -> tuple[int, Matrix]:
        """Return the index of the body to add to (-1: the world), created if movable or `named`, and T_body_item."""
        if not isinstance(name, str):
            raise SceneBuildError(f"name is {name!r}: text is expected, '' for no name")
        pose = check_pose(options.get("position", IDENTITY.p), options.get("quaternion", IDENTITY.q))
        movable, on = bool(options.get("movable", False)), options.get("on", "")
        if on and movable:
            raise SceneBuildError(f"{name!r} is to be movable and on {on!r}: one of both")
        if on:
            return self._find_movable(on), to_matrix(pose)
        if movable:
            self._check_new_name(name)
            if name == _WORLD:
                raise SceneBuildError(f"name is {name!r}: that is the frame that all is in, give name= another one")
            self._content.names.add(name)
        if movable or named:
            self._content.bodies.append(ComposedBody(truncate_name(name), -1, pose, movable))
            return len(self._content.bodies) - 1, np.eye(4)
        return -1, to_matrix(pose)

    def _find_movable(self, on: str) -> int:
        """Return the index of the movable body `on`, -1 for none."""
        if not on:
            return -1
        for index, body in enumerate(self._content.bodies):
            if body.moving and body.name == on:
                return index
        names = ", ".join(body.name for body in self._content.bodies if body.moving) or "none"
        raise SceneBuildError(f"on={on!r}: no movable body has this name. Movable: {names}")

    def _check_new_name(self, name: str) -> None:
        if not isinstance(name, str) or not name or len(name) > _MAX_NAME or truncate_name(name) != name:
            raise SceneBuildError(
                f"name is {reprlib.repr(name)}: movable bodies, articulations, deformables need 1 to {_MAX_NAME} "
                "characters"
            )
        if name in self._content.names:
            raise SceneBuildError(f"there is a {name!r} already: choose another name")


# --- checks of arguments: every `SceneBuildError` names the argument and says what would be right -----------------


def parse_appearance(options: AppearanceOptions | DrawingOptions, known: type = DrawingOptions) -> Appearance | None:
    """Return the appearance that arguments describe, `None` when all are defaults.

    Raises:
        SceneBuildError: A value is out of its range, or the texture cannot be read.
        TypeError: An argument is not one of `known`.
    """
    if unknown := [name for name in options if name not in known.__annotations__]:
        names = ", ".join(known.__annotations__)
        raise TypeError(f"unexpected argument {unknown[0]!r}: these are known: {names}")
    rgba, texture = options.get("rgba"), options.get("texture")
    across, down = check_numbers("repeat", options.get("repeat", (1.0, 1.0)), 2)
    uniform = bool(options.get("uniform", False))
    values: dict[str, Any] = {
        name: check_number(name, value) for name in _STRENGTHS if (value := options.get(name)) is not None
    }
    if rgba is None and texture is None and not values and (across, down) == (1.0, 1.0) and not uniform:
        return None
    color = (GREY if texture is None else (1.0, 1.0, 1.0, 1.0)) if rgba is None else _check_rgba(rgba)
    images = () if texture is None else color_images(TextureImage(check_texture(texture, "texture")))
    for name, value in values.items():
        if value < 0.0 or (value > 1.0 and name != "emission"):
            raise SceneBuildError(f"{name} is {value:g}: {'0 or more' if name == 'emission' else 'from 0 to 1'}")
    if "roughness" in values and "shininess" not in values:  # for clients that do not draw by roughness
        values["shininess"] = min(max(1.0 - values["roughness"], 0.0), 1.0)
    return replace(Appearance(rgba=color, images=images, repeat=(across, down), uniform=uniform), **values)


def _check_rgba(rgba: Any) -> Rgba:
    try:
        numbers = check_numbers("rgba", rgba, len(rgba))
    except (TypeError, SceneBuildError):
        numbers = ()
    if len(numbers) not in (3, 4) or not all(0.0 <= v <= 1.0 for v in numbers):
        raise SceneBuildError(f"rgba is {rgba!r}: red, green, blue, alpha from 0 to 1 are needed; (1, 0, 0, 1) is red")
    red, green, blue, alpha = (*numbers, 1.0)[:4]
    return red, green, blue, alpha


def check_texture(given: Any, what: str) -> NDArray[np.uint8]:
    """Return the pixels given, or those of the image whose path is given."""
    if isinstance(given, str | PathLike):
        path = check_path(given)
        if path.is_dir():
            raise SceneBuildError(f"{what} is {str(path)!r}, a folder: the path of a picture is needed, or pixels")
        return read_pixels(read_bounded(path), str(path))
    return check_pixels(given, what)


def check_path(path: Any) -> Path:
    """Return the path of a file."""
    try:
        return Path(os.fsdecode(path))
    except TypeError:
        raise SceneBuildError(f"path is {path!r}: the path of a file is needed, as text or a Path") from None


def check_numbers(
    what: str, values: Any, count: int, needed: str = "", *, above: float | None = None
) -> tuple[float, ...]:
    """Return `count` finite numbers, greater than `above`. `needed`: what they are, for the message."""
    try:
        found = tuple(check_number(what, v) for v in values)
    except (TypeError, SceneBuildError):
        found = ()
    if len(found) != count:
        raise SceneBuildError(f"{what} is {values!r}: {count} finite numbers {needed} are needed".replace("  ", " "))
    if above is not None and min(found) <= above:
        raise SceneBuildError(f"{what} is {values!r}: numbers greater than {above:g} are needed")
    return found


def check_number(what: str, value: Any, *, above: float | None = None) -> float:
    """Return one finite number, greater than `above`."""
    try:
        found = math.nan if isinstance(value, str | bytes) else float(value)  # though `float` takes their digits
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not math.isfinite(found):
        raise SceneBuildError(f"{what} is {value!r}: a finite number is needed")
    if above is not None and found <= above:
        raise SceneBuildError(f"{what} is {value!r}: a number greater than {above:g} is needed")
    return found


def check_vertices(what: str, values: Any, width: int = 3, count: int | None = None) -> NDArray[np.float32]:
    """Return rows of finite float32, read-only."""
    needed = f"finite numbers of shape (n, {width}) are needed"
    given = to_array(values, what)
    if given.dtype.kind not in "biuf":
        raise SceneBuildError(f"{what}: an array of {given.dtype} of shape {given.shape}: {needed}")
    with np.errstate(over="ignore"):  # what float32 cannot hold is not finite then
        array = np.array(given, np.float32)
    if array.ndim != 2 or array.shape[1] != width or not len(array) or not np.isfinite(array).all():
        raise SceneBuildError(f"{what}: an array of shape {array.shape}: {needed}")
    if count is not None and len(array) != count:
        raise SceneBuildError(f"{what}: {len(array)} rows for {count} vertices: one each is needed")
    array.setflags(write=False)
    return array


def check_triangles(what: str, values: Any, vertices: int, width: int = 3) -> NDArray[np.uint32]:
    """Return rows of vertex numbers."""
    array = to_array(values, what)
    if array.ndim != 2 or array.shape[1] != width or not len(array) or array.dtype.kind not in "iu":
        raise SceneBuildError(
            f"{what}: an array {array.shape} of {array.dtype}: whole numbers of shape (m, {width}) are needed, at "
            "least one row"
        )
    if len(array) > MAX_TRIANGLES:
        raise SceneBuildError(f"{what}: {len(array)} rows: at most {MAX_TRIANGLES:,}")
    low, high = int(array.min()), int(array.max())
    if low < 0 or high >= vertices:
        wrong = low if low < 0 else high
        raise SceneBuildError(f"{what}: vertex {wrong} of {vertices}: numbers go from 0 to {vertices - 1}")
    return np.ascontiguousarray(array, np.uint32)


def check_mesh(whose: str, vertices: Any, triangles: Any, normals: Any, uvs: Any, colors: Any) -> MeshArrays:
    """Return a mesh of arrays per vertex. `whose`: its name in messages."""
    points = check_vertices(f"vertices of {whose}", vertices)
    index = check_triangles(f"triangles of {whose}", triangles, len(points)).astype(np.int64)
    if normals is None:
        across = compute_creased_normals(points.astype(np.float64), index).astype(np.float32)
    else:
        across = np.asarray(
            normalise(check_vertices(f"normals of {whose}", normals, 3, len(points)))[index], np.float32
        )
    uv = None if uvs is None else check_vertices(f"uvs of {whose}", uvs, 2, len(points))[index]
    color = None
    if colors is not None:
        array = to_array(colors, f"colors of {whose}")
        if array.dtype != np.uint8 or array.ndim != 2 or array.shape[1] not in (3, 4) or len(array) != len(points):
            raise SceneBuildError(
                f"colors of {whose}: {array.shape} of {array.dtype}: ({len(points)}, 3 or 4) of uint8"
            )
        if array.shape[1] == 3:
            array = np.concatenate([array, np.full((len(array), 1), 255, np.uint8)], axis=1)
        color = array[index]
    return index_corners(points[index], across, uv, color)


def check_pose(position: Any, quaternion: Any) -> Pose:
    """Return a pose with the quaternion normalised. Raises `SceneBuildError`."""
    x, y, z = check_numbers("position", position, 3, "(x, y, z) [m]")
    p: Vec3 = (x, y, z)
    q = check_numbers("quaternion", quaternion, 4, "(w, x, y, z)")
    length = math.hypot(*q)
    if not 1e-9 <= length < math.inf:
        raise SceneBuildError(
            f"quaternion is {quaternion!r}, of length {length:g}: (w, x, y, z) of length 1; (1, 0, 0, 0) turns nothing"
        )
    unit: Quat = (q[0] / length, q[1] / length, q[2] / length, q[3] / length)
    return IDENTITY if (p, unit) == (IDENTITY.p, IDENTITY.q) else Pose(p, unit)
