"""The trust boundary: round trips, and typed errors. Random and damaged bytes: tests/tools/test_fuzz.py."""

from __future__ import annotations

import math
from array import array
from typing import Any

import msgspec
import numpy as np
import pytest

from iris_session.protocol import codec
from iris_session.protocol.client_messages import Hello, Sample, wrap_message
from iris_session.protocol.common import Pose, Target
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.errors import MalformedError, ProtocolVersionError, TooLargeError
from iris_session.protocol.limits import (
    LIMITS,
    MAX_CLIENT_BYTES,
    MAX_INTRODUCTION_BYTES,
    MAX_MEDIA_FRAME_BYTES,
    MAX_ON_BEHALF_BYTES,
    MAX_SERVER_BYTES,
)
from iris_session.protocol.media import StreamCamera, StreamInfo
from iris_session.protocol.server_messages import Event, Presence, ServerEnvelope, StateHeader
from tools.codegen.examples import make_extreme, make_full, make_least

pack = msgspec.msgpack.encode
MAKES = (make_full, make_least, make_extreme)
BYE = b"\x94\x01\x00\xa0\x82\xa4type\xa3bye"


@pytest.mark.parametrize("make", MAKES)
@pytest.mark.parametrize("tag", codec.CLIENT_TYPES)
def test_client_messages_round_trip(tag: str, make: object) -> None:
    value = wrap_message(make(codec.CLIENT_TYPES[tag]), 3)  # type: ignore[operator]
    data = codec.encode_client(value)
    assert codec.decode_client(data) == value
    assert codec.encode_client(codec.decode_client(memoryview(data))) == data


@pytest.mark.parametrize("make", MAKES)
@pytest.mark.parametrize("tag", codec.SERVER_TYPES)
def test_server_messages_round_trip(tag: str, make: object) -> None:
    value = ServerEnvelope(1, 3, make(codec.SERVER_TYPES[tag]))  # type: ignore[operator]
    data = codec.encode_server(value)
    assert codec.decode_server(data) == value
    assert codec.encode_server(codec.decode_server(bytearray(data))) == data


@pytest.mark.parametrize("make", MAKES)
@pytest.mark.parametrize("tag", codec.EVENT_TYPES)
def test_events_round_trip(tag: str, make: object) -> None:
    value = ServerEnvelope(1, 3, Event(1, 2, 3, make(codec.EVENT_TYPES[tag])))  # type: ignore[operator]
    assert codec.decode_server(codec.encode_server(value)) == value


@pytest.mark.parametrize("make", MAKES)
def test_state_channel_round_trips(make: object) -> None:
    header, presence = make(StateHeader), make(Presence)  # type: ignore[operator]
    assert codec.decode_state_header(codec.encode_state_header(header)) == header
    assert codec.decode_presence(codec.encode_presence(presence)) == presence


def test_introduction_round_trips_and_waits_for_its_end() -> None:
    beacon = msgspec.structs.replace(make_full(Beacon), protocol=1)
    introduction = msgspec.structs.replace(make_full(Introduction), beacon=beacon)
    data = codec.encode_introduction(introduction)
    assert codec.decode_introduction(data) == introduction
    assert codec.decode_introduction(bytearray(data)) == introduction
    assert [codec.decode_introduction(data[:n]) for n in range(len(data))] == [None] * len(data)
    with pytest.raises(MalformedError, match="after its end"):
        codec.decode_introduction(data + b"x")
    with pytest.raises(TooLargeError):
        codec.decode_introduction((MAX_INTRODUCTION_BYTES + 1).to_bytes(4, "big"))
    later = msgspec.structs.replace(introduction, beacon=msgspec.structs.replace(beacon, protocol=7))
    with pytest.raises(ProtocolVersionError):
        codec.decode_introduction(codec.encode_introduction(later))


def test_non_finite_floats_pass_to_the_authority() -> None:
    pose = Pose((math.nan, math.inf, -math.inf), (1.0, 0.0, 0.0, 0.0))
    decoded = codec.decode_client(codec.encode_client(wrap_message(Sample("head", "pose", 1, 2, 3, 4, 5, pose=pose))))
    assert isinstance(decoded.message, Sample)
    assert decoded.message.pose is not None
    assert math.isnan(decoded.message.pose.p[0])
    assert decoded.message.pose.p[1:] == (math.inf, -math.inf)


