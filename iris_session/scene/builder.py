"""`SceneBuilder`: scenes without MuJoCo, from shapes, arrays and files. Metres, world frame right-handed, z up.

Nothing is encoded before `build`; files are read when they are added, so that their faults show there.
"""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from os import PathLike
from typing import Any, Final, Unpack

import numpy as np

from iris_session.assets.store import AssetStore
from iris_session.protocol.common import IDENTITY, Vec3
from iris_session.protocol.media import MAX_STREAMS
from iris_session.protocol.names import GeometryKind, LightKind, TextureKind
from iris_session.protocol.scene import Camera, Environment, Light, Rgb
from iris_session.scene.arrays import array_of
from iris_session.scene.assembly import Flexible, Thing, World, assemble
from iris_session.scene.asset_builder import EncodeOptions
from iris_session.scene.composed import ComposedScene
from iris_session.scene.elements import Item, Look, Matrix, Picture, cut, matrix_of
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.importers.files import load_file
from iris_session.scene.importers.units import file_question, side_of
from iris_session.scene.importers.urdf import read_urdf
from iris_session.scene.validation import (
    Looks,
    checked_pose,
    given_mesh,
    given_vertices,
    look_of,
    number,
    numbers,
    path_of,
    takes,
    texture_of,
    triangles_of,
)
from iris_session.streams.deformable_topology import MAX_VERTICES

#: Turns what has y up: 90 degrees around x.
_FROM_Y_UP: Final = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
#: As long as names of bodies in the state stream may be.
_MAX_NAME: Final = 64
#: Taken by the root of every scene, also in recordings.
_WORLD: Final = "world"


class Options(Looks, total=False):
    """What every `add_` of a shape or mesh takes besides its own: how it looks (`Looks`), and where it is.

    `position` [m], `quaternion` `[w, x, y, z]`: in the world, or in the frame of the thing `on`. `movable`: it is
    addressed by its name and its pose is published; else it stands still. `on`: name of a movable thing or of a body
    of an articulation, which it is fixed to.
    """

    position: Sequence[float]
    quaternion: Sequence[float]
    movable: bool
    on: str


