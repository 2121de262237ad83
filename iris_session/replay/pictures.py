"""Pictures of a recording: the state of a replayed step, drawn by MuJoCo's own renderer, without a display.

A picture shows the newest step at its time, exactly as MuJoCo draws that state: nothing is interpolated. Patches of the
scene are drawn as far as MuJoCo can: see `_ScenePatches`. Not here: encoding and files (`cli.recording_render`).
"""

from __future__ import annotations

import copy
import importlib
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.common import Pose
from iris_session.protocol.names import Device
from iris_session.protocol.scene import (
    FIRST_SITE_VISUAL,
    AddMaterial,
    AddVisual,
    Material,
    PatchOp,
    RemoveVisual,
    SetVisual,
    Visual,
)
from iris_session.protocol.server_messages import BodyInfo, PresenceItem, SceneChanged
from iris_session.recording import Recording, RecordingError
from iris_session.replay.simulation import Replay
from iris_session.rrd.batches import RowTimes
from iris_session.scene.mujoco_visuals import VIEWER_GROUPS, find_viewer_groups
from iris_session.session.core import SessionCore
from iris_session.viewer.narration import find_colour

Image = NDArray[np.uint8]
#: A picture, depth [m] (float32), or a mask (uint16).
Layer = NDArray[Any]
Floats = NDArray[np.float64]

#: Direction of the default view, from the bodies to the eye: in front and above, as in the Rerun viewer.
EYE: Final = (0.25, -1.75, 0.95)
#: Share of the picture's height and width that the bodies take at most.
FILLED: Final = 0.9
#: The least radius of a body that is shown [m].
MIN_HALF_M: Final = 0.1
#: Moments at which the places of bodies are read for it, and poses in all.
MOMENTS: Final = 500
MOST_POSES: Final = 20_000
#: Geoms besides those of the model: marks of MuJoCo, added visuals, people.
MORE_GEOMS: Final = 10_000
#: Radius of a ball around a head or a hand [m].
PERSON_M: Final = 0.12
#: Presence older than this is not drawn: its device is not tracked any more [ns].
PRESENCE_NS: Final = 250_000_000
#: Number in a mask where there is no body.
NO_BODY: Final = 65_535
#: A group of geoms that MuJoCo does not show by default.
HIDDEN_GROUP: Final = mujoco.mjNGROUP - 1

_KINDS: Final = {"geom": int(mujoco.mjtObj.mjOBJ_GEOM), "site": int(mujoco.mjtObj.mjOBJ_SITE)}
_SHAPES: Final = {
    kind: getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
    for kind in ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
}
_VISOR: Final = (0.10, 0.10, 0.12)
#: Shapes of a head (x forward) and of a hand: half extents [m], offset in the device's frame [m], whether a visor.
_HEAD: Final = (
    ("ellipsoid", (0.085, 0.07, 0.10), (-0.06, 0.0, 0.0), False),
    ("box", (0.035, 0.065, 0.04), (0.01, 0.0, 0.01), True),
)
_HAND: Final = (
    ("ellipsoid", (0.05, 0.04, 0.025), (0.0, 0.0, 0.0), False),
    ("ellipsoid", (0.018, 0.018, 0.06), (0.0, 0.0, -0.03), False),
)


class PictureError(RecordingError):
    """The recording cannot be drawn, or not here."""


class PictureOptions(NamedTuple):
    """Size and content of a picture.

    `camera`: name or number of a camera of the model; empty for a view of all bodies that move. `people`: draw heads
    and hands of participants, in their colours of the Rerun viewer.
    """

    width: int = 1280
    height: int = 720
    camera: str = ""
    people: bool = False


