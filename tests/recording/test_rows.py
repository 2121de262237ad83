"""Rows and their checksums: every change is named."""

from __future__ import annotations

import zlib
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iris_session.journal import rows as journal
from iris_session.journal.rows import (
    JournalRow,
    Keyframe,
    array_header,
    check_fields,
    check_keyframe,
    check_row,
    compute_chain,
    header_root,
    make_row,
    pack_model,
    seal_keyframe,
    unpack_model,
)
from iris_session.protocol.client_messages import Marker
from iris_session.protocol.entries import HOST, Entry, decode_entries, encode_entries
from tests.recording.support import make_entries, make_header

ROOT = b"r" * 16


def a_row(n_entries: int = 3, plant: bytes = b"plant") -> JournalRow:
    entries = (make_entries(5) * 9)[:n_entries]
    return make_row(ROOT, 5, 12_000_000, 1, entries, b"d" * 16, plant)


def changed(row: JournalRow, **fields: Any) -> JournalRow:
    return msgspec.structs.replace(row, **fields)


def test_row_roundtrip() -> None:
    row = a_row()
    assert check_row(ROOT, row) is None
    assert check_fields(row) is None
    assert compute_chain(ROOT, row) == row.chain
    assert decode_entries(row.entries) == (make_entries(5) * 9)[:3]
    assert row.entries == encode_entries((make_entries(5) * 9)[:3])


@pytest.mark.parametrize("n", [0, 1, 15, 16, 70_000])
def test_entries_blob_is_a_messagepack_array(n: int) -> None:
    entry = Entry(HOST, HOST, 1, Marker(1, "m"))
    row = make_row(ROOT, 1, 1, 0, [entry] * n, b"d" * 16)
    assert row.entries == encode_entries([entry] * n)
    assert row.entries.startswith(array_header(n))
    assert check_row(ROOT, row) is None


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("step", 6),
        ("now_ns", 12_000_001),
        ("n_ticks", 2),
        ("digest", b"e" * 16),
        ("plant", b"plans"),
        ("chain", b"c" * 16),
    ],
)
def test_changed_field_is_named(field: str, value: object) -> None:
    problem = check_row(ROOT, changed(a_row(), **{field: value}))
    assert problem is not None
    assert problem.field == field


def test_changed_checksum_is_distinguished_from_changed_field() -> None:
    row = a_row()
    problem = check_row(ROOT, changed(row, field_crcs=(row.field_crcs[0] ^ 1, *row.field_crcs[1:])))
    assert problem is not None
    assert problem.field == "field_crcs"
    crcs = (row.entry_crcs[0], row.entry_crcs[1] ^ 4, row.entry_crcs[2])
    problem = check_row(ROOT, changed(row, entry_crcs=crcs))
    assert problem is not None
    assert (problem.field, problem.entry) == ("entry_crcs", 1)


@given(st.integers(0, 10_000), st.integers(0, 7))
def test_any_flipped_bit_of_the_entries_is_found_at_its_entry(position: int, bit: int) -> None:
    row = a_row(7)
    at = position % len(row.entries)
    blob = bytearray(row.entries)
    blob[at] ^= 1 << bit
    problem = check_row(ROOT, changed(row, entries=bytes(blob)))
    assert problem is not None
    begin = len(row.entries) - sum(row.entry_lengths)
    if at < begin:
        assert problem.entry == -1
        return
    ends = [begin + sum(row.entry_lengths[: i + 1]) for i in range(7)]
    assert problem.entry == next(i for i, end in enumerate(ends) if at < end)
    assert check_fields(changed(row, entries=bytes(blob))) == problem


def test_row_of_another_history_breaks_the_chain() -> None:
    problem = check_row(b"s" * 16, a_row())
    assert problem is not None
    assert problem.field == "chain"
    assert check_fields(a_row()) is None


def test_the_first_chain_value_binds_the_header() -> None:
    header = make_header()
    assert header_root(header) == header_root(make_header())
    assert header_root(msgspec.structs.replace(header, config=b"other")) != header_root(header)


def test_changed_keyframe_is_named() -> None:
    sealed = seal_keyframe(Keyframe(9, b"plant", b"authority", b"controller", b"status"), ROOT)
    assert check_keyframe(sealed) == ""
    for name in ("plant", "authority", "controller", "status"):
        assert check_keyframe(msgspec.structs.replace(sealed, **{name: b"x"})) == name
    assert check_keyframe(msgspec.structs.replace(sealed, step=8)) == "step"
    assert check_keyframe(msgspec.structs.replace(sealed, chain=b"")) == "step"
    assert check_keyframe(Keyframe(9, b"", b"", b"")) == "crcs"


def test_models_are_packed_without_loss() -> None:
    data = bytes(range(256)) * 1000
    assert unpack_model(pack_model(data)) == data
    assert len(pack_model(data)) < len(data) / 10


def test_model_of_a_foreign_recording_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A few kilobytes could unpack to any size."""
    packed = pack_model(bytes(4_000_000))
    assert len(packed) < 10_000
    monkeypatch.setattr(journal, "MAX_MODEL_BYTES", 1_000_000)
    with pytest.raises(zlib.error, match="MiB"):
        unpack_model(packed)
    with pytest.raises(zlib.error):
        unpack_model(packed[:-1])
