"""Plants faults, one after the other, and looks whether `iris-session doctor` names each of them.

    python tools/planted_faults.py                 table of docs/evidence/doctor.md; exit status 1 when one is not named
    python tools/planted_faults.py --only revoked --only full-disk --verbose
    python tools/planted_faults.py --list

The faults are in `tools/planted.py`, the two machines in `tools/planted_lab.py`: needs Linux, root, `ip` and `nft`. A
fault counts as named when the check that stands for it is not well and says the words that name it, when no other check
failed but those that follow from it, when the exit status is that of its state, and when all fits on one screen.
Before and after, the doctor must find nothing failed, else nothing is shown.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
import textwrap
import time
from pathlib import Path
from typing import Final

from planted import FAULTS, Fault, Visit, from_client
from planted_lab import Lab, LabError, require

from iris_session.cli.doctor import lines, verdict
from iris_session.doctor.findings import FAILED, Finding

SCREEN: Final = (120, 50)
"""Columns and lines of a screen."""
PLAIN: Final = str.maketrans("|`", "/'")
"""In a table, and not as commands of the document."""
FORGOTTEN_S: Final = 20.0
"""Late ticks are told of the last ten seconds: those of the start, and of a fault, are forgotten then."""


def consult(visit: Visit) -> tuple[list[Finding], int, float]:
    """What the doctor found, its exit status, and how long it took [s]."""
    began = time.monotonic()
    done = visit.machine.iris("doctor", *visit.arguments, "--json", keys=visit.keys)
    took = time.monotonic() - began
    if not done.stdout:
        raise LabError(f"the doctor itself failed: {done.stderr[-500:]}")
    return [Finding(**one) for one in json.loads(done.stdout)["checks"]], done.returncode, took


def screen(findings: list[Finding]) -> int:
    """Lines that the findings take on a screen."""
    columns, _ = SCREEN
    return sum(max(1, len(textwrap.wrap(line, columns))) for line in [*lines(findings), verdict(findings)])


def judge(one: Fault, findings: list[Finding], status: int) -> str:
    """Why the fault is not named; empty when it is."""
    found = {finding.check: finding for finding in findings}
    if one.check not in found or found[one.check].state != one.state:
        return f"`{one.check}` is {found[one.check].state if one.check in found else 'missing'}, not {one.state}"
    named = found[one.check]
    told = f"{named.text} {named.why} {named.advice}"
    if missing := [words for words in one.says if words not in told]:
        return f"`{one.check}` does not say {missing}: {told}"
    if not named.advice:
        return f"`{one.check}` does not say what to do"
    others = {finding.check for finding in findings if finding.failed} - {one.check, *one.follows}
    if others:
        return f"failed too: {', '.join(sorted(others))}"
    if status != (1 if one.state == FAILED else 0):
        return f"exit status {status}"
    if screen(findings) > SCREEN[1]:
        return f"{screen(findings)} lines are more than a screen"
    return ""


def healthy(lab: Lab) -> None:
    """Raises `LabError` when checks go on to fail while nothing is planted: then nothing that follows counts."""
    until = time.monotonic() + FORGOTTEN_S
    while True:
        found, status, _ = consult(from_client(lab))
        bad = [f"{one.check}: {one.text}" for one in found if one.failed]
        if not bad and not status:
            return
        if time.monotonic() > until:
            raise LabError(f"nothing is planted, and yet {'; '.join(bad) or f'exit status {status}'}")


def row(number: int, one: Fault, findings: list[Finding], status: int, took: float) -> str:
    """A line of the table: in the words of the doctor."""
    named = next(finding for finding in findings if finding.check == one.check)
    said = f"{named.text}. Why: {named.why}" if named.why else named.text
    what = [part.translate(PLAIN) for part in (said, named.advice)]
    return (
        f"| {number} | {one.planted} | `{named.check}`, {named.state} | {what[0]} | {what[1]} | {status} | {took:.1f} |"
    )


def examine_all(lab: Lab, chosen: list[Fault], *, verbose: bool) -> list[str]:
    """Prints the table; a line for each fault that is not named."""
    unnamed = []
    print("| | planted | check | what it says | what to do | status | s |\n|---|---|---|---|---|---|---|")
    for number, one in enumerate(chosen, 1):
        try:
            with one.plant(lab) as visit:
                findings, status, took = consult(visit)
        except LabError as error:
            unnamed.append(f"{one.name}: could not be planted: {error}")
            print(f"| {number} | {one.planted} | **not planted**: {error} | | | | |", flush=True)
            continue
        if verbose:
            print("\n".join([*lines(findings), verdict(findings)]), file=sys.stderr)
        if why := judge(one, findings, status):
            unnamed.append(f"{one.name}: {why}")
            print(f"| {number} | {one.planted} | **not named**: {why} | | | {status} | {took:.1f} |", flush=True)
        else:
            print(row(number, one, findings, status, took), flush=True)
    return unnamed


def main() -> int:
    """Exit status 1 when a fault is not named, 2 when the faults could not be planted."""
    names = [one.name for one in FAULTS]
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", action="append", choices=names, metavar="FAULT", help="this fault, repeatable")
    parser.add_argument("--list", action="store_true", help="only names the faults")
    parser.add_argument("--verbose", action="store_true", help="what the doctor prints, on standard error")
    options = parser.parse_args()
    if options.list:
        print("\n".join(f"{one.name:28s} {one.planted}" for one in FAULTS))
        return 0
    chosen = [one for one in FAULTS if not options.only or one.name in options.only]
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(2))  # else namespaces and processes would stay
    try:
        require()
        with tempfile.TemporaryDirectory(prefix="iris-faults-") as folder, Lab(Path(folder)) as lab:
            lab.server.serve("--interface", lab.server.interface, "--name", "lab-1", "--no-record")
            lab.server.iris("keys", "allow", "client", lab.key_of("keys"), "--role", "any")
            healthy(lab)
            unnamed = examine_all(lab, chosen, verbose=options.verbose)
            healthy(lab)
    except LabError as error:
        print(f"planted_faults: {error}", file=sys.stderr)
        return 2
    print(f"\n{len(chosen) - len(unnamed)} of {len(chosen)} faults are named", *unnamed, sep="\n")
    return 1 if unnamed else 0


if __name__ == "__main__":
    sys.exit(main())
