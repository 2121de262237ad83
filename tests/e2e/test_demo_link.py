"""A demo over bad links: the whole handover, recorded and verified, by people whose link delays and jitters."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.e2e.conftest import DEMO_S, iris

pytestmark = pytest.mark.e2e


def test_handover_over_busy_wifi(tmp_path: Path) -> None:
    recording = tmp_path / "session.rrd"
    options = ("--profile", "busy-wifi", "--seed", "3", "--record", str(recording), "--json")
    done = iris("demo", "handover", *options, cwd=tmp_path, timeout_s=DEMO_S)
    result = json.loads(done.stdout)
    assert result["ok"], (result["problems"], done.stderr[-2000:])
    assert result["verified"]
    assert [h["object"] for h in result["handovers"]] == ["hammer"]
    assert all(age > 10.0 for age in result["state_age_ms_p99"].values()), "the link is in the ages"


def test_delays_that_cannot_be(tmp_path: Path) -> None:
    assert "'-3' is not a delay" in iris("demo", "handover", "--latency=-3", cwd=tmp_path).stderr
    both = iris("demo", "handover", "--latency", "3", "--profile", "lan", cwd=tmp_path)
    assert both.returncode == 2
    assert "not allowed with" in both.stderr
    unknown = iris("demo", "handover", "--profile", "wifi", cwd=tmp_path)
    assert unknown.returncode == 2
    assert unknown.stderr.startswith("iris-session: no profile 'wifi': give one of")
