"""Rows of an entity, whole again where Rerun's tools have split them. Pure; works on Arrow record batches.

`rerun rrd optimize` puts large columns of an entity into chunks of their own, merges chunks, and fills in nulls where a
merged chunk had no such column; one chunk may hold a row twice then, with something in other columns each time. What it
keeps is the id of every row, which grows in the order of writing: the parts of one row have one id. As measured with
rerun-sdk 0.41, the chunks of an entity come in the order of their first rows; so what waits here is no more than the
longest chunk and those beside it. Where they come otherwise, parts stay apart, and whoever reads them misses the rest
of their rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final

ROW_ID: Final = "rerun.controls.RowId"
_ENTITY: Final = b"rerun:entity_path"
_KIND: Final = b"rerun:kind"
_DATA: Final = b"data"


def group_spans(batches: Iterable[Any]) -> Iterator[list[Any]]:
    """Record batches, of any entities, as pieces that belong together: all there is of some rows of one entity.

    Mostly that is one batch, as it was written. Spans of an entity come in the order of its rows.
    """
    waiting: dict[str, list[Any]] = {}
    for batch in batches:
        if batch.num_rows:
            ordered = _in_order(batch)
            pieces = waiting.setdefault(get_entity(batch), [])
            yield from _released(pieces, ordered.column(ROW_ID)[0])
            pieces.append(ordered)
    yield from filter(None, waiting.values())


def join_pieces(pieces: list[Any]) -> Any:
    """One record batch of all rows of a span, null where a row has nothing in a column.

    Raises `ValueError` where pieces say different things of one row: then the file was changed.
    """
    import pyarrow as pa  # type: ignore[import-untyped]

    if _is_whole(pieces):
        return pieces[0]
    ids = _ids(pieces)
    fields = {field.name: field for piece in pieces for field in piece.schema}
    columns = [_column(field, ids, [p for p in pieces if field.name in p.schema.names]) for field in fields.values()]
    schema = pa.schema(fields.values(), metadata=pieces[0].schema.metadata)
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def count_joined_rows(pieces: list[Any]) -> int:
    """How many rows `join` would give."""
    return pieces[0].num_rows if _is_whole(pieces) else len(_ids(pieces))


def get_entity(batch: Any) -> str:
    """Path of the entity that the rows are of."""
    return str(batch.schema.metadata[_ENTITY].decode())


def _is_whole(pieces: list[Any]) -> bool:
    """Whether it is one piece with every row in it once, as a recorder writes them."""
    return len(pieces) == 1 and _ascends(pieces[0])


def _ascends(batch: Any) -> bool:
    import pyarrow.compute as pc  # type: ignore[import-untyped]

    ids = batch.column(ROW_ID)
    return pc.all(pc.less(ids[:-1], ids[1:])).as_py() is not False  # None: too few to compare


def _in_order(batch: Any) -> Any:
    import pyarrow.compute as pc

    return batch if _ascends(batch) else batch.take(pc.sort_indices(batch.column(ROW_ID)))


def _released(pieces: list[Any], bound: Any) -> Iterator[list[Any]]:
    """Takes the rows before the id `bound` out of `pieces`."""
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


def _ids(pieces: list[Any]) -> Any:
    """The row ids of all pieces, each once, in order."""
    import pyarrow as pa
    import pyarrow.compute as pc

    ids = pc.unique(pa.concat_arrays([piece.column(ROW_ID) for piece in pieces]))
    return ids.take(pc.sort_indices(ids))


def _column(field: Any, ids: Any, pieces: list[Any]) -> Any:
    """The values of one column for the rows `ids`. `pieces`: those that have it."""
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
