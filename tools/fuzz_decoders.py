"""Inputs and decoders of `fuzz.py`.

Inputs are values of any message type generated from its schema, valid and invalid, and damaged as bytes. Each decoder
is a target with the errors that it may raise.
"""

from __future__ import annotations

import hashlib
import math
import struct
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from random import Random
from typing import Any, Final

import msgspec
import numpy as np
from msgspec import inspect

from iris_session.client.discovery import Address
from iris_session.client.errors import ClientError
from iris_session.front.media.scheduler import MediaScheduler, MediaSubscriber
from iris_session.journal import messages
from iris_session.journal import rows as journal
from iris_session.link import messages as link
from iris_session.link.config import Ports, SceneInfo
from iris_session.link.discovery import is_plausible
from iris_session.protocol import codec, entries
from iris_session.protocol.assets import MAX_ASSET_CHUNK_BYTES, AssetChunk, AssetRefused, AssetRequest
from iris_session.protocol.client_messages import ClientEnvelope
from iris_session.protocol.codec import make_decoder
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.media import (
    CLASSES,
    MAX_STREAMS,
    MediaHeader,
    MediaPush,
    StreamBudget,
    StreamInfo,
    make_topic,
    parse_topic,
)
from iris_session.protocol.names import PROTOCOL_VERSION
from iris_session.protocol.server_messages import Presence, RobotStates, ServerEnvelope, StateHeader
from iris_session.protocol.status import DeliveryBudget
from iris_session.security import KeysError
from iris_session.security.allow_list import AllowedKey, AllowList
from iris_session.security.curve import load_public, load_secret
from iris_session.security.join_codes import JoinCode, JoinCodes
from iris_session.security.known_servers import KnownServer, KnownServers
from iris_session.security.private_folder import PrivateFolder
from iris_session.security.session_registry import RegisteredSession, SessionRegistry
from iris_session.streams.cloud import decode_cloud, encode_cloud
from iris_session.streams.errors import StreamError
from iris_session.streams.rigid import RigidDecoder, RigidEncoder
from iris_session.web import wire

# --- inputs -----------------------------------------------------------------------------------------------------------


FLOATS: Final = (0.0, -0.0, 1.0, -1.0, 0.5, 1e-3, 1e10, 1e308, -1e308, 5e-324, math.nan, math.inf, -math.inf)
INTS: Final = (
    0,
    1,
    2,
    7,
    127,
    128,
    255,
    65_535,
    2**31,
    2**32,
    2**53,
    2**63 - 1,
    2**63,
    2**64 - 1,
    -1,
    -(2**31),
    -(2**63),
)
WORDS: Final = (
    "", "x", "p1", "p2", "arm1", "arm2", "host", "robot", "object", "head", "controller/right", "pose", "joints",
    "operator", "director", "observer", "measured", "not_needed", "exclusive", "start",
    "left\n[red]", "ß" * 64, "\x00", "\U0001d518",
)  # fmt: skip
#: MessagePack markers: containers and texts with a length, extensions, numbers, and the unused marker.
MARKERS: Final = bytes((0xC1, 0xC0, 0xC2, 0xC4, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCF, 0xD3, 0xD4, 0xD9, 0xDB, 0xDC, 0xDD,
                        0xDE, 0xDF, 0x80, 0x8F, 0x90, 0x9F, 0xA0, 0xBF, 0xFF, 0x7F, 0x00))  # fmt: skip
#: Containers that claim more content than there is, and deep nesting.
LIES: Final = (
    b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xdc\xff\xff",
    b"\xde\xff\xff", b"\x91" * 200, b"\x81\xa1x" * 200, b"\x91" * 5000, b"\xd9\xff", b"\xc9\xff\xff\xff\xff\x01",
)  # fmt: skip
#: One field in this many has another type, is too long, or is missing.
WRONG: Final = 200


@cache
def schema(kind: Any) -> inspect.Type:
    return inspect.type_info(kind)


