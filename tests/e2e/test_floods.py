"""Floods of every kind against a real session: cut and named, and nobody else notices."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from iris_session.client import Client
from iris_session.protocol.security import Audited
from iris_session.protocol.status import ParticipantReport
from tests.e2e.conftest import Hand, Server, Stage

pytestmark = pytest.mark.e2e
ROOT = Path(__file__).parents[2]
#: What a flood of each kind is called.
NAMED = {
    "samples": "sample", "snapshots": "get_snapshot", "hellos": "before hello", "subscriptions": "subscriptions",
    "connections": "connections",
}  # fmt: skip
FLOOD_S = 2.0
#: Below it an age may be that of a machine with nothing to spare: the flooder itself takes a processor of it.
BUSY_MS = 100.0


@pytest.fixture
def party(serve: Callable[..., Server]) -> Iterator[tuple[Stage, Client, Client, Hand]]:
    """Ann drives, Eve looks on."""
    stage = Stage(serve())
    ann, eve = stage.join("Ann"), stage.join("Eve", "observer")
    stage.run(lambda: ann.ready and eve.ready, "both are ready")
    ann.acquire(["left"])
    hand = stage.hand(ann, "left")
    hand.pose = hand.tip
    stage.engage(hand)
    yield stage, ann, eve, hand
    stage.close()


def state_port(client: Client) -> int:
    welcome = client.connection.welcome
    assert welcome is not None
    return welcome.endpoints.state


def row(client: Client, name: str) -> ParticipantReport:
    return next(p for p in client.status().participants if p.name == name)


def worst_age_ms(stage: Stage, client: Client, seconds: float) -> float:
    """The largest p99 that a client reports within a stretch of time."""
    worst = 0.0
    for _ in range(round(2 * seconds)):
        stage.seconds(0.5)
        age = row(client, client.name).state_age
        worst = max(worst, age.p99 if age is not None else 0.0)
    return worst


@pytest.mark.parametrize("kind", ["samples", "snapshots", "frames", "hellos", "subscriptions", "connections"])
def test_a_flood_is_cut_and_named_and_nobody_else_notices(party: tuple[Stage, Client, Client, Hand], kind: str) -> None:
    stage, ann, eve, hand = party
    while {p.name for p in eve.status().participants if p.reported} != {"Ann", "Eve"}:
        stage.seconds(0.5)
    before_ms = worst_age_ms(stage, eve, 1.5)
    before = row(eve, "Ann")
    host, port = ann.address.split(":")
    command = [sys.executable, "-m", "tests.e2e.flooder", kind, host, port, str(state_port(ann)), str(FLOOD_S + 5.0)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as flooder:
        assert flooder.stdout is not None
        assert flooder.stdout.readline() == b"flooding\n"
        during_ms = worst_age_ms(stage, eve, FLOOD_S)
        during, report = row(eve, "Ann"), eve.status()
        flooder.kill()
    print(f"{kind}: p99 {before_ms:.1f} ms before, {during_ms:.1f} ms during; {report.step_to_publish}")
    assert during_ms <= max(2 * before_ms, BUSY_MS)
    stage.engage(hand)
    assert during.rejected == before.rejected
    assert during.drops == before.drops == 0
    assert report.connections >= 2
    if kind != "frames":  # larger than any message: libzmq closes the connection at the first byte
        assert any(NAMED[kind] in text and "flood" in text for text in report.warnings), report.warnings
        audits = [e.body for e in stage.events["Eve"] if isinstance(e.body, Audited)]
        assert any(audit.kind == "flood" and audit.detail == NAMED[kind] for audit in audits)
