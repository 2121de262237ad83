"""Write one part of a recording into a Rerun file: journal and raw data exactly, and a drawing of the session.

Exact float64 poses, raw samples and the journal are plain columns beside what `SessionDrawing` draws for the viewer.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
import rerun as rr

from iris_session.journal.errors import WriteError
from iris_session.journal.messages import (
    ABRUPT,
    Batch,
    DenialRecord,
    EndMark,
    HeaderCopy,
    SceneAssets,
    SceneModel,
    StateFrame,
    encode_header,
    encode_header_copy,
    encode_scene,
)
from iris_session.journal.rows import (
    CLOSED,
    CRASHED,
    NO_ENTRIES,
    JournalRow,
    Keyframe,
    SessionHeader,
    blob_root,
    seal_blob,
)
from iris_session.journal.runs import pack_run, split_runs
from iris_session.protocol.client_messages import Heartbeat
from iris_session.protocol.entries import decode_entries
from iris_session.protocol.server_messages import Event
from iris_session.rrd import paths
from iris_session.rrd.assets import AssetQueue, AssetRows
from iris_session.rrd.batches import RUN
from iris_session.rrd.index import INDEX_BYTES
from iris_session.rrd.stream import (
    RrdStream,
    bytes_column,
    duration_index,
    matrix_column,
    scalar_column,
    sequence_index,
    table_columns,
)
from iris_session.viewer.drawing import SessionDrawing
from iris_session.viewer.event_layer import make_log_columns
from iris_session.viewer.narration import WARN, NarratedEvent, describe_denial, describe_session
from iris_session.viewer.timelines import MomentTable, to_time_columns

_encode = msgspec.msgpack.Encoder().encode
#: Columns of tables: those of `JournalRow` behind its times, and of runs; of raw messages; of `AssetRows`.
_NUMBERS: Final = pa.list_(pa.uint32())
_ROWS: Final = {
    "n_ticks": pa.int64(),
    "entries": pa.binary(),
    "entry_lengths": _NUMBERS,
    "entry_crcs": _NUMBERS,
    "digest": pa.binary(),
    "chain": pa.binary(),
    "field_crcs": _NUMBERS,
    "plant": pa.binary(),
    RUN: pa.binary(),
}
_SAMPLES: Final = {"connection": pa.int64(), "receive_ns": pa.int64(), "data": pa.binary()}
_SCENES: Final = {"scene_step": pa.int64(), "scene_ns": pa.int64(), "hash": pa.string(), "recorded": pa.string()}
_PIECES: Final = {
    "address": pa.string(),
    "offset": pa.int64(),
    "total": pa.int64(),
    "is_scene": pa.bool_(),
    "data": pa.binary(),
}
_FAULTS: Final = {"address": pa.string(), "text": pa.string()}


class RrdWriter:
    """Writer of one file.

    `add`, `add_sample` and `add_media` only collect; `flush` writes and returns when the operating
    system has the bytes.

    Attributes:
        path: The file.
        stream: Its bytes.
        drawing: What the viewer shows.
        assets: What `write_assets` writes.
        is_urgent: Something was collected that is not to wait: all but rows of steps in which nothing but heartbeats
            came in, plotted values, and what participants report of their states.
    """

    def __init__(self, path: str | Path, recording_id: str, assets: AssetQueue | None = None) -> None:
        self.path = str(path)
        self.assets = AssetQueue() if assets is None else assets
        self.stream = RrdStream(self.path, paths.APPLICATION, recording_id)
        self._rec = self.stream.recording
        self._rec.set_log_time_enabled(False)
        self._moments = MomentTable()
        self.drawing = SessionDrawing(self._rec, self._moments, is_first=paths.split_part(self.path)[1] == 1)
        self._pending = Batch()
        self._samples: list[tuple[int, int, bytes]] = []
        self._reports: list[tuple[str, int, float]] = []
        self._media: list[Sequence[bytes]] = []
        self.is_urgent = False
        self._header: SessionHeader | None = None
        self._newest_row = (-1, b"")
        self._begins_ns: int | None = None  # session time of the first row
        self._newest_ns = 0
        self._has_scene = False  # the assets of a scene were given

    @property
    def size_with_index(self) -> int:
        """Bytes that the file would have if it was closed now and got its index."""
        return self.stream.size + self.stream.messages * INDEX_BYTES

    def write_header(self, header: SessionHeader) -> None:
        """Write the header and the scene. Must be called before the first flush with data."""
        self._rec.send_recording_name(header.session_name)
        blob = encode_header(header)
        copy = encode_header_copy(HeaderCopy(blob_root(blob), msgspec.structs.replace(header, model=b"")))
        for entity, content in ((paths.HEADER, blob), (paths.HEADER_COPY, copy)):
            self._log_static(entity, rr.AnyValues(blob=pa.array([seal_blob(content)], pa.binary())))
        self._header = header
        self._moments.origin_utc_ns = header.origin_utc_ns
        self._log_static(paths.INFO, rr.TextDocument(describe_session(header), media_type="text/markdown"))
        self.drawing.begin(header)

    def add(self, batch: Batch) -> None:
        """Collect one batch of the authority. States of one flush are of one scene."""
        if batch.scenes or batch.assets:
            self.flush()
            self._write_scenes(batch.scenes, batch.assets)
        pending = self._pending
        self.is_urgent = self.is_urgent or not _is_idle(batch)
        self.drawing.narration.add_people(batch.people)
        for name in ("rows", "states", "events", "denials", "metrics", "keyframes", "holds", "vertices"):
            getattr(pending, name).extend(getattr(batch, name))

    def add_sample(self, connection: int, receive_ns: int, data: bytes) -> None:
        """Collect one raw message of a client, as received."""
        self._samples.append((connection, receive_ns, data))
        self.is_urgent = True

    def add_report(self, participant: str, receive_ns: int, age_ms: float) -> None:
        """Collect a report of a client: the age [ms] below which 99 % of the states of a second reached it."""
        self._reports.append((participant, receive_ns, age_ms))

    def add_media(self, message: Sequence[bytes]) -> None:
        """Collect a message about a stream of clouds or pictures, as `MediaDrawer.draw` takes it."""
        self._media.append(message)
        self.is_urgent = True

    def flush(self, timeout_s: float = 10.0) -> None:
        """Write everything collected. Raises `WriteError`; the file is then valid up to an earlier flush."""
        batch, self._pending = self._pending, Batch()
        samples, self._samples = self._samples, []
        reports, self._reports = self._reports, []
        media, self._media = self._media, []
        self.is_urgent = False
        self._write_rows(batch.rows)
        self._write_keyframes(batch.keyframes)
        events = self.drawing.events
        narration = self.drawing.narration
        narrated = [narration.add(event) for event in batch.events]  # names and roles are known when people appear
        for _, states in groupby(batch.states, key=lambda state: len(state.poses)):
            self._write_states(list(states))
        self._write_events(batch.events, narrated)
        events.add_holds(batch.holds)
        self._write_denials(batch.denials)
        events.add_metrics(batch.metrics)
        events.add_state_ages(reports)
        self.drawing.write()
        self.drawing.draw_vertices(batch.vertices)
        self._write_samples(samples)
        self.drawing.draw_media(media)
        self._write_stream(timeout_s)
        if batch.keyframes:
            self._write_mark()

    def write_assets(self, max_bytes: int, timeout_s: float = 10.0) -> None:
        """Write the next assets, after the first row: no time in the file is before the first picture.

        Raises `WriteError`.
        """
        if self.assets and self._begins_ns is not None:
            self._write_asset_rows(self.assets.read(self._newest_ns, max_bytes), timeout_s)

    def close(
        self, timeout_s: float = 10.0, reason: str = "", samples_left_out: int = 0, *, is_abrupt: bool = False
    ) -> None:
        """Write the rest and the end mark, and close the file. Assets that still wait are noted as missing.

        Args:
            timeout_s: Longest time for each write.
            reason: Why the recording ends before the session; empty if it does not.
            samples_left_out: Number of raw messages that are not in the file.
            is_abrupt: The session was killed.

        Raises:
            WriteError: The disk is full or the file system reports an error.
        """
        self.flush(timeout_s)
        self._write_asset_rows(self.assets.close(reason or "the session ended before it was written"), timeout_s)
        text = reason or (ABRUPT if is_abrupt else "")
        if text:
            self._rec.log(f"{paths.EVENTS}/recorder", rr.TextLog(text, level=WARN), strict=True)
        self.drawing.close()
        self._describe_result()
        self.flush(timeout_s)
        self._write_mark()
        mark = EndMark(*self._newest_row, reason, samples_left_out, is_abrupt)
        self._log_static(paths.END, rr.AnyValues(end=pa.array([_encode(mark)], pa.binary())))
        try:
            self.stream.close(timeout_s)
        except (RuntimeError, ValueError, OSError) as error:
            raise self._to_error(error) from error

    def _write_stream(self, timeout_s: float) -> None:
        try:
            self.stream.write(timeout_s)
        except (RuntimeError, ValueError, OSError) as error:
            raise self._to_error(error) from error

    def _to_error(self, error: Exception) -> WriteError:
        said = (isinstance(error, OSError) and error.strerror) or " ".join(str(error).split())
        return WriteError(f"{self.path} cannot be written: {said}")

    def _describe_result(self) -> None:
        """Say what the session was, in the text and as properties: those of a folder of files are a table."""
        header, narration = self._header, self.drawing.narration
        if header is None:
            return
        duration_s = 0.0 if self._begins_ns is None else (self._newest_ns - self._begins_ns) * 1e-9
        text = describe_session(header, narration, duration_s)
        self._log_static(paths.INFO, rr.TextDocument(text, media_type="text/markdown"))
        properties = rr.AnyValues(
            people=list(narration.roles) or None,
            robots=[robot.name for robot in header.robots] or None,
            handovers=narration.handovers,
            episodes=narration.episodes,
            duration_s=duration_s,
            verify_class=header.recording_class,
        )
        self._rec.send_property("session", properties)

    def _log_static(self, entity: str, *values: Any) -> None:
        self._rec.log(entity, *values, static=True, strict=True)

    def _send_columns(self, entity: str, times: Sequence[Any], columns: Sequence[Any]) -> None:
        rr.send_columns(entity, times, columns, recording=self._rec, strict=True)

    def _write_mark(self) -> None:
        times = [sequence_index(paths.STEP, [self._newest_row[0]])]
        self._send_columns(paths.MARKS, times, [bytes_column("mark", [_encode(self.stream.mark())])])

    def _write_rows(self, rows: Sequence[JournalRow]) -> None:
        if not rows:
            return
        table: list[Sequence[Any]] = []
        places: list[tuple[int, int]] = []
        for some in split_runs(rows):
            run = pack_run(some)
            if run:
                table.append((*[None] * (len(_ROWS) - 1), run))
            else:
                table += [(*msgspec.structs.astuple(row)[2:-1], row.plant or None, None) for row in some]
            places += [(row.step, row.now_ns) for row in (some[-1:] if run else some)]
        used = [any(value is not None for value in values) for values in zip(*table, strict=True)]
        columns = [column for column, is_used in zip(table_columns(table, _ROWS), used, strict=True) if is_used]
        steps, times_ns = zip(*places, strict=True)
        times = [sequence_index(paths.STEP, steps), duration_index(paths.SESSION_TIME, times_ns)]
        self._send_columns(paths.ROWS, times, columns)
        self._newest_row = (rows[-1].step, rows[-1].chain)
        self._newest_ns = rows[-1].now_ns
        if self._begins_ns is None:
            self._begins_ns = rows[0].now_ns

    def _write_keyframes(self, keyframes: Sequence[Keyframe]) -> None:
        if keyframes:
            times = [sequence_index(paths.STEP, [k.step for k in keyframes])]
            self._send_columns(paths.KEYFRAMES, times, [bytes_column("keyframe", [_encode(k) for k in keyframes])])

    def _write_scenes(self, scenes: list[SceneModel], assets: list[SceneAssets]) -> None:
        """Write models for verification, and change the picture."""
        if scenes:
            times = [sequence_index(paths.STEP, [s.step for s in scenes])]
            blobs = [seal_blob(encode_scene(scene)) for scene in scenes]
            self._send_columns(paths.MODELS, times, [bytes_column("scene", blobs)])
        self.drawing.change_scene(scenes, assets)
        for one in assets:
            self.assets.add_scene(one, is_patch=not scenes and self._has_scene)
            self._has_scene = True

    def _write_states(self, states: list[StateFrame]) -> None:
        poses = np.stack([np.frombuffer(s.poses, np.float64).reshape(-1, 7) for s in states])
        # Of class closed, the simulation gives the exact poses.
        is_closed = self._header is not None and self._header.recording_class == CLOSED
        columns = [
            matrix_column("poses", poses.reshape(len(states), -1).astype(np.float32 if is_closed else np.float64)),
            scalar_column("tick", [s.tick for s in states], pa.int64()),
            scalar_column("sim_time_s", [s.sim_time for s in states], pa.float64()),
            bytes_column("presence", [_encode(s.presence) for s in states]),
            bytes_column("applied", [_encode(s.applied) for s in states]),
        ]
        times = np.array(self.drawing.find_moments(states), np.int64).T
        self._send_columns(paths.STATE, to_time_columns(times), columns)
        self.drawing.draw_states(states, poses, self._begins_ns)

    def _write_events(self, events: list[Event], narrated: Sequence[NarratedEvent]) -> None:
        if events:
            columns = self.drawing.events.draw_events(events, narrated)
            columns.append(bytes_column("event", [_encode(event) for event in events]))
            times = self._moments.to_times(paths.EVENTS, [(e.step, e.session_time) for e in events])
            self._send_columns(paths.EVENTS, times, columns)

    def _write_denials(self, denials: list[DenialRecord]) -> None:
        if denials:
            columns = make_log_columns([describe_denial(record) for record in denials])
            columns.append(bytes_column("denial", [_encode(record) for record in denials]))
            times = self._moments.to_times(paths.DENIALS, [(d.step, d.session_time) for d in denials])
            self._send_columns(paths.DENIALS, times, columns)

    def _write_samples(self, samples: list[tuple[int, int, bytes]]) -> None:
        if not samples:
            return
        times = [self._moments.spread_one(paths.SAMPLES, s[1]) for s in samples]
        self._send_columns(paths.SAMPLES, [duration_index(paths.SESSION_TIME, times)], table_columns(samples, _SAMPLES))

    def _write_asset_rows(self, rows: AssetRows, timeout_s: float) -> None:
        """Write rows about assets at the time of the newest row of the journal."""
        scenes, pieces = (paths.ASSET_SCENES, _SCENES, rows.scenes), (paths.ASSETS, _PIECES, rows.pieces)
        tables: tuple[tuple[str, dict[str, Any], Sequence[Any]], ...]
        tables = (scenes, pieces, (paths.ASSET_FAULTS, _FAULTS, rows.faults))
        for entity, types, table in tables:
            if table:
                times = [self._moments.spread_one(entity, self._newest_ns) for _ in table]
                index = [duration_index(paths.SESSION_TIME, times)]
                self._send_columns(entity, index, table_columns(table, types))
        self._write_stream(timeout_s)


def _is_idle(batch: Batch) -> bool:
    """Return whether a batch may wait for others, see `RrdWriter.is_urgent`."""
    urgent: tuple[Sequence[Any], ...] = (batch.states, batch.events, batch.denials, batch.keyframes, batch.scenes)
    urgent += (batch.assets, batch.holds, batch.vertices)
    return not any(urgent) and all(_is_idle_row(row) for row in batch.rows)


def _is_idle_row(row: JournalRow) -> bool:
    if row.plant or row.digest == CRASHED:
        return False
    return row.entries == NO_ENTRIES or all(type(entry.message) is Heartbeat for entry in decode_entries(row.entries))
