"""Motion that a killed recorder had not written, made from the states that it had.

A recorder writes rows of motion every few seconds (`writer.MAX_PERIOD_NS`), and exact states several times a second. So
a part that its recorder did not close has states without motion at its end. Copies for the viewer and repaired files
get the rows from these states.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.server_messages import PresenceItem
from iris_session.recording import paths, record_batches
from iris_session.recording.errors import RecorderError
from iris_session.recording.people import get_device_entity
from iris_session.recording.picture import MotionRows
from iris_session.recording.record_batches import UNREADABLE, RecordedState, read_index
from iris_session.recording.rerun_tool import read_recording_id
from iris_session.recording.rrd_file import read_chunks
from iris_session.recording.rrd_stream import RrdStream

_TRANSLATION: Final = "Transform3D:translation"
_TIMELINES: Final = (paths.STEP, paths.SIM_TIME, paths.SESSION_TIME, paths.WALL_TIME)
_WRITE_S: Final = 10.0


@contextmanager
def open_with_lost_motion(files: Sequence[str]) -> Iterator[list[str]]:
    """Yield readable files of a session, each followed by a temporary one with the motion that it lacks, if any.

    Raises `RecorderError` if a temporary file cannot be written.
    """
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(TemporaryDirectory(prefix="iris-motion-"))
            found: list[str] = []
            for i, file in enumerate(files):
                motion = Path(folder, f"{i}{paths.SUFFIX}")
                found += [file, str(motion)] if write_lost_motion(file, motion) else [file]
        except OSError as error:
            raise RecorderError(f"a temporary file cannot be written: {error.strerror or error}") from error
        yield found


def write_lost_motion(file: str, output: Path) -> int:
    """Write the motion that is missing at the end of a readable file.

    Args:
        file: A part of a recording. One that its recorder has closed lacks nothing.
        output: The file to write, if anything is missing.

    Returns:
        The number of states that it is made from.
    """
    if next(read_chunks(file, paths.END), None) is not None:
        return 0
    drawn_ns = _find_end_of_motion(file)
    stream: RrdStream | None = None
    devices: dict[str, PresenceItem] = {}
    n = 0
    for entities, states, times in _read_states(file, drawn_ns):
        is_late = times[2] > drawn_ns
        devices |= _find_devices(state for state, late in zip(states, is_late, strict=True) if not late)
        if not is_late.any():
            continue
        if stream is None:
            stream = RrdStream(str(output), paths.APPLICATION, read_recording_id(file))
            motion = MotionRows(stream.recording)
        of = [state for state, late in zip(states, is_late, strict=True) if late]
        _add_bodies(motion, entities, of, times[:, is_late])
        _add_devices(motion, of, times[:, is_late], devices)
        n += len(of)
    if stream is not None:
        motion.write()
        stream.write(_WRITE_S)
        stream.close(_WRITE_S)
    return n


def _find_end_of_motion(file: str) -> int:
    """Return the session time of the newest row of motion in a file [ns], -1 if there is none."""
    newest_ns = -1
    for chunk in read_chunks(file, (f"{paths.SCENE}/**", f"{paths.PRESENCE}/**")):
        batch: Any = chunk.to_record_batch()
        with suppress(*UNREADABLE):
            if _TRANSLATION in batch.schema.names:
                newest_ns = max(newest_ns, *read_index(batch, paths.SESSION_TIME))
    return newest_ns


def _read_states(
    file: str, after_ns: int
) -> Iterator[tuple[Sequence[str], Sequence[RecordedState], NDArray[np.int64]]]:
    """Yield the entities of bodies, states, and their times (see `MotionRows.add`) of chunks with states after a
    session time, and of the chunk before the first of them.
    """
    entities: list[str] = []
    before: list[Any] = []
    for chunk in read_chunks(file, (paths.STATE, paths.STATE_ENTITIES)):
        batch: Any = chunk.to_record_batch()
        with suppress(*UNREADABLE):  # what is damaged is left out
            if chunk.entity_path == paths.STATE_ENTITIES:
                entities = [str(entity or "") for entity in batch.column("bodies")[-1].as_py()]
            elif max(read_index(batch, paths.SESSION_TIME)) <= after_ns:
                before = [batch]
            else:
                for one in (*before, batch):
                    times = np.array([read_index(one, timeline) for timeline in _TIMELINES], np.int64)
                    yield entities, list(record_batches.decode_states(one)), times
                before = []


def _add_bodies(
    motion: MotionRows, entities: Sequence[str], states: Sequence[RecordedState], times: NDArray[np.int64]
) -> None:
    """Add a row for every moving body and state. `times`: as of `MotionRows.add`, one column per state."""
    moving = np.array([i for i, entity in enumerate(entities) if entity], np.intp)
    of_scene = [i for i, state in enumerate(states) if len(state.poses) == len(entities)]
    if not of_scene or not len(moving):
        return
    poses = np.stack([states[i].poses[moving] for i in of_scene])
    which = np.tile(np.arange(len(moving)), len(of_scene))
    motion.add(
        [entities[i] for i in moving], which, np.repeat(times[:, of_scene], len(moving), axis=1), poses.reshape(-1, 7)
    )


def _find_devices(states: Iterable[RecordedState]) -> dict[str, PresenceItem]:
    """Return the newest poses of devices by entity."""
    return {get_device_entity(one.participant, one.device): one for state in states for one in state.presence}


def _add_devices(
    motion: MotionRows,
    states: Sequence[RecordedState],
    times: NDArray[np.int64],
    known: dict[str, PresenceItem],
) -> None:
    """Add a row for every new pose of a device. `known`: the newest pose of each, by entity."""
    rows: list[tuple[str, int, tuple[float, ...]]] = []
    for i, state in enumerate(states):
        for item in state.presence:
            entity = get_device_entity(item.participant, item.device)
            if known.get(entity) != item:
                known[entity] = item
                rows.append((entity, i, (*item.pose.p, *item.pose.q)))
    entities = list(dict.fromkeys(entity for entity, _, _ in rows))
    which = np.array([entities.index(entity) for entity, _, _ in rows], np.intp)
    poses = np.array([pose for _, _, pose in rows], np.float64)
    motion.add(entities, which, times[:, [i for _, i, _ in rows]], poses)
