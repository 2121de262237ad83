"""Owner and tracking frame of observations are found in rows and events that a session records."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.journal.messages import Batch
from iris_session.protocol.client_messages import Observation
from iris_session.protocol.common import IDENTITY, Applied
from iris_session.protocol.entries import AlignmentAlarm, Entry, Join
from iris_session.protocol.server_messages import Event, StateHeader
from iris_session.protocol.steps import Decision
from iris_session.recording import JournalRow, Keyframe, Recording, TrackingFrame, header_root, read_alignment_history
from iris_session.recording.writer import RrdWriter
from iris_session.session.stepper import Stepper
from tests.recording.support import make_header
from tests.session.play import TICK_NS, make_core

ANN, BOB = 4, 9
_encode = msgspec.msgpack.Encoder().encode


class Front:
    """Gives `waiting`."""

    def __init__(self) -> None:
        self.waiting: list[Entry] = []

    def poll(self) -> list[Entry]:
        entries, self.waiting = self.waiting, []
        return entries

    def send_decision(self, step: int, decision: Decision) -> None: ...

    def send_state(self, header: StateHeader, poses: NDArray[np.float64]) -> None: ...


class Recorder:
    """Keeps rows and events."""

    wants_keyframe = False

    def __init__(self) -> None:
        self.rows: list[JournalRow] = []
        self.events: list[Event] = []

    def add_row(self, row: JournalRow) -> None:
        self.rows.append(row)

    def add_decision(self, step: int, session_time: int, decision: Decision) -> None:
        self.events.extend(decision.events)

    def flush(self) -> None: ...

    def add_keyframe(self, keyframe: Keyframe, chain: bytes) -> None: ...

    def add_state(
        self,
        step: int,
        tick: int,
        sim_time: float,
        session_time: int,
        poses: NDArray[np.float64],
        applied: Sequence[Applied] = (),
        robots: bytes = b"",
    ) -> None: ...

    def add_metric(self, step: int, session_time: int, name: str, value: float) -> None: ...

    def take_gap(self) -> int:
        return 0


def test_observations_of_a_session_have_owner_and_tracking_frame(tmp_path: Path) -> None:
    """Two participants join; the tracking frame of one jumps between its two observations."""
    header, front, recorder, now_ns = make_header(), Front(), Recorder(), 0
    stepper = Stepper(make_core(), front, recorder, lambda: now_ns, 1 << 60, 1 << 60, header_root(header))
    jump_ns = 25 * TICK_NS
    said = {
        0: (ANN, Join("a", "operator", "ann", devices=("head",), alignment="measured", capabilities=("run:a",))),
        10: (BOB, Join("b", "operator", "bob", devices=("head",), alignment="measured", capabilities=("run:b",))),
        30: (ANN, AlignmentAlarm("jump", 0, "", 0.2, jump_ns)),
    }
    for step in range(60):
        now_ns += TICK_NS
        if step in said:
            connection, message = said[step]
            front.waiting = [Entry(connection, connection, now_ns, message)]
        stepper.step(1)
    writer = RrdWriter(tmp_path / "session.rrd", "id")
    writer.write_header(header)
    writer.add(Batch(rows=recorder.rows, events=recorder.events))
    for connection, at_ns in ((ANN, 20 * TICK_NS), (BOB, 20 * TICK_NS), (ANN, 26 * TICK_NS)):
        writer.add_sample(connection, at_ns, _encode(Observation("table", "qr", IDENTITY, at_ns, 0, 1)))
    writer.close()

    with Recording.open(tmp_path / "session.rrd") as recording:
        found = read_alignment_history(recording)
    assert found.unowned == 0
    assert {frame: len(looks) for frame, looks in found.observations.items()} == {
        TrackingFrame("p1", 1, 0): 1,
        TrackingFrame("p1", 1, 0, 1): 1,
        TrackingFrame("p2", 1, 0): 1,
    }
    assert found.participants["p1"].runs == ["run:a"]
