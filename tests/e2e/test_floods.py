"""Floods of every kind against a real session: cut and named, and nobody else notices."""

from __future__ import annotations

import select
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from iris_session.protocol.server_messages import Audited
from iris_session.protocol.status import ParticipantReport
from tests.e2e.conftest import Hand, Server, Stage, end_all, serve_command

pytestmark = pytest.mark.e2e
ROOT = Path(__file__).parents[2]
#: What a flood of each kind is called. `before hello` first: whoever was cut off goes on like that.
NAMED = {
    "hellos": "before hello", "connections": "connections", "subscriptions": "subscriptions", "samples": "sample",
    "snapshots": "get_snapshot",
}  # fmt: skip
#: Longer than any test: the flood ends with its process.
FLOOD_S = 100.0
#: Below it an age may be that of a machine with nothing to spare: the flooder itself takes a processor of it.
BUSY_MS = 100.0


class Party:
    """Ann drives, Eve looks on."""

    def __init__(self, server: Server) -> None:
        self.stage = Stage(server)
        self.ann, self.eve = self.stage.join("Ann"), self.stage.join("Eve", "observer")
        self.stage.run(lambda: self.ann.ready and self.eve.ready, "both are ready")
        self.ann.acquire(["left"])
        self.hand: Hand = self.stage.hand(self.ann, "left")
        self.hand.pose = self.hand.tip
        self.stage.engage(self.hand)
        while {p.name for p in self.eve.status().participants if p.reported} != {"Ann", "Eve"}:
            self.stage.seconds(0.5)
        self.usual_ms = max(self.age_ms() for _ in range(2))

    def row(self, name: str) -> ParticipantReport:
        return next(p for p in self.eve.status().participants if p.name == name)

    def age_ms(self) -> float:
        """The p99 of the age of state that Eve reports; a report a second."""
        self.stage.seconds(1.0)
        age = self.row("Eve").state_age
        assert age is not None
        return age.p99

    def undisturbed(self) -> bool:
        """Whether a second passes in which Ann's hand drives as ever, and Eve sees it."""
        if not self.stage.following(self.hand):  # on a busy machine a sample came too late, flood or not
            self.stage.engage(self.hand)
        before = self.row("Ann")
        age_ms = self.age_ms()
        after = self.row("Ann")
        print(f"p99 {age_ms:.1f} ms, usually {self.usual_ms:.1f} ms")
        return (
            age_ms <= max(2 * self.usual_ms, BUSY_MS)
            and (after.rejected, after.drops) == (before.rejected, before.drops)
            and self.stage.following(self.hand)
        )

    def complete(self) -> bool:
        """Whether Ann and Eve are in the session. It is asked at a pace that is allowed."""
        self.stage.seconds(0.3)
        return {p.name for p in self.eve.status().participants if p.connected} >= {"Ann", "Eve"}

    def told(self) -> int:
        """Floods that everybody was told of."""
        audits = [e.body for e in self.stage.events["Eve"] if isinstance(e.body, Audited)]
        return sum(audit.kind == "flood" for audit in audits)

    def named(self, what: str) -> bool:
        """Whether the status says of what there is a flood. It is asked at a pace that is allowed."""
        self.stage.seconds(0.3)
        return any("flood" in text and text.endswith(f": {what}") for text in self.eve.status().warnings)


@pytest.fixture(scope="module")
def party(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Party]:
    """One session for all floods: each leaves it as it was."""
    folder = tmp_path_factory.mktemp("floods")
    recording = folder / "session.rrd"
    server = Server(folder, recording, serve_command("handover", recording))
    try:
        one = Party(server)
        yield one
        one.stage.close()
    finally:
        end_all([server])


@pytest.mark.parametrize("kind", [*NAMED, "frames"])
def test_a_flood_is_cut_and_named_and_nobody_else_notices(party: Party, kind: str) -> None:
    stage, told = party.stage, party.told()
    welcome = party.ann.connection.welcome
    assert welcome is not None
    host, port = party.ann.address.split(":")
    command = [
        sys.executable, "-m", "tests.e2e.flooder", kind, host, port, str(welcome.endpoints.state), str(FLOOD_S)
    ]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as flooder:
        try:
            out = flooder.stdout
            assert out is not None
            stage.run(lambda: select.select([out], [], [], 0)[0], "the flood begins")
            assert out.readline() == b"flooding\n"
            if kind in NAMED:  # frames are larger than any message: libzmq closes the connection at the first byte
                stage.run(lambda: party.told() > told and party.named(NAMED[kind]), "the flood is told and named")
            stage.run(party.undisturbed, "a second as before, while the flood goes on", 60.0)
            stage.engage(party.hand)
            assert flooder.poll() is None
        finally:
            flooder.kill()
    stage.run(party.complete, "both are still there")
