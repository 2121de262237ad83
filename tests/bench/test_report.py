"""Reports of benchmarks: the common form with every key. Speed is not tested."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import msgspec
import pytest

from iris_session.bench.report import BenchReport, make_bar, measure_parallel_speed
from iris_session.cli.main import main

#: Length of a window: a busy machine may stand still for ten of these seconds.
SECONDS: Final = "12"
STATE_KEYS = {
    *("delivered_hz_min", "age_ms_p50", "age_ms_p95", "age_ms_p99", "bytes_per_frame", "bytes_per_body"),
    *("max_position_error_mm", "max_rotation_error_deg", "server_cpu_share", "late_tick_share", "lateness_ms_p99"),
    "ticks",
}
INPUT_KEYS = {
    *("response_ms_p50", "response_ms_p99", "late_tick_share", "lateness_ms_p99", "samples_per_s", "rejected"),
}
SLOW_CLIENT_KEYS = {
    f"{prefix}{key}" for prefix in ("", "link_") for key in ("resume_first_age_ms", "resume_fresh_after_ms")
} | {"others_age_ms_p99", "others_age_ms_p99_link", "others_age_ms_p99_baseline", "late_tick_share"}


def _bench(folder: Path, *arguments: str) -> dict[str, Any]:
    """Run one benchmark; standard output must be one JSON object."""
    command = [sys.executable, "-m", "iris_session.cli.main", "bench", *arguments, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, timeout=300.0)
    assert done.returncode == 0, done.stderr[-2000:]
    result: dict[str, Any] = json.loads(done.stdout)
    assert not list(folder.iterdir()), "a benchmark leaves no file behind"
    return result


def _check(result: dict[str, Any], name: str, keys: set[str]) -> None:
    assert list(result) == ["name", "version", "machine", "params", "results", "reference", "bars"]
    assert result["name"] == name
    assert set(result["machine"]) == {"cpus", "memory_gb", "python", "mujoco", "stolen_share", "parallel_speed"}
    assert keys <= set(result["results"])
    for key in keys - {"rejected"}:
        assert math.isfinite(result["results"][key]), key
    for one in result["bars"]:
        assert set(one) == {"key", "op", "bound", "value", "ok"}
        assert one["value"] == result["results"][one["key"]]
    assert result["bars"]


@pytest.mark.long
@pytest.mark.e2e
@pytest.mark.parametrize("crypto", ["--plain", "--curve"])
def test_state(tmp_path: Path, crypto: str) -> None:
    result = _bench(tmp_path, "state", "--clients", "2", "--bodies", "20", "--seconds", SECONDS, crypto)
    _check(result, "state", STATE_KEYS)
    assert {"clients": 2, "bodies": 20}.items() <= result["params"].items()
    got = result["results"]
    assert got["ticks"] >= 400
    assert got["max_position_error_mm"] <= 0.1
    assert got["max_rotation_error_deg"] <= 0.05
    assert 0.0 <= got["late_tick_share"] <= 1.0
    assert 0.0 < got["age_ms_p50"] <= got["age_ms_p95"] <= got["age_ms_p99"]


@pytest.mark.long
@pytest.mark.e2e
def test_input(tmp_path: Path) -> None:
    result = _bench(tmp_path, "input", "--operators", "1", "--robots", "1", "--observers", "1", "--seconds", SECONDS)
    _check(result, "input", INPUT_KEYS)
    assert {"operators": 1, "robots": 1, "observers": 1}.items() <= result["params"].items()
    got = result["results"]
    assert 0.0 < got["response_ms_p50"] <= got["response_ms_p99"]
    assert isinstance(got["rejected"], dict)


@pytest.mark.long
@pytest.mark.e2e
def test_slow_client(tmp_path: Path) -> None:
    """One round. The stopped client and the one with a stalled link get fresh state again."""
    # Most of a single round is time to recover: a busy machine may stand still.
    result = _bench(tmp_path, "slow-client", "--clients", "3", "--bodies", "20", "--seconds", "26")
    _check(result, "slow-client", SLOW_CLIENT_KEYS)
    assert result["params"]["rounds"] == 1
    assert result["reference"]["resume_first_age_ms"] > 2900.0
    assert all(result["results"][f"{link}resume_first_age_ms"] < 1000.0 for link in ("", "link_"))


@pytest.mark.long
@pytest.mark.e2e
@pytest.mark.parametrize("arguments", [("state", "--bodies", "20"), ("input", "--operators", "1", "--robots", "1")])
def test_benchmarks_over_an_impaired_link(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    """The figures include the link, so no bar applies."""
    slow = tmp_path / "slow.toml"
    slow.write_text("[[phases]]\ndelay_ms = 50\n")
    folder = tmp_path / "empty"
    folder.mkdir()
    people = ("--clients", "1") if arguments[0] == "state" else ("--observers", "0")
    key = "age_ms_p50" if arguments[0] == "state" else "response_ms_p50"
    for _ in range(3):
        result = _bench(folder, *arguments, *people, "--seconds", SECONDS, "--profile", str(slow))
        if result["results"][key] is not None:  # null: a busy machine has disconnected the operator
            break
    assert result["results"][key] > 50.0
    assert result["bars"] == []
    assert result["params"]["profile"] == str(slow)
    assert "include the link" in result["params"]["bars"]


def test_unknown_profile_is_one_line_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "state", "--profile", "nice-wifi"]) == 2
    assert "'nice-wifi'" in capsys.readouterr().err
    assert main(["bench", "slow-client", "--clients", "2"]) == 2
    assert "--clients 2" in capsys.readouterr().err


def _report(value: float) -> BenchReport:
    results = {"age_ms_p99": value, "extra": 1}
    return BenchReport("state", {"clients": 2}, results, (make_bar(results, "age_ms_p99", "<=", 3.0),))


@pytest.mark.parametrize(("value", "ok"), [(2.9, True), (3.0, True), (3.1, False), (math.nan, False)])
def test_bar_is_kept_or_missed(value: float, ok: bool) -> None:
    report = _report(value)
    assert report.ok is ok
    assert ("MISSED" in report.format()) is not ok


def test_stolen_processor_time_is_reported() -> None:
    report = msgspec.structs.replace(_report(1.0), stolen_share=0.1234567)
    assert "12.3%" in report.format()
    assert report.as_dict()["machine"]["stolen_share"] == 0.1235
    assert "other virtual machines" not in _report(1.0).format()


def test_speed_with_all_processors_in_use_is_reported() -> None:
    report = msgspec.structs.replace(_report(1.0), parallel_speed=0.456)
    assert "0.46 times" in report.format()
    assert report.as_dict()["machine"]["parallel_speed"] == 0.46
    assert "times as fast" not in _report(1.0).format()
    assert 0.0 < measure_parallel_speed() <= 1.0


def test_infinite_values_are_null() -> None:
    report = _report(math.inf).as_dict()
    assert report["results"]["age_ms_p99"] is report["bars"][0]["value"] is None
    assert report["bars"][0]["ok"] is False
    json.dumps(report, allow_nan=False)


@pytest.mark.parametrize(("value", "options", "status"), [(9.0, ["--check"], 1), (9.0, [], 0), (1.0, ["--check"], 0)])
def test_missed_bar_sets_the_exit_status(
    value: float, options: list[str], status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("iris_session.bench.state.run_state", lambda *_, **__: _report(value))
    assert main(["bench", "state", *options]) == status
    assert "age_ms_p99" in capsys.readouterr().out
