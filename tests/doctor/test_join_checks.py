"""Checks of joining: each refusal has its check; server keys are compared with the known ones."""

from __future__ import annotations

import os
import re

import numpy as np
import pytest

from iris_session.client.core.state_stream import SceneState
from iris_session.client.discovery import Address
from iris_session.client.errors import NotConnectedError, RefusedError, SessionNameError, TrustError, VersionError
from iris_session.doctor import network_checks
from iris_session.doctor.join_checks import (
    attempt_join,
    check_ports,
    check_server_key,
    check_state_age,
    explain_refusal,
    explain_unpaired_key,
)
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.names import RefusalCode
from iris_session.protocol.server_messages import Endpoints, Refused, StateHeader
from iris_session.security import KeyHome, KeyPair, RegisteredSession

pytestmark = pytest.mark.usefixtures("home")

ADDRESS = Address("192.0.2.7", 7721)


def offered_key(key: str) -> Introduction:
    return Introduction(Beacon(1, "s1", "lab", "live", "192.0.2.7", 7721, 7722, 0, 0, 0), key)


@pytest.mark.parametrize(
    ("error", "check"),
    [
        (VersionError(Refused("version", "no", supported_versions=(2,))), "version"),
        (RefusedError(Refused(RefusalCode.CODE, "used")), "code"),
        (RefusedError(Refused("role", "not as director")), "role"),
        (RefusedError(Refused(RefusalCode.FULL, "all in use")), "join"),
        (TrustError("another key"), "server_key"),
        (SessionNameError("two of them"), "beacon"),
        (NotConnectedError("nobody"), "join"),
    ],
)
def test_every_refusal_has_its_check(error: Exception, check: str) -> None:
    found = explain_refusal(error)  # type: ignore[arg-type]
    assert (found.check, found.state) == (check, "failed")
    assert found.text


def test_a_dropped_port_of_the_page_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def probe(_ip: str, port: int, _timeout_s: float) -> None:
        if port == 7725:
            raise TimeoutError

    monkeypatch.setattr(network_checks, "probe_tcp", probe)
    found = check_ports(ADDRESS, Endpoints(state=7722, media=7723, assets=7724, web=7725))
    assert [(one.check, one.state) for one in found] == [
        ("web_port", "failed"),
        ("media_port", "ok"),
        ("assets_port", "ok"),
    ]
    assert "7725 (web)" in found[0].text
    assert found[0].advice
    assert not check_ports(ADDRESS, Endpoints(state=7722)), "a session without a page"


def test_known_server_key_is_ok(home: KeyHome) -> None:
    key = KeyPair.generate().public
    assert check_server_key(ADDRESS, offered_key(key)).state == "warning"  # not known yet
    home.known_servers.pin(str(ADDRESS), "lab", key)
    assert check_server_key(ADDRESS, offered_key(key)).state == "ok"


def test_changed_server_key_fails(home: KeyHome) -> None:
    home.known_servers.pin(str(ADDRESS), "lab", KeyPair.generate().public)
    found = check_server_key(ADDRESS, offered_key(KeyPair.generate().public))
    assert found.failed
    assert "iris-session keys forget 192.0.2.7:7721" in found.advice


def test_key_of_a_scanned_code_is_compared(home: KeyHome) -> None:
    scanned = Address("192.0.2.7", 7721, server_key=KeyPair.generate().public)
    assert check_server_key(scanned, offered_key(KeyPair.generate().public)).failed
    assert check_server_key(scanned, offered_key(scanned.server_key)).state == "ok"


def test_revoked_key_is_explained(home: KeyHome) -> None:
    new = explain_unpaired_key(ADDRESS, offered_key(KeyPair.generate().public))
    assert (new.check, new.state, new.why) == ("key", "failed", "")
    assert "iris-session pair" in new.advice
    assert f"iris-session doctor {ADDRESS} --code" in new.advice
    key = KeyPair.generate().public
    home.known_servers.pin(str(ADDRESS), "lab", key)
    assert "admitted before" in explain_unpaired_key(ADDRESS, offered_key(key)).why


def test_owner_is_advised_to_allow_own_key(home: KeyHome) -> None:
    key = KeyPair.generate()
    home.sessions.add(RegisteredSession("s1", "lab", os.getpid(), ("192.0.2.7",), 7721, key.fingerprint))
    assert check_server_key(ADDRESS, offered_key(key.public)).state == "ok"
    assert explain_unpaired_key(ADDRESS, offered_key(key.public)).advice.endswith("keys allow me")
    assert "pair" in explain_unpaired_key(ADDRESS, offered_key(KeyPair.generate().public)).advice


def test_invalid_join_code_fails_check_code() -> None:
    [found] = attempt_join(ADDRESS, str(ADDRESS), "abc", "observer", None).findings
    assert (found.check, found.state) == ("code", "failed")
    assert "like 7KQ2-M4XD-9PTR" in found.text
    assert "iris-session pair" in found.advice


def state(session_time: int, age_ms: int) -> SceneState:
    return SceneState(StateHeader(1, 0, 0, 0.0, session_time, 0, 0, 0), np.zeros((0, 7)), 0, age_ms * 1_000_000)


def test_old_state_is_attributed_to_link_only_with_new_states() -> None:
    moving = [state(n, 3) for n in range(90)]
    assert check_state_age(moving, 0).state == "ok"
    slow = check_state_age([state(n, 300) for n in range(90)], 7)
    assert (slow.state, slow.why[:9]) == ("warning", "7 frames ")
    silent = check_state_age([state(5, 9000 + 250 * n) for n in range(6)], 0)
    assert silent.state == "warning"
    assert re.search(r"4 Hz, .* 10\.2 s", silent.text)
    assert "published" in silent.why
    assert check_state_age([state(5, 9000), *(state(6 + n, 3) for n in range(80))], 0).state == "ok", "it goes on"
    assert check_state_age([state(5, 3)], 0).state == "ok", "a single state proves nothing"
