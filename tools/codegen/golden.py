"""Golden vectors: bytes and value of every message, for tests of this and every other implementation.

Written to docs/protocol/golden.json. Values are JSON as in MessagePack, except: byte strings are base64, and a float
that is not finite is null. An encoder of this version does not make `decode_only` vectors (a field is missing or
unknown), but they must decode to the value. `malformed` vectors must be rejected with `code`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import msgspec

from iris_session.protocol import codec
from iris_session.protocol.assets import AssetChunk, AssetRefused, AssetRequest
from iris_session.protocol.client_messages import Bye, ClientEnvelope, Episode, Hello, Pair, Sample, wrap_message
from iris_session.protocol.discovery import Beacon
from iris_session.protocol.media import MediaHeader, MediaPush, StreamBudget
from iris_session.protocol.names import PROTOCOL_VERSION
from iris_session.protocol.server_messages import (
    Event,
    Presence,
    RobotStates,
    ServerEnvelope,
    Snapshot,
    StateHeader,
)
from iris_session.protocol.status import DeliveryBudget, MediaStreamReport, StatusReport
from tools.codegen import conversions, rigid_reference
from tools.codegen.examples import iterate_examples, make_full
from tools.codegen.vectors import render_vectors

_pack = msgspec.msgpack.encode
#: Fields that messages got after their first vectors were written: a message without them must decode, too.
ADDED_FIELDS: Final[dict[type[msgspec.Struct], tuple[str, ...]]] = {
    Hello: ("certificate_hash",),
    Pair: ("identity",),
    Sample: ("emulated",),
    Episode: ("countdown_ns",),
    Snapshot: ("anchors",),
    MediaHeader: ("sent_ns", "received_ns"),
    MediaPush: ("info", "sent_ns", "connection_epoch"),
}
#: Structs that are a message of their own, without an envelope.
VERSIONED = (AssetRequest, AssetChunk, AssetRefused)


def render_golden() -> str:
    """Return the text of golden.json."""
    content = {
        "protocol_version": PROTOCOL_VERSION,
        "client": list(_iterate_messages("client", codec.CLIENT_TYPES.values())),
        "server": [*_iterate_messages("server", codec.SERVER_TYPES.values()), *_iterate_events()],
        "state_header": list(_iterate_values("state_header", StateHeader)),
        "presence": list(_iterate_values("presence", Presence)),
        "robot_states": list(_iterate_values("robot_states", RobotStates)),
        "media_header": list(_iterate_values("media_header", MediaHeader)),
        "media_push": list(_iterate_values("media_push", MediaPush)),
        "asset_request": list(_iterate_values("asset_request", AssetRequest)),
        "asset_chunk": list(_iterate_values("asset_chunk", AssetChunk)),
        "asset_refused": list(_iterate_values("asset_refused", AssetRefused)),
        "beacon": list(_iterate_values("beacon", Beacon)),
        "decode_only": list(_iterate_decode_only()),
        "decode_only_server": [
            *_iterate_earlier("server", codec.SERVER_TYPES.values()),
            *_iterate_earlier_streams(),
        ],
        "decode_only_media_header": [_make_earlier_array(MediaHeader)],
        "decode_only_media_push": [_make_earlier_array(MediaPush)],
        "malformed": list(_iterate_malformed()),
        "conversions": list(_iterate_conversions()),
        "rigid": list(_iterate_rigid()),
    }
    return render_vectors(content)


def _describe_vector(name: str, data: bytes, value: Any, **more: Any) -> dict[str, Any]:
    return {"name": name, **more, "hex": data.hex(), "value": msgspec.to_builtins(value)}


def _put_in_envelope(side: str, message: Any) -> Any:
    return ClientEnvelope(PROTOCOL_VERSION, 7, "", message) if side == "client" else ServerEnvelope(1, 7, message)


def _iterate_messages(side: str, kinds: Any) -> Iterator[dict[str, Any]]:
    for kind in kinds:
        for name, message in iterate_examples(kind):
            value = _put_in_envelope(side, message)
            yield _describe_vector(f"{codec.get_tag(kind)}/{name}", _pack(value), value)


def _iterate_events() -> Iterator[dict[str, Any]]:
    for kind in codec.EVENT_TYPES.values():
        for name, body in iterate_examples(kind, ("full", "least")):
            event = Event(event_seq=5, step=1_000, session_time=2_000_000_000, body=body)
            value = _put_in_envelope("server", event)
            yield _describe_vector(f"event/{codec.get_tag(kind)}/{name}", _pack(value), value)


def _iterate_values(group: str, kind: type[msgspec.Struct]) -> Iterator[dict[str, Any]]:
    kinds = ("full", "least") if kind is Beacon else ("full", "least", "extreme")
    for name, value in iterate_examples(kind, kinds):
        if kind in VERSIONED:
            value = msgspec.structs.replace(value, version=PROTOCOL_VERSION)  # noqa: PLW2901
        yield _describe_vector(f"{group}/{name}", _pack(value), value)


def _iterate_decode_only() -> Iterator[dict[str, Any]]:
    """Yield messages that older or newer clients may send: fields missing or unknown, other widths of numbers."""
    hello = Hello(role="surgeon", name="Ada")
    yield _describe_vector(
        "fields left out", _pack([1, 0, "", {"type": "hello", "role": "surgeon", "name": "Ada"}]), wrap_message(hello)
    )
    grown = {"new": [{"deep": 1.5}], "type": "hello", "name": "Ada", "role": "surgeon", "newer": None}
    yield _describe_vector(
        "unknown fields and another order", _pack([1, 0, "", grown, "later element"]), wrap_message(hello)
    )
    sample = Sample("head", "pose", 1, 2, 3, 4, 5, gripper=1.0)
    bare = {
        "type": "sample",
        "device": "head",
        "kind": "pose",
        "seq": 1,
        "capture_ns": 2,
        "scene_epoch": 3,
        "tracking_epoch": 4,
        "alignment_version": 5,
        "gripper": 1,
    }
    yield _describe_vector("an integer where a float is meant", _pack([1, 0, "", bare]), wrap_message(sample))
    wide = bytes.fromhex("94 d3 0000000000000001 cf 0000000000000000 d9 00 de 0002 d9 04") + b"type"
    wide += b"\xda\x00\x03bye\xa6reason\xdb\x00\x00\x00\x01x"
    yield _describe_vector("numbers and strings in wider forms", wide, wrap_message(Bye("x")))
    yield from _iterate_earlier("client", codec.CLIENT_TYPES.values())


def _iterate_earlier(side: str, kinds: Any) -> Iterator[dict[str, Any]]:
    """Yield messages as they were before they got `ADDED_FIELDS`: in journals, and of clients of that time."""
    for kind in kinds:
        if kind in ADDED_FIELDS:
            full = make_full(kind)
            fields = {field.name: field for field in msgspec.structs.fields(kind)}
            before = {name: fields[name].default for name in ADDED_FIELDS[kind]}
            later = msgspec.to_builtins(full, builtin_types=(bytes,))
            bare = {name: value for name, value in later.items() if name not in before}
            data = _pack(_put_in_envelope(side, bare))
            value = _put_in_envelope(side, msgspec.structs.replace(full, **before))
            yield _describe_vector(f"{codec.get_tag(kind)} of before", data, value)


def _iterate_earlier_streams() -> Iterator[dict[str, Any]]:
    """Yield the messages that describe media streams, as they were before streams had a title."""
    budget = {"stream": "room", "budget_class": "half", "mbit_per_s": 1.25, "encoding": "cloud"}
    delivery = {"type": "delivery_budget", "budget_class": "half", "streams": [budget]}
    stream = StreamBudget("room", "half", 1.25, "cloud")
    yield _describe_vector(
        "delivery_budget of before",
        _pack(_put_in_envelope("server", delivery)),
        _put_in_envelope("server", DeliveryBudget("half", streams=(stream,))),
    )
    report = {"stream": "room", "hz": 30.5, "source": "front", "subscribers": 2, "encoding": "cloud", "age_ms": 12.5}
    status = {"type": "status_report", "request_id": 1, "session_id": "s", "session_name": "lab", "session_time": 2}
    streams = (MediaStreamReport("room", 30.5, source="front", subscribers=2, encoding="cloud", age_ms=12.5),)
    yield _describe_vector(
        "status_report of before",
        _pack(_put_in_envelope("server", {**status, "media": [report]})),
        _put_in_envelope("server", StatusReport(1, "s", "lab", 2, media=streams)),
    )


def _make_earlier_array(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Return a vector of an array as it was before it got `ADDED_FIELDS` at its end."""
    added = ADDED_FIELDS[kind]
    full = make_full(kind)
    defaults = {field.name: field.default for field in msgspec.structs.fields(kind) if field.name in added}
    bare = msgspec.structs.astuple(full)[: -len(added)]
    return _describe_vector(f"{kind.__name__} of before", _pack(bare), msgspec.structs.replace(full, **defaults))


