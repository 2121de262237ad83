"""The stepper's bounds and rhythms, with recording ports in place of processes."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from iris_session.journal.rows import CRASHED, Keyframe, check_row
from iris_session.link import messages as link_messages
from iris_session.protocol.client_messages import Assign, EStop, Marker
from iris_session.protocol.entries import HOST, Entry, ExternalReset, RecordingGap, decode_entries
from iris_session.protocol.server_messages import RobotState, StateHeader
from iris_session.protocol.steps import Decision
from iris_session.session.core import SessionCore
from iris_session.session.errors import OwnershipError
from iris_session.session.stepper import MAX_HOST_ENTRIES, RESERVED_HOST_ENTRIES, Stepper
from tests.rig.journal import Journal
from tests.session.play import TICK_NS, entries, make_core

MS = 1_000_000


class Front:
    """Keeps what is sent, from `first_step` on; gives `waiting`."""

    def __init__(self, first_step: int = 0) -> None:
        self.first_step = first_step
        self.waiting: list[Entry] = []
        self.decisions: list[Decision] = []
        self.states: list[StateHeader] = []
        self.n_bodies = 0

    def poll(self) -> list[Entry]:
        entries, self.waiting = self.waiting, []
        return entries

    def send_decision(self, step: int, decision: Decision) -> None:
        assert step == self.first_step + len(self.decisions)
        self.decisions.append(decision)

    def send_state(self, header: StateHeader, poses: NDArray[np.float64], robots: tuple[RobotState, ...] = ()) -> None:
        assert poses.shape[1] == 7
        self.n_bodies = len(poses)
        self.states.append(header)


class Recorder(Journal):
    """A journal that knows when states were recorded; loses `gap` rows once."""

    def __init__(self, core: SessionCore) -> None:
        super().__init__(core.config, core.world.encode_model())
        self.gap = self.flushed = 0
        self.state_times: list[int] = []

    def flush(self) -> None:
        self.flushed = len(self.rows)

    def add_keyframe(self, keyframe: Keyframe, chain: bytes) -> None:
        assert chain == (self.rows[-1].chain if self.rows else b"root")
        super().add_keyframe(keyframe, chain)

    def add_state(self, step: int, tick: int, sim_time: float, session_time: int, *_: Any) -> bool:
        self.state_times.append(session_time)
        return True

    def take_gap(self) -> int:
        gap, self.gap = self.gap, 0
        return gap


class Rig:
    """A stepper whose clock the test moves."""

    def __init__(self, core: SessionCore | None = None) -> None:
        self.now_ns = 0
        self.core = core or make_core()
        self.front, self.recorder = Front(), Recorder(self.core)
        self.stepper = Stepper(
            self.core, self.front, self.recorder, lambda: self.now_ns, 16 * MS, 100 * MS, b"root"
        )  # fmt: skip

    def step(self, *arrived: Entry, distance_ns: int = TICK_NS) -> None:
        self.now_ns += distance_ns
        self.front.waiting = list(arrived)
        self.stepper.step(1)

    def steps(self, n: int, distance_ns: int = TICK_NS) -> None:
        for _ in range(n):
            self.step(*entries(self.stepper.step_count), distance_ns=distance_ns)


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_input_that_crashes_a_step_is_recorded(rig: Rig) -> None:
    rig.steps(3)
    rig.stepper.inputs.post(Marker(0, "the last words"))
    step = rig.stepper.core.controller.begin
    rig.stepper.core.controller.begin = lambda *_: {}["key"]  # type: ignore[method-assign,assignment]
    with pytest.raises(KeyError):
        rig.steps(1)
    row = rig.recorder.rows[-1]
    assert (row.step, row.digest, rig.recorder.flushed) == (3, CRASHED, 4)
    assert check_row(rig.recorder.rows[-2].chain, row) is None
    assert [e.message for e in decode_entries(row.entries)] == [Marker(0, "the last words")]
    rig.stepper.core.controller.begin = step  # type: ignore[method-assign]
    with pytest.raises(KeyError):
        rig.steps(1)
    assert rig.recorder.rows[-1] is row, "no row follows, whatever thread would take the next step"


def test_interrupted_step_is_the_last(rig: Rig) -> None:
    """After Ctrl-C in a script's loop the helper thread must not continue from half a step, which no journal has."""
    rig.steps(3)

    def interrupted(step: int, decision: Decision) -> None:
        raise KeyboardInterrupt

    rig.front.send_decision = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        rig.steps(1)
    del rig.front.send_decision
    depths = set()
    for _ in range(3):
        with pytest.raises(OwnershipError, match="interrupt") as caught:
            rig.steps(1)
        depths.add(len(caught.traceback))
    assert len(depths) == 1, "who tries again and again does not fill the memory"
    assert len(rig.recorder.rows) == 3


