"""Soak: people over bad links are cut off, killed, robbed of their robots at random; nothing may leak or get lost.

    python tools/soak.py --seconds 3600 --operators 8 --observers 4 --profile busy-wifi --json
    python tools/soak.py --seconds 60 --operators 3 --observers 1

A session (`iris-session serve`, recorded, mode takeover) with seven-joint arms, emulated people in processes of their
own behind `emulator.impairment`, and disturbances at random times from `--seed`. Checked at the end:

- everybody is back and drives, within a minute of the last disturbance;
- every client was handed every event without a gap from each of its snapshots on, and they are those of the recording;
- the memory of authority, front and recorder does not grow in the second half;
- `iris-session verify` finds every step identical.

Exit status 0 when all of that holds; `problems` says what does not.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from soak_run import Soak

from iris_session.client import ClientError
from iris_session.netsim.profiles import load_profile


def soak(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """One run in `folder`; the object that `--json` prints."""
    load_profile(options.profile)
    begun = time.monotonic()
    with ExitStack() as stack:
        run = Soak(options, folder, stack)
        run.start()
        run.run()
        run.finish()
    return {
        "ok": not run.result.problems,
        "seconds": round(time.monotonic() - begun, 1),
        **{k: getattr(options, k) for k in ("operators", "observers", "per_process", "profile", "seed")},
        "disturbances": dict(run.result.disturbances),
        **run.result.details,
        "problems": run.result.problems,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3600.0, help="of disturbances (%(default)s)")
    parser.add_argument("--operators", type=int, default=8)
    parser.add_argument("--observers", type=int, default=4)
    parser.add_argument(
        "--per-process", type=int, default=2, help="people who share a process, and a link (%(default)s)"
    )
    parser.add_argument("--profile", default="busy-wifi", help="of every link: docs/evidence/links.md (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of disturbances, people and weather")
    parser.add_argument("--keep", type=Path, help="folder for recording and logs (default: a temporary one)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    options = parser.parse_args()
    folder = options.keep or Path(tempfile.mkdtemp(prefix="iris-soak-"))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        result = soak(options, folder)
    except ClientError as error:
        raise SystemExit(f"soak: {error}") from error
    finally:
        if options.keep is None:
            shutil.rmtree(folder, ignore_errors=True)
    print(json.dumps(result) if options.json else "\n".join(f"{key:<16}{value}" for key, value in result.items()))
    return 0 if result["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
