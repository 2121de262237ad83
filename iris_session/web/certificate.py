"""Certificate of the gateway: made on first use in the key home, renewed with the same key; or one of the user's own.

Browsers ask a person once per certificate; apps and the pairing remember the hash of its public key, which stays. So a
certificate is made anew only when it expires or an address is missing in it, and its key never.
"""

from __future__ import annotations

import base64
import datetime
import hashlib
import ipaddress
import os
import socket
import ssl
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from iris_session.security import KeyHome, KeysError
from iris_session.system.extras import MissingExtraError, require_package

if TYPE_CHECKING:
    from cryptography import x509

CERTIFICATE_FILE: Final = "web.crt"
KEY_FILE: Final = "web.key_pem"
#: Browsers refuse certificates that are valid for longer than 398 days.
VALID_DAYS: Final = 397
RENEW_DAYS: Final = 30
#: Names in a certificate at most: those of earlier networks are kept, the oldest are dropped.
MAX_NAMES: Final = 32
_PURPOSE: Final = "the certificate of the web page"


@dataclass(frozen=True)
class Certificate:
    """A certificate and its key.

    Attributes:
        certificate_path, key_path: PEM files; the certificate's may hold its chain.
        spki_hash: SHA-256 of the SubjectPublicKeyInfo (DER), 32 bytes: S of the pairing behind a gateway.
        fingerprint: SHA-256 of the certificate, as browsers show it: `3F:A2:...`.
        names: Host names and addresses that it is for.
    """

    certificate_path: Path
    key_path: Path
    spki_hash: bytes
    fingerprint: str
    names: tuple[str, ...]

    @property
    def key(self) -> str:
        """`spki_hash` in base64url without padding, as `/v1/info` has it."""
        return base64.urlsafe_b64encode(self.spki_hash).rstrip(b"=").decode()


def load_or_make_certificate(home: KeyHome, addresses: Iterable[str]) -> Certificate:
    """Return the certificate of the key home for these addresses; make or renew it where needed.

    Args:
        home: Key home of the user.
        addresses: Host names and addresses by which browsers reach this machine.

    Raises:
        KeysError: A file is damaged, or the folder cannot be used; nothing is replaced then.
        MissingExtraError: `cryptography` is not installed.
    """
    require_package("cryptography", _PURPOSE)
    wanted = _list_names(addresses)
    with home.folder.lock():
        found = find_certificate(home)
        if found is not None and set(wanted) <= set(found.names) and not _expires_soon(found):
            return found
        kept = () if found is None else found.names
        return _make_certificate(home, tuple(dict.fromkeys((*wanted, *kept)))[:MAX_NAMES])


def find_certificate(home: KeyHome) -> Certificate | None:
    """Return the certificate of the key home, `None` while there is none or `cryptography` is not installed.

    Raises `KeysError` as `load_certificate`.
    """
    data = home.folder.read(CERTIFICATE_FILE)
    if data is None or home.folder.read(KEY_FILE) is None:
        return None
    with suppress(MissingExtraError):
        return load_certificate(home.path / CERTIFICATE_FILE, home.path / KEY_FILE)
    return None


def load_certificate(
    certificate_path: str | os.PathLike[str], key_path: str | os.PathLike[str] | None = None
) -> Certificate:
    """Return a certificate in PEM files. Raises `KeysError` when they cannot be read or do not belong together.

    `key_path` `None`: only the certificate is needed; its own path stands in place of the key's.
    """
    require_package("cryptography", _PURPOSE)
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization

    path, key = Path(certificate_path), Path(certificate_path if key_path is None else key_path)
    data = _read(path)
    try:
        found = x509.load_pem_x509_certificate(data)
        names = _read_names(found)
        spki = serialization.PublicFormat.SubjectPublicKeyInfo
        public = found.public_key().public_bytes(serialization.Encoding.DER, spki)
        fingerprint = found.fingerprint(hashes.SHA256()).hex(":").upper()
    except Exception as error:  # of the parser, for any bytes: ValueError, UnsupportedAlgorithm, its own panics
        raise KeysError(f"{path} is not a certificate in PEM form: {_shorten(error)}") from None
    try:
        if key_path is not None:
            _read(key)
            make_tls_context(path, key)
    except (ssl.SSLError, OSError, ValueError) as error:
        raise KeysError(f"{key} is not the key of {path}, or is encrypted: {_shorten(error)}") from None
    return Certificate(path, key, hashlib.sha256(public).digest(), fingerprint, names)


