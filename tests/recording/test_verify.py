"""Verification names the first difference, and continues after it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

from iris_session.journal.rows import CRASHED, Keyframe, make_row, seal_keyframe
from iris_session.journal.verification import Models
from iris_session.protocol.client_messages import Marker
from iris_session.protocol.entries import HOST, Entry
from iris_session.recording import Recording, SessionHeader, verify
from tests.recording.support import TICK_NS, SmallCore, journal, write


def edited(path: Path, at: int, **fields: Any) -> Path:
    """Write a recording of 200 steps with one changed row."""
    header, batch = journal(200)
    batch.rows[at] = msgspec.structs.replace(batch.rows[at], **fields)
    return write(path, header, batch)


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


@pytest.mark.parametrize("field", ["now_ns", "n_ticks", "digest", "chain"])
def test_changed_field_is_named_with_its_step(path: Path, field: str) -> None:
    value = {"now_ns": 121 * TICK_NS + 1, "n_ticks": 2, "digest": b"e" * 16, "chain": b"c" * 16}[field]
    report = verify(edited(path, 120, **{field: value}), SmallCore)
    assert not report.ok
    first = report.problems[0]
    assert (first.step, first.field, first.kind) == (120, field, "changed")
    assert f"step 120, {field}" in report.line()
    changed = [p for p in report.problems if p.kind == "changed"]
    assert len(changed) == 1, "the rows behind it are as they were"
    assert report.steps == (200 if field in {"digest", "chain"} else 171)


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


def test_changed_step_number_is_not_a_gap(path: Path) -> None:
    report = verify(edited(path, 120, step=7120), SmallCore)
    assert [(p.step, p.field) for p in report.problems] == [(120, "step")]
    assert report.gaps == []
    assert report.steps == 200


def test_flipped_byte_is_named_with_step_and_entry(path: Path) -> None:
    _, batch = journal(200)
    row = batch.rows[122]  # two entries
    blob = bytearray(row.entries)
    blob[len(blob) - row.entry_lengths[1] + 3] ^= 0x40
    report = verify(edited(path, 122, entries=bytes(blob)), SmallCore)
    first = report.problems[0]
    assert (first.step, first.entry, first.kind) == (122, 1, "changed")
    assert "step 122, entry 1" in report.line()


def test_verification_continues_at_the_next_keyframe_after_a_change(path: Path) -> None:
    report = verify(edited(path, 120, n_ticks=2), SmallCore)
    assert [p.kind for p in report.problems] == ["changed", "divergence"]
    assert report.unverified_steps == 29, "121 to 149"
    assert report.steps == 171
    assert report.keyframes == 5


def test_missing_rows_are_a_gap_and_verification_restarts(path: Path) -> None:
    header, batch = journal(200)
    del batch.rows[60:70]
    report = verify(write(path, header, batch), SmallCore)
    assert report.gaps == [(60, 69)]
    assert [(p.step, p.kind) for p in report.problems] == [(60, "missing")]
    assert report.unverified_steps == 30, "70 to 99"
    assert report.steps == 160


def test_keyframe_at_the_end_of_a_gap_is_used(path: Path) -> None:
    header, batch = journal(200)
    del batch.rows[90:100]
    report = verify(write(path, header, batch), SmallCore)
    assert report.gaps == [(90, 99)]
    assert report.unverified_steps == 0


def test_missing_first_and_last_rows_are_found(path: Path) -> None:
    header, batch = journal(200)
    full = write(path, header, msgspec.structs.replace(batch, rows=list(batch.rows)))
    del batch.rows[:10]
    report = verify(write(path.with_name("head.rrd"), header, journal(200)[1]), SmallCore)
    assert report.ok
    report = verify(write(path.with_name("cut.rrd"), header, batch), SmallCore)
    assert report.gaps == [(0, 9)]
    with Recording.open(full) as recording:
        assert recording.end is not None
        assert recording.end.step == 199


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


def test_changed_keyframes_are_named(path: Path) -> None:
    header, batch = journal(200)
    batch.keyframes[2] = msgspec.structs.replace(batch.keyframes[2], plant=batch.keyframes[2].plant[:-1])
    report = verify(write(path, header, batch), SmallCore)
    assert [(p.step, p.field, p.kind) for p in report.problems] == [(49, "plant", "changed")]


def test_valid_keyframe_of_another_state_is_a_divergence(path: Path) -> None:
    header, batch = journal(200)
    true = batch.keyframes[2]
    batch.keyframes[2] = seal_keyframe(Keyframe(99, true.plant, b"other" * 4, true.controller, true.status), true.chain)
    report = verify(write(path, header, batch), SmallCore)
    assert [(p.step, p.field, p.kind) for p in report.problems] == [(99, "authority", "divergence")]


def test_changed_header_is_named(path: Path) -> None:
    header, batch = journal(50)
    report = verify(write(path, msgspec.structs.replace(header, config=b"easier"), batch), SmallCore)
    assert [(p.step, p.field) for p in report.problems] == [(-1, "header"), (0, "chain")]


def test_core_that_cannot_be_built_is_reported(path: Path) -> None:
    def refuse(header: SessionHeader, models: Models) -> SmallCore:
        raise ValueError("config of\nversion 9")

    report = verify(write(path, *journal(50)), refuse)
    assert not report.ok
    assert report.problems[0].text.endswith("config of version 9")


def test_open_session_uses_the_plant_of_its_rows(path: Path) -> None:
    report = verify(write(path, *journal(120, "open")), SmallCore)
    assert report.ok, report.line()
    assert report.recording_class == "open"
    header, batch = journal(120, "open")
    plant = bytearray(batch.rows[70].plant)
    plant[-3] ^= 1
    batch.rows[70] = msgspec.structs.replace(batch.rows[70], plant=bytes(plant))
    report = verify(write(path.with_name("b.rrd"), header, batch), SmallCore)
    assert (report.problems[0].step, report.problems[0].field) == (70, "plant")


def test_bytes_alone_can_be_checked_without_a_core(path: Path) -> None:
    assert verify(write(path, *journal(50)), None).ok
    report = verify(edited(path.with_name("b.rrd"), 120, digest=b"e" * 16), None)
    assert (report.problems[0].step, report.problems[0].field) == (120, "digest")


def test_other_library_versions_are_reported(path: Path) -> None:
    header, batch = journal(50)
    header = msgspec.structs.replace(header, versions={"mujoco": "1.2.3"})
    report = verify(write(path, header, batch), SmallCore)
    assert report.version_differences[0].startswith("mujoco: recorded 1.2.3")
    assert "versions" in report.line()
