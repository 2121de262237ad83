"""An encrypted session with real processes: pairing by command, revocation while driving, forgery, two directors."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zmq

from anchors.pose import distance
from iris_session.client import Client, CurveKeys, DeniedError, RefusedError
from iris_session.protocol.client_messages import (
    Assign,
    ClientMessage,
    EStop,
    Hello,
    RemoveParticipant,
    Sample,
    SetMode,
    wrap_message,
)
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.names import AuditKind, DenialReason, FaultCode, RefusalCode, RejectReason
from iris_session.protocol.server_messages import (
    Audited,
    LeaseChanged,
    ParticipantLeft,
    ProtocolFault,
    Refused,
    SamplesRejected,
)
from iris_session.security import KeyHome, KeyPair
from tests.e2e.scenario import Hand, Scenario
from tests.e2e.session_process import COMMAND, DEADLINE_S, SessionProcess, wait_until

pytestmark = pytest.mark.e2e


class EncryptedScenario(Scenario):
    """An encrypted session whose clients have a key each, on the allow-list or not."""

    def __init__(self, serve: Callable[..., SessionProcess], home: Path) -> None:
        self.home = KeyHome(home)
        self.key = self.home.load_server_key()
        super().__init__(serve("handover", "--curve", "--no-beacon"))

    def make_curve_keys(self, pair: KeyPair) -> CurveKeys:
        return CurveKeys(self.key.public.encode(), pair.public.encode(), pair.secret.encode())

    def allow_new_key(self, name: str, *roles: str) -> KeyPair:
        pair = KeyPair.generate()
        self.home.clients.allow_key(name, pair.public, roles)
        return pair

    def join_encrypted(self, name: str, role: str = "operator", pair: KeyPair | None = None) -> Client:
        """Join with a key, by default with a new one that is put on the allow-list."""
        log = self.events[name] = []
        client = Client(
            self.server.address,
            role=role,
            name=name,
            devices=("desktop", "head"),
            alignment="not_needed",
            curve=self.make_curve_keys(pair or self.allow_new_key(name)),
            on_event=log.append,
        )
        return self.add(client)

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


class Attacker:
    """A raw socket with a key."""

    def __init__(self, lab: EncryptedScenario, pair: KeyPair) -> None:
        self.inbox: list[object] = []
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        self._socket.linger = 0
        keys = lab.make_curve_keys(pair)
        self._socket.curve_serverkey, self._socket.curve_publickey = keys.server_public, keys.public
        self._socket.curve_secretkey = keys.secret
        self._socket.connect(f"tcp://{lab.server.address}")

    def send(self, message: ClientMessage, epoch: int = 0, on_behalf_of: str = "") -> None:
        self._socket.send(encode_client(wrap_message(message, epoch, on_behalf_of)))

    def list_received(self, kind: type) -> list:  # type: ignore[type-arg]
        while self._socket.poll(0):
            self.inbox.append(decode_server(self._socket.recv_multipart()[0]).message)
        return [message for message in self.inbox if isinstance(message, kind)]

    def close(self) -> None:
        self._socket.close()


def get_refusal(address: str, **options: str) -> RefusedError:
    """Return the error of a client that must be refused."""
    client = Client(address, **options)  # type: ignore[arg-type]
    try:
        with pytest.raises(RefusedError) as refused:
            client.connect(DEADLINE_S)
    finally:
        client.close()
    return refused.value


def read_modes(folder: Path) -> set[str]:
    """Return the modes of a folder and of its files."""
    return {oct(path.stat().st_mode & 0o777) for path in (folder, *folder.iterdir())}


def start_pairing(folder: Path, *options: str) -> tuple[subprocess.Popen[str], dict[str, str]]:
    """Start `iris-session pair`. Return the process and the offer that it has shown."""
    shown = folder / f"pair{len(list(folder.glob('pair*')))}.out"
    with shown.open("w") as out:
        process = subprocess.Popen([*COMMAND, "pair", "--json", *options], stdout=out, stderr=out, text=True)
    wait_until(lambda: shown.read_text().endswith("\n"), "the join code")
    offer: dict[str, str] = json.loads(shown.read_text().splitlines()[0])
    return process, {**offer, "file": str(shown)}


def wait_for_end(process: subprocess.Popen[str], offer: dict[str, str]) -> tuple[int, dict[str, object]]:
    """Return the exit status of `iris-session pair`, and its last line."""
    status = process.wait(DEADLINE_S)
    last: dict[str, object] = json.loads(Path(offer["file"]).read_text().splitlines()[-1])
    return status, last


def test_device_pairs_with_a_single_use_code_and_joins_in_its_role(
    lab: EncryptedScenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watcher = lab.join_encrypted("watcher", "observer").start()
    png = tmp_path / "code.png"
    process, offer = start_pairing(tmp_path, "--role", "observer", "--name", "tablet", "--png", str(png))
    assert offer["fingerprint"] == lab.key.fingerprint
    assert offer["addresses"] == [lab.server.address]
    assert png.read_bytes().startswith(b"\x89PNG")
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "tablet-home"))
    tablet = Client(lab.server.address, role="observer", name="Tab", join_code=offer["code"].lower())
    with tablet.connect(DEADLINE_S):
        assert tablet.wait_for(lambda c: c.scene.state is not None, DEADLINE_S)
    assert wait_for_end(process, offer)[0] == 0
    (entry,) = [key for key in lab.home.clients.read().values() if key.name == "tablet"]
    assert entry.roles == ("observer",)
    assert wait_for_end(process, offer)[1] == {
        "paired": "tablet",
        "fingerprint": entry.fingerprint,
        "roles": ["observer"],
    }
    role = get_refusal(lab.server.address, role="operator", name="Tab")
    assert role.code == DenialReason.ROLE
    assert "observer" in role.advice
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "thief-home"))
    assert get_refusal(lab.server.address, name="Eve", join_code=offer["code"]).code == RefusalCode.CODE
    wait_until(lambda: lab.list_audits("watcher", AuditKind.CODE_REFUSED), "the attempt is audited")
    assert lab.list_audits("watcher", AuditKind.PAIRED)[0].subject == entry.fingerprint
    assert lab.list_audits("watcher", AuditKind.ROLE_REFUSED)[0].detail == "operator"
    assert watcher.ready
    for name in ("server-home", "tablet-home"):
        assert read_modes(tmp_path / name) == {"0o700", "0o600"}
    lab.server.finish()


@pytest.mark.long
def test_wrong_and_expired_join_codes_are_refused(
    lab: EncryptedScenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    process, offer = start_pairing(tmp_path)
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "eve-home"))
    for _ in range(5):
        assert get_refusal(lab.server.address, name="Eve", join_code="0000-0000-0000").code == RefusalCode.CODE
    assert get_refusal(lab.server.address, name="Ann", join_code=offer["code"]).code == RefusalCode.CODE
    assert wait_for_end(process, offer) == (1, {"paired": None, "reason": "void"})
    monkeypatch.setenv("IRIS_HOME", str(lab.home.path))
    process, offer = start_pairing(tmp_path, "--minutes", "0.01")
    assert wait_for_end(process, offer) == (1, {"paired": None, "reason": "expired"})
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "ann-home"))
    assert get_refusal(lab.server.address, name="Ann", join_code=offer["code"]).code == RefusalCode.CODE
    assert lab.home.clients.read() == {}


def test_revoked_key_is_disconnected_at_once_and_others_are_not(lab: EncryptedScenario) -> None:
    ann_key = lab.allow_new_key("ann")
    ann = lab.add_hand(lab.join_encrypted("ann", pair=ann_key), "left")
    bob = lab.add_hand(lab.join_encrypted("bob"), "right")
    for hand in (ann, bob):
        hand.client.acquire([hand.robot])
        lab.engage(hand)
    version = bob.client.lease_version("right")
    ann.velocity = bob.velocity = (0.0, 0.05, 0.0)
    lab.run_for(0.3)
    gap = StateGap(bob.client)
    revoked_at = time.monotonic()
    assert lab.home.clients.revoke_key("ann") is not None  # what `iris-session keys revoke ann` does

    def is_refused() -> bool:
        gap.measure()
        return ann.client.connection.failure is not None

    lab.hands.remove(ann)
    lab.clients.remove(ann.client)
    with pytest.raises(RefusedError) as error:
        poll_sending(lab, ann, is_refused)
    out_after = time.monotonic() - revoked_at
    assert error.value.code == FaultCode.REVOKED
    assert ann.client.scene.state is not None
    last = ann.client.scene.state.header.state_seq
    lab.run_until(lambda: "left" in list_free_robots(bob), "the robot of ann is free, without grace period")
    resting = bob.client.scene.tip_pose("left")
    lab.run_until(lambda: gap.measure() and time.monotonic() - revoked_at > 2.0, "two seconds of state")
    # Half a second and one second on an idle machine; printed, because a busy one has no bound.
    print(f"out after {out_after:.3f} s, longest gap of the others {gap.longest:.3f} s")
    lab.engage(bob)  # on a busy machine a sample may be late
    # A machine that stood still for 2 s has disconnected bob, too, who has resumed his lease.
    assert bob.client.lease_version("right") == version or gap.longest > 2.0
    now = bob.client.scene.tip_pose("left")
    assert resting is not None
    assert now is not None
    assert distance(resting[0], now[0]) < 0.05  # the arm decelerates
    with pytest.raises(RefusedError):
        ann.client.poll(0.1)
    assert ann.client.scene.state.header.state_seq - last < 60, "no state for a revoked key"
    assert lab.list_audits("bob", AuditKind.KEY_REFUSED) == [], "a revoked client does not reconnect"
    with pytest.raises(RefusedError) as again:
        lab.join_encrypted("ann2", pair=ann_key)
    assert again.value.code == RefusalCode.UNPAIRED
    lab.clients.pop().close()
    assert [a.name for a in lab.list_audits("bob", AuditKind.KEY_REVOKED)] == ["ann"]
    ann.client.close()
    lab.server.finish()


class StateGap:
    """The longest time without state at one client [s]."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._seq = -1
        self._at = time.monotonic()
        self.longest = 0.0

    def measure(self) -> bool:
        """Update `longest`; to be called often. Return true."""
        state = self._client.scene.state
        now = time.monotonic()
        if state is not None and state.header.state_seq != self._seq:
            self.longest = max(self.longest, now - self._at)
            self._seq, self._at = state.header.state_seq, now
        return True


