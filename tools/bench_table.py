"""Run the benchmarks of a session under every link profile and print the table of docs/evidence/links.md.

python tools/bench_table.py --seconds 20 > table.md
python tools/bench_table.py --profiles lan,busy-wifi --seconds 5 --json

Exit status 1 if a benchmark failed. Ctrl-C (or SIGTERM) prints the table of the measurements so far, with "-" for the
rest; exit status 130.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import subprocess
import sys
from typing import Any, Final

from iris_session.bench import report

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


def run(arguments: tuple[str, ...], profile: str, seconds: float, seed: int) -> dict[str, Any]:
    """One benchmark in processes of its own; its JSON object, without results when it failed (its error is on
    standard error)."""
    command = [sys.executable, "-m", "iris_session.cli.main", "bench", *arguments, "--seed", str(seed), "--json"]
    if "slow-client" not in arguments:
        command += ["--seconds", str(seconds)]
    command += ["--profile", profile] if profile else []
    with subprocess.Popen(command, stdout=subprocess.PIPE) as bench:
        try:
            out, _ = bench.communicate()
        except KeyboardInterrupt:
            bench.send_signal(signal.SIGINT)  # it ends its own processes; if killed, it would leave them
            bench.communicate()
            raise
    if bench.returncode != 0:
        print(f"failed: {' '.join(command)}", file=sys.stderr, flush=True)
        return {"results": {}}
    result: dict[str, Any] = json.loads(out)
    return result


def rows(reports: dict[str, dict[str, dict[str, Any]]], profiles: list[str]) -> str:
    """The Markdown table of `reports`: by label of the benchmark, by profile."""
    lines = [f"| bench | ms unless Hz | {' | '.join(name or 'no link' for name in profiles)} |"]
    lines.append("|---" * (2 + len(profiles)) + "|")
    for label, _, keys in BENCHES:
        for key, name in keys if label in reports else ():
            cells = [cell(reports[label].get(profile), key) for profile in profiles]
            lines.append(f"| {label} | {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def cell(report: dict[str, Any] | None, key: str) -> str:
    """Return a cell of the table: "-" for a benchmark that was not run."""
    return "-" if report is None else number(report["results"].get(key, math.nan))


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
    try:
        measure(reports, chosen, options)
        status = int(any(not one["results"] for by_profile in reports.values() for one in by_profile.values()))
    except KeyboardInterrupt:
        print("ended before everything was measured", file=sys.stderr)
        status = 130
    if options.json:
        print(json.dumps(reports))
    elif reports:
        print(rows(reports, options.profiles.split(",")))
        machine = report.describe_machine()
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
            found = run(arguments, profile, options.seconds, options.seed)
            reports.setdefault(label, {})[profile] = found


if __name__ == "__main__":
    sys.exit(main())
