"""Verification names the first difference, and continues after it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

from iris_session.journal.messages import Batch
from iris_session.journal.rows import CRASHED, Keyframe, make_row, seal_keyframe
from iris_session.journal.verification import Models
from iris_session.protocol.client_messages import Marker
from iris_session.protocol.entries import HOST, Entry
from iris_session.recording import SessionHeader, verify
from tests.recording.support import TICK_NS, SmallCore, journal, write

Edit = Callable[[Batch], None]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "session.rrd"


def test_intact_recording_is_ok(path: Path) -> None:
    seen: list[tuple[int, int]] = []
    report = verify(write(path, *journal(200)), SmallCore, lambda done, total: seen.append((done, total)))
    assert report.ok
    assert (report.steps, report.keyframes, report.recording_class, report.finished) == (200, 5, "closed", True)
    assert report.seconds == pytest.approx(199 * TICK_NS / 1e9)
    assert seen[-1] == (200, 200)
    assert report.line().startswith("ok: 200 steps")
    assert json.loads(report.json())["ok"] is True


def edit_row(at: int, **fields: Any) -> Edit:
    def edit(batch: Batch) -> None:
        batch.rows[at] = msgspec.structs.replace(batch.rows[at], **fields)

    return edit


def delete_rows(first: int, last: int) -> Edit:
    return lambda batch: batch.rows.__delitem__(slice(first, last + 1))


def flip_entry(batch: Batch) -> None:
    """Change a byte of the second entry of step 122."""
    row = batch.rows[122]
    blob = bytearray(row.entries)
    blob[len(blob) - row.entry_lengths[1] + 3] ^= 0x40
    batch.rows[122] = msgspec.structs.replace(row, entries=bytes(blob))


def edit_keyframe(batch: Batch) -> None:
    batch.keyframes[2] = msgspec.structs.replace(batch.keyframes[2], plant=batch.keyframes[2].plant[:-1])


def exchange_keyframe(batch: Batch) -> None:
    true = batch.keyframes[2]
    other = Keyframe(99, true.plant, b"other" * 4, true.controller, true.status)
    batch.keyframes[2] = seal_keyframe(other, true.chain)


@pytest.mark.parametrize(
    ("edit", "problems", "unverified"),
    [
        (edit_row(120, now_ns=121 * TICK_NS + 1), ["120 changed now_ns", "120 divergence digest"], 29),
        (edit_row(120, n_ticks=2), ["120 changed n_ticks", "120 divergence digest"], 29),
        (edit_row(120, digest=b"e" * 16), ["120 changed digest"], 0),
        (edit_row(120, chain=b"c" * 16), ["120 changed chain"], 0),
        (edit_row(120, step=7120), ["120 changed step"], 0),
        (flip_entry, ["122 changed entries 1", "122 divergence entries"], 27),
        (delete_rows(60, 69), ["60 missing step"], 30),
        (delete_rows(90, 99), ["90 missing step"], 0),
        (edit_keyframe, ["49 changed plant"], 0),
        (exchange_keyframe, ["99 divergence authority"], 0),
    ],
)
def test_a_change_is_named_and_verification_goes_on_after_it(
    path: Path, edit: Edit, problems: list[str], unverified: int
) -> None:
    """What follows is simulated again from the next keyframe on, and counts as no difference."""
    header, batch = journal(200)
    edit(batch)
    rows = len(batch.rows)
    report = verify(write(path, header, batch), SmallCore)
    assert not report.ok
    found = [f"{p.step} {p.kind} {p.field}" + (f" {p.entry}" if p.entry >= 0 else "") for p in report.problems]
    assert found == problems
    assert f"step {report.problems[0].step}" in report.line()
    assert (report.unverified_steps, report.steps) == (unverified, rows - unverified)


def test_changed_header_is_named_without_a_core_too(path: Path) -> None:
    header, batch = journal(50)
    report = verify(write(path, msgspec.structs.replace(header, config=b"easier"), batch), None)
    assert [(p.step, p.field) for p in report.problems] == [(-1, "header"), (0, "chain")]
    assert verify(write(path.with_name("b.rrd"), *journal(50)), None).ok


@pytest.mark.parametrize("again", [True, False])
def test_crashed_step_is_reported(path: Path, again: bool) -> None:
    class Core(SmallCore):
        def step(self, now_ns: int, entries: Sequence[Entry], n_ticks: int, plant: bytes = b"") -> bytes:
            if again and now_ns == last.now_ns + 1:
                raise KeyError("the\nreason")
            return super().step(now_ns, entries, n_ticks, plant)

    header, batch = journal(200)
    last = batch.rows[-1]
    batch.rows.append(make_row(last.chain, 200, last.now_ns + 1, 1, [], CRASHED))
    report = verify(write(path, header, batch), Core)
    assert report.ok
    assert report.steps == 201
    assert "step 200" in report.line()
    assert ("comes again: KeyError" if again else "does not come again") in report.crash


def test_rewritten_journal_is_found_by_simulation(path: Path) -> None:
    """A journal with recomputed checksums does not reproduce the recorded states."""
    header, batch = journal(200)
    chain = batch.rows[99].chain
    for step in range(100, 200):
        old = batch.rows[step]
        entries = [Entry(HOST, HOST, old.now_ns, Marker(1, "invented"))]
        batch.rows[step] = make_row(chain, step, old.now_ns, 1, entries, old.digest)
        chain = batch.rows[step].chain
    batch.keyframes = [k for k in batch.keyframes if k.step < 100]
    report = verify(write(path, header, batch), SmallCore)
    assert (report.problems[0].step, report.problems[0].kind) == (100, "divergence")
    assert report.unverified_steps == 99


def test_core_that_cannot_be_built_is_reported(path: Path) -> None:
    def refuse(header: SessionHeader, models: Models) -> SmallCore:
        raise ValueError("config of\nversion 9")

    report = verify(write(path, *journal(50)), refuse)
    assert not report.ok
    assert report.problems[0].text.endswith("config of version 9")


def test_other_library_versions_are_reported(path: Path) -> None:
    header, batch = journal(50)
    header = msgspec.structs.replace(header, versions={"mujoco": "1.2.3"})
    report = verify(write(path, header, batch), SmallCore)
    assert report.version_differences[0].startswith("mujoco: recorded 1.2.3")
    assert "versions" in report.line()
