"""Verify rows and keyframes of a journal: check the bytes and the chain of every row, and take the steps again. Pure.

The first problem is identified by step and field or entry. Verification begins at the initial state; after missing rows
or a divergence it resumes at the next keyframe. The simulation is composed elsewhere and passed in as a `Core`. Reading
a recording for it is in `recording/verify.py`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any, Final, Protocol

import msgspec

from iris_session.journal.messages import EndMark
from iris_session.journal.rows import (
    CRASHED,
    JournalRow,
    Keyframe,
    RowProblem,
    SessionHeader,
    check_fields,
    check_keyframe,
    check_row,
    compute_chain,
    is_result,
)
from iris_session.protocol.entries import Entry, decode_entries

#: Maximum number of problems listed in a report; further ones are only counted.
MAX_PROBLEMS: Final = 20


class Core(Protocol):
    """Interface of the simulated session, made by `make_core(header, models)` in its initial state."""

    def step(self, now_ns: int, entries: list[Entry], n_ticks: int, plant: bytes = b"") -> bytes:
        """Take one step and return its digest. `plant`: that of the row, in class `open`."""
        ...

    def restore(self, keyframe: Keyframe) -> None:
        """Set the state to that of `keyframe`."""
        ...

    def find_differences(self, keyframe: Keyframe) -> list[str]:
        """Return the names of the snapshots in `keyframe` that are not those of the present state."""
        ...


#: Returns a scene's model in binary form (mjb) by `SceneLoaded.model_hash`; raises `LookupError` if it is missing.
Models = Callable[[str], bytes]


class Problem(msgspec.Struct, frozen=True):
    """One problem found in a recording.

    `kind`: `changed` (bytes differ from those written), `missing` (rows), `divergence` (the simulation gives another
    result), `unreadable`. `field`: of the row or keyframe; `entry`: index, -1 if it is not an entry.
    """

    step: int
    kind: str
    field: str
    text: str
    entry: int = -1


class VerifyReport(msgspec.Struct):
    """Result of a verification. `ok`: every step was checked and simulated again with the same result.

    `gaps`: `(first, last)` missing steps. `unverified_steps`: rows between a gap or divergence and the next keyframe.
    `finished`: the recorder closed the file, so nothing can be missing at its end; otherwise `ending` describes it.
    `files`: the parts. `cuts`, `missing`, `notes`: see `Recording`. `crash`: description of the last step if an error
    in it ended the session. `continues`: recording and step that a resumed session continues. `keyframes`: number of
    keyframes compared and equal. `seconds`: session time simulated [s]; `wall_s`: duration of the verification [s].
    `problems`: the first `MAX_PROBLEMS`, in order. `is_being_written`: a process was writing the recording meanwhile.
    """

    path: str
    ok: bool = False
    recording_class: str = ""
    finished: bool = True
    ending: str = ""
    parts: int = 1
    steps: int = 0
    unverified_steps: int = 0
    keyframes: int = 0
    seconds: float = 0.0
    wall_s: float = 0.0
    problems: list[Problem] = []
    more_problems: int = 0
    gaps: list[tuple[int, int]] = []
    last_step: int = -1
    damage: list[str] = []
    cuts: list[str] = []
    files: list[str] = []
    missing: list[str] = []
    notes: list[str] = []
    crash: str = ""
    continues: str = ""
    version_differences: list[str] = []
    is_being_written: bool = False

    def line(self) -> str:
        """Return the result on one line."""
        speed = self.seconds / self.wall_s if self.wall_s > 0 else 0.0
        parts = [f"{self.steps} steps, {self.seconds:.1f} s of session in {self.wall_s:.1f} s ({speed:.1f}x)"]
        parts.append(f"{self.keyframes} keyframes equal, class {self.recording_class}")
        if self.unverified_steps:
            parts.append(f"{self.unverified_steps} steps could not be verified")
        if self.crash:
            parts.append(self.crash)
        if self.parts > 1:
            parts.append(f"{self.parts} parts: {', '.join(self.files)}")
        if self.continues:
            parts.append(f"continues {self.continues}")
        parts += self.notes
        if self.ok and self.finished:
            return "ok: " + "; ".join(parts)
        if self.ok and self.is_being_written:
            return f"ok so far, {self.ending}: " + "; ".join(parts)
        if self.ok:
            return f"ok as far as it goes, but {self.ending}: " + "; ".join(parts)
        if self.version_differences:
            parts.append(f"versions differ: {', '.join(self.version_differences)}")
        parts += [self.ending] if self.ending else []
        if not self.problems:
            return "FAILED: no step could be verified; " + "; ".join(parts)
        first = self.problems[0]
        entry = f", entry {first.entry}" if first.entry >= 0 else ""
        n = len(self.problems) + self.more_problems - 1
        more = f" (and {n} more)" if n else ""
        return f"FAILED at step {first.step}{entry}, {first.field}: {first.text}{more}; " + "; ".join(parts)

    def as_dict(self) -> dict[str, Any]:
        """Return all fields as plain values, including `line`."""
        fields: dict[str, Any] = msgspec.to_builtins(self)
        return {**fields, "line": self.line()}

    def json(self) -> str:
        """Return `as_dict` as one JSON object."""
        return json.dumps(self.as_dict())


class Verification:
    """One verification of a journal. Its findings are in `report`.

    Attributes:
        report: The report so far.
        last_step: Step of the newest row.
        simulating: False between a gap or divergence and the next keyframe.
    """

    def __init__(
        self,
        header: SessionHeader,
        root: bytes,
        keyframes: Iterator[Keyframe],
        core: Core | None,
        report: VerifyReport,
    ) -> None:
        """Begin a verification.

        Args:
            header: Header of the recording.
            root: Chain value before the first row.
            keyframes: All keyframes, in order of steps.
            core: The simulated session in its initial state; `None` checks bytes, chain and completeness.
            report: The report to fill.
        """
        self.report = report
        self.last_step = header.begins_after
        # A resumed session begins at the keyframe that it was resumed from.
        self.simulating = header.continues is None
        self._core = core
        self._chain: bytes | None = root
        self._stored_chain: bytes | None = None  # of the last row, if it differs from the computed one
        self._now_ns: int | None = None
        self._keyframes = keyframes
        self._next_keyframe = next(self._keyframes, None)
        self._first = self.last_step
        self.compare_keyframe(self._first)

    def verify_row(self, row: JournalRow) -> None:
        """Check one row, simulate it, and compare the keyframe taken after it."""
        problem = self._check(row)
        expected = self.last_step + 1
        is_step = problem is not None and problem.field == "step"
        if row.step != expected and not is_step:
            self._gap(expected, row.step - 1)
            problem = check_fields(row)
        elif problem is None and self._now_ns is not None and row.now_ns < self._now_ns:
            problem = RowProblem(row.step, "now_ns", "session time goes back")
        self.last_step = expected if is_step else row.step
        if problem is not None:
            self.add_problem(Problem(self.last_step, "changed", problem.field, problem.text, problem.entry))
        # After a changed chain value the computed one is used, so that the next row is not blamed: see `_check`.
        bad_chain = problem is not None and problem.field == "chain" and self._chain is not None
        self._stored_chain = row.chain if bad_chain else None
        self._chain = compute_chain(self._chain, row) if bad_chain and self._chain is not None else row.chain
        self._simulate(row, compare=problem is None or problem.field != "digest")
        self.compare_keyframe(self.last_step)

    def _check(self, row: JournalRow) -> RowProblem | None:
        if self._chain is None:
            return check_fields(row)
        problem = check_row(self._chain, row)
        if problem is not None and problem.field == "chain" and self._stored_chain is not None:
            return check_row(self._stored_chain, row)
        return problem

    def end(self, mark: EndMark | None) -> None:
        """Check that the rows reach as far as the recorder noted when it closed the file."""
        if mark is None or not mark.chain:
            return
        if mark.step > self.last_step:
            self._gap(self.last_step + 1, mark.step)
        elif self._chain is not None and (mark.step, mark.chain) != (self.last_step, self._chain):
            text = (
                f"the end mark names step {mark.step}, the journal ends at step {self.last_step} or with another chain"
            )
            self.add_problem(Problem(self.last_step, "changed", "end", text))

    def _gap(self, first: int, last: int) -> None:
        if last < first:  # the same or an earlier step again: not a gap, but never written so
            self.add_problem(Problem(last + 1, "changed", "step", f"step {last + 1} comes after step {first - 1}"))
        else:
            self.report.gaps.append((first, last))
            text = f"{last - first + 1} rows are missing, steps {first} to {last}"
            self.add_problem(Problem(first, "missing", "step", text))
        self.simulating = False
        self._chain = None
        self.compare_keyframe(last)

    def _simulate(self, row: JournalRow, *, compare: bool) -> None:
        elapsed = 0 if self._now_ns is None else max(0, row.now_ns - self._now_ns)
        self._now_ns = row.now_ns
        if not self.simulating:
            self.report.unverified_steps += 1
            return
        self.report.steps += 1
        self.report.seconds += elapsed / 1e9
        if row.digest == CRASHED:
            self._crashed(row)
        elif self._core is not None:
            self._step(self._core, row, compare)

    def _crashed(self, row: JournalRow) -> None:
        """Repeat the step that ended the session, to report its error."""
        self.report.crash = f"an error in step {row.step} ended the session"
        self.simulating = False
        if self._core is None:
            return
        try:
            self._core.step(row.now_ns, decode_entries(row.entries), row.n_ticks, row.plant)
        except Exception as error:
            self.report.crash += f", and comes again: {format_error(error)}"
        else:
            self.report.crash += "; it does not come again"

    def _step(self, core: Core, row: JournalRow, compare: bool) -> None:
        try:
            digest = core.step(row.now_ns, decode_entries(row.entries), row.n_ticks, row.plant)
        except ImportError:
            raise
        except Exception as error:  # changed bytes may cause any error in the core; the error is the finding
            self._diverged("entries", f"the step cannot be taken again: {format_error(error)}")
            return
        if compare and not is_result(row, digest):
            self._diverged("digest", "the simulation gives another result than the recording")

    def _diverged(self, field: str, text: str) -> None:
        self.add_problem(Problem(self.last_step, "divergence", field, text))
        self.simulating = False

    def compare_keyframe(self, step: int) -> None:
        """Compare the keyframe after `step`, or resume from it if the simulation had stopped."""
        while (keyframe := self._next_keyframe) is not None:
            changed = check_keyframe(keyframe)
            if not changed and keyframe.step > step:
                return
            self._next_keyframe = next(self._keyframes, None)
            if changed:
                text = f"keyframe: {changed} was changed"
                self.add_problem(Problem(step, "changed", changed, text))
            elif keyframe.step == step:
                self._use_keyframe(keyframe)

    def _use_keyframe(self, keyframe: Keyframe) -> None:
        if self._chain is not None and keyframe.chain != self._chain:
            if keyframe.step == self._first:
                text = "the header is not the one that the journal was begun with"
                self.add_problem(Problem(keyframe.step, "changed", "header", text))
            else:
                self.add_problem(Problem(keyframe.step, "changed", "chain", "keyframe: it belongs to another journal"))
            return
        self._chain = keyframe.chain
        if self._core is None:
            self.simulating = True
        elif not self.simulating:
            try:
                self._core.restore(keyframe)
            except ImportError:
                raise
            except Exception as error:  # snapshots of another version may cause any error in the core
                self.add_problem(
                    Problem(keyframe.step, "divergence", "keyframe", f"it cannot be restored: {format_error(error)}")
                )
                return
            self.simulating = True
        else:
            other = self._core.find_differences(keyframe)
            if other:
                text = f"keyframe: {', '.join(other)} is not what the simulation gives"
                self.add_problem(Problem(keyframe.step, "divergence", other[0], text))
                return
        self.report.keyframes += 1

    def add_problem(self, problem: Problem) -> None:
        """Add a problem to the report."""
        if len(self.report.problems) < MAX_PROBLEMS:
            self.report.problems.append(problem)
        else:
            self.report.more_problems += 1


def format_error(error: Exception) -> str:
    """Return type and message of an error on one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
