"""What a re-simulation must have in common with the recording: library versions, platform, processor, BLAS threads."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from iris_session.recording import blas

#: Distributions whose version can change the floats of a step.
LIBRARIES: Final = ("iris-session", "numpy", "scipy", "mujoco", "mink", "daqp", "msgspec", "rerun-sdk")
#: Environment variables that set the number of BLAS threads; more than one thread may change the order of sums.
BLAS_VARIABLES: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def describe_environment() -> dict[str, str]:
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
    found["blas_threads"] = blas.count_blas_threads()
    found["cpu"] = read_cpu_model()
    return found


def read_cpu_model() -> str:
    """The processor's own name: another one may take other vector instructions, which round differently."""
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "unknown"


def compare_environment(recorded: dict[str, str], here: dict[str, str] | None = None) -> list[str]:
    """One line per version that is not the recorded one: why a re-simulation may differ."""
    now = describe_environment() if here is None else here
    return [
        f"{name}: recorded {value}, here {now.get(name, 'absent')}"
        for name, value in sorted(recorded.items())
        if now.get(name, "absent") != value
    ]


def read_boot_id() -> str:
    """Which boot of which machine this is; empty where the system does not tell. CLOCK_MONOTONIC begins with it."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return ""
