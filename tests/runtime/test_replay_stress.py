"""Random whole sessions continue bit for bit from any snapshot in a fresh process (see `replay_stress`)."""

from __future__ import annotations

import msgspec
import pytest

from tests.runtime.replay_stress import play, replay, replay_elsewhere


@pytest.mark.parametrize(("seed", "open_loop"), [(2, False), (3, True)])
def test_any_snapshot_continues_bit_for_bit_in_another_process(seed: int, open_loop: bool) -> None:
    stress = play(seed, 700, open_loop=open_loop)
    assert stress.moved > 300, "a session in which hardly anything moved proves nothing"
    assert {"pose", "joints", "hold"} <= stress.kinds
    assert stress.journal.frames
    assert replay_elsewhere(stress.journal, span=40) == [""]


def test_a_changed_input_is_found() -> None:
    journal = play(0, 60, open_loop=False).journal
    row = journal.rows[50]
    journal.rows[50] = msgspec.structs.replace(row, n_ticks=row.n_ticks + 1)
    assert replay(journal, 20)[0] == "from 0: step 50 differs"