def test_unknown_names_and_fields_are_accepted() -> None:
    data = pack([1, 0, "", {"type": "hello", "role": "juggler", "name": "A", "hat": {"colour": [1, 2]}}, "more"])
    assert codec.decode_client(data).message == Hello(role="juggler", name="A")


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"", "truncated"),
        (b"\xc1", "no envelope"),
        (pack({"version": 1}), "MessagePack array"),
        (pack("hello"), "MessagePack array"),
        (pack([]), "no envelope"),
        (pack([1.5, 0, "", {"type": "bye"}]), "no envelope"),
        (pack([1, 0, ""]), "length 4"),
        (pack([1, 0, "", 5]), "Expected `object`, got `int`"),
        (pack([1, 0, "", {"type": "teleport"}]), "type 'teleport', .*hello, bye"),
        (pack([1, 0, "", {"type": "welcome"}]), "type 'welcome'"),
        (pack([1, 0, "", {"reason": "x"}]), "field `type`"),
        (pack([1, 0, "", {"type": 7}]), r"Expected `str`, got `int` - at `\$\[3\].type`"),
        (pack([1, 0, "", {"type": "clock_ping"}]), "clock_ping: .*`t0_ns`"),
        (pack([1, 0, "", {"type": "clock_ping", "t0_ns": 1.5}]), "Expected `int`, got `float`"),
        (pack([1, 0, "", {"type": "clock_ping", "t0_ns": 2**63}]), "<= 9223372036854775807"),
        (pack([1, -1, "", {"type": "bye"}]), ">= 0"),
        (pack([1, 2**64 - 1, "", {"type": "bye"}]), "<= 9223372036854775807"),
        (pack([1, 0, "x" * 65, {"type": "bye"}]), "length <= 64"),
        (pack([1, 0, "", {"type": "bye", "reason": b"x"}]), "Expected `str`, got `bytes`"),
        (pack([1, 0, "", {"type": "acquire", "request_id": 1, "robots": ["r"] * 33}]), "length <= 32"),
        (pack([1, 0, "", {"type": "bye"}]) + b"\0", "trailing"),
        (BYE + b"\xa6reason\xa2\xff\xfe", "(?i)utf-8"),
        (BYE + b"\xa1z" + b"\x91" * 3000 + b"\xc0", "recursion"),
        (BYE + b"\xa1z\xdd\xff\xff\xff\xff", "truncated"),
        (b"\x94\x01\x00\xa0\xdf\xff\xff\xff\xff\xa4type\xa3bye", "truncated"),
        (BYE + b"\x05\xa1z", "Expected `str`, got `int`"),
    ],
)
def test_malformed_messages_name_the_fault(data: bytes, match: str) -> None:
    with pytest.raises(MalformedError, match=match) as caught:
        codec.decode_client(data)
    assert caught.value.code == "malformed"


def test_unknown_event_and_server_type_are_named() -> None:
    event = {"type": "event", "event_seq": 1, "step": 1, "session_time": 1, "body": {"event": "fireworks"}}
    with pytest.raises(MalformedError, match=r"event 'fireworks', .*participant_joined"):
        codec.decode_server(pack([1, 0, event]))
    with pytest.raises(MalformedError, match="field `event`"):
        codec.decode_server(pack([1, 0, {**event, "body": {}}]))
    with pytest.raises(MalformedError, match=r"type 'hello', .*welcome"):
        codec.decode_server(pack([1, 0, {"type": "hello"}]))


@pytest.mark.parametrize("version", [0, 2, -1, 2**64 - 1])
def test_other_versions_are_reported_before_the_schema(version: int) -> None:
    for rest in ([{"x": 1}], [0, "", {"type": "bye"}], [0, "", {"type": "new"}], [None] * 9):
        data = pack([version, *rest])
        assert codec.peek_version(data) == version
        with pytest.raises(ProtocolVersionError, match=f"version {version}, .* 1") as caught:
            codec.decode_client(data)
        assert caught.value.version == version
        assert caught.value.code == "version"
    with pytest.raises(ProtocolVersionError):
        codec.decode_server(pack([version, 0, {"type": "clock_pong", "t0_ns": 1, "t1_ns": 2, "t2_ns": 3}]))


@pytest.mark.parametrize("tag", codec.CLIENT_TYPES)
def test_size_limit_of_each_type(tag: str) -> None:
    kind = codec.CLIENT_TYPES[tag]
    message = msgspec.to_builtins(make_least(kind), builtin_types=(bytes,))
    limit = LIMITS[kind].max_bytes

    def padded(size: int) -> bytes:
        bare = len(pack([1, 0, "", {**message, "pad": bytes(256)}])) - 256
        return pack([1, 0, "", {**message, "pad": bytes(size - bare)}])

    if limit > 512:  # a shorter pad has another header
        assert len(padded(limit)) == limit
        codec.decode_client(padded(limit))
    with pytest.raises(TooLargeError) as caught:
        codec.decode_client(padded(limit + 1 if limit > 512 else 700))
    assert caught.value.limit in (limit, MAX_CLIENT_BYTES + MAX_ON_BEHALF_BYTES)
    assert caught.value.size > limit
    assert caught.value.code == "too_large"


def test_size_limit_of_all_messages() -> None:
    with pytest.raises(TooLargeError):
        codec.decode_client(b"\0" * (MAX_CLIENT_BYTES + MAX_ON_BEHALF_BYTES + 1))
    with pytest.raises(TooLargeError):
        codec.decode_server(bytes(MAX_SERVER_BYTES + 1))
    with pytest.raises(TooLargeError, match="clock_pong"):
        codec.decode_server(pack([1, 0, {"type": "clock_pong", "t0_ns": 1, "t1_ns": 2, "t2_ns": 3, "z": b"x" * 600}]))


