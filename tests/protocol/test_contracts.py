"""Entries and decisions round-trip through the journal; a fixed view is a `WorldView`; wire and journal names agree."""

from __future__ import annotations

from typing import get_args

import msgspec
import pytest

from iris_session.protocol import entries, specs, steps
from iris_session.protocol.client_messages import Bye, ClientMessage, Hello, Sample
from iris_session.protocol.codec import decode_server, encode_server
from iris_session.protocol.common import IDENTITY, MAX_TEXT, Applied, Denial, Pose, Target
from iris_session.protocol.entries import Entry, decode_entries, decode_entry, encode_entries, encode_entry
from iris_session.protocol.scene import RemoveVisual, SetVisual
from iris_session.protocol.server_messages import Event, Feedback, Notice, PresenceItem, Reply, ServerEnvelope
from iris_session.protocol.specs import RobotSpec
from tools.codegen.examples import make_extreme, make_full, make_least

WIRE = set(get_args(ClientMessage))
INTERNAL = [kind for kind in get_args(entries.EntryMessage) if kind not in WIRE]

JOIN = entries.Join("ab12", "operator", "Ada", "test 1", ("head",), ("x",), "measured", "p1", 3)
PROPOSAL = entries.AlignmentProposal(
    Pose((0.1, -0.0, 1e-300), (1.0, 0.0, 0.0, 0.0)),
    1,
    (0.1 + 0.2,) * 36,
    (1.0, 2.0, 3.0),
    0.004,
    0.01,
    5,
    2,
    True,
    "closer",
)


@pytest.mark.parametrize("make", [make_full, make_least, make_extreme])
@pytest.mark.parametrize("kind", [kind for kind in get_args(entries.EntryMessage) if kind in WIRE])
def test_client_messages_round_trip_as_entries(kind: type[msgspec.Struct], make: object) -> None:
    entry = Entry(1, 2, 3, make(kind))  # type: ignore[operator]
    assert decode_entry(encode_entry(entry)) == entry


@pytest.mark.parametrize(
    "message",
    [
        JOIN,
        PROPOSAL,
        entries.Lost("silent"),
        entries.ExternalReset(),
        entries.StalledGap(12),
        entries.FrontRestarted(),
        entries.Audit("key_refused", "ab12", "Ada", "10.0.0.7", "pair", 3),
        entries.SessionResumed(5_000_000_000),
        entries.RecordingGap(7),
        entries.SceneLoaded("ab12", (RobotSpec("left", ("j",), ("a",), "tcp", "base"),), (), b"state"),
        entries.ScenePatched((SetVisual(1, rgba=(1.0, 0.0, 0.0, 1.0)), RemoveVisual(2)), "cd34"),
    ],
    ids=lambda message: type(message).__name__,
)
def test_internal_messages_round_trip_as_entries(message: entries.EntryMessage) -> None:
    batch = [Entry(entries.HOST, 0, 5, message), Entry(2, 2, 6, Bye())]
    assert decode_entries(encode_entries(batch)) == batch
    assert encode_entries(decode_entries(encode_entries(batch))) == encode_entries(batch)


def test_every_internal_message_is_covered() -> None:
    names = {"Join", "Lost", "AlignmentProposal", "ExternalReset", "StalledGap", "FrontRestarted", "RecordingGap"}
    names |= {
        "Audit",
        "SessionResumed",
        "AlignmentAlarm",
        "TipSolved",
        "CrossChecked",
        "SceneLoaded",
        "ScenePatched",
        "OwnerListens",
        "PhysicsDiverged",
    }
    assert {kind.__name__ for kind in INTERNAL} == names


def test_client_cannot_send_internal_messages() -> None:
    """No tag of an internal message is one of the wire: the front never decodes a `join` or `lost`."""
    wire = {kind.__struct_config__.tag for kind in WIRE}
    assert not wire & {kind.__struct_config__.tag for kind in INTERNAL}


def test_secrets_are_not_in_the_journal() -> None:
    assert Hello not in get_args(entries.EntryMessage)
    for kind in get_args(entries.EntryMessage):
        assert not {"secret", "resume_token", "join_code"} & set(kind.__struct_fields__)


def test_bad_journal_bytes_are_decode_errors() -> None:
    for data in (b"", b"\xc1", encode_entry(Entry(1, 1, 1, Bye()))[:-1]):
        with pytest.raises(msgspec.DecodeError):
            decode_entry(data)
        with pytest.raises(msgspec.DecodeError):
            decode_entries(data)


def test_urgent_messages_are_entries() -> None:
    assert set(entries.URGENT) <= set(get_args(entries.EntryMessage))
    assert Sample not in entries.URGENT


def test_decision_digest_bytes_round_trip() -> None:
    source = steps.CommandSource("p1", "controller/right", 1, 2, 3, 4, pose_world=IDENTITY)
    decision = steps.Decision(
        commands=(
            steps.Command("left", "pose", sources=(source,), gripper=0.5),
            steps.Command("right", "hold", "estop"),
        ),
        objects=(steps.ObjectCommand("board", 1, IDENTITY),),
        outgoing=(steps.OutgoingMessage(1, Feedback("left", "pose", rejected={"seq": 1})),),
        admitted=(steps.Admitted(1, "p1", "operator", False),),
        dropped=(steps.Dropped(2, "bye"),),
        events=(Event(1, 2, 3, Notice("info", "hello")),),
        presence=(PresenceItem("p1", "head", IDENTITY, 5),),
        event_seq=1,
    )
    data = msgspec.msgpack.encode(decision)
    assert msgspec.msgpack.decode(data, type=steps.Decision) == decision


def test_fixed_view_is_a_world_view() -> None:
    view: steps.WorldView = steps.FixedView(
        tick=7,
        sim_time=0.014,
        tips={"left": IDENTITY},
        q={"left": (0.1, 0.2)},
        objects={"board": IDENTITY},
        contacts=(steps.ObjectContact("board", ("left",), ("left",), ()),),
        forces={"left": 2.5},
    )
    assert (view.tick, view.sim_time) == (7, 0.014)
    assert view.tip_pose("left") == view.object_pose("board") == IDENTITY
    assert view.joints("left") == (0.1, 0.2)
    assert view.object_contacts()[0].grippers == ("left",)
    assert (view.gripper_force("left"), view.gripper_force("right")) == (2.5, 0.0)


def test_status_and_specs_are_values() -> None:
    applied = Applied("left", "p1", "head", 1, 2, 3, 4)
    assert steps.ControlStatus("left", ("joint1",), applied) == steps.ControlStatus("left", ("joint1",), applied)
    robot = specs.RobotSpec("left", ("j",), ("a",), "tcp", "base")
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(robot), type=specs.RobotSpec) == robot
    assert hash(specs.ObjectSpec("board", "board")) == hash(specs.ObjectSpec("board", "board"))
    assert Target("left", 1).kind == "robot"


def test_denial_of_a_large_scene_fits_the_wire() -> None:
    names = ", ".join(f"free_body_{i}" for i in range(300))
    denial = Denial("unknown_target", f"no object x among {names}", f"objects: {names}", "x")
    assert denial.advice.startswith("objects: free_body_0, ")
    assert denial.advice.endswith("...")
    assert len(denial.message) == len(denial.advice) == MAX_TEXT
    answer = ServerEnvelope(1, 1, Reply(1, False, denial))
    assert decode_server(encode_server(answer)) == answer
    assert Denial("held", "short", "wait").advice == "wait"
