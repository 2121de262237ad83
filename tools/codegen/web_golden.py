"""Golden vectors of the web channel, for tests of gateways and of clients without ZeroMQ.

docs/protocol/web.json, written by `python -m tools.codegen web`: WebSocket messages with their frames, messages
that must be refused, the messages of a gateway, and what a gateway makes of a client's envelope.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import msgspec

from iris_session.protocol.client_messages import ClockPing, Heartbeat, Hello, wrap_message
from iris_session.protocol.codec import (
    encode_client,
    encode_media_header,
    encode_presence,
    encode_server,
    encode_state_header,
)
from iris_session.protocol.media import MediaHeader
from iris_session.protocol.names import PROTOCOL_VERSION
from iris_session.protocol.server_messages import (
    TOPIC_PRESENCE,
    TOPIC_RIGID,
    ClockPong,
    Presence,
    ServerEnvelope,
    StateHeader,
)
from iris_session.web.wire import (
    CONTROL,
    GATEWAY,
    MEDIA,
    MEDIA_WISHES,
    STATE,
    SUBPROTOCOL,
    GatewayNotice,
    Ticket,
    encode_frames,
    splice_name,
)
from tools.codegen.vectors import render_vectors

_encode = msgspec.msgpack.Encoder().encode
_NAME: Final = "web-00112233aabb"
_HELLO: Final = encode_client(wrap_message(Hello("observer", "ann", secret=bytes(range(32)))))


def _iterate_messages() -> Iterator[tuple[str, int, list[bytes]]]:
    """Yield name, channel and frames of messages in both directions."""
    pong = encode_server(ServerEnvelope(PROTOCOL_VERSION, 7, ClockPong(1, 2, 3)))
    header = StateHeader(1, 0, 5, 0.01, 20_000_000, 21_000_000, 5, 0)
    yield "hello, to the gateway", CONTROL, [_HELLO]
    yield "heartbeat, to the gateway", CONTROL, [encode_client(wrap_message(Heartbeat(), 7))]
    yield "clock pong", CONTROL, [pong]
    yield "an answer with a bulk frame", CONTROL, [pong, bytes(range(56))]
    yield "rigid state", STATE, [TOPIC_RIGID, encode_state_header(header), bytes(20)]
    yield "presence", STATE, [TOPIC_PRESENCE, encode_presence(Presence(20_000_000, 21_000_000, ()))]
    yield (
        "a frame of media",
        MEDIA,
        [
            b"media/7/cloud/half",
            encode_media_header(MediaHeader("cloud", "half", 1, 4, 20_000_000, 21_000_000)),
            b"frame",
        ],
    )
    yield "an empty frame", CONTROL, [pong, b""]
    yield "media wishes", MEDIA_WISHES, [_encode(["cloud", "cloth-1"])]
    yield "no media wishes", MEDIA_WISHES, [_encode([])]
    yield "ticket", GATEWAY, [_encode(Ticket("kJvZ0d3v9X1c", 600))]
    yield "ticket, from a client", GATEWAY, [_encode({"type": "ticket", "ticket": "kJvZ0d3v9X1c"})]
    yield "notice", GATEWAY, [_encode(GatewayNotice("the session was updated: reload this page"))]


#: Containers that must be refused.
_REFUSED: Final = {
    "empty": b"",
    "channel alone": b"\x01",
    "no frame": b"\x01\x00",
    "lengths cut off": b"\x01\x02\x01\x00\x00\x00",
    "frame cut off": b"\x01\x01\x05\x00\x00\x00abcd",
    "a byte too many": b"\x01\x01\x03\x00\x00\x00abcd",
    "length of 4 GiB": b"\x01\x01\xff\xff\xff\xffab",
    "sum of lengths beyond 4 GiB": b"\x01\x02\xff\xff\xff\xff\x03\x00\x00\x00ab",
}


def _iterate_envelopes() -> Iterator[tuple[str, bytes]]:
    """Yield envelopes of clients, whose name a gateway fills in."""
    ping = encode_client(wrap_message(ClockPing(5), 300))
    message = ping[ping.index(b"\xa0") + 1 :]
    yield "hello", _HELLO
    yield "clock ping, epoch of two bytes", ping
    yield "array of 16-bit length, empty string of 8-bit length", b"\xdc\x00\x04\x01\xcd\x01\x2c\xd9\x00" + message
    yield (
        "array of 32-bit length, wide integers",
        b"\xdd\x00\x00\x00\x04\xcf"
        + (1).to_bytes(8, "big")
        + b"\xd3"
        + (300).to_bytes(8, "big")
        + b"\xdb\x00\x00\x00\x00"
        + message,
    )
    yield "an element of a later version at the end", b"\x95" + ping[1:] + b"\xc3"


#: Envelopes that close the WebSocket, with the code.
_BAD_ENVELOPES: Final = {
    "a name that the client has set": (b"\x94\x01\x07\xa3bob\x80", 4003),
    "the name of another client": (b"\x94\x01\x07\xb0" + _NAME.encode() + b"\x80", 4003),
    "another version": (b"\x94\x02\x07\xa0\x80", 4001),
    "too few elements": (b"\x93\x01\x07\xa0", 4003),
    "not an array": (b"\x84\x01\x07\xa0\x80", 4003),
    "cut off in the epoch": (b"\x94\x01\xcd\x01", 4003),
    "name of another type": (b"\x94\x01\x07\xc0\x80", 4003),
    "cut off in the name": (b"\x94\x01\x07\xdb\x00\x00", 4003),
    "empty": (b"", 4003),
}


def build_golden() -> dict[str, Any]:
    """Return the content of the file."""
    return {
        "format": 1,
        "subprotocol": SUBPROTOCOL,
        "messages": [
            {
                "name": name,
                "channel": channel,
                "frames": [frame.hex() for frame in frames],
                "hex": encode_frames(channel, frames).hex(),
            }
            for name, channel, frames in _iterate_messages()
        ],
        "refused": [{"name": name, "hex": data.hex()} for name, data in _REFUSED.items()],
        "gateway": [
            {"name": name, "hex": frames[0].hex(), "value": msgspec.msgpack.decode(frames[0])}
            for name, channel, frames in _iterate_messages()
            if channel in (GATEWAY, MEDIA_WISHES)
        ],
        "envelopes": [
            {"name": name, "hex": data.hex(), "on_behalf_of": _NAME, "spliced": splice_name(data, _NAME).hex()}
            for name, data in _iterate_envelopes()
        ],
        "bad_envelopes": [
            {"name": name, "hex": data.hex(), "close": code} for name, (data, code) in _BAD_ENVELOPES.items()
        ],
    }


def render_golden() -> str:
    """Return the text of the file."""
    return render_vectors(build_golden())
