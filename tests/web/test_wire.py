"""Bytes of the web channel: vectors both ways, refusals, and names that arbitrary bytes cannot change."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iris_session.protocol.client_messages import Bye, Heartbeat, Hello, wrap_message
from iris_session.protocol.codec import decode_client, encode_client, encode_server
from iris_session.protocol.errors import MalformedError, ProtocolError, ProtocolVersionError, TooLargeError
from iris_session.protocol.limits import MAX_CLIENT_BYTES, MAX_CONTROL_BYTES
from iris_session.protocol.server_messages import ClockPong, ProtocolFault, ServerEnvelope
from iris_session.web import wire
from iris_session.web.hub import NAME_LENGTH
from tools.codegen.web_golden import build_golden, render_golden

#: Of a MESSAGE command of CurveZMQ around a frame (RFC 26): its name, nonce, authentication and flags.
CURVE_BYTES = 8 + 8 + 16 + 1
FILE = Path(__file__).parents[2] / "docs" / "protocol" / "web.json"
GOLDEN: dict[str, Any] = json.loads(FILE.read_text())


def cases(section: str) -> pytest.MarkDecorator:
    rows = GOLDEN[section]
    return pytest.mark.parametrize("row", rows, ids=[row["name"] for row in rows])


def test_vectors_are_current() -> None:
    assert FILE.read_text() == render_golden()
    assert json.loads(json.dumps(build_golden())) == GOLDEN
    assert GOLDEN["subprotocol"] == wire.SUBPROTOCOL


@cases("messages")
def test_messages_both_ways(row: dict[str, Any]) -> None:
    data, frames = bytes.fromhex(row["hex"]), [bytes.fromhex(frame) for frame in row["frames"]]
    channel, decoded = wire.decode_frames(data)
    assert (channel, [bytes(frame) for frame in decoded]) == (row["channel"], frames)
    assert wire.encode_frames(channel, frames) == data


@cases("refused")
def test_containers_that_must_be_refused(row: dict[str, Any]) -> None:
    with pytest.raises(MalformedError):
        wire.decode_frames(bytes.fromhex(row["hex"]))


@cases("gateway")
def test_gateway_messages(row: dict[str, Any]) -> None:
    data, value = bytes.fromhex(row["hex"]), row["value"]
    if isinstance(value, list):
        assert wire.decode_subscriptions(data) == frozenset(value)
        return
    message = wire.decode_gateway_message(data)
    assert {**msgspec.to_builtins(message), **value} == msgspec.to_builtins(message)


@cases("envelopes")
def test_a_gateway_fills_in_the_name(row: dict[str, Any]) -> None:
    data, name = bytes.fromhex(row["hex"]), row["on_behalf_of"]
    spliced = wire.splice_name(data, name)
    assert spliced == bytes.fromhex(row["spliced"])
    before, after = decode_client(data), decode_client(spliced)
    assert after.on_behalf_of == name
    assert msgspec.structs.replace(after, on_behalf_of="") == before


@cases("bad_envelopes")
def test_envelopes_that_close_the_socket(row: dict[str, Any]) -> None:
    expected = ProtocolVersionError if row["close"] == wire.CLOSE_VERSION else (MalformedError, wire.ForgedNameError)
    with pytest.raises(expected):
        wire.splice_name(bytes.fromhex(row["hex"]), "web-00112233aabb")


@given(st.integers(0, 255), st.lists(st.binary(max_size=40), min_size=1, max_size=255))
def test_any_frames_come_back(channel: int, frames: list[bytes]) -> None:
    decoded_channel, decoded = wire.decode_frames(wire.encode_frames(channel, frames))
    assert (decoded_channel, [bytes(frame) for frame in decoded]) == (channel, frames)


@given(st.binary(max_size=64))
def test_what_follows_the_name_cannot_change_it(rest: bytes) -> None:
    envelope = wire.splice_name(b"\x94\x01\x07\xa0" + rest, "web-00112233aabb")
    assert envelope.startswith(b"\x94\x01\x07\xb0web-00112233aabb")
    try:
        assert decode_client(envelope).on_behalf_of == "web-00112233aabb"
    except ProtocolError:
        return


def test_what_a_gateway_takes_the_session_takes_with_the_name_in_it() -> None:
    def make(pad: int) -> bytes:
        return msgspec.msgpack.encode([1, 7, "", {"type": "samples", "samples": [], "pad": bytes(pad)}])

    largest = make(2 * MAX_CLIENT_BYTES - len(make(MAX_CLIENT_BYTES)))
    assert len(largest) == MAX_CLIENT_BYTES
    assert len(wire.encode_frames(wire.CONTROL, [largest])) == wire.MAX_CLIENT_MESSAGE
    spliced = wire.splice_name(largest, "w" * NAME_LENGTH)
    assert decode_client(spliced).on_behalf_of == "w" * NAME_LENGTH
    assert len(spliced) + CURVE_BYTES <= MAX_CONTROL_BYTES
    with pytest.raises(TooLargeError):
        decode_client(wire.splice_name(make(MAX_CLIENT_BYTES), "w" * NAME_LENGTH))


@pytest.mark.parametrize("nested", [b"\xdd\x00\x0f\x42\x40", b"\xdf\x00\x0f\x42\x40"])
def test_nested_heads_are_refused_before_they_take_memory(nested: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(MalformedError):
            wire.splice_name(b"\x94" + nested * 1000, "web-00112233aabb")
        assert tracemalloc.get_traced_memory()[1] < 100_000
    finally:
        tracemalloc.stop()


def test_the_longest_head_of_an_envelope_is_read() -> None:
    head = b"\xdd\0\0\0\4" + b"\xcf" + (1).to_bytes(8, "big") + b"\xcf" + (2**64 - 1).to_bytes(8, "big")
    assert wire.splice_name(head + b"\xdb\0\0\0\0" + b"rest", "web-1") == head + b"\xa5web-1" + b"rest"
    with pytest.raises(wire.ForgedNameError):
        wire.splice_name(head + b"\xdb\0\0\0\x1f" + b"n" * 31, "web-1")


def test_names_have_one_byte_of_length() -> None:
    with pytest.raises(TooLargeError):
        wire.splice_name(encode_client(wrap_message(Heartbeat())), "n" * 32)


def test_subscriptions_are_bounded_names_and_nonsense_is_refused() -> None:
    for names in (["a"] * 17, ["-x"], [""], ["a/b"]):
        with pytest.raises(MalformedError):
            wire.decode_subscriptions(msgspec.msgpack.encode(names))
    with pytest.raises(MalformedError):
        wire.decode_gateway_message(b"\xc1")


def test_types_are_read_without_the_message() -> None:
    assert wire.peek_client_message(encode_client(wrap_message(Bye(), 3, "x"))) == wire.ClientHead("bye")
    hello = encode_client(wrap_message(Hello("observer", "ann", secret=b"s"), 0))
    assert wire.peek_client_message(hello) == wire.ClientHead("hello", b"s", [])
    pong = encode_server(ServerEnvelope(1, 9, ClockPong(1, 2, 3)))
    assert wire.peek_server_message(pong) == (9, "clock_pong", "")
    fault = encode_server(ServerEnvelope(1, 9, ProtocolFault("revoked", "text")))
    assert wire.peek_server_message(fault) == (9, "protocol_fault", "revoked")
    for no_message in (b"\xc1", bytes(wire.MAX_PEEKED + 1)):
        assert wire.peek_server_message(no_message).type == ""
