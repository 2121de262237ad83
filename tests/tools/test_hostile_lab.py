"""The state ages that `tools/hostile.py` compares with: those of a window before the attack."""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from hostile import CASES, Lab, Window


def test_quiet_windows_after_an_attack_are_not_pooled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An attack may leave the session slow: that must not become the bound of the next case."""
    lab: Any = Lab(tmp_path, ExitStack())
    ages = iter([10.0, 500.0, 300.0, 20.0])
    monkeypatch.setattr(lab, "measure", lambda seconds: Window(seconds, {"a": [next(ages)] * 100}, 0, 0))
    lab.director = SimpleNamespace(status=lambda: SimpleNamespace(drops={}))
    output = SimpleNamespace(readline=lambda: b"attacking\n", read=lambda: b"")
    monkeypatch.setattr(lab, "_spawn", lambda *_: SimpleNamespace(stdout=output, pid=os.getpid(), wait=lambda _: 0))
    monkeypatch.setattr(lab, "_make_job", lambda *_, **__: None)
    lab.keys = dict.fromkeys(name for one in CASES.values() for name in one.keys)
    lab.measure_quiet(1.0)
    lab.attack(next(iter(CASES.values())), 1.0)
    lab.measure_quiet(1.0)
    assert lab.find_usual_p99_ms(("a",)) == 10.0
    assert lab.find_usual_p99_ms(("a",), lab.measure_quiet(1.0)) == 20.0
