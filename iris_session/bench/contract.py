"""The one form in which every benchmark reports: parameters, results, bars, the machine."""

from __future__ import annotations

import math
import os
import platform
from importlib.metadata import version
from typing import Any, Final

import msgspec

VERSION: Final = 1
#: Parameter `bars` of a benchmark over an impaired link.
NO_BARS: Final = "none: the figures include the link"
_OPERATORS: Final = {
    "<=": lambda value, bound: value <= bound,
    ">=": lambda value, bound: value >= bound,
    "<": lambda value, bound: value < bound,
}


class BenchError(Exception):
    """A benchmark that gives no figures: one line for the person who started it."""


class Bar(msgspec.Struct, frozen=True):
    """A bound that a result must keep. `ok` is false for a value that is not a number."""

    key: str
    op: str
    bound: float
    value: float
    ok: bool


def bar(results: dict[str, Any], key: str, op: str, bound: float) -> Bar:
    """The bar `results[key] op bound`."""
    value = float(results[key])
    return Bar(key, op, bound, value, bool(_OPERATORS[op](value, bound)))


class BenchReport(msgspec.Struct, frozen=True):
    """What `iris-session bench NAME --json` prints."""

    name: str
    params: dict[str, Any]
    results: dict[str, Any]
    bars: tuple[Bar, ...]
    reference: dict[str, float] | None = None
    version: int = VERSION

    @property
    def ok(self) -> bool:
        return all(b.ok for b in self.bars)

    def as_dict(self) -> dict[str, Any]:
        """The JSON object of the contract. What never came (an infinite age) is null: JSON has no infinity."""
        return {
            "name": self.name,
            "version": self.version,
            "machine": machine(),
            "params": self.params,
            "results": {key: _finite(value) for key, value in self.results.items()},
            "reference": self.reference,
            "bars": [{**msgspec.to_builtins(b), "value": _finite(b.value)} for b in self.bars],
        }

    def lines(self) -> str:
        """The same for people."""
        width = max(map(len, self.results))
        rows = [f"{self.name}: {' '.join(f'{k}={v}' for k, v in self.params.items())}"]
        bars = {b.key: b for b in self.bars}
        for key, value in self.results.items():
            note = ""
            if key in bars:
                b = bars[key]
                note = f"   bar {b.op} {b.bound:g}  {'ok' if b.ok else 'MISSED'}"
            rows.append(f"  {key:<{width}}  {value}{note}")
        return "\n".join(rows)


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def machine() -> dict[str, Any]:
    """The machine as the contract names it."""
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return {
        "cpus": os.cpu_count(),
        "memory_gb": round(pages / 2**30, 1),
        "python": platform.python_version(),
        "mujoco": version("mujoco"),
    }
