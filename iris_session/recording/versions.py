"""What a re-simulation must have in common with the recording: library versions, platform, BLAS threads."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from typing import Final

#: Distributions whose version can change the floats of a step.
LIBRARIES: Final = ("iris-session", "numpy", "scipy", "mujoco", "mink", "daqp", "msgspec", "rerun-sdk")
#: Environment variables that set the number of BLAS threads; more than one thread may change the order of sums.
BLAS_VARIABLES: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def environment() -> dict[str, str]:
    """Versions of this process: one text per name. Libraries that are not installed are `absent`."""
    found = {"python": platform.python_version(), "implementation": sys.implementation.name}
    for name in LIBRARIES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "absent"
    found["platform"] = f"{platform.system()}-{platform.machine()}-{platform.libc_ver()[1] or 'unknown'}"
    for name in BLAS_VARIABLES:
        found[name] = os.environ.get(name, "unset")
    return found


def differences(recorded: dict[str, str], here: dict[str, str] | None = None) -> list[str]:
    """One line per version that is not the recorded one: why a re-simulation may differ."""
    now = environment() if here is None else here
    return [
        f"{name}: recorded {value}, here {now.get(name, 'absent')}"
        for name, value in sorted(recorded.items())
        if now.get(name, "absent") != value
    ]
