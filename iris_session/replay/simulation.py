"""Replay of a recording: its steps are taken again, one by one, with the core of the session.

Class `closed`: authority, control and physics run again, and the digest of every step is compared with the recorded
one, so what is read after a step is what the session had, bit for bit. Class `open`: the state of the plant is in the
rows; authority and control run only where commands are wanted. Steps that are missing or damaged, and those after them
up to the next keyframe, are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Final, NamedTuple

from iris_session.journal.environment import compare_environment
from iris_session.journal.rows import CLOSED, CRASHED, check_fields, check_keyframe, is_result
from iris_session.protocol.entries import decode_entries
from iris_session.recording import JournalRow, Keyframe, Recording, RecordingError
from iris_session.session.core import SessionCore, StepOutcome, ignore_lap
from iris_session.session.verification import ReplayCore

#: Steps between two calls of `progress`.
PROGRESS_STEPS: Final = 500
#: Differences of versions, and characters of another error, in an error text.
MOST_DIFFERENCES: Final = 3
MOST_CHARACTERS: Final = 300
#: In the entries of a row that loads a scene.
_SCENE_TAG: Final = b"scene_loaded"


class ReplayError(RecordingError):
    """A step cannot be taken again here, or gives another result than in the recording."""


class ReplayedStep(NamedTuple):
    """A step that was taken again.

    `session_time`: when it was taken [ns]. `outcome`: decision and control; None in class `open` without commands.
    """

    step: int
    session_time: int
    outcome: StepOutcome | None


class Replay:
    """The session of an open recording, taken again by iterating over `steps`, once.

    Args:
        recording: The recording.
        with_control: In class `open`, run authority and control too; in class `closed` they always run.
        progress: Called as `progress(done, total)` with numbers of steps, `total` 0 if the recording is not finished.
        lap: Called within each step as that of `SessionCore.step`, where authority and control run.

    Attributes:
        core: The session after the newest step. Class `open`: the plant is as at the beginning of that step.
        left_out: First and last step of each range that is missing or damaged, or cannot be taken again after one.
        step: The step that is being taken, or was taken last.

    Raises:
        ReplayError: The session cannot be built from the header.
        ImportError: A package that simulating needs is not installed; the message names the extra.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        with_control: bool = True,
        progress: Callable[[int, int], None] | None = None,
        lap: Callable[[str], None] = ignore_lap,
    ) -> None:
        header = recording.header
        self._recording, self._lap = recording, lap
        self._with_control = with_control or header.recording_class == CLOSED
        self._progress = progress or (lambda done, total: None)
        self.left_out: list[tuple[int, int]] = []
        self.step = header.begins_after
        self._rows: Iterator[JournalRow] | None = None
        self._last, self._follows = header.begins_after, header.continues is None
        self._is_over = False
        try:
            self._replay = ReplayCore(header, recording.model)
        except ImportError:
            raise
        except Exception as error:  # a changed header, or another version of the code
            raise self._make_error("the session cannot be built from the header", error) from error

    @property
    def core(self) -> SessionCore:
        return self._replay.core

    @cached_property
    def _keyframes(self) -> _KeyframeFinder:
        return _KeyframeFinder(self._recording)

    def steps(self, after: int | None = None) -> Iterator[ReplayedStep]:
        """Take the steps again, and yield each.

        Args:
            after: Begin at the newest keyframe up to this step; None begins at the first step.

        Raises:
            ReplayError: A step cannot be taken again, or gives another result here.
            NotARecordingError: A file can no longer be read.
        """
        end = self._recording.end
        total = 0 if end is None else max(0, end.step - self._last)
        if (
            after is not None
            and (newest := self._keyframes.find_newest(after)) is not None
            and newest.step > self._last
        ):
            total = max(0, total - (newest.step - self._last))
            self._restore(newest)
        for done, row in enumerate(self._recording.rows(self._last if after is not None else None)):
            if done % PROGRESS_STEPS == 0:
                self._progress(done, total)
            step = self._advance(row)
            if self._is_over:
                break
            if step is not None:
                yield step
        self._progress(total, total)

    def steps_between(self, first: int, end: int) -> Iterator[ReplayedStep]:
        """Take steps again, and yield each: from the newest keyframe before `first`, which may be earlier, up to `end`.

        Call it again for later steps: the files are read once for all calls, so that a call costs what its own steps
        cost, wherever they are. Raises as `steps`.
        """
        if self._rows is None:
            self._rows = self._recording.rows()
        newest = self._keyframes.find_newest(first - 1)
        if newest is not None and (newest.step > self._last or not self._follows):
            self._restore(newest)
        while self._last < end - 1 and not self._is_over and (row := next(self._rows, None)) is not None:
            step = self._advance(row)
            if step is not None:
                yield step

    def _advance(self, row: JournalRow) -> ReplayedStep | None:
        """Take the step of the next row; None for one that is left out, or was taken."""
        if check_fields(row) is not None:  # its number may be what was changed
            self._last, self._follows = self._last + 1, False
            self._leave_out(self._last, self._last)
            return None
        if row.step <= self._last:
            return None
        if row.step > self._last + 1:
            self._leave_out(self._last + 1, row.step - 1)
            self._follows = False
        if not self._follows and (keyframe := self._keyframes.find(row.step - 1)) is not None:
            self._restore(keyframe)
        self._last = row.step
        if not self._follows:
            self._leave_out(row.step, row.step)
            return None
        if row.digest == CRASHED:  # an error in it ended the session: it has no result
            self._is_over = True
            return None
        return ReplayedStep(row.step, row.now_ns, self._take(row))

    def _take(self, row: JournalRow) -> StepOutcome | None:
        self.step = row.step
        try:
            if not self._with_control:
                entries = decode_entries(row.entries) if _SCENE_TAG in row.entries else ()
                self.core.show(entries, row.plant)
                return None
            outcome = self.core.step(row.now_ns, decode_entries(row.entries), row.n_ticks, row.plant, lap=self._lap)
        except ImportError:
            raise
        except Exception as error:  # a foreign file may cause any error in the core
            raise self._make_error(f"step {row.step} cannot be taken again", error) from error
        if not is_result(row, outcome.digest):
            raise self._make_error(f"step {row.step} gives another result here than in the recording")
        return outcome

    def _restore(self, keyframe: Keyframe) -> None:
        self._last, self._follows = keyframe.step, True
        try:
            self._replay.restore(keyframe)
        except ImportError:
            raise
        except Exception as error:  # a snapshot of another version may mean anything
            raise self._make_error(f"the keyframe after step {keyframe.step} cannot be restored", error) from error

    def _make_error(self, text: str, error: Exception | None = None) -> ReplayError:
        """Return an error with what differs here from the environment of the session, or how to find out more."""
        if error is not None:
            text += f": {type(error).__name__}: {' '.join(str(error).split())}"[:MOST_CHARACTERS]
        differences = compare_environment(self._recording.header.versions)
        if not differences:
            return ReplayError(f"{text}; `iris-session verify` says more")
        more = len(differences) - MOST_DIFFERENCES
        listed = "; ".join(differences[:MOST_DIFFERENCES]) + (f"; and {more} more" if more > 0 else "")
        return ReplayError(f"{text}; it needs the versions and the processor of the session ({listed})")

    def describe_left_out(self) -> str:
        """Return one line about the steps that were left out so far."""
        n = sum(last - first + 1 for first, last in self.left_out)
        first, last = self.left_out[0]
        more = f" and {len(self.left_out) - 1} more ranges" if len(self.left_out) > 1 else ""
        return (
            f"{n} steps are missing, damaged, or follow such ones before the next keyframe, and are left out: "
            f"{first} to {last}{more}"
        )

    def _leave_out(self, first: int, last: int) -> None:
        if self.left_out and self.left_out[-1][1] == first - 1:
            first = self.left_out.pop()[0]
        self.left_out.append((first, last))


