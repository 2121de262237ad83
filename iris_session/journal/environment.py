"""Environment that a re-simulation must share with the recording: library versions, platform, processor, BLAS threads.

BLAS runs on one thread: with several, the order of sums, and with it the last bits of a step, may change from run to
run.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

#: Distributions whose version can change the floats of a step.
LIBRARIES: Final = ("iris-session", "numpy", "scipy", "mujoco", "mink", "daqp", "msgspec", "rerun-sdk")
#: Environment variables that set the number of BLAS threads; more than one thread may change the order of sums.
BLAS_VARIABLES: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def describe_environment() -> dict[str, str]:
    """Return versions of this process by name. Libraries that are not installed are `absent`."""
    found = {"python": platform.python_version(), "implementation": sys.implementation.name}
    for name in LIBRARIES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "absent"
    found["platform"] = f"{platform.system()}-{platform.machine()}-{platform.libc_ver()[1] or 'unknown'}"
    for name in BLAS_VARIABLES:
        found[name] = os.environ.get(name, "unset")
    found["blas_threads"] = count_blas_threads()
    found["cpu"] = read_cpu_model()
    return found


def read_cpu_model() -> str:
    """Return the name of the processor: another one may use other vector instructions, which round differently."""
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "unknown"


def compare_environment(recorded: dict[str, str], here: dict[str, str] | None = None) -> list[str]:
    """Return a line per version that is not the recorded one: why a re-simulation may differ."""
    now = describe_environment() if here is None else here
    return [
        f"{name}: recorded {value}, here {now.get(name, 'absent')}"
        for name, value in sorted(recorded.items())
        if now.get(name, "absent") != value
    ]


def read_boot_id() -> str:
    """Return the id of this boot of this machine, empty if unknown. CLOCK_MONOTONIC begins with it."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return ""


# --- BLAS threads -----------------------------------------------------------------------------------------------------
#
# OpenBLAS reads its environment when it is loaded, which is before any code of ours; so the libraries that are loaded
# are configured directly. Linux only; elsewhere the environment counts.

_AFFIXES: Final = tuple((a, b) for a in ("scipy_", "") for b in ("64_", "", "_64"))


def use_one_blas_thread() -> None:
    """Set every loaded OpenBLAS to one thread, for the whole process."""
    for library in _load_blas_libraries():
        if (function := _find_function(library, "openblas_set_num_threads")) is not None:
            function(1)


def count_blas_threads() -> str:
    """Return the threads of the loaded OpenBLAS libraries, `1` or `1,8`; `unknown` without any."""
    found = {
        int(f())
        for library in _load_blas_libraries()
        if (f := _find_function(library, "openblas_get_num_threads")) is not None
    }
    return ",".join(map(str, sorted(found))) or "unknown"


def _load_blas_libraries() -> Iterator[ctypes.CDLL]:
    paths: set[str] = set()
    with suppress(OSError), open("/proc/self/maps", encoding="utf-8", errors="replace") as maps:
        paths = {line.split(maxsplit=5)[5].rstrip("\n") for line in maps if "openblas" in line}
    for path in sorted(paths):
        with suppress(OSError):
            yield ctypes.CDLL(path)


def _find_function(library: ctypes.CDLL, name: str) -> Any:
    for before, behind in _AFFIXES:
        with suppress(AttributeError):
            return getattr(library, f"{before}{name}{behind}")
    return None
