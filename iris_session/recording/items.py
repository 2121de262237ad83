"""What stands in the columns of a recording, as values: rows, keyframes, states, events, raw messages. Pure.

Each function takes an Arrow record batch and gives one value per row. What it raises (`UNREADABLE`) says that the bytes
mean something else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.common import Applied
from iris_session.protocol.server_messages import BodyInfo, Event, PresenceItem
from iris_session.recording import paths
from iris_session.recording.joining import ROW_ID, get_entity
from iris_session.recording.journal import JournalRow, Keyframe, open_blob
from iris_session.recording.messages import DenialRecord, EndMark, SceneModel, decode_scene
from iris_session.recording.rrd_file import Mark

#: What decoding of bytes that mean something else may raise; the last one is Arrow's, for types that it cannot turn.
UNREADABLE: Final = (msgspec.DecodeError, LookupError, TypeError, ValueError, ArithmeticError, NotImplementedError)
#: Bytes of a row id that are the time of the write.
_WRITE: Final = 8
_T = TypeVar("_T")

_decode_presence = msgspec.msgpack.Decoder(tuple[PresenceItem, ...]).decode
_decode_applied = msgspec.msgpack.Decoder(tuple[Applied, ...]).decode


class RawSample(NamedTuple):
    """A message of a client as it came. `receive_ns`: session time."""

    connection: int
    receive_ns: int
    data: bytes


class RecordedState(NamedTuple):
    """`poses`: float64 (n_bodies, 7) `x y z qw qx qy qz`, world frame, exactly as the session had them. `bodies`: of
    which body each is."""

    step: int
    tick: int
    sim_time: float
    session_time: int
    poses: NDArray[np.float64]
    presence: tuple[PresenceItem, ...]
    applied: tuple[Applied, ...]
    bodies: tuple[BodyInfo, ...] = ()


class Scalar(NamedTuple):
    """A value of a plot. `session_time`: [ns]."""

    entity: str
    session_time: int
    value: float


def decode_rows(batch: Any) -> Iterator[JournalRow]:
    """Rows of the journal."""
    columns = zip(
        read_index(batch, paths.STEP),
        read_index(batch, paths.SESSION_TIME),
        read_values(batch, "n_ticks"),
        read_values(batch, "entries"),
        _lists(batch, "entry_lengths"),
        _lists(batch, "entry_crcs"),
        read_values(batch, "digest"),
        read_values(batch, "chain"),
        _lists(batch, "field_crcs"),
        _plants(batch),
        strict=True,
    )
    return (JournalRow(*row) for row in columns)


def decode_states(batch: Any) -> Iterator[RecordedState]:
    """States without their `bodies`."""
    _flat(batch, "poses")
    lists = batch.column("poses")
    ends = np.cumsum(np.asarray(lists.value_lengths(), np.intp))  # another scene has other bodies
    poses = [p.reshape(-1, 7) for p in np.split(np.asarray(lists.flatten(), np.float64), ends[:-1])]
    columns = zip(
        read_index(batch, paths.STEP),
        read_index(batch, paths.TICK),
        read_values(batch, "sim_time_s"),
        read_index(batch, paths.SESSION_TIME),
        poses,
        map(_decode_presence, read_values(batch, "presence")),
        map(_decode_applied, read_values(batch, "applied")),
        strict=True,
    )
    return (RecordedState(*row) for row in columns)


def decode_models(batch: Any) -> Iterator[SceneModel]:
    """Scenes that were loaded."""
    for sealed in read_values(batch, "scene"):
        blob, intact = open_blob(sealed)
        if not intact:
            raise ValueError("a model was changed (checksum)")
        yield decode_scene(blob)


def decode_samples(batch: Any) -> Iterator[RawSample]:
    """Raw messages."""
    columns = (read_values(batch, "connection"), read_index(batch, paths.SESSION_TIME), read_values(batch, "data"))
    return (RawSample(*row) for row in zip(*columns, strict=True))


def decode_scalars(batch: Any) -> Iterator[Scalar]:
    """Values of plots."""
    columns = (read_index(batch, paths.SESSION_TIME), read_values(batch, "Scalars:scalars"))
    return (Scalar(get_entity(batch), *row) for row in zip(*columns, strict=True))


def numbered_denial_decoder() -> Callable[[Any], Iterator[tuple[int, DenialRecord]]]:
    """Reads denials, and how many of the same step come before each: two may be alike. For batches in their order.

    The recorder writes those of a step at once, and the first half of Rerun's row id tells of each write. So a step
    goes on where Rerun's tools have cut between its denials, and begins anew where another part repeats it.
    """
    place, n = (b"", -1), 0

    def numbered(batch: Any) -> Iterator[tuple[int, DenialRecord]]:
        nonlocal place, n
        for record, row in zip(decode_denials(batch), batch.column(ROW_ID).to_pylist(), strict=True):
            at = (row[:_WRITE], record.step)
            place, n = at, n + 1 if at == place else 0
            yield n, record

    return numbered


def _packed(column: str, kind: type[_T]) -> Callable[[Any], Iterator[_T]]:
    """Reads a column with one MessagePack value per row."""
    decode = msgspec.msgpack.Decoder(kind).decode
    return lambda batch: map(decode, read_values(batch, column))


decode_keyframes: Final = _packed("keyframe", Keyframe)
decode_events: Final = _packed("event", Event)
decode_denials: Final = _packed("denial", DenialRecord)
decode_marks: Final = _packed("mark", Mark)
decode_ends: Final = _packed("end", EndMark)


def read_values(batch: Any, column: str) -> list[Any]:
    """One value per row of a component column."""
    flat = _flat(batch, column)
    if len(flat) != batch.num_rows:
        raise ValueError(f"{column} has {len(flat)} values in {batch.num_rows} rows")
    return list(flat.to_pylist())


def read_index(batch: Any, timeline: str) -> list[int]:
    """Integer values of a timeline (durations in nanoseconds)."""
    return [int(v) for v in np.asarray(batch.column(timeline).cast("int64"))]


def _plants(batch: Any) -> list[bytes]:
    """Empty for rows without one; where no row has one there is no such column."""
    if "plant" not in batch.schema.names:
        return [b""] * batch.num_rows
    return [value[0] if value else b"" for value in batch.column("plant").to_pylist()]


def _lists(batch: Any, column: str) -> Iterator[tuple[Any, ...]]:
    """A tuple per row of a component column."""
    _flat(batch, column)
    return map(tuple, batch.column(column).to_pylist())


def _flat(batch: Any, column: str) -> Any:
    """All values of a column that every row has something in."""
    lists = batch.column(column)
    flat = lists.flatten()
    if missing := lists.null_count + flat.null_count:
        raise ValueError(f"{column} has {missing} values less than it ought to have")
    return flat
