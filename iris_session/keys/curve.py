"""CURVE key pairs: made, read from and written as ZeroMQ certificates, named by fingerprints."""

from __future__ import annotations

import base64
import hashlib
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import zmq
from zmq.auth import load_certificate
from zmq.utils import z85

from iris_session.keys.files import KeysError, PrivateFolder

Z85_CHARACTERS: Final = 40
_CERTIFICATE: Final = """#   ZeroMQ CURVE certificate of iris-session.
#   The secret key is what proves who you are: never pass it on.

metadata
curve
    public-key = "{public}"
    secret-key = "{secret}"
"""


def fingerprint(key: bytes, person: bytes = b"iris-key") -> str:
    """Name of a key (raw 32 bytes) that tells nothing about it: 128-bit BLAKE2b in base32, lower case."""
    digest = hashlib.blake2b(key, digest_size=16, person=person).digest()
    return base64.b32encode(digest).decode().rstrip("=").lower()


def raw_key(text: str) -> bytes:
    """The 32 raw bytes of a CURVE key in Z85 (40 characters). Raises `KeysError`."""
    if len(text) == Z85_CHARACTERS and text.isascii():
        try:
            key = z85.decode(text.encode())
        except (KeyError, ValueError, struct.error):  # the last: five characters above 2**32
            key = b""
        if len(key) == 32:
            return bytes(key)
    raise KeysError(f"{text[:50]!r} is not a CURVE key: {Z85_CHARACTERS} characters of Z85, as in a *.key file")


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A CURVE key pair, both halves Z85 text of 40 characters."""

    public: str
    secret: str

    def __repr__(self) -> str:
        return f"KeyPair({self.fingerprint})"  # never the secret, in no log and no traceback

    @property
    def raw_public(self) -> bytes:
        return raw_key(self.public)

    @property
    def fingerprint(self) -> str:
        return fingerprint(self.raw_public)

    @classmethod
    def new(cls) -> KeyPair:
        public, secret = zmq.curve_keypair()
        return cls(public.decode(), secret.decode())


def load_public(path: str | os.PathLike[str]) -> str:
    """The public key (Z85) in a ZeroMQ certificate, `*.key` or `*.key_secret`. Raises `KeysError`."""
    return _load(path)[0]


def load_secret(path: str | os.PathLike[str]) -> KeyPair:
    """The key pair in a `*.key_secret` certificate. Raises `KeysError`."""
    public, secret = _load(path)
    if not secret:
        raise KeysError(f"{os.fspath(path)} holds no secret key: give the *.key_secret file")
    try:
        raw_key(secret)
    except KeysError:  # whose text would show it
        raise KeysError(f"the secret key in {os.fspath(path)} is damaged") from None
    return KeyPair(public, secret)


def pair_in(folder: PrivateFolder, name: str) -> KeyPair:
    """The key pair in a file of a private folder, made on first use."""
    if folder.read(name) is None:  # also checks who may read it
        with folder.locked():
            if folder.read(name) is None:
                pair = KeyPair.new()
                folder.write(name, _CERTIFICATE.format(public=pair.public, secret=pair.secret).encode())
    return load_secret(folder.path / name)


def _load(path: str | os.PathLike[str]) -> tuple[str, str]:
    try:
        public, secret = load_certificate(Path(path))
        text = public.decode()
        raw_key(text)
    except (OSError, ValueError, IndexError, KeysError) as error:  # IndexError: a key without quotes
        raise KeysError(f"key file {os.fspath(path)} cannot be used: {error}") from error
    return text, secret.decode(errors="replace") if secret else ""
