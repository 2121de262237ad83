"""Vectors of addresses, links, join codes, keys and beacons, read by the Python client, for the tests of the C# one.

A line is a kind and its values, with tabs between; texts and bytes in hexadecimal.

    host          text, is it a host (0 or 1), is it this machine
    link          text, and host, control port, key, join code, name of the session; only the text: it is refused
    code          text, the normal form, empty: it is refused
    key           bytes, fingerprint
    certificate   bytes, fingerprint
    proof         code, S, C, stretched, client's proof, server's proof
    beacon        bytes, sender, why it is ignored, or `HOST:PORT`
    introduction  bytes, control port, session id; `more`: it is the beginning of one; `refused`
"""

from __future__ import annotations

import hashlib
import string
from collections.abc import Iterator
from functools import cache
from random import Random
from typing import Final

import msgpack
import msgspec

from iris_session.client.discovery import Address, pairing_uri
from iris_session.client.errors import ClientError
from iris_session.link.config import is_loopback
from iris_session.link.discovery import BeaconListener, is_host, is_plausible
from iris_session.protocol import pairing
from iris_session.protocol.codec import decode_introduction, encode_introduction
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.errors import ProtocolError
from iris_session.security import compute_fingerprint, decode_key

KEY: Final = "rY5P4[G=Mu()uIR1{6xjIHL7utHv9:LKIMvLkp?v"
CODE: Final = "7KQ2-M4XD-9PTR"
_HOSTS: Final = (
    "10.0.0.5", "lab", "lab-1.local", "a_b.", "xn--bcher-kva.example", "::1", "fe80::1%eth0", "127.0.0.1", "127.8.9.1",
    "localhost", "a..b", ".a", "-", "a b", "*", "a/b", "x" * 64, "a." * 200, "bücher", "::1::2", "::", "1::", "::1%",
    "::1%25lo", "1:2:3:4:5:6:7:8", "1:2:3:4:5:6:7", "1::2:3:4:5:6:7:8", "1:2:3:4:5:6:7::", "::127.0.0.1", "::1.2.3.256",
    "::01.2.3.4", "1:2:3:4:5:6:1.2.3.4", "1:2:3:4:5:6:7:1.2.3.4", "12345::", "g::", ":::", ":1", "1:", "127.1",
    "127.0.0.01",
)  # fmt: skip
_TEXTS: Final = (
    "", " ", ":7721", "host:", "host:x", "host:70000", "host:0", "[]:1", "127.0.0.1:7000", "lab.local", "tcp://lab:1/",
    "[::1]:7000", "::1", "[::1]", "iris://", "iris://h:x/", "iris://h/?k=abc", "iris://h/?k=%20", "iris://h/?c=ABC",
    "iris://h/?k=" + "A" * 44, "iris://10.0.0.5", "IRIS://10.0.0.5:7731/?later=1&c=7kq2-m4xd-9ptr", "iris://h?n=a+b%20c",
    "iris://h/?n=%C3%BC&n=last", "iris://h/?n=&c=", "iris://h/?n=1&k=" + "A" * 42 + "-", "iris://h/x/y?n=1#c=2",
)  # fmt: skip


