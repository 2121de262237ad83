"""The picture of the scene in a recording: static geometry in named frames; with a second scene, geometry in time.

Rerun shows static things at all times, so when another scene is loaded the static ones are emptied and drawn again from
the beginning until that moment.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import rerun as rr

from iris_session.protocol.server_messages import BodyInfo
from iris_session.recording import paths, scene
from iris_session.recording.journal import unpack_model

#: Step, tick, simulated time [ns], session time [ns].
Moment = tuple[int, int, int, int]
BEGINNING: Final[Moment] = (-1, 0, 0, 0)


class ScenePicture:
    """Geometry of the scenes of one file."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._rec = recording
        self._number = 1
        self._shapes: list[scene.Shape] = []

    def begin(self, packed_model: bytes, bodies: Sequence[BodyInfo]) -> None:
        """The scene that the session began with."""
        self._shapes = self._shapes_of(packed_model, bodies)
        for shape in self._shapes:
            self._rec.log(_entity(paths.SCENE, shape), *drawing(shape), static=True, strict=True)

    def change(self, packed_model: bytes, bodies: Sequence[BodyInfo], moment: Moment) -> None:
        """Another scene from `moment` on."""
        if self._number == 1:
            self._rec.set_log_time_enabled(False)
            for shape in self._shapes:
                nothing = rr.InstancePoses3D(translations=[])
                self._rec.log(_entity(paths.SCENE, shape), nothing, static=True, strict=True)
            self._draw(BEGINNING)
        self._at(moment)
        self._rec.log(f"{paths.SCENE}/{self._number}", rr.Clear(recursive=True), strict=True)
        self._rec.reset_time()
        self._number += 1
        self._shapes = self._shapes_of(packed_model, bodies)
        self._draw(moment)

    def _draw(self, moment: Moment) -> None:
        self._at(moment)
        for shape in self._shapes:
            self._rec.log(_entity(f"{paths.SCENE}/{self._number}", shape), *drawing(shape), strict=True)
        self._rec.reset_time()

    def _at(self, moment: Moment) -> None:
        step, tick, sim_ns, session_ns = moment
        self._rec.set_time(paths.STEP, sequence=step)
        self._rec.set_time(paths.TICK, sequence=tick)
        self._rec.set_time(paths.SIM_TIME, duration=np.timedelta64(sim_ns, "ns"))
        self._rec.set_time(paths.SESSION_TIME, duration=np.timedelta64(session_ns, "ns"))

    def _shapes_of(self, packed_model: bytes, bodies: Sequence[BodyInfo]) -> list[scene.Shape]:
        try:
            return scene.shapes(scene.load_model(unpack_model(packed_model)), bodies)
        except (ValueError, zlib.error) as error:
            # The journal is worth more than its picture: go on, and say it where the viewer shows it.
            text = f"the scene is not drawn, MuJoCo does not take the model: {error}"
            self._rec.log(f"{paths.EVENTS}/recorder", rr.TextLog(text, level="ERROR"), static=True, strict=True)
            return []


def _entity(folder: str, shape: scene.Shape) -> str:
    return f"{folder}/{entity_part(shape.body)}/{entity_part(shape.name)}"


def drawing(shape: scene.Shape) -> list[Any]:
    """Rerun components of one geom: its frame, its pose in that frame, and its form."""
    frame = rr.CoordinateFrame(shape.frame)
    w, x, y, z = shape.q
    p = shape.p
    color = shape.rgba
    solid = rr.components.FillMode.Solid
    drawn: Any
    if shape.kind == scene.BOX:
        drawn = rr.Boxes3D(half_sizes=[shape.size], colors=[color], fill_mode=solid)
    elif shape.kind == scene.ELLIPSOID:
        drawn = rr.Ellipsoids3D(half_sizes=[shape.size], colors=[color], fill_mode=solid)
    elif shape.kind == scene.CYLINDER:
        radius, half = shape.size
        drawn = rr.Cylinders3D(lengths=[2.0 * half], radii=[radius], colors=[color], fill_mode=solid)
    elif shape.kind == scene.CAPSULE:
        radius, half = shape.size
        drawn = rr.Capsules3D(lengths=[2.0 * half], radii=[radius], colors=[color], fill_mode=solid)
        # Rerun's capsule begins at the origin and MuJoCo's is centred there: back by half a length along its axis.
        axis = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
        p = (p[0] - half * axis[0], p[1] - half * axis[1], p[2] - half * axis[2])
    else:
        drawn = rr.Mesh3D(
            vertex_positions=shape.vertices,
            vertex_normals=shape.normals,
            triangle_indices=shape.faces,
            albedo_factor=color,
        )
    return [frame, rr.InstancePoses3D(translations=[p], quaternions=[rr.Quaternion(xyzw=[x, y, z, w])]), drawn]


def entity_part(name: str) -> str:
    """`name` as one part of an entity path (names may hold slashes and spaces)."""
    return str(rr.escape_entity_path_part(name))