def test_keyframes_at_start_every_interval_and_on_request_of_the_recorder(rig: Rig) -> None:
    rig.steps(60)  # 120 ms
    rig.recorder.wants_keyframe = True
    rig.steps(1)
    rig.recorder.wants_keyframe = False
    rig.steps(59)
    assert [k.step for k in rig.recorder.keyframes] == [-1, 50, 60, 110]
    assert rig.recorder.keyframes[0].plant == make_core().snapshot().plant


def test_session_time_grows_although_the_clock_stands_still(rig: Rig) -> None:
    rig.steps(5, distance_ns=0)
    times = [row.now_ns for row in rig.recorder.rows]
    assert all(b > a for a, b in pairwise(times))


def test_state_keeps_its_rate_without_bursts_after_a_gap(rig: Rig) -> None:
    rig.steps(400)  # 0.8 s
    assert len(rig.front.states) == pytest.approx(0.8 / 0.016, abs=1)
    assert len(rig.recorder.state_times) == len(rig.front.states)
    before = len(rig.front.states)
    rig.now_ns += 3_000 * MS
    rig.steps(8)  # 16 ms
    assert len(rig.front.states) - before <= 2


def test_lost_rows_are_a_gap_in_the_next_step(rig: Rig) -> None:
    rig.steps(2)
    rig.recorder.gap = 17
    rig.steps(2)
    (entry,) = decode_entries(rig.recorder.rows[-1].entries)
    assert entry.message == RecordingGap(17)


def test_host_entries_are_bounded(rig: Rig) -> None:
    for i in range(MAX_HOST_ENTRIES):
        rig.stepper.inputs.post(Marker(0, f"m{i}"))
    with pytest.raises(OwnershipError, match="loop"):
        rig.stepper.inputs.post(Marker(0, "one more"))
    rig.stepper.inputs.post_own(ExternalReset())  # a reset that a script's loop has seen
    for _ in range(2 * RESERVED_HOST_ENTRIES):
        rig.stepper.inputs.post(EStop("a hand is in the way"))  # one that waits is enough
    for _ in range(RESERVED_HOST_ENTRIES - 2):
        rig.stepper.inputs.post_own(ExternalReset())
    with pytest.raises(RuntimeError, match="loop"):
        rig.stepper.inputs.post_own(ExternalReset())
    rig.steps(1)
    assert rig.stepper.last is not None
    assert rig.stepper.last.decision.estop
    rig.stepper.inputs.post(Marker(0, "there is room again"))


def test_long_texts_are_truncated_and_other_excess_raises(rig: Rig) -> None:
    """Front and recorder check every limit of the protocol: excess must not reach them."""
    rig.stepper.inputs.post(Marker(0, "m" * 3000))
    rig.stepper.inputs.post(EStop("r" * 3000))
    with pytest.raises(ValueError, match="Assign"):
        rig.stepper.inputs.post(Assign(0, ("r" * 65,)))
    rig.steps(1)
    assert [e.message for e in decode_entries(rig.recorder.rows[-1].entries) if e.connection == HOST] == [
        Marker(0, "m" * 509 + "..."),
        EStop("r" * 509 + "..."),
    ]
    for decision in rig.front.decisions:
        encoded = link_messages.encoder.encode(link_messages.Decided(1, events=decision.events))
        link_messages.decode_decided(encoded)
