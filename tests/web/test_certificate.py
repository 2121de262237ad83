"""The certificate of the gateway: made once, renewed with the same key, and one of the user's own."""

from __future__ import annotations

import contextlib
import hashlib
import ssl
import stat
import subprocess
from pathlib import Path

import pytest

from iris_session.security import KeyHome, KeysError
from iris_session.system import extras
from iris_session.web import certificate
from iris_session.web.certificate import (
    find_certificate,
    load_certificate,
    load_or_make_certificate,
    make_tls_context,
    normalise_name,
)


@pytest.fixture
def home(tmp_path: Path) -> KeyHome:
    return KeyHome(tmp_path / "home")


def test_it_is_made_once_and_private(home: KeyHome) -> None:
    assert find_certificate(home) is None
    made = load_or_make_certificate(home, ["192.168.0.10", "lab-pc"])
    assert {"192.168.0.10", "lab-pc", "localhost", "127.0.0.1", "::1"} <= set(made.names)
    assert load_or_make_certificate(home, ["192.168.0.10"]) == made == find_certificate(home)
    assert [stat.S_IMODE(path.stat().st_mode) for path in (made.certificate_path, made.key_path)] == [0o600, 0o600]
    assert len(made.spki_hash) == 32
    assert len(made.key) == 43
    der = ssl.PEM_cert_to_DER_cert(made.certificate_path.read_text())
    assert made.fingerprint.replace(":", "") == hashlib.sha256(der).hexdigest().upper()
    make_tls_context(made.certificate_path, made.key_path)


def test_clients_get_tls_in_which_every_record_becomes_data_or_ends_it(home: KeyHome) -> None:
    """TLS 1.3 has KeyUpdate, which does neither and cannot be switched off."""
    made = load_or_make_certificate(home, [])
    serving = make_tls_context(made.certificate_path, made.key_path)
    assert serving.options & ssl.OP_NO_RENEGOTIATION

    def connect(client: ssl.SSLContext) -> tuple[str | None, str | None]:
        client.check_hostname, client.verify_mode = False, ssl.CERT_NONE
        client.set_alpn_protocols(["http/1.1"])
        to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
        ends = [client.wrap_bio(to_client, to_server), serving.wrap_bio(to_server, to_client, server_side=True)]
        for _ in range(4):
            for end in ends:
                with contextlib.suppress(ssl.SSLWantReadError):
                    end.do_handshake()
        return ends[0].version(), ends[0].selected_alpn_protocol()

    assert connect(ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)) == ("TLSv1.2", "http/1.1")
    newest = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    newest.minimum_version = ssl.TLSVersion.TLSv1_3
    with pytest.raises(ssl.SSLError):
        connect(newest)


def test_spki_hash_is_that_of_openssl(home: KeyHome) -> None:
    made = load_or_make_certificate(home, [])
    command = f"openssl x509 -in {made.certificate_path} -pubkey -noout | openssl pkey -pubin -outform der"
    der = subprocess.run(["bash", "-c", command], capture_output=True, check=True).stdout
    assert hashlib.sha256(der).digest() == made.spki_hash


def test_a_new_address_renews_it_with_the_same_key(home: KeyHome) -> None:
    before = load_or_make_certificate(home, ["192.168.0.10"])
    key = before.key_path.read_bytes()
    after = load_or_make_certificate(home, ["10.1.2.3"])
    assert {"192.168.0.10", "10.1.2.3"} <= set(after.names)
    assert after.fingerprint != before.fingerprint
    assert after.spki_hash == before.spki_hash
    assert after.key_path.read_bytes() == key
    many = load_or_make_certificate(home, [f"10.0.0.{n}" for n in range(40)])
    assert len(many.names) <= certificate.MAX_NAMES


def test_it_is_renewed_before_it_expires(home: KeyHome, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(certificate, "VALID_DAYS", certificate.RENEW_DAYS)
    before = load_or_make_certificate(home, [])
    monkeypatch.undo()
    after = load_or_make_certificate(home, [])
    assert after.fingerprint != before.fingerprint
    assert after.spki_hash == before.spki_hash
    assert load_or_make_certificate(home, []) == after


def test_a_damaged_key_is_an_error_and_stays(home: KeyHome) -> None:
    made = load_or_make_certificate(home, [])
    made.key_path.write_text("garbage")
    made.certificate_path.unlink()
    with pytest.raises(KeysError, match="damaged") as error:
        load_or_make_certificate(home, [])
    assert "\n" not in str(error.value)
    assert made.key_path.read_text() == "garbage"


def test_a_damaged_certificate_is_an_error_and_stays(home: KeyHome) -> None:
    made = load_or_make_certificate(home, [])
    made.certificate_path.write_text("garbage")
    with pytest.raises(KeysError, match="not a certificate"):
        load_or_make_certificate(home, [])


def test_files_of_the_user_are_checked(home: KeyHome, tmp_path: Path) -> None:
    one, other = load_or_make_certificate(home, []), load_or_make_certificate(KeyHome(tmp_path / "other"), [])
    assert load_certificate(one.certificate_path, one.key_path) == one
    with pytest.raises(KeysError, match="cannot be read"):
        load_certificate(tmp_path / "missing.pem", one.key_path)
    with pytest.raises(KeysError, match="cannot be read"):
        load_certificate(one.certificate_path, tmp_path / "missing.pem")
    with pytest.raises(KeysError, match="is not the key"):
        load_certificate(one.certificate_path, other.key_path)
    with pytest.raises(KeysError, match="not a certificate"):
        load_certificate(one.key_path, one.key_path)


def test_a_missing_package_names_the_extra(home: KeyHome, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(extras.MissingExtraError, match=r"iris-session\[web\]"):
        load_or_make_certificate(home, [])
    assert not home.path.exists()


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("Lab-PC.local.", "lab-pc.local"),
        ("[::1]", "::1"),
        ("fe80::1%eth0", "fe80::1"),
        ("127.0.0.1", "127.0.0.1"),
        ("a..b", ""),
        ("a b", ""),
        ("", ""),
        ("x" * 64, ""),
        ("ä.example", ""),
    ],
)
def test_names_in_one_spelling(text: str, name: str) -> None:
    assert normalise_name(text) == name
