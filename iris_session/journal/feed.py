"""Feed of the recorder: send journal rows, states and events of the authority, without a step that waits for it.

Batches of about 20 ms are numbered and kept in memory until the recorder acknowledges that they are in the file: the
first of them, the window, are sent, the others wait in the backlog. A restarted recorder receives everything that was
not acknowledged. Rows are dropped only if the backlog is full, states and metrics before: they are counted and reported
by `take_gap`. No step waits for a disk, so nothing here is kept on one.

Vertices of deformables are for the picture only: while batches wait they are dropped and counted. States of a scene at
rest are left out (`RestFilter`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeVar

import msgspec
import numpy as np
import zmq
from numpy.typing import NDArray

from iris_session.journal import messages
from iris_session.journal.messages import (
    Batch,
    DenialRecord,
    HoldRecord,
    MetricRecord,
    RecorderStatus,
    RobotLabels,
    SceneAssets,
    SceneModel,
    StateFrame,
    VertexFrame,
)
from iris_session.journal.rows import JournalRow, Keyframe, SessionHeader, seal_keyframe
from iris_session.protocol.common import Applied
from iris_session.protocol.server_messages import (
    BodyInfo,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantJoined,
    ParticipantLeft,
    PresenceItem,
    Reply,
)
from iris_session.protocol.steps import Decision
from iris_session.streams.deformable import read_header

_T = TypeVar("_T")

BATCH_ROWS: Final = 10
BATCH_NS: Final = 20_000_000
#: Memory for batches that are sent and not in the file yet, and for those that wait. 2 operators and 50 bodies make
#: about 0.5 MB/s, so 30 s and 17 minutes.
WINDOW_BYTES: Final = 16 << 20
BACKLOG_BYTES: Final = 512 << 20
#: Maximum number of batches of the backlog that are sent per flush, so that it stays short: four times what is new.
BACKLOG_BATCHES: Final = 4
#: Time over which the growth of the file is measured.
RATE_NS: Final = 30_000_000_000
#: Share of the backlog above which only what verification needs is kept: rows, keyframes, scenes.
JOURNAL_SHARE: Final = 0.75
#: Maximum time without a status while closing. A recorder that writes sends one every half second; a busy machine or
#: its disk may stand still for longer.
SILENCE_S: Final = 3.0
#: Maximum length of each list of one batch. A flush comes long before, unless the caller never takes a step.
BATCH_ITEMS: Final = 4096
#: Maximum number of participants whose names a later recorder gets; batches that it gets again are about past ones too.
PEOPLE: Final = 256


class FeedStats(msgspec.Struct):
    """Counters of one feed.

    `waiting_batches`, `waiting_bytes`: the backlog. `dropped_rows`: rows missing in the recording; `drop_reason`: why
    the last ones; `dropped_items`: states, events and other items missing;
    `dropped_vertices`: frames missing in the picture; `recorder`: the last status of the recorder; `bytes_per_hour`:
    growth of the file at the rate of the last `RATE_NS`, 0 before. What comes after the budget of the recording is used
    up is in none of them.
    """

    window_bytes: int = 0
    waiting_batches: int = 0
    waiting_bytes: int = 0
    dropped_rows: int = 0
    dropped_items: int = 0
    dropped_vertices: int = 0
    recorders: int = 0
    drop_reason: str = ""
    recorder: RecorderStatus | None = None
    bytes_per_hour: int = 0


class RecorderFeed:
    """One feed per session, used from the thread that takes the steps. No clock, no threads.

    Call `row` once per step (it flushes by itself), `keyframe` every few seconds and whenever `wants_keyframe`.
    `endpoint`: where the recorder process listens, see `RecorderProcess.feed_endpoint`.
    """

    def __init__(
        self,
        endpoint: str,
        window_bytes: int = WINDOW_BYTES,
        backlog_bytes: int = BACKLOG_BYTES,
    ) -> None:
        self.stats = FeedStats()
        self._lost = False
        self._complete = False
        self._window_limit = window_bytes
        self._backlog_limit = backlog_bytes
        self._backlog: deque[tuple[bytes, int, int]] = deque()  # batches, and numbers of rows and of others in them
        self._context = zmq.Context(io_threads=1)
        self._socket = self._context.socket(zmq.DEALER)
        # Unlimited marks: the window is the bound, and a refused send would be a second one to account for.
        self._socket.setsockopt(zmq.SNDHWM, 0)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RECONNECT_IVL, 50)
        self._socket.connect(endpoint)
        self._vertex_limit = VertexRateLimit()
        self._rest = RestFilter()
        self._header = b""
        self._scene = Batch()  # the newest `SceneModel`, and the assets of the picture
        self._robots: tuple[RobotLabels, ...] = ()
        self._next = 0
        self._window: deque[tuple[int, bytes]] = deque()
        self._instance = 0
        self._header_sent_to = 0
        self._gap_rows = 0
        self._batch = Batch()
        self._batch_since = 0
        self._now = (0, 0)  # step and session time of the newest row
        self._sim_time = self._sim_before = 0.0  # of the newest state, and what resets have set it back by [s]
        self._last_status_ns = 0
        self._size_at = (0, 0)  # session time, and size of the file then
        #: Session time since the last status of a recorder that has something to write: it may hang.
        self.silence_ns = 0
        #: New since the newest state, by participant and device.
        self._presence: dict[tuple[str, str], PresenceItem] = {}
        #: Reason to hold by robot; `None`: the file does not have it.
        self._holds: dict[str, str | None] = {}
        self._people: dict[str, ParticipantInfo] = {}
        self._ended = False  # nothing more is recorded: the budget is used up

    @property
    def wants_keyframe(self) -> bool:
        """True once there is room again after rows were dropped: verification can continue from the next keyframe."""
        return self._lost and not self._backlog and 2 * self.stats.window_bytes <= self._window_limit

    def send_header(
        self, header: SessionHeader, root: str = "", scene_hash: str = "", robots: tuple[RobotLabels, ...] = ()
    ) -> None:
        """Send the header of the session, once, before the first row. The others: see `SceneAssets`."""
        self._header = messages.encode_header(header)
        self._robots = robots
        self._scene.assets = [SceneAssets(-1, 0, root, scene_hash, robots)]
        self._transfer()

    def send_scene(
        self,
        model_hash: str,
        packed_model: bytes,
        bodies: tuple[BodyInfo, ...],
        root: str = "",
        scene_hash: str = "",
        robots: tuple[RobotLabels, ...] = (),
    ) -> None:
        """Send the model of a scene, before the row that loads it. Later states are of its `bodies` and `robots`."""
        self._vertex_limit.reset()
        self._robots = robots
        self._holds.clear()
        scene = SceneModel(*self._now, model_hash, packed_model, bodies)
        self._send_scene_data(Batch(scenes=[scene], assets=[SceneAssets(*self._now, root, scene_hash, robots)]))

    def send_patch(self, root: str, scene_hash: str) -> None:
        """Send a patched specification of the present scene, before the row that patches it."""
        assets = [SceneAssets(*self._now, root, scene_hash, self._robots)]
        self._send_scene_data(Batch(scenes=self._scene.scenes, assets=assets), Batch(assets=assets))

    def _send_scene_data(self, known: Batch, news: Batch | None = None) -> None:
        """Send scene data. `known`: for recorders that start later; `news`: for the present one, if less than
        `known`."""
        self._end_rest()
        self._rest.reset()
        self.flush()
        self._scene, news = known, known if news is None else news
        self._batch.scenes, self._batch.assets = list(news.scenes), list(news.assets)
        self.flush()

    def add_row(self, row: JournalRow) -> None:
        """Add the row of one step. Flushes after 10 rows or 20 ms of session time."""
        batch = self._batch
        if not batch.rows:
            self._batch_since = row.now_ns
        batch.rows.append(row)
        self._now = (row.step, row.now_ns)
        self._last_status_ns = self._last_status_ns or row.now_ns  # a resumed session does not begin at time zero
        if len(batch.rows) >= BATCH_ROWS or row.now_ns - self._batch_since >= BATCH_NS:
            self.flush()

    def add_keyframe(self, keyframe: Keyframe, chain: bytes) -> None:
        """Add snapshots after the step of the newest row, whose `chain` is given (`header_root` before the first
        row)."""
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
        robots: bytes = b"",
    ) -> bool:
        """Add world poses (n_bodies, 7) `x y z qw qx qy qz` of the header's bodies, at the state rate; presence since
        the last state with it. `robots`: see `StateFrame`. Return whether it is recorded, see `RestFilter`."""
        presence = tuple(self._presence.values())
        self._presence.clear()
        if sim_time < self._sim_time:
            self._sim_before += self._sim_time - sim_time
        self._sim_time = sim_time
        applied = tuple(applied)
        frame = StateFrame(
            step, tick, sim_time, session_time, poses.tobytes(), presence, applied, robots, self._sim_before
        )
        admitted = self._rest.admit_frame(frame, np.concatenate((poses.ravel(), np.frombuffer(robots))))
        for one in admitted:
            self._add(self._batch.states, one)
        return bool(admitted)

    def _end_rest(self) -> None:
        """Add the newest state if it was left out: what comes next has its simulated time, or replaces its scene."""
        for frame in self._rest.take_left_out():
            self._add(self._batch.states, frame)

    def add_decision(self, step: int, session_time: int, decision: Decision) -> None:
        """Add events, denials and changed reasons to hold of one step; its presence is sent with the next state."""
        for item in decision.presence:
            self._presence[item.participant, item.device] = item
        for event in decision.events:
            self._end_rest()
            self._add(self._batch.events, event)
            if isinstance(event.body, ParticipantJoined | ParticipantChanged):
                self._people[event.body.participant.id] = event.body.participant
                if len(self._people) > PEOPLE:
                    del self._people[next(iter(self._people))]
            elif isinstance(event.body, ParticipantLeft):
                for key in [key for key in self._presence if key[0] == event.body.participant]:
                    del self._presence[key]
        for command in decision.commands:
            if self._holds.get(command.robot, "") != command.hold_reason:
                self._holds[command.robot] = command.hold_reason
                self._end_rest()
                self._add(self._batch.holds, HoldRecord(step, session_time, command.robot, command.hold_reason))
        for outgoing in decision.outgoing:
            message = outgoing.message
            if type(message) is Reply and message.denial is not None:
                self._end_rest()
                record = DenialRecord(step, session_time, outgoing.connection, message.denial)
                self._add(self._batch.denials, record)

    def add_metric(self, step: int, session_time: int, name: str, value: float) -> None:
        """Add a scalar, plotted as `/metrics/<name>`."""
        self._add(self._batch.metrics, MetricRecord(step, session_time, name, float(value)))

    def add_vertices(self, stream: str, frame: bytes, session_time: int) -> None:
        """Add a frame (level `full`) of a deformable as published with the state of `session_time`, for the picture.

        Frames beyond `VertexRateLimit` are left out.
        """
        if not self._vertex_limit.admit_frame(stream, read_header(frame).n_vertices, session_time):
            return
        self._end_rest()
        if self._backlog:
            self.stats.dropped_vertices += 1
        else:
            self._add(self._batch.vertices, VertexFrame(stream, session_time, frame))

    def take_gap(self) -> int:
        """Return the rows dropped since the last call: journal them as `Entry(RecordingGap(rows))` and add a
        keyframe."""
        rows, self._gap_rows = self._gap_rows, 0
        return rows

    def flush(self) -> None:
        """Number the pending batch and send what the window allows. Never blocks."""
        if self._ended:
            self._batch = Batch(dropped_rows=self.stats.dropped_rows)
            self._transfer()
            return
        batch = self._batch
        lists: tuple[list[Any], ...] = (batch.states, batch.events, batch.denials, batch.metrics, batch.keyframes)
        lists += (batch.scenes, batch.assets, batch.holds, batch.vertices)
        if self.stats.waiting_bytes > JOURNAL_SHARE * self._backlog_limit:
            self._leave_out_picture(batch)
        if batch.rows or any(lists):
            self._batch = Batch(dropped_rows=self.stats.dropped_rows)
            self._enqueue(messages.encode_batch(batch), len(batch.rows), sum(len(items) for items in lists))
        self._transfer()
        self.silence_ns = self._now[1] - self._last_status_ns if self._window else 0

    def close(
        self,
        timeout_s: float = 5.0,
        alive: Callable[[], bool] = lambda: True,
        silence_s: float = math.inf,
        cpu_s: Callable[[], float] = lambda: 0.0,
    ) -> bool:
        """Send everything and wait until it is in the file.

        Without a header nothing was recorded, and the call does not wait. A second call does nothing.

        Args:
            timeout_s: Longest wait.
            alive: Returns whether the recorder process still runs.
            silence_s: Longest time without a status and without work (`SILENCE_S`, unless the recorder was just
                started).
            cpu_s: Returns the CPU time of the recorder process [s]; while it grows the recorder is slow, not hanging.

        Returns:
            False if not everything is known to be in the file.
        """
        if self._socket.closed:
            return self._complete
        self._end_rest()
        self.flush()
        if self._instance and self._header_sent_to == self._instance:
            self._send(messages.FLUSH, self._next, b"")
        waits = max(1, round(timeout_s / 0.02))
        silent, said = 0, (self.stats.recorder, cpu_s())
        while waits and silent < silence_s / 0.02 and alive() and self._header and (self._window or self._backlog):
            self._socket.poll(20)
            self._transfer()
            waits -= 1
            now = (self.stats.recorder, cpu_s())
            silent = 0 if now != said else silent + 1
            said = now
        self._transfer()  # it may have ended with a last status
        self._complete = not self._window and not self._backlog
        if self._backlog:
            why = "the session ended before the recorder could take it all"
            self._drop(sum(rows for _, rows, _ in self._backlog), sum(others for *_, others in self._backlog), why)
            self._backlog.clear()
        self._socket.close(0)
        self._context.term()
        return self._complete

    def _leave_out_picture(self, batch: Batch) -> None:
        """Leave what the file shows, but verification does not need, out of a batch: the rest is for the journal."""
        for items in (batch.states, batch.metrics, batch.holds):
            self.stats.dropped_items += len(items)
            items.clear()
        self._holds = dict.fromkeys(self._holds)  # what was left out is sent when there is room
        self._rest.reset()

    def _add(self, items: list[_T], item: _T) -> None:
        if len(items) < BATCH_ITEMS:
            items.append(item)
        else:
            self.stats.dropped_items += 1

    def _enqueue(self, body: bytes, rows: int, others: int) -> None:
        if not self._backlog and self.stats.window_bytes < self._window_limit:  # a large model may exceed it
            self._send_batch(body)
        elif self.stats.waiting_bytes + len(body) > self._backlog_limit:
            limit = self._backlog_limit >> 20
            self._drop(rows, others, f"the recorder is behind, and {limit} MiB wait for it, the limit")
        else:
            self._backlog.append((body, rows, others))
            self.stats.waiting_bytes += len(body)

    def _drop(self, rows: int, others: int, why: str) -> None:
        self.stats.dropped_rows += rows
        self.stats.dropped_items += others
        self.stats.drop_reason = why
        self._gap_rows += rows
        self._lost = True
        self._rest.reset()
        self._batch.dropped_rows = self.stats.dropped_rows

    def _send_batch(self, body: bytes) -> None:
        number, self._next = self._next, self._next + 1
        self._window.append((number, body))
        self.stats.window_bytes += len(body)
        if self._instance and self._header_sent_to == self._instance:
            self._send(messages.BATCH, number, body)

    def _send(self, kind: bytes, number: int, *bodies: bytes) -> None:
        """Send a message. A model may have tens of megabytes: to copy it would take several ticks."""
        self._socket.send_multipart((messages.FRAME.pack(kind, number), *bodies), zmq.NOBLOCK, copy=False)

    def _transfer(self) -> None:
        while int(self._socket.get(zmq.EVENTS)) & zmq.POLLIN:
            self._process_status(messages.decode_status(self._socket.recv(zmq.NOBLOCK)))
        for _ in range(BACKLOG_BATCHES):
            if not self._backlog or self.stats.window_bytes >= self._window_limit:
                break
            body, _, _ = self._backlog.popleft()
            self.stats.waiting_bytes -= len(body)
            self._send_batch(body)
        self.stats.waiting_batches = len(self._backlog)

    def _process_status(self, status: RecorderStatus) -> None:
        self.stats.recorder = status
        self._last_status_ns = self._now[1]
        if status.instance != self._instance:
            self._instance = status.instance
            self.stats.recorders += 1
            self._vertex_limit.reset()
            self._rest.reset()  # the picture of a new part begins with a state
            self._size_at = (self._now[1] + RATE_NS // 2, 0)  # after the scene and its assets
        self._measure_rate(status.bytes)
        while self._window and self._window[0][0] <= status.written:
            self.stats.window_bytes -= len(self._window.popleft()[1])
        if status.ended:
            self._end()
        is_able = not status.fault and not status.ended
        if status.expecting < 0 and self._header and self._header_sent_to != self._instance and is_able:
            self._header_sent_to = self._instance
            first = self._window[0][0] if self._window else self._next
            self._scene.people = list(self._people.values())
            self._send(messages.HEADER, first, self._header, messages.encode_batch(self._scene))
            for number, body in self._window:
                self._send(messages.BATCH, number, body)

    def _measure_rate(self, size: int) -> None:
        now_ns, (since_ns, since) = self._now[1], self._size_at
        if now_ns <= since_ns:
            self._size_at = (since_ns, size)
        elif now_ns - since_ns >= RATE_NS:
            self.stats.bytes_per_hour = max(0, size - since) * 3_600_000_000_000 // (now_ns - since_ns)
            self._size_at = (now_ns, size)

    def _end(self) -> None:
        """Discard what waits, and all that comes: the recorder has closed the last file."""
        self._ended, self._lost, self._gap_rows, self.silence_ns = True, False, 0, 0
        self._window.clear()
        self._backlog.clear()
        self.stats.window_bytes = self.stats.waiting_bytes = 0


#: Changes of a state that are not recorded while the scene is at rest: [m], [rad], and in quaternions. Bodies at rest
#: move by some 1e-11.
STILL: Final = 1e-6
#: Time without a larger change after which a scene is at rest, and distance of the states that are recorded then.
REST_NS: Final = 2_000_000_000
REST_STATE_NS: Final = 30_000_000_000


class RestFilter:
    """Leave out states of a scene at rest: those that equal the recorded one within `STILL`, without presence.

    The newest state that was left out is recorded before one that moved, so that readers which interpolate between two
    states see the rest, and then the motion.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Record the next states whatever they are: it is another scene or file, or states were lost."""
        self._recorded: StateFrame | None = None
        self._values: NDArray[np.float64] = np.empty(0)
        self._moved_ns = 0
        self._left_out: StateFrame | None = None

    def admit_frame(self, frame: StateFrame, values: NDArray[np.float64]) -> list[StateFrame]:
        """Return what to record now. `values`: what must not change, NaN for what there is not."""
        is_moving = not self._is_still(frame, values)
        if is_moving:
            self._moved_ns = frame.session_time
        elif frame.session_time - self._moved_ns >= REST_NS and not self._is_due(frame):
            self._left_out = frame
            return []
        left_out = self.take_left_out() if is_moving else []
        self._recorded, self._values, self._left_out = frame, values, None
        return [*left_out, frame]

    def take_left_out(self) -> list[StateFrame]:
        """Return the newest state, if it was left out; it counts as recorded then."""
        frame, self._left_out = self._left_out, None
        if frame is None:
            return []
        self._recorded = frame
        return [frame]

    def _is_due(self, frame: StateFrame) -> bool:
        return self._recorded is None or frame.session_time - self._recorded.session_time >= REST_STATE_NS

    def _is_still(self, frame: StateFrame, values: NDArray[np.float64]) -> bool:
        before = self._recorded
        if before is None or frame.presence or frame.applied != before.applied or values.shape != self._values.shape:
            return False
        is_same = np.abs(values - self._values) <= STILL
        return bool((is_same | (np.isnan(values) & np.isnan(self._values))).all())


#: Minimum time between frames of one deformable: 20 a second look smooth, if all deformables together fit.
PERIOD_NS: Final = 50_000_000
#: Maximum rate of vertices in the file [bytes/s]: about twice that of two operators and fifty bodies.
BYTES_PER_S: Final = 1_000_000
#: Bytes of one vertex of one frame in the file: position and normal, float32.
VERTEX_BYTES: Final = 24


class VertexRateLimit:
    """Limit the frames of deformables in the picture: a rate per deformable, and bytes per second for all of a scene.

    It is applied where vertices are published, so that a frame that is left out costs one comparison.
    """

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._due_ns: dict[str, int] = {}
        self._period_ns = PERIOD_NS

    def reset(self) -> None:
        """Start over: another scene, or a new recorder."""
        self._counts.clear()
        self._due_ns.clear()
        self._period_ns = PERIOD_NS

    def admit_frame(self, stream: str, count: int, session_time: int) -> bool:
        """Return whether a frame of `count` vertices is recorded."""
        if self._counts.get(stream) != count:
            self._counts[stream] = count
            frame_bytes = sum(self._counts.values()) * VERTEX_BYTES
            self._period_ns = max(PERIOD_NS, frame_bytes * 1_000_000_000 // BYTES_PER_S)
        if session_time < self._due_ns.get(stream, 0):
            return False
        # A frame that is a little late, as states are, does not delay those after it.
        self._due_ns[stream] = max(self._due_ns.get(stream, 0), session_time - PERIOD_NS // 4) + self._period_ns
        return True
