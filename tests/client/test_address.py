"""Addresses as typed, and the URI of a pairing code."""

from __future__ import annotations

import pytest

from iris_session.client import ClientError
from iris_session.client.discovery import Address, pairing_uri
from iris_session.link.discovery import host_port, is_host

KEY = "rY5P4[G=Mu()uIR1{6xjIHL7utHv9:LKIMvLkp?v"


@pytest.mark.parametrize("host", ["10.0.0.5", "::1", "lab.local"])
def test_complete_uri_round_trips(host: str) -> None:
    uri = pairing_uri(host, 7731, KEY, "7KQ2-M4XD-9PTR", "lab 1/2")
    assert uri.startswith(f"iris://{host_port(host, 7731)}/?k=")
    assert Address.parse(uri) == Address(host, 7731, KEY, "7KQ2M4XD9PTR", "lab 1/2")
    assert str(Address.parse(uri)) == host_port(host, 7731)


def test_uri_may_lack_parts_or_have_unknown_ones() -> None:
    assert Address.parse("iris://10.0.0.5") == Address("10.0.0.5", 7721)
    assert Address.parse("IRIS://10.0.0.5:7731/?later=1&c=7kq2-m4xd-9ptr") == Address(
        "10.0.0.5", 7731, "", "7KQ2M4XD9PTR"
    )


@pytest.mark.parametrize(
    "uri",
    ["iris://", "iris://h:x/", "iris://h/?k=abc", "iris://h/?k=%20", "iris://h/?c=ABC", "iris://h/?k=" + "A" * 44],
)
def test_damaged_uri_is_rejected_with_an_example(uri: str) -> None:
    with pytest.raises(ClientError, match="iris://HOST:PORT") as error:
        Address.parse(uri)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "host", ["10.0.0.5", "lab", "lab-1.local", "a_b.", "xn--bcher-kva.example", "::1", "fe80::1%eth0"]
)
def test_valid_hosts_are_accepted(host: str) -> None:
    assert is_host(host)
    assert Address.parse(f"[{host}]:7731" if ":" in host else f"{host}:7731").host == host


@pytest.mark.parametrize(
    "host", ["a..b", ".a", "-", "a b", "*", "a/b", "x" * 64, "a." * 200, "bücher", "a\0b", "\ud800", "::1::2"]
)
def test_invalid_host_is_a_one_line_error(host: str) -> None:
    assert not is_host(host)
    with pytest.raises(ClientError, match="is not HOST:PORT"):
        Address.parse(host)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("127.0.0.1:7000", ("127.0.0.1", 7000)),
        ("lab.local", ("lab.local", 7721)),
        ("tcp://lab:1/", ("lab", 1)),
        ("[::1]:7000", ("::1", 7000)),
        ("::1", ("::1", 7721)),
        ("[::1]", ("::1", 7721)),
    ],
)
def test_addresses_are_parsed(text: str, expected: tuple[str, int]) -> None:
    address = Address.parse(text)
    assert (address.host, address.port) == expected


@pytest.mark.parametrize("text", ["", ":7721", "host:", "host:x", "host:70000", "[]:1"])
def test_invalid_addresses_are_rejected(text: str) -> None:
    with pytest.raises(ClientError, match="HOST:PORT"):
        Address.parse(text)