class Timeline:
    """Steps of a recording by session time.

    `begin_ns`, `end_ns`: of the first and last step in the file [ns]. Raises `PictureError` if there is none.
    """

    def __init__(self, recording: Recording) -> None:
        rows = [item for item in recording.outline() if isinstance(item, RowTimes)]
        steps = np.concatenate([row.steps for row in rows]) if rows else np.empty(0, np.int64)
        if not len(steps):
            raise PictureError(f"{recording.files[0]} has no step: there is nothing to draw")
        self._steps, first = np.unique(steps, return_index=True)  # a part repeats steps of the one before
        self._times: NDArray[np.int64] = np.concatenate([row.session_times for row in rows])[first]
        self.begin_ns, self.end_ns = int(self._times[0]), int(self._times[-1])

    def find_step(self, time_ns: int) -> int:
        """Return the newest step at a time."""
        return int(self._steps[max(0, int(np.searchsorted(self._times, time_ns, side="right")) - 1)])

    def get_next_ns(self, step: int) -> int | None:
        """Return the time of the step after `step`, `None` after the last."""
        after = int(np.searchsorted(self._steps, step, side="right"))
        return int(self._times[after]) if after < len(self._times) else None


def list_cameras(recording: Recording) -> tuple[str, ...]:
    """Return the names of the cameras of a recording's first scene; one without a name has its number."""
    return list_model_cameras(Replay(recording).core.world.model)


def list_model_cameras(model: mujoco.MjModel) -> tuple[str, ...]:
    return tuple(model.camera(i).name or str(i) for i in range(model.ncam))


def find_camera(model: mujoco.MjModel, wanted: str) -> mujoco.MjvCamera | None:
    """Return the camera of a model with a name, or the number of one without; None if there is none."""
    names = list_model_cameras(model)
    number = names.index(wanted) if wanted in names else int(wanted) if wanted.isdecimal() else -1
    if not 0 <= number < model.ncam:
        return None
    camera = mujoco.MjvCamera()
    camera.type, camera.fixedcamid = int(mujoco.mjtCamera.mjCAMERA_FIXED), number
    return camera


def require_shapes(model: mujoco.MjModel, recording: Recording) -> None:
    """Raise `PictureError` for the model of a world that MuJoCo cannot draw."""
    if not (model.ngeom or model.nflex or model.nskin):
        raise PictureError(
            f"{recording.files[0]} is of a published world, whose shapes MuJoCo does not have: "
            "`iris-session view` shows it"
        )


