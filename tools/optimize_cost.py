"""Measure `rerun rrd optimize` on a recording: size, chunks, and processor time of reading.

    python tools/optimize_cost.py sessions/20261122T082921.884463Z-lab-1/session.rrd

The copy is made in a temporary folder (of `--folder`) and removed. Times are those of this process and its children.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from iris_session.recording import Recording

READ = ("events", "keyframes", "rows", "states", "samples")


def spent_s() -> float:
    """Processor time of this process and of its children that have ended."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    before = spent_s()
    return work(), spent_s() - before


def figures(path: Path) -> Iterator[tuple[str, str]]:
    """Name and value of each line of the table, for one file."""
    from rerun.chunk import RrdReader

    yield "size", f"{path.stat().st_size / 1e6:,.1f} MB"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an original has no index
        yield "chunks", f"{sum(1 for _ in RrdReader(path).stream()):,}"
    recording, open_s = timed(lambda: Recording.open(path, warn=False))
    with recording:
        yield "`Recording.open`", f"{open_s:.1f} s"
        for name in READ:
            n, read_s = timed(lambda name=name: sum(1 for _ in getattr(recording, name)()))
            yield f"`{name}()`, {n:,} of them", f"{read_s:.1f} s"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--folder", type=Path, help="where the copy is made meanwhile")
    options = parser.parse_args()
    rerun = Path(sys.executable).parent / "rerun"
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        copy = Path(folder) / "copy.rrd"
        command = [rerun, "rrd", "optimize", options.recording, "-o", copy]
        _, made_s = timed(lambda: subprocess.run(command, check=True, capture_output=True))
        peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / 1e6
        print("| | as recorded | copy |\n|---|---|---|")
        for (name, before), (_, after) in zip(figures(options.recording), figures(copy), strict=True):
            print(f"| {name} | {before} | {after} |")
    print(f"\nThe copy was made in {made_s:.1f} s of processor time, with {peak_mb:,.0f} MB of memory.")


if __name__ == "__main__":
    main()
