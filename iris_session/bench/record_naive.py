"""References of `bench record`: what Rerun's own calls make of the same values, without a journal and raw messages.

One entity per body, device and series, one row per state, on the four timelines of a recording. The geometry of the
scene is in the file once. The length of the batches decides about the size, since a short chunk is mostly its schema.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from iris_session.protocol.common import Pose
from iris_session.recording import RecordedState, Recording
from iris_session.rrd import paths
from iris_session.rrd.batches import read_index
from iris_session.rrd.file import read_chunks
from iris_session.viewer.scene_layer import SceneLayer, SceneSource, escape_entity_part
from iris_session.viewer.timelines import Moment, to_time_columns

#: Session time of a batch: of a program that collects for `rerun.send_columns` as long as a recorder does, and of one
#: that calls `rerun.log`, whose batcher writes after 0.2 s (`ChunkBatcherConfig.flush_tick`).
LONG_BATCH_S: Final = 8.0
LOG_BATCH_S: Final = 0.2
_SCALARS: Final = "Scalars:scalars"
_TIMELINES: Final = (paths.STEP, paths.SIM_TIME, paths.SESSION_TIME, paths.WALL_TIME)
_Rows = dict[str, list[tuple[Moment, list[float]]]]


def write_naive_log(recording: Recording, output: Path, batch_s: float) -> int:
    """Log the values of a recording to `output`, in batches of so much session time. Return its size [bytes]."""
    log = rr.RecordingStream("naive", recording_id="naive")
    log.set_log_time_enabled(False)
    log.save(output)
    states = list(recording.states())
    if states:
        header, first = recording.header, _make_moment(states[0], recording.header.origin_utc_ns)
        picture = SceneLayer(log)
        picture.set_scene(SceneSource(header.model, header.bodies, robots=header.robots))
        picture.draw(first)
    for rows in _split(_list_poses(states, recording.header.origin_utc_ns), batch_s):
        for entity, taken in rows.items():
            poses = np.array([pose for _, pose in taken], np.float32)
            columns = rr.Transform3D.columns(translation=poses[:, :3], quaternion=poses[:, [4, 5, 6, 3]])
            _send(log, entity, [moment for moment, _ in taken], columns)
    for rows in _split(sorted(_list_scalars(recording), key=lambda row: row[1].session_ns), batch_s):
        for entity, taken in rows.items():
            values = np.array([row for _, row in taken], np.float64)
            columns = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))
            _send(log, entity, [moment for moment, _ in taken], columns)
    for event in recording.events():
        log.set_time(paths.SESSION_TIME, duration=np.timedelta64(event.session_time, "ns"))
        log.log("events", rr.TextLog(repr(event.body)))
    log.disconnect()
    return output.stat().st_size


def _list_poses(states: list[RecordedState], origin_utc_ns: int) -> Iterator[tuple[str, Moment, list[float]]]:
    """Yield entity, time and pose (`x y z qw qx qy qz`) of every moving body and device at every state."""
    for state in states:
        moment = _make_moment(state, origin_utc_ns)
        for body, pose in zip(state.bodies, state.poses.tolist(), strict=True):
            if body.moving:
                yield f"bodies/{escape_entity_part(body.name)}", moment, pose
        for item in state.presence:
            yield f"people/{item.participant}/{item.device}", moment, _list_numbers(item.pose)


def _list_scalars(recording: Recording) -> Iterator[tuple[str, Moment, list[float]]]:
    """Yield entity, time and values of what the recording plots: joints, grippers, speeds, delays."""
    for file in recording.readable_files:
        for chunk in read_chunks(file, (f"{paths.ROBOTS}/**", f"{paths.METRICS}/**")):
            batch = chunk.to_record_batch()
            if _SCALARS not in batch.schema.names:
                continue
            times = zip(*(read_index(batch, timeline) for timeline in _TIMELINES), strict=True)
            for moment, values in zip(times, batch.column(_SCALARS).to_pylist(), strict=True):
                yield str(chunk.entity_path), Moment(*moment), values


def _split(rows: Iterable[tuple[str, Moment, list[float]]], batch_s: float) -> Iterator[_Rows]:
    """Collect rows in order of time by entity, in batches."""
    begin_ns: int | None = None
    batch: _Rows = {}
    for entity, moment, values in rows:
        if begin_ns is None or not 0 <= moment.session_ns - begin_ns < batch_s * 1e9:
            if batch:
                yield batch
            begin_ns, batch = moment.session_ns, {}
        batch.setdefault(entity, []).append((moment, values))
    if batch:
        yield batch


def _make_moment(state: RecordedState, origin_utc_ns: int) -> Moment:
    time_ns = state.session_time
    return Moment(state.step, round(state.sim_time * 1e9), time_ns, time_ns + origin_utc_ns)


def _list_numbers(pose: Pose) -> list[float]:
    return [*pose.p, *pose.q]


def _send(log: rr.RecordingStream, entity: str, moments: list[Moment], columns: Any) -> None:
    times: NDArray[np.int64] = np.array(moments, np.int64).T
    rr.send_columns(entity, to_time_columns(times), [*columns], recording=log, strict=True)
