"""Choice of the server key: every combination of given, stored and offered keys."""

from __future__ import annotations

import pytest
from zmq.utils import z85

from iris_session.client import TrustError
from iris_session.client.discovery import Address
from iris_session.client.server_trust import ServerTrust
from iris_session.security import KeyHome

A, B = (z85.encode(bytes([first] * 32)).decode() for first in (1, 2))
LAB = Address("10.0.0.5", 7721)


@pytest.mark.parametrize(
    ("given", "stored", "offered", "loopback", "used"),
    [
        ("", "", A, False, A),  # on first use
        ("", A, A, False, A),
        (A, "", A, False, A),
        (A, A, A, False, A),
        ("", "", None, False, None),  # nothing known, nothing offered: wait
        ("", A, None, False, A),  # its introduction may be blocked by a firewall
        (A, "", None, False, A),
        ("", "", None, True, ""),
        ("", "", "", True, ""),
        ("", A, "", True, ""),  # encrypted yesterday, an unencrypted session of this machine today
        ("", "", A, True, A),
    ],
)
def test_selected_key(
    home: KeyHome, given: str, stored: str, offered: str | None, loopback: bool, used: str | None
) -> None:
    if stored:
        home.known_servers.pin(str(LAB), "lab-1", stored)
    address = Address(LAB.host, LAB.port, given)
    assert ServerTrust(home, address).select_key(offered, loopback=loopback) == used


@pytest.mark.parametrize(
    ("given", "stored", "offered", "loopback"),
    [
        ("", A, B, False),  # another program answers
        ("", A, B, True),
        (A, "", B, False),
        (A, B, A, False),  # the code belongs to another session than the known one
        (A, B, None, False),
        ("", "", "", False),  # not encrypted over a network
        ("", A, "", False),
        (A, "", "", True),
    ],
)
def test_mismatched_key_is_an_error_and_never_stored(
    home: KeyHome, given: str, stored: str, offered: str | None, loopback: bool
) -> None:
    if stored:
        home.known_servers.pin(str(LAB), "lab-1", stored)
    trust = ServerTrust(home, Address(LAB.host, LAB.port, given))
    with pytest.raises(TrustError, match=r"10\.0\.0\.5:7721"):
        trust.select_key(offered, loopback=loopback)
    if stored:
        with pytest.raises(TrustError, match="iris-session keys forget"):
            trust.store("lab-1", A if stored == B else B)
    assert [one.key for one in home.known_servers.read()] == ([stored] if stored else [])


def test_known_name_with_another_key_is_not_trusted_on_first_use(home: KeyHome) -> None:
    home.known_servers.pin("10.0.0.7:7721", "lab-1", A)
    ServerTrust(home, LAB, "lab-1").check_name(A)  # the machine has another address today
    ServerTrust(home, LAB, "lab-2").check_name(B)
    ServerTrust(home, LAB).check_name(B)  # not requested by name
    with pytest.raises(TrustError, match="another key"):
        ServerTrust(home, LAB, "lab-1").check_name(B)
