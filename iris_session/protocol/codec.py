"""Bytes to messages and back: the trust boundary. MessagePack by `msgspec`, checked against the schema and the sizes.

For any bytes, every `decode_*` returns a value or raises a `ProtocolError`, nothing else. It accepts on purpose:
unknown fields (ignored, so that a version can grow), unknown values of open enumerations and non-finite floats (the
authority answers them with typed reasons).
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from typing import Final, TypeVar, get_args

import msgspec

from iris_session.protocol.assets import MAX_ASSET_CHUNK_BYTES, AssetChunk, AssetRefused, AssetRequest
from iris_session.protocol.client_messages import ClientEnvelope, ClientMessage
from iris_session.protocol.common import EventBody, Message, Name
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.errors import MalformedError, ProtocolError, ProtocolVersionError, TooLargeError
from iris_session.protocol.limits import (
    LIMITS,
    MAX_ASSET_HEADER_BYTES,
    MAX_ASSET_REQUEST_BYTES,
    MAX_BEACON_BYTES,
    MAX_CLIENT_BYTES,
    MAX_INTRODUCTION_BYTES,
    MAX_MEDIA_FRAME_BYTES,
    MAX_MEDIA_HEADER_BYTES,
    MAX_MEDIA_PUSH_BYTES,
    MAX_ON_BEHALF_BYTES,
    MAX_PRESENCE_BYTES,
    MAX_ROBOT_STATES_BYTES,
    MAX_SERVER_BYTES,
    MAX_STATE_HEADER_BYTES,
    SERVER_LIMITS,
    Limit,
)
from iris_session.protocol.media import (
    CLASSES,
    MediaHeader,
    MediaPush,
    StreamInfo,
    describe_bad_stream_name,
    find_info_problem,
    is_stream_name,
)
from iris_session.protocol.names import PROTOCOL_VERSION, BudgetClass
from iris_session.protocol.server_messages import (
    EventKind,
    Presence,
    RobotStates,
    ServerEnvelope,
    ServerMessage,
    StateHeader,
)

Bytes = bytes | bytearray | memoryview
#: Exceptions that `msgspec` raises for arbitrary bytes: schema and syntax, text that is not UTF-8, nesting, numbers.
BAD_BYTES: Final = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, OverflowError)
K = TypeVar("K")
T = TypeVar("T")
A = TypeVar("A", AssetRequest, AssetChunk, AssetRefused)
E = TypeVar("E", ClientEnvelope, ServerEnvelope)


def make_decoder(kind: type[K]) -> Callable[[Bytes], K]:
    """Return a decoder of bytes to `kind`. It raises `msgspec.DecodeError` (or its subclass `ValidationError`) and
    nothing else.
    """
    decode = msgspec.msgpack.Decoder(kind).decode

    def checked(data: Bytes) -> K:
        try:
            return decode(data)
        except msgspec.DecodeError:
            raise
        except BAD_BYTES as error:
            raise msgspec.DecodeError(str(error)) from None

    return checked


def get_tag(kind: type[msgspec.Struct]) -> str:
    """Return the wire name of a message or event type: `Sample` -> `"sample"`."""
    return str(kind.__struct_config__.tag)


#: Types by wire name, in the order of their definition.
CLIENT_TYPES: Final[dict[str, type[Message]]] = {get_tag(kind): kind for kind in get_args(ClientMessage)}
SERVER_TYPES: Final[dict[str, type[Message]]] = {get_tag(kind): kind for kind in get_args(ServerMessage)}
EVENT_TYPES: Final[dict[str, type[EventBody]]] = {get_tag(kind): kind for kind in get_args(EventKind)}


class _Version(msgspec.Struct, array_like=True):
    """Envelope of any version: an array whose first element is the version."""

    version: int


class _BeaconVersion(msgspec.Struct):
    protocol: int


class _IntroductionVersion(msgspec.Struct):
    beacon: _BeaconVersion


class _Event(msgspec.Struct, frozen=True):
    event: str = ""


class _Tags(msgspec.Struct):
    """The tags of a message; its other fields are ignored."""

    type: str = ""
    body: _Event = _Event()


class _ClientTags(msgspec.Struct, array_like=True):
    version: int
    connection_epoch: msgspec.Raw
    on_behalf_of: msgspec.Raw
    message: _Tags


class _ClientName(msgspec.Struct, array_like=True):
    version: int
    connection_epoch: int
    on_behalf_of: Name


class _ServerTags(msgspec.Struct, array_like=True):
    version: int
    connection_epoch: msgspec.Raw
    message: _Tags


_encoder: Final = msgspec.msgpack.Encoder()
_client: Final = msgspec.msgpack.Decoder(ClientEnvelope)
_server: Final = msgspec.msgpack.Decoder(ServerEnvelope)
_version: Final = msgspec.msgpack.Decoder(_Version)
_beacon_version: Final = msgspec.msgpack.Decoder(_BeaconVersion)
_introduction_version: Final = msgspec.msgpack.Decoder(_IntroductionVersion)
_client_tags: Final = msgspec.msgpack.Decoder(_ClientTags)
_client_name: Final = msgspec.msgpack.Decoder(_ClientName)
_server_tags: Final = msgspec.msgpack.Decoder(_ServerTags)
_state_header: Final = msgspec.msgpack.Decoder(StateHeader)
_presence: Final = msgspec.msgpack.Decoder(Presence)
_robot_states: Final = msgspec.msgpack.Decoder(RobotStates)
_beacon: Final = msgspec.msgpack.Decoder(Beacon)
_introduction: Final = msgspec.msgpack.Decoder(Introduction)
_media_header: Final = msgspec.msgpack.Decoder(MediaHeader)
_media_push: Final = msgspec.msgpack.Decoder(MediaPush)
_asset_request: Final = msgspec.msgpack.Decoder(AssetRequest)
_asset_chunk: Final = msgspec.msgpack.Decoder(AssetChunk)
_asset_refused: Final = msgspec.msgpack.Decoder(AssetRefused)

#: Bytes of the length before an introduction.
INTRODUCTION_PREFIX: Final = 4


def encode_client(envelope: ClientEnvelope) -> bytes:
    """Return the MessagePack bytes of a message to the session."""
    return _encoder.encode(envelope)


def decode_client(data: Bytes) -> ClientEnvelope:
    """Decode a message to the session. Raises `ProtocolVersionError`, `TooLargeError` or `MalformedError`."""
    max_bytes = MAX_CLIENT_BYTES + MAX_ON_BEHALF_BYTES
    return _decode_envelope(_client, _client_tags, CLIENT_TYPES, LIMITS, data, max_bytes)


def encode_server(envelope: ServerEnvelope) -> bytes:
    """Return the MessagePack bytes of a message to a client."""
    return _encoder.encode(envelope)


def decode_server(data: Bytes) -> ServerEnvelope:
    """Decode a message to a client. Raises `ProtocolVersionError`, `TooLargeError` or `MalformedError`."""
    return _decode_envelope(_server, _server_tags, SERVER_TYPES, SERVER_LIMITS, data, MAX_SERVER_BYTES)


def peek_version(data: Bytes) -> int:
    """Return the protocol version of an envelope whose other elements may be of any schema. Raises `MalformedError`."""
    try:
        return _version.decode(data).version
    except BAD_BYTES as error:
        raise MalformedError(
            f"no envelope: {error}; expected a MessagePack array that starts with the version"
        ) from None


def peek_on_behalf_of(data: Bytes) -> str:
    """Return `on_behalf_of` of an envelope whose message does not fit the schema; empty for what is no envelope."""
    try:
        return _client_name.decode(data).on_behalf_of
    except BAD_BYTES:
        return ""


def encode_state_header(header: StateHeader) -> bytes:
    """Return the second frame of a rigid-state message; the topic before it, the payload after it."""
    return _encoder.encode(header)


def decode_state_header(data: Bytes) -> StateHeader:
    """Decode a state header. Raises `TooLargeError` or `MalformedError`."""
    return _decode("state header", _state_header, data, MAX_STATE_HEADER_BYTES)


def encode_presence(presence: Presence) -> bytes:
    """Return the second frame of a presence message, after the topic."""
    return _encoder.encode(presence)


def decode_presence(data: Bytes) -> Presence:
    """Decode a presence message. Raises `TooLargeError` or `MalformedError`."""
    return _decode("presence", _presence, data, MAX_PRESENCE_BYTES)


def encode_robot_states(states: RobotStates) -> bytes:
    """Return the second frame of a message of robot states, after the topic."""
    return _encoder.encode(states)


def decode_robot_states(data: Bytes) -> RobotStates:
    """Decode a message of robot states. Raises `TooLargeError` or `MalformedError`."""
    return _decode("robot states", _robot_states, data, MAX_ROBOT_STATES_BYTES)


def encode_media_header(header: MediaHeader) -> bytes:
    """Return the second frame of a media message, after the topic."""
    return _encoder.encode(header)


def decode_media_header(data: Bytes) -> MediaHeader:
    """Decode a media header. Raises `TooLargeError` or `MalformedError`."""
    return _decode("media header", _media_header, data, MAX_MEDIA_HEADER_BYTES)


def encode_media_push(push: MediaPush) -> bytes:
    """Return the first frame of a source's message."""
    return _encoder.encode(push)


