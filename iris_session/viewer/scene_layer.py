"""Picture of the scene in a recording: an entity per body, which `MotionRows` moves, its geometry below it.

Below `/scene/<number>` are `robots/<robot>/<link>`, `bodies/<body>`, and `world` for what has no body. None of it is
static, because Rerun shows static data at all times: scenes replace one another, patches change the look of visuals,
and deformables move. A scene is drawn at its first state.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from anchors.pose import PoseTuple
from iris_session.journal.messages import RobotLabels, SceneAssets
from iris_session.protocol.scene import SceneSpec, Visual
from iris_session.protocol.server_messages import BodyInfo
from iris_session.protocol.specs import RobotSpec
from iris_session.rrd import paths
from iris_session.scene import SceneBuildError
from iris_session.viewer import scene_geometry
from iris_session.viewer.deformables import DrawnDeformable
from iris_session.viewer.scene_geometry import SceneReader, VisualShape
from iris_session.viewer.timelines import Moment, log_at, set_moment, to_time_columns

#: Number of escaped names that are kept: Rerun takes longer for one than the recorder for all else of a row.
MAX_ESCAPED: Final = 8192
#: Maximum number of entities named in an error line about entities that cannot be drawn.
NAMED: Final = 5
#: Errors that keep a scene or a part of it from being drawn. Recording continues: the journal matters more.
_NOT_DRAWN: Final = (ValueError, LookupError, TypeError, OSError, zlib.error, SceneBuildError)


class SceneSource(NamedTuple):
    """Source of the picture of a scene. `packed_model`: used if no assets are shared."""

    packed_model: bytes
    bodies: Sequence[BodyInfo]
    assets: SceneAssets = SceneAssets()
    robots: Sequence[RobotSpec | RobotLabels] = ()


class _Drawn(NamedTuple):
    """A visual as it is in the picture now; `shown`: it is visible."""

    visual: Visual
    entity: str
    kind: str
    tint: tuple[float, float, float]
    shown: bool


class SceneLayer:
    """Geometry of the scenes of one file. `is_first`: the file is no later part, which begins where others end.

    `deformables`: deformables of the present scene, by stream. `since_ns`: session time [ns] from which the present
    scene is drawn.
    """

    def __init__(self, recording: rr.RecordingStream, *, is_first: bool = True) -> None:
        self._rec = recording
        self._is_first = is_first
        self._number = 0
        self._entities: dict[str, str] = {}
        self._robots: dict[int, str] = {}
        self._source: SceneSource | None = None
        self._waits = False
        self._visuals: dict[int, _Drawn] = {}
        self._names: Counter[str] = Counter()
        self._failed: list[str] = []
        self.deformables: dict[str, DrawnDeformable] = {}
        self.since_ns = 0

    def set_scene(self, source: SceneSource) -> None:
        """Set the scene to be drawn by the next `draw`."""
        self._source, self._waits = source, True

    def replace_scene(self, source: SceneSource, moment: Moment) -> None:
        """Replace the scene from `moment` on."""
        begun = not self._waits and self._source is not None
        self.set_scene(source)
        if begun:
            log_at(self._rec, moment, self._folder, rr.Clear(recursive=True))
            self.draw(moment)

    def patch_scene(self, assets: SceneAssets, moment: Moment) -> None:
        """Update the present scene to the specification in `assets` from `moment` on."""
        if self._source is None:
            return
        self._source = self._source._replace(assets=assets)
        if not self._waits:
            set_moment(self._rec, moment)
            self._with_scene(self._update)
            self._rec.reset_time()

    def draw(self, moment: Moment) -> bool:
        """Draw the scene given to `set_scene`, once, from `moment` on. Return whether it was drawn now."""
        if not self._waits:
            return False
        self._waits = False
        self._number += 1
        self._visuals.clear()
        self._names.clear()
        self._entities.clear()
        self._robots.clear()
        self.deformables.clear()
        self.since_ns = moment.session_ns
        set_moment(self._rec, moment)
        if self._number == 1 and not self._is_first:
            for drawn in (paths.SCENE, paths.PRESENCE):  # as the part before left it
                self._rec.log(drawn, rr.Clear(recursive=True), strict=True)
        self._with_scene(self._draw_all)
        self._rec.reset_time()
        return True

    def find_entity(self, body: str) -> str:
        """Return the entity of a body of the present scene, by its name."""
        assert self._source is not None
        if not self._entities:
            taken: set[str] = set()
            for info in self._source.bodies:
                robot = self._robots.get(info.id, "")
                name = info.name.removeprefix(f"{robot}/") if robot else info.name
                folder = f"{self._folder}/robots/{escape_entity_part(robot)}" if robot else f"{self._folder}/bodies"
                entity = f"{folder}/{escape_entity_part(name)}"
                if entity in taken:
                    entity = f"{folder}/{escape_entity_part(info.name)}"
                taken.add(entity)
                self._entities[info.name] = entity
        return self._entities[body]

    @property
    def _folder(self) -> str:
        return f"{paths.SCENE}/{self._number}"

    def _with_scene(self, work: Any) -> None:
        """Call `work(spec, reader)` on the present scene; log errors where the viewer shows them."""
        assert self._source is not None
        if not (self._source.packed_model or self._source.assets.root):
            return
        self._failed = []
        try:
            with scene_geometry.open_scene(self._source.assets, self._source.packed_model) as (spec, store):
                work(spec, SceneReader(spec, store, self._source.bodies))
        except _NOT_DRAWN as error:
            self._log_error(f"the scene is not drawn: {error}")
        if self._failed:
            more = f" and {len(self._failed) - NAMED} more" if len(self._failed) > NAMED else ""
            self._log_error(f"{', '.join(self._failed[:NAMED])}{more} cannot be drawn")

    def _log_error(self, text: str) -> None:
        self._rec.log(f"{paths.EVENTS}/recorder", rr.TextLog(text, level="ERROR"), strict=True)

    def _draw_all(self, spec: SceneSpec, reader: SceneReader) -> None:
        assert self._source is not None
        self._robots = scene_geometry.assign_robots(spec, self._source.robots)
        self._entities.clear()
        for visual in spec.visuals:
            if reader.is_shown(visual):
                self._draw(reader, visual)
        for deformable in spec.deformables:
            if reader.is_shown(deformable):
                entity = self._number_entity(self._world, deformable.name or deformable.stream)
                try:
                    texture = reader.read_texture(deformable.material)
                    bending = DrawnDeformable(entity, deformable, reader.read_arrays(deformable), texture)
                except _NOT_DRAWN as error:
                    self._failed.append(f"{entity} ({error})")
                    continue
                self.deformables[deformable.stream] = bending
                self._rec.log(entity, *bending.build_components(), strict=True)

    def _update(self, spec: SceneSpec, reader: SceneReader) -> None:
        """Draw the visuals that differ from the picture. Deformables do not: patches concern visuals."""
        for gone in sorted(self._visuals.keys() - {visual.id for visual in spec.visuals}):
            self._clear(gone)
        for visual in spec.visuals:
            old = self._visuals.get(visual.id)
            if old is not None and old.visual != visual:
                self._redraw(reader, old, visual)
            elif old is None and reader.is_shown(visual):
                self._draw(reader, visual)

    def _draw(self, reader: SceneReader, visual: Visual) -> None:
        assert self._source is not None
        frame, T_frame_visual = reader.place_visual(visual)
        entity = self._number_entity(self._find_parent(visual.body, frame), self._shorten(visual))
        try:
            form = reader.read_shape(visual)
        except _NOT_DRAWN as error:
            self._failed.append(f"{entity} ({error})")
            return
        self._visuals[visual.id] = _Drawn(visual, entity, form.kind, form.tint, shown=True)
        self._rec.log(
            entity,
            *build_components(form, scene_geometry.to_rgba8(visual.rgba, form.tint), T_frame_visual),
            strict=True,
        )

    def _redraw(self, reader: SceneReader, old: _Drawn, visual: Visual) -> None:
        """Log the changes of a visual, without its mesh unless that changed."""
        was = old.visual
        alike = msgspec.structs.replace(was, rgba=visual.rgba, group=visual.group, T_body_visual=visual.T_body_visual)
        if alike != visual:
            self._clear(visual.id)
            if reader.is_shown(visual):
                self._draw(reader, visual)
            return
        shown = reader.is_shown(visual)
        parts: list[Any] = []
        if visual.rgba != was.rgba:
            parts.append(build_colour(old.kind, scene_geometry.to_rgba8(visual.rgba, old.tint)))
        if shown != old.shown or visual.T_body_visual != was.T_body_visual:
            size = visual.geometry.size[2]
            parts.append(build_pose(old.kind, size, reader.place_visual(visual)[1], shown=shown))
        self._visuals[visual.id] = old._replace(visual=visual, shown=shown)
        if parts:
            self._rec.log(old.entity, *parts, strict=True)

    def _clear(self, visual: int) -> None:
        self._rec.log(self._visuals.pop(visual).entity, rr.Clear(recursive=False), strict=True)

    @property
    def _world(self) -> str:
        return f"{self._folder}/{scene_geometry.WORLD}"

    def _find_parent(self, body: int, frame: str) -> str:
        """Return the entity below which the geometry of a body is. `frame`: the body that moves it, or the world."""
        assert self._source is not None
        name = next((info.name for info in self._source.bodies if info.id == body), "")
        if frame == scene_geometry.WORLD:
            return self.find_entity(name) if name else self._world
        parent = self.find_entity(frame)
        return parent if name in ("", frame) else f"{parent}/{escape_entity_part(name)}"

    def _shorten(self, visual: Visual) -> str:
        """Return the name of a visual without that of its robot."""
        robot = self._robots.get(visual.body, "")
        return (visual.name.removeprefix(f"{robot}/") if robot else visual.name) or f"visual_{visual.id}"

    def _number_entity(self, parent: str, name: str) -> str:
        """Return a unique entity for an element of the scene."""
        entity = f"{parent}/{escape_entity_part(name)}"
        self._names[entity] += 1
        return entity if self._names[entity] == 1 else self._number_entity(parent, f"{name} ({self._names[entity]})")


class MotionRows:
    """Poses of bodies and devices in the world that are not written yet, each at an entity of its own.

    Rerun's dataframes have one row per entity and time, and a chunk of few rows is mostly its schema: so rows are
    collected and written together, a chunk per entity.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._rec = recording
        self._indices: dict[str, int] = {}
        self._parts: list[tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.float64]]] = []

    def add(
        self,
        entities: Sequence[str],
        which: NDArray[np.intp],
        times: NDArray[np.int64],
        poses: NDArray[np.float64],
    ) -> None:
        """Collect rows.

        Args:
            entities: Entities that the rows are of, each once.
            which: Index of the entity of each row, shape (n,).
            times: See `to_time_columns`, one column per row.
            poses: `x y z qw qx qy qz` ([m], unit quaternion), world frame, shape (n, 7).
        """
        if not len(which):
            return
        indices = np.array([self._indices.setdefault(entity, len(self._indices)) for entity in entities], np.intp)
        self._parts.append((indices[which], times, poses))

    def write(self) -> None:
        """Write what was collected."""
        if not self._parts:
            return
        which = np.concatenate([part[0] for part in self._parts])
        order = np.argsort(which, kind="stable")
        times = np.concatenate([part[1] for part in self._parts], axis=1)[:, order]
        poses = np.concatenate([part[2] for part in self._parts])[order].astype(np.float32)
        ends = np.cumsum(np.bincount(which, minlength=len(self._indices))).tolist()
        for entity, begin, end in zip(self._indices, [0, *ends], ends, strict=False):
            if begin < end:
                rows = poses[begin:end]
                columns = rr.Transform3D.columns(translation=rows[:, :3], quaternion=rows[:, [4, 5, 6, 3]])
                times_of = to_time_columns(times[:, begin:end])
                rr.send_columns(entity, times_of, [*columns], recording=self._rec, strict=True)
        self._indices.clear()
        self._parts.clear()