def test_largest_valid_sample_fits() -> None:
    """Full hands, a leader of 64 joints and two targets, names of 16 characters."""
    value = 1.2345678901234567
    pose = Pose((value,) * 3, (value,) * 4)
    targets = (Target("left-arm-of-lab1", 2**40), Target("right-arm-of-lab", 2**40))
    sample = Sample("controller/right", "pose", *(2**50,) * 5, targets=targets, pose=pose, twist=(value,) * 6)
    sample = msgspec.structs.replace(sample, hand_joints=(value,) * 182, q=(value,) * 64, qd=(value,) * 64)
    assert codec.decode_client(codec.encode_client(wrap_message(sample, 2**40, "somebody"))).message == sample


def test_state_channel_and_beacon_errors() -> None:
    for decode in (codec.decode_state_header, codec.decode_presence, codec.decode_beacon):
        with pytest.raises(MalformedError, match="no "):
            decode(b"\xc1")
        with pytest.raises(TooLargeError):
            decode(bytes(300_000))
    with pytest.raises(MalformedError, match="no beacon"):
        codec.decode_beacon(pack({"protocol": 1}))
    with pytest.raises(ProtocolVersionError, match="version 9"):
        codec.decode_beacon(pack({"protocol": 9, "shape": "round"}))


def test_long_foreign_texts_are_truncated() -> None:
    with pytest.raises(MalformedError) as caught:
        codec.decode_client(pack([1, 0, "", {"type": "é" * 5000}]))
    assert len(str(caught.value)) <= 400
    assert len(str(MalformedError("x" * 401))) == 400


def _camera(**changes: Any) -> StreamCamera:
    return msgspec.structs.replace(StreamCamera(640, 480, 585.0, 585.0, 319.5, 239.5), **changes)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"frames": 3}, "int: bytes"),
        ({"frames": "text"}, "str: bytes"),
        ({"frames": {"full": None}}, "NoneType: bytes"),
        ({"frames": {"half": b""}}, "has class 'full'"),
        ({"frames": array("d", bytes(MAX_MEDIA_FRAME_BYTES + 8))}, f"at most {MAX_MEDIA_FRAME_BYTES}"),
        ({"stream": 3}, "^3 "),
        ({"capture_ns": "now"}, "capture_ns 'now'"),
        ({"capture_ns": 0.5}, "capture_ns 0.5"),
        ({"capture_ns": 10**30}, "capture_ns 1000"),
        ({"encoding": 3}, "encoding 3"),
        ({"sent_ns": 0.5}, "Expected `int`"),
        ({"info": "room"}, "Expected `object . null`"),
        ({"info": StreamInfo(title="x" * 513)}, "length <= 512"),
        ({"info": StreamInfo(hz=math.nan)}, "hz of a media stream: nan"),
        ({"info": StreamInfo(hz=-1.0)}, "hz of a media stream: -1"),
        ({"info": StreamInfo(camera=_camera(width=4097))}, "camera of 4097 x 480"),
        ({"info": StreamInfo(camera=_camera(height=0))}, "camera of 640 x 0"),
        ({"info": StreamInfo(camera=_camera(fx=math.inf))}, "intrinsics"),
        ({"info": StreamInfo(camera=_camera(fy=0.0))}, "intrinsics"),
        ({"info": StreamInfo(camera=_camera(distortion=(0.0, math.nan, 0.0, 0.0)))}, "intrinsics"),
        ({"info": StreamInfo(camera=_camera(distortion=(0.1,)))}, "1 distortion coefficients"),
        ({"info": StreamInfo(camera=_camera(position=(0.0, math.nan, 0.0)))}, "position of a camera"),
        ({"info": StreamInfo(camera=_camera(orientation=(0.0, 0.0, 0.0, 0.0)))}, "orientation of a camera"),
    ],
)
def test_invalid_media_are_rejected_at_publishing(given: dict[str, object], expected: str) -> None:
    """Otherwise the call would succeed and no front would accept the frame."""
    good = {"stream": "cloud", "frames": b"points", "capture_ns": 5, "scene_epoch": 1, "encoding": "bytes"}
    header, *data = codec.encode_media_frames(**good)  # type: ignore[arg-type]
    assert codec.decode_media_push(header).stream == "cloud"
    assert data == [b"points"]
    with pytest.raises(ValueError, match=expected):
        codec.encode_media_frames(**(good | given))  # type: ignore[arg-type]


def test_media_arrays_are_encoded_in_row_order() -> None:
    """A flipped picture is not contiguous in memory; sockets need contiguous bytes."""
    rows = np.arange(6, dtype=np.uint8).reshape(3, 2)
    frames = {"full": rows[::-1], "half": array("H", [1, 2])}
    _, *data = codec.encode_media_frames("cloud", frames, 5, 1, "bytes")  # type: ignore[arg-type]
    assert data == [bytes([4, 5, 2, 3, 0, 1]), array("H", [1, 2]).tobytes()]
    assert [len(one) for one in data] == [6, 4]
