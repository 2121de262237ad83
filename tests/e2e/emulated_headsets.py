"""Emulated headsets, each in a process of its own: reports of their true poses, and disturbances of their tracking."""

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
from tests.e2e.session_process import DEADLINE_S, END_WITH_PARENT

#: A pair may differ by this multiple of its p95 by chance (`anchors.cross_check.Disagreement.as_expected`).
CHANCE_FACTOR: Final = 2.0


class EmulatedHeadset:
    """One headset. `report` is the newest it has written: one a second, and one at every change of phase."""

    def __init__(self, folder: Path, address: str, spec: HeadsetSpec) -> None:
        self.spec = spec
        specs = folder / f"{spec.name}.json"
        specs.write_bytes(msgspec.json.encode([spec]))
        self._out = folder / f"{spec.name}.out"
        command = [sys.executable, "-m", "iris_session.emulator", "--address", address, "--specs", str(specs)]
        self._size, self._report = -1, HeadsetReport(name=spec.name)
        with self._out.open("wb") as out, (folder / f"{spec.name}.errors.out").open("wb") as errors:
            self.process = subprocess.Popen(
                [*END_WITH_PARENT, *command, "--json", "--orders", "--seconds", "300"],
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

    def disturb(self, kind: str) -> None:
        """Disturb the tracking frame of this headset now."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{kind} {self.spec.name}\n".encode())
        self.process.stdin.flush()

    def get_disturbed_ns(self, kind: str) -> int:
        """Return the session time of a disturbance, -1 before it."""
        return self.report.disturbed_ns.get(kind, -1)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(DEADLINE_S)
        if self.process.stdin is not None:
            self.process.stdin.close()


class ShownPoint:
    """The true position at which a headset shows a point of the session, and the covariance that it states of it."""

    def __init__(self, report: HeadsetReport, covariance: tuple[float, ...], pivot_world: Vec3, point: Vec3) -> None:
        assert report.T_true_shown is not None
        self.p_true = apply(report.T_true_shown, point)
        self.covariance = covariance_at_point(covariance, pivot_world, point)


def compute_shown_points(headsets: list[EmulatedHeadset], watcher: Client, point: Vec3) -> list[ShownPoint] | None:
    """Return the point as each headset shows it; `None` until all have reported their current alignment."""
    out = []
    for headset in headsets:
        report = headset.report
        alignment = watcher.mirror.find_alignment(report.participant)
        if alignment is None or report.T_true_shown is None or report.alignment_version != alignment.version:
            return None
        out.append(ShownPoint(report, alignment.covariance, headset.spec.T_world_anchor[0], point))
    return out


def compute_differences(points: list[ShownPoint]) -> list[tuple[float, float]]:
    """Return for every pair their distance and the p95 of it by their stated covariances [m]."""
    return [
        (distance(a.p_true, b.p_true), length_p95(np.asarray(a.covariance + b.covariance)))
        for a, b in combinations(points, 2)
    ]


def are_consistent(pairs: list[tuple[float, float]]) -> bool:
    """Return whether all pairs are within `CHANCE_FACTOR` of their p95, and most within the p95 itself."""
    within = sum(d <= p95 for d, p95 in pairs)
    return all(d <= CHANCE_FACTOR * p95 for d, p95 in pairs) and 2 * within > len(pairs)
