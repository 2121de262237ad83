"""Verify a recording: what `Verification` finds in its rows and keyframes, and what is wrong with its files."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from iris_session.journal import environment
from iris_session.journal.errors import NotARecordingError
from iris_session.journal.rows import Continues, SessionHeader
from iris_session.journal.verification import Core, Models, Problem, Verification, VerifyReport, format_error
from iris_session.recording.reader import Recording, check_assets

PROGRESS_ROWS: Final = 500


def verify(
    path: str | Path,
    make_core: Callable[[SessionHeader, Models], Core] | None,
    progress: Callable[[int, int], None] | None = None,
) -> VerifyReport:
    """Verify a recording.

    Args:
        path: First file of the recording.
        make_core: Makes the simulated session in its initial state from the header and the models; None checks bytes,
            chain and completeness without simulating.
        progress: Called as `progress(done, total)` with row counts, about every 500 rows.

    Returns:
        The report; all findings are in it.

    Raises:
        NotARecordingError: `path` cannot be read as a recording.
        ImportError: A package that reading or simulating needs is not installed; the message names the extra.
    """
    began = time.perf_counter()
    with Recording.open(path, warn=False) as recording:
        header = recording.header
        report = VerifyReport(str(path), recording_class=header.recording_class, parts=len(recording.files))
        report.version_differences = environment.compare_environment(header.versions)
        total = recording.count_rows() if progress else 0
        try:
            core = make_core(header, recording.model) if make_core else None
        except ImportError:  # a package of an extra is missing: nothing is wrong with the recording
            raise
        except Exception as error:  # a changed header, or another version of the code: reported
            text = f"the session cannot be built from the header: {format_error(error)}"
            report.problems.append(Problem(-1, "divergence", "header", text))
            return report
        run = Verification(header, recording.root, recording.keyframes(), core, report)
        for done, row in enumerate(recording.rows()):
            run.verify_row(row)
            if progress is not None and done % PROGRESS_ROWS == 0:
                progress(done, total)
        if progress is not None:
            progress(total, total)
        run.end(recording.end)
        changed = recording.changed_spans()
        lost = check_assets(recording).list_problems(finished=recording.all_closed)
        report.finished = recording.finished
        report.last_step = run.last_step
        report.is_being_written = recording.is_being_written
        if recording.is_being_written:
            report.ending = f"the recording is being written: read as far as step {run.last_step}"
        elif not recording.finished:
            report.ending = _ending(run.last_step)
        report.damage = list(recording.damage)
        report.cuts = list(recording.cuts)
        report.missing = list(recording.missing)
        report.notes = list(recording.notes)
        report.files = [os.path.basename(file) for file in recording.files]
        if header.continues is not None:
            _compare_past(run, header.continues)
        found = (("missing", "file", recording.missing), ("unreadable", "file", recording.damage))
        for kind, field, lines in (*found, ("changed", "file", changed), ("changed", "asset", lost)):
            for line in lines:
                run.add_problem(Problem(run.last_step, kind, field, line))
    report.wall_s = round(time.perf_counter() - began, 3)
    report.ok = not report.problems and report.steps > 0 and not report.unverified_steps
    return report


def _compare_past(run: Verification, past: Continues) -> None:
    """Check that the recording beside this one is the one that it continues."""
    if not re.fullmatch(r"[^/\0]{1,255}", past.file) or past.file in (".", ".."):
        text = f"the header names no file that it continues, but {past.file[:80]!r}"
        run.add_problem(Problem(past.step, "changed", "header", text))
        return
    run.report.continues = f"{past.file} after step {past.step}"
    given = Path(run.report.path)
    path = (given if given.is_dir() else given.parent) / past.file
    if not path.is_file():
        run.report.notes.append(f"{past.file} is not there to compare with")
        return
    try:
        with Recording.open(path, warn=False) as recording:
            rows = recording.rows(after=past.step - 1)
            root = recording.root if past.step == recording.header.begins_after else b""
            chain = root or next((row.chain for row in rows if row.step == past.step), b"")
    except NotARecordingError as error:
        run.report.notes.append(f"{past.file} cannot be compared with: {error}")
        return
    if chain != past.chain:
        text = f"it does not continue the {past.file} beside it: that has another step {past.step}"
        run.add_problem(Problem(past.step, "changed", "header", text))


def _ending(last_step: int) -> str:
    """Describe a file without an end mark: a killed recorder and a file cut between two writes look the same."""
    return f"NOT FINISHED: it was not closed after step {last_step}, and what may have followed is missing"
