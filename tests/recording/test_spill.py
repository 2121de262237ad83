"""The spill file: order, bound, and a disk that refuses."""

from __future__ import annotations

import os
import random
from pathlib import Path

import pytest

from iris_session.recording.feed import SpillFile


def test_spill_is_first_in_first_out_and_removed_when_empty(tmp_path: Path) -> None:
    spill = SpillFile(tmp_path / "s", 1 << 20)
    assert spill.pop() is None
    for round_ in range(3):
        for i in range(20):
            assert spill.push(bytes([i]) * (i + 1), i)
        assert len(spill) == 20
        assert not any(tmp_path.iterdir()), "a killed session would leave it behind"
        for i in range(20):
            assert spill.pop() == (bytes([i]) * (i + 1), i), round_
        assert spill.rows == 0


def test_symbolic_link_is_not_followed(tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    theirs.write_bytes(b"precious")
    (tmp_path / "s").symlink_to(theirs)
    spill = SpillFile(tmp_path / "s", 1000)
    assert spill.push(b"x", 1)
    assert theirs.read_bytes() == b"precious"
    spill.close()


def test_full_spill_refuses_rows(tmp_path: Path) -> None:
    spill = SpillFile(tmp_path / "s", 100)
    assert spill.push(b"x" * 60, 10)
    assert not spill.push(b"x" * 60, 10)
    assert "limit" in spill.fault
    assert spill.pop() == (b"x" * 60, 10)
    assert spill.push(b"y" * 60, 10), "an emptied file begins anew"
    spill.close()


def test_limit_is_on_pending_bytes(tmp_path: Path) -> None:
    """A queue that is never empty goes round in its file; sizes and order are those of a plain queue."""
    spill, rng, plain, most = SpillFile(tmp_path / "s", 1000), random.Random(1), [], 0
    for i in range(3000):
        data = bytes([i % 256]) * rng.randrange(1, 120)
        if spill.push(data, i, 2):
            plain.append((data, i))
        while len(plain) > rng.randrange(2, 12):
            assert spill.pop() == plain.pop(0)
        assert (len(spill), spill.rows, spill.others) == (len(plain), sum(n for _, n in plain), 2 * len(plain))
        assert spill.pending_bytes == sum(len(d) + 12 for d, _ in plain)
        most = max(most, os.fstat(spill._fd).st_size)
    assert spill.push(b"x" * 100, 0)
    assert most <= 1000
    spill.close()


def test_unwritable_folder_refuses_rows(tmp_path: Path) -> None:
    spill = SpillFile(tmp_path / "missing" / "s", 1 << 20)
    assert not spill.push(b"x", 1)
    assert "cannot be written" in spill.fault
    assert len(spill) == 0


def test_unreadable_spill_is_an_error(tmp_path: Path) -> None:
    spill = SpillFile(tmp_path / "s", 1 << 20)
    for _ in range(3):
        spill.push(b"x" * 100, 10)
    os.ftruncate(spill._fd, 150)
    assert spill.pop() == (b"x" * 100, 10)
    with pytest.raises(OSError, match="26 of 100"):
        spill.pop()
    assert spill.rows == 20
    spill.close()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs the device that is always full")
def test_full_disk_refuses_rows(tmp_path: Path) -> None:
    spill = SpillFile(tmp_path / "s", 1 << 20)
    assert spill.push(b"x", 1)
    full = os.open("/dev/full", os.O_RDWR)
    os.dup2(full, spill._fd)
    os.close(full)
    assert not spill.push(b"x", 1)
    assert "No space left" in spill.fault
    assert spill.rows == 1
    spill.close()