def poll_sending(lab: EncryptedScenario, ann: Hand, until: Callable[[], bool]) -> None:
    """Poll all clients while the hand goes on sending, until a condition holds."""
    deadline = time.monotonic() + DEADLINE_S
    while not until():
        assert time.monotonic() < deadline, "ann is not refused"
        if ann.client.connection.is_joined:
            ann.send_if_due()
        ann.client.poll(0.0)
        lab.poll()
    ann.client.poll(0.0)


def list_free_robots(hand: Hand) -> set[str]:
    return {lease.target for lease in hand.client.mirror.leases.values() if not lease.holder}


def test_forged_and_replayed_messages_move_nothing_and_are_audited(lab: EncryptedScenario) -> None:
    """An attacker with an allowed key: stolen token, forged gateway, replayed samples of another participant."""
    ann = lab.add_hand(lab.join_encrypted("ann"), "left")
    ann.client.acquire(["left"])
    eve_key = lab.allow_new_key("eve")
    joined = lab.join_encrypted("eve", pair=eve_key)  # a participant with the attacker's key
    lab.engage(ann)
    thief, eve = Attacker(lab, eve_key), Attacker(lab, eve_key)
    thief.send(Hello("operator", "ann", resume_token=ann.client.connection.identity.resume_token))
    lab.run_until(lambda: thief.list_received(Refused), "the token is refused")
    assert thief.list_received(Refused)[0].code == RefusalCode.RESUME_TOKEN

    sniffed: list[Sample] = []
    send = ann.client.send
    ann.client.send = lambda message: (sniffed.append(message) if isinstance(message, Sample) else None, send(message))[
        1
    ]  # type: ignore[method-assign]
    lab.run_until(lambda: len(sniffed) > 20, "samples to replay")
    epoch = ann.client.connection.connection_epoch
    before = ann.tip
    for old in sniffed[:20]:
        for sample in (old, sniffed[-1]):  # an old one, and the newest
            eve.send(sample, epoch)  # without hello
            eve.send(sample, epoch, on_behalf_of="ann")
            joined.send(sample)  # from the attacker's own connection
        lab.poll()
    lab.run_until(lambda: lab.list_audits("ann", AuditKind.GATEWAY_REFUSED), "the forgery is audited")
    lab.run_until(lambda: has_rejection(lab, joined, RejectReason.NOT_HOLDER), "samples of eve are rejected")
    assert lab.list_audits("ann", AuditKind.TOKEN_REFUSED)[0].subject == eve_key.fingerprint
    lab.run_until(lambda: eve.list_received(ProtocolFault), "a fault for the attacker")
    eve.send(EStop("in the name of ann"), epoch, on_behalf_of="ann")
    for sample in sniffed:  # ann's own connection, old numbers: counted, harmless
        ann.client.connection.send(sample)
        lab.poll()
    lab.run_until(lambda: has_rejection(lab, ann.client, RejectReason.SEQ), "old numbers are rejected")
    lost = [b for e in lab.events["ann"] if isinstance(b := e.body, LeaseChanged) and b.previous_holder]
    assert not lost, "forgery must not take a robot"
    mine = ann.client.connection.participant_id
    rejected = {
        b.reason for e in lab.events["ann"] if isinstance(b := e.body, SamplesRejected) and b.participant == mine
    }
    assert rejected <= {RejectReason.SEQ, RejectReason.STALE}, (
        "samples are late on a busy machine, but never rejected because of forgery"
    )
    assert distance(before[0], ann.tip[0]) < 2e-3
    assert not ann.client.mirror.estop
    lab.engage(ann)
    thief.close()
    eve.close()
    lab.server.finish()