def open_gl(width: int, height: int) -> Any:
    """Return a current OpenGL context. On Linux it is EGL, which needs no display, unless `MUJOCO_GL` names another.

    Raises:
        PictureError: There is no OpenGL here.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    backend = wanted if wanted in ("osmesa", "glfw") else "egl"
    name = f"mujoco.{backend}" if sys.platform == "linux" else "mujoco.gl_context"
    try:
        context = importlib.import_module(name).GLContext(width, height)
        context.make_current()
    except (ImportError, AttributeError, RuntimeError, mujoco.FatalError) as error:
        said = " ".join(str(error).split())
        raise PictureError(
            f"no OpenGL here ({said}): install libegl1 and Mesa's driver (Debian: libegl1 libgl1-mesa-dri), or "
            "libosmesa6 with MUJOCO_GL=osmesa"
        ) from error
    return context


class RecordingPictures:
    """Pictures of an open recording, drawn while its session is replayed.

    Args:
        recording: The recording.
        timeline: Its steps.
        options: What is shown.

    Attributes:
        notes: What is not drawn as it was, one line each.
        left_out: First and last step of each range that is missing or damaged.

    Raises:
        PictureError: The recording has no model to draw, or there is no OpenGL here.
    """

    def __init__(self, recording: Recording, timeline: Timeline, options: PictureOptions) -> None:
        self._recording, self._timeline, self._options = recording, timeline, options
        patched = any(isinstance(one.body, SceneChanged) and one.body.cause == "patch" for one in recording.events())
        self._replay = Replay(recording, with_control=patched)  # patches are state of the authority
        self._artist: Renderer | None = None
        self._camera: mujoco.MjvCamera = None
        self._views: dict[tuple[BodyInfo, ...], SceneBounds] = {}
        self._people = _PeopleTrack(recording) if options.people else None
        self._gl: Any = None
        self.notes: list[str] = []

    @property
    def left_out(self) -> list[tuple[int, int]]:
        return self._replay.left_out

    def __enter__(self) -> Self:
        self._gl = open_gl(self._options.width, self._options.height)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._artist is not None:
            self._artist.close()
            self._artist = None
        self._gl.free()

    def draw(self, times_ns: Sequence[int]) -> Iterator[Image]:
        """Yield a picture for each of `times_ns`, ascending session times [ns]: uint8, shape (height, width, 3), RGB.

        A picture may be yielded again; do not change it. Where steps are left out, the last one before them is shown.

        Raises:
            PictureError: The first scene has no such camera, or a scene has nothing to draw.
            ReplayError: A step gives another result here than in the recording.
        """
        if not self._options.camera:
            people = self._options.people
            self._views = _read_reach(self._recording, times_ns[0], times_ns[-1], with_people=people)
        waiting = iter(times_ns)
        time_ns = next(waiting, None)
        image: Image | None = None
        for step in self._replay.steps(self._timeline.find_step(times_ns[0]) - 1):
            while time_ns is not None and image is not None and time_ns < step.session_time:
                yield image  # steps before this one are left out
                time_ns = next(waiting, None)
            next_ns = self._timeline.get_next_ns(step.step)
            is_drawn = False
            while time_ns is not None and (next_ns is None or time_ns < next_ns):
                if image is None or not is_drawn or self._people is not None:
                    image, is_drawn = self._draw_core(self._replay.core, time_ns), True
                yield image
                time_ns = next(waiting, None)
            if time_ns is None:
                return
        if image is None:
            raise PictureError(
                f"{self._recording.files[0]}: no step can be taken again from {times_ns[0] * 1e-9:.2f} s on"
            )
        while time_ns is not None:
            yield image
            time_ns = next(waiting, None)

    def _draw_core(self, core: SessionCore, time_ns: int) -> Image:
        """Return a picture of a core as it is now."""
        people = self._people.advance(time_ns) if self._people is not None else []
        if self._artist is None or self._artist.core_model is not core.world.model:
            self._artist = self._make_artist(core, people)
        return self._artist.draw(core.world.data, self._camera, core.authority.patches, people)

    def _make_artist(self, core: SessionCore, people: Sequence[_AvatarMarker]) -> Renderer:
        model, is_first = core.world.model, self._artist is None
        if self._artist is not None:
            self._artist.close()
        require_shapes(model, self._recording)
        self._camera = self._choose_camera(core, people, is_first=is_first)
        return Renderer(model, self._options.width, self._options.height, self.notes)

    def _choose_camera(self, core: SessionCore, people: Sequence[_AvatarMarker], *, is_first: bool) -> mujoco.MjvCamera:
        camera = self._find_camera(core.world.model, is_required=is_first)
        if camera is None:
            view = self._views.get(core.world.bodies) or SceneBounds(core.world.bodies)
            view.people = view.people or [one.item.pose.p for one in people]  # one moment is mostly between two states
            aspect = self._options.width / self._options.height
            camera = view.make_camera(core.world.model, core.world.data, aspect)
        return camera

    def _find_camera(self, model: mujoco.MjModel, *, is_required: bool) -> mujoco.MjvCamera | None:
        """Return the camera of the options in a model; `None` for the view of all that moves."""
        wanted = self._options.camera
        if not wanted:
            return None
        camera = find_camera(model, wanted)
        if camera is None:
            there_are = ", ".join(map(repr, list_model_cameras(model))) or "none: leave --camera out"
            text = f"there is no camera {wanted!r} in the scene, there are {there_are}"
            if is_required:
                raise PictureError(text)
            self._add_note(f"in a scene that was loaded later {text}: the view of all that moves is drawn")
        return camera

    def _add_note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)


# --- the default view -------------------------------------------------------------------------------------------------


class SceneBounds:
    """Places of the moving bodies of a scene in a span of time.

    `positions`: of the bodies in the world at each moment, shape (n, 3) [m]. Without any: where they are now. `people`:
    positions of heads and hands [m].
    """

    def __init__(self, bodies: Sequence[BodyInfo]) -> None:
        self.rows = [i for i, body in enumerate(bodies) if body.moving]
        self.ids = [bodies[i].id for i in self.rows]
        self.positions: list[Floats] = []
        self.people: list[Sequence[float]] = []

    def make_camera(self, model: mujoco.MjModel, data: Any, aspect: float) -> mujoco.MjvCamera:
        """Return a camera that sees all of it in a picture of that `aspect`, width by height."""
        camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, camera)
        positions = self.positions or [data.xpos[self.ids]]
        radii = np.tile([_measure_radius(model, body) for body in self.ids], len(positions))
        people = np.array(self.people).reshape(-1, 3)
        vertices = data.flexvert_xpos.reshape(-1, 3)
        at = np.vstack([*positions, people, vertices])
        radii = np.concatenate([radii, np.full(len(people), PERSON_M), np.zeros(len(vertices))])
        known = np.isfinite(at).all(axis=1)
        at, radii = at[known], np.maximum(radii[known], MIN_HALF_M)
        if not len(at):
            return camera
        near, far = np.percentile(at, (5.0, 95.0), axis=0)  # bodies may have fallen off, and be far away
        reach = max(2.0 * float(np.linalg.norm(far - near)), 10.0 * MIN_HALF_M)
        at = np.clip(at, near - reach, far + reach)
        centre = (at.min(axis=0) + at.max(axis=0)) / 2.0
        forward = -np.array(EYE) / np.linalg.norm(EYE)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        axes = np.array([right, np.cross(right, forward), forward])
        x, y, depth = axes @ (at - centre).T  # to the right, upward, away
        slope = math.tan(math.radians(model.vis.global_.fovy) / 2.0) * FILLED
        needed = np.maximum((np.abs(x) + radii) / aspect, np.abs(y) + radii) / slope - depth
        camera.lookat, camera.distance = centre, float(needed.max())
        camera.azimuth = math.degrees(math.atan2(forward[1], forward[0]))
        camera.elevation = math.degrees(math.asin(forward[2]))
        camera.orthographic = 0
        return camera


def _measure_radius(model: mujoco.MjModel, body: int) -> float:
    """Return the radius of a ball around the origin of a body that holds its shown geoms [m]."""
    geoms = np.arange(model.body_geomnum[body]) + model.body_geomadr[body]
    geoms = geoms[model.geom_group[geoms] < 3]
    reach = np.linalg.norm(model.geom_pos[geoms], axis=1) + model.geom_rbound[geoms]
    return float(reach.max(initial=0.0))


def _read_reach(
    recording: Recording, begin_ns: int, end_ns: int, *, with_people: bool
) -> dict[tuple[BodyInfo, ...], SceneBounds]:
    """Return the moving bodies of each scene in a span of time, at some moments, as the recorded states have them."""
    found: dict[tuple[BodyInfo, ...], SceneBounds] = {}
    bodies: tuple[BodyInfo, ...] = ()
    due_ns = begin_ns
    for state in recording.states():
        if state.session_time > end_ns:
            break
        if state.bodies is not bodies:  # the same object in all states of a scene
            bodies, due_ns = state.bodies, max(begin_ns, state.session_time)
        if state.session_time >= due_ns and len(state.poses) == len(bodies):  # a file may hold any number
            reach = found.setdefault(bodies, SceneBounds(bodies))
            reach.positions.append(state.poses[reach.rows, :3])
            reach.people += [one.pose.p for one in state.presence if with_people]
            moments = max(1, min(MOMENTS, MOST_POSES // max(1, len(reach.rows))))
            due_ns = state.session_time + (end_ns - begin_ns) // moments
    return found


# --- drawing ----------------------------------------------------------------------------------------------------------


class Renderer:
    """Draws the states of one model into the current OpenGL context.

    Args:
        model: That of the simulation, which is not changed: a copy of it is drawn.
        width, height: Of the largest picture [px].
        notes: What cannot be drawn as it was is added, a line each.
        vary: Changes the copy, for a scene that looks different.
        plain: Draw without shadows, reflections and smooth edges: many times as fast without a graphics card.

    Raises:
        PictureError: Pictures of this size cannot be drawn here.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        width: int,
        height: int,
        notes: list[str],
        vary: Callable[[mujoco.MjModel], None] = lambda model: None,
        *,
        plain: bool = False,
    ) -> None:
        self.core_model = model  # that of the simulation, which must not be changed
        self._notes, self._size = notes, (width, height)
        original = copy.copy(model)
        vary(original)
        self._model = copy.copy(original)
        self._fovy = float(self._model.vis.global_.fovy)
        self._model.vis.global_.offwidth, self._model.vis.global_.offheight = self._size
        self._look = _ScenePatches(original, self._model)
        self._option = mujoco.MjvOption()
        for group in set(VIEWER_GROUPS) - set(find_viewer_groups(model)):
            self._option.geomgroup[group] = 0
        self._scene = mujoco.MjvScene(self._model, MORE_GEOMS + model.ngeom)
        if plain:
            self._model.vis.quality.offsamples = 0
            self._scene.flags[int(mujoco.mjtRndFlag.mjRND_SHADOW)] = 0
            self._scene.flags[int(mujoco.mjtRndFlag.mjRND_REFLECTION)] = 0
        try:
            self._context = mujoco.MjrContext(self._model, int(mujoco.mjtFontScale.mjFONTSCALE_150))
        except mujoco.FatalError as error:
            raise PictureError(f"no picture of {width} x {height} can be drawn here: {error}") from error

    def draw(
        self,
        data: Any,
        camera: mujoco.MjvCamera,
        patches: Sequence[PatchOp] = (),
        people: Sequence[_AvatarMarker] = (),
        *,
        size: tuple[int, int] | None = None,
        fovy: float = 0.0,
    ) -> Image:
        """Return a picture of a state.

        Args:
            data: The state, with all that is derived of it.
            camera: The camera that sees it.
            patches: Those of the scene at this time.
            people: Heads and hands that are drawn too.
            size: Width and height [px]; None: the largest.
            fovy: Vertical field of view of a free camera [deg]; 0: that of the model.

        Returns:
            uint8, shape (height, width, 3), RGB.
        """
        for note in self._look.apply(patches):
            if note not in self._notes:
                self._notes.append(note)
        self._model.vis.global_.fovy = fovy or self._fovy
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, camera, int(mujoco.mjtCatBit.mjCAT_ALL), self._scene
        )
        self._look.decorate(self._scene, data)
        for figure in people:
            figure.draw(self._scene)
        width, height = size or self._size
        area = mujoco.MjrRect(0, 0, width, height)
        image = np.empty((height, width, 3), np.uint8)
        # The framebuffer is that of the OpenGL context: another renderer may have drawn into its own meanwhile.
        mujoco.mjr_setBuffer(int(mujoco.mjtFramebuffer.mjFB_OFFSCREEN), self._context)
        mujoco.mjr_render(area, self._scene, self._context)
        mujoco.mjr_readPixels(image, None, area, self._context)
        return np.ascontiguousarray(image[::-1])  # OpenGL's first row is the lowest

    def measure(self) -> tuple[NDArray[np.float32], NDArray[np.uint16]]:
        """Return depth and bodies of the picture that was drawn last.

        Returns:
            float32, shape (height, width): along the axis of the camera [m], infinite where nothing is. uint16, of the
            same shape: number of the body in the model, 0 for what stands still, `NO_BODY` where nothing of it is.
        """
        width, height = self._size
        area, flags = mujoco.MjrRect(0, 0, width, height), self._scene.flags.copy()
        for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
            self._scene.flags[int(flag)] = 1  # without smooth edges, which would mix numbers and distances
        self._context.readDepthMap = int(mujoco.mjtDepthMap.mjDEPTH_ZEROFAR)
        codes, buffer = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.float32)
        mujoco.mjr_setBuffer(int(mujoco.mjtFramebuffer.mjFB_OFFSCREEN), self._context)
        mujoco.mjr_render(area, self._scene, self._context)
        mujoco.mjr_readPixels(codes, buffer, area, self._context)
        self._scene.flags[:] = flags
        extent, limits = self._model.stat.extent, self._model.vis.map
        near, far, value = limits.znear * extent, limits.zfar * extent, buffer[::-1].astype(np.float64)
        # The buffer is 1 at the near plane, 0 at the far one, linear in 1 / depth.
        depth = np.where(value > 0.0, near * far / (near + value * (far - near)), np.inf).astype(np.float32)
        bodies = np.full(self._scene.ngeom + 1, NO_BODY, np.uint16)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.segid >= 0:
                bodies[geom.segid + 1] = self._model.geom_bodyid[geom.objid]
        numbers = codes[::-1].astype(np.int64) @ (1, 256, 65536)
        return depth, bodies[numbers]

    def close(self) -> None:
        """Release what the model holds in the context."""
        self._context.free()


