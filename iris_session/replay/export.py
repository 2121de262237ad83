"""Export of a recording as tables: CSV, Parquet, or NumPy's npz.

One table per robot and per object, one of commands per robot, one of samples, one of events. Rows are written while the
session is replayed, once for all tables; npz keeps them until the end, since its arrays are written whole. All files
are written into a folder beside the target, and get their places when all of them are complete.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Callable, Sequence
from itertools import repeat
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple, Protocol, Self

import msgspec
import numpy as np

from iris_session.protocol.client_messages import Sample
from iris_session.recording import RecordingError
from iris_session.recording.records import iterate_samples, list_event_records, list_numbers, read_names
from iris_session.replay.plant_reader import CTRL, POSE, PlantReader, Quantity, read_steps
from iris_session.replay.recorded_session import OBJECT, ROBOT, SessionRecording, describe_command
from iris_session.replay.simulation import Replay, ReplayedStep, StepSelector

CSV: Final = "csv"
PARQUET: Final = "parquet"
NPZ: Final = "npz"
FORMATS: Final = (CSV, PARQUET, NPZ)

#: Kinds of tables, in the order of their files.
ROBOTS: Final = "robots"
OBJECTS: Final = "objects"
COMMANDS: Final = "commands"
SAMPLES: Final = "samples"
EVENTS: Final = "events"
TABLES: Final = (ROBOTS, OBJECTS, COMMANDS, SAMPLES, EVENTS)

#: Rows that are written together.
CHUNK_ROWS: Final = 8192
#: Samples between two calls of `progress`.
SAY_ROWS: Final = 20_000
#: Characters of a robot's or object's name in the name of a file.
MAX_STEM: Final = 80
_UNSAFE: Final = re.compile(r"[^A-Za-z0-9_.-]+")

_INT: Final = "int"
_FLOAT: Final = "float"
_BOOL: Final = "bool"
_TEXT: Final = ""
_DTYPES: Final[dict[str, Any]] = {_INT: np.int64, _FLOAT: np.float64, _BOOL: np.bool_}


class ExportError(RecordingError):
    """The tables cannot be written to the given place."""


class ExportedTable(msgspec.Struct, frozen=True):
    """A table that was written. `kind`: one of `TABLES`; `name`: of the robot or object, empty without one."""

    kind: str
    name: str
    file: str
    rows: int
    columns: int


class ExportReport(msgspec.Struct, frozen=True):
    """Result of an export. `left_out`: first and last step of each range that is missing or damaged."""

    folder: str
    format: str
    tables: tuple[ExportedTable, ...]
    left_out: tuple[tuple[int, int], ...]
    damage: tuple[str, ...]


class Column(NamedTuple):
    """A column, or several that are one array of an npz file. `names`: those of several, in the order of the array.

    `kind`: of its values, empty for texts.
    """

    key: str
    kind: str
    names: tuple[str, ...] = ()

    def list_names(self) -> list[str]:
        """Return the name of each column in a file of columns."""
        return [f"{self.key}/{name}" for name in self.names] if self.names else [self.key]


_HEAD: Final = (Column("step", _INT), Column("session_time_ns", _INT), Column("sim_time_s", _FLOAT))
_COMMAND: Final = (
    *(Column(key, _TEXT) for key in ("kind", "hold_reason", "participant", "participant_name", "device")),
    *(Column("gripper", _FLOAT), Column("scale", _FLOAT)),
)
_SAMPLE: Final = (
    *(Column(key, _INT) for key in ("session_time_ns", "capture_ns", "seq", "buttons", "tracking_epoch")),
    *(Column(key, _TEXT) for key in ("participant", "participant_name", "device", "kind", "targets")),
    *(Column(key, _BOOL) for key in ("tracked", "worn", "clutch")),
    *(Column("gripper", _FLOAT), Column("pose", _FLOAT, POSE)),
    Column("twist", _FLOAT, ("vx", "vy", "vz", "wx", "wy", "wz")),
)
_EVENT: Final = (
    *(Column(key, _INT) for key in ("event_seq", "session_time_ns")),
    *(Column(key, _TEXT) for key in ("event", "fields")),
)


class _Sink(Protocol):
    """A file that takes columns of rows: an array per column, or a list of texts."""

    def write(self, columns: Sequence[Any]) -> None: ...

    def close(self) -> None: ...


class _ArrowSink:
    """CSV or Parquet, written chunk by chunk."""

    def __init__(self, path: Path, columns: Sequence[Column], *, is_csv: bool) -> None:
        import pyarrow as pa  # type: ignore[import-untyped]

        self._pa, self._columns = pa, columns
        types = {_INT: pa.int64(), _FLOAT: pa.float64(), _BOOL: pa.bool_(), _TEXT: pa.string()}
        self._schema = pa.schema([(name, types[one.kind]) for one in columns for name in one.list_names()])
        if is_csv:
            from pyarrow import csv

            self._writer = csv.CSVWriter(
                str(path), self._schema, write_options=csv.WriteOptions(quoting_style="needed")
            )
        else:
            from pyarrow import parquet

            self._writer = parquet.ParquetWriter(str(path), self._schema)

    def write(self, columns: Sequence[Any]) -> None:
        flat: list[Any] = []
        for column, values in zip(self._columns, columns, strict=True):
            flat += [values[:, i] for i in range(len(column.names))] if column.names else [values]
        arrays = [self._pa.array(values, field.type) for values, field in zip(flat, self._schema, strict=True)]
        self._writer.write_batch(self._pa.record_batch(arrays, schema=self._schema))

    def close(self) -> None:
        self._writer.close()


class _NpzSink:
    """Arrays by key, and the names of their columns as `KEY_names`."""

    def __init__(self, path: Path, columns: Sequence[Column]) -> None:
        self._path, self._columns = path, columns
        self._chunks: list[list[Any]] = [[] for _ in columns]

    def write(self, columns: Sequence[Any]) -> None:
        for chunks, values in zip(self._chunks, columns, strict=True):
            chunks.append(values if isinstance(values, np.ndarray) else np.array(values, np.str_))

    def close(self) -> None:
        arrays: dict[str, Any] = {}
        for column, chunks in zip(self._columns, self._chunks, strict=True):
            arrays[column.key] = np.concatenate(chunks)
            if column.names:
                arrays[f"{column.key}_names"] = np.array(column.names, np.str_)
        with self._path.open("wb") as file:
            np.savez_compressed(file, **arrays)


class _Table:
    """Rows of one table on their way into its file."""

    def __init__(self, kind: str, name: str, path: Path, to: str, columns: Sequence[Column]) -> None:
        self.kind, self.name, self.path, self.columns = kind, name, path, tuple(columns)
        self.rows = 0
        self._sink: _Sink = _NpzSink(path, columns) if to == NPZ else _ArrowSink(path, columns, is_csv=to == CSV)
        self._rows: list[Sequence[Any]] = []

    def add(self, values: Sequence[Any]) -> None:
        """Add a row: a value per column, a sequence for a column with names."""
        self.rows += 1
        self._rows.append(values)
        if len(self._rows) == CHUNK_ROWS:
            self._flush()

    def _flush(self) -> None:
        columns = []
        for column, values in zip(
            self.columns, zip(*self._rows, strict=True) if self._rows else repeat(()), strict=False
        ):
            shape = (len(self._rows), len(column.names)) if column.names else -1
            columns.append(np.array(values, _DTYPES[column.kind]).reshape(shape) if column.kind else list(values))
        self._sink.write(columns)
        self._rows.clear()

    def close(self) -> ExportedTable:
        """Write the rest, and finish the file."""
        if self._rows or not self.rows:
            self._flush()
        self._sink.close()
        n = sum(len(column.list_names()) for column in self.columns)
        return ExportedTable(self.kind, self.name, self.path.name, self.rows, n)


class ExportOptions(NamedTuple):
    """Options of an export.

    `hz`: rate of rows of robots, objects and commands [1/s]; None for every step. `tables`: kinds of tables. `robots`,
    `objects`: names; empty: all. `force`: replace files that are there.
    """

    hz: float | None = 100.0
    tables: tuple[str, ...] = TABLES
    robots: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    force: bool = False


def export_recording(
    recording: SessionRecording,
    folder: Path,
    to: str,
    options: ExportOptions | None = None,
    progress: Callable[[str], None] | None = None,
) -> ExportReport:
    """Write the content of a recording as tables into a folder.

    Args:
        recording: An open recording.
        folder: Is made if it does not exist. It must be empty, unless files in it may be replaced.
        to: `csv`, `parquet` or `npz`.
        options: What is written; None for everything at 100 rows a second.
        progress: Called now and then with a text that says how far it is.

    Returns:
        The tables that were written.

    Raises:
        ExportError: The folder is not empty, or cannot be written to.
        UnknownNameError: A robot or object of `options` does not exist.
        ReplayError: A step gives another result here than in the recording.
        ValueError: A format, table or rate that there is not.
    """
    options, say = options or ExportOptions(), progress or (lambda text: None)
    if to not in FORMATS or not set(options.tables) <= set(TABLES):
        raise ValueError(f"{to!r} with tables {options.tables}: give one of {FORMATS}, and some of {TABLES}")
    selector = StepSelector(options.hz, recording.header.tick_period_ns)
    for name in options.robots:
        recording.robot(name)
    for name in options.objects:
        recording.object(name)
    try:
        with _Staging(folder, to, force=options.force) as staging:
            left_out = _write_steps(recording, staging, options, selector, say)
            if SAMPLES in options.tables:
                _write_samples(recording, staging, say)
            if EVENTS in options.tables:
                _write_events(recording, staging)
            tables = staging.commit()
    except OSError as error:  # pyarrow's errors of files are of this class too
        raise ExportError(
            f"the tables cannot be written to {folder}: {' '.join((error.strerror or str(error)).split())}"
        ) from error
    damage = (*recording.missing, *recording.damage)
    return ExportReport(str(folder), to, tables, tuple(left_out), damage)


class _Staging:
    """Tables in a temporary folder beside the target; nothing is left of them unless `commit` was reached."""

    def __init__(self, folder: Path, to: str, *, force: bool) -> None:
        self._folder, self._to, self._force = folder, to, force
        self._tables: list[_Table] = []
        self._stems: set[str] = set()

    def __enter__(self) -> Self:
        if self._folder.exists():
            if not self._folder.is_dir():
                raise ExportError(f"{self._folder} is no folder: give one that is empty or does not exist")
            if not self._force and any(self._folder.iterdir()):
                raise ExportError(f"the folder {self._folder} is not empty: give another one, or --force")
        self._folder.parent.mkdir(parents=True, exist_ok=True)
        self._temporary = Path(tempfile.mkdtemp(prefix=f".{self._folder.name[:100]}-", dir=self._folder.parent))
        return self

    def make_table(self, kind: str, name: str, columns: Sequence[Column]) -> _Table:
        """Begin a table. Names of robots and objects may hold anything, so files get printable ones, each once."""
        short = {ROBOTS: ROBOT, OBJECTS: OBJECT}.get(kind, kind)
        stem = unique = f"{short}-{_UNSAFE.sub('_', name)[:MAX_STEM]}" if name else short
        number = 1
        while unique.lower() in self._stems:  # some file systems do not tell cases apart
            number += 1
            unique = f"{stem}~{number}"
        self._stems.add(unique.lower())
        table = _Table(kind, name, self._temporary / f"{unique}.{self._to}", self._to, columns)
        self._tables.append(table)
        return table

    def commit(self) -> tuple[ExportedTable, ...]:
        """Finish all files and move them to their places."""
        done = [table.close() for table in self._tables]
        self._folder.mkdir(exist_ok=True)
        for one in done:
            os.replace(self._temporary / one.file, self._folder / one.file)
        order = {kind: i for i, kind in enumerate(TABLES)}
        return tuple(sorted(done, key=lambda one: (order[one.kind], one.file)))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        shutil.rmtree(self._temporary, ignore_errors=True)


# --- robots, objects, commands ----------------------------------------------------------------------------------------


def _write_steps(
    recording: SessionRecording,
    staging: _Staging,
    options: ExportOptions,
    selector: StepSelector,
    say: Callable[[str], None],
) -> Sequence[tuple[int, int]]:
    """Replay the session into the tables of robots, objects and commands. Return what was left out."""
    if not {ROBOTS, OBJECTS, COMMANDS} & set(options.tables):
        return ()
    replay = Replay(
        recording,
        with_control=COMMANDS in options.tables,
        progress=lambda done, total: say(f"step {done} of {total}" if total else f"step {done}"),
    )
    writer = _StepWriter(staging, options, read_names(recording))
    for step, reader in read_steps(replay, selector):
        writer.add(step, reader)
    return replay.left_out


class _StepWriter:
    """Writes the rows of replayed steps. A table has the columns of the first scene in which its robot is."""

    def __init__(self, staging: _Staging, options: ExportOptions, people: dict[str, str]) -> None:
        self._staging, self._options, self._people = staging, options, people
        self._tables: dict[tuple[str, str], _Table] = {}

    def add(self, step: ReplayedStep, reader: PlantReader) -> None:
        """Add the rows of one step."""
        options = self._options
        head = (step.step, step.session_time, reader.world.view().sim_time)
        robots = [name for name in reader.robots if not options.robots or name in options.robots]
        for name in robots if ROBOTS in options.tables else ():
            self._add_row(ROBOTS, name, head, reader.robots[name])
        if OBJECTS in options.tables:
            for name, quantities in reader.objects.items():
                if not options.objects or name in options.objects:
                    self._add_row(OBJECTS, name, head, quantities)
        for name in robots if COMMANDS in options.tables else ():
            self._add_row(COMMANDS, name, (*head, *self._describe(step, name)), {CTRL: reader.ctrl[name]}, _COMMAND)

    def _add_row(
        self, kind: str, name: str, head: tuple[Any, ...], quantities: dict[str, Quantity], more: Sequence[Column] = ()
    ) -> None:
        columns = (*_HEAD, *more, *(Column(key, _FLOAT, one.names) for key, one in quantities.items()))
        table = self._tables.get((kind, name))
        if table is None:
            table = self._tables[kind, name] = self._staging.make_table(kind, name, columns)
        if table.columns == columns:
            table.add((*head, *(one.read() for one in quantities.values())))

    def _describe(self, step: ReplayedStep, robot: str) -> tuple[Any, ...]:
        """Return the values of `_COMMAND`."""
        kind, reason, participants, devices, gripper, scale = describe_command(step, robot)
        names = ", ".join(self._people.get(one, "") for one in participants.split(",") if one)
        return kind, reason, participants, names, devices, gripper, scale


# --- samples, events --------------------------------------------------------------------------------------------------


def _write_samples(recording: SessionRecording, staging: _Staging, say: Callable[[str], None]) -> None:
    """Write all raw samples; joints of a leader as far as the longest sample, those of hands not at all."""
    n_joints = max((len(one.sample.q) for one in iterate_samples(recording)), default=0)
    joints = (Column("q", _FLOAT, tuple(map(str, range(n_joints)))),) if n_joints else ()
    table = staging.make_table(SAMPLES, "", (*_SAMPLE, *joints))
    for one in iterate_samples(recording):
        sample: Sample = one.sample
        gripper, *numbers = list_numbers(sample)
        row = (
            *(one.receive_ns, sample.capture_ns, sample.seq, sample.buttons, sample.tracking_epoch),
            *(one.participant, one.name, sample.device, sample.kind, " ".join(t.name for t in sample.targets)),
            *(sample.tracked, sample.worn, sample.clutch, gripper, numbers[:7], numbers[7:]),
        )
        q = [*sample.q, *(np.nan,) * (n_joints - len(sample.q))]
        table.add((*row, q) if joints else row)
        if table.rows % SAY_ROWS == 0:
            say(f"sample {table.rows}")


def _write_events(recording: SessionRecording, staging: _Staging) -> None:
    """Write the events. Every kind has other fields, so these are one column, as JSON."""
    table = staging.make_table(EVENTS, "", _EVENT)
    head = ("event_seq", "session_time_ns", "event")
    for record in list_event_records(recording):
        fields = {key: value for key, value in record.items() if key not in (*head, "time_s")}
        table.add((*(record[key] for key in head), msgspec.json.encode(fields).decode()))