def encoded(rng: Random, kind: Any) -> bytes:
    """Return MessagePack of a value of `kind`, mostly a valid one."""
    return msgspec.msgpack.encode(value(rng, schema(kind)))


def encoded_json(rng: Random, kind: Any) -> bytes:
    return msgspec.json.encode(value(rng, schema(kind)))


def value(rng: Random, kind: inspect.Type) -> Any:
    """Return a value of builtin types that `kind` describes."""
    if not rng.randrange(WRONG):
        return wrong(rng)
    return _MAKERS[type(kind)](rng, kind)


def wrong(rng: Random) -> Any:
    """Return a value of any type."""
    nested: Any = 0
    for _ in range(rng.choice((1, 3, 40))):
        nested = [nested]
    return rng.choice(
        (None, True, rng.choice(INTS), rng.choice(FLOATS), "x" * 5000, b"\xff" * 300, [], {}, [0] * 300, nested)
    )


def _int(rng: Random, kind: Any) -> int:
    low = kind.ge if kind.ge is not None else -(2**63)
    high = kind.le if kind.le is not None else 2**63 - 1
    number = rng.choice(INTS) if rng.random() < 0.5 else rng.randrange(1000)
    return number if rng.random() < 0.05 else min(max(number, low), high)


def _text(rng: Random, kind: Any) -> str:
    text = rng.choice(WORDS)
    return text if kind.max_length is None or len(text) <= kind.max_length else text[: kind.max_length]


def _bytes(rng: Random, kind: Any) -> bytes:
    longest = kind.max_length if kind.max_length is not None else 64
    return rng.randbytes(rng.choice((0, 1, min(16, longest), min(64, longest))))


def _array(rng: Random, kind: Any) -> list[Any]:
    low = kind.min_length or 0
    high = kind.max_length if kind.max_length is not None else 8
    n = rng.choice((low, low, 1, 2, rng.randint(low, max(low, min(high, 12)))))
    if rng.random() < 0.02:
        n = high + rng.randrange(2)
    return [value(rng, kind.item_type) for _ in range(max(n, low))]


def _struct(rng: Random, kind: Any) -> Any:
    fields = []
    for field in kind.fields:
        if not field.required and rng.random() < 0.4 and not kind.array_like:
            continue
        if not rng.randrange(4 * WRONG):
            continue
        fields.append((field.encode_name, value(rng, field.type)))
    if kind.array_like:
        return [*([kind.tag] if kind.tag is not None else []), *(one for _, one in fields)]
    if not rng.randrange(WRONG):
        fields.append(("unheard_of", wrong(rng)))
    rng.shuffle(fields)
    tagged = [(kind.tag_field, kind.tag)] if kind.tag_field else []
    return dict((*tagged, *fields) if rng.random() < 0.9 else (*fields, *tagged))


def _dict(rng: Random, kind: Any) -> dict[Any, Any]:
    keys = [_MAKERS[type(kind.key_type)](rng, kind.key_type) for _ in range(rng.randrange(4))]
    return {key: value(rng, kind.value_type) for key in keys}


def _pick(rng: Random, kind: Any) -> Any:
    return value(rng, rng.choice(kind.types))


_MAKERS: Final[dict[type, Callable[[Random, Any], Any]]] = {
    inspect.IntType: _int,
    inspect.FloatType: lambda rng, kind: rng.choice(FLOATS) if rng.random() < 0.3 else rng.uniform(-2, 2),
    inspect.StrType: _text,
    inspect.BytesType: _bytes,
    inspect.BoolType: lambda rng, kind: rng.random() < 0.5,
    inspect.NoneType: lambda rng, kind: None,
    inspect.VarTupleType: _array,
    inspect.ListType: _array,
    inspect.TupleType: lambda rng, kind: [value(rng, one) for one in kind.item_types],
    inspect.DictType: _dict,
    inspect.StructType: _struct,
    inspect.UnionType: _pick,
    inspect.RawType: lambda rng, kind: 0,
    inspect.AnyType: lambda rng, kind: wrong(rng),
}


