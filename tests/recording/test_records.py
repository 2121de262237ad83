"""Events as records and samples as arrays, of files written by hand."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from iris_session.journal.messages import Batch
from iris_session.protocol.client_messages import Observation, Sample
from iris_session.protocol.common import IDENTITY, Lease, Pose
from iris_session.protocol.entries import Entry, Join
from iris_session.protocol.server_messages import (
    Event,
    EventBody,
    EventKind,
    LeasesChanged,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantJoined,
    PauseChanged,
)
from iris_session.recording import Recording, RecordingError, header_root, make_row
from iris_session.recording.records import (
    ID_FIELDS,
    ID_LIST_FIELDS,
    iterate_samples,
    list_event_records,
    make_event_record,
    read_device_samples,
    read_names,
)
from iris_session.recording.writer import RrdWriter
from tests.recording.support import TICK_NS, make_header

ANN = ParticipantInfo("p1", "ann", "operator", True)
BOB = ParticipantInfo("p2", "bob", "leader", True)


def write(path: Path, bodies: list[EventBody], messages: list[tuple[int, bytes]]) -> Path:
    """Write a recording in which ann and bob join over connections 7 and 8. `messages`: with their connections."""
    header = make_header()
    joins = [Entry(7, 7, 0, Join("k1", "operator", "ann")), Entry(8, 8, 0, Join("k2", "leader", "bob"))]
    row = make_row(header_root(header), 0, TICK_NS, 1, joins, b"d" * 16)
    events = [
        Event(seq, seq, TICK_NS * seq, body)  # type: ignore[arg-type]
        for seq, body in enumerate(bodies, 4)
    ]
    joined = [Event(i, 1, TICK_NS, ParticipantJoined(one)) for i, one in enumerate((ANN, BOB), 1)]
    writer = RrdWriter(path, "id")
    writer.write_header(header)
    for i, (connection, data) in enumerate(messages):
        writer.add_sample(connection, i * TICK_NS, data)
    writer.add(
        Batch(rows=[row], events=[msgspec.structs.replace(e, event_seq=e.event_seq + 1) for e in joined] + events)
    )
    writer.close()
    return path


def sample(device: str, seq: int, **fields: object) -> bytes:
    return msgspec.msgpack.encode(Sample(device, "pose", seq, seq * 10, 1, 1, 1, **fields))  # type: ignore[arg-type]


def test_records_have_names_beside_ids_in_all_depths(tmp_path: Path) -> None:
    lease = Lease("left", "robot", "shared", "p1", 3, queue=("p9",), sub_holders=("p1", "p2"), weights=(0.5, 0.5))
    renamed = msgspec.structs.replace(ANN, name="anna")
    bodies = [
        LeasesChanged((lease,), "acquired", ("p2",)),
        ParticipantChanged(renamed),
        PauseChanged(True, "p1", "tea"),
    ]
    with Recording.open(write(tmp_path / "session.rrd", bodies, [])) as recording:
        joined, _, leases, _, paused = list_event_records(recording)
        assert read_names(recording) == {"p1": "anna", "p2": "bob"}
    assert (joined["event"], joined["participant"]["name"]) == ("participant_joined", "ann")
    assert leases["leases"][0]["holder_name"] == "ann", "by its name at that time"
    assert leases["leases"][0]["sub_holders_names"] == ["ann", "bob"]
    assert leases["leases"][0]["queue_names"] == [""], "not in this recording"
    assert leases["previous_holders_names"] == ["bob"]
    assert paused == {
        "event_seq": 6,
        "session_time_ns": 6 * TICK_NS,
        "time_s": pytest.approx(6 * TICK_NS * 1e-9),
        "event": "pause_changed",
        "paused": True,
        "participant": "p1",
        "participant_name": "anna",
        "reason": "tea",
    }


def test_no_field_of_an_event_has_a_name_of_the_record() -> None:
    head = set(make_event_record(Event(1, 1, 1, PauseChanged(True)), {})) - {"participant_name", "paused", "reason"}
    for kind in EventKind.__args__:  # type: ignore[attr-defined]
        fields = set(kind.__struct_fields__)
        assert not fields & (head - {"participant"}), kind
        assert not {f"{name}_name" for name in fields & ID_FIELDS} & fields, kind
        assert not {f"{name}_names" for name in fields & ID_LIST_FIELDS} & fields, kind


def test_samples_have_their_participant_and_nan_for_what_they_lack(tmp_path: Path) -> None:
    pose = Pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    twist = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    seen = msgspec.msgpack.encode(Observation("sheet", "qr", 0.16, 1, 1, 1, IDENTITY))
    messages = [
        (7, sample("hand/left", 1, pose=pose, clutch=True, gripper=0.25, buttons=5, hand_joints=(1.0,) * 14)),
        (7, sample("head", 2, pose=pose)),
        (8, sample("joints", 1, q=(0.1, 0.2))),
        (7, seen),
        (7, b"\xc1 damaged"),
        (7, sample("hand/left", 3, twist=twist, tracked=False, worn=False)),
        (8, sample("joints", 2, q=(0.1, 0.2, 0.3))),
        (99, sample("head", 1, pose=pose)),
    ]
    with Recording.open(write(tmp_path / "session.rrd", [], messages)) as recording:
        senders = [(one.name, one.sample.device) for one in iterate_samples(recording)]
        hand = read_device_samples(recording, "ann", "hand/left")
        leader = read_device_samples(recording, "p2", "joints")
        with pytest.raises(RecordingError, match="Samples: ann hand/left, ann head, bob joints, unknown head"):
            read_device_samples(recording, "ann", "hand/right")
    assert senders == [
        *(("ann", "hand/left"), ("ann", "head"), ("bob", "joints"), ("ann", "hand/left")),
        *(("bob", "joints"), ("", "head")),
    ]
    assert (hand.seq.tolist(), hand.capture_ns.tolist(), hand.receive_ns.tolist()) == ([1, 3], [10, 30], [0, 10**7])
    assert (hand.clutch.tolist(), hand.tracked.tolist(), hand.worn.tolist()) == ([True, False],) * 3
    assert hand.buttons.tolist() == [5, 0]
    assert np.array_equal(hand.gripper, [0.25, np.nan], equal_nan=True)
    assert np.array_equal(hand.poses, [[1, 2, 3, 1, 0, 0, 0], [np.nan] * 7], equal_nan=True)
    assert np.array_equal(hand.twists, [[np.nan] * 6, twist], equal_nan=True)
    assert np.array_equal(hand.hand_joints, [[1.0] * 14, [np.nan] * 14], equal_nan=True)
    assert hand.q.shape == (2, 0)
    assert np.array_equal(leader.q, [[0.1, 0.2, np.nan], [0.1, 0.2, 0.3]], equal_nan=True)
