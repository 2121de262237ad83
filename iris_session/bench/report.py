"""Report of a benchmark: parameters, results, bars, the machine."""

from __future__ import annotations

import hashlib
import math
import os
import platform
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from typing import Any, Final

import msgspec
import numpy as np
import psutil
from numpy.typing import NDArray

from iris_session.protocol.errors import IrisError

VERSION: Final = 1
#: Parameter `bars` of a benchmark over an impaired link.
NO_BARS: Final = "none: the figures include the link"
#: Stolen share below which the text of a report does not mention it.
MIN_STOLEN_SHARE: Final = 0.01
#: Parallel speed above which the text of a report does not mention it: threads of one core share it.
MAX_PARALLEL_SPEED: Final = 0.8
#: Duration of one measurement of speed [s], and bytes that are hashed at once.
SPEED_S: Final = 0.2
SPEED_BLOCK: Final = bytes(65_536)
_OPERATORS: Final = {
    "<=": lambda value, bound: value <= bound,
    ">=": lambda value, bound: value >= bound,
    "<": lambda value, bound: value < bound,
}


class BenchError(IrisError):
    """The benchmark has no result. The text is one line for the user."""


class Bar(msgspec.Struct, frozen=True):
    """Bound of a result. `ok` is false for a value that is not a number."""

    key: str
    op: str
    bound: float
    value: float
    ok: bool


def make_bar(results: dict[str, Any], key: str, op: str, bound: float) -> Bar:
    """Return the bar `results[key] op bound`; a dotted key names a value of an object within the results."""
    value = float(flatten(results)[key] if "." in key else results[key])
    return Bar(key, op, bound, value, bool(_OPERATORS[op](value, bound)))


class BenchReport(msgspec.Struct, frozen=True):
    """Report that `iris-session bench NAME --json` prints.

    A benchmark gives results, bars, reference, and the parameters that are no options; `complete` adds the rest.
    `stolen_share`: share of processor time that other virtual machines used meanwhile, 0 where that is not known.
    `parallel_speed`: see `measure_parallel_speed`, the lower of the values before and after.
    """

    results: dict[str, Any]
    bars: Sequence[Bar]
    reference: dict[str, float] | None = None
    params: dict[str, Any] = {}
    name: str = ""
    version: int = VERSION
    stolen_share: float = 0.0
    parallel_speed: float = 1.0

    @property
    def ok(self) -> bool:
        """True if no bar is missed."""
        return all(b.ok for b in self.bars)

    def complete(self, name: str, options: dict[str, Any], stolen_share: float, parallel_speed: float) -> BenchReport:
        """Return the report of a run with these options. With a link profile, no bar applies."""
        params = {key: value for key, value in options.items() if value != ""} | self.params
        bars = self.bars
        if options.get("profile"):
            params, bars = params | {"bars": NO_BARS}, ()
        return BenchReport(
            self.results, bars, self.reference, params, name, stolen_share=stolen_share, parallel_speed=parallel_speed
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object. Infinite values (an age of something that never arrived) are null."""
        return {
            "name": self.name,
            "version": self.version,
            "machine": describe_machine()
            | {"stolen_share": round(self.stolen_share, 4), "parallel_speed": round(self.parallel_speed, 2)},
            "params": self.params,
            "results": _replace_infinite(self.results),
            "reference": self.reference,
            "bars": [{**msgspec.to_builtins(b), "value": _replace_infinite(b.value)} for b in self.bars],
        }

    def format(self) -> str:
        """Return the report as text."""
        nested = any("." in b.key for b in self.bars)
        results = flatten(self.results) if nested else self.results
        width = max(map(len, results))
        rows = [f"{self.name}: {' '.join(f'{k}={v}' for k, v in self.params.items())}"]
        for key, value in results.items():
            held = [f"   bar {b.op} {b.bound:g}  {'ok' if b.ok else 'MISSED'}" for b in self.bars if b.key == key]
            note = "".join(held)
            rows.append(f"  {key:<{width}}  {value}{note}")
        if self.reference:
            rows.append("reference, in the same run:")
            rows += [f"  {key:<{width}}  {value}" for key, value in self.reference.items()]
        if self.stolen_share > MIN_STOLEN_SHARE:
            rows.append(f"other virtual machines used {self.stolen_share:.1%} of the processor time meanwhile")
        if self.parallel_speed < MAX_PARALLEL_SPEED:
            rows.append(f"with all processors in use, a thread is {self.parallel_speed:.2f} times as fast as alone")
        return "\n".join(rows)


def read_stolen_time() -> tuple[float, float]:
    """Return the processor time that other virtual machines used, and all processor time [s]."""
    times = psutil.cpu_times()
    return getattr(times, "steal", 0.0), sum(times)


def measure_parallel_speed() -> float:
    """Return how fast a thread is while all processors are in use, as a share of its speed alone.

    Well below 1 where processors share a core, and where others use the machine, also in ways that the kernel of a
    virtual machine does not see: figures of such a run are too high.
    """
    n = os.cpu_count() or 1
    with ThreadPoolExecutor(n) as pool:
        [alone] = pool.map(_count_hashes, [SPEED_S])
        together = list(pool.map(_count_hashes, [SPEED_S] * n))
    return min(1.0, sum(together) / n / alone)


def _count_hashes(seconds: float) -> int:
    """Return how many blocks are hashed in that time; hashing does not hold the interpreter lock."""
    until = time.perf_counter() + seconds
    count = 1
    while time.perf_counter() < until:
        hashlib.blake2b(SPEED_BLOCK)
        count += 1
    return count


def flatten(results: dict[str, Any]) -> dict[str, Any]:
    """Return the results with nested objects as dotted keys."""
    out: dict[str, Any] = {}
    for key, value in results.items():
        if isinstance(value, dict):
            out |= {f"{key}.{inner}": one for inner, one in value.items()}
        else:
            out[key] = value
    return out


def compute_percentile(values: NDArray[Any], q: float) -> float:
    """Return a percentile of values, to three decimals; infinite, so null in a report, where there are none."""
    return round(float(np.percentile(values, q)), 3) if len(values) else math.inf


def summarize_percentiles(key: str, values: NDArray[Any], percentiles: Sequence[int] = (50, 99)) -> dict[str, float]:
    """Return percentiles of values under the keys `KEY_p50`, `KEY_p99`."""
    return {f"{key}_p{q}": compute_percentile(values, q) for q in percentiles}


def allow_increase(age_ms: float) -> float:
    """Return the bar of a disturbed age of state: a fifth more than without the disturbance, or 1 ms more."""
    return round(age_ms + max(0.2 * age_ms, 1.0), 3)


def _replace_infinite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _replace_infinite(one) for key, one in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def describe_machine() -> dict[str, Any]:
    """Return the `machine` object of a report."""
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return {
        "cpus": os.cpu_count(),
        "memory_gb": round(pages / 2**30, 1),
        "python": platform.python_version(),
        "mujoco": version("mujoco"),
    }