def build_components(form: VisualShape, rgba: scene_geometry.Rgba8, T_frame_visual: PoseTuple) -> list[Any]:
    """Return the Rerun components of one visual: its pose at its entity, and its shape."""
    drawn: Any
    solid = rr.components.FillMode.Solid
    radius, _, half = form.size
    if form.kind == scene_geometry.BOX:
        drawn = rr.Boxes3D(half_sizes=[form.size], colors=[rgba], fill_mode=solid)
    elif form.kind == scene_geometry.ELLIPSOID:
        drawn = rr.Ellipsoids3D(half_sizes=[form.size], colors=[rgba], fill_mode=solid)
    elif form.kind == scene_geometry.CYLINDER:
        drawn = rr.Cylinders3D(lengths=[2.0 * half], radii=[radius], colors=[rgba], fill_mode=solid)
    elif form.kind == scene_geometry.CAPSULE:
        drawn = rr.Capsules3D(lengths=[2.0 * half], radii=[radius], colors=[rgba], fill_mode=solid)
    else:
        assert form.mesh is not None
        drawn = rr.Mesh3D(
            vertex_positions=form.mesh.position,
            vertex_normals=form.mesh.normal,
            triangle_indices=form.mesh.index,
            vertex_texcoords=form.uv,
            vertex_colors=form.mesh.color,
            albedo_texture=form.texture,
            albedo_factor=rgba,
        )
    return [build_pose(form.kind, half, T_frame_visual), drawn]


