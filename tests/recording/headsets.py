"""Recordings of headsets that observe sheets, written without a session, for tests of the reader."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from anchors.pose import PoseTuple, apply, inverse
from iris_session.journal.messages import Batch
from iris_session.protocol.client_messages import Observation, Sample
from iris_session.protocol.common import Alignment, Pose
from iris_session.protocol.entries import AlignmentAlarm, Entry, Join
from iris_session.protocol.server_messages import (
    AlignmentAlarmed,
    AlignmentChanged,
    Event,
    EventKind,
    ParticipantInfo,
    ParticipantJoined,
)
from iris_session.recording import Settings, header_root, make_row
from iris_session.recording.writer import RrdWriter
from tests.anchors.worlds import Viewpoint, viewpoint_around
from tests.recording.support import make_header

S = 1_000_000_000
_encode = msgspec.msgpack.Encoder().encode


class Played:
    """What happened, step by step; `write` makes a recording of it, with a step at every instant at which something
    did. As in a session, rows are numbered from 0 and steps of events from 1. `anchors`: as the session has them."""

    def __init__(self, anchors: dict[str, PoseTuple], sizes: dict[str, float] | None = None, seed: int = 1) -> None:
        poses = {name: Pose(p, q) for name, (p, q) in anchors.items()}
        settings = Settings(60.0, 5.0, False, anchor_sizes=sizes or {})
        self.header = msgspec.structs.replace(make_header(), anchors=poses, settings=settings)
        self.rng = np.random.default_rng(seed)
        self.now_ns = 0
        self.samples: list[tuple[int, int, bytes]] = []
        self._entries: dict[int, list[Entry]] = {}
        self._events: list[tuple[int, EventKind]] = []  # with their time
        self._people: dict[str, ParticipantInfo] = {}

    def wait(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)

    def event(self, body: EventKind) -> None:
        self._events.append((self.now_ns, body))

    def join(
        self,
        connection: int,
        id: str,
        name: str,
        *,
        run: str = "run:1",
        role: str = "operator",
        alignment: Alignment | None = None,
        refused: bool = False,
    ) -> None:
        """Add a join. `refused`: by the session, so without an event."""
        entry = Entry(connection, connection, self.now_ns, Join("key", role, name, capabilities=(run,) if run else ()))
        self._entries.setdefault(self.now_ns, []).append(entry)
        if not refused:
            self.event(ParticipantJoined(ParticipantInfo(id, name, role, True, alignment=alignment), resumed=False))

    def jumped(self, connection: int, id: str, late_s: float) -> None:
        """Let the tracking frame jump; the session is notified later by `late_ns`."""
        alarm = AlignmentAlarm("jump", 0, "", 0.2, self.now_ns)
        self.wait(late_s)
        self._entries.setdefault(self.now_ns, []).append(Entry(connection, connection, self.now_ns, alarm))
        self.event(AlignmentAlarmed(id, "jump", "", 0.2))

    def aligned(self, id: str, version: int, T_world_tracking: PoseTuple, stated_m: float, epoch: int = 0) -> None:
        """Add an accepted alignment."""
        pose = Pose(*T_world_tracking)
        self.event(AlignmentChanged(id, Alignment(version, "measured", pose, epoch, (), stated_m, stated_m)))

    def look(
        self,
        connection: int,
        anchor_id: str,
        T_world_anchor: PoseTuple,
        T_world_tracking: PoseTuple,
        viewpoint: int,
        *,
        n: int = 20,
        epoch: int = 0,
        head_late_ns: int = 5_000_000,
        noise: float = 1.0,
    ) -> None:
        """A headset looks at a sheet from a new place, `n` pictures in two seconds. `head_late_ns`: how long after a
        picture the nearest sample of the head was taken."""
        look = Viewpoint(self.rng, T_world_anchor, viewpoint_around(self.rng, T_world_anchor[0], 0.6), noise)
        for _ in range(n):
            self.wait(2.0 / n)
            seen = Observation(
                anchor_id, "qr", Pose(*look.observe(T_world_tracking)), self.now_ns, epoch, viewpoint, size_m=0.16
            )
            self.sample(
                connection, apply(inverse(T_world_tracking), look.p_head_world), self.now_ns + head_late_ns, epoch
            )
            self.raw(connection, _encode(seen))

    def sample(self, connection: int, p: tuple[float, float, float], capture_ns: int, epoch: int = 0) -> None:
        head = Sample("head", "pose", len(self.samples), capture_ns, 1, epoch, 1, pose=Pose(p, (1.0, 0.0, 0.0, 0.0)))
        self.raw(connection, _encode(head))

    def raw(self, connection: int, data: bytes) -> None:
        self.samples.append((connection, self.now_ns, data))

    def write(self, path: Path) -> Path:
        """Write the recording."""
        writer = RrdWriter(path, "id")
        writer.write_header(self.header)
        chain, rows = header_root(self.header), []
        times = sorted({0, self.now_ns, *self._entries, *(now_ns for now_ns, _ in self._events)})
        for step, now_ns in enumerate(times):
            rows.append(make_row(chain, step, now_ns, 1, self._entries.get(now_ns, []), b"\0" * 16, b""))
            chain = rows[-1].chain
        events = [Event(n, times.index(now_ns) + 1, now_ns, body) for n, (now_ns, body) in enumerate(self._events, 1)]
        writer.add(Batch(rows=rows, events=events))
        for sample in self.samples:
            writer.add_sample(*sample)
        writer.close()
        return path