def encode_media_frames(
    stream: str,
    frames: bytes | Mapping[str, bytes],
    capture_ns: int,
    scene_epoch: int,
    encoding: str,
    *,
    info: StreamInfo | None = None,
    sent_ns: int = 0,
    connection_epoch: int = 0,
) -> list[bytes]:
    """Return all frames of a source's message. `frames`: of class `full`, or by class; none with an `info` alone.
    Raises `ValueError`.
    """
    by_class = frames if isinstance(frames, Mapping) else {BudgetClass.FULL: frames}
    if not isinstance(stream, str) or not is_stream_name(stream):
        raise ValueError(describe_bad_stream_name(stream))
    has_full = BudgetClass.FULL in by_class or (not by_class and info is not None)
    if not has_full or any(name not in CLASSES[:-1] for name in by_class):
        raise ValueError(f"a media frame has class 'full', and may have 'half' and 'quarter', not {list(by_class)}")
    payloads = []
    for data in by_class.values():
        try:
            view = memoryview(data)
        except TypeError:
            raise ValueError(f"a media frame is {type(data).__name__}: bytes are expected") from None
        if view.nbytes > MAX_MEDIA_FRAME_BYTES:
            raise ValueError(f"a media frame of {view.nbytes} bytes: at most {MAX_MEDIA_FRAME_BYTES} for each class")
        # An array may be counted in rows, or lie in memory in pieces, which a socket refuses with half a message sent.
        payloads.append(data if isinstance(data, bytes) else view.tobytes())
    try:
        capture_ns = operator.index(capture_ns)
        push = MediaPush(stream, scene_epoch, capture_ns, tuple(by_class), encoding, info, sent_ns, connection_epoch)
        header = encode_media_push(push)
        checked = decode_media_push(header).info
    except (TypeError, OverflowError, ProtocolError) as error:  # a time, an encoding or an info that is none
        raise ValueError(f"a media frame of capture_ns {capture_ns!r}, encoding {encoding!r}: {error}") from None
    problem = "" if checked is None else find_info_problem(checked)
    if problem:
        raise ValueError(problem)
    return [header, *payloads]


