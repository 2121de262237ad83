"""Assets and media over links that are slow or break, beside other clients, and across a restart of the front."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import pytest

from iris_session.client import AssetFetch, AssetStore, Client
from iris_session.netsim.process import ImpairmentProcess
from iris_session.protocol.names import BudgetClass
from iris_session.protocol.status import ParticipantReport
from tests.e2e import session_program
from tests.e2e.scenario import Scenario
from tests.e2e.session_process import DEADLINE_S, SessionProcess, kill_all
from tests.front.asset_rig import noise, put
from tests.loopback import make_loopback_address

pytestmark = pytest.mark.e2e


LINK = make_loopback_address()  # of no other test
MIB = 1 << 20


def run_program(folder: Path, *arguments: str) -> Iterator[Scenario]:
    """Run a session of `session_program.py`."""
    command = [sys.executable, session_program.__file__, make_loopback_address(), *arguments]
    server = SessionProcess(folder, folder / "session.rrd", command)
    scenario = Scenario(server)
    yield scenario
    scenario.close()
    kill_all([server])


@pytest.fixture
def data(tmp_path: Path) -> dict[str, bytes]:
    return {put(tmp_path / "store", one): one for one in (noise(3000), *[noise(20_000) for _ in range(30)], noise(MIB))}


@pytest.fixture
def serving(tmp_path: Path, data: dict[str, bytes]) -> Iterator[Scenario]:
    """A session that serves assets of its own."""
    yield from run_program(tmp_path, "assets", str(tmp_path / "store"), *data)


def join_observer(scenario: Scenario, name: str, address: str, cache: Path) -> Client:
    client = Client(address, role="observer", name=name, alignment="not_needed")
    client.assets.cache = AssetStore(cache)
    scenario.clients.append(client)
    return client.connect(DEADLINE_S)


@pytest.mark.long
def test_fetch_survives_slow_link_cut_and_killed_front(
    serving: Scenario, data: dict[str, bytes], tmp_path: Path
) -> None:
    scenario, address = serving, serving.server.address
    (host, _, number), size = address.rpartition(":"), sum(map(len, data.values()))
    port = int(number)
    ann = join_observer(scenario, "ann", address, tmp_path / "ann")
    welcome = ann.connection.welcome
    assert welcome is not None
    slow = tmp_path / "slow.json"
    slow.write_text(json.dumps({"window_kib": 64, "phases": [{"delay_ms": 20, "rate_mbit": 4}]}))
    endpoints = welcome.endpoints
    ports = [port, endpoints.state, endpoints.media, endpoints.assets]
    with ImpairmentProcess({LINK: "lan"}, ports, target=host) as proxy:
        eve = join_observer(scenario, "eve", f"{LINK}:{port}", tmp_path / "eve")
        proxy.execute(f"profile {slow}")
        fetch = eve.assets.fetch(list(data))
        scenario.run_until(lambda: fetch.bytes_done > size // 8, "eve receives the first chunks")
        others = ann.assets.fetch(list(data))
        scenario.run_until(lambda: others.done, "ann has all assets")
        assert not fetch.done
        proxy.execute("cut")
        scenario.run_until(lambda: fetch.bytes_done > size // 3, "eve resumes after the link broke")
        scenario.server.children()["front.main"].kill()
        proxy.execute("profile lan")
        scenario.run_until(lambda: fetch.done, "eve has all assets, from the restarted front")
        for one in (fetch, others):
            assert_complete(one, data)
        scenario.run_until(lambda: ann.ready and eve.ready, "both have reconnected")
    again = ann.assets.fetch(list(data))
    scenario.run_until(lambda: again.done, "ann reads her cache")
    assert (again.bytes_received, again.cached) == (0, len(data))


def assert_complete(fetch: AssetFetch, data: dict[str, bytes]) -> None:
    """Check that every asset was received, and no byte twice."""
    fetch.check()
    assert {address: fetch.read(address) for address in data} == data
    assert fetch.bytes_received == sum(map(len, data.values()))


# --- media, which share the link with state --------------------------------------------------------------------------


HZ, FRAME = 30, 83_333  # 20 Mbit/s
#: What full media leave of the state's freshness on that link: half a MiB before it, at 8 Mbit/s.
FLOODED_MS = 500.0


@pytest.fixture
def publishing(tmp_path: Path) -> Iterator[Scenario]:
    """A session with a stream `cloud` of 20 Mbit/s."""
    yield from run_program(tmp_path, "media", str(HZ), str(FRAME))


class Watcher:
    """An observer of the scene and of `cloud` that records the age of each state."""

    def __init__(self, scenario: Scenario, name: str, address: str) -> None:
        self.ages_ms: list[float] = []
        self.client = Client(
            address,
            role="observer",
            name=name,
            alignment="not_needed",
            on_state=lambda state: self.ages_ms.append(state.age_ns * 1e-6),
        )
        scenario.clients.append(self.client)
        self.client.connect(DEADLINE_S)
        self.feed = self.client.media.subscribe("cloud")

    @property
    def level(self) -> str:
        return self.feed.budget_class


@pytest.mark.long
def test_slow_link_gets_less_media_and_fresh_state(publishing: Scenario, tmp_path: Path) -> None:
    scenario, address = publishing, publishing.server.address
    ann, bob = (Watcher(scenario, name, address) for name in ("ann", "bob"))
    welcome = ann.client.connection.welcome
    assert welcome is not None
    host, _, number = address.rpartition(":")
    port = int(number)
    slow = tmp_path / "slow.json"
    slow.write_text(json.dumps({"window_kib": 512, "phases": [{"delay_ms": 20, "rate_mbit": 8}]}))
    ports = [port, welcome.endpoints.state, welcome.endpoints.media]
    with ImpairmentProcess({LINK: "lan"}, ports, target=host) as proxy:
        eve = Watcher(scenario, "eve", f"{LINK}:{port}")
        all_watchers = (ann, bob, eve)
        scenario.run_until(lambda: all(w.feed.received > HZ for w in all_watchers), "all receive media")
        scenario.run_until(lambda: all(w.level == BudgetClass.FULL for w in all_watchers), "at full rate")

        proxy.execute(f"profile {slow}")
        scenario.run_until(lambda: eve.level in (BudgetClass.QUARTER, BudgetClass.NONE), "eve's level falls")
        delivery = eve.client.media.delivery
        assert delivery is not None
        assert delivery.reason
        assert delivery.mbit_per_s < 20.0

        def has_settled() -> bool:
            recent = eve.ages_ms[-60:]
            others = ann.level == bob.level == BudgetClass.FULL
            return eve.level == BudgetClass.QUARTER and others and median(recent) < FLOODED_MS / 3

        scenario.run_until(has_settled, "eve's state is fresh beside a quarter of the media, the others have all")

        row: dict[str, ParticipantReport] = {}

        def is_reported() -> bool:
            """The rate is of a quarter of a second, in which a busy machine may publish nothing."""
            scenario.run_for(0.3)
            row.update({p.name: p for p in ann.client.status(DEADLINE_S).participants})
            return row["ann"].media_bytes_per_s > 1e6

        scenario.run_until(is_reported, "the status shows the media of ann")
        assert {p.media[0].stream for p in row.values() if p.media} == {"cloud"}

        proxy.execute("profile lan")
        scenario.run_until(lambda: eve.level == BudgetClass.FULL, "eve is at full level again", 90.0)
        received = eve.feed.received
        scenario.run_until(lambda: eve.feed.received > received + HZ, "at its full rate")
    scenario.server.stop()
