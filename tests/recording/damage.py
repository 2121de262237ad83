"""Damage of a small recording, and what `repair` must make of it."""

from __future__ import annotations

import random
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from iris_session.recording import NotARecordingError, Recording
from iris_session.recording.repair import repair
from iris_session.recording.summary import summarise
from iris_session.rrd import paths
from iris_session.rrd.file import KIND_END, KIND_STORE_INFO, RrdMessage, read_message, scan_file
from iris_session.rrd.rerun_tool import INDEX, find_rerun, rewrite
from tests.recording.support import journal, write

HEAD_BYTES = 16  # of a message
STEPS = 60


class Original(NamedTuple):
    """A whole file. `unmarked`: messages without the recorder's checksums. `n_header`: messages up to its header."""

    path: Path
    messages: list[RrdMessage]
    unmarked: frozenset[bytes]
    n_header: int

    @property
    def begin(self) -> int:
        """Offset of the first message behind the file's own head, and those that say what is stored in it."""
        return next(m.offset for m in self.messages if m.kind != KIND_STORE_INFO)


def make_original(folder: Path) -> Original:
    """Write the file into `folder`."""
    path = write(folder / "session.rrd", *journal(STEPS), rows_per_chunk=6)
    with open(folder / "unmarked.rrd", "wb") as file:
        rewrite(INDEX, [str(path)], file, options=("--drop-entity", paths.MARKS))
    unmarked = frozenset(list_messages(folder / "unmarked.rrd"))
    return Original(path, scan_file(path).messages, unmarked, _count_header_messages(path, folder))


def _count_header_messages(path: Path, folder: Path) -> int:
    cut = folder / "cut.rrd"
    for n, message in enumerate(scan_file(path).messages):
        cut.write_bytes(path.read_bytes()[: message.offset])
        with suppress(NotARecordingError), Recording.open(cut):
            return n
    raise AssertionError("no header")


def list_messages(path: Path) -> list[bytes]:
    """Return the messages of a file but the last, which ends it."""
    with open(path, "rb") as file:
        return [read_message(file, m) for m in scan_file(path).messages if m.kind != KIND_END]


def has_index(path: Path) -> bool:
    """Return whether Rerun finds the index of a file."""
    done = subprocess.run([find_rerun(), "rrd", "verify", path], capture_output=True, check=False)
    return done.returncode == 0


def check_repair(original: Original, damaged: bytes, fault: int, folder: Path) -> str:
    """Repair a file with a fault in byte `fault`; return what became of it: `whole`, `damaged` or `none`."""
    path, output = folder / "damaged.rrd", folder / "repaired.rrd"
    path.write_bytes(damaged)
    n_before = sum(m.offset + HEAD_BYTES + m.length <= fault and m.kind != KIND_END for m in original.messages)
    expected = list_messages(original.path)[:n_before]
    is_cut = len(damaged) == fault
    if n_before < original.n_header if is_cut else fault < original.begin:
        with suppress(NotARecordingError):  # without a header it is no recording
            repair(path, output, overwrite=True)
        return "none"
    report = repair(path, output, overwrite=True)
    assert path.read_bytes() == damaged
    assert scan_file(output).indexed
    # A changed name of a component decodes, and is kept and reported, though Rerun does not know it.
    assert has_index(output) or report.damage, f"byte {fault}"
    kept = list_messages(output)
    if report.damage:
        expected = [data for data in expected if data in original.unmarked]
        kept = [data for data in kept if data in set(expected)]
    assert kept[: len(expected)] == expected, f"byte {fault}"
    with Recording.open(path, warn=False) as recording:
        summary = summarise(recording)
    assert summary.ok == report.ok, f"byte {fault}"
    assert set(report.damage) == set(summary.damage)
    return "whole" if report.ok else "damaged"


def check_cut(original: Original, n_bytes: int, folder: Path) -> str:
    """Cut the file after `n_bytes`, repair it, and return what became of it."""
    return check_repair(original, original.path.read_bytes()[:n_bytes], n_bytes, folder)


def flip_bits(original: Original, folder: Path, n: int, seed: int) -> Iterator[str]:
    """Flip one bit of the file `n` times; yield what became of each."""
    data, rng = original.path.read_bytes(), random.Random(seed)
    for _ in range(n):
        at = rng.randrange(len(data))
        damaged = bytearray(data)
        damaged[at] ^= 1 << rng.randrange(8)
        yield check_repair(original, bytes(damaged), at, folder)
