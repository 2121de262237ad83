"""`iris-session keys` and `pair`: output, exit status, stored keys."""

from __future__ import annotations

import argparse
import json
import os
import socket
import time
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import pytest
from zmq.auth import create_certificates

from iris_session.cli.common import CommandError, check_session_reachable, describe_error, describe_own_sessions
from iris_session.client import RefusedError
from iris_session.client.discovery import Address
from iris_session.doctor.runner import LOCAL, find_default_address
from iris_session.protocol import pairing
from iris_session.protocol.names import RefusalCode
from iris_session.protocol.server_messages import Refused
from iris_session.security import KeyHome, KeyPair, RegisteredSession
from iris_session.web.certificate import find_certificate, load_or_make_certificate
from tests.cli.conftest import CommandLine


@pytest.fixture
def lab(home: KeyHome) -> KeyHome:
    """A home with one running session."""
    mark = home.load_server_key().fingerprint
    home.sessions.add(RegisteredSession("id", "lab-1", os.getpid(), ("10.0.0.5", "fd00::5"), 7731, mark))
    return home


def test_allow_list_revoke(home: KeyHome, tmp_path: Path, cli: CommandLine) -> None:
    assert "no keys" in cli.run("keys", "list")
    certificate, _ = create_certificates(tmp_path, "ann")
    bob = KeyPair.generate()
    cli.run("keys", "allow", "ann", certificate, "--role", "director", "--role", "operator")
    cli.run("keys", "allow", "bob", bob.public)
    rows = {row["name"]: row for row in cli.json("keys", "list")["keys"]}
    assert rows["ann"]["roles"] == ["director", "operator"]
    assert rows["bob"]["roles"] == ["operator", "observer", "agent", "leader"], "directing is given by name only"
    assert rows["bob"]["fingerprint"] == bob.fingerprint
    cli.run("keys", "allow", "bob", bob.public, "--role", "any")
    assert home.clients.read()[bob.fingerprint].roles == ()
    assert "any role" in cli.run("keys", "list")
    cli.run("keys", "revoke", "ann")
    assert "'ann' on the list" in cli.refuse("keys", "revoke", "ann")
    assert list(home.clients.read()) == [bob.fingerprint]


def test_allow_without_a_key_adds_the_own_one_which_may_direct(home: KeyHome, cli: CommandLine) -> None:
    for options, roles in (
        (["--role", "any"], set()),
        ([], {"operator", "observer", "agent", "leader", "director"}),
        (["--role", "observer"], {"observer"}),
    ):
        assert home.load_identity().fingerprint in cli.run("keys", "allow", "me", *options)
        assert [(one.name, set(one.roles)) for one in home.clients.read().values()] == [("me", roles)]


def test_default_address_is_the_own_session(home: KeyHome) -> None:
    """A session that listens on one network is not at 127.0.0.1, where a command looks by itself."""
    home.sessions.add(
        RegisteredSession("s1", "lab-1", os.getpid(), ("192.0.2.7",), 7721, home.load_server_key().fingerprint)
    )
    assert find_default_address() == "192.0.2.7:7721"
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # without listening: no other process gets the port
        unused = f"127.0.0.1:{closed.getsockname()[1]}"
        with pytest.raises(CommandError) as raised:
            check_session_reachable(argparse.Namespace(session="", address=unused))
    assert "your session" not in str(raised.value)
    assert describe_own_sessions().endswith("'lab-1' is at 192.0.2.7:7721")
    home.sessions.remove("s1", os.getpid())
    assert find_default_address() == LOCAL
    assert "--session NAME" in describe_own_sessions()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["keys", "allow", "eve", "short"], "'short' is"),
        (["keys", "allow", "eve", "missing.key"], "missing.key"),
        (["keys", "forget", "10.0.0.9:7721"], "'10.0.0.9:7721'; stored: none"),
        (["pair"], "no encrypted session"),
        (["pair", "--address", "lab:99999", "--no-wait"], "not HOST:PORT"),
    ],
)
def test_expected_errors_are_one_line_each(home: KeyHome, arguments: list[str], text: str, cli: CommandLine) -> None:
    assert text in cli.refuse(*arguments)
    assert home.join_codes.read() == []