class _KeyframeFinder:
    """Finds intact keyframes by their steps, which must be asked for in order."""

    def __init__(self, recording: Recording) -> None:
        self._keyframes = recording.keyframes()
        self._next = next(self._keyframes, None)

    def find(self, step: int) -> Keyframe | None:
        """Return the keyframe after `step`, if there is one."""
        while self._next is not None and (self._next.step < step or check_keyframe(self._next)):
            self._next = next(self._keyframes, None)
        return self._next if self._next is not None and self._next.step == step else None

    def find_newest(self, step: int) -> Keyframe | None:
        """Return the newest keyframe up to `step`, if there is one."""
        found = None
        while self._next is not None and self._next.step <= step:
            if not check_keyframe(self._next):
                found = self._next
            self._next = next(self._keyframes, None)
        return found


class StepSelector:
    """Selects steps at a rate: the first one of each period, within half a tick. Nothing is interpolated.

    Args:
        hz: Steps per second of session time; None, or at least the rate of the ticks: every step.
        tick_period_ns: Nominal time between two steps [ns].

    Raises:
        ValueError: `hz` is not a positive number.
    """

    def __init__(self, hz: float | None, tick_period_ns: int) -> None:
        if hz is not None and not (math.isfinite(hz) and hz > 0.0):
            raise ValueError(f"hz is {hz!r}: give a rate above 0, for example 100, or None for every step")
        # A rate written with few digits, such as 333, still means every step of a tick of 3 ms.
        self._takes_all = hz is None or hz * tick_period_ns >= 0.998e9
        self._period_ns = 0.0 if hz is None else 1e9 / hz
        self._tolerance_ns = tick_period_ns // 2
        self._begin_ns: int | None = None
        self._period = -1

    def selects(self, session_time: int) -> bool:
        """Return whether the step at `session_time` [ns] is selected. Call it for every step, in order."""
        if self._takes_all:
            return True
        if self._begin_ns is None:
            self._begin_ns = session_time
        period = int((session_time - self._begin_ns + self._tolerance_ns) / self._period_ns)
        if period <= self._period:
            return False
        self._period = period
        return True
