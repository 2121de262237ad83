"""Processes of benchmarks: calls, answers and failures, and a session with real clients."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from iris_session.bench.clients import BROWSERS, ClientJob
from iris_session.bench.harness import _group_clients
from iris_session.bench.plugins import Plugin, PluginProcess
from iris_session.bench.report import BenchError
from iris_session.cli.main import main


class Echo(Plugin):
    """Plug-in that repeats its argument."""

    def __init__(self, text: str) -> None:
        if not text:
            raise SystemExit(3)
        self._text = text
        print("libraries print here")

    def repeat(self, n: int) -> dict[str, Any]:
        return {"text": self._text * n}

    def end(self) -> None:
        raise SystemExit(4)


ECHO = "tests.bench.test_plugins:Echo"


def test_calls_are_answered_in_their_order_and_failures_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))  # the process imports this module
    with PluginProcess(ECHO, "ha") as worker:
        worker.send("repeat", 2)
        worker.send("repeat", 1)
        assert [worker.read(30.0) for _ in range(3)] == [None, {"text": "haha"}, {"text": "ha"}]
        with pytest.raises(BenchError, match=r"Echo.*4"):
            worker.ask("end", timeout_s=30.0)
    with PluginProcess(ECHO, "") as worker, pytest.raises(BenchError, match=r"Echo.*3"):
        worker.read(30.0)


def test_at_most_four_clients_of_one_plugin_share_a_process() -> None:
    clients = [ClientJob(f"client{i}", "observer") for i in range(5)]
    clients += [ClientJob(f"alone{i}", "observer", alone=True) for i in range(2)]
    clients += [ClientJob(f"browser{i}", "observer", plugin=BROWSERS) for i in range(2)]
    assert [len(group) for group in _group_clients(clients)] == [4, 1, 1, 1, 2]


@pytest.mark.long
@pytest.mark.e2e
def test_state_of_a_session_with_clients(capfd: pytest.CaptureFixture[str]) -> None:
    """A whole benchmark: what clients decode is what the session had."""
    # A busy machine may stand still for ten of these seconds.
    assert main(["bench", "state", "--clients", "2", "--bodies", "20", "--seconds", "12", "--curve", "--json"]) == 0
    got = json.loads(capfd.readouterr().out)["results"]
    assert 0.0 < got["max_position_error_mm"] <= 0.1
    assert 0.0 < got["max_rotation_error_deg"] <= 0.05
    assert 0.0 < got["age_ms_p50"] <= got["age_ms_p95"] <= got["age_ms_p99"]
    assert got["frames_not_logged"] == 0
