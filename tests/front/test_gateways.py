"""Participants behind a gateway whose key is revoked or loses roles."""

from __future__ import annotations

import os

import numpy as np
import pytest

from iris_session.protocol.client_messages import Hello, Marker, RemoveParticipant
from iris_session.protocol.entries import Join, Lost
from iris_session.protocol.names import FaultCode
from iris_session.protocol.server_messages import ProtocolFault, Refused, Welcome
from iris_session.protocol.steps import Decision, Dropped
from iris_session.security import KeyPair
from tests.front.harness import RawClient
from tests.front.lab import Lab


class Gateway:
    """A gateway that has joined, and its participants. `numbers`: their connections by name."""

    def __init__(self, lab: Lab, *roles: str) -> None:
        self.lab = lab
        self.pair = KeyPair.generate()
        lab.home.clients.allow_key("web", self.pair.public, roles)
        self.client: RawClient = lab.client(self.pair)
        self.client.join(role="gateway", name="web")
        self.numbers: dict[str, int] = {"web": self.client.epoch}
        self._secrets: dict[str, bytes] = {}

    def enter(self, name: str, role: str) -> Join:
        """Send a hello through the gateway. Return the entry of the authority."""
        secret = self._secrets.setdefault(name, os.urandom(16))
        seen, before = len(self.client.got(Welcome)), len(self.lab.session.wait_entries(Join))
        self.client.send(Hello(role, name, secret=secret), on_behalf_of=name)
        self.client.wait_for(Welcome, seen + 1)
        entry = self.lab.session.wait_entries(Join, before + 1)[-1]
        self.numbers[name] = entry.connection
        assert isinstance(entry.message, Join)
        return entry.message

    def faults(self) -> dict[str, ProtocolFault]:
        """Return the newest fault for each participant; the gateway's own under an empty name."""
        told = [(m, frames) for m, frames in self.client.inbox if isinstance(m, ProtocolFault)]
        return {frames[0].decode() if frames else "": message for message, frames in told}

    def lost(self, n: int) -> dict[int, str]:
        """Wait for `n` disconnects. Return their reasons by connection."""
        entries = self.lab.session.wait_entries(Lost, n)
        return {e.connection: e.message.reason for e in entries if isinstance(e.message, Lost)}

    def removed(self, n: int) -> set[str]:
        """Wait for at least `n` removals by the front. Return the participants."""
        entries = self.lab.session.wait_entries(RemoveParticipant, n)
        return {e.message.participant for e in entries if isinstance(e.message, RemoveParticipant)}

    def ids(self, *names: str) -> set[str]:
        return {f"p{self.numbers[name]}" for name in names}


@pytest.mark.parametrize("by", ["list", "director"])
def test_revoked_gateway_removes_connected_and_disconnected_participants(lab: Lab, by: str) -> None:
    gateway = Gateway(lab, "gateway", "operator", "observer")
    gateway.enter("tab1", "operator")
    gateway.enter("tab2", "observer")
    gateway.enter("away", "operator")
    away = gateway.numbers["away"]
    lab.session.once(Decision((), dropped=(Dropped(away, "heartbeat"),)))
    lab.session.pump(lambda: "away" in gateway.faults(), "the tab is let go")
    _, bob = lab.allowed("bob")
    if by == "list":
        lab.home.clients.revoke_key("web")
    else:
        dropped = Dropped(gateway.numbers["web"], "revoked", gateway.pair.fingerprint)
        lab.session.once(Decision((), dropped=(dropped,)))
    assert gateway.removed(4) == gateway.ids("web", "tab1", "tab2", "away")
    lab.session.pump(lambda: {"", "tab1", "tab2"} <= gateway.faults().keys(), "all are told")
    codes = {name: fault.code for name, fault in gateway.faults().items()}
    assert codes[""] == FaultCode.REVOKED
    assert codes["tab1"] == codes["tab2"] == (FaultCode.REVOKED if by == "list" else FaultCode.DROPPED)
    assert gateway.numbers["tab1"] in gateway.lost(2 if by == "director" else 3)
    bob.send(Marker(1, "still here"))
    lab.session.wait_entries(Marker)


def test_participants_of_a_gateway_lose_the_roles_of_its_key(lab: Lab) -> None:
    gateway = Gateway(lab, "gateway", "operator", "observer")
    gateway.enter("tab1", "operator")
    gateway.enter("tab2", "observer")
    first = gateway.ids("tab1")
    lab.home.clients.allow_key("web", gateway.pair.public, ("gateway", "observer"))
    assert gateway.lost(1) == {gateway.numbers["tab1"]: "role"}
    assert gateway.removed(1) == first
    lab.session.pump(lambda: "tab1" in gateway.faults(), "the tab is told")
    assert gateway.faults()["tab1"].code == FaultCode.DROPPED
    assert gateway.enter("tab1", "operator").roles == ("observer",), "the authority refuses it by that"
    gateway.client.send(Marker(1, "still here"), on_behalf_of="tab2", epoch=gateway.numbers["tab2"])
    (marker,) = lab.session.wait_entries(Marker)
    assert marker.connection == gateway.numbers["tab2"]
    assert len(gateway.lost(1)) == 1


@pytest.mark.parametrize("who", ["behind a gateway", "without state", "with state"])
def test_subscribers_reconnect_only_when_a_subscribed_key_is_revoked(lab: Lab, who: str) -> None:
    bob, _ = lab.allowed("bob")
    watcher = lab.session.subscriber(curve=lab.curve(bob))
    if who == "behind a gateway":
        gateway = Gateway(lab, "gateway", "operator")
        key_id = gateway.enter("tab1", "operator").key_id
        dropped = Dropped(gateway.numbers["tab1"], "revoked", key_id)
        client = gateway.client
    else:
        ann, client = lab.allowed("ann")
        if who == "with state":
            lab.session.subscriber(curve=lab.curve(ann))
        dropped = Dropped(client.epoch, "revoked", ann.fingerprint)
    lab.session.once(Decision((), dropped=(dropped,)))
    client.wait_for(ProtocolFault)
    lab.session.wait_entries(RemoveParticipant)
    assert watcher.disconnects == (who == "with state")
    lab.session.send_state(np.zeros((3, 7)))
    lab.session.pump(lambda: watcher.frames, "state")


def test_what_a_client_behind_a_gateway_sends_counts_as_its_own(lab: Lab) -> None:
    gateway = Gateway(lab, "gateway", "operator")
    gateway.enter("tab1", "operator")
    unknown = b"\x94\x01\x00\xa4tab1\x81\xa4type\xa7unknown"
    gateway.client.socket.send(unknown)
    gateway.client.wait_for(ProtocolFault)
    assert gateway.faults()["tab1"].code == FaultCode.MALFORMED
    gateway.client.socket.send(unknown.replace(b"tab1", b"tab2"))
    gateway.client.wait_for(Refused)
    assert "" not in gateway.faults(), "the gateway itself has done nothing wrong"