def build_pose(kind: str, half: float, T_frame_visual: PoseTuple, *, shown: bool = True) -> Any:
    """Return the pose of a visual in its frame. A hidden one has scale 0, so its mesh need not be written again."""
    p, (w, x, y, z) = T_frame_visual
    if kind == scene_geometry.CAPSULE:
        # Rerun's capsule begins at the origin and ours is centred there: shift it by half a length along its axis.
        axis = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
        p = (p[0] - half * axis[0], p[1] - half * axis[1], p[2] - half * axis[2])
    scales = None if shown else [(0.0, 0.0, 0.0)]
    return rr.InstancePoses3D(translations=[p], quaternions=[rr.Quaternion(xyzw=[x, y, z, w])], scales=scales)


def build_colour(kind: str, rgba: scene_geometry.Rgba8) -> Any:
    """Return the component of the colour alone."""
    if kind == scene_geometry.MESH:
        return rr.Mesh3D.from_fields(albedo_factor=rgba)
    primitives: dict[str, Any] = {
        scene_geometry.BOX: rr.Boxes3D,
        scene_geometry.ELLIPSOID: rr.Ellipsoids3D,
        scene_geometry.CYLINDER: rr.Cylinders3D,
        scene_geometry.CAPSULE: rr.Capsules3D,
    }
    return primitives[kind].from_fields(colors=[rgba])


@lru_cache(maxsize=MAX_ESCAPED)
def escape_entity_part(name: str) -> str:
    """Escape `name` as one part of an entity path (names may hold slashes and spaces)."""
    return str(rr.escape_entity_path_part(name))
