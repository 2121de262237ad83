"""Fuzz every decoder and every state machine behind a socket with hostile bytes and conversations.

    python tools/fuzz.py --target all --inputs 1000000 --seed 1
    python tools/fuzz.py --target client,front --inputs 20000 --json

Inputs are generated from the schemas of the messages, valid and invalid, and then damaged as bytes. A finding is an
exception that a target does not promise, a broken invariant, or memory that grows. Its input is saved, and the same
seed reproduces it. Prints a table row per target, or one JSON object; exit status 1 if there is a finding.

Decoders are in `fuzz_decoders`, conversations in `fuzz_state_machines`, the live web gateway in `fuzz_web`.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import sys
import time
import traceback
from dataclasses import asdict, dataclass, field
from pathlib import Path
from random import Random
from typing import Any, Final

import psutil
from fuzz_decoders import DECODERS
from fuzz_state_machines import ALL_TYPES, MACHINES
from fuzz_web import WebGateway

TARGETS: Final = {**DECODERS, **MACHINES, "web-gateway": WebGateway}
#: Allowed growth of memory above that after the first inputs.
MAX_GROWTH_MIB: Final = 64
WARM_UP: Final = 5000
MEASURE_EVERY: Final = 1000
MAX_FINDINGS: Final = 5
#: Returns free memory of this process to the system, where the C library can.
trim_memory: Final = getattr(ctypes.CDLL(None), "malloc_trim", lambda _: None)


@dataclass
class Result:
    """Result of one target. `growth_mib`: peak of resident memory above that after the first inputs."""

    target: str
    inputs: int = 0
    accepted: int = 0
    seconds: float = 0.0
    peak_rss_mib: float = 0.0
    growth_mib: float = 0.0
    findings: list[dict[str, Any]] = field(default_factory=list)

    @property
    def rate(self) -> float:
        return self.inputs / self.seconds if self.seconds else 0.0


def fuzz(name: str, inputs: int, seed: int, save: Path | None = None, limit_s: float = float("inf")) -> Result:
    """Feed `inputs` inputs to a target, or as many as fit into `limit_s`."""
    result = Result(name)
    target = TARGETS[name](Random(f"{seed}:{name}"))
    process = getattr(target, "process", None) or psutil.Process()
    seen: set[str] = set()
    base = 0
    began = time.monotonic()
    try:
        for i in range(inputs):
            data = target.make()
            try:
                result.accepted += bool(target.feed(data))
            except Exception as error:  # any other exception is a finding
                where = traceback.extract_tb(error.__traceback__)[-1]
                place = f"{type(error).__name__} at {Path(where.filename).name}:{where.lineno}"
                if place not in seen:
                    seen.add(place)
                    result.findings.append(make_finding(name, seed, i, data, f"{place}: {error}"[:500], save))
            result.inputs = i + 1
            if i % MEASURE_EVERY == 0:
                trim_memory(0)  # what models of scenes leave in pieces is not in use
                rss = process.memory_info().rss
                result.peak_rss_mib = max(result.peak_rss_mib, rss / 2**20)
                base = max(base, rss) if i <= WARM_UP else base
                if time.monotonic() - began > limit_s or len(seen) >= MAX_FINDINGS:
                    break
    finally:
        result.seconds = time.monotonic() - began
        target.close()
    result.growth_mib = max(0.0, result.peak_rss_mib - base / 2**20)
    if result.growth_mib > MAX_GROWTH_MIB:
        result.findings.append(
            make_finding(name, seed, result.inputs, b"", f"memory grew by {result.growth_mib:.0f} MiB", None)
        )
    if name in ("client", "front") and inputs > WARM_UP:
        missing = sorted(ALL_TYPES - getattr(target, "types", ALL_TYPES))
        if missing:
            result.findings.append(
                make_finding(name, seed, result.inputs, b"", f"never sent: {', '.join(missing)}", None)
            )
    return result


def make_finding(name: str, seed: int, number: int, data: bytes, text: str, save: Path | None) -> dict[str, Any]:
    """Return a finding as a JSON object, and save its input."""
    path = ""
    if save is not None:
        save.mkdir(parents=True, exist_ok=True)
        file = save / f"{name}-{seed}-{number}.bin"
        file.write_bytes(data)
        path = str(file)
    return {"target": name, "seed": seed, "input": number, "text": text, "saved": path}


def format_row(result: Result) -> str:
    """Return a row of the table."""
    return (
        f"| {result.target} | {result.inputs:,} | {result.accepted / max(1, result.inputs):.0%} | {result.rate:,.0f} | "
        f"{result.peak_rss_mib:.0f} | {result.growth_mib:.1f} | {len(result.findings)} |"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--target", default="all", help="comma-separated names, or all")
    parser.add_argument("--inputs", type=int, default=10_000, help="inputs per target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--limit", type=float, default=float("inf"), help="at most this many seconds per target")
    parser.add_argument("--save", type=Path, default=Path("fuzz-findings"), help="folder for inputs of findings")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.add_argument("--list", action="store_true", help="list the targets")
    arguments = parser.parse_args()
    if arguments.list:
        print("\n".join(TARGETS))
        return 0
    names = list(TARGETS) if arguments.target == "all" else arguments.target.split(",")
    unknown = [name for name in names if name not in TARGETS]
    if unknown:
        parser.error(f"unknown target {', '.join(unknown)}: {', '.join(TARGETS)}")
    results = []
    if not arguments.json:
        print("| target | inputs | accepted | per second | peak RSS [MiB] | growth [MiB] | findings |")
        print("|---|---|---|---|---|---|---|", flush=True)
    for name in names:
        results.append(fuzz(name, arguments.inputs, arguments.seed, arguments.save, arguments.limit))
        if not arguments.json:
            print(format_row(results[-1]), flush=True)
    findings = [one for result in results for one in result.findings]
    if arguments.json:
        print(json.dumps({"ok": not findings, "results": [{**asdict(r), "per_second": r.rate} for r in results]}))
    else:
        for one in findings:
            print(f"{one['target']}, seed {one['seed']}, input {one['input']}: {one['text']} {one['saved']}")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
