"""CURVE key pairs: generated, read from and written as ZeroMQ certificates, identified by fingerprints."""

from __future__ import annotations

import base64
import hashlib
import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import zmq
from zmq.utils import z85

from iris_session.security.private_folder import KeysError, PrivateFolder, check_private

Z85_CHARACTERS: Final = 40
MAX_CERTIFICATE_BYTES: Final = 65_536
#: A line of a certificate (ZeroMQ's ZPL): the name of a key, and the key in quotes.
_KEY: Final = re.compile(r"""^[ \t]*(public|secret)-key[ \t]*=[ \t]*["']?([^"'\s]*)["']?[ \t\r]*$""", re.MULTILINE)
_CERTIFICATE: Final = """#   ZeroMQ CURVE certificate of iris-session.
#   The secret key is what proves who you are: never pass it on.

metadata
curve
    public-key = "{public}"
    secret-key = "{secret}"
"""


def compute_fingerprint(key: bytes, person: bytes = b"iris-key") -> str:
    """Return a public identifier of a key (raw 32 bytes): 128-bit BLAKE2b in base32, lower case."""
    digest = hashlib.blake2b(key, digest_size=16, person=person).digest()
    return base64.b32encode(digest).decode().rstrip("=").lower()


def decode_key(text: str) -> bytes:
    """Return the 32 raw bytes of a CURVE key in Z85 (40 characters). Raises `KeysError`."""
    if len(text) == Z85_CHARACTERS and text.isascii():
        try:
            key = z85.decode(text.encode())
        except (KeyError, ValueError, struct.error):  # the last: five characters above 2**32
            key = b""
        if len(key) == 32:
            return bytes(key)
    raise KeysError(f"{text[:50]!r} is not a CURVE key: expected {Z85_CHARACTERS} Z85 characters, as in a *.key file")


def encode_key(raw: bytes) -> str:
    """Return 32 raw bytes in Z85, as keys are written in files."""
    return z85.encode(raw).decode()


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A CURVE key pair, both halves Z85 text of 40 characters."""

    public: str
    secret: str

    def __repr__(self) -> str:
        return f"KeyPair({self.fingerprint})"  # the secret must not reach a log or traceback

    @property
    def raw_public(self) -> bytes:
        return decode_key(self.public)

    @property
    def fingerprint(self) -> str:
        return compute_fingerprint(self.raw_public)

    @classmethod
    def generate(cls) -> KeyPair:
        public, secret = zmq.curve_keypair()
        return cls(public.decode(), secret.decode())


def load_public(path: str | os.PathLike[str]) -> str:
    """Return the public key (Z85) of a ZeroMQ certificate, `*.key` or `*.key_secret`. Raises `KeysError`."""
    return _read_certificate(Path(path))[0]


def load_secret(path: str | os.PathLike[str]) -> KeyPair:
    """Return the key pair of a `*.key_secret` certificate that only its owner can read. Raises `KeysError`."""
    path = Path(path)
    public, secret = _read_certificate(path, private=True)
    if not secret:
        raise KeysError(f"{path} holds no secret key: give the *.key_secret file")
    try:
        decode_key(secret)
    except KeysError:  # its message would show the key
        raise KeysError(f"the secret key in {path} {_describe_bad_key(secret)}: generate a new pair") from None
    if zmq.curve_public(secret.encode()) != public.encode():
        raise KeysError(f"the two keys in {path} do not belong together: use the file as it was generated")
    return KeyPair(public, secret)


def load_or_create_pair(folder: PrivateFolder, name: str) -> KeyPair:
    """Return the key pair in a file of a private folder, generated on first use."""
    if folder.read(name) is None:  # also checks the permissions
        with folder.lock():
            if folder.read(name) is None:
                pair = KeyPair.generate()
                folder.write(name, _CERTIFICATE.format(public=pair.public, secret=pair.secret).encode())
    return load_secret(folder.path / name)


def find_pair(folder: PrivateFolder, name: str) -> KeyPair | None:
    """Return the key pair in a file of a private folder, `None` without one. Nothing is created."""
    return None if folder.read(name) is None else load_secret(folder.path / name)


def _read_certificate(path: Path, *, private: bool = False) -> tuple[str, str]:
    """Return both keys of a certificate, the secret one empty when it has none.

    `private`: a file with a secret key must be readable by this user alone. The check is of the file that was opened,
    not of the one that has its name later.
    """
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            text = file.read(MAX_CERTIFICATE_BYTES).decode(errors="replace")
    except PermissionError:
        raise KeysError(f"key file {path} cannot be read: its owner has to run chmod u+r {path}") from None
    except OSError as error:
        raise KeysError(f"key file {path} cannot be used: {error.strerror}") from None
    keys = dict(reversed(_KEY.findall(text)))  # the first of two
    public, secret = keys.get("public", ""), keys.get("secret", "")
    if private and secret:
        check_private(path, status, f"chmod 600 {path}")
    if not public:
        text = 'a ZeroMQ certificate with a line public-key = "..."'
        raise KeysError(f"key file {path} cannot be used: it should be {text}")
    try:
        decode_key(public)
    except KeysError:
        raise KeysError(f"key file {path} cannot be used: its public key {_describe_bad_key(public)}") from None
    return public, secret


def _describe_bad_key(key: str) -> str:
    """Return what is wrong with a key without showing it."""
    if len(key) != Z85_CHARACTERS:
        return f"has {len(key)} characters, a CURVE key has {Z85_CHARACTERS} of Z85"
    return f"is not {Z85_CHARACTERS} characters of Z85"
