"""One thread for sums, told to the libraries that are loaded, and written into every recording."""

from __future__ import annotations

import subprocess
import sys

SCRIPT = """
import numpy, scipy.linalg
from iris_session.recording import blas
from iris_session.recording.versions import environment
before = blas.threads()
blas.use_one_thread()
print(before, environment()["blas_threads"], bool(environment()["cpu"]))
"""


def test_the_loaded_libraries_use_one_thread() -> None:
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
