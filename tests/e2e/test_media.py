"""Media over a slow link that state shares: fewer media, fresh state, the client is told, the others notice nothing."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import pytest

from iris_session.client import Client
from iris_session.netsim.process import ImpairmentProcess
from iris_session.protocol.names import BudgetClass
from iris_session.protocol.status import ParticipantReport
from tests.e2e.conftest import DEADLINE_S, Server, Stage, end_all

pytestmark = pytest.mark.e2e

LINK = "127.0.0.2"
HZ, FRAME = 30, 83_333  # 20 Mbit/s
#: What full media leave of the state's freshness on that link: half a MiB before it, at 8 Mbit/s.
FLOODED_MS = 500.0


@pytest.fixture
def publishing(tmp_path: Path) -> Iterator[Stage]:
    """A session with a stream `cloud` of 20 Mbit/s."""
    script = Path(__file__).with_name("media_server.py")
    server = Server(tmp_path, tmp_path / "session.rrd", [sys.executable, str(script), str(HZ), str(FRAME)])
    stage = Stage(server)
    yield stage
    stage.close()
    end_all([server])


class Watcher:
    """An observer of the scene and of `cloud`, and how old state was when it came."""

    def __init__(self, stage: Stage, name: str, address: str) -> None:
        self.ages_ms: list[float] = []
        self.client = Client(
            address,
            role="observer",
            name=name,
            alignment="not_needed",
            on_state=lambda state: self.ages_ms.append(state.age_ns * 1e-6),
        )
        stage.clients.append(self.client)
        self.client.connect(DEADLINE_S)
        self.feed = self.client.media.subscribe("cloud")

    @property
    def level(self) -> str:
        return self.feed.budget_class


def test_a_slow_link_gets_fewer_media_and_fresh_state(publishing: Stage, tmp_path: Path) -> None:
    stage, address = publishing, publishing.server.address
    ann, bob = (Watcher(stage, name, address) for name in ("ann", "bob"))
    welcome = ann.client.connection.welcome
    assert welcome is not None
    port = int(address.rpartition(":")[2])
    slow = tmp_path / "slow.json"
    slow.write_text(json.dumps({"window_kib": 512, "phases": [{"delay_ms": 20, "rate_mbit": 8}]}))
    ports = [port, welcome.endpoints.state, welcome.endpoints.media]
    with ImpairmentProcess({LINK: "lan"}, ports) as proxy:
        eve = Watcher(stage, "eve", f"{LINK}:{port}")
        everybody = (ann, bob, eve)
        stage.run(lambda: all(w.feed.received > HZ for w in everybody), "everybody gets media")
        stage.run(lambda: all(w.level == BudgetClass.FULL for w in everybody), "and all of it")

        proxy.execute(f"profile {slow}")
        stage.run(lambda: eve.level in (BudgetClass.QUARTER, BudgetClass.NONE), "eve gets less")
        told = eve.client.media.delivery
        assert told is not None
        assert told.reason
        assert told.mbit_per_s < 20.0

        def settled() -> bool:
            recent = eve.ages_ms[-60:]
            others = ann.level == bob.level == BudgetClass.FULL
            return eve.level == BudgetClass.QUARTER and others and median(recent) < FLOODED_MS / 3

        stage.run(settled, "eve's state is fresh beside a quarter of the media, the others have all")

        row: dict[str, ParticipantReport] = {}

        def told_of_all() -> bool:
            """The rate is that of a quarter of a second, in which a busy machine may publish nothing."""
            stage.seconds(0.3)
            row.update({p.name: p for p in ann.client.status(DEADLINE_S).participants})
            return row["ann"].media_bytes_per_s > 1e6

        stage.run(told_of_all, "the status says what ann gets")
        assert {p.media[0].stream for p in row.values() if p.media} == {"cloud"}

        proxy.execute("profile lan")
        stage.run(lambda: eve.level == BudgetClass.FULL, "eve has all of it again", 90.0)
        received = eve.feed.received
        stage.run(lambda: eve.feed.received > received + HZ, "at its full rate")
    children = stage.server.process
    stage.server.stop()
    assert children.returncode == 0
