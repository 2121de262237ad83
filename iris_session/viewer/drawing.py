"""Drawing of a session for Rerun's viewer: scene, motion, participants, deformables, media, arrangement of views.

Moving bodies and devices of participants have an entity each, with a transform per change and geometry below it. No two
rows of an entity have one time, so that Rerun's dataframes have them all. Nothing here is needed to verify a recording.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
import rerun as rr
from numpy.typing import NDArray

from iris_session.journal.messages import RobotLabels, SceneAssets, SceneModel, StateFrame, VertexFrame
from iris_session.journal.rows import SessionHeader
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.server_messages import BodyInfo
from iris_session.protocol.specs import RobotSpec
from iris_session.rrd import paths
from iris_session.rrd.stream import list_column
from iris_session.streams.errors import StreamError
from iris_session.viewer.blueprint import build_blueprint, place_eye
from iris_session.viewer.event_layer import EventLayer
from iris_session.viewer.media import MediaDrawer
from iris_session.viewer.narration import EventNarration
from iris_session.viewer.participant_layer import AnchorLayer, Base, ParticipantLayer
from iris_session.viewer.plots import RobotPlots, get_robot_entity
from iris_session.viewer.scene_layer import MotionRows, SceneLayer, SceneSource
from iris_session.viewer.timelines import Moment, MomentTable, to_time_columns

#: Period in which motion and plots are written [ns]: a chunk is mostly its schema, so that every second instead makes a
#: file a sixth larger; a kill of the recorder takes what is not written from the picture.
COLLECT_NS: Final = 4_000_000_000
#: Difference of a pose from the one drawn that is not seen, [m] and in the quaternion: bodies at rest jitter by less.
UNSEEN: Final = np.array([2e-5] * 3 + [5e-5] * 4)
#: Largest simulated time that is shown [s], 285 years: it has 63 bits of nanoseconds, and a user's loop may count it in
#: any unit. The exact one is in `/state`.
LONGEST_S: Final = 9e9


class SessionDrawing:
    """Drawing of one file. `is_first`: the file is no later part, which begins where others end.

    Attributes:
        narration: What events mean.
        events: Log, lanes and metrics.
        vertices_refused: Number of vertex frames that are not drawn.
        media_refused: Number of frames of point clouds and pictures that do not decode.
    """

    def __init__(self, recording: rr.RecordingStream, moments: MomentTable, *, is_first: bool) -> None:
        self._rec = recording
        self._moments = moments
        self._scene = SceneLayer(recording, is_first=is_first)
        self._motion = MotionRows(recording)
        self._plots = RobotPlots(recording)
        self._media = MediaDrawer(recording)
        self._anchors = AnchorLayer(recording)
        self.narration = EventNarration(is_first=is_first)
        self._participants = ParticipantLayer(recording, self.narration, is_first=is_first)
        self.events = EventLayer(recording, moments, self.narration, self._participants, self._anchors)
        self.vertices_refused = self.media_refused = 0
        self._last_step = -2  # newest step with a state of the previous scene; the initial state has step -1
        self._bodies: tuple[BodyInfo, ...] = ()
        self._moving: NDArray[np.intp] = np.empty(0, np.intp)
        self._robots: Sequence[RobotSpec | RobotLabels] = ()
        self._drawn_poses: NDArray[np.float64] | None = None
        self._collected_due_ns = 0
        self._eye: Any = None
        self._has_views = False  # the arrangement of views fits the scene

    def begin(self, header: SessionHeader) -> None:
        """Set the scene, robots and anchors of the session; they are drawn with the first state."""
        self._rec.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True, strict=True)
        self._set_bodies(header.bodies)
        self._robots = header.robots
        self._media.origin_utc_ns = header.origin_utc_ns
        self._anchors.set_anchors(header.anchors)
        self._scene.set_scene(SceneSource(header.model, header.bodies, robots=header.robots))

    def change_scene(self, scenes: Sequence[SceneModel], assets: Sequence[SceneAssets]) -> None:
        """Draw scenes that were loaded, or patches of the present one."""
        if assets and assets[-1].robots != self._plots.robots:
            self._write_collected()
            self._plots.set_robots(assets[-1].robots)
            self._has_views = False
        for loaded in scenes:
            self._set_bodies(loaded.bodies)
            self._last_step = loaded.step if loaded.session_time else self._last_step
            self._robots = assets[-1].robots if assets else ()
            source = SceneSource(loaded.model, loaded.bodies, assets[-1] if assets else SceneAssets(), self._robots)
            self._scene.replace_scene(source, self._moments.find(loaded.step, loaded.session_time))
        for patch in () if scenes else assets:
            self._scene.patch_scene(patch, self._moments.find(patch.step, patch.session_time))

    def find_moments(self, states: Sequence[StateFrame]) -> list[Moment]:
        """Return the moments of states."""
        # The simulated time is that since the session began, resets included.
        times_s = [max(-LONGEST_S, min(state.sim_before + state.sim_time, LONGEST_S)) for state in states]
        pairs = zip(states, times_s, strict=True)
        return [self._moments.make(state.step, round(sim_s * 1e9), state.session_time) for state, sim_s in pairs]

    def draw_states(self, states: Sequence[StateFrame], poses: NDArray[np.float64], begins_ns: int | None) -> None:
        """Draw states of one scene.

        Args:
            states: The states.
            poses: Their poses, shape (n, n_bodies, 7).
            begins_ns: Session time of the first row of the journal, where the picture begins.
        """
        moments = self.find_moments(states)
        times = np.array(moments, np.int64).T
        seen = self._draw_scene(moments[0], times, begins_ns)
        if not self._has_views:
            if self._eye is None and poses.shape[1] == len(self._bodies):
                self._eye = place_eye(poses[0, self._moving if len(self._moving) else slice(None), :3])
                self._participants.label_robots(self._find_bases(poses[0]), Moment(*seen[:, 0].tolist()))
            self._send_blueprint()
        if poses.shape[1] == len(self._bodies):  # a new recorder also gets pending states of the scene before
            self._collect_motion(states, poses, seen)
        self._moments.known.extend(moments)
        for state in states:
            self.events.add_latencies(state.applied, state.step, state.session_time)
        self._plots.add(states, times)

    def draw_media(self, messages: Sequence[Sequence[bytes]]) -> None:
        """Draw clouds and pictures; a stream of pictures that is new gets a view."""
        views = len(self._media.pictures)
        for message in messages:
            try:
                self._media.draw(message)
            except (StreamError, ProtocolError):
                self.media_refused += 1
        if len(self._media.pictures) > views and self._has_views:
            self._send_blueprint()

    def write(self) -> None:
        """Write lanes, and motion and plots when they are due."""
        self.events.write_lanes()
        if self._moments.known and self._moments.newest.session_ns >= self._collected_due_ns:
            self._collected_due_ns = self._moments.newest.session_ns + COLLECT_NS
            self._write_collected()

    def close(self) -> None:
        """Write the rest. Without a state the scene is drawn nevertheless."""
        self._write_collected()
        self._scene.draw(self._moments.find(-1, 0))
        if not self._has_views:
            self._send_blueprint()

    def _write_collected(self) -> None:
        self._motion.write()
        self._plots.write()
        self.events.write_metrics()

    def _set_bodies(self, bodies: tuple[BodyInfo, ...]) -> None:
        self._bodies = bodies
        self._moving = np.array([i for i, body in enumerate(bodies) if body.moving], np.intp)
        self._drawn_poses = None

    def _draw_scene(self, first: Moment, times: NDArray[np.int64], begins_ns: int | None) -> NDArray[np.int64]:
        """Draw the scene if it is new. Return the times of the states as the picture has them.

        The picture begins with the first row, not with the state after it: the viewer opens at the first moment.
        """
        moment = first
        if begins_ns is not None and not self._moments.known:
            moment = self._moments.make(first.step, first.sim_ns, min(first.session_ns, begins_ns))
        self._anchors.draw(moment)
        if not self._scene.draw(moment):
            return times
        entities = [self._scene.find_entity(body.name) if body.moving else "" for body in self._bodies]
        columns: list[Any] = [list_column("bodies", [entities], pa.string())]
        time_columns = to_time_columns(np.array([moment], np.int64).T)
        rr.send_columns(paths.STATE_ENTITIES, time_columns, columns, recording=self._rec, strict=True)
        seen = times.copy()
        seen[:, 0] = moment
        return seen

    def _find_bases(self, poses: NDArray[np.float64]) -> dict[str, Base]:
        """Return the bases of the robots of the header, in the frame of the world if they do not move."""
        known = {body.name: (body, pose) for body, pose in zip(self._bodies, poses, strict=True)}
        found = {robot.name: known[robot.base_body] for robot in self._robots if robot.base_body in known}
        return {
            name: Base(f"{self._scene.find_entity(body.name)}/label", (0.0, 0.0, 0.0))
            if body.moving
            else Base(get_robot_entity(name), tuple(pose[:3].tolist()))
            for name, (body, pose) in found.items()
        }

    def _collect_motion(
        self, states: Sequence[StateFrame], poses: NDArray[np.float64], times: NDArray[np.int64]
    ) -> None:
        """Collect a row per body that moved visibly, and per device of a participant that has a new pose."""
        moving = poses[:, self._moving]
        drawn = np.full(moving.shape[1:], np.nan) if self._drawn_poses is None else self._drawn_poses
        moved = np.empty(moving.shape[:2], np.bool_)
        for now, rows in zip(moving, moved, strict=True):
            np.logical_not((np.abs(now - drawn) < UNSEEN).all(axis=1), out=rows)
            drawn[rows] = now[rows]
        self._drawn_poses = drawn
        frame, body = np.nonzero(moved)
        entities = [self._scene.find_entity(self._bodies[i].name) for i in self._moving]
        self._motion.add(entities, body, times[:, frame], moving[frame, body])
        devices = self._participants.draw(states, [Moment(*moment) for moment in times.T.tolist()])
        entities = list(dict.fromkeys(row.entity for row in devices))
        which = np.array([entities.index(row.entity) for row in devices], np.intp)
        frame = np.array([row.state for row in devices], np.intp)
        self._motion.add(entities, which, times[:, frame], np.array([row.pose for row in devices], np.float64))

    def draw_vertices(self, frames: Sequence[VertexFrame]) -> None:
        """Draw frames of deformables, after their states. Those of another scene than the drawn one are refused."""
        known = self._moments.known
        times = [moment.session_ns for moment in known]
        rows: dict[str, list[tuple[Moment, Any]]] = {}
        for frame in frames:
            at = bisect_right(times, frame.session_time) - 1
            deformable = self._scene.deformables.get(frame.stream)
            if deformable is None:  # hidden, or reported as not drawn
                continue
            try:
                # The state of a step is later than its row, by the duration of the step, so times cannot be compared.
                late = at < 0 or frame.session_time < self._scene.since_ns or known[at].step <= self._last_step
                vertices = None if late else deformable.decode_frame(frame.frame)
            except StreamError:
                late, vertices = True, None
            self.vertices_refused += late
            if vertices is not None:
                moment = self._moments.make(known[at].step, known[at].sim_ns, frame.session_time)
                rows.setdefault(frame.stream, []).append((moment, vertices))
        for stream, taken in rows.items():
            deformable = self._scene.deformables[stream]
            time_columns = to_time_columns(np.array([moment for moment, _ in taken], np.int64).T)
            columns = [*deformable.build_columns([row for _, row in taken])]
            rr.send_columns(deformable.entity, time_columns, columns, recording=self._rec, strict=True)

    def _send_blueprint(self) -> None:
        self._has_views = True
        self._rec.send_blueprint(build_blueprint(self._eye, self._media.pictures, self._plots.robots))