@cache
def render_pairing_vectors(count: int = 400) -> str:
    """Return the lines. `count`: how many of each kind are made from others by a few changed characters or bytes."""
    random = Random(34)
    lines: list[tuple[str, ...]] = []
    hosts = [*_HOSTS, *(_change_text(random, random.choice(_HOSTS), "01:.af%-_z") for _ in range(count))]
    lines += [("host", _hex(host), str(int(is_host(host))), str(int(is_loopback(host)))) for host in hosts]
    uris = [pairing_uri(host, 7731, KEY, CODE, "lab 1/2 ü") for host in ("10.0.0.5", "::1", "lab.local")]
    texts = [*_TEXTS, *uris, *(f"{host}:7731" for host in _HOSTS)]
    texts += [_change_text(random, random.choice(texts), string.printable[:94]) for _ in range(count)]
    lines += [_describe_link(text.strip()) for text in texts]
    codes = [_change_text(random, CODE, "oU -x%") for _ in range(count // 10)]
    codes += [CODE, " 7kq2 m4xd 9ptr ", "OILU-oilu-0000", "7KQ2-M4XD-9PT", "7KQ2-M4XD-9PTRR", "", "7KQ2-M4XD-9PT!"]
    lines += [_describe_code(code) for code in codes]
    for length in (0, 1, 32, 129):
        data = random.randbytes(length)
        lines.append(("key", data.hex(), compute_fingerprint(data)))
        lines.append(("certificate", data.hex(), hashlib.sha256(data).hexdigest().upper()))
    lines.append(_describe_proof(CODE, bytes(range(32)), bytes(range(32, 64))))
    lines += _iterate_beacons(random, count)
    lines += _iterate_introductions(random, count)
    return "".join("\t".join(line) + "\n" for line in lines)


def _hex(text: str) -> str:
    return text.encode().hex()


def _change_text(random: Random, text: str, characters: str) -> str:
    changed = list(text)
    for _ in range(random.choice((1, 1, 2))):
        at = random.randrange(len(changed) + 1)
        changed[at : at + random.randrange(2)] = random.choice(("", random.choice(characters)))
    return "".join(changed)


def _describe_link(text: str) -> tuple[str, ...]:
    try:
        found = Address.parse(text)
    except ClientError:
        return "link", _hex(text)
    key = decode_key(found.server_key).hex() if found.server_key else ""
    return "link", _hex(text), found.host, str(found.port), key, found.join_code, _hex(found.session)


def _describe_code(text: str) -> tuple[str, ...]:
    try:
        return "code", _hex(text), pairing.normalise_code(text)
    except ValueError:
        return "code", _hex(text), ""


def _describe_proof(code: str, server: bytes, client: bytes) -> tuple[str, ...]:
    stretched = pairing.stretch_code(code, server)
    by_client = pairing.make_client_proof(stretched, server, client)
    by_server = pairing.make_server_proof(stretched, server, client)
    return "proof", _hex(code), server.hex(), client.hex(), stretched.hex(), by_client.hex(), by_server.hex()


def _make_beacon(**fields: object) -> Beacon:
    return msgspec.structs.replace(
        Beacon(1, "id", "lab", "live", "10.0.0.5", 7721, 7722, 7723, 7724, 7725, "abc"), **fields
    )


def _iterate_beacons(random: Random, count: int) -> Iterator[tuple[str, ...]]:
    made = [
        _make_beacon(), _make_beacon(protocol=2), _make_beacon(host="127.0.0.1"), _make_beacon(host="a b"),
        _make_beacon(session_name="lab\n2"), _make_beacon(session_name="l\u200bab"), _make_beacon(session_name=""),
        _make_beacon(session_name="Labor für Ü 🤖"), _make_beacon(control=0), _make_beacon(control=65536),
        _make_beacon(key_fingerprint=""), _make_beacon(host="::1"), _make_beacon(session_id="\u2028"),
    ]  # fmt: skip
    data = [msgspec.msgpack.encode(beacon) for beacon in made]
    data += [b"", b"\x80", data[0] + b"\0", msgpack.packb({**msgspec.to_builtins(made[0]), "later": "x" * 1_000})]
    data += [msgpack.packb({**msgspec.to_builtins(made[0]), "later": "x" * 2_000}), msgpack.packb({"protocol": 7})]
    # The C# one reads all texts before it knows that a message is of another version.
    data += [_change_bytes(random, random.choice((data[0], *data[2:]))) for _ in range(count)]
    for one in data:
        for sender in ("10.0.0.9", "127.0.0.1"):
            yield "beacon", one.hex(), sender, _describe_beacon(one, sender)


def _describe_beacon(data: bytes, sender: str) -> str:
    with BeaconListener(0) as listener:
        listener._process_datagram(data, sender)
        ignored = next(iter(listener.ignored), "")
        return ignored or listener.poll_sessions()[0].address


def _iterate_introductions(random: Random, count: int) -> Iterator[tuple[str, ...]]:
    whole = encode_introduction(Introduction(_make_beacon(), "k" * 40, True, 3))
    other = encode_introduction(Introduction(_make_beacon(protocol=2)))
    wrong = encode_introduction(Introduction(_make_beacon(host="a b")))
    data = [whole, other, wrong, whole[:3], whole[:20], whole + b"\0", b"", b"\0\0\x0f\xa1", b"\xff\xff\xff\xff"]
    data += [_change_bytes(random, whole) for _ in range(count)]
    for one in data:
        yield "introduction", one.hex(), "7721", _describe_introduction(one, 7721)
    yield "introduction", whole.hex(), "7722", "refused"


def _describe_introduction(data: bytes, control: int) -> str:
    try:
        introduction = decode_introduction(data)
    except ProtocolError:
        return "refused"
    if introduction is None:
        return "more"
    beacon = introduction.beacon
    return beacon.session_id if is_plausible(beacon) and beacon.control == control else "refused"


def _change_bytes(random: Random, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(random.choice((1, 1, 2))):
        at = random.randrange(len(changed) + 1)
        changed[at : at + random.randrange(2)] = random.choice((b"", random.randbytes(1)))
    return bytes(changed)