def has_rejection(lab: EncryptedScenario, client: Client, reason: str) -> bool:
    me = client.connection.participant_id
    bodies = [event.body for event in lab.events["ann"]]
    return any(isinstance(b, SamplesRejected) and b.participant == me and b.reason == reason for b in bodies)


def test_two_directors_at_once_and_removal_of_a_participant(lab: EncryptedScenario) -> None:
    one, two = lab.join_encrypted("one", "director"), lab.join_encrypted("two", "director")
    ann, bob = lab.join_encrypted("ann"), lab.join_encrypted("bob")
    mine = {c: c.connection.participant_id for c in (ann, bob)}
    asked = []
    for i in range(20):
        for director, operator in ((one, ann), (two, bob)):
            asked.append((director, director.submit(Assign(0, ("left",), mine[operator]))))
            asked.append((director, director.submit(SetMode(0, "left", ("takeover", "exclusive")[i % 2]))))
        lab.poll()

    def are_answered() -> bool:
        """`answer` returns each answer once, so answered requests are removed."""
        asked[:] = [(director, number) for director, number in asked if director.answer(number) is None]
        return not asked

    lab.run_until(are_answered, "all requests are answered")
    holders = {c: c.mirror.leases["left"].holder for c in (one, two, ann, bob)}
    lab.run_until(lambda: len({c.mirror.leases["left"].holder for c in holders}) == 1, "all see the same holder")
    assert one.mirror.leases["left"].holder in mine.values()
    with pytest.raises(DeniedError) as denied:
        ann.request(RemoveParticipant(0, mine[bob]))
    assert denied.value.denial.reason == DenialReason.ROLE
    one.submit(RemoveParticipant(0, mine[bob], True, "left the lab"))
    lab.clients.remove(bob)
    deadline = time.monotonic() + DEADLINE_S
    while bob.connection.failure is None:
        assert time.monotonic() < deadline
        try:
            bob.poll(0.0)
        except RefusedError as error:
            assert error.code == FaultCode.REVOKED  # noqa: PT017
        lab.poll()
    lab.run_until(
        lambda: "bob" not in {key.name for key in lab.home.clients.read().values()}, "the key is not allowed any more"
    )
    lab.run_until(lambda: ParticipantLeft(mine[bob], "removed") in [e.body for e in lab.events["two"]], "bob has left")
    bob.close()
    assert two.ready
    lab.server.finish()
