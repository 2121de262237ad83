"""The front process under a condition that is rare: `python -m tests.front.altered_front CONDITION`.

`run_altered` makes `FrontProcess` start it.
"""

from __future__ import annotations

import os
import resource
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from iris_session.front.main import main
from iris_session.link import front_process
from iris_session.system.process import ChildProcess

FEW_DESCRIPTORS = "few_descriptors"
DESCRIPTORS = 512


def run_altered(monkeypatch: pytest.MonkeyPatch, condition: str) -> None:
    """Start front processes under this condition, as long as the test runs."""
    folders = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    altered: Any = partial(
        ChildProcess, __name__, (condition,), environment={"PYTHONPATH": os.pathsep.join(filter(None, folders))}
    )
    monkeypatch.setattr(front_process, "ChildProcess", lambda _module, **options: altered(**options))


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))
    sys.exit(main())
