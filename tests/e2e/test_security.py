"""An encrypted session over real sockets: pairing by command with a code for one device, and a key that is revoked."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from iris_session.client import Client, CurveKeys, RefusedError
from iris_session.protocol.names import AuditKind, FaultCode, RefusalCode
from iris_session.protocol.server_messages import Audited
from iris_session.security import KeyHome, KeyPair
from tests.e2e.scenario import Scenario
from tests.e2e.session_process import DEADLINE_S, SessionProcess

pytestmark = pytest.mark.e2e


class EncryptedScenario(Scenario):
    """An encrypted session whose clients have a key each, on the allow-list or not."""

    def __init__(self, serve: Callable[..., SessionProcess], home: Path) -> None:
        self.home = KeyHome(home)
        self.key = self.home.load_server_key()
        super().__init__(serve("handover", "--curve", "--no-beacon"))

    def allow_new_key(self, name: str) -> KeyPair:
        pair = KeyPair.generate()
        self.home.clients.allow_key(name, pair.public, ())
        return pair

    def make_client(self, name: str, pair: KeyPair, role: str = "operator") -> Client:
        """Make a client with a key, not connected yet."""
        return Client(
            self.server.address,
            role=role,
            name=name,
            devices=("desktop", "head"),
            alignment="not_needed",
            curve=CurveKeys(self.key.public.encode(), pair.public.encode(), pair.secret.encode()),
            on_event=self.events.setdefault(name, []).append,
        )

    def list_audits(self, name: str, kind: str) -> list[Audited]:
        """Return the audit events of a kind that client `name` has received."""
        bodies = [event.body for event in self.events[name]]
        return [body for body in bodies if isinstance(body, Audited) and body.kind == kind]


@pytest.fixture
def lab(
    serve: Callable[..., SessionProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[EncryptedScenario]:
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "server-home"))
    lab = EncryptedScenario(serve, tmp_path / "server-home")
    yield lab
    lab.close()


def get_refusal(client: Client) -> RefusedError:
    """Return the error of a client that must be refused."""
    try:
        with pytest.raises(RefusedError) as refused:
            client.connect(DEADLINE_S)
    finally:
        client.close()
    return refused.value


def test_revoked_key_is_out_while_another_client_goes_on(lab: EncryptedScenario) -> None:
    keys = {name: lab.allow_new_key(name) for name in ("ann", "bob")}
    ann, bob = (lab.add(lab.make_client(name, key)) for name, key in keys.items())
    hands = [lab.add_hand(ann, "left"), lab.add_hand(bob, "right")]
    for hand in hands:
        hand.client.acquire([hand.robot])
        lab.engage(hand)
    me = bob.participant_id
    assert lab.home.clients.revoke_key("ann") is not None  # what `iris-session keys revoke ann` does
    lab.clients.remove(ann)
    lab.hands.remove(hands[0])
    refused: list[RefusedError] = []

    def is_refused() -> bool:
        try:
            ann.poll(0.0)
        except RefusedError as error:
            refused.append(error)
        return bool(refused)

    lab.run_until(is_refused, "ann is refused")
    assert refused[0].code == FaultCode.REVOKED
    with pytest.raises(RefusedError):
        ann.poll(0.1)
    ann.close()
    lab.run_until(lambda: not bob.mirror.leases["left"].holder, "the robot of ann is free")
    lab.run_until(lambda: lab.list_audits("bob", AuditKind.KEY_REVOKED), "the revocation is audited")
    assert [audit.name for audit in lab.list_audits("bob", AuditKind.KEY_REVOKED)] == ["ann"]
    begun_ns = bob.session_now_ns()
    lab.run_until(
        lambda: bob.scene.state is not None and bob.scene.state.header.published_ns > begun_ns, "bob receives state"
    )
    assert bob.mirror.leases["right"].holder == bob.participant_id == me
    lab.engage(hands[1])
    assert get_refusal(lab.make_client("ann2", keys["ann"])).code == RefusalCode.UNPAIRED
    lab.server.finish()
