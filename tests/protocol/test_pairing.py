"""Join codes and their proofs: the vector of docs/protocol.md, spellings, invalid codes."""

from __future__ import annotations

import hashlib
import hmac
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iris_session.protocol import pairing

PAGE = Path(__file__).parents[2] / "docs" / "protocol.md"
SERVER, CLIENT = bytes(range(32)), bytes(range(32, 64))


def test_vector_of_the_document() -> None:
    page = PAGE.read_text(encoding="utf-8")
    vector = dict(re.findall(r"^(stretched|client_proof|server_proof) +([0-9a-f]{64})$", page, re.MULTILINE))
    stretched = pairing.stretch_code("7KQ2-M4XD-9PTR", SERVER)
    assert vector == {
        "stretched": stretched.hex(),
        "client_proof": pairing.make_client_proof(stretched, SERVER, CLIENT).hex(),
        "server_proof": pairing.make_server_proof(stretched, SERVER, CLIENT).hex(),
    }
    by_the_text = hashlib.pbkdf2_hmac("sha256", b"7KQ2M4XD9PTR", b"iris-pair-1" + SERVER, 200_000, 32)
    assert by_the_text == stretched
    assert hmac.new(stretched, b"client" + SERVER + CLIENT, "sha256").hexdigest() == vector["client_proof"]


@given(st.binary(min_size=8, max_size=8))
def test_codes_are_normalised_from_any_spelling(entropy: bytes) -> None:
    code = pairing.make_code(entropy)
    assert re.fullmatch(r"[0-9A-HJKMNP-TV-Z]{4}(-[0-9A-HJKMNP-TV-Z]{4}){2}", code)
    normal = pairing.normalise_code(code)
    assert len(normal) == 12
    for spelt in (code.lower(), normal, f" {code} ", code.replace("0", "O").replace("1", "l").replace("V", "u")):
        assert pairing.normalise_code(spelt) == normal
    number = int.from_bytes(entropy, "big")
    assert pairing.make_code(((number + 1) % 2**64).to_bytes(8, "big")) != code


@pytest.mark.parametrize(
    "text",
    ["", "7KQ2-M4XD", "7KQ2-M4XD-9PT", "7KQ2-M4XD-9PTRD", "7KQ2-M4XD-9PT!", "\u0667KQ2M4XD9PTR", "7KQ2_M4XD_9PTR"],
)
def test_invalid_codes_are_rejected(text: str) -> None:
    with pytest.raises(ValueError, match="join code"):
        pairing.stretch_code(text, SERVER)


def test_proofs_depend_on_both_keys_and_the_role() -> None:
    stretched = pairing.stretch_code("7KQ2-M4XD-9PTR", SERVER)
    proofs = {
        pairing.make_client_proof(stretched, SERVER, CLIENT),
        pairing.make_server_proof(stretched, SERVER, CLIENT),
        pairing.make_client_proof(stretched, SERVER, SERVER),
        pairing.make_client_proof(stretched, CLIENT, SERVER),
        pairing.make_client_proof(pairing.stretch_code("7KQ2-M4XD-9PTS", SERVER), SERVER, CLIENT),
        pairing.make_client_proof(pairing.stretch_code("7KQ2-M4XD-9PTR", CLIENT), SERVER, CLIENT),
    }
    assert len(proofs) == 6
    with pytest.raises(ValueError, match="32 raw bytes"):
        pairing.make_client_proof(stretched, b"x" * 40, CLIENT)
