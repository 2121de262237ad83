"""Arrow record batches of a recording: rejoin rows that Rerun's tools have split, and decode their columns. Pure.

Each `decode_` function takes a record batch and yields one value per row: journal rows, keyframes, states, events, raw
messages. It raises one of `UNREADABLE` if the bytes mean something else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import Any, Final, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.journal.messages import DenialRecord, EndMark, SceneModel, decode_scene
from iris_session.journal.rows import JournalRow, Keyframe, open_blob
from iris_session.journal.runs import read_run_times, unpack_run
from iris_session.protocol.assets import is_address
from iris_session.protocol.common import Applied
from iris_session.protocol.media import StreamInfo
from iris_session.protocol.names import MediaEncoding
from iris_session.protocol.server_messages import BodyInfo, Event, PresenceItem
from iris_session.rrd import paths
from iris_session.rrd.assets import RECORD_ASSETS, AssetFault, AssetPiece, RecordedScene, check_piece
from iris_session.rrd.file import Mark

#: Errors of decoding bytes that mean something else; the last one is Arrow's, for types that it cannot convert.
UNREADABLE: Final = (msgspec.DecodeError, LookupError, TypeError, ValueError, ArithmeticError, NotImplementedError)
#: Column of a run of rows (`journal/runs.py`), null in a row that is none.
RUN: Final = "run"
#: Bytes of a row id that are the time of the write.
_WRITE: Final = 8
_T = TypeVar("_T")

_decode_presence = msgspec.msgpack.Decoder(tuple[PresenceItem, ...]).decode
_decode_info = msgspec.json.Decoder(StreamInfo).decode
_decode_applied = msgspec.msgpack.Decoder(tuple[Applied, ...]).decode


class RawSample(NamedTuple):
    """A message of a client as received. `receive_ns`: session time."""

    connection: int
    receive_ns: int
    data: bytes


class RecordedState(NamedTuple):
    """State of all bodies at one moment.

    `poses`: float64 (n_bodies, 7) `x y z qw qx qy qz`, world frame, exactly as in the session. `bodies`: the body of
    each pose. `sim_time` [s], `session_time` [ns].
    """

    step: int
    tick: int
    sim_time: float
    session_time: int
    poses: NDArray[np.float64]
    presence: tuple[PresenceItem, ...]
    applied: tuple[Applied, ...]
    bodies: tuple[BodyInfo, ...] = ()


class RecordedCloud(NamedTuple):
    """A frame of a point cloud.

    Attributes:
        stream: Name of the stream.
        seq: Number of the frame in it; frames between two recorded ones are left out.
        capture_ns: Session time of the capture, as its source states it.
        received_ns: Session time at which the session received it.
        positions: (n, 3) float32 [m], world frame.
        colors: (n, 4) uint8, red, green, blue, and 255.
        error_m: Where a point is stated to be within, 95 % of the time [m]; infinite where that is not known.
        voxel_m: Edge of the cell that a point stands for [m]; 0 where it stands for itself.
    """

    stream: str
    seq: int
    capture_ns: int
    received_ns: int
    positions: NDArray[np.float32]
    colors: NDArray[np.uint8]
    error_m: float
    voxel_m: float


class RecordedImage(NamedTuple):
    """A picture of a camera. `jpeg`: the file as its source made it. The others are as in `RecordedCloud`."""

    stream: str
    seq: int
    capture_ns: int
    received_ns: int
    jpeg: bytes


class RecordedStream(NamedTuple):
    """A description of a stream of clouds or pictures, valid until the next one of this stream.

    Attributes:
        stream: Name of the stream.
        session_time: Capture of the first frame that it describes, or the time when it changed or ended [ns].
        encoding: Encoding of the frames, `cloud` or `jpeg`.
        info: What its source says of it: title, audience, camera with intrinsics and pose, rate, fault. `None`: the
            stream has ended.
    """

    stream: str
    session_time: int
    encoding: str
    info: StreamInfo | None


class Scalar(NamedTuple):
    """A value of a plot. `session_time`: [ns]."""

    entity: str
    session_time: int
    value: float


class RowTimes(NamedTuple):
    """Steps and session times [ns] of some rows of the journal, int64, shape (n,)."""

    steps: NDArray[np.int64]
    session_times: NDArray[np.int64]


class FrameTime(NamedTuple):
    """Number and capture [ns] of a frame of a cloud or picture. `encoding`: `cloud` or `jpeg`."""

    stream: str
    encoding: str
    seq: int
    capture_ns: int


def decode_rows(batch: Any) -> Iterator[JournalRow]:
    """Yield rows of the journal, those of runs too.

    Raises:
        ValueError: Runs are damaged. The other rows are yielded before.
    """
    damaged: list[str] = []
    is_run, singles, runs = _split_runs(batch)
    single_rows = _decode_single_rows(singles) if singles.num_rows else iter(())
    ends = zip(read_index(runs, paths.STEP), read_index(runs, paths.SESSION_TIME), _read_runs(runs), strict=True)
    for packed in is_run:
        if not packed:
            yield next(single_rows)
            continue
        step, now_ns, run = next(ends)
        try:
            rows = unpack_run(run)
        except ValueError as error:
            damaged.append(f"rows up to step {step}: {error}")
            continue
        if (rows[-1].step, rows[-1].now_ns) == (step, now_ns):
            yield from rows
        else:
            damaged.append(f"rows up to step {rows[-1].step}: step or time of a run were changed")
    if damaged:
        raise ValueError("; ".join(damaged))


def _split_runs(batch: Any) -> tuple[list[bool], Any, Any]:
    """Return which rows are runs, the rows that are none, and the runs."""
    if RUN not in batch.schema.names:
        return [False] * batch.num_rows, batch, batch.slice(0, 0)
    is_single = batch.column(RUN).is_null()
    is_run = batch.column(RUN).is_valid()
    return is_run.to_pylist(), batch.filter(is_single), batch.filter(is_run)


def _read_runs(runs: Any) -> list[bytes]:
    return read_values(runs, RUN) if runs.num_rows else []


def _decode_single_rows(batch: Any) -> Iterator[JournalRow]:
    columns = zip(
        read_index(batch, paths.STEP),
        read_index(batch, paths.SESSION_TIME),
        read_values(batch, "n_ticks"),
        read_values(batch, "entries"),
        _read_lists(batch, "entry_lengths"),
        _read_lists(batch, "entry_crcs"),
        read_values(batch, "digest"),
        read_values(batch, "chain"),
        _read_lists(batch, "field_crcs"),
        _read_plants(batch),
        strict=True,
    )
    return (JournalRow(*row) for row in columns)


def decode_states(batch: Any) -> Iterator[RecordedState]:
    """Yield states without their `bodies`."""
    _flatten(batch, "poses")
    lists = batch.column("poses")
    ends = np.cumsum(np.asarray(lists.value_lengths(), np.intp))  # another scene has other bodies
    poses = [p.reshape(-1, 7) for p in np.split(np.asarray(lists.flatten(), np.float64), ends[:-1])]
    columns = zip(
        read_index(batch, paths.STEP),
        _read_ticks(batch),
        read_values(batch, "sim_time_s"),
        read_index(batch, paths.SESSION_TIME),
        poses,
        map(_decode_presence, read_values(batch, "presence")),
        map(_decode_applied, read_values(batch, "applied")),
        strict=True,
    )
    return (RecordedState(*row) for row in columns)


def decode_models(batch: Any) -> Iterator[SceneModel]:
    """Yield the models of scenes that were loaded."""
    for sealed in read_values(batch, "scene"):
        blob, intact = open_blob(sealed)
        if not intact:
            raise ValueError("a model was changed (checksum)")
        yield decode_scene(blob)


def decode_samples(batch: Any) -> Iterator[RawSample]:
    """Yield raw messages."""
    is_exact = "receive_ns" in batch.schema.names  # since rows of one time are shown 1 ns apart
    received = read_values(batch, "receive_ns") if is_exact else read_index(batch, paths.SESSION_TIME)
    columns = (read_values(batch, "connection"), received, read_values(batch, "data"))
    return (RawSample(*row) for row in zip(*columns, strict=True))


def decode_scalars(batch: Any) -> Iterator[Scalar]:
    """Yield values of plots."""
    batch = _select_rows(batch, "Scalars:scalars")  # others name the series
    if not batch.num_rows:
        return iter(())
    columns = (read_index(batch, paths.SESSION_TIME), read_values(batch, "Scalars:scalars"))
    return (Scalar(get_entity(batch), *row) for row in zip(*columns, strict=True))


def decode_clouds(batch: Any) -> Iterator[RecordedCloud]:
    """Yield the frames of one stream."""
    batch = _select_frames(batch)
    if not batch.num_rows:
        return iter(())
    columns = (
        *_read_times(batch),
        (_read_points(row) for row in batch.column("Points3D:positions")),
        (_read_colors(row) for row in batch.column("Points3D:colors")),
        read_values(batch, "error_m"),
        read_values(batch, "voxel_m"),
    )
    return (RecordedCloud(_read_stream(batch), *row) for row in zip(*columns, strict=True))


def decode_pictures(batch: Any) -> Iterator[RecordedImage]:
    """Yield the pictures of one stream."""
    batch = _select_frames(batch)
    if not batch.num_rows:
        return iter(())
    blobs = (np.asarray(row.values.flatten(), np.uint8).tobytes() for row in batch.column("EncodedImage:blob"))
    return (RecordedImage(_read_stream(batch), *row) for row in zip(*_read_times(batch), blobs, strict=True))


def decode_streams(batch: Any) -> Iterator[RecordedStream]:
    """Yield the descriptions of one stream."""
    columns = (read_index(batch, paths.SESSION_TIME), read_values(batch, "encoding"), read_values(batch, "info"))
    for at_ns, encoding, info in zip(*columns, strict=True):
        yield RecordedStream(_read_stream(batch), at_ns, encoding, _decode_info(info) if info else None)


def decode_asset_scenes(batch: Any) -> Iterator[RecordedScene]:
    """Yield the scenes of a session."""
    names = ("scene_step", "scene_ns", "hash", "recorded")
    for row in zip(*(read_values(batch, name) for name in names), strict=True):
        scene = RecordedScene(*row)
        if not is_address(scene.hash) or scene.recorded not in RECORD_ASSETS:
            raise ValueError(f"a scene {scene.hash[:80]!r} with the assets {scene.recorded[:80]!r}")
        yield scene


def decode_asset_pieces(batch: Any) -> Iterator[AssetPiece]:
    """Yield pieces of assets."""
    names = ("address", "offset", "total", "is_scene", "data")
    for row in zip(*(read_values(batch, name) for name in names), strict=True):
        yield check_piece(AssetPiece(*row))


def decode_asset_faults(batch: Any) -> Iterator[AssetFault]:
    """Yield assets that could not be recorded."""
    for row in zip(read_values(batch, "address"), read_values(batch, "text"), strict=True):
        yield AssetFault(*row)


def decode_row_times(batch: Any) -> RowTimes:
    """Return the times of rows of the journal, which is much quicker than the rows."""
    is_run, singles, runs = _split_runs(batch)
    step, time = (np.asarray(singles.column(name).cast("int64")) for name in (paths.STEP, paths.SESSION_TIME))
    found: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    at = 0
    for place, run in zip(np.flatnonzero(is_run) - np.arange(runs.num_rows), _read_runs(runs), strict=True):
        found.append((step[at:place], time[at:place]))
        at = place
        with suppress(ValueError):  # its rows are missing
            found.append(read_run_times(run))
    steps, times = (np.concatenate(values) for values in zip(*found, (step[at:], time[at:]), strict=True))
    return RowTimes(steps, times)


def decode_frame_times(batch: Any) -> Iterator[FrameTime]:
    """Yield number and capture of the frames of one stream."""
    batch = _select_frames(batch)
    if not batch.num_rows:
        return iter(())
    columns = (read_values(batch, name) for name in ("seq", "capture_ns"))
    is_cloud = get_entity(batch).startswith(paths.CLOUDS + "/")
    encoding = MediaEncoding.CLOUD if is_cloud else MediaEncoding.JPEG
    return (FrameTime(_read_stream(batch), encoding, *row) for row in zip(*columns, strict=True))


def numbered_denial_decoder() -> Callable[[Any], Iterator[tuple[int, DenialRecord]]]:
    """Return a decoder of denials for batches in order, which numbers those of one step: two may be equal.

    The recorder writes the denials of a step at once, and the first half of Rerun's row id identifies the write. So a
    step continues where Rerun's tools have split its denials, and starts over where another part repeats it.
    """
    place, n = (b"", -1), 0

    def decode(batch: Any) -> Iterator[tuple[int, DenialRecord]]:
        nonlocal place, n
        for record, row in zip(decode_denials(batch), batch.column(ROW_ID).to_pylist(), strict=True):
            at = (row[:_WRITE], record.step)
            place, n = at, n + 1 if at == place else 0
            yield n, record

    return decode


def _msgpack_decoder(column: str, kind: type[_T]) -> Callable[[Any], Iterator[_T]]:
    """Return a decoder of a column with one MessagePack value per row."""
    decode = msgspec.msgpack.Decoder(kind).decode
    return lambda batch: map(decode, read_values(batch, column))


decode_keyframes: Final = _msgpack_decoder("keyframe", Keyframe)
decode_events: Final = _msgpack_decoder("event", Event)
decode_denials: Final = _msgpack_decoder("denial", DenialRecord)
decode_marks: Final = _msgpack_decoder("mark", Mark)
decode_ends: Final = _msgpack_decoder("end", EndMark)


def read_values(batch: Any, column: str) -> list[Any]:
    """Return one value per row of a component column."""
    flat = _flatten(batch, column)
    if len(flat) != batch.num_rows:
        raise ValueError(f"{column} has {len(flat)} values in {batch.num_rows} rows")
    return list(flat.to_pylist())


def read_index(batch: Any, timeline: str) -> list[int]:
    """Return integer values of a timeline (durations in nanoseconds)."""
    return [int(v) for v in np.asarray(batch.column(timeline).cast("int64"))]


def _read_stream(batch: Any) -> str:
    return get_entity(batch).rpartition("/")[2]


def _select_frames(batch: Any) -> Any:
    """Return the rows of a stream that have a frame; the others clear the picture when the stream ends."""
    return _select_rows(batch, "seq")


def _select_rows(batch: Any, column: str) -> Any:
    """Return the rows that have a value in a column."""
    return batch.filter(batch.column(column).is_valid()) if column in batch.schema.names else batch.slice(0, 0)


def _read_times(batch: Any) -> list[list[int]]:
    return [read_values(batch, name) for name in ("seq", "capture_ns", "received_ns")]


def _read_points(row: Any) -> NDArray[np.float32]:
    return np.asarray(row.values.flatten(), np.float32).reshape(-1, 3)


def _read_colors(row: Any) -> NDArray[np.uint8]:
    """Return red, green, blue and alpha, which Rerun has in one number, red in its highest byte."""
    return np.asarray(row.values, ">u4").view(np.uint8).reshape(-1, 4)


def _read_ticks(batch: Any) -> list[int]:
    """Return the ticks of states: a timeline in files of earlier versions."""
    is_data = batch.schema.field("tick").type.num_fields > 0  # a list
    return read_values(batch, "tick") if is_data else read_index(batch, "tick")


def _read_plants(batch: Any) -> list[bytes]:
    """Return the plant state per row, empty where there is none; without any, the column is missing."""
    if "plant" not in batch.schema.names:
        return [b""] * batch.num_rows
    return [value[0] if value else b"" for value in batch.column("plant").to_pylist()]


def _read_lists(batch: Any, column: str) -> Iterator[tuple[Any, ...]]:
    """Yield a tuple per row of a component column."""
    _flatten(batch, column)
    return map(tuple, batch.column(column).to_pylist())


def _flatten(batch: Any, column: str) -> Any:
    """Return all values of a column that must not have nulls."""
    lists = batch.column(column)
    flat = lists.flatten()
    if missing := lists.null_count + flat.null_count:
        raise ValueError(f"{column} has {missing} missing values")
    return flat


# --- rows that Rerun's tools have split -------------------------------------------------------------------------------
#
# `rerun rrd optimize` puts large columns of an entity into chunks of their own, merges chunks, and fills in nulls where
# a merged chunk had no such column; one chunk may hold a row twice then, with something in other columns each time.
# What it keeps is the id of every row, which grows in the order of writing: the parts of one row have one id. As
# measured with rerun-sdk 0.41, the chunks of an entity come in the order of their first rows; so no more is
# held here than the longest chunk and those beside it. In another order parts stay separate, and readers miss the rest
# of their rows.

ROW_ID: Final = "rerun.controls.RowId"
_ENTITY: Final = b"rerun:entity_path"
_KIND: Final = b"rerun:kind"
_DATA: Final = b"data"


def group_spans(batches: Iterable[Any]) -> Iterator[list[Any]]:
    """Group record batches of any entities into spans: all pieces of some rows of one entity.

    Mostly a span is one batch, as it was written. Spans of an entity come in the order of its rows. A batch that
    follows itself counts once: a closed file ends with two copies of the same messages.
    """
    waiting: dict[str, list[Any]] = {}
    for batch in batches:
        if batch.num_rows:
            ordered = _in_order(batch)
            pieces = waiting.setdefault(get_entity(batch), [])
            if pieces and ordered.equals(pieces[-1]):
                continue
            yield from _release_before(pieces, ordered.column(ROW_ID)[0])
            pieces.append(ordered)
    yield from filter(None, waiting.values())


def join_pieces(pieces: list[Any]) -> Any:
    """Join a span into one record batch, null where a row has no value in a column.

    Raises:
        ValueError: Pieces contradict each other in one row: the file was changed.
    """
    import pyarrow as pa  # type: ignore[import-untyped]

    if len(pieces) == 1 and _is_ascending(pieces[0]):  # as a recorder writes them
        return pieces[0]
    ids = _list_row_ids(pieces)
    fields = {field.name: field for piece in pieces for field in piece.schema}
    columns = [
        _join_column(field, ids, [p for p in pieces if field.name in p.schema.names]) for field in fields.values()
    ]
    schema = pa.schema(fields.values(), metadata=pieces[0].schema.metadata)
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def get_entity(batch: Any) -> str:
    """Return the entity path of the rows."""
    return str(batch.schema.metadata[_ENTITY].decode())


def _is_ascending(batch: Any) -> bool:
    import pyarrow.compute as pc  # type: ignore[import-untyped]

    ids = batch.column(ROW_ID)
    return pc.all(pc.less(ids[:-1], ids[1:])).as_py() is not False  # None: too few to compare


def _in_order(batch: Any) -> Any:
    import pyarrow.compute as pc

    return batch if _is_ascending(batch) else batch.take(pc.sort_indices(batch.column(ROW_ID)))


def _release_before(pieces: list[Any], bound: Any) -> Iterator[list[Any]]:
    """Remove the rows before the id `bound` from `pieces` and yield them as a span."""
    import pyarrow.compute as pc

    heads, tails = [], []
    for piece in pieces:
        n = pc.sum(pc.less(piece.column(ROW_ID), bound)).as_py()
        if n:
            heads.append(piece.slice(0, n))
        if n < piece.num_rows:
            tails.append(piece.slice(n))
    pieces[:] = tails
    if heads:
        yield heads


def _list_row_ids(pieces: list[Any]) -> Any:
    """Return the row ids of all pieces, each once, in order."""
    import pyarrow as pa
    import pyarrow.compute as pc

    ids = pc.unique(pa.concat_arrays([piece.column(ROW_ID) for piece in pieces]))
    return ids.take(pc.sort_indices(ids))


def _join_column(field: Any, ids: Any, pieces: list[Any]) -> Any:
    """Return the values of one column for the rows `ids`. `pieces`: those that have the column."""
    import pyarrow as pa
    import pyarrow.compute as pc

    have = pa.concat_arrays([piece.column(ROW_ID) for piece in pieces])
    values = pa.concat_arrays([piece.column(field.name) for piece in pieces])
    if values.null_count:
        have, values = have.filter(values.is_valid()), values.drop_null()
    if have.equals(ids):
        return values
    found = values.take(pc.index_in(ids, value_set=have))
    if len(pc.unique(have)) < len(have):
        # Row ids and times stand in every piece, and must agree; data stand in one.
        is_data = (field.metadata or {}).get(_KIND) == _DATA
        if is_data or not found.take(pc.index_in(have, value_set=ids)).equals(values):
            raise ValueError(f"rows have more than one {field.name}")
    return found
