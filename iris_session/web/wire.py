"""Bytes of the web channel: several frames in one WebSocket message. Pure, and never raises but a `ProtocolError`.

A binary message is channel (u8), count (u8), `count` lengths (u32, little-endian), then the frames, which are those of
ZeroMQ. A gateway does not decode what people say: it puts their name into the envelope (`splice_name`), and reads the
type of what the session answers (`peek_server_message`).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated, Any, Final, NamedTuple

import msgpack
import msgspec

from iris_session.protocol.codec import BAD_BYTES, Bytes
from iris_session.protocol.errors import MalformedError, ProtocolError, ProtocolVersionError, TooLargeError
from iris_session.protocol.limits import MAX_CLIENT_BYTES
from iris_session.protocol.media import is_stream_name
from iris_session.protocol.names import PROTOCOL_VERSION, RefusalCode

#: WebSocket subprotocol of this version.
SUBPROTOCOL: Final = "iris-session.1"
CONTROL: Final = 1
STATE: Final = 2
MEDIA: Final = 3
MEDIA_WISHES: Final = 4
GATEWAY: Final = 5
_HEAD: Final = 2
_LENGTH: Final = 4
#: Largest WebSocket message of a client [bytes]: one frame of what the session takes.
MAX_CLIENT_MESSAGE: Final = _HEAD + _LENGTH + MAX_CLIENT_BYTES
#: Streams that a client may subscribe to, as many as a session has.
MAX_SUBSCRIPTIONS: Final = 16
#: Server messages that are larger are none of those that a gateway acts on.
MAX_PEEKED: Final = 65_536

# Codes with which a gateway closes a WebSocket.
CLOSE_ENDED: Final = 4000
CLOSE_VERSION: Final = 4001
CLOSE_NOT_ALLOWED: Final = 4003
CLOSE_TOO_SLOW: Final = 4008
CLOSE_LIMIT: Final = 4009
CLOSE_RESTART: Final = 1012
CLOSE_TRY_AGAIN: Final = 1013

_MAX_FRAMES: Final = 255
_ENVELOPE_ELEMENTS: Final = 4
#: More bytes than an envelope has up to its message: 5 for the array, 9 for each number, 5 + 31 for a name.
_MAX_ENVELOPE_HEAD: Final = 64
#: Bytes of a name that MessagePack encodes with one byte of length.
_MAX_NAME: Final = 31

# Of the frames of a WebSocket: opcodes of a binary message (0: it goes on) and of a close, marks of its end and of long
# lengths.
_BINARY: Final = 2
_FINAL: Final = 0x80
_CLOSE: Final = 8
_LENGTH_16: Final = 126
_LENGTH_64: Final = 127


class ForgedNameError(ProtocolError):
    """A client behind a gateway has set `on_behalf_of` itself."""

    code = RefusalCode.GATEWAY_ONLY

    def __init__(self) -> None:
        super().__init__("on_behalf_of must be empty: the gateway sets it")


class Ticket(msgspec.Struct, frozen=True, tag="ticket"):
    """Ticket of a participant, by which its media socket and its requests for assets are known as its own.

    From the gateway with `expires_s`, seconds until it expires; from a client on its media socket without.
    """

    ticket: Annotated[str, msgspec.Meta(max_length=128)]
    expires_s: Annotated[int, msgspec.Meta(ge=0, le=86_400)] = 0


class GatewayNotice(msgspec.Struct, frozen=True, tag="notice"):
    """Words of the gateway for the person."""

    text: Annotated[str, msgspec.Meta(max_length=512)]


GatewayMessage = Ticket | GatewayNotice


class ServerHead(NamedTuple):
    """Beginning of a server message: connection epoch, `type`, and `code` of a fault."""

    connection_epoch: int
    type: str
    code: str


class ClientHead(msgspec.Struct):
    """Beginning of a client message: `type`, and of a hello the `secret` and `capabilities` (unchecked)."""

    type: str = ""
    secret: bytes = b""
    capabilities: Any = ()


class _Type(msgspec.Struct):
    type: str = ""
    code: str = ""


class _ServerEnvelope(msgspec.Struct, array_like=True):
    version: int
    connection_epoch: int
    message: _Type


class _ClientEnvelope(msgspec.Struct, array_like=True):
    version: int
    connection_epoch: int
    on_behalf_of: str
    message: ClientHead


_server: Final = msgspec.msgpack.Decoder(_ServerEnvelope)
_client: Final = msgspec.msgpack.Decoder(_ClientEnvelope)
_gateway: Final[msgspec.msgpack.Decoder[GatewayMessage]] = msgspec.msgpack.Decoder(GatewayMessage)
_subscriptions: Final = msgspec.msgpack.Decoder(Annotated[list[str], msgspec.Meta(max_length=MAX_SUBSCRIPTIONS)])
_encoder: Final = msgspec.msgpack.Encoder()


def encode_frames(channel: int, frames: Sequence[Bytes]) -> bytes:
    """Return the binary WebSocket message that holds `frames`."""
    if not 0 < len(frames) <= _MAX_FRAMES:
        raise ValueError(f"a message has 1 to {_MAX_FRAMES} frames, not {len(frames)}")
    lengths = [len(frame) for frame in frames]
    return b"".join((struct.pack(f"<BB{len(frames)}I", channel, len(frames), *lengths), *frames))


def make_fragment(message: bytes, begin: int, end: int) -> bytes:
    """Return a part of a binary message of a server as a WebSocket frame (RFC 6455, sections 5.2 and 5.4)."""
    length = end - begin
    first = (0 if begin else _BINARY) | (_FINAL if end == len(message) else 0)
    if length < _LENGTH_16:
        head = struct.pack(">BB", first, length)
    elif length < 2**16:
        head = struct.pack(">BBH", first, _LENGTH_16, length)
    else:
        head = struct.pack(">BBQ", first, _LENGTH_64, length)
    return head + memoryview(message)[begin:end]


def make_close_frame(code: int, reason: str) -> bytes:
    """Return the WebSocket frame that closes, of a server; `reason`: at most 123 bytes."""
    body = struct.pack(">H", code) + reason.encode()
    return bytes((_CLOSE | _FINAL, len(body))) + body


def decode_frames(data: Bytes) -> tuple[int, list[memoryview]]:
    """Return channel and frames of a binary WebSocket message. Raises `MalformedError`."""
    view = memoryview(data)
    if len(view) < _HEAD:
        raise MalformedError(f"no web message: {len(view)} bytes, at least {_HEAD} are needed")
    channel, count = view[0], view[1]
    begin = _HEAD + _LENGTH * count
    if not count or begin > len(view):
        raise MalformedError(f"no web message: {count} frames in {len(view)} bytes")
    lengths = struct.unpack_from(f"<{count}I", view, _HEAD)
    if begin + sum(lengths) != len(view):
        raise MalformedError(f"no web message: frames of {sum(lengths)} bytes, but {len(view) - begin} follow")
    frames = []
    for length in lengths:
        frames.append(view[begin : begin + length])
        begin += length
    return channel, frames


def encode_gateway_message(message: GatewayMessage) -> bytes:
    """Return the WebSocket message of channel 5."""
    return encode_frames(GATEWAY, (_encoder.encode(message),))


def decode_gateway_message(frame: Bytes) -> GatewayMessage:
    """Decode the frame of channel 5. Raises `MalformedError`."""
    try:
        return _gateway.decode(frame)
    except BAD_BYTES as error:
        raise MalformedError(f"no message of a gateway: {error}") from None


def decode_subscriptions(frame: Bytes) -> frozenset[str]:
    """Decode the frame of channel 4. Raises `MalformedError`."""
    try:
        names = _subscriptions.decode(frame)
    except BAD_BYTES as error:
        raise MalformedError(f"no media subscriptions: {error}") from None
    for name in names:
        if not is_stream_name(name):
            raise MalformedError(f"no media subscriptions: {name[:64]!r} cannot be the name of a stream")
    return frozenset(names)


def splice_name(envelope: Bytes, name: str) -> bytes:
    """Return an encoded `ClientEnvelope` with `name` in place of its empty `on_behalf_of`.

    What follows the name is copied unread: the session checks it.

    Raises:
        ProtocolVersionError: The envelope is of another version.
        ForgedNameError: `on_behalf_of` is not empty.
        MalformedError: It is no envelope.
        TooLargeError: `name` has more than 31 bytes.
    """
    encoded = name.encode()
    if len(encoded) > _MAX_NAME:
        raise TooLargeError("name", len(encoded), _MAX_NAME)
    # An element that holds others would be filled in before they come: the head has none.
    unpacker = msgpack.Unpacker(
        max_buffer_size=_MAX_ENVELOPE_HEAD, max_array_len=0, max_map_len=0, max_bin_len=0, max_ext_len=0
    )
    unpacker.feed(memoryview(envelope)[:_MAX_ENVELOPE_HEAD])
    try:
        n_elements, version, epoch = unpacker.read_array_header(), unpacker.unpack(), unpacker.unpack()
        begin = unpacker.tell()
        before, end = unpacker.unpack(), unpacker.tell()
    except (ValueError, msgpack.UnpackException) as error:
        raise MalformedError(f"no envelope: {error}") from None
    if type(version) is not int or type(epoch) is not int or not isinstance(before, str):
        raise MalformedError("no envelope: version and connection_epoch must be integers, on_behalf_of a string")
    if version != PROTOCOL_VERSION:
        raise ProtocolVersionError(version)
    if n_elements < _ENVELOPE_ELEMENTS:
        raise MalformedError(f"no envelope: {n_elements} elements, {_ENVELOPE_ELEMENTS} are needed")
    if before:
        raise ForgedNameError
    data = memoryview(envelope)
    return b"".join((data[:begin], _encoder.encode(name), data[end:]))


def peek_client_message(envelope: Bytes) -> ClientHead:
    """Return the head of a client message. Raises `MalformedError` for what is not MessagePack.

    The session checks the rest: it may know types that a gateway does not.
    """
    try:
        return _client.decode(envelope).message
    except BAD_BYTES as error:
        raise MalformedError(f"no envelope: {error}") from None


def peek_server_message(envelope: Bytes) -> ServerHead:
    """Return the head of a `ServerEnvelope`; its type is empty for what is not one, and for large ones."""
    if len(envelope) > MAX_PEEKED:
        return ServerHead(0, "", "")
    try:
        found = _server.decode(envelope)
    except BAD_BYTES:
        return ServerHead(0, "", "")
    return ServerHead(found.connection_epoch, found.message.type, found.message.code)
