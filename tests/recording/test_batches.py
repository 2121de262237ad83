"""Rows that were split into columns are joined again; contradictions are errors."""

from __future__ import annotations

import random
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pyarrow as pa
import pytest

from iris_session.rrd.batches import ROW_ID, group_spans, join_pieces

COLUMNS = ("a", "b", "c")


def table(first: int, rows: int, columns: tuple[str, ...] = COLUMNS, entity: str = "/rows") -> Any:
    """Return rows from `first`, as Rerun has them: an id, a time, and a list in every column."""
    fields = [pa.field(ROW_ID, pa.binary(16), nullable=False, metadata={"rerun:kind": "control"})]
    fields.append(pa.field("step", pa.int64(), metadata={"rerun:kind": "index"}))
    fields += [pa.field(name, pa.list_(pa.binary()), metadata={"rerun:kind": "data"}) for name in columns]
    numbers = range(first, first + rows)
    arrays = [pa.array([n.to_bytes(16, "big") for n in numbers], pa.binary(16)), pa.array(numbers, pa.int64())]
    arrays += [pa.array([[f"{name}{n}".encode()] for n in numbers], pa.list_(pa.binary())) for name in columns]
    return pa.RecordBatch.from_arrays(arrays, schema=pa.schema(fields, metadata={"rerun:entity_path": entity}))


def values(batches: list[Any]) -> dict[str, list[Any]]:
    return {name: [v for b in batches for v in b.column(name).to_pylist()] for name in (ROW_ID, "step", *COLUMNS)}


def test_rows_as_they_were_written_stay_as_they_are() -> None:
    written = [table(0, 5), table(5, 1), table(6, 3)]
    assert [join_pieces(pieces) for pieces in group_spans(written)] == written


@pytest.mark.parametrize("seed", range(6))
def test_columns_cut_at_any_place_are_joined(seed: int) -> None:
    rng = random.Random(seed)
    groups = rng.choice([[("a",), ("b", "c")], [("a",), ("b",), ("c",)], [("c", "a"), ("b",)]])
    batches = []
    for group in groups:
        cuts = [0, *sorted(rng.sample(range(1, 100), rng.randrange(8))), 100]
        batches += [table(a, b - a, group) for a, b in pairwise(cuts)]
    batches.sort(key=lambda batch: (batch.column("step")[0].as_py(), rng.random()))
    assert values([join_pieces(pieces) for pieces in group_spans(batches)]) == values([table(0, 100)])


def test_pending_rows_are_bounded_by_interleaving() -> None:
    taken = 0

    def thick_and_thin() -> Iterator[Any]:
        nonlocal taken
        for first in range(0, 1000, 10):
            if first % 200 == 0:
                yield table(first, 200, ("b", "c"))
            taken += 1
            yield table(first, 10, ("a",))

    for n, pieces in enumerate(group_spans(thick_and_thin())):
        assert join_pieces(pieces).num_rows == 10
        assert taken <= n + 2


def test_rows_without_a_column_have_null_in_it() -> None:
    first, second = table(0, 4), table(4, 2, ("b", "c"))
    batch = join_pieces([first, second])
    assert batch.column("a").to_pylist() == [[b"a0"], [b"a1"], [b"a2"], [b"a3"], None, None]
    assert batch.column("b").null_count == 0


def test_rows_out_of_order_within_a_batch_are_sorted() -> None:
    mixed = table(0, 6, ("a", "c")).take(pa.array([3, 1, 0, 5, 4, 2]))
    found = list(group_spans([mixed, table(0, 3, ("b",)), table(3, 3, ("b",))]))
    assert values(list(map(join_pieces, found))) == values([table(0, 6)])


def test_two_values_of_one_row_are_an_error() -> None:
    with pytest.raises(ValueError, match="more than one b"):
        join_pieces([table(0, 3, ("a", "b")), table(0, 3, ("b", "c"))])
