"""Emulated people with headsets, each in a process of its own: what they say of the truth, what is done to them."""

from __future__ import annotations

import json
import subprocess
import sys
from itertools import combinations
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from anchors.pose import Vec3, apply, distance
from anchors.uncertainty import covariance_at_point, length_p95
from iris_session.client import Client
from iris_session.emulator.specs import HeadsetReport, HeadsetSpec
from tests.e2e.conftest import DEADLINE_S, ENDS_WITH_US

#: Twice the p95 of a pair is beyond chance (`anchors.cross_check.Disagreement.as_expected`).
BEYOND_CHANCE: Final = 2.0


class Emulated:
    """One person. `report` is the newest that it has written: about one a second, and one at every change of phase."""

    def __init__(self, folder: Path, address: str, spec: HeadsetSpec) -> None:
        self.spec = spec
        specs = folder / f"{spec.name}.json"
        specs.write_bytes(msgspec.json.encode([spec]))
        self._out = folder / f"{spec.name}.out"
        command = [sys.executable, "-m", "iris_session.emulator", "--address", address, "--specs", str(specs)]
        self._size, self._report = -1, HeadsetReport(name=spec.name)
        with self._out.open("wb") as out, (folder / f"{spec.name}.errors.out").open("wb") as errors:
            self.process = subprocess.Popen(
                [*ENDS_WITH_US, *command, "--json", "--orders", "--seconds", "300"],
                stdin=subprocess.PIPE,
                stdout=out,
                stderr=errors,
            )

    @property
    def report(self) -> HeadsetReport:
        size = self._out.stat().st_size
        if size != self._size:
            *lines, _unfinished = self._out.read_bytes().split(b"\n")
            self._size = size
            known = {
                k: v for k, v in json.loads(lines[-1] if lines else b"{}").items() if v is not None
            }  # no NaN in JSON
            self._report = msgspec.convert({"name": self.spec.name, **known}, HeadsetReport)
        return self._report

    def order(self, kind: str) -> None:
        """Something happens to the tracking frame of this headset, now."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{kind} {self.spec.name}\n".encode())
        self.process.stdin.flush()

    def disturbed_ns(self, kind: str) -> int:
        """Session time at which an order was carried out, -1 while it was not."""
        return self.report.disturbed_ns.get(kind, -1)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(DEADLINE_S)
        if self.process.stdin is not None:
            self.process.stdin.close()


class View:
    """Where one headset shows a point of the session in the true world, and how far off it states that may be."""

    def __init__(self, report: HeadsetReport, covariance: tuple[float, ...], pivot_world: Vec3, point: Vec3) -> None:
        assert report.T_true_shown is not None
        self.p_true = apply(report.T_true_shown, point)
        self.covariance = covariance_at_point(covariance, pivot_world, point)


def views(crew: list[Emulated], watcher: Client, point: Vec3) -> list[View] | None:
    """One of everybody; none while somebody is not aligned, or has not yet reported of the alignment in force."""
    out = []
    for person in crew:
        report = person.report
        alignment = watcher.mirror.find_alignment(report.participant)
        if alignment is None or report.T_true_shown is None or report.alignment_version != alignment.version:
            return None
        out.append(View(report, alignment.covariance, person.spec.T_world_anchor[0], point))
    return out


def differences(seen: list[View]) -> list[tuple[float, float]]:
    """Of every pair: how far apart they show the point, and what 95 % of pairs stay below by what they state [m]."""
    return [
        (distance(a.p_true, b.p_true), length_p95(np.asarray(a.covariance + b.covariance)))
        for a, b in combinations(seen, 2)
    ]


def agree(pairs: list[tuple[float, float]]) -> bool:
    """Whether all pairs are within what chance explains of what they state, and most within the p95 itself."""
    within = sum(apart <= p95 for apart, p95 in pairs)
    return all(apart <= BEYOND_CHANCE * p95 for apart, p95 in pairs) and 2 * within > len(pairs)