class _ScenePatches:
    """Patches of a scene, as changes of a model that is only drawn, and as geoms that are added to each picture.

    Patches are made for clients. MuJoCo lacks meshes and textures that they bring along: such visuals are left out.
    """

    def __init__(self, original: mujoco.MjModel, drawn: mujoco.MjModel) -> None:
        self._original, self._drawn = original, drawn
        self._patches: tuple[PatchOp, ...] = ()
        self._moved: dict[tuple[int, int], Pose] = {}  # by kind and number
        self._added: list[tuple[Visual, Material | None]] = []

    def apply(self, patches: Sequence[PatchOp]) -> list[str]:
        """Make the patches those of the next pictures. Return what cannot be drawn, a line each."""
        if patches is self._patches:
            return []
        self._patches = tuple(patches)
        drawn, original = self._drawn, self._original
        for kind, field in product(_KINDS, ("rgba", "group", "matid")):
            getattr(drawn, f"{kind}_{field}")[:] = getattr(original, f"{kind}_{field}")
        self._moved, self._added, notes = {}, [], []
        materials: list[Material] = []
        for op in patches:
            if isinstance(op, AddMaterial):
                materials.append(op.material)
            elif isinstance(op, AddVisual):
                visual = op.visual
                if visual.geometry.kind not in _SHAPES or visual.geometry.mesh >= original.nmesh:
                    notes.append("shapes that a patch brought along are not drawn: `iris-session view` shows them")
                    continue
                new = visual.material - original.nmat
                self._added.append((visual, materials[new] if 0 <= new < len(materials) else None))
            elif isinstance(op, RemoveVisual) and (found := self._find(op.visual)):
                getattr(drawn, f"{found[0]}_group")[found[1]] = HIDDEN_GROUP
            elif isinstance(op, SetVisual) and (found := self._find(op.visual)):
                self._set(op, *found)
        return notes

    def _find(self, visual: int) -> tuple[str, int] | None:
        """Return whether a visual is a geom or a site of the model, and its number; `None` for decoration."""
        if visual < self._original.ngeom:
            return "geom", visual
        site = visual - FIRST_SITE_VISUAL
        return ("site", site) if 0 <= site < self._original.nsite else None

    def _set(self, op: SetVisual, kind: str, index: int) -> None:
        drawn = self._drawn
        if op.rgba is not None:
            getattr(drawn, f"{kind}_rgba")[index] = op.rgba
        if op.group is not None:
            getattr(drawn, f"{kind}_group")[index] = min(max(op.group, 0), HIDDEN_GROUP)
        if op.material is not None:
            getattr(drawn, f"{kind}_matid")[index] = op.material if op.material < drawn.nmat else -1
        if op.T_body_visual is not None:
            self._moved[_KINDS[kind], index] = op.T_body_visual

    def decorate(self, scene: mujoco.MjvScene, data: Any) -> None:
        """Move and add geoms of a scene that shows `data`."""
        for geom in scene.geoms[: scene.ngeom] if self._moved else ():
            if (pose := self._moved.get((geom.objtype, geom.objid))) is not None:
                bodies = self._original.geom_bodyid if geom.objtype == _KINDS["geom"] else self._original.site_bodyid
                p_world, R_world = _to_world(data, int(bodies[geom.objid]), pose)
                geom.pos[:], geom.mat[:] = p_world, R_world.reshape(3, 3)
        for visual, material in self._added:
            if visual.body >= self._original.nbody or not 0 <= visual.group < 3 or visual.rgba[3] == 0.0:
                continue
            p_world, R_world = _to_world(data, visual.body, visual.T_body_visual)
            geom = _add_geom(scene, visual.geometry.kind, visual.geometry.size, p_world, R_world, visual.rgba)
            if visual.geometry.mesh >= 0:
                geom.dataid = 2 * visual.geometry.mesh  # of a mesh, odd numbers are hulls
            if material is not None:
                geom.emission, geom.specular = material.emission, material.specular
                geom.shininess, geom.reflectance = material.shininess, material.reflectance


