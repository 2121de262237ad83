"""What `fuzz.py` gives bytes to: every decoder, with the errors that it may raise."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any, Final

import msgspec
import numpy as np
from fuzz_inputs import Corpus, encoded, encoded_json

from iris_session.client.address import Address
from iris_session.client.discovery import is_plausible
from iris_session.client.errors import ClientError
from iris_session.link import messages as link
from iris_session.link.config import Ports, SceneInfo
from iris_session.protocol import codec, entries
from iris_session.protocol.client_messages import ClientEnvelope
from iris_session.protocol.decoding import decoder
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.names import PROTOCOL_VERSION
from iris_session.protocol.server_messages import Presence, ServerEnvelope, StateHeader
from iris_session.recording import journal, messages
from iris_session.security import KeysError
from iris_session.security.allow_list import AllowedKey, AllowList
from iris_session.security.curve import load_public, load_secret
from iris_session.security.files import PrivateFolder
from iris_session.security.join_codes import JoinCode, JoinCodes
from iris_session.security.known_servers import KnownServer, KnownServers
from iris_session.security.session_notes import SessionNote, SessionNotes
from iris_session.streams.errors import StreamError
from iris_session.streams.rigid import RigidDecoder, RigidEncoder

Errors = tuple[type[Exception], ...]
Make = Callable[[Random], bytes]
_decode_keyframe = decoder(journal.Keyframe)


class Decoder:
    """One target: `make` gives the next input, `take` decodes it. True: accepted; false: refused as it should be."""

    def __init__(self, rng: Random, make: Sequence[Make], decode: Callable[[bytes], Any], refusals: Errors) -> None:
        self._corpus = Corpus(rng, make)
        self._decode = decode
        self._refusals = refusals

    def make(self) -> bytes:
        return self._corpus.damaged()

    def take(self, data: bytes) -> bool:
        try:
            self._decode(data)
        except self._refusals:
            return False
        return True

    def close(self) -> None:
        """Nothing was opened."""


def _envelope(kind: Any, message_types: dict[str, type]) -> list[Make]:
    """Makers of envelopes: one per message type, so that each comes as often."""

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
    """Frames of an encoder of which some bodies moved, behind `state_seq` and `base_seq`."""
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


def take_rigid(n_bodies: int) -> Callable[[bytes], None]:
    decoder = RigidDecoder(n_bodies)

    def take(data: bytes) -> None:
        if len(data) < 16:
            raise StreamError("no frame")
        state_seq, base_seq = struct.unpack_from("<qq", data)
        if state_seq > 1000:  # a high number would make the decoder pass over everything after it
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


def check_journal(data: bytes) -> None:
    """Rows of a damaged file: decoded, then checked as `verify` does."""
    for row in messages.decode_batch(data).rows:
        journal.check_row(b"\0" * 16, row)
        journal.check_fields(row)
        journal.chain_of(b"\0" * 16, row)


def check_keyframe(data: bytes) -> None:
    journal.check_keyframe(_decode_keyframe(data))


def address_texts(rng: Random) -> bytes:
    key = rng.choice(("A" * 43, "AAAA", "", "_-" * 21 + "A"))
    code = rng.choice(("7KQ2-M4XD-9PTR", "7kq2m4xd9ptr", "x", "%F0%9F", ""))
    host = rng.choice(("10.0.0.5", "[::1]", "lab.local", "::1", "²", "", "%", "[", "lab:²", "x" * 300))
    port = rng.choice((":7721", ":0", ":99999", ":²", ":-1", "", ":٣"))
    if rng.random() < 0.4:
        return f"{host}{port}".encode()
    return f"iris://{host}{port}/?k={key}&c={code}&n={rng.choice(('lab', '%00', 'ü'))}".encode()


def take_address(data: bytes) -> None:
    Address.parse(data.decode(errors="replace"))


def take_introduction(data: bytes) -> None:
    introduction = codec.decode_introduction(data)
    if introduction is not None:
        is_plausible(introduction.beacon)


def take_beacon(data: bytes) -> None:
    is_plausible(codec.decode_beacon(data))


def _of_this_version(rng: Random, kind: Any) -> Any:
    """A beacon, or something with a beacon in it, mostly of our version of the protocol."""
    made = msgspec.msgpack.decode(encoded(rng, kind))
    if isinstance(made, dict) and rng.random() < 0.95:
        beacon = made.get("beacon", made)
        if isinstance(beacon, dict):
            beacon["protocol"] = PROTOCOL_VERSION
    return made


def _beacons(rng: Random) -> bytes:
    return msgspec.msgpack.encode(_of_this_version(rng, Beacon))


def _introductions(rng: Random) -> bytes:
    body = msgspec.msgpack.encode(_of_this_version(rng, Introduction))
    length = len(body) if rng.random() < 0.9 else rng.choice((0, 1, 4001, 2**32 - 1))
    return length.to_bytes(4, "big") + body


class KeyFiles(Decoder):
    """Files of the home of keys, each read as its owner reads it."""

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


#: A pair of the manual of zmq_curve: a public key that is not the secret one's is refused.
_PUBLIC: Final = r"rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7"
_SECRET: Final = r"JTKVSB%%)wK0E.X)V>+}o?pNmC{O&4W4b!Ni{Lh6"


def _certificate(rng: Random) -> bytes:
    public, secret = rng.choice(((_PUBLIC, _SECRET), (_PUBLIC, _SECRET), (_SECRET, _PUBLIC), ("~" * 40, "ü" * 40)))
    lines = ["#   comment", "metadata", "curve", f'    public-key = "{public}"', f'    secret-key = "{secret}"']
    return "\n".join(line for line in lines if rng.random() < 0.95).encode()


def plain(kind: Any, decode: Callable[[bytes], Any], refusals: Errors) -> Callable[[Random], Decoder]:
    return lambda rng: Decoder(rng, [lambda rng: encoded(rng, kind)], decode, refusals)


_OURS: Final[Errors] = (ProtocolError,)
_ENTRIES: Final[Errors] = (msgspec.DecodeError,)
DECODERS: Final[dict[str, Callable[[Random], Any]]] = {
    "client": lambda rng: Decoder(rng, client_messages(), codec.decode_client, _OURS),
    "server": lambda rng: Decoder(rng, server_messages(), codec.decode_server, _OURS),
    "version": lambda rng: Decoder(rng, client_messages(), codec.peek_version, _OURS),
    "state-header": plain(StateHeader, codec.decode_state_header, _OURS),
    "presence": plain(Presence, codec.decode_presence, _OURS),
    "beacon": lambda rng: Decoder(rng, [_beacons], take_beacon, _OURS),
    "introduction": lambda rng: Decoder(rng, [_introductions], take_introduction, _OURS),
    "rigid": lambda rng: Decoder(rng, [rigid_frames(7)], take_rigid(7), (StreamError,)),
    "address": lambda rng: Decoder(rng, [address_texts], take_address, (ClientError,)),
    "entry": plain(entries.Entry, entries.decode_entry, _ENTRIES),
    "entries": plain(list[entries.Entry], entries.decode_entries, _ENTRIES),
    "link-decided": plain(link.Decided, link.decode_decided, _ENTRIES),
    "link-status": plain(link.FrontStatus, link.decode_status, _ENTRIES),
    "link-ports": plain(Ports, link.decode_ports, _ENTRIES),
    "link-scene": plain(SceneInfo, link.decode_scene, _ENTRIES),
    "journal-rows": plain(messages.Batch, check_journal, _ENTRIES),
    "journal-header": plain(journal.SessionHeader, messages.decode_header, _ENTRIES),
    "journal-keyframe": plain(journal.Keyframe, check_keyframe, _ENTRIES),
    "keys-clients": lambda rng: KeyFiles(rng, list[AllowedKey], lambda f: AllowList(f).read(), "clients.json"),
    "keys-codes": lambda rng: KeyFiles(rng, list[JoinCode], lambda f: JoinCodes(f).read(), "join_codes.json"),
    "keys-servers": lambda rng: KeyFiles(
        rng, list[KnownServer], lambda f: KnownServers(f).read(), "known_servers.json"
    ),
    "keys-sessions": lambda rng: KeyFiles(rng, list[SessionNote], lambda f: SessionNotes(f).read(), "sessions.json"),
    "keys-public": lambda rng: KeyFiles(rng, None, lambda f: load_public(f.path / "x.key"), "x.key", _certificate),
    "keys-secret": lambda rng: KeyFiles(rng, None, lambda f: load_secret(f.path / "x.key"), "x.key", _certificate),
}
