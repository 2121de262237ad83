"""The recorder's place in the rig: keeps the journal in memory, and takes every step again from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from iris_session.journal.rows import JournalRow, Keyframe, is_result
from iris_session.physics import decode_model
from iris_session.protocol.entries import decode_entries
from iris_session.recording import unpack_model
from iris_session.session.core import CoreConfig, CoreState, SessionCore


class Journal:
    """What a recorder gets of a session; see `RecorderPort` in `session.stepper`.

    Attributes:
        config: Of the core, as in the header of a recording.
        rows: One per step.
        keyframes: The first is of the state before the first step.
    """

    wants_keyframe = False

    def __init__(self, config: CoreConfig, model: bytes) -> None:
        self.config = config
        self._model = model
        self._models: dict[str, bytes] = {}
        self.rows: list[JournalRow] = []
        self.keyframes: list[Keyframe] = []

    def send_scene(self, model_hash: str, packed_model: bytes, *_: Any) -> None:
        self._models[model_hash] = unpack_model(packed_model)

    def add_row(self, row: JournalRow) -> None:
        self.rows.append(row)

    def add_keyframe(self, keyframe: Keyframe, chain: bytes) -> None:
        self.keyframes.append(keyframe)

    def send_patch(self, *_: Any) -> None: ...

    def flush(self) -> None: ...

    def add_state(self, *_: Any) -> bool:
        return True

    def add_decision(self, *_: Any) -> None: ...

    def add_metric(self, *_: Any) -> None: ...

    def take_gap(self) -> int:
        return 0

    def verify(self, first_keyframe: int = 0) -> int:
        """Take every step again on a core of its own. Return how many; a step that differs fails the test.

        Args:
            first_keyframe: Begin at this keyframe instead of at the begin of the session.
        """
        if not self.keyframes:
            assert not self.rows, "steps without the keyframe before the first of them"
            return 0  # the session ended before its first step
        core = SessionCore(decode_model(self._model), self.config, lambda name: decode_model(self._models[name]))
        keyframe = self.keyframes[first_keyframe]
        core.restore(CoreState(keyframe.plant, keyframe.authority, keyframe.controller, keyframe.status))
        rows: Sequence[JournalRow] = [row for row in self.rows if row.step > keyframe.step]
        for row in rows:
            entries = decode_entries(row.entries)
            outcome = core.step(row.now_ns, entries, row.n_ticks, row.plant)
            assert is_result(row, outcome.digest), f"step {row.step} differs from the journal: {entries}"
        return len(rows)
