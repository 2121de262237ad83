"""BLAS on one thread: with several, the order of sums, and with it the last bits of a step, may change from run to run.

OpenBLAS reads its environment when it is loaded, which is before any code of ours; so the libraries that are loaded are
told directly. Linux only; elsewhere the environment counts.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Final

_AFFIXES: Final = tuple((a, b) for a in ("scipy_", "") for b in ("64_", "", "_64"))


def use_one_blas_thread() -> None:
    """From here on, in the whole process, for every OpenBLAS that is loaded now."""
    for library in _libraries():
        if (function := _function(library, "openblas_set_num_threads")) is not None:
            function(1)


def count_blas_threads() -> str:
    """Threads of the loaded OpenBLAS libraries, `1` or `1,8`; `unknown` where none says."""
    found = {int(f()) for library in _libraries() if (f := _function(library, "openblas_get_num_threads")) is not None}
    return ",".join(map(str, sorted(found))) or "unknown"


def _libraries() -> Iterator[ctypes.CDLL]:
    paths: set[str] = set()
    with suppress(OSError), open("/proc/self/maps", encoding="utf-8", errors="replace") as maps:
        paths = {line.split(maxsplit=5)[5].rstrip("\n") for line in maps if "openblas" in line}
    for path in sorted(paths):
        with suppress(OSError):
            yield ctypes.CDLL(path)


def _function(library: ctypes.CDLL, name: str) -> Any:
    for before, behind in _AFFIXES:
        with suppress(AttributeError):
            return getattr(library, f"{before}{name}{behind}")
    return None
