"""Measure the memory of the recorder's writer over hours of session time, written as fast as possible.

    python tools/recorder_memory.py --minutes 120 --operators 8

Feeds the recorder's writer in its own rhythm (a write per 0.14 s of session time) with rows, states of 60 bodies at
60 Hz, presence, raw samples of three devices per person at 72 Hz and a keyframe every 5 s. Prints the resident memory
at intervals, and the slope over the second half [MiB per hour of session]. The file is removed at the end.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

import numpy as np
import psutil

from iris_session.journal.messages import Batch, MetricRecord, StateFrame
from iris_session.journal.rows import seal_keyframe
from iris_session.protocol.client_messages import Sample, wrap_message
from iris_session.protocol.codec import encode_client
from iris_session.protocol.common import Applied, Pose
from iris_session.protocol.entries import Entry
from iris_session.protocol.server_messages import BodyInfo, PresenceItem
from iris_session.recording import CLOSED, Keyframe, SessionHeader, header_root, make_row
from iris_session.recording.writer import RrdWriter

TICK_NS: Final = 2_000_000
WRITE_TICKS: Final = 70
STATE_TICKS: Final = 8
KEYFRAME_TICKS: Final = 2500
BODIES: Final = 60
DEVICES: Final = ("head", "controller/left", "controller/right")
UPRIGHT: Final = (1.0, 0.0, 0.0, 0.0)


class Feeder:
    """A session that is only its recording: the content of every write, all of it different."""

    def __init__(self, operators: int) -> None:
        bodies = tuple(BodyInfo(i + 1, f"body {i}", True) for i in range(BODIES))
        self.header = SessionHeader("s", "memory", CLOSED, TICK_NS, bodies=bodies)
        self._people = [f"p{i}" for i in range(operators)]
        self._chain = header_root(self.header)
        self._rng = np.random.default_rng(0)
        self._bytes = random.Random(0).randbytes
        self.step = 0

    def feed(self, writer: RrdWriter) -> None:
        """One write."""
        batch = Batch()
        for _ in range(WRITE_TICKS):
            self._tick(batch)
        now_ns = self.step * TICK_NS
        batch.metrics.append(MetricRecord(self.step - 1, now_ns, "lateness_ms", 0.1))
        writer.add(batch)
        for person in range(len(self._people)):
            for i in range(len(DEVICES) * 10):
                writer.add_sample(person, now_ns + i, encode_client(wrap_message(self._sample(i % len(DEVICES)))))
        writer.flush()

    def _tick(self, batch: Batch) -> None:
        now_ns = (self.step + 1) * TICK_NS
        entries = [Entry(i, i, now_ns, self._sample(1)) for i in range(len(self._people) // 2)]
        row = make_row(self._chain, self.step, now_ns, 1, entries, self._bytes(16))
        self._chain = row.chain
        batch.rows.append(row)
        if self.step % STATE_TICKS == 0:
            pose = Pose((self.step / 1000, 0.0, 1.0), UPRIGHT)
            presence = tuple(PresenceItem(p, d, pose, now_ns) for p in self._people for d in DEVICES)
            applied = tuple(Applied(f"arm/{p}", p, DEVICES[1], 1, now_ns, now_ns, now_ns) for p in self._people)
            poses = self._rng.normal(size=(BODIES, 7)).tobytes()
            batch.states.append(StateFrame(self.step, self.step + 1, now_ns * 1e-9, now_ns, poses, presence, applied))
        if self.step % KEYFRAME_TICKS == 0:
            plant, authority, controller, status = (self._bytes(20_000) for _ in range(4))
            keyframe = Keyframe(self.step, plant, authority, controller, status)
            batch.keyframes.append(seal_keyframe(keyframe, self._chain))
        self.step += 1

    def _sample(self, device: int) -> Sample:
        pose = Pose((self.step / 1000, device / 10, 1.0), UPRIGHT)
        return Sample(DEVICES[device], "pose", self.step, self.step * TICK_NS, 1, 1, 1, pose=pose)


def main() -> int:
    parser = argparse.ArgumentParser(description="memory of the recorder's writer over a long session")
    parser.add_argument("--minutes", type=float, default=60.0, help="of session time")
    parser.add_argument("--operators", type=int, default=8)
    options = parser.parse_args()
    feeder, process = Feeder(options.operators), psutil.Process()
    ticks = round(options.minutes * 60e9 / TICK_NS)
    series: list[tuple[float, float]] = []
    with tempfile.TemporaryDirectory(dir=".") as folder:
        path = Path(folder) / "session.rrd"
        writer = RrdWriter(path, "memory")
        writer.write_header(feeder.header)
        began = time.process_time()
        while feeder.step < ticks:
            feeder.feed(writer)
            if feeder.step >= len(series) * ticks / 24:
                hours = feeder.step * TICK_NS / 3.6e12
                series.append((hours, process.memory_info().rss / 2**20))
                print(f"{hours * 60:7.1f} min {series[-1][1]:7.1f} MiB", file=sys.stderr, flush=True)
        writer.close()
        size = path.stat().st_size / 2**20
    half = np.array(series[len(series) // 2 :])
    slope = float(np.polyfit(half[:, 0], half[:, 1], 1)[0])
    hours = options.minutes / 60
    share = (time.process_time() - began) / (hours * 3600)
    print(f"memory {slope:+.1f} MiB/h, file {size / hours:.0f} MiB/h, {100 * share:.1f} % of a core with this feeder")
    return 0


if __name__ == "__main__":
    sys.exit(main())
