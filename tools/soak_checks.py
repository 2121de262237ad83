"""What `tools/soak.py` checks afterwards: the events that clients were handed, and memory."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, Final

import numpy as np
from soak_worker import RECORD, fingerprint

from iris_session.recording import Recording

#: Growth of the second half that is noise: allocators, caches that fill.
NOISE_MIB: Final = 6.0


def check_events(recording: Path, folder: Path) -> tuple[dict[str, int], list[str]]:
    """Compares the logs `*.events` in `folder` with the recording. Figures, and a line per problem."""
    problems: list[str] = []
    with Recording.open(recording) as opened:
        recorded = {event.event_seq: fingerprint(event) for event in opened.events()}
    if list(recorded) != list(range(1, len(recorded) + 1)):
        problems.append(f"the recording's {len(recorded)} events are not numbered without a gap")
    logs = sorted(folder.glob("*.events"))
    handed = filled = 0
    for log in logs:
        data = log.read_bytes()
        whole = len(data) - len(data) % RECORD.size  # a killed process may leave half a record
        handed += whole // RECORD.size
        gaps, problem = check_log(log.name, list(struct.iter_unpack(RECORD.format, data[:whole])), recorded)
        filled += gaps
        problems += problem
    return {"recorded": len(recorded), "logs": len(logs), "handed_out": handed, "filled_by_snapshots": filled}, problems


def check_log(name: str, records: list[tuple[Any, ...]], recorded: dict[int, int]) -> tuple[int, list[str]]:
    """One client's events (generation, times that it was told of missed ones, event_seq, CRC): none is missed without
    being told, all in order, each as recorded. A client whose link takes nothing loses events, and is given a snapshot
    in their place: how often, on connections that went on."""
    last_generation = last_told = last_seq = -1
    filled = 0
    for generation, told, seq, crc in records:
        if last_seq >= 0 and seq != last_seq + 1:
            if told == last_told:
                return filled, [f"{name}: event {seq} came after {last_seq}, and nobody told of those between"]
            filled += generation == last_generation
        if seq <= last_seq:
            return filled, [f"{name}: event {seq} came after {last_seq}"]
        if recorded.get(seq) != crc:
            return filled, [f"{name}: event {seq} is not that of the recording"]
        last_generation, last_told, last_seq = generation, told, seq
    return filled, []


def check_memory(rss: dict[str, list[tuple[float, float]]]) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Per process, of its resident memory over the second half of the run [MiB]: beginning, end, slope per hour."""
    figures: dict[str, dict[str, float]] = {}
    problems: list[str] = []
    for name, series in rss.items():
        half = np.array(series[len(series) // 2 :])
        if len(half) < 4:
            continue
        slope = float(np.polyfit(half[:, 0] - half[0, 0], half[:, 1], 1)[0])
        growth = slope * float(half[-1, 0] - half[0, 0])
        figures[name] = {
            "mib": round(float(half[-1, 1]), 1),
            "mib_at_half": round(float(half[0, 1]), 1),
            "mib_per_hour": round(slope * 3600.0, 1),
        }
        if growth > NOISE_MIB:
            problems.append(f"memory of {name} grew by {growth:.1f} MiB more than it may in the second half")
    return figures, problems
