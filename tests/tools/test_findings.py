"""Findings of `tools/fuzz.py`, each with the input that showed it."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from iris_session.client.core.connection import ClientConnection
from iris_session.client.discovery import Address
from iris_session.client.errors import ClientError
from iris_session.client.identity import Identity
from iris_session.journal import rows as journal
from iris_session.journal.messages import decode_header
from iris_session.link.messages import decode_decided
from iris_session.protocol.client_messages import Heartbeat, Hello
from iris_session.protocol.codec import decode_client, encode_server
from iris_session.protocol.entries import decode_entries, decode_entry
from iris_session.protocol.server_messages import (
    Endpoints,
    Lease,
    Message,
    ProtocolFault,
    Reply,
    ServerEnvelope,
    Welcome,
)
from iris_session.security.private_folder import PrivateFolder
from iris_session.security.session_registry import SessionRegistry

MS = 1_000_000


@pytest.mark.parametrize("port", ["²", "٣", "9" * 5000, "-1", "65536"])
def test_invalid_ports_raise_client_error(port: str) -> None:
    for text in (f"lab:{port}", f"iris://lab:{port}/"):
        with pytest.raises(ClientError):
            Address.parse(text)


@pytest.mark.parametrize("decode", [decode_entry, decode_entries, decode_decided, decode_header])
@pytest.mark.parametrize("data", [b"\x91" * 5000, b"\x94\x01\x01\x01\x81\xa1\xff\x01", b"\x81\xa2\xc3\x28\x01", b""])
def test_internal_decoders_raise_one_error_type(decode: object, data: bytes) -> None:
    with pytest.raises(msgspec.DecodeError):
        decode(data)  # type: ignore[operator]


def test_inconsistent_row_counts_are_damage() -> None:
    row = journal.make_row(b"\0" * 16, 0, 0, 1, [], b"d" * 16)
    for changed in (
        {"entry_lengths": (1, 2)},
        {"entry_crcs": (2**63,)},
        {"entry_lengths": (2**64 - 1,), "entry_crcs": (1, 2, 3)},
        {"field_crcs": (2**64 - 1,) * 6},
    ):
        damaged = msgspec.structs.replace(row, **changed)
        assert journal.check_row(b"\0" * 16, damaged) is not None
        journal.check_fields(damaged)
    assert journal.check_row(b"\0" * 16, row) is None
    keyframe = journal.seal_keyframe(journal.Keyframe(3, b"p", b"a", b"c"), b"chain")
    assert journal.check_keyframe(keyframe) == ""
    assert journal.check_keyframe(msgspec.structs.replace(keyframe, step=2**64 - 1)) == "step"


def test_session_note_with_invalid_pid_is_ignored(tmp_path: Path) -> None:
    tmp_path.chmod(0o700)
    file = tmp_path / "sessions.json"
    file.touch(0o600)
    note = {"session_id": "s", "name": "lab", "pid": 2**40, "hosts": [], "control": 1, "server": ""}
    file.write_bytes(msgspec.json.encode([note]))
    assert SessionRegistry(PrivateFolder(tmp_path)).read() == []


def joined_connection(heartbeat_ns: int) -> ClientConnection:
    connection = ClientConnection(Hello("operator", "Ann"), Identity(b"s" * 16))
    connection.open(10**12)
    deliver(
        connection,
        Welcome("s", "lab", "live", "p1", 7, "operator", b"t", False, 0, heartbeat_ns, 1, 1, Endpoints(1, 2)),
    )
    return connection


def deliver(connection: ClientConnection, message: Message) -> None:
    connection.receive([encode_server(ServerEnvelope(1, 7, message))], 10**12)  # type: ignore[arg-type]


@pytest.mark.parametrize("heartbeat_ns", [-(2**63), 0, 1])
def test_heartbeat_interval_of_session_is_limited(heartbeat_ns: int) -> None:
    connection = joined_connection(heartbeat_ns)
    heartbeats = 0
    for i in range(100):
        connection.tick(10**12 + i * MS)
        assert connection.next_deadline_ns(10**12 + i * MS) > 10**12
        while (waiting := connection.peek_outgoing()) is not None:
            heartbeats += isinstance(decode_client(waiting[1]).message, Heartbeat)
            connection.pop_outgoing(sent=True)
    assert heartbeats <= 10


def test_silent_session_is_detected_for_any_heartbeat() -> None:
    connection = joined_connection(2**63 - 1)
    now_ns = 10**12
    for _ in range(100):
        now_ns += 500 * MS
        connection.tick(now_ns)
    assert connection.counters.reconnects == 1


def test_faults_and_leases_of_a_client_are_bounded() -> None:
    connection = joined_connection(500 * MS)
    for i in range(6000):
        deliver(connection, ProtocolFault(f"code{i}", "x"))
        deliver(connection, Reply(0, True, leases=(Lease(f"robot{i}", "robot", "exclusive", "p1", 1),)))
    assert len(connection.counters.faults) <= 65
    assert sum(connection.counters.faults.values()) == 6000
    assert len(connection.requests._granted) <= 4096