class SceneBuilder:
    """Collects things and builds a scene of them. `name`: of the scene. `environment`: what surrounds it; as it is,
    lights that shine along the view, no fog, and distances taken from what is there.

    Methods return the name of what they added. Movable things, articulations and deformables need one of their own;
    things that stand still may have any or none. Every refusal is a `SceneBuildError` that says what would be right;
    a keyword that a method does not have is a `TypeError`.
    """

    def __init__(self, name: str = "scene") -> None:
        self.environment: Environment | None = None
        self._world = World(cut(name))

    @property
    def triangles(self) -> int:
        """Of all meshes that were added: preparing them takes some seconds for each million, once."""
        return sum(item.mesh.triangles for item in self._world.items if item.mesh is not None)

    @property
    def names(self) -> frozenset[str]:
        """What moves or bends so far, links of articulations too."""
        return frozenset(self._world.names)

    # --- shapes -------------------------------------------------------------------------------------------------------

    @takes(Options)
    def add_box(self, name: str = "", *, half_size: Sequence[float], **options: Unpack[Options]) -> str:
        """A box of half lengths x, y, z."""
        return self._shape(GeometryKind.BOX, name, numbers("half_size", half_size, 3, above=0.0), options)

    @takes(Options)
    def add_sphere(self, name: str = "", *, radius: float, **options: Unpack[Options]) -> str:
        """A sphere."""
        return self._shape(GeometryKind.SPHERE, name, number("radius", radius, above=0.0) * 3, options)

    @takes(Options)
    def add_ellipsoid(self, name: str = "", *, half_size: Sequence[float], **options: Unpack[Options]) -> str:
        """An ellipsoid of half axes x, y, z."""
        return self._shape(GeometryKind.ELLIPSOID, name, numbers("half_size", half_size, 3, above=0.0), options)

    @takes(Options)
    def add_capsule(self, name: str = "", *, radius: float, half_length: float, **options: Unpack[Options]) -> str:
        """A capsule along z: two half spheres beyond the half length."""
        size = numbers("radius and half_length", [radius, radius, half_length], 3, above=0.0)
        return self._shape(GeometryKind.CAPSULE, name, size, options)

    @takes(Options)
    def add_cylinder(self, name: str = "", *, radius: float, half_length: float, **options: Unpack[Options]) -> str:
        """A cylinder along z."""
        size = numbers("radius and half_length", [radius, radius, half_length], 3, above=0.0)
        return self._shape(GeometryKind.CYLINDER, name, size, options)

    @takes(Options)
    def add_plane(self, name: str = "", *, half_size: Sequence[float] = (0.0, 0.0), **options: Unpack[Options]) -> str:
        """A rectangle in z = 0 that is seen from +z; a half length of 0 is without end."""
        x, y = numbers("half_size", half_size, 2)
        if x < 0 or y < 0:
            raise SceneBuildError(f"half_size of a plane is {tuple(half_size)}: lengths, or 0 for no end")
        return self._shape(GeometryKind.PLANE, name, (x, y, 1.0), options)

    @takes(Options)
    def add_mesh(
        self,
        name: str = "",
        *,
        vertices: Any,
        triangles: Any,
        normals: Any = None,
        uvs: Any = None,
        colors: Any = None,
        **options: Unpack[Options],
    ) -> str:
        """`vertices` (n, 3) [m], `triangles` (m, 3), counter-clockwise seen from outside; of the vertices `normals`
        (n, 3), texture coordinates `uvs` (n, 2; v down), `colors` (n, 3 or 4) uint8. Without normals they are made.
        """
        mesh = given_mesh(f"mesh {reprlib.repr(name)}", vertices, triangles, normals, uvs, colors)
        look = look_of(options) or Look(rgba=(1.0, 1.0, 1.0, 1.0) if colors is not None else Look().rgba)
        body, matrix = self._place(name, options)
        self._world.items.append(Item(body, cut(name), matrix, look, mesh))
        return name

    # --- files --------------------------------------------------------------------------------------------------------

    @takes(Options)
    def add_file(
        self,
        path: str | PathLike[str],
        *,
        scale: float | Sequence[float] = 1.0,
        up: str | None = None,
        package_dirs: Sequence[str | PathLike[str]] = (),
        name: str = "",
        **options: Unpack[Options],
    ) -> str:
        """A glTF or GLB, OBJ, STL, PLY, OFF, DAE, 3MF file. Without a name it is called as the file.

        `scale`: of one of its lengths [m]. `up`: its axis that is up, `y` or `z`; as it is, that of the format, y for
        glTF and DAE that say nothing else. A look, if one is given, takes the place of all in the file. Nodes of what
        stands still are bodies of the scene; what is movable is one. `package_dirs`: folders it may refer into.
        """
        where = path_of(path)
        if not isinstance(name, str):
            raise SceneBuildError(f"name is {name!r}: text is expected, '' for that of the file")
        name = name or where.stem[:_MAX_NAME]
        loaded = load_file(where, package_dirs, name)
        turn = up or loaded.up
        if turn not in ("y", "z"):
            said = f"{where.name} says that {turn} is up" if up is None else f"up is {up!r}"
            raise SceneBuildError(f"{said}: give up='y' or up='z', or None for what the format means")
        one = array_of(scale, "scale").ndim == 0
        if one:
            (factor,) = number("scale", scale, "a number, or three, is needed")
        factors = (factor,) * 3 if one else numbers("scale", scale, 3)
        if 0.0 in factors:
            raise SceneBuildError("scale is 0: give one of the file's lengths in metres")
        T_thing_file = np.diag([*(loaded.unit * f for f in factors), 1.0]) @ (_FROM_Y_UP if turn == "y" else np.eye(4))
        look = look_of(options)
        with self._world.whole(), np.errstate(all="ignore"):  # places that are not finite are refused
            body, T_body_thing = self._place(name, options, named=True)
            self._world.add_nodes(loaded, body, T_body_thing @ T_thing_file, look, flat=self._moves(body))
            placed = [(one.mesh, T_thing_file @ node.matrix) for node in loaded.nodes for one in node.surfaces]
            self._world.note(file_question(where.name, side_of(placed), factors))
        return name

    @takes()
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
        """An articulation: links that joints move are bodies called `name/link`, its root among them.

        Without a name it is called as the file. `package_dirs`: folders of the packages it refers to; folders above the
        file are searched too. `collisions`: draw its collision shapes in place of visuals. `scale`: how large it is
        drawn; positions of its joints stay those of the robot, also where they slide.
        """
        where = path_of(path)
        name = name or where.stem[:_MAX_NAME]
        self._new_name(name)
        T_world_root = checked_pose(position, quaternion)
        (factor,) = number("scale", scale, above=0.0)
        robot = read_urdf(where, name, T_world_root, package_dirs, collisions=collisions, scale=factor)
        for body in robot.articulation.bodies:
            self._new_name(body)
        self._world.add_robot(robot)
        return name

    # --- what bends, shines and looks ---------------------------------------------------------------------------------

    @takes(Looks)
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
        **looks: Unpack[Looks],
    ) -> str:
        """A mesh whose vertices are published: a cloth or a surface of `triangles` (m, 3), or ropes of `edges` (m, 2)
        and `radius` [m]. `vertices` (n, 3) [m]: the first ones, world frame. `uvs` (n, 2). `flat`: a normal per face.
        """
        self._new_name(name)
        if len(self._world.flexibles) >= MAX_STREAMS:
            raise SceneBuildError(
                f"deformable {name!r} is one too many: {MAX_STREAMS} are streamed, join some into one mesh"
            )
        if (triangles is None) == (edges is None):
            raise SceneBuildError(f"deformable {name!r} needs triangles (m, 3) or edges (m, 2): one of them")
        whose = f"deformable {name!r}"
        points = given_vertices(f"vertices of {whose}", vertices)
        if len(points) > MAX_VERTICES:
            raise SceneBuildError(
                f"deformable {name!r} has {len(points):,} vertices, at most {MAX_VERTICES:,}: make it coarser"
            )
        what, given, width = ("triangles", triangles, 3) if edges is None else ("edges", edges, 2)
        elements = triangles_of(f"{what} of {whose}", given, len(points), width)
        (half,) = number("radius", radius, above=0.0)
        look = look_of(looks) or Look()
        coordinates = None if uvs is None else given_vertices(f"uvs of {whose}", uvs, 2, len(points))
        self._world.flexibles.append(Flexible(name, points, elements, coordinates, half, flat, look))
        self._world.names.add(name)
        return name

    @takes()
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
        """A light; `kind`: directional, spot or point. In the frame of the thing `on`, or in the world."""
        if kind not in (LightKind.DIRECTIONAL, LightKind.SPOT, LightKind.POINT):
            raise SceneBuildError(f"a light of kind {kind!r}: directional, spot or point")
        along = np.array(numbers("direction", direction, 3))
        length = float(np.linalg.norm(along))
        if length < 1e-9:
            raise SceneBuildError("direction of a light is 0 0 0: it shines along one")
        light = Light(
            name=cut(name),
            kind=kind,
            body=0,
            p_body=_three("position", position),
            direction_body=_three("direction", along / length),
            ambient=_three("ambient", ambient),
            diffuse=_three("diffuse", diffuse),
            specular=_three("specular", specular),
            cutoff=numbers("cutoff", [cutoff], 1)[0],
            castshadow=castshadow,
        )
        self._world.lights.append((self._body_named(on), light))
        return name

    @takes()
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
        """A camera that looks along -z of its frame, y up, with a vertical field of view of `fovy` degrees."""
        (angle,) = number("fovy", fovy, above=0.0)
        if angle >= 180.0:
            raise SceneBuildError(f"fovy is {fovy}: degrees below 180")
        camera = Camera(cut(name), 0, checked_pose(position, quaternion), angle, resolution=resolution)
        self._world.cameras.append((self._body_named(on), camera))
        return name

    def set_skybox(self, pixels: Any) -> None:
        """Around everything: six square faces below one another, (6 n, n, 3) uint8 or the path of such a picture, in
        the order of docs/scene.md."""
        faces = texture_of(pixels, "skybox")
        if faces.shape[0] != 6 * faces.shape[1]:
            raise SceneBuildError(f"a skybox of {faces.shape[1]} x {faces.shape[0]}: six squares below one another")
        self._world.skybox = Picture(faces, "skybox", TextureKind.SKYBOX)

    def build(self, store: AssetStore, *, options: EncodeOptions | None = None, threads: int = 0) -> ComposedScene:
        """The scene as it stands; its assets are in `store` afterwards. The same things give the same hash anywhere."""
        return assemble(self._world, self.environment, store, options, threads)

    # --- inside -------------------------------------------------------------------------------------------------------

    def _shape(self, kind: str, name: str, size: tuple[float, ...], options: Options) -> str:
        look = look_of(options) or Look()
        body, matrix = self._place(name, options)
        self._world.items.append(Item(body, cut(name), matrix, look, kind=kind, size=(size[0], size[1], size[2])))
        return name

    def _place(self, name: str, options: Options, *, named: bool = False) -> tuple[int, Matrix]:
        """The body that something is added to, made for it where it is movable or `named`, and T_body_thing."""
        if not isinstance(name, str):
            raise SceneBuildError(f"name is {name!r}: text is expected, '' for no name")
        T = checked_pose(options.get("position", IDENTITY.p), options.get("quaternion", IDENTITY.q))
        on, movable = options.get("on", ""), options.get("movable", False)
        if on and movable:
            raise SceneBuildError(f"{name!r} is to be movable and on {on!r}: one of both")
        if on:
            return self._body_named(on), matrix_of(T)
        if movable:
            self._new_name(name)
            if name == _WORLD:
                raise SceneBuildError(f"name is {name!r}: that is the frame that all is in, give name= another one")
            self._world.names.add(name)
        if movable or named:
            self._world.things.append(Thing(cut(name), -1, T, movable))
            return len(self._world.things) - 1, np.eye(4)
        return -1, matrix_of(T)

    def _moves(self, body: int) -> bool:
        return body >= 0 and self._world.things[body].moving

    def _body_named(self, on: str) -> int:
        """Place of the movable body `on`, -1 for none."""
        if not on:
            return -1
        for place, thing in enumerate(self._world.things):
            if thing.moving and thing.name == on:
                return place
        names = ", ".join(thing.name for thing in self._world.things if thing.moving) or "none"
        raise SceneBuildError(f"on={on!r}: no movable body is called so. Movable: {names}")

    def _new_name(self, name: str) -> None:
        if not isinstance(name, str) or not name or len(name) > _MAX_NAME or cut(name) != name:
            raise SceneBuildError(
                f"name is {reprlib.repr(name)}: what moves needs one of 1 to {_MAX_NAME} characters, by which it is "
                "addressed"
            )
        if name in self._world.names:
            raise SceneBuildError(f"there is a {name!r} already: what moves needs a name of its own")


def _three(what: str, values: Any) -> Vec3:
    x, y, z = numbers(what, values, 3)
    return x, y, z