def decode_media_push(data: Bytes) -> MediaPush:
    """Decode the first frame of a source's message. Raises `TooLargeError` or `MalformedError`."""
    return _decode("media push", _media_push, data, MAX_MEDIA_PUSH_BYTES)


def encode_asset_request(request: AssetRequest) -> bytes:
    """Return the one frame of a client's message on the assets channel."""
    return _encoder.encode(request)


def decode_asset_request(data: Bytes) -> AssetRequest:
    """Decode a request for a chunk. Raises `ProtocolVersionError`, `TooLargeError` or `MalformedError`."""
    return _decode_asset("asset request", _asset_request, data, MAX_ASSET_REQUEST_BYTES)


def encode_asset_header(header: AssetChunk | AssetRefused) -> bytes:
    """Return the first frame of an answer on the assets channel; the bytes of a chunk follow it."""
    return _encoder.encode(header)


def decode_asset_chunk(data: Bytes, payload: int) -> AssetChunk:
    """Decode the first of the two frames of a chunk, whose second has `payload` bytes. Raises as
    `decode_asset_request`.
    """
    chunk = _decode_asset("asset chunk", _asset_chunk, data, MAX_ASSET_HEADER_BYTES)
    _check_length("asset chunk", payload, MAX_ASSET_CHUNK_BYTES)
    if chunk.offset + payload > chunk.total:
        raise MalformedError(f"asset chunk: {payload} bytes from {chunk.offset} of an asset of {chunk.total}")
    return chunk


def decode_asset_refused(data: Bytes) -> AssetRefused:
    """Decode an answer of one frame. Raises as `decode_asset_request`."""
    return _decode_asset("asset refusal", _asset_refused, data, MAX_ASSET_HEADER_BYTES)


def encode_beacon(beacon: Beacon) -> bytes:
    """Return one discovery datagram."""
    return _encoder.encode(beacon)