class Corpus:
    """Changing collection of encoded values; `damaged` returns one of them, unchanged or damaged."""

    SIZE: Final = 256

    def __init__(self, rng: Random, make: Sequence[Callable[[Random], bytes]]) -> None:
        self._rng = rng
        self._make = make
        self._kept = [make[i % len(make)](rng) for i in range(self.SIZE)]

    def damaged(self) -> bytes:
        rng = self._rng
        if rng.random() < 0.3:
            self._kept[rng.randrange(self.SIZE)] = rng.choice(self._make)(rng)
        data = rng.choice(self._kept)
        if rng.random() < 0.25:
            return data
        if rng.random() < 0.03:
            return rng.randbytes(rng.randrange(80))
        other = rng.choice(self._kept)
        return damage(rng, data, other)


def damage(rng: Random, data: bytes, other: bytes) -> bytes:
    """Return `data` with one to three changes; `other` may be spliced in."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        at = rng.randrange(len(changed) + 1)
        kind = rng.randrange(9)
        if kind == 0 and at < len(changed):
            changed[at] ^= 1 << rng.randrange(8)
        elif kind == 1 and at < len(changed):
            changed[at] = rng.choice(MARKERS)
        elif kind == 2:
            del changed[at:]
        elif kind == 3:
            del changed[at : at + rng.randrange(1, 9)]
        elif kind == 4:
            changed[at:at] = rng.randbytes(rng.randrange(1, 9))
        elif kind == 5:
            changed[at:at] = changed[rng.randrange(len(changed) + 1) :][: rng.randrange(1, 40)]
        elif kind == 6:
            changed[at:] = other[rng.randrange(len(other) + 1) :]
        elif kind == 7 and at < len(changed):
            changed[at] = rng.randrange(256)
        elif kind == 8 and not rng.randrange(4):
            changed[at : at + rng.randrange(2)] = rng.choice(LIES)
    return bytes(changed)


# --- decoders ---------------------------------------------------------------------------------------------------------


Errors = tuple[type[Exception], ...]
Make = Callable[[Random], bytes]
_decode_keyframe = make_decoder(journal.Keyframe)


class Decoder:
    """Target of bytes: `make` returns the next input; `feed` decodes it and returns whether it was accepted."""

    def __init__(self, rng: Random, make: Sequence[Make], decode: Callable[[bytes], Any], refusals: Errors) -> None:
        self._corpus = Corpus(rng, make)
        self._decode = decode
        self._refusals = refusals

    def make(self) -> bytes:
        return self._corpus.damaged()

    def feed(self, data: bytes) -> bool:
        try:
            self._decode(data)
        except self._refusals:
            return False
        return True

    def close(self) -> None:
        """Nothing to close."""


def _envelope(kind: Any, message_types: dict[str, type]) -> list[Make]:
    """Return generators of envelopes: one per message type, so that all are equally frequent."""

    def of(tag: str) -> Make:
        def make(rng: Random) -> bytes:
            message = msgspec.msgpack.decode(encoded(rng, message_types[tag]))
            head: list[Any] = [
                PROTOCOL_VERSION if rng.random() < 0.97 else rng.choice((0, 2, 2**40, -1)),
                rng.choice((0, 1, 7)),
            ]
            if kind is ClientEnvelope:
                head.append("" if rng.random() < 0.9 else rng.choice(("tab1", "x" * 65)))
            return msgspec.msgpack.encode([*head, message])

        return make

    return [of(tag) for tag in message_types]


def client_messages() -> list[Make]:
    return _envelope(ClientEnvelope, codec.CLIENT_TYPES)


def server_messages() -> list[Make]:
    return _envelope(ServerEnvelope, codec.SERVER_TYPES)


def rigid_frames(n_bodies: int) -> Make:
    """Return a generator of frames of moving bodies, prefixed with `state_seq` and `base_seq`."""
    encoders: dict[int, RigidEncoder] = {}

    def make(rng: Random) -> bytes:
        if not rng.randrange(20):
            encoders.clear()
        encoder = encoders.setdefault(0, RigidEncoder(n_bodies))
        numbers = np.random.default_rng(rng.getrandbits(32))
        poses = np.zeros((n_bodies, 7))
        poses[:, :3] = numbers.uniform(-3, 3, (n_bodies, 3)) * rng.choice((1, 1, 1000, 1e9))
        rotations = numbers.normal(size=(n_bodies, 4))
        poses[:, 3:] = rotations / np.linalg.norm(rotations, axis=1, keepdims=True)
        if rng.random() < 0.2:
            poses[rng.randrange(n_bodies)] = np.nan
        frame = encoder.encode(poses, 1)
        return struct.pack("<qq", frame.state_seq, frame.base_seq) + frame.payload

    return make


def make_rigid_check(n_bodies: int) -> Callable[[bytes], None]:
    decoder = RigidDecoder(n_bodies)

    def take(data: bytes) -> None:
        if len(data) < 16:
            raise StreamError("no frame")
        state_seq, base_seq = struct.unpack_from("<qq", data)
        if state_seq > 1000:  # the decoder would skip everything after a high number
            state_seq %= 1000
        before = decoder.poses.copy()
        try:
            decoder.apply(state_seq, base_seq, data[16:])
        except StreamError:
            assert np.array_equal(before, decoder.poses, equal_nan=True), "a refused frame has changed the poses"
            raise
        assert decoder.poses.shape == (n_bodies, 7)
        if state_seq > 900:
            decoder.reset()

    return take


def make_cloud_frame(rng: Random) -> bytes:
    """Return a frame of a few points."""
    numbers = np.random.default_rng(rng.getrandbits(32))
    n = rng.choice((0, 1, 3, 12))
    points = numbers.uniform(-1, 1, (n, 3)) * rng.choice((0.01, 1, 30, 1000)) + rng.choice((0, 5, 1e4))
    colors = numbers.integers(0, 256, (n, 3)).astype(np.uint8)
    return encode_cloud(points, colors, voxel_m=rng.choice((0.0, 0.01, 1.0)), error_m=rng.choice((0.01, math.inf)))[
        "full"
    ]


def check_cloud(data: bytes) -> None:
    frame = decode_cloud(data)
    assert np.isfinite(frame.positions).all()
    assert 8 * len(frame.positions) < len(data)
    assert len(frame.colors) == len(frame.positions)


def check_journal(data: bytes) -> None:
    """Decode the rows of a damaged file and check them as `verify` does."""
    for row in messages.decode_batch(data).rows:
        journal.check_row(b"\0" * 16, row)
        journal.check_fields(row)
        journal.compute_chain(b"\0" * 16, row)


def check_keyframe(data: bytes) -> None:
    journal.check_keyframe(_decode_keyframe(data))


def make_address(rng: Random) -> bytes:
    key = rng.choice(("A" * 43, "AAAA", "", "_-" * 21 + "A"))
    code = rng.choice(("7KQ2-M4XD-9PTR", "7kq2m4xd9ptr", "x", "%F0%9F", ""))
    host = rng.choice(("10.0.0.5", "[::1]", "lab.local", "::1", "²", "", "%", "[", "lab:²", "x" * 300))
    port = rng.choice((":7721", ":0", ":99999", ":²", ":-1", "", ":٣"))
    if rng.random() < 0.4:
        return f"{host}{port}".encode()
    return f"iris://{host}{port}/?k={key}&c={code}&n={rng.choice(('lab', '%00', 'ü'))}".encode()


def check_address(data: bytes) -> None:
    Address.parse(data.decode(errors="replace"))


def check_introduction(data: bytes) -> None:
    introduction = codec.decode_introduction(data)
    if introduction is not None:
        is_plausible(introduction.beacon)


def check_beacon(data: bytes) -> None:
    is_plausible(codec.decode_beacon(data))


def _make_versioned(rng: Random, kind: Any) -> Any:
    """Return a beacon, or a message with a beacon, mostly of our protocol version."""
    made = msgspec.msgpack.decode(encoded(rng, kind))
    if isinstance(made, dict) and rng.random() < 0.95:
        beacon = made.get("beacon", made)
        if isinstance(beacon, dict):
            beacon["protocol"] = PROTOCOL_VERSION
    return made


def _beacons(rng: Random) -> bytes:
    return msgspec.msgpack.encode(_make_versioned(rng, Beacon))


def _introductions(rng: Random) -> bytes:
    body = msgspec.msgpack.encode(_make_versioned(rng, Introduction))
    length = len(body) if rng.random() < 0.9 else rng.choice((0, 1, 4001, 2**32 - 1))
    return length.to_bytes(4, "big") + body


class KeyFiles(Decoder):
    """Target of key files: each is read as the program reads it."""

    def __init__(
        self, rng: Random, kind: Any, read: Callable[[PrivateFolder], Any], name: str, certificate: Make | None = None
    ):
        memory = "/dev/shm" if Path("/dev/shm").is_dir() else None  # a file is written per input
        self._folder = tempfile.TemporaryDirectory(prefix="iris-fuzz-", dir=memory)
        path = Path(self._folder.name)
        path.chmod(0o700)
        folder = PrivateFolder(path)
        file = path / name
        file.touch(0o600)

        def take(data: bytes) -> None:
            file.write_bytes(data)
            read(folder)

        make = certificate or (lambda rng: encoded_json(rng, kind))
        super().__init__(rng, [make], take, (KeysError,))

    def close(self) -> None:
        self._folder.cleanup()


#: Key pair from the manual of zmq_curve: a public key that does not match the secret one is refused.
_PUBLIC: Final = r"rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7"
_SECRET: Final = r"JTKVSB%%)wK0E.X)V>+}o?pNmC{O&4W4b!Ni{Lh6"


def _certificate(rng: Random) -> bytes:
    public, secret = rng.choice(((_PUBLIC, _SECRET), (_PUBLIC, _SECRET), (_SECRET, _PUBLIC), ("~" * 40, "ü" * 40)))
    lines = ["#   comment", "metadata", "curve", f'    public-key = "{public}"', f'    secret-key = "{secret}"']
    return "\n".join(line for line in lines if rng.random() < 0.95).encode()


def decode_plain(kind: Any, decode: Callable[[bytes], Any], refusals: Errors) -> Callable[[Random], Decoder]:
    return lambda rng: Decoder(rng, [lambda rng: encoded(rng, kind)], decode, refusals)


#: Stream of the honest publisher and viewer.
HONEST: Final = "honest"


def make_media_topic(rng: Random) -> bytes:
    stream = rng.choice((HONEST, "cloud", "a", "x" * 48, "Ärger", "", "a/b"))
    return rng.choice((b"\1", b"\1", b"\0")) + make_topic(rng.choice((0, 1, 2, 7, 2**63, 10**30)), stream)


def make_media_push(rng: Random) -> bytes:
    """Return a push as a source sends it, mostly with stream names and classes of the protocol."""
    if rng.random() < 0.3:
        return encoded(rng, MediaPush)
    classes = tuple(rng.sample(CLASSES, rng.randrange(1, len(CLASSES))))
    push = MediaPush(rng.choice(("cloud", "a", f"s{rng.randrange(100)}", "")), 1, rng.getrandbits(40), classes)
    info = value(rng, schema(StreamInfo)) if rng.random() < 0.5 else None
    if isinstance(info, dict):
        info["detail"] = rng.choice(WORDS) * rng.choice((1, 8, 64, 600))
    return msgspec.msgpack.encode([*msgspec.structs.astuple(push)[:5], info, rng.choice(INTS)])


def check_media_push(data: bytes) -> None:
    """Decode a push, and deliver it as the front does: its info reaches every client in one message."""
    push = codec.decode_media_push(data)
    scheduler = MediaScheduler()
    scheduler.set_subscribers({1: MediaSubscriber("", {})}, 0)
    scheduler.push(push, [b"x"] * min(len(push.classes), len(CLASSES)), "", 1)
    for name, facts in scheduler.read_streams().items():
        camera = facts.info.camera
        numbers = () if camera is None else (camera.fx, camera.cy, *camera.distortion, *camera.position)
        assert all(map(math.isfinite, (facts.info.hz, *numbers)))
        assert not facts.is_stale(2**62) or facts.info.hz > 0.0 or facts.frame_bytes is None
        scheduler.subscribe(1, name, "", 2, 3)
        info = facts.info
        described = StreamBudget(name, title=info.title, camera=info.camera, fault=info.fault, detail=info.detail)
        budgets = codec.encode_server(ServerEnvelope(1, 7, DeliveryBudget("full", streams=(described,) * MAX_STREAMS)))
        codec.decode_server(budgets)
    scheduler.flush(lambda _, header, __: bool(codec.decode_media_header(header)), 4)


def check_media_topic(data: bytes) -> None:
    if parse_topic(data[1:]) is None:
        raise ValueError


#: Asset that the honest client fetches.
PICTURE: Final = bytes(range(256)) * 1000


def asset_address(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def make_asset_request(rng: Random) -> bytes:
    """Return a request as a client sends it, mostly acceptable."""
    if rng.random() < 0.3:
        return encoded(rng, AssetRequest)
    address = rng.choice(
        (asset_address(PICTURE), asset_address(PICTURE), asset_address(b""), "0" * 64, "../../etc/passwd", "")
    )
    offset = rng.choice((0, 0, 1000, len(PICTURE), len(PICTURE) + 1, 2**62))
    length = rng.choice((1, 1000, MAX_ASSET_CHUNK_BYTES, MAX_ASSET_CHUNK_BYTES + 1, 0, 2**62))
    epoch = rng.choice((2, 2, 2, 3, 0, 2**62))  # the second connection is hostile; the first is the honest client
    return codec.encode_asset_request(AssetRequest(1, epoch, rng.getrandbits(30), address, offset, length))


def _encode_versioned(rng: Random, kind: type[msgspec.Struct]) -> bytes:
    """Encode a struct, mostly with our version."""
    data = encoded(rng, kind)
    return data[:1] + b"\x01" + data[2:] if rng.random() < 0.7 else data


WEB_NAME: Final = "web-00112233aabb"


def make_web_message(rng: Random) -> bytes:
    """Return a WebSocket message: mostly an envelope for the control channel, else any frames on any channel."""
    if rng.random() < 0.8:
        return wire.encode_frames(wire.CONTROL, [rng.choice(client_messages())(rng)])
    frames = [rng.randbytes(rng.choice((0, 1, 20, 300))) for _ in range(rng.choice((1, 1, 2, 3, 255)))]
    return wire.encode_frames(rng.randrange(8), frames)


def check_web(data: bytes) -> None:
    """Do with a WebSocket message what a gateway does, on every channel. Raises `ProtocolError`."""
    channel, frames = wire.decode_frames(data)
    assert sum(map(len, frames)) < len(data)
    if channel == wire.MEDIA_WISHES:
        wire.decode_subscriptions(frames[0])
    elif channel == wire.GATEWAY:
        wire.decode_gateway_message(frames[0])
    else:
        wire.peek_server_message(frames[0])
        spliced = wire.splice_name(frames[0], WEB_NAME)
        wire.peek_client_message(frames[0])
        assert codec.decode_client(spliced).on_behalf_of == WEB_NAME


_OURS: Final[Errors] = (ProtocolError,)
_ENTRIES: Final[Errors] = (msgspec.DecodeError,)
DECODERS: Final[dict[str, Callable[[Random], Any]]] = {
    "client": lambda rng: Decoder(rng, client_messages(), codec.decode_client, _OURS),
    "server": lambda rng: Decoder(rng, server_messages(), codec.decode_server, _OURS),
    "web": lambda rng: Decoder(rng, [make_web_message], check_web, _OURS),
    "version": lambda rng: Decoder(rng, client_messages(), codec.peek_version, _OURS),
    "state-header": decode_plain(StateHeader, codec.decode_state_header, _OURS),
    "presence": decode_plain(Presence, codec.decode_presence, _OURS),
    "robot_states": decode_plain(RobotStates, codec.decode_robot_states, _OURS),
    "beacon": lambda rng: Decoder(rng, [_beacons], check_beacon, _OURS),
    "introduction": lambda rng: Decoder(rng, [_introductions], check_introduction, _OURS),
    "rigid": lambda rng: Decoder(rng, [rigid_frames(7)], make_rigid_check(7), (StreamError,)),
    "cloud": lambda rng: Decoder(rng, [make_cloud_frame], check_cloud, (StreamError,)),
    "address": lambda rng: Decoder(rng, [make_address], check_address, (ClientError,)),
    "entry": decode_plain(entries.Entry, entries.decode_entry, _ENTRIES),
    "entries": decode_plain(list[entries.Entry], entries.decode_entries, _ENTRIES),
    "link-decided": decode_plain(link.Decided, link.decode_decided, _ENTRIES),
    "link-status": decode_plain(link.FrontStatus, link.decode_status, _ENTRIES),
    "link-ports": decode_plain(Ports, link.decode_ports, _ENTRIES),
    "link-scene": decode_plain(SceneInfo, link.decode_scene, _ENTRIES),
    "journal-rows": decode_plain(messages.Batch, check_journal, _ENTRIES),
    "journal-header": decode_plain(journal.SessionHeader, messages.decode_header, _ENTRIES),
    "journal-keyframe": decode_plain(journal.Keyframe, check_keyframe, _ENTRIES),
    "keys-clients": lambda rng: KeyFiles(rng, list[AllowedKey], lambda f: AllowList(f).read(), "clients.json"),
    "keys-codes": lambda rng: KeyFiles(rng, list[JoinCode], lambda f: JoinCodes(f).read(), "join_codes.json"),
    "keys-servers": lambda rng: KeyFiles(
        rng, list[KnownServer], lambda f: KnownServers(f).read(), "known_servers.json"
    ),
    "keys-sessions": lambda rng: KeyFiles(
        rng, list[RegisteredSession], lambda f: SessionRegistry(f).read(), "sessions.json"
    ),
    "keys-public": lambda rng: KeyFiles(rng, None, lambda f: load_public(f.path / "x.key"), "x.key", _certificate),
    "keys-secret": lambda rng: KeyFiles(rng, None, lambda f: load_secret(f.path / "x.key"), "x.key", _certificate),
    "media-header": lambda rng: Decoder(rng, [lambda r: encoded(r, MediaHeader)], codec.decode_media_header, _OURS),
    "media-push": lambda rng: Decoder(rng, [make_media_push], check_media_push, _OURS),
    "media-topic": lambda rng: Decoder(rng, [make_media_topic], check_media_topic, (ValueError,)),
    "asset-request": lambda rng: Decoder(rng, [make_asset_request], codec.decode_asset_request, _OURS),
    "asset-chunk": lambda rng: Decoder(
        rng, [lambda r: _encode_versioned(r, AssetChunk)], lambda data: codec.decode_asset_chunk(data, 0), _OURS
    ),
    "asset-refused": lambda rng: Decoder(
        rng, [lambda r: _encode_versioned(r, AssetRefused)], codec.decode_asset_refused, _OURS
    ),
}
