"""Reports of benchmarks: their form, bars and exit status, with a benchmark that measures nothing."""

from __future__ import annotations

import inspect
import json
import math
from functools import wraps
from typing import Any

import pytest

from iris_session.bench import state
from iris_session.bench.report import NO_BARS, BenchReport, make_bar
from iris_session.cli.main import main


def _report(value: float = 1.0) -> BenchReport:
    results = {"age_ms_p99": value, "extra": 1, "case": {"hz": 30.0}}
    bars = (make_bar(results, "age_ms_p99", "<=", 3.0), make_bar(results, "case.hz", ">=", 10.0))
    return BenchReport(results, bars, params={"hz": 60})


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Replace the benchmark `state` by one that misses a bar when it is asked for 9 bodies."""
    found: list[dict[str, Any]] = []

    @wraps(state.run_state)
    def run_state(**options: Any) -> BenchReport:
        found.append(options)
        return _report(9.0 if options["bodies"] == 9 else 1.0)

    monkeypatch.setattr("iris_session.bench.state.run_state", run_state)
    return found


def test_json_is_one_object_with_every_key(calls: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "state", "--json", "--seed", "3", "--curve"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert list(result) == ["name", "version", "machine", "params", "results", "reference", "bars"]
    assert result["name"] == "state"
    assert set(result["machine"]) == {"cpus", "memory_gb", "python", "mujoco", "stolen_share", "parallel_speed"}
    assert [set(one) for one in result["bars"]] == [{"key", "op", "bound", "value", "ok"}] * 2
    assert [one["value"] for one in result["bars"]] == [1.0, 30.0]
    (options,) = calls
    assert options.items() >= {"bodies": 300, "seed": 3, "curve": True, "profile": ""}.items()
    defaults = inspect.signature(state.run_state).parameters
    assert {name: options[name] for name in ("clients", "seconds")} == {
        name: defaults[name].default for name in ("clients", "seconds")
    }


@pytest.mark.parametrize(("bodies", "options", "status"), [(9, ["--check"], 1), (9, [], 0), (1, ["--check"], 0)])
def test_missed_bar_sets_the_exit_status(
    bodies: int, options: list[str], status: int, calls: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "state", "--bodies", str(bodies), *options]) == status
    assert ("MISSED" in capsys.readouterr().out) is (bodies == 9)


@pytest.mark.parametrize(("value", "ok"), [(2.9, True), (3.0, True), (3.1, False), (math.nan, False)])
def test_bar_is_kept_or_missed(value: float, ok: bool) -> None:
    assert _report(value).ok is ok
    assert ("MISSED" in _report(value).format()) is not ok


def test_a_link_profile_leaves_no_bars() -> None:
    plain, linked = (_report().complete("state", {"profile": profile}, 0.0, 1.0) for profile in ("", "lan"))
    assert (plain.params, len(plain.bars)) == ({"hz": 60}, 2)
    assert (linked.params, linked.bars) == ({"profile": "lan", "hz": 60, "bars": NO_BARS}, ())
