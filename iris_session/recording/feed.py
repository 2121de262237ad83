"""The authority's side of the recorder: hands over journal rows, states and events without ever blocking a step.

Batches of about 20 ms are numbered and kept until the recorder says that they are in the file: first in a window in
memory, beyond it in a spill file. A recorder that was killed and started anew gets everything that was not yet in the
file. Only when memory and spill are both full are rows dropped: counted, and told by `take_gap`.

Vertices of what bends are for the picture only. They go by a socket of their own, nobody keeps them, and those that it
does not take at once are dropped and counted: they cost the journal nothing.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec
import numpy as np
import zmq
from numpy.typing import NDArray

from iris_session.protocol.common import Applied
from iris_session.protocol.server_messages import BodyInfo, PresenceItem, Reply
from iris_session.protocol.steps import Decision
from iris_session.recording import messages
from iris_session.recording.journal import JournalRow, Keyframe, SessionHeader, seal_keyframe
from iris_session.recording.messages import (
    Batch,
    DenialRecord,
    MetricRecord,
    RecorderStatus,
    SceneAssets,
    SceneModel,
    StateFrame,
    VertexFrame,
)
from iris_session.recording.spill import SpillFile
from iris_session.recording.vertices import VertexRateLimit
from iris_session.streams.deformable import read_header

_T = TypeVar("_T")

BATCH_ROWS: Final = 10
BATCH_NS: Final = 20_000_000
#: Memory for batches that are not in the file yet. 2 operators, 50 bodies: about 0.5 MB/s, so 30 s.
WINDOW_BYTES: Final = 16 << 20
SPILL_BYTES: Final = 2 << 30
#: Records taken from the spill file per flush: 20 ms of backlog 4 times over, so that a flush stays short.
UNSPILL_BATCHES: Final = 4
#: A recorder that writes says so every half second. Longer than this nobody who wants to end waits for its word.
SILENCE_S: Final = 1.0
#: Bound on each list of one batch. A flush comes long before; it holds when a caller never takes a step.
BATCH_ITEMS: Final = 4096
#: Frames of vertices on their way. The recorder takes them thirty times a second.
VERTEX_FRAMES: Final = 32


class FeedStats(msgspec.Struct):
    """Counters of one feed. `dropped_rows`: rows that are lost for the recording, `dropped_items`: states, events
    and so on that are, `dropped_vertices`: frames that the picture lacks; `recorder`: its last status."""

    rows: int = 0
    batches: int = 0
    bytes: int = 0
    window_bytes: int = 0
    spilled_batches: int = 0
    waiting_in_spill: int = 0
    spilled_bytes: int = 0
    dropped_rows: int = 0
    dropped_items: int = 0
    dropped_vertices: int = 0
    recorders: int = 0
    spill_fault: str = ""
    recorder: RecorderStatus | None = None


class RecorderFeed:
    """One feed per session, used from the thread that takes the steps. No clock, no threads.

    Call `row` once per step (it flushes by itself), `keyframe` every few seconds and whenever `wants_keyframe`.
    `endpoint`: where the recorder process listens, see `RecorderProcess.feed_endpoint`; `vertices_endpoint`: the same.
    """

    def __init__(
        self,
        endpoint: str,
        spill_dir: str | Path,
        window_bytes: int = WINDOW_BYTES,
        spill_bytes: int = SPILL_BYTES,
        vertices_endpoint: str = "",
    ) -> None:
        self.stats = FeedStats()
        self._lost = False
        self._complete = False
        self._window_limit = window_bytes
        self._spill = SpillFile(Path(spill_dir) / f"feed-{os.getpid()}.spill", spill_bytes)
        self._context = zmq.Context(io_threads=1)
        self._socket = self._context.socket(zmq.DEALER)
        # Unlimited marks: the window is the bound, and a refused send would be a second one to account for.
        self._socket.setsockopt(zmq.SNDHWM, 0)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RECONNECT_IVL, 50)
        self._socket.connect(endpoint)
        self._vertices = self._context.socket(zmq.PUSH) if vertices_endpoint else None
        if self._vertices is not None:
            self._vertices.setsockopt(zmq.SNDHWM, VERTEX_FRAMES)
            self._vertices.setsockopt(zmq.LINGER, 0)
            self._vertices.setsockopt(zmq.RECONNECT_IVL, 50)
            self._vertices.connect(vertices_endpoint)
        self._pace = VertexRateLimit()
        self._header = b""
        self._scene = Batch()  # the newest `SceneModel`, and what the picture is drawn from
        self._next = 0
        self._window: deque[tuple[int, bytes]] = deque()
        self._instance = 0
        self._header_sent_to = 0
        self._gap_rows = 0
        self._batch = Batch()
        self._batch_since = 0
        self._now = (0, 0)  # step and session time of the newest row
        self._heard_ns = 0
        #: Session time in which a recorder that has something to write has said nothing: it may hang.
        self.silence_ns = 0
        self._presence: tuple[PresenceItem, ...] = ()

    @property
    def wants_keyframe(self) -> bool:
        """True once there is room again after a loss: verification can go on from the next keyframe."""
        return self._lost and not self._spill and 2 * self.stats.window_bytes <= self._window_limit

    def send_header(self, header: SessionHeader, root: str = "", scene_hash: str = "") -> None:
        """Names the session: once, before the first row. `root`, `scene_hash`: see `SceneAssets`."""
        self._header = messages.encode_header(header)
        self._scene.assets = [SceneAssets(-1, 0, root, scene_hash)]
        self._exchange()

    def send_scene(
        self,
        model_hash: str,
        packed_model: bytes,
        bodies: tuple[BodyInfo, ...],
        root: str = "",
        scene_hash: str = "",
    ) -> None:
        """The model of a scene, before the row that loads it. States from then on are of its `bodies`."""
        self._pace.reset()
        scene = SceneModel(*self._now, model_hash, packed_model, bodies)
        self._tell(Batch(scenes=[scene], assets=[SceneAssets(*self._now, root, scene_hash)]))

    def send_patch(self, root: str, scene_hash: str) -> None:
        """The present scene is drawn in another way from now on, before the row that says so."""
        assets = [SceneAssets(*self._now, root, scene_hash)]
        self._tell(Batch(scenes=self._scene.scenes, assets=assets), Batch(assets=assets))

    def _tell(self, known: Batch, news: Batch | None = None) -> None:
        """`known`: what a recorder that comes later is to know; `news`: what this one is told, if not all of that."""
        self.flush()
        self._scene, news = known, known if news is None else news
        self._batch.scenes, self._batch.assets = list(news.scenes), list(news.assets)
        self.flush()

    def add_row(self, row: JournalRow) -> None:
        """One step. Flushes after 10 rows or 20 ms of session time."""
        batch = self._batch
        if not batch.rows:
            self._batch_since = row.now_ns
        batch.rows.append(row)
        self._now = (row.step, row.now_ns)
        self._heard_ns = self._heard_ns or row.now_ns  # a resumed session does not begin at time zero
        self.stats.rows += 1
        if len(batch.rows) >= BATCH_ROWS or row.now_ns - self._batch_since >= BATCH_NS:
            self.flush()

    def add_keyframe(self, keyframe: Keyframe, chain: bytes) -> None:
        """Snapshots after the step of the newest row, whose `chain` is given (`header_root` before the first row)."""
        self._lost = False
        self._batch.keyframes.append(seal_keyframe(keyframe, chain))
        self.flush()

    def add_state(
        self,
        step: int,
        tick: int,
        sim_time: float,
        session_time: int,
        poses: NDArray[np.float64],
        applied: Sequence[Applied] = (),
    ) -> None:
        """World poses (n_bodies, 7) `x y z qw qx qy qz` of the header's bodies, at the state rate; presence with it."""
        frame = StateFrame(step, tick, sim_time, session_time, poses.tobytes(), self._presence, tuple(applied))
        self._add(self._batch.states, frame)

    def add_decision(self, step: int, session_time: int, decision: Decision) -> None:
        """Events and denials of one step; its presence goes with the next state."""
        if decision.presence:
            self._presence = decision.presence
        for event in decision.events:
            self._add(self._batch.events, event)
        for outgoing in decision.outgoing:
            message = outgoing.message
            if type(message) is Reply and message.denial is not None:
                record = DenialRecord(step, session_time, outgoing.connection, message.denial)
                self._add(self._batch.denials, record)

    def add_metric(self, name: str, value: float) -> None:
        """A scalar at the newest row's step and time, plotted as `/metrics/<name>`."""
        self._add(self._batch.metrics, MetricRecord(*self._now, name, float(value)))

    def send_vertices(self, stream: str, frame: bytes, session_time: int) -> None:
        """`full` of a deformable's media stream, as it was published with the state of `session_time`. For the picture:
        not all of them go in (`VertexPace`), and none waits."""
        if self._vertices is None or not self._pace.take(stream, read_header(frame).n_vertices, session_time):
            return
        try:
            self._vertices.send(messages.encode_vertices(VertexFrame(stream, session_time, frame)), zmq.NOBLOCK)
        except zmq.Again:
            self.stats.dropped_vertices += 1

    def take_gap(self) -> int:
        """Rows lost since the last call: journal them as `Entry(RecordingGap(rows))` and take a keyframe."""
        rows, self._gap_rows = self._gap_rows, 0
        return rows

    def flush(self) -> None:
        """Numbers the pending batch and hands over what the window allows. Never blocks."""
        batch = self._batch
        lists: tuple[list[Any], ...] = (batch.states, batch.events, batch.denials, batch.metrics, batch.keyframes)
        lists += (batch.scenes, batch.assets)
        if batch.rows or any(lists):
            self._batch = Batch(dropped_rows=self.stats.dropped_rows)
            self._enqueue(messages.encode_batch(batch), len(batch.rows), sum(len(items) for items in lists))
        self._exchange()
        self.silence_ns = self._now[1] - self._heard_ns if self._window else 0

    def close(
        self, timeout_s: float = 5.0, alive: Callable[[], bool] = lambda: True, silence_s: float = math.inf
    ) -> bool:
        """Hands over everything and waits until it is in the file. False: not all of it is known to be there, after
        `timeout_s`, or when the recorder is no longer `alive` or has said nothing for `silence_s`
        (`SILENCE_S`, unless it was just started and is not there yet).

        Without a header nothing was recorded, and there is nothing to wait for. A second call does nothing.
        """
        if self._socket.closed:
            return self._complete
        self.flush()
        waits = max(1, round(timeout_s / 0.02))
        silent, said = 0, self.stats.recorder
        while waits and silent < silence_s / 0.02 and alive() and self._header and (self._window or self._spill):
            self._socket.poll(20)
            self._exchange()
            waits -= 1
            silent = 0 if self.stats.recorder is not said else silent + 1
            said = self.stats.recorder
        self._complete = not self._window and not self._spill
        if self._spill:
            self._lose(self._spill.rows, self._spill.others, "the session ended before the recorder could take it all")
        self._spill.close()
        if self._vertices is not None:
            self._vertices.close(0)
        self._socket.close(0)
        self._context.term()
        return self._complete

    def _add(self, items: list[_T], item: _T) -> None:
        if len(items) < BATCH_ITEMS:
            items.append(item)
        else:
            self.stats.dropped_items += 1

    def _enqueue(self, body: bytes, rows: int, others: int) -> None:
        if not self._spill and self.stats.window_bytes + len(body) <= self._window_limit:
            self._send_batch(body)
        elif self._spill.push(body, rows, others):
            self.stats.spilled_batches += 1
        else:
            self._lose(rows, others, self._spill.fault)

    def _lose(self, rows: int, others: int, why: str) -> None:
        self.stats.dropped_rows += rows
        self.stats.dropped_items += others
        self.stats.spill_fault = why
        self._gap_rows += rows
        self._lost = True
        self._batch.dropped_rows = self.stats.dropped_rows

    def _send_batch(self, body: bytes) -> None:
        number, self._next = self._next, self._next + 1
        self._window.append((number, body))
        self.stats.batches += 1
        self.stats.bytes += len(body)
        self.stats.window_bytes += len(body)
        if self._instance and self._header_sent_to == self._instance:
            self._socket.send_multipart((messages.FRAME.pack(messages.BATCH, number), body), zmq.NOBLOCK)

    def _exchange(self) -> None:
        while int(self._socket.get(zmq.EVENTS)) & zmq.POLLIN:
            self._take(messages.decode_status(self._socket.recv(zmq.NOBLOCK)))
        for _ in range(UNSPILL_BATCHES):
            if not self._spill or self.stats.window_bytes >= self._window_limit:
                break
            try:
                record = self._spill.pop()
            except OSError as error:  # a disk that fails must not end the session
                self._lose(self._spill.rows, self._spill.others, f"the spill file cannot be read: {error}")
                self._spill.close()
                break
            if record is not None:
                self._send_batch(record[0])
        self.stats.waiting_in_spill = len(self._spill)
        self.stats.spilled_bytes = self._spill.waiting_bytes

    def _take(self, status: RecorderStatus) -> None:
        self.stats.recorder = status
        self._heard_ns = self._now[1]
        if status.instance != self._instance:
            self._instance = status.instance
            self.stats.recorders += 1
            self._pace.reset()
        while self._window and self._window[0][0] <= status.written:
            self.stats.window_bytes -= len(self._window.popleft()[1])
        if status.expecting < 0 and self._header and self._header_sent_to != self._instance and not status.fault:
            self._header_sent_to = self._instance
            first = self._window[0][0] if self._window else self._next
            known = messages.encode_batch(self._scene)
            head = (messages.FRAME.pack(messages.HEADER, first), self._header, known)
            self._socket.send_multipart(head, zmq.NOBLOCK)
            for number, body in self._window:
                self._socket.send_multipart((messages.FRAME.pack(messages.BATCH, number), body), zmq.NOBLOCK)