def _iterate_malformed() -> Iterator[dict[str, Any]]:
    """Yield bytes that a server must reject, with the code of the error."""
    good = _pack(wrap_message(Bye("x")))
    bye = b"\x94\x01\x00\xa0\x82\xa4type\xa3bye"
    cases = {
        "empty": (b"", "malformed"),
        "truncated": (good[:-1], "malformed"),
        "trailing byte": (good + b"\x00", "malformed"),
        "no MessagePack": (b"\xc1" + good[1:], "malformed"),
        "not an array": (_pack({"type": "bye"}), "malformed"),
        "unknown message type": (_pack([1, 0, "", {"type": "teleport"}]), "malformed"),
        "no message type": (_pack([1, 0, "", {"reason": "x"}]), "malformed"),
        "missing field": (_pack([1, 0, "", {"type": "clock_ping"}]), "malformed"),
        "wrong type": (_pack([1, 0, "", {"type": "clock_ping", "t0_ns": "now"}]), "malformed"),
        "negative count": (_pack([1, -1, "", {"type": "bye"}]), "malformed"),
        "above int64": (_pack([1, 2**63, "", {"type": "bye"}]), "malformed"),
        "name of 65 characters": (_pack([1, 0, "x" * 65, {"type": "bye"}]), "malformed"),
        "text that is not UTF-8": (bye + b"\xa6reason\xa2\xff\xfe", "malformed"),
        "deep nesting": (bye + b"\xa1z" + b"\x91" * 3_000 + b"\xc0", "malformed"),
        "array longer than the message": (bye + b"\xa1z\xdd\xff\xff\xff\xff", "malformed"),
        "version 2, other schema": (_pack([2, {"kind": "hi"}]), "version"),
        "version 2, same schema": (_pack([2, 0, "", {"type": "bye"}]), "version"),
        "too large for its type": (_pack([1, 0, "", {"type": "heartbeat", "pad": "x" * 600}]), "too_large"),
    }
    for name, (data, code) in cases.items():
        yield {"name": name, "code": code, "hex": data.hex()}