def test_show_creates_nothing(home: KeyHome, cli: CommandLine) -> None:
    shown = cli.json("keys", "show")
    assert shown == {"home": str(home.path), "server": None, "identity": None, "certificate": None}
    text = cli.run("keys", "show")
    assert (text.count("no key yet"), text.count("no certificate yet")) == (2, 1)
    assert not home.path.exists()


def test_show_prints_public_keys_and_the_certificate_of_the_page(home: KeyHome, cli: CommandLine) -> None:
    server, own = home.load_server_key(), home.load_identity()
    made = load_or_make_certificate(home, ["192.168.0.10"])
    text = cli.run("keys", "show", "--json")
    shown = json.loads(text)
    assert shown["server"]["fingerprint"] == server.fingerprint
    assert shown["identity"]["key"] == own.public
    assert shown["certificate"] == {"fingerprint": made.fingerprint, "key": made.key}
    lines = cli.run("keys", "show")
    assert made.fingerprint in lines
    assert "192.168.0.10" in lines
    assert not any(one.secret in text + lines for one in (server, own))


def test_pair_web_shows_a_link_that_works_behind_the_gateway(home: KeyHome, cli: CommandLine) -> None:
    command = ["pair", "--web", "--no-wait", "--address", "192.168.0.10:7731"]
    invitation = cli.json(*command)
    made = find_certificate(home)
    assert made is not None
    assert "192.168.0.10" in made.names
    assert invitation["page"] == f"https://192.168.0.10:7735/#c={invitation['code']}"
    assert invitation["certificate"] == made.fingerprint
    (code,) = home.join_codes.read()
    assert code.web_key == made.spki_hash
    cli.run(*command)
    assert "in a browser https://192.168.0.10:7735/#c=" in cli.out
    assert "assumed at port 7735: give --web-port" in cli.err


def find_page_port(cli: CommandLine, *options: str) -> int | None:
    page = cli.json("pair", "--web", "--no-wait", "--address", "192.168.0.10:7731", *options)["page"]
    assert "assumed" not in cli.err
    return urlsplit(page).port


def test_pair_web_has_the_port_of_a_session_that_runs_here(home: KeyHome, cli: CommandLine) -> None:
    mark = home.load_server_key().fingerprint
    home.sessions.add(RegisteredSession("s0", "lab-0", os.getpid(), ("10.0.0.5",), 7721, mark, 7725))
    assert find_page_port(cli, "--web-port", "9001") == 9001
    home.sessions.add(RegisteredSession("s1", "lab-1", os.getpid(), ("10.0.0.5",), 7731, mark, 8443))
    assert find_page_port(cli) == 8443
    assert find_page_port(cli, "--web-port", "9001") == 9001
    home.sessions.add(RegisteredSession("s1", "lab-1", os.getpid(), ("10.0.0.5",), 7731, mark, 0))
    assert "serves no page" in cli.refuse("pair", "--web", "--no-wait", "--address", "192.168.0.10:7731")
    assert "2 sessions run here" in cli.refuse("pair", "--no-wait")
    assert cli.json("pair", "--no-wait", "--session", "lab-1")["page"] == "", "no link to a page that is not served"


def test_pair_unity_writes_what_a_headset_reads_at_start(home: KeyHome, tmp_path: Path, cli: CommandLine) -> None:
    mark = home.load_server_key().fingerprint
    home.sessions.add(RegisteredSession("s1", "lab-1", os.getpid(), ("10.0.0.5", "fd00::5"), 7731, mark, 8443))
    path = tmp_path / "pairing.json"
    shown, written = cli.json("pair", "--unity", path, "--no-wait"), json.loads(path.read_text())
    made = find_certificate(home)
    assert made is not None
    assert {"10.0.0.5", "fd00::5"} <= set(made.names), "the certificate is for the addresses in the file"
    assert written == {
        "format": 1,
        "session": "lab-1",
        "addresses": ["https://10.0.0.5:8443/", "https://[fd00::5]:8443/"],
        "pin": made.key,
        "code": shown["code"],
        "expires": shown["expires"],
    }
    assert shown["file"] == str(path)
    assert path.stat().st_mode & 0o077 == 0
    (code,) = home.join_codes.read()
    assert code.web_key == made.spki_hash, "the code is valid behind the gateway"
    cli.run("pair", "--unity", tmp_path / "missing" / "pairing.json", "--no-wait", status=2)
    assert not any(one.is_open(time.time()) for one in home.join_codes.read() if one.id != code.id), "void again"
    home.sessions.add(RegisteredSession("s1", "lab-1", os.getpid(), ("10.0.0.5",), 7731, mark, 0))
    assert "serves no page" in cli.refuse("pair", "--unity", path, "--no-wait")
    home.sessions.add(RegisteredSession("s1", "lab-1", os.getpid(), ("127.0.0.1",), 7731, mark, 8443))
    cli.run("pair", "--unity", path, "--no-wait")
    assert str(path) in cli.out
    assert "adb reverse tcp:8443" in cli.err, "no headset reaches the address of this machine over a network"