def decode_beacon(data: Bytes) -> Beacon:
    """Decode a beacon. Raises `ProtocolVersionError`, `TooLargeError` or `MalformedError`."""
    _require_version(_decode("beacon", _beacon_version, data, MAX_BEACON_BYTES).protocol)
    return _decode("beacon", _beacon, data, MAX_BEACON_BYTES)


def encode_introduction(introduction: Introduction) -> bytes:
    """Return all bytes written to a TCP connection on the introduction's port: length (uint32, big-endian), body."""
    body = _encoder.encode(introduction)
    return len(body).to_bytes(INTRODUCTION_PREFIX, "big") + body


def decode_introduction(data: Bytes) -> Introduction | None:
    """Decode an introduction; return `None` while `data`, as received so far, is only its beginning.

    Raises `ProtocolVersionError`, `TooLargeError` or `MalformedError`.
    """
    if len(data) < INTRODUCTION_PREFIX:
        return None
    length = int.from_bytes(data[:INTRODUCTION_PREFIX], "big")
    if length > MAX_INTRODUCTION_BYTES:
        raise TooLargeError("introduction", length, MAX_INTRODUCTION_BYTES)
    body = data[INTRODUCTION_PREFIX:]
    if len(body) < length:
        return None
    if len(body) > length:
        raise MalformedError(f"no introduction: {len(body) - length} bytes after its end")
    _require_version(_decode("introduction", _introduction_version, body, MAX_INTRODUCTION_BYTES).beacon.protocol)
    return _decode("introduction", _introduction, body, MAX_INTRODUCTION_BYTES)


def _decode(what: str, decoder: msgspec.msgpack.Decoder[T], data: Bytes, limit: int) -> T:
    _check_size(what, data, limit)
    try:
        return decoder.decode(data)
    except BAD_BYTES as error:
        raise MalformedError(f"no {what}: {error}") from None


def _decode_asset(what: str, decoder: msgspec.msgpack.Decoder[A], data: Bytes, limit: int) -> A:
    """Decode a struct that begins with the version, which is checked first."""
    _check_size(what, data, limit)
    _require_version(peek_version(data))
    return _decode(what, decoder, data, limit)


def _decode_envelope(
    decoder: msgspec.msgpack.Decoder[E],
    tags: msgspec.msgpack.Decoder[_ClientTags] | msgspec.msgpack.Decoder[_ServerTags],
    known: Mapping[str, type[Message]],
    limits: Mapping[type[Message], Limit],
    data: Bytes,
    max_bytes: int,
) -> E:
    _check_size("message", data, max_bytes)
    try:
        envelope = decoder.decode(data)
    except BAD_BYTES as error:
        raise _explain_failure(error, data, tags, known) from None
    _require_version(envelope.version)
    kind = type(envelope.message)
    behind = envelope.on_behalf_of if isinstance(envelope, ClientEnvelope) else ""
    _check_length(get_tag(kind), len(data) - len(behind), limits[kind].max_bytes)  # a gateway has put that name in
    return envelope


def _require_version(version: int) -> None:
    if version != PROTOCOL_VERSION:
        raise ProtocolVersionError(version)


def _check_size(what: str, data: Bytes, limit: int) -> None:
    _check_length(what, len(data), limit)


def _check_length(what: str, length: int, limit: int) -> None:
    if length > limit:
        raise TooLargeError(what, length, limit)


def _explain_failure(
    error: Exception,
    data: Bytes,
    tags: msgspec.msgpack.Decoder[_ClientTags] | msgspec.msgpack.Decoder[_ServerTags],
    known: Mapping[str, type[Message]],
) -> ProtocolError:
    """Return the error to raise for an envelope that failed with `error`: wrong version first, then unknown type."""
    try:
        version = peek_version(data)
    except MalformedError as no_envelope:
        return no_envelope
    if version != PROTOCOL_VERSION:
        return ProtocolVersionError(version)
    try:
        message = tags.decode(data).message
    except BAD_BYTES:
        return MalformedError(str(error))
    if message.type and message.type not in known:
        return MalformedError(f"unknown message type {message.type[:64]!r}, expected one of {', '.join(known)}")
    if message.type == "event" and message.body.event and message.body.event not in EVENT_TYPES:
        return MalformedError(f"unknown event {message.body.event[:64]!r}, expected one of {', '.join(EVENT_TYPES)}")
    return MalformedError(f"{message.type or 'message'}: {error}")
