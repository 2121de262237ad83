"""Damage a small recording in every place, repair it, and count what became of it.

    python tools/damage_recording.py
    python tools/damage_recording.py --flips 100 --cuts 2 --json

The file is cut after every byte: what is whole of it must be found. At some places of every message, and for every
flipped bit, `repair` must write every whole message before the fault, and `inspect` must name the rest. Exit status 1
if not. Takes a quarter of a second for each repair.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.recording.damage import Original, check_cut, check_scans, flip_bits, make_original

PROGRESS_S = 2.0


class Progress:
    """Line on standard error, now and then."""

    def __init__(self) -> None:
        self._due = time.monotonic()

    def show(self, text: str) -> None:
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + PROGRESS_S
            print(text, file=sys.stderr, flush=True)


def cut_everywhere(original: Original, folder: Path, progress: Progress) -> int:
    """Cut the file after every byte from its first message on. Return the number of cuts."""
    n = 0
    for left in check_scans(original, folder):
        n += 1
        progress.show(f"cut {n} times, {left} bytes left")
    return n


def repair_cuts(original: Original, folder: Path, per_message: int, progress: Progress) -> Counter[str]:
    """Cut every message at its beginning and at random places, and repair the file. Return what became of it."""
    rng, outcomes = random.Random(1), Counter[str]()
    for i, message in enumerate(original.messages):
        places = {0, *(rng.randrange(16 + message.length) for _ in range(per_message - 1))}
        outcomes.update(check_cut(original, message.offset + at, folder) for at in places)
        progress.show(f"repaired cuts in {i} of {len(original.messages)} messages")
    return outcomes


def repair_flips(original: Original, folder: Path, n: int, seed: int, progress: Progress) -> Counter[str]:
    """Flip bits, one at a time, and repair the file. Return what became of it."""
    outcomes = Counter[str]()
    for i, outcome in enumerate(flip_bits(original, folder, n, seed)):
        outcomes[outcome] += 1
        progress.show(f"repaired {i} of {n} flips")
    return outcomes


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flips", type=int, default=1000, help="number of flipped bits (%(default)s)")
    parser.add_argument("--cuts", type=int, default=4, help="repaired cuts per message; 0: no cuts (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    began, progress = time.monotonic(), Progress()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        original = make_original(folder)
        try:
            found = {
                "bytes": original.path.stat().st_size,
                "messages": len(original.messages),
                "cuts": cut_everywhere(original, folder, progress) if options.cuts else 0,
                "repaired_cuts": repair_cuts(original, folder, options.cuts, progress) if options.cuts else {},
                "repaired_flips": repair_flips(original, folder, options.flips, options.seed, progress),
                "seconds": round(time.monotonic() - began, 1),
            }
        except AssertionError as error:
            print(f"not repaired: {error}", file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            return 130
    print(json.dumps(found) if options.json else "\n".join(f"{key}: {value}" for key, value in found.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
