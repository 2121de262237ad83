"""Runs the benchmarks of a session under every profile and prints the table of docs/links.md.

python tools/bench_table.py --seconds 20 > table.md
python tools/bench_table.py --profiles lan,busy-wifi --seconds 5 --json

Ctrl-C (or SIGTERM) ends it with the table of what was measured till then; exit status 130.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import subprocess
import sys
from typing import Any, Final

from iris_session.bench import contract

PROFILES: Final = ("", "lan", "good-wifi", "busy-wifi", "wan", "blackout")
#: Label, arguments of `iris-session bench`, and what of the results goes into the table: key, label.
BENCHES: Final = (
    ("state", ("state",), (("age_ms_p50", "p50"), ("age_ms_p99", "p99"), ("delivered_hz_min", "Hz"))),
    ("state, CURVE", ("state", "--curve"), (("age_ms_p50", "p50"), ("age_ms_p99", "p99"), ("delivered_hz_min", "Hz"))),
    ("input", ("input",), (("response_ms_p50", "p50"), ("response_ms_p99", "p99"))),
    (
        "slow client",
        ("slow-client",),
        (
            ("resume_first_age_ms", "first"),
            ("resume_fresh_after_ms", "fresh"),
            ("link_resume_first_age_ms", "link first"),
            ("link_resume_fresh_after_ms", "link fresh"),
            ("others_age_ms_p99", "others"),
            ("others_age_ms_p99_link", "others, link"),
            ("others_age_ms_p99_baseline", "baseline"),
        ),
    ),
)


NOTHING: Final[dict[str, Any]] = {"results": {}}


def run(arguments: tuple[str, ...], profile: str, seconds: float, seed: int) -> dict[str, Any]:
    """One benchmark in processes of its own; its JSON object, without results when it failed (its error is on
    standard error)."""
    command = [sys.executable, "-m", "iris_session.cli.main", "bench", *arguments, "--seed", str(seed), "--json"]
    if "slow-client" not in arguments:
        command += ["--seconds", str(seconds)]
    command += ["--profile", profile] if profile else []
    done = subprocess.run(command, stdout=subprocess.PIPE, check=False)
    if done.returncode != 0:
        print(f"failed: {' '.join(command)}", file=sys.stderr, flush=True)
        return NOTHING
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def rows(reports: dict[str, dict[str, dict[str, Any]]]) -> str:
    """The Markdown table of `reports`: by label of the benchmark, by profile."""
    profiles = list(next(iter(reports.values())))
    lines = [f"| bench | ms unless Hz | {' | '.join(name or 'no link' for name in profiles)} |"]
    lines.append("|---" * (2 + len(profiles)) + "|")
    for label, _, keys in BENCHES:
        for key, name in keys if label in reports else ():
            values = [reports[label].get(profile, NOTHING)["results"].get(key, math.nan) for profile in profiles]
            lines.append(f"| {label} | {name} | {' | '.join(map(number, values))} |")
    return "\n".join(lines)


def number(value: float | None) -> str:
    if value is None:
        return "never"
    if math.isnan(value):
        return "failed"
    return f"{value:.0f}" if value >= 100.0 else f"{value:.1f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--profiles", default=",".join(PROFILES), help="comma-separated; empty: no link (%(default)s)")
    parser.add_argument("--benches", default=",".join(label.replace(", ", "/") for label, _, _ in BENCHES))
    parser.add_argument("--seconds", type=float, default=20.0, help="measured part of state and input (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="the reports instead of the table")
    options = parser.parse_args()
    chosen = options.benches.split(",")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    reports: dict[str, dict[str, dict[str, Any]]] = {}
    status = 0
    try:
        measure(reports, chosen, options)
    except KeyboardInterrupt:
        print("ended before everything was measured", file=sys.stderr)
        status = 130
    if options.json:
        print(json.dumps(reports))
    elif reports:
        print(rows(reports))
        machine = contract.machine()
        versions = f"Python {machine['python']}, MuJoCo {machine['mujoco']}"
        print(f"\n{machine['cpus']} cores, {versions}; {options.seconds:g} s each, seed {options.seed}.")
    return status


def measure(reports: dict[str, dict[str, dict[str, Any]]], chosen: list[str], options: argparse.Namespace) -> None:
    """Fills `reports`, one benchmark after the other."""
    for label, arguments, _ in BENCHES:
        if label.replace(", ", "/") not in chosen:
            continue
        for profile in options.profiles.split(","):
            print(f"{label}, {profile or 'no link'}", file=sys.stderr, flush=True)
            report = run(arguments, profile, options.seconds, options.seed)
            reports.setdefault(label, {})[profile] = report


if __name__ == "__main__":
    sys.exit(main())
