"""Entries and decisions round-trip through the journal; a fixed view is a `WorldView`; wire and journal names agree."""

from __future__ import annotations

from typing import get_args

import msgspec
import pytest

from iris_session.protocol import entries
from iris_session.protocol.client_messages import Bye, ClientMessage, Hello
from iris_session.protocol.codec import decode_server, encode_server
from iris_session.protocol.common import MAX_TEXT, Denial, Pose
from iris_session.protocol.entries import Entry, decode_entries, decode_entry, encode_entries, encode_entry
from iris_session.protocol.scene import RemoveVisual, SetVisual
from iris_session.protocol.server_messages import Reply, ServerEnvelope
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


def test_denial_of_a_large_scene_fits_the_wire() -> None:
    names = ", ".join(f"free_body_{i}" for i in range(300))
    denial = Denial("unknown_target", f"no object x among {names}", f"objects: {names}", "x")
    assert denial.advice.startswith("objects: free_body_0, ")
    assert denial.advice.endswith("...")
    assert len(denial.message) == len(denial.advice) == MAX_TEXT
    answer = ServerEnvelope(1, 1, Reply(1, False, denial))
    assert decode_server(encode_server(answer)) == answer
    assert Denial("held", "short", "wait").advice == "wait"
