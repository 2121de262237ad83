"""Participants and anchors in the viewer: heads and hands at the poses that the session had of them, names at robots,
and the anchors that headsets are aligned to.

A device is drawn at an entity of its own, which `MotionRows` moves. It appears with its first pose, and is cleared when
its participant leaves or no pose came for `STALE_NS`. Nothing is static, as Rerun shows static data at all times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import rerun as rr

from iris_session.journal.messages import StateFrame
from iris_session.protocol.common import Pose
from iris_session.protocol.names import Device
from iris_session.protocol.server_messages import PresenceItem
from iris_session.rrd import paths
from iris_session.viewer.narration import FREE, EventNarration, Rgb, find_colour
from iris_session.viewer.scene_layer import escape_entity_part
from iris_session.viewer.timelines import Moment, log_at

#: A device without a pose for so long is not drawn: it is not tracked any more [ns].
STALE_NS: Final = 250_000_000
#: Half extents of a head and of a hand, and length of the arrow in the direction of view [m]. Heads look along x.
HEAD_HALF_M: Final = (0.06, 0.09, 0.05)
HAND_HALF_M: Final = (0.05, 0.03, 0.03)
VIEW_M: Final = 0.3
#: Length of the axes of an anchor [m], and the colours of its label and error.
AXES_M: Final = 0.1
LABEL_COLOUR: Final = (255, 150, 150)
ERROR_COLOUR: Final = (220, 60, 60, 120)

_Key = tuple[str, str]  # participant, device


class DeviceRow(NamedTuple):
    """Pose of a device at a state. `state`: its index. `pose`: `x y z qw qx qy qz`."""

    state: int
    entity: str
    pose: tuple[float, ...]


class Base(NamedTuple):
    """Base of a robot, where its label is. `position`: at `entity` [m]."""

    entity: str
    position: tuple[float, float, float]


class _Shown(NamedTuple):
    """A device as it is in the picture. `label`: text at it."""

    item: PresenceItem
    seen_ns: int
    label: str


class ParticipantLayer:
    """Devices of participants in one file. `is_first`: the file is no later part, whose robots may have holders."""

    def __init__(self, recording: rr.RecordingStream, narration: EventNarration, *, is_first: bool) -> None:
        self._rec = recording
        self._is_first = is_first
        self._narration = narration
        self._shown: dict[_Key, _Shown] = {}
        self._bases: dict[str, Base] = {}

    def label_robots(self, bases: Mapping[str, Base], moment: Moment) -> None:
        """Label all robots by their names, without holders. Others have no label any more."""
        if self._bases:
            log_at(self._rec, moment, paths.ROBOTS, rr.Clear(recursive=True))
        self._bases = dict(bases)
        for robot in bases if self._is_first else ():
            self.label_robot(robot, "", FREE, moment)

    def label_robot(self, robot: str, holder: str, colour: Rgb, moment: Moment) -> None:
        """Label a robot by its name and that of its holder."""
        base = self._bases.get(robot)
        if base is None:
            return
        label = f"{robot}: {holder}" if holder else robot
        point = rr.Points3D([base.position], colors=[colour], radii=[0.01], labels=[label], show_labels=True)
        log_at(self._rec, moment, base.entity, point)

    def draw(self, states: Sequence[StateFrame], moments: Sequence[Moment]) -> list[DeviceRow]:
        """Draw devices that appear in `states`, clear those that are stale, and return the poses that are new."""
        rows: list[DeviceRow] = []
        for i, (state, moment) in enumerate(zip(states, moments, strict=True)):
            for item in state.presence:
                key = (item.participant, item.device)
                shown = self._shown.get(key)
                if shown is not None and shown.item == item:
                    continue
                label = self._label(key)
                if shown is None or shown.label != label:
                    self._draw_device(key, label, moment)
                self._shown[key] = _Shown(item, state.session_time, label)
                rows.append(DeviceRow(i, get_device_entity(*key), (*item.pose.p, *item.pose.q)))
            for key in [key for key, shown in self._shown.items() if state.session_time - shown.seen_ns > STALE_NS]:
                self._clear(key, moment)
        return rows

    def remove(self, participant: str, moment: Moment) -> None:
        """Clear everything of a participant who has left."""
        for key in [key for key in self._shown if key[0] == participant]:
            self._clear(key, moment)

    def _label(self, key: _Key) -> str:
        if key[1] != Device.HEAD:
            return ""
        person = self._narration.find_person(key[0])
        return f"{person.name} · {person.role}" if person.role else person.name

    def _draw_device(self, key: _Key, label: str, moment: Moment) -> None:
        """Draw a box for a head, with an arrow in the direction of view, and a ball for a hand."""
        colours = [find_colour(key[0])]
        solid = rr.components.FillMode.Solid
        entity = get_device_entity(*key)
        if key[1] == Device.HEAD:
            box: Any = rr.Boxes3D(
                half_sizes=[HEAD_HALF_M], colors=colours, labels=[label], show_labels=True, fill_mode=solid
            )
            arrow = rr.Arrows3D(vectors=[(VIEW_M, 0.0, 0.0)], colors=colours, radii=[0.008])
            log_at(self._rec, moment, entity, box)
            log_at(self._rec, moment, f"{entity}/view", arrow)
        else:
            ball = rr.Ellipsoids3D(half_sizes=[HAND_HALF_M], colors=colours, fill_mode=solid)
            log_at(self._rec, moment, entity, ball)

    def _clear(self, key: _Key, moment: Moment) -> None:
        del self._shown[key]
        log_at(self._rec, moment, get_device_entity(*key), rr.Clear(recursive=True))


class AnchorLayer:
    """Anchors: axes at `T_world_anchor`, a label, and the stated error of the alignments to them as a ball.

    The error is that of the person whose alignment is worst: 95 % of the positions at the anchor are within it.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._rec = recording
        self._poses: dict[str, Pose] = {}
        self._error_m = 0.0
        self._drawn = False

    def set_anchors(self, poses: Mapping[str, Pose]) -> None:
        """Set the anchors that `draw` will draw."""
        self._poses = dict(poses)

    def draw(self, moment: Moment) -> None:
        """Draw all anchors, once."""
        if not self._drawn:
            self._drawn = True
            for anchor, pose in self._poses.items():
                self._draw_axes(anchor, pose, moment)
                self._draw_error(anchor, moment)

    def move(self, anchor: str, pose: Pose, moment: Moment) -> None:
        """Move an anchor."""
        self._poses[anchor] = pose
        if self._drawn:
            self._draw_axes(anchor, pose, moment)

    def set_error(self, error_m: float, moment: Moment) -> None:
        """Set the stated error [m], 0 if none is."""
        if error_m != self._error_m:
            self._error_m = error_m
            for anchor in self._poses if self._drawn else ():
                self._draw_error(anchor, moment)

    def _draw_axes(self, anchor: str, pose: Pose, moment: Moment) -> None:
        w, x, y, z = pose.q
        transform = rr.Transform3D(translation=pose.p, quaternion=rr.Quaternion(xyzw=[x, y, z, w]))
        entity = f"{paths.ANCHORS}/{escape_entity_part(anchor)}"
        log_at(self._rec, moment, entity, transform, rr.TransformAxes3D(AXES_M))

    def _draw_error(self, anchor: str, moment: Moment) -> None:
        label = f"{anchor}: {self._error_m * 1e3:.1f} mm (95 %)" if self._error_m else anchor
        point = rr.Points3D([(0.0, 0.0, 0.0)], colors=[LABEL_COLOUR], radii=[0.003], labels=[label], show_labels=True)
        solid = rr.components.FillMode.Solid
        ball = rr.Ellipsoids3D(half_sizes=[[self._error_m] * 3], colors=[ERROR_COLOUR], fill_mode=solid)
        entity = f"{paths.ANCHORS}/{escape_entity_part(anchor)}"
        log_at(self._rec, moment, f"{entity}/label", point)
        log_at(self._rec, moment, f"{entity}/error", ball)


def get_device_entity(participant: str, device: str) -> str:
    """Return the entity of a device."""
    return "/".join((paths.PRESENCE, *map(escape_entity_part, (participant, *device.split("/")))))
