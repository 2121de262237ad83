"""Compare what Rerun's dataframes have of a recording with the rows of the file, one by one.

To Rerun, an empty list is no value, and clearing an entity is none either: both are left out. Equal values at one time
count once: the last mark of a closed file is written twice.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import rerun as rr

from iris_session.rrd import paths
from iris_session.rrd.file import read_chunks

_TIMELINES = (paths.STEP, paths.SIM_TIME, paths.SESSION_TIME, paths.WALL_TIME)
_NO_VALUES = ("rerun.controls.RowId", "Clear:is_recursive")


def compare_dataframes(path: Path) -> tuple[int, list[str]]:
    """Compare every value at a time in a file with the dataframe of its entity.

    Returns:
        The number of values, and a line for each component of an entity whose values differ.
    """
    n, problems = 0, []
    with rr.server.Server(host="127.0.0.1", datasets={"session": [str(path)]}) as server:
        dataset = server.client().get_dataset("session")
        for (entity, timeline), tables in _read_tables(path).items():
            frame = dataset.filter_contents(entity).reader(index=timeline).to_arrow_table()
            for component in sorted({name for table in tables for name in table.schema.names}):
                if component in _TIMELINES or component in _NO_VALUES:
                    continue
                written = {row for table in tables for row in _list_values(table, component, timeline)}
                shown = set(_list_values(frame, f"{entity}:{component}", timeline))
                n += len(written)
                if shown != written:
                    text = f"of {len(written)} values {len(written - shown)} are missing, {len(shown - written)} differ"
                    problems.append(f"{entity}, {component}: {text}")
    return n, problems


def _read_tables(path: Path) -> dict[tuple[str, str], list[Any]]:
    """Return the rows of the chunks of every entity with its timeline: some have steps only. Nothing that is static."""
    found: dict[tuple[str, str], list[Any]] = {}
    for chunk in read_chunks(path, "/**"):
        if not chunk.is_static:
            table = pa.Table.from_batches([chunk.to_record_batch()])
            timeline = paths.SESSION_TIME if paths.SESSION_TIME in table.schema.names else paths.STEP
            found.setdefault((str(chunk.entity_path), timeline), []).append(table)
    return found


def _list_values(table: Any, name: str, timeline: str) -> Iterator[tuple[int, str]]:
    """Yield time and value of every row that has one. As text: NaN equals itself."""
    if name not in table.schema.names:
        return
    taken = table.filter(pc.is_valid(table[name]))
    for time, value in zip(taken[timeline].cast(pa.int64()).to_pylist(), taken[name].to_pylist(), strict=True):
        if value != []:
            yield time, repr(value)
