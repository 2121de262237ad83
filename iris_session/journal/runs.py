"""Runs of quiet rows: consecutive rows of a session at rest, packed for the file without loss. Pure.

A run holds what its rows differ in: the times of their steps, and what they keep of their digests. The rest follows:
steps are consecutive, `n_ticks` is the same in all, checksums and chain are computed again as `make_row` did.

    CRC-32 of all that follows, first step, first `now_ns`, median difference of times, `n_ticks`, number of rows,
    chain of the first row, chain of the last row; digests; byte planes of the differences of times, zlib

A run is checked as a whole: a changed byte in it costs its rows, at most `MAX_RUN_ROWS`, and no others.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.journal.rows import HASH_BYTES, QUIET_DIGEST_BYTES, JournalRow, is_quiet, make_row

#: Rows of a run, half a second at 500 Hz: what a changed byte costs.
MAX_RUN_ROWS: Final = 250
_CRC_BYTES: Final = 4
_HEAD: Final = struct.Struct(f"<qqqqH{HASH_BYTES}s{HASH_BYTES}s")
_TIME_BYTES: Final = 8
_DIGESTS_AT: Final = _CRC_BYTES + _HEAD.size
_MIN_BYTES: Final = _DIGESTS_AT + QUIET_DIGEST_BYTES
#: With as many bytes more as zlib needs for times that it cannot compress, and not many more.
_MAX_BYTES: Final = _MIN_BYTES + MAX_RUN_ROWS * (QUIET_DIGEST_BYTES + _TIME_BYTES + 1)
#: Steps above would not fit into 64 bits.
_MAX_STEP: Final = 1 << 62


class _Head(NamedTuple):
    step: int
    now_ns: int
    period_ns: int
    n_ticks: int
    n_rows: int
    first_chain: bytes
    last_chain: bytes


def split_runs(rows: Iterable[JournalRow]) -> Iterator[list[JournalRow]]:
    """Yield rows in lists: those that make a run together, and every other row alone."""
    run: list[JournalRow] = []
    for row in rows:
        if run and not (
            is_quiet(row)
            and is_quiet(run[-1])
            and (row.step, row.n_ticks) == (run[-1].step + 1, run[-1].n_ticks)
            and len(run) < MAX_RUN_ROWS
        ):
            yield run
            run = []
        run.append(row)
    if run:
        yield run


def pack_run(rows: Sequence[JournalRow]) -> bytes:
    """Pack rows of `split_runs`.

    Returns:
        The run; empty if the rows are not quiet, or would not come out of it as they are: then store them one by one.
    """
    if not all(map(is_quiet, rows)):
        return b""
    first, last = rows[0], rows[-1]
    times = np.array([row.now_ns for row in rows], np.int64)
    differences = times[1:] - times[:-1]
    period = int(np.sort(differences)[len(differences) // 2]) if len(differences) else 0
    head = _HEAD.pack(first.step, first.now_ns, period, first.n_ticks, len(rows), first.chain, last.chain)
    deviations = differences - period
    zigzag = (deviations << 1) ^ (deviations >> 63)  # small numbers, whatever their sign: high planes are all zero
    planes = zigzag.astype("<i8").view(np.uint8).reshape(-1, _TIME_BYTES).T.tobytes()
    body = b"".join((head, *(row.digest for row in rows), zlib.compress(planes, 9)))
    run = zlib.crc32(body).to_bytes(_CRC_BYTES, "little") + body
    try:
        return run if unpack_run(run) == list(rows) else b""
    except ValueError:
        return b""


def unpack_run(run: bytes) -> list[JournalRow]:
    """Return the rows of a run.

    Raises:
        ValueError: Bytes of it were changed, or it was not made by `pack_run`.
    """
    head = _read_head(run)
    rows: list[JournalRow] = []
    for i, (step, now_ns) in enumerate(zip(*(values.tolist() for values in read_run_times(run)), strict=True)):
        at = _DIGESTS_AT + i * QUIET_DIGEST_BYTES
        before = rows[-1].chain if rows else b""
        row = make_row(before, step, now_ns, head.n_ticks, (), run[at : at + QUIET_DIGEST_BYTES])
        # The chain of the first row is the one that was written: it depends on the row before the run.
        rows.append(row if rows else msgspec.structs.replace(row, chain=head.first_chain))
    if rows[-1].chain != head.last_chain:
        raise ValueError("the chain of a run of rows does not reach its end")
    return rows


def read_run_times(run: bytes) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return steps and session times [ns] of the rows of a run, int64, shape (n,), which is quicker than the rows.

    Raises:
        ValueError: Bytes of the run were changed, or it was not made by `pack_run`.
    """
    head = _read_head(run)
    n_bytes = (head.n_rows - 1) * _TIME_BYTES
    decompressor = zlib.decompressobj()
    try:
        planes = decompressor.decompress(run[_DIGESTS_AT + head.n_rows * QUIET_DIGEST_BYTES :], n_bytes + 1)
    except zlib.error as error:
        raise ValueError(f"the times of a run of rows cannot be unpacked: {error}") from error
    if len(planes) != n_bytes or not decompressor.eof or decompressor.unused_data:
        raise ValueError(f"a run of {head.n_rows} rows does not have {n_bytes} bytes of times")
    zigzag = np.frombuffer(planes, np.uint8).reshape(_TIME_BYTES, -1).T.copy().view("<u8").ravel()
    deviations = (zigzag >> np.uint64(1)).astype(np.int64) ^ -(zigzag & np.uint64(1)).astype(np.int64)
    times = np.cumsum(np.concatenate(([head.now_ns], deviations + head.period_ns)), dtype=np.int64)
    return np.arange(head.step, head.step + head.n_rows, dtype=np.int64), times


def _read_head(run: bytes) -> _Head:
    if not _MIN_BYTES <= len(run) <= _MAX_BYTES:
        raise ValueError(f"a run of rows with {len(run)} bytes, expected {_MIN_BYTES} to {_MAX_BYTES}")
    if zlib.crc32(memoryview(run)[_CRC_BYTES:]).to_bytes(_CRC_BYTES, "little") != run[:_CRC_BYTES]:
        raise ValueError("a run of rows was changed (checksum)")
    head = _Head(*_HEAD.unpack_from(run, _CRC_BYTES))
    if not (1 <= head.n_rows <= MAX_RUN_ROWS and 0 <= head.step <= _MAX_STEP):
        raise ValueError(f"a run of {head.n_rows} rows from step {head.step}")
    return head
