"""Write one part of a recording into a Rerun file: journal and raw data exactly, and a picture of the session.

Moving bodies and devices of participants have an entity each, with a transform per change and geometry below it. No two
rows of an entity have one time, so that Rerun's dataframes have them all. Exact float64 poses, raw samples and the
journal are plain columns beside the picture. `describe_...` make the texts that the viewer shows.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
import rerun as rr
from numpy.typing import NDArray

from iris_session.protocol.common import Applied
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.server_messages import (
    AlignmentChanged,
    AnchorMoved,
    BodyInfo,
    Event,
    ParticipantChanged,
    ParticipantJoined,
    ParticipantLeft,
    SamplesRejected,
    SceneChanged,
)
from iris_session.protocol.specs import RobotSpec
from iris_session.recording import paths
from iris_session.recording.asset_queue import AssetQueue, AssetRows
from iris_session.recording.blueprint import build_blueprint, place_eye
from iris_session.recording.errors import WriteError
from iris_session.recording.footer import INDEX_BYTES
from iris_session.recording.journal import CLOSED, SessionHeader, blob_root, seal_blob
from iris_session.recording.media import MediaDrawer
from iris_session.recording.messages import (
    ABRUPT,
    Batch,
    DenialRecord,
    EndMark,
    HeaderCopy,
    HoldRecord,
    MetricRecord,
    RobotLabels,
    SceneAssets,
    SceneModel,
    StateFrame,
    VertexFrame,
    encode_header,
    encode_header_copy,
    encode_scene,
)
from iris_session.recording.people import AnchorPicture, Base, PeoplePicture
from iris_session.recording.picture import MotionRows, ScenePicture, SceneSource, escape_entity_part
from iris_session.recording.plots import (
    ALIGNMENT,
    INPUT_TO_STEP,
    REJECTED,
    STATE_AGE,
    MetricPlots,
    RobotPlots,
    get_robot_entity,
)
from iris_session.recording.rrd_stream import (
    RrdStream,
    bytes_column,
    duration_index,
    list_column,
    matrix_column,
    scalar_column,
    sequence_index,
    text_list_column,
)
from iris_session.recording.story import FREE, WARN, LaneChange, LogLine, Rgb, SessionStory, StatedErrors
from iris_session.recording.timelines import Moment, UniqueTimes, get_session_time, to_time_columns
from iris_session.streams.errors import StreamError

#: Chunks of the picture per second, each mostly its schema, and the shortest and longest time between two of an entity
#: [ns]. Until then a kill of the recorder takes the newest plots and motion; motion is made anew (`lost_motion.py`).
CHUNKS_PER_S: Final = 8
MIN_PERIOD_NS: Final = 1_000_000_000
MAX_PERIOD_NS: Final = 8_000_000_000
#: Difference of a pose from the one drawn that is not seen, [m] and in the quaternion: bodies at rest jitter by less.
UNSEEN: Final = np.array([2e-5] * 3 + [5e-5] * 4)
#: Number of newest states whose times are kept for vertices that arrive later: 4 s at 60 Hz.
KNOWN_MOMENTS = 256
#: Maximum number of lanes whose colours are known to be in the file: participants that come and go have one each.
MAX_LANES = 4096
#: Maximum number of pending vertex frames whose states are not in the file yet.
MAX_PENDING_VERTICES = 256
#: Largest simulated time that is shown [s], 285 years: it has 63 bits of nanoseconds, and a user's loop may count it in
#: any unit. The exact one is in `/state`.
LONGEST_S: Final = 9e9
_encode = msgspec.msgpack.Encoder().encode


class _Told(NamedTuple):
    """An event as the picture tells it, and what is then in force of its participant, if it has one, and of all."""

    line: LogLine
    changes: list[LaneChange]
    participant: str
    errors: StatedErrors | None
    rejected: int
    worst_at_anchor_m: float


#: Events after which the alignment or the rejected samples of a participant may be others.
_PERSONAL: Final = (AlignmentChanged, ParticipantJoined, ParticipantChanged, ParticipantLeft, SamplesRejected)


class RrdWriter:
    """Writer of one file.

    `add`, `add_sample`, `add_vertices` and `add_media` only collect; `flush` writes and returns when the operating
    system has the bytes. `vertices_refused`: number of vertex frames that are not in the picture. `media_refused`:
    number of frames of point clouds and pictures that do not decode. `assets`: what `write_assets` writes.
    """

    def __init__(self, path: str | Path, recording_id: str, assets: AssetQueue | None = None) -> None:
        self.path = str(path)
        self.assets = AssetQueue() if assets is None else assets
        self._stream = RrdStream(self.path, paths.APPLICATION, recording_id)
        self._rec = self._stream.recording
        is_first = paths.split_part(self.path)[1] == 1
        self._picture = ScenePicture(self._rec, is_first=is_first)
        self._motion = MotionRows(self._rec)
        self._times = UniqueTimes()
        self._pending = Batch()
        self._samples: list[tuple[int, int, bytes]] = []
        self._reports: list[tuple[str, int, float]] = []
        self._vertices: deque[VertexFrame] = deque()
        self.vertices_refused = 0
        self._media: list[Sequence[bytes]] = []
        self._drawer = MediaDrawer(self._rec)
        self.media_refused = 0
        self._known: deque[Moment] = deque(maxlen=KNOWN_MOMENTS)  # of the newest states
        self._last_step = -2  # newest step with a state of the previous scene; the initial state has step -1
        self._bodies: tuple[BodyInfo, ...] = ()
        self._moving: NDArray[np.intp] = np.empty(0, np.intp)
        self._frames: list[str] = []
        self._robots: Sequence[RobotSpec | RobotLabels] = ()
        self._shown_poses: NDArray[np.float64] | None = None
        self._pose_type: type[np.floating[Any]] = np.float64
        self._newest_row = (-1, b"")
        self._begins_ns: int | None = None  # session time of the first row
        self._newest_ns = 0
        self._origin_utc_ns = 0
        self._header: SessionHeader | None = None
        self._applied: dict[str, Applied] = {}
        self._story = SessionStory(is_first=is_first)
        self._plots = RobotPlots(self._rec)
        self._metrics = MetricPlots(self._rec, self._story)
        self._collected_due_ns = 0
        self._anchors = AnchorPicture(self._rec)
        self._people = PeoplePicture(self._rec, self._story, is_first=is_first)
        self._lanes: dict[str, list[tuple[Moment, LaneChange]]] = {}
        self._lane_colours: dict[str, dict[str, Rgb]] = {}
        self._has_scene = False  # the assets of a scene were given
        self._eye: Any = None
        self._arranged = False

    def write_header(self, header: SessionHeader) -> None:
        """Write the header and the scene. Must be called before the first flush with data."""
        self._rec.send_recording_name(header.session_name)
        blob = encode_header(header)
        copy = encode_header_copy(HeaderCopy(blob_root(blob), msgspec.structs.replace(header, model=b"")))
        for entity, content in ((paths.HEADER, blob), (paths.HEADER_COPY, copy)):
            self._log_static(entity, rr.AnyValues(blob=pa.array([seal_blob(content)], pa.binary())))
        self._header = header
        if header.recording_class == CLOSED:  # the simulation gives the exact poses
            self._pose_type = np.float32
        self._log_static(paths.INFO, rr.TextDocument(describe_session(header), media_type="text/markdown"))
        self._set_bodies(header.bodies)
        self._robots = header.robots
        self._log_static("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._origin_utc_ns = self._drawer.origin_utc_ns = header.origin_utc_ns
        self._anchors.set_anchors(header.anchors)
        self._picture.set_scene(SceneSource(header.model, header.bodies, robots=header.robots))

    def _set_bodies(self, bodies: tuple[BodyInfo, ...]) -> None:
        self._bodies = bodies
        self._moving = np.array([i for i, body in enumerate(bodies) if body.moving], np.intp)
        self._frames = [bodies[i].name for i in self._moving]
        self._shown_poses = None

    def add(self, batch: Batch) -> None:
        """Collect one batch of the authority. States of one flush are of one scene."""
        if batch.scenes or batch.assets:
            self.flush()
            self._write_scenes(batch.scenes, batch.assets)
        pending = self._pending
        self._story.add_people(batch.people)
        for name in ("rows", "states", "events", "denials", "metrics", "keyframes", "holds"):
            getattr(pending, name).extend(getattr(batch, name))

    def add_sample(self, connection: int, receive_ns: int, data: bytes) -> None:
        """Collect one raw message of a client, as received."""
        self._samples.append((connection, receive_ns, data))

    def add_report(self, participant: str, receive_ns: int, age_ms: float) -> None:
        """Collect a report of a client: the age [ms] below which 99 % of the states of a second reached it."""
        self._reports.append((participant, receive_ns, age_ms))

    def add_vertices(self, frame: VertexFrame) -> None:
        """Collect a frame of a deformable. If too many are pending, the oldest is dropped."""
        if len(self._vertices) >= MAX_PENDING_VERTICES:
            self._vertices.popleft()
            self.vertices_refused += 1
        self._vertices.append(frame)

    def add_media(self, message: Sequence[bytes]) -> None:
        """Collect a message about a stream of clouds or pictures, as `MediaDrawer.draw` takes it."""
        self._media.append(message)

    def flush(self, timeout_s: float = 10.0) -> None:
        """Write everything collected. Raises `WriteError`; the file is then valid up to an earlier flush."""
        batch, self._pending = self._pending, Batch()
        samples, self._samples = self._samples, []
        reports, self._reports = self._reports, []
        self._write_rows(batch)
        self._write_keyframes(batch)
        told = [self._tell(event) for event in batch.events]  # names and roles are known when people appear
        for _, states in groupby(batch.states, key=lambda state: len(state.poses)):
            self._write_states(list(states))
        self._write_events(batch.events, told)
        self._add_holds(batch.holds)
        self._write_denials(batch.denials)
        self._add_metrics(batch.metrics)
        self._add_reports(reports)
        self._write_lanes()
        if self._known and self._known[-1].session_ns >= self._collected_due_ns:
            self._collected_due_ns = self._known[-1].session_ns + self._write_collected()
        self._write_samples(samples)
        self._write_vertices()
        self._write_media()
        self._write_stream(timeout_s)
        if batch.keyframes:
            self._write_mark()

    def write_assets(self, max_bytes: int, timeout_s: float = 10.0) -> None:
        """Write the next assets, after the first row: no time in the file is before the first picture.

        Raises `WriteError`.
        """
        if self.assets and self._begins_ns is not None:
            self._write_asset_rows(self.assets.read(self._newest_ns, max_bytes), timeout_s)

    def _write_asset_rows(self, rows: AssetRows, timeout_s: float) -> None:
        scenes, pieces, faults = rows
        if scenes:
            columns = [
                scalar_column("scene_step", [one.step for one in scenes], pa.int64()),
                scalar_column("scene_ns", [one.session_time for one in scenes], pa.int64()),
                scalar_column("hash", [one.hash for one in scenes], pa.string()),
                scalar_column("recorded", [one.recorded for one in scenes], pa.string()),
            ]
            self._send_now(paths.ASSET_SCENES, len(scenes), columns)
        if pieces:
            columns = [
                scalar_column("address", [one.address for one in pieces], pa.string()),
                scalar_column("offset", [one.offset for one in pieces], pa.int64()),
                scalar_column("total", [one.total for one in pieces], pa.int64()),
                scalar_column("is_scene", [one.is_scene for one in pieces], pa.bool_()),
                bytes_column("data", [one.data for one in pieces]),
            ]
            self._send_now(paths.ASSETS, len(pieces), columns)
        if faults:
            columns = [
                scalar_column("address", [one.address for one in faults], pa.string()),
                scalar_column("text", [one.text for one in faults], pa.string()),
            ]
            self._send_now(paths.ASSET_FAULTS, len(faults), columns)
        self._write_stream(timeout_s)

    def _write_stream(self, timeout_s: float) -> None:
        try:
            self._stream.write(timeout_s)
        except (RuntimeError, ValueError, OSError) as error:
            raise self._to_error(error) from error

    def _send_now(self, entity: str, n: int, columns: Sequence[Any]) -> None:
        """Write rows at the time of the newest row of the journal."""
        times = self._times.spread(entity, [self._newest_ns] * n)
        self._send_columns(entity, [duration_index(paths.SESSION_TIME, times)], columns)

    def close(
        self, timeout_s: float = 10.0, reason: str = "", samples_left_out: int = 0, *, is_abrupt: bool = False
    ) -> None:
        """Write the rest and the end mark, and close the file.

        For the mark: `reason`, why before the session ends; `samples_left_out`, number of raw messages; `is_abrupt`,
        the session was killed.

        Assets that still wait are noted as missing. Raises `WriteError`.
        """
        self.flush(timeout_s)
        self._write_asset_rows(self.assets.close(reason or "the session ended before it was written"), timeout_s)
        text = reason or (ABRUPT if is_abrupt else "")
        if text:
            self._rec.log(f"{paths.EVENTS}/recorder", rr.TextLog(text, level=WARN), strict=True)
        self._write_collected()
        self._picture.draw(self._find_moment(-1, 0))  # without a state the scene is drawn nevertheless
        if not self._arranged:
            self._send_blueprint()
        self._describe_result()
        self.flush(timeout_s)
        self._write_mark()
        mark = EndMark(*self._newest_row, reason, samples_left_out, is_abrupt)
        self._log_static(paths.END, rr.AnyValues(end=pa.array([_encode(mark)], pa.binary())))
        try:
            self._stream.close(timeout_s)
        except (RuntimeError, ValueError, OSError) as error:
            raise self._to_error(error) from error

    def _describe_result(self) -> None:
        """Say what the session was, in the text and as properties: those of a folder of files are a table."""
        header, story = self._header, self._story
        if header is None:
            return
        duration_s = 0.0 if self._begins_ns is None else (self._newest_ns - self._begins_ns) * 1e-9
        text = describe_session(header, story, duration_s)
        self._log_static(paths.INFO, rr.TextDocument(text, media_type="text/markdown"))
        properties = rr.AnyValues(
            people=list(story.roles) or None,
            robots=[robot.name for robot in header.robots] or None,
            handovers=story.handovers,
            episodes=story.episodes,
            duration_s=duration_s,
            verify_class=header.recording_class,
        )
        self._rec.send_property("session", properties)

    def _to_error(self, error: Exception) -> WriteError:
        said = (isinstance(error, OSError) and error.strerror) or " ".join(str(error).split())
        return WriteError(f"{self.path} cannot be written: {said}")

    @property
    def size(self) -> int:
        """Bytes in the file so far."""
        return self._stream.size

    @property
    def write_s(self) -> float:
        """Time that the system took for the bytes of the last write [s], without that to encode them."""
        return self._stream.write_s

    @property
    def size_with_index(self) -> int:
        """Bytes that the file would have if it was closed now and got its index."""
        return self._stream.size + self._stream.messages * INDEX_BYTES

    def _write_mark(self) -> None:
        times = [sequence_index(paths.STEP, [self._newest_row[0]])]
        self._send_columns(paths.MARKS, times, [bytes_column("mark", [_encode(self._stream.mark())])])

    def _log_static(self, entity: str, *values: Any) -> None:
        self._rec.log(entity, *values, static=True, strict=True)

    def _send_columns(self, entity: str, times: Sequence[Any], columns: Sequence[Any]) -> None:
        rr.send_columns(entity, times, columns, recording=self._rec, strict=True)

    def _write_rows(self, batch: Batch) -> None:
        rows = batch.rows
        if not rows:
            return
        columns = [
            scalar_column("n_ticks", [row.n_ticks for row in rows], pa.int64()),
            bytes_column("entries", [row.entries for row in rows]),
            list_column("entry_lengths", [row.entry_lengths for row in rows], pa.uint32()),
            list_column("entry_crcs", [row.entry_crcs for row in rows], pa.uint32()),
            bytes_column("digest", [row.digest for row in rows]),
            bytes_column("chain", [row.chain for row in rows]),
            list_column("field_crcs", [row.field_crcs for row in rows], pa.uint32()),
        ]
        if any(row.plant for row in rows):
            columns.append(bytes_column("plant", [row.plant for row in rows]))
        times = [
            sequence_index(paths.STEP, [row.step for row in rows]),
            duration_index(paths.SESSION_TIME, [row.now_ns for row in rows]),
        ]
        self._send_columns(paths.ROWS, times, columns)
        self._newest_row = (rows[-1].step, rows[-1].chain)
        self._newest_ns = rows[-1].now_ns
        if self._begins_ns is None:
            self._begins_ns = rows[0].now_ns

    def _write_scenes(self, scenes: list[SceneModel], assets: list[SceneAssets]) -> None:
        """Write models for verification, and change the picture."""
        if scenes:
            times = [sequence_index(paths.STEP, [s.step for s in scenes])]
            self._send_columns(
                paths.MODELS, times, [bytes_column("scene", [seal_blob(encode_scene(s)) for s in scenes])]
            )
        if assets and assets[-1].robots != self._plots.robots:
            self._write_collected()
            self._plots.set_robots(assets[-1].robots)
            self._arranged = False
        for loaded in scenes:
            self._set_bodies(loaded.bodies)
            self._last_step = loaded.step if loaded.session_time else self._last_step
            self._robots = assets[-1].robots if assets else ()
            source = SceneSource(loaded.model, loaded.bodies, assets[-1] if assets else SceneAssets(), self._robots)
            self._picture.replace_scene(source, self._find_moment(loaded.step, loaded.session_time))
        for one in assets:
            self.assets.add_scene(one, is_patch=not scenes and self._has_scene)
            self._has_scene = True
        for patch in () if scenes else assets:
            self._picture.patch_scene(patch, self._find_moment(patch.step, patch.session_time))

    def _write_keyframes(self, batch: Batch) -> None:
        frames = batch.keyframes
        if not frames:
            return
        times = [sequence_index(paths.STEP, [k.step for k in frames])]
        self._send_columns(paths.KEYFRAMES, times, [bytes_column("keyframe", [_encode(k) for k in frames])])

    def _write_states(self, states: list[StateFrame]) -> None:
        if not states:
            return
        poses = np.stack([np.frombuffer(s.poses, np.float64).reshape(-1, 7) for s in states])
        moments = [self._make_moment(s.step, _to_sim_ns(s), s.session_time) for s in states]
        times = np.array(moments, np.int64).T
        seen = self._draw_scene(moments[0], times)
        if not self._arranged:
            if self._eye is None and poses.shape[1] == len(self._bodies):
                self._eye = place_eye(poses[0, self._moving if len(self._moving) else slice(None), :3])
                self._people.label_robots(self._find_bases(poses[0]), Moment(*seen[:, 0].tolist()))
            self._send_blueprint()
        columns = [
            matrix_column("poses", poses.reshape(len(states), -1).astype(self._pose_type)),
            scalar_column("tick", [s.tick for s in states], pa.int64()),
            scalar_column("sim_time_s", [s.sim_time for s in states], pa.float64()),
            bytes_column("presence", [_encode(s.presence) for s in states]),
            bytes_column("applied", [_encode(s.applied) for s in states]),
        ]
        self._send_columns(paths.STATE, to_time_columns(times), columns)
        if poses.shape[1] == len(self._bodies):  # a new recorder also gets pending states of the scene before
            self._write_transforms(states, poses, seen)
        self._known.extend(moments)
        self._note_latencies(states)
        self._plots.add(states, times)

    def _draw_scene(self, first: Moment, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Draw the scene if it is new. Return the times of the states as the picture has them.

        The picture begins with the first row, not with the state after it: the viewer opens at the first moment.
        """
        moment = first
        if self._begins_ns is not None and not self._known:
            moment = self._make_moment(first.step, first.sim_ns, min(first.session_ns, self._begins_ns))
        self._anchors.draw(moment)
        if not self._picture.draw(moment):
            return times
        entities = [self._picture.find_entity(body.name) if body.moving else "" for body in self._bodies]
        self._send_columns(
            paths.STATE_ENTITIES,
            to_time_columns(np.array([moment], np.int64).T),
            [text_list_column("bodies", entities)],
        )
        seen = times.copy()
        seen[:, 0] = moment
        return seen

    def _find_bases(self, poses: NDArray[np.float64]) -> dict[str, Base]:
        """Return the bases of the robots of the header, in the frame of the world if they do not move."""
        known = {body.name: (body, pose) for body, pose in zip(self._bodies, poses, strict=True)}
        found = {robot.name: known[robot.base_body] for robot in self._robots if robot.base_body in known}
        return {
            name: Base(f"{self._picture.find_entity(body.name)}/label", (0.0, 0.0, 0.0))
            if body.moving
            else Base(get_robot_entity(name), tuple(pose[:3].tolist()))
            for name, (body, pose) in found.items()
        }

    def _write_vertices(self) -> None:
        """Write vertices whose states are in the file. Frames of another scene than the drawn one are refused."""
        times = [moment.session_ns for moment in self._known]
        rows: dict[str, list[tuple[Moment, Any]]] = {}
        while self._vertices and times and self._vertices[0].session_time <= times[-1]:
            frame = self._vertices.popleft()
            at = bisect_right(times, frame.session_time) - 1
            bending = self._picture.deformables.get(frame.stream)
            if bending is None:  # hidden, or reported as not drawn
                continue
            try:
                # The state of a step is later than its row, by the duration of the step, so times cannot be compared.
                late = at < 0 or frame.session_time < self._picture.since_ns or self._known[at].step <= self._last_step
                vertices = None if late else bending.decode_frame(frame.frame)
            except StreamError:
                late, vertices = True, None
            self.vertices_refused += late
            if vertices is not None:
                moment = self._make_moment(self._known[at].step, self._known[at].sim_ns, frame.session_time)
                rows.setdefault(frame.stream, []).append((moment, vertices))
        for stream, taken in rows.items():
            bending = self._picture.deformables[stream]
            moments = np.array([moment for moment, _ in taken], np.int64).T
            self._send_columns(
                bending.entity, to_time_columns(moments), [*bending.build_columns([row for _, row in taken])]
            )

    def _send_blueprint(self) -> None:
        self._arranged = True
        self._rec.send_blueprint(build_blueprint(self._eye, self._drawer.pictures, self._plots.robots))

    def _write_media(self) -> None:
        """Draw clouds and pictures; a stream of pictures that is new gets a view."""
        messages, self._media = self._media, []
        views = len(self._drawer.pictures)
        for message in messages:
            try:
                self._drawer.draw(message)
            except (StreamError, ProtocolError):
                self.media_refused += 1
        if len(self._drawer.pictures) > views and self._arranged:
            self._send_blueprint()

    def _note_latencies(self, states: list[StateFrame]) -> None:
        """Collect latencies for the plots: from the capture of a sample to its step, per robot."""
        for state in states:
            for applied in state.applied:
                if self._applied.get(applied.robot) != applied:
                    self._applied[applied.robot] = applied
                    latency_ms = (applied.step_ns - applied.capture_ns) / 1e6
                    moment = self._find_moment(state.step, state.session_time)
                    self._metrics.add(INPUT_TO_STEP, applied.robot, latency_ms, moment)

    def _write_collected(self) -> int:
        """Write motion and plots collected so far. Return the time until they are due again [ns]."""
        n = self._motion.write() + self._plots.write()
        n += self._metrics.write(self._known[-1] if self._known else self._find_moment(0, 0))
        return min(MAX_PERIOD_NS, max(MIN_PERIOD_NS, n * 1_000_000_000 // CHUNKS_PER_S))

    def _write_transforms(self, states: list[StateFrame], poses: NDArray[np.float64], times: NDArray[np.int64]) -> None:
        """Collect a row per body that moved visibly, and per device of a participant that has a new pose."""
        moving = poses[:, self._moving]
        shown = np.full(moving.shape[1:], np.nan) if self._shown_poses is None else self._shown_poses
        moved = np.empty(moving.shape[:2], np.bool_)
        for now, rows in zip(moving, moved, strict=True):
            np.logical_not((np.abs(now - shown) < UNSEEN).all(axis=1), out=rows)
            shown[rows] = now[rows]
        self._shown_poses = shown
        frame, body = np.nonzero(moved)
        values = moving[frame, body]
        entities = [self._picture.find_entity(name) for name in self._frames]
        self._motion.add(entities, body, times[:, frame], values)
        people = self._people.draw(states, [Moment(*moment) for moment in times.T.tolist()])
        entities = list(dict.fromkeys(row.entity for row in people))
        which = np.array([entities.index(row.entity) for row in people], np.intp)
        frame = np.array([row.state for row in people], np.intp)
        self._motion.add(entities, which, times[:, frame], np.array([row.pose for row in people], np.float64))

    def _write_events(self, events: list[Event], told: list[_Told]) -> None:
        if not events:
            return
        changes = []
        for event, one in zip(events, told, strict=True):
            changes += [(event.step, event.session_time, change) for change in one.changes]
            if one.participant:
                self._plot_person(event, one)
                self._anchors.set_error(one.worst_at_anchor_m, self._find_anchor_moment(event))
            if isinstance(event.body, ParticipantLeft) and not event.body.grace:
                self._people.remove(event.body.participant, self._find_moment(event.step, event.session_time))
            elif isinstance(event.body, AnchorMoved):
                self._anchors.move(event.body.anchor_id, event.body.T_world_anchor, self._find_anchor_moment(event))
            elif isinstance(event.body, SceneChanged) and event.body.cause == "new_scene":
                self._people.label_robots({}, self._find_moment(event.step, event.session_time))
        text = rr.TextLog.columns(text=[one.line.text for one in told], level=[one.line.level for one in told])
        columns = [*text, bytes_column("event", [_encode(event) for event in events])]
        times = self._to_times(paths.EVENTS, [e.step for e in events], [e.session_time for e in events])
        self._send_columns(paths.EVENTS, times, columns)
        self._add_lanes(changes)

    def _find_anchor_moment(self, event: Event) -> Moment:
        """Return the moment of an event that may change anchors; no two are equal."""
        moment = self._find_moment(event.step, event.session_time)
        (shown_ns,) = self._times.spread(paths.ANCHORS, [moment.session_ns])
        return self._make_moment(moment.step, moment.sim_ns, shown_ns)

    def _tell(self, event: Event) -> _Told:
        line, changes = self._story.add(event)
        body: Any = event.body
        participant = ""
        if isinstance(body, _PERSONAL):
            participant = body.participant if isinstance(body.participant, str) else body.participant.id
        errors, rejected = self._story.errors.get(participant), self._story.rejected.get(participant, 0)
        worst_m = max((one.at_anchor_m for one in self._story.errors.values()), default=0.0)
        return _Told(line, changes, participant, errors, rejected, worst_m)

    def _plot_person(self, event: Event, told: _Told) -> None:
        """Plot the stated error and the rejected samples of the participant of an event."""
        moment = self._find_moment(event.step, event.session_time)
        if told.errors is not None:
            self._metrics.add(ALIGNMENT, told.participant, told.errors.at_robot_m * 1e3, moment)
        else:
            self._metrics.end(ALIGNMENT, told.participant, moment)
        if told.rejected:
            self._metrics.add(REJECTED, told.participant, told.rejected, moment)
        else:
            self._metrics.end(REJECTED, told.participant, moment)

    def _add_holds(self, holds: list[HoldRecord]) -> None:
        changes = [(h.step, h.session_time, c) for h in holds for c in self._story.add_hold(h.robot, h.reason)]
        self._add_lanes(changes)

    def _add_lanes(self, changes: list[tuple[int, int, LaneChange]]) -> None:
        """Collect changed lanes; label robots by their holders."""
        for step, now_ns, change in changes:
            moment = self._find_moment(step, now_ns)
            entity = "/".join((paths.LANES, *map(escape_entity_part, change.lane)))
            self._lanes.setdefault(entity, []).append((moment, change))
            folder, name, *kind = (*change.lane, "")
            if folder == "robots" and kind[0] == "holder":
                self._people.label_robot(name, change.state, change.colours.get(change.state, FREE), moment)

    def _write_lanes(self) -> None:
        """Write changed lanes, and the colours of their states when those are new."""
        lanes, self._lanes = self._lanes, {}
        for entity, rows in lanes.items():
            colours = {state: colour for _, change in rows for state, colour in change.colours.items()}
            if colours and self._lane_colours.get(entity) != colours:
                if len(self._lane_colours) >= MAX_LANES:
                    self._lane_colours.clear()
                self._lane_colours[entity] = colours
                self._log_static(entity, rr.StateConfiguration(values=[*colours], colors=[*colours.values()]))
            times = self._spread(entity, [moment for moment, _ in rows])
            self._send_columns(entity, times, [*rr.StateChange.columns(state=[change.state for _, change in rows])])

    def _write_denials(self, denials: list[DenialRecord]) -> None:
        if not denials:
            return
        lines = [describe_denial(record) for record in denials]
        text = rr.TextLog.columns(text=[line.text for line in lines], level=[line.level for line in lines])
        columns = [*text, bytes_column("denial", [_encode(record) for record in denials])]
        times = self._to_times(paths.DENIALS, [d.step for d in denials], [d.session_time for d in denials])
        self._send_columns(paths.DENIALS, times, columns)

    def _add_metrics(self, metrics: list[MetricRecord]) -> None:
        for record in metrics:
            kind, _, subject = record.name.partition("/")
            self._metrics.add(kind, subject, record.value, self._find_moment(record.step, record.session_time))

    def _add_reports(self, reports: list[tuple[str, int, float]]) -> None:
        for participant, receive_ns, age_ms in reports:
            step = self._known[-1].step if self._known else 0
            self._metrics.add(STATE_AGE, participant, age_ms, self._find_moment(step, receive_ns))

    def _write_samples(self, samples: list[tuple[int, int, bytes]]) -> None:
        if not samples:
            return
        columns = [
            scalar_column("connection", [s[0] for s in samples], pa.int64()),
            scalar_column("receive_ns", [s[1] for s in samples], pa.int64()),
            bytes_column("data", [s[2] for s in samples]),
        ]
        times = self._times.spread(paths.SAMPLES, [s[1] for s in samples])
        self._send_columns(paths.SAMPLES, [duration_index(paths.SESSION_TIME, times)], columns)

    def _to_times(self, entity: str, steps: list[int], session_times: list[int]) -> list[Any]:
        """Return the times of rows, each of which has the simulated time of the newest state before it."""
        return self._spread(entity, [self._find_moment(*times) for times in zip(steps, session_times, strict=True)])

    def _spread(self, entity: str, moments: Sequence[Moment]) -> list[Any]:
        """Return the times of rows of an entity, no two of which are equal."""
        times = np.array(moments, np.int64).T
        times[2] = self._times.spread(entity, times[2].tolist())
        times[3] = times[2] + self._origin_utc_ns
        return to_time_columns(times)

    def _find_moment(self, step: int, session_ns: int) -> Moment:
        """Return the moment of a step: the simulated time is that of the newest state before it."""
        known = self._known
        at = max(0, bisect_right(known, session_ns, key=get_session_time) - 1)
        return self._make_moment(step, known[at].sim_ns if known else 0, session_ns)

    def _make_moment(self, step: int, sim_ns: int, session_ns: int) -> Moment:
        return Moment(step, sim_ns, session_ns, session_ns + self._origin_utc_ns)


def _to_sim_ns(state: StateFrame) -> int:
    """Return the simulated time of a state since the session began, resets included [ns]."""
    return round(max(-LONGEST_S, min(state.sim_before + state.sim_time, LONGEST_S)) * 1e9)


# --- text for the viewer ----------------------------------------------------------------------------------------------


def describe_denial(record: DenialRecord) -> LogLine:
    """Return the log line of a denial: connection, reason, message, holder and advice."""
    denial = record.denial
    parts = [f"connection {record.connection}: {denial.reason}: {denial.message}"]
    if denial.holder:
        parts.append(f"held by {denial.holder_name or denial.holder}")
    if denial.advice:
        parts.append(denial.advice)
    return LogLine(WARN, "; ".join(parts))


def describe_session(header: SessionHeader, story: SessionStory | None = None, duration_s: float = 0.0) -> str:
    """Return a Markdown page about the recording. `story`: at its end; `None`: it begins."""
    versions = "\n".join(f"| {name} | {value} |" for name, value in header.versions.items())
    parts = [f"# {header.session_name}"]
    if story is not None:
        people = ", ".join(f"**{name}** ({role})" for name, role in story.roles.items()) or "No one joined"
        counts = f"{duration_s:.1f} s, handovers: {story.handovers}, episodes: {story.episodes}"
        parts.append(f"{people}. {counts}.")
    parts += [
        f"Robots: {', '.join(r.name for r in header.robots) or 'none'}. "
        f"Objects: {', '.join(o.name for o in header.objects) or 'none'}. "
        f"Bodies: {len(header.bodies)}. Tick: {header.tick_period_ns / 1e6:g} ms.",
        f"Recorded {header.created_utc}, class **{header.recording_class}**: `iris-session verify FILE` simulates "
        + ("it again." if header.recording_class == CLOSED else "decisions and control again."),
        f"Session `{header.session_id}`",
        f"| library | version |\n|---|---|\n{versions}\n",
    ]
    return "\n\n".join(parts)
