"""The one form in which every benchmark reports: parameters, results, bars, the machine."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from typing import Any, Final

import msgspec

VERSION: Final = 1
_OPERATORS: Final = {
    "<=": lambda value, bound: value <= bound,
    ">=": lambda value, bound: value >= bound,
    "<": lambda value, bound: value < bound,
}


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
        """The JSON object of the contract."""
        return {
            "name": self.name,
            "version": self.version,
            "machine": machine(),
            "params": self.params,
            "results": self.results,
            "reference": self.reference,
            "bars": [msgspec.to_builtins(b) for b in self.bars],
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


def machine() -> dict[str, Any]:
    """The machine as the contract names it."""
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return {
        "cpus": os.cpu_count(),
        "memory_gb": round(pages / 2**30, 1),
        "python": platform.python_version(),
        "mujoco": version("mujoco"),
    }
