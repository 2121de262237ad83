"""Join codes: proofs by which a client and a session show each other that they know the same code, without sending it.

A join code is twelve characters (60 bits), valid for minutes and for one client. Both sides stretch it once:

    stretched    = PBKDF2-HMAC-SHA256(code, salt = "iris-pair-1" || server_public, 200,000 iterations, 32 bytes)
    client_proof = HMAC-SHA256(stretched, "client" || server_public || client_public)
    server_proof = HMAC-SHA256(stretched, "server" || server_public || client_public)

Keys are the raw 32 bytes of the CURVE keys in use. So a code protects against a relay in the middle: one that uses its
own keys gets a proof that allows nothing but testing guesses of the code, at 200,000 iterations each. While a code is
valid, or beforehand for a key of the relay, that covers a vanishing part of 2**60 guesses (docs/security.md has the
numbers). PBKDF2 because every browser and .NET has it; a password-authenticated key exchange would need a shorter code
only, but none is in their standard libraries.
"""

from __future__ import annotations

import hashlib
import hmac
from typing import Final

#: Crockford's base 32: no I, L, O, U. Any of them, and lower case, is read as the character that it resembles.
ALPHABET: Final = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
CODE_CHARACTERS: Final = 12
#: Random bytes that a code is made from; it takes 60 bits of them.
CODE_BYTES: Final = 8
KEY_BYTES: Final = 32
ITERATIONS: Final = 200_000
_SALT: Final = b"iris-pair-1"
_LOOKS_LIKE: Final = str.maketrans("OILU", "011V")


def make_code(entropy: bytes) -> str:
    """Return the join code `XXXX-XXXX-XXXX` made from the last 60 bits of eight random bytes."""
    if len(entropy) != CODE_BYTES:
        raise ValueError(f"a join code is made from {CODE_BYTES} bytes, not {len(entropy)}")
    number = int.from_bytes(entropy, "big")
    text = "".join(ALPHABET[(number >> shift) & 31] for shift in range(5 * CODE_CHARACTERS - 5, -1, -5))
    return f"{text[:4]}-{text[4:8]}-{text[8:]}"


def normalise_code(text: str) -> str:
    """Return a typed code in the one form that is stretched. Raises `ValueError` for any other text."""
    code = text.upper().translate(_LOOKS_LIKE).replace("-", "").replace(" ", "")
    if len(code) != CODE_CHARACTERS or any(character not in ALPHABET for character in code):
        raise ValueError(f"{text!r} is not a join code: twelve letters and digits, like 7KQ2-M4XD-9PTR")
    return code


def stretch_code(code: str, server_public: bytes) -> bytes:
    """Derive the secret that both sides share from `code` (any spelling): takes about 0.1 s, on purpose."""
    _check_key(server_public)
    return hashlib.pbkdf2_hmac("sha256", normalise_code(code).encode(), _SALT + server_public, ITERATIONS, 32)


def make_client_proof(stretched: bytes, server_public: bytes, client_public: bytes) -> bytes:
    """Return the proof that the client sends in `Pair`."""
    return _make_proof(stretched, b"client", server_public, client_public)


def make_server_proof(stretched: bytes, server_public: bytes, client_public: bytes) -> bytes:
    """Return the proof that the session answers in `Paired`."""
    return _make_proof(stretched, b"server", server_public, client_public)


def is_same_proof(a: bytes, b: bytes) -> bool:
    """Compare two proofs in constant time."""
    return hmac.compare_digest(a, b)


def _make_proof(stretched: bytes, side: bytes, server_public: bytes, client_public: bytes) -> bytes:
    _check_key(server_public)
    _check_key(client_public)
    return hmac.digest(stretched, side + server_public + client_public, "sha256")


def _check_key(key: bytes) -> None:
    if len(key) != KEY_BYTES:
        raise ValueError(f"a CURVE key has {KEY_BYTES} raw bytes, got {len(key)}: decode Z85 first")
