"""Random whole sessions continue bit for bit from any snapshot in a fresh process (see `replay_stress`)."""

from __future__ import annotations

import msgspec
import pytest

from iris_session.protocol.client_messages import PlaceAlignment
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import Entry, decode_entries, encode_entries
from iris_session.session.core import CoreConfig, SessionCore
from iris_session.session.stepper import Stepper
from tests.session.fuzz_core import run
from tests.session.play import make_core
from tests.session.replay_stress import play, replay, replay_elsewhere
from tests.session.test_stepper import Front

ENCODE = msgspec.msgpack.Encoder().encode


@pytest.mark.long
@pytest.mark.parametrize(("seed", "open_loop"), [(2, False), (3, True)])
def test_any_snapshot_continues_bit_for_bit_in_another_process(seed: int, open_loop: bool) -> None:
    stress = play(seed, 700, open_loop=open_loop)
    assert stress.moved > 300, "a session in which hardly anything moved proves nothing"
    assert {"pose", "joints", "hold"} <= stress.kinds
    assert stress.journal.frames
    assert replay_elsewhere(stress.journal, span=40) == [""]


def test_changed_input_is_found() -> None:
    journal = play(0, 60, open_loop=False).journal
    row = journal.rows[50]
    journal.rows[50] = msgspec.structs.replace(row, n_ticks=row.n_ticks + 1)
    assert replay(journal, 20)[0] == "from 0: step 50 differs"


def test_integers_in_a_configuration_are_stored_as_floats() -> None:
    """`contact_step_n=1` would give whole newtons as integers live and as floats in the replay."""
    written = make_core(contact_step_n=1)
    replayed = SessionCore(written.world.model, msgspec.msgpack.decode(ENCODE(written.config), type=CoreConfig))
    assert isinstance(written.config.authority.contact_step_n, float)
    assert ENCODE(written.config) == ENCODE(replayed.config)


def test_posted_messages_are_used_as_journaled() -> None:
    core = make_core()
    stepper = Stepper(core, Front(), None, iter(range(1, 100)).__next__, 10**9, 10**9)
    stepper.inputs.post(PlaceAlignment(1, "p1", Pose((1, 0, 0), (1, 0, 0, 0))))
    seen: list[Entry] = []
    stepper.on_entries = seen.extend
    stepper.step(0)
    assert ENCODE(seen) == ENCODE(decode_entries(encode_entries(seen)))


@pytest.mark.parametrize("seed", [11, 13])
def test_no_entry_raises_or_jumps(seed: int) -> None:
    """Random schema-valid entries, most of them nonsense (see `fuzz_core`)."""
    fuzz = run(seed, 6000)
    assert fuzz.scenes > 0
    assert fuzz.moved > 10
    assert fuzz.rejected >= {"not_finite", "not_holder", "quota", "seq", "stale", "unknown_value"}
    assert fuzz.largest < 200_000
