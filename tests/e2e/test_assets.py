"""Assets of a whole session: over a slow link that breaks, beside others, from a front that is killed."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from iris_session.client import AssetFetch, AssetStore, Client
from iris_session.netsim.process import ImpairmentProcess
from tests.e2e.conftest import DEADLINE_S, Server, Stage, end_all
from tests.front.asset_rig import noise, put

pytestmark = pytest.mark.e2e

LINK = "127.0.0.2"
MIB = 1 << 20


@pytest.fixture
def data(tmp_path: Path) -> dict[str, bytes]:
    return {put(tmp_path / "store", one): one for one in (noise(3000), *[noise(20_000) for _ in range(30)], noise(MIB))}


@pytest.fixture
def serving(tmp_path: Path, data: dict[str, bytes]) -> Iterator[Stage]:
    script = Path(__file__).with_name("asset_server.py")
    command = [sys.executable, str(script), str(tmp_path / "store"), *data]
    server = Server(tmp_path, tmp_path / "session.rrd", command)
    stage = Stage(server)
    yield stage
    stage.close()
    end_all([server])


def watcher(stage: Stage, name: str, address: str, cache: Path) -> Client:
    client = Client(address, role="observer", name=name, alignment="not_needed")
    client.assets.cache = AssetStore(cache)
    stage.clients.append(client)
    return client.connect(DEADLINE_S)


def test_a_slow_link_that_breaks_and_a_front_that_is_killed(
    serving: Stage, data: dict[str, bytes], tmp_path: Path
) -> None:
    stage, address = serving, serving.server.address
    port, size = int(address.rpartition(":")[2]), sum(map(len, data.values()))
    ann = watcher(stage, "ann", address, tmp_path / "ann")
    welcome = ann.connection.welcome
    assert welcome is not None
    slow = tmp_path / "slow.json"
    slow.write_text(json.dumps({"window_kib": 64, "phases": [{"delay_ms": 20, "rate_mbit": 4}]}))
    endpoints = welcome.endpoints
    ports = [port, endpoints.state, endpoints.media, endpoints.assets]
    with ImpairmentProcess({LINK: "lan"}, ports) as proxy:
        eve = watcher(stage, "eve", f"{LINK}:{port}", tmp_path / "eve")
        proxy.execute(f"profile {slow}")
        fetch = eve.assets.fetch(list(data))
        stage.run(lambda: fetch.bytes_done > size // 8, "eve gets something")
        others = ann.assets.fetch(list(data))
        stage.run(lambda: others.done, "ann has everything")
        assert not fetch.done
        proxy.execute("cut")
        stage.run(lambda: fetch.bytes_done > size // 3, "eve goes on after the link broke")
        stage.server.children()["front.main"].kill()
        proxy.execute("profile lan")
        stage.run(lambda: fetch.done, "eve has everything, from another front")
        for one in (fetch, others):
            whole(one, data)
        stage.run(lambda: ann.ready and eve.ready, "both are back")
    again = ann.assets.fetch(list(data))
    stage.run(lambda: again.done, "ann has it still")
    assert (again.bytes_received, again.cached) == (0, len(data))


def whole(fetch: AssetFetch, data: dict[str, bytes]) -> None:
    """Everything came, and no byte of it twice."""
    fetch.check()
    assert {address: fetch.read(address) for address in data} == data
    assert fetch.bytes_received == sum(map(len, data.values()))