def _iterate_conversions() -> Iterator[dict[str, Any]]:
    """Yield world poses `x y z qw qx qy qz` and the same poses in engines, `x y z qx qy qz qw`."""
    half = math.sqrt(0.5)
    for world in (
        (1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0),
        (1.0, 2.0, 3.0, half, half, 0.0, 0.0),
        (1.0, 2.0, 3.0, half, 0.0, half, 0.0),
        (1.0, 2.0, 3.0, half, 0.0, 0.0, half),
        (-0.25, 0.5, 1.5, 0.1, 0.3, -0.9, 0.3),
    ):
        yield {"world": world, "unity": conversions.to_unity(world), "three": conversions.to_three(world)}


def _iterate_rigid() -> Iterator[dict[str, Any]]:
    """Yield payloads of the state stream: `poses` by body, as decoded; a decoder's floats may differ by 1e-12."""
    half = math.sqrt(0.5)
    poses: list[tuple[float, ...]] = [
        (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
        (9.9, -0.1, 2.9, half, 0.0, -half, 0.0),
        (-0.1, 9.9, 0.1, -0.5, 0.5, 0.5, -0.5),
        (1.234567, 2.345678, 0.876543, 0.1, 0.3, -0.9, 0.3),
        (5.0, 5.0, 1.5, 0.0, 0.0, 0.0, -1.0),
    ]
    wide: list[tuple[float, ...]] = [(90.0 * k, 80.0, -7.0 * k, *poses[k][3:]) for k in range(2)]
    nan: tuple[float, ...] = (math.nan,) * 7
    frames: dict[str, tuple[int, dict[int, Sequence[float]], dict[int, Sequence[float]]]] = {
        "nothing moved": (5, {}, {}),
        "one body": (1, {0: poses[3]}, {}),
        "room of 10 x 10 x 3 m": (5, dict(enumerate(poses)), {}),
        "two of nineteen": (19, {7: poses[1], 18: poses[2]}, {}),
        "wide: farther apart than 16 m": (2, dict(enumerate(wide)), {}),
        "escapes": (12, {3: poses[3]}, {0: nan, 11: (1e9, 0.0, -1e9, *poses[1][3:])}),
    }
    for name, (n_bodies, quantised, escaped) in frames.items():
        payload = rigid_reference.encode(n_bodies, quantised, escaped)
        decoded = rigid_reference.decode(payload)
        rows = {body: [v if math.isfinite(v) else None for v in pose] for body, pose in decoded.items()}
        yield {"name": name, "n_bodies": n_bodies, "hex": payload.hex(), "poses": rows}