def _to_world(data: Any, body: int, pose: Pose) -> tuple[Floats, Floats]:
    """Return position [m] and rotation (9,) in the world of a pose in the frame of a body."""
    p_world: Floats = np.empty(3)
    R_world: Floats = np.empty(9)
    mujoco.mj_local2Global(data, p_world, R_world, np.array(pose.p), np.array(pose.q), body, 0)
    return p_world, R_world


def _add_geom(
    scene: mujoco.MjvScene, kind: str, size: Sequence[float], p: Floats, rotation: Floats, rgba: Sequence[float]
) -> Any:
    """Add a geom to a scene, and return it."""
    if scene.ngeom >= scene.maxgeom:
        raise PictureError(f"a scene of more than {scene.maxgeom} shapes")
    geom: Any = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, _SHAPES[kind], np.array(size), p, rotation.reshape(9), np.array(rgba, np.float32))
    scene.ngeom += 1
    return geom


class _AvatarMarker(NamedTuple):
    """Head or hand of a participant. `colour`: RGB, 0..1."""

    item: PresenceItem
    colour: tuple[float, ...]

    def draw(self, scene: mujoco.MjvScene) -> None:
        """Add it to a scene."""
        rotation: Floats = np.empty(9)
        mujoco.mju_quat2Mat(rotation, np.array(self.item.pose.q))
        matrix = rotation.reshape(3, 3)
        for kind, size, offset, is_visor in _HEAD if self.item.device == Device.HEAD else _HAND:
            p_world = np.array(self.item.pose.p) + matrix @ np.array(offset)
            _add_geom(scene, kind, size, p_world, matrix, (*(_VISOR if is_visor else self.colour), 1.0))


class _PeopleTrack:
    """The newest pose of every head and hand, at ascending times."""

    def __init__(self, recording: Recording) -> None:
        self._states = recording.states()
        self._ahead = next(self._states, None)
        self._newest: dict[tuple[str, str], PresenceItem] = {}

    def advance(self, time_ns: int) -> list[_AvatarMarker]:
        """Return the heads and hands at `time_ns`."""
        while self._ahead is not None and self._ahead.session_time <= time_ns:
            self._newest.update({(item.participant, item.device): item for item in self._ahead.presence})
            self._ahead = next(self._states, None)
        shown = [item for item in self._newest.values() if item.capture_ns > time_ns - PRESENCE_NS]
        return [_AvatarMarker(one, tuple(c / 255.0 for c in find_colour(one.participant))) for one in shown]