def make_tls_context(certificate_path: Path, key_path: Path) -> ssl.SSLContext:
    """Return the TLS settings of a server. Raises `ssl.SSLError` or `OSError`."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    # Not 1.3: a KeyUpdate is a record of 27 bytes that costs 56 us, never becomes data, and cannot be switched off.
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    context.options |= ssl.OP_NO_RENEGOTIATION
    context.set_alpn_protocols(["http/1.1"])
    context.load_cert_chain(certificate_path, key_path, password=lambda: b"")  # never ask at a terminal
    return context


def _make_certificate(home: KeyHome, names: Sequence[str]) -> Certificate:
    """Make a certificate for these names, with the key that is there, else with a new one. The lock is held."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    stored = home.folder.read(KEY_FILE)
    if stored is None:
        key = ec.generate_private_key(ec.SECP256R1())
        stored = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    else:
        try:
            loaded = serialization.load_pem_private_key(stored, None)
        except Exception as error:  # of the parser, for any bytes
            text = f"{home.path / KEY_FILE} is damaged ({_shorten(error)}): move it away; apps have to pair anew then"
            raise KeysError(text) from None
        if not isinstance(loaded, ec.EllipticCurvePrivateKey):
            raise KeysError(f"{home.path / KEY_FILE} is not a key of this software: move it away")
        key = loaded
    now = datetime.datetime.now(datetime.UTC)
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"iris-session on {socket.gethostname()}"[:64])])
    usage = x509.KeyUsage(
        digital_signature=True, content_commitment=False, key_encipherment=False, data_encipherment=False,
        key_agreement=False, key_cert_sign=False, crl_sign=False, encipher_only=False, decipher_only=False,
    )  # fmt: skip
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))  # clocks of headsets are not always right
        .not_valid_after(now + datetime.timedelta(days=VALID_DAYS - 1))
        .add_extension(x509.SubjectAlternativeName([_to_general_name(one) for one in names]), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .sign(key, hashes.SHA256())
    )
    home.folder.write(KEY_FILE, stored)
    home.folder.write(CERTIFICATE_FILE, made.public_bytes(serialization.Encoding.PEM))
    return load_certificate(home.path / CERTIFICATE_FILE, home.path / KEY_FILE)


def _list_names(addresses: Iterable[str]) -> tuple[str, ...]:
    """Return the names that a certificate is to have: the addresses, this machine's name, loopback."""
    names = [*addresses, *list_host_names(), "localhost", "127.0.0.1", "::1"]
    return tuple(dict.fromkeys(normalised for one in names if (normalised := normalise_name(one))))


def list_host_names() -> tuple[str, ...]:
    """Return the names of this machine: its host name, and that in the local domain of multicast DNS."""
    host = normalise_name(socket.gethostname())
    if not host:
        return ()
    short = host.partition(".")[0]
    return tuple(dict.fromkeys((host, short, f"{short}.local")))


def normalise_name(name: str) -> str:
    """Return a host name or an address in one spelling, empty for what is neither."""
    text = name.strip().strip("[]").rstrip(".").lower()
    try:
        return str(ipaddress.ip_address(text.partition("%")[0]))
    except ValueError:
        pass
    labels = text.split(".")
    fits = all(label and len(label) < 64 and label.replace("-", "a").isalnum() and label.isascii() for label in labels)
    return text if fits and len(text) < 254 else ""


def _to_general_name(name: str) -> x509.GeneralName:
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)


def _read_names(certificate: x509.Certificate) -> tuple[str, ...]:
    from cryptography import x509

    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    addresses = [str(one) for one in names.get_values_for_type(x509.IPAddress)]
    return tuple(dict.fromkeys((*addresses, *names.get_values_for_type(x509.DNSName))))


def _expires_soon(certificate: Certificate) -> bool:
    from cryptography import x509

    found = x509.load_pem_x509_certificate(certificate.certificate_path.read_bytes())
    return found.not_valid_after_utc - datetime.datetime.now(datetime.UTC) < datetime.timedelta(days=RENEW_DAYS)


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(1 << 20)
    except OSError as error:
        raise KeysError(f"{path} cannot be read: {error.strerror}") from error


def _shorten(error: Exception) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__
