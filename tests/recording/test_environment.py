"""Loaded libraries compute with one thread, which every recording states."""

from __future__ import annotations

import subprocess
import sys

SCRIPT = """
import numpy, scipy.linalg
from iris_session.journal.environment import count_blas_threads, describe_environment, use_one_blas_thread
before = count_blas_threads()
use_one_blas_thread()
print(before, describe_environment()["blas_threads"], bool(describe_environment()["cpu"]))
"""


def test_loaded_libraries_use_one_thread() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
        env={"OPENBLAS_NUM_THREADS": "2"},
    )
    before, after, cpu = done.stdout.split()
    assert before in ("2", "unknown")
    assert after == ("1" if before == "2" else "unknown")
    assert cpu == "True"
