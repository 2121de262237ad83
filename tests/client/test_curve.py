"""The client on encrypted sockets: keys from files, listed keys only."""

from __future__ import annotations

from pathlib import Path

import pytest
from zmq.auth import create_certificates

from iris_session.client import Client, CurveKeys, IdentityError, NotConnectedError
from tests.client.harness import LiveSession


def test_listed_keys_join_and_see_and_others_do_not(tmp_path: Path) -> None:
    allowed = tmp_path / "clients"
    allowed.mkdir()
    server_public, server_secret = create_certificates(tmp_path, "server")
    _, ann_secret = create_certificates(allowed, "ann")
    _, eve_secret = create_certificates(tmp_path, "eve")
    for secret in (server_secret, ann_secret, eve_secret):
        Path(secret).chmod(0o600)
    session = LiveSession(curve_secret_file=server_secret, curve_clients_dir=str(allowed))
    try:
        with Client(session.address, name="ann", curve=CurveKeys.from_files(server_public, ann_secret)) as ann:
            assert ann.wait_for(lambda c: c.scene.state is not None)
        eve = Client(session.address, name="eve", curve=CurveKeys.from_files(server_public, eve_secret))
        plain = Client(session.address, name="plain")
        for stranger in (eve, plain):
            with pytest.raises(NotConnectedError):
                stranger.connect(0.5)
            stranger.close()
    finally:
        session.close()


def test_wrong_key_files_say_which_is_needed(tmp_path: Path) -> None:
    public, secret = create_certificates(tmp_path, "ann")
    with pytest.raises(IdentityError, match=r"can be used by other users of this machine: chmod 600 .*ann.key_secret"):
        CurveKeys.from_files(public, secret)
    Path(secret).chmod(0o600)
    assert CurveKeys.from_files(public, secret).public == CurveKeys.from_files(public, secret).server_public
    with pytest.raises(IdentityError, match="key_secret"):
        CurveKeys.from_files(public, public)
    with pytest.raises(IdentityError, match="cannot be used"):
        CurveKeys.from_files(tmp_path / "missing.key", public)