def test_refused_owner_of_a_session_reads_how_to_allow_the_own_key(lab: KeyHome) -> None:
    refused = RefusedError(Refused(RefusalCode.UNPAIRED, "this key is not on the session's list", ""))
    assert "keys allow me" in describe_error(refused)
    assert "keys allow me" not in describe_error(RefusedError(Refused(RefusalCode.CODE, "wrong", "")))
    for note in lab.sessions.read():
        lab.sessions.remove(note.session_id, note.pid)
    assert "keys allow me" not in describe_error(refused)


def test_forget_removes_stored_key(cli: CommandLine, home: KeyHome) -> None:
    home.known_servers.pin("10.0.0.9:7721", "lab", KeyPair.generate().public)
    cli.run("keys", "forget", "10.0.0.9:7721")
    assert home.known_servers.read() == []


def test_pair_shows_a_complete_uri(lab: KeyHome, tmp_path: Path, cli: CommandLine) -> None:
    png = tmp_path / "code.png"
    result = cli.json("pair", "--no-wait", "--png", png, "--name", "tablet", "--minutes", "2")
    assert result["fingerprint"] == lab.load_server_key().fingerprint
    address = Address.parse(result["uri"])
    assert (address.host, address.port, address.session) == ("10.0.0.5", 7731, "lab-1")
    assert address.server_key == lab.load_server_key().public
    assert pairing.normalise_code(result["code"]) == address.join_code
    assert result["addresses"] == ["10.0.0.5:7731", "[fd00::5]:7731"]
    assert 60 < result["expires"] - time.time() <= 120
    picture = cv2.imread(str(png))  # for some random codes one of OpenCV's two finders sees no corners
    readers = (cv2.QRCodeDetector(), cv2.QRCodeDetectorAruco())
    assert result["uri"] in [reader.detectAndDecode(picture)[0] for reader in readers], "a camera reads it"
    (made,) = lab.join_codes.read()
    assert (made.name, made.roles) == ("tablet", ("operator", "observer", "agent", "leader"))
    out = cli.run("pair", "--no-wait", "--address", "192.0.2.7")
    assert "\u2588" in out
    assert "192.0.2.7:7721" in out


def test_unused_code_fails_and_interrupted_code_is_void(
    lab: KeyHome, cli: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "expired" in cli.run("pair", "--minutes", "0.002", status=1)

    def interrupt(_seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("iris_session.cli.pair.time.sleep", interrupt)
    cli.run("pair", status=130)
    assert not any(
        one.is_open(time.time()) for one in lab.join_codes.list_for_server(lab.load_server_key().fingerprint)
    )


def test_pair_waits_and_prints_paired_name(lab: KeyHome, cli: CommandLine, monkeypatch: pytest.MonkeyPatch) -> None:
    ann, server = KeyPair.generate(), lab.load_server_key()

    def use_code(_seconds: float) -> None:
        (made,) = [one for one in lab.join_codes.read() if one.secret]
        proof = pairing.make_client_proof(made.secret, server.raw_public, ann.raw_public)
        lab.join_codes.redeem(server.raw_public, ann.public, proof, "ann", lab.clients)

    monkeypatch.setattr("iris_session.cli.pair.time.sleep", use_code)
    assert f"paired: ann ({ann.fingerprint})" in cli.run("pair", "--role", "observer")
