"""One step of a live session: gathers entries, runs the core, sends the results out, journals. No pacing, no threads.

Session time is stamped here, once per step, and handed to the pure core. Everything that goes out is bounded by the
ports behind it (front link, recorder feed); what they drop they count.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType, TracebackType
from typing import Final, NamedTuple, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.client_messages import Control, EStop, GetSnapshot, Marker
from iris_session.protocol.common import MAX_TEXT, Applied, Pose
from iris_session.protocol.entries import (
    HOST,
    Entry,
    EntryMessage,
    RecordingGap,
    ScenePatched,
    SessionResumed,
    decode_entry,
    encode_entry,
)
from iris_session.protocol.names import LateCause
from iris_session.protocol.server_messages import BodyInfo, StateHeader
from iris_session.protocol.steps import Decision
from iris_session.recording.journal import CRASHED, JournalRow, Keyframe, make_row
from iris_session.session.core import Plant, SessionCore, StepOutcome, unmeasured
from iris_session.session.deformables import Bending
from iris_session.session.errors import OwnershipError
from iris_session.session.shared_scene import Shown
from iris_session.session.status import SessionLedger

#: Host entries waiting for the next step; a script that posts more in one step is refused with an error.
MAX_HOST_ENTRIES: Final = 256
#: As many more are kept for e-stops, and for what the session says itself: a few a step.
ROOM_FOR_OURS: Final = 64
#: Scenes and patches that wait; a step takes one.
MAX_SCENES: Final = 64


class FrontPort(Protocol):
    """What the stepper needs of the front process."""

    def poll(self) -> list[Entry]: ...

    def send_decision(self, step: int, decision: Decision) -> None: ...

    def send_state(self, header: StateHeader, poses: NDArray[np.float64]) -> None: ...


class RecorderPort(Protocol):
    """What the stepper needs of the recorder's feed."""

    @property
    def wants_keyframe(self) -> bool: ...

    def send_scene(
        self,
        model_hash: str,
        packed_model: bytes,
        bodies: tuple[BodyInfo, ...],
        root: str = "",
        scene_hash: str = "",
    ) -> None: ...

    def send_patch(self, root: str, scene_hash: str) -> None: ...

    def add_row(self, row: JournalRow) -> None: ...

    def flush(self) -> None: ...

    def add_keyframe(self, keyframe: Keyframe, chain: bytes) -> None: ...

    def add_state(
        self,
        step: int,
        tick: int,
        sim_time: float,
        session_time: int,
        poses: NDArray[np.float64],
        applied: Sequence[Applied] = (),
    ) -> None: ...

    def add_decision(self, step: int, session_time: int, decision: Decision) -> None: ...

    def add_metric(self, name: str, value: float) -> None: ...

    def take_gap(self) -> int: ...


class NextScene(NamedTuple):
    """A scene that is to take the place of the present one. `packed_model`: to be recorded; `shown`: to clients;
    `bending`: what bends in it."""

    plant: Plant
    model_hash: str
    packed_model: bytes
    shown: Shown
    bending: Sequence[Bending] = ()


class NextPatch(NamedTuple):
    """A change of what is drawn. `shown`: to clients after it."""

    message: ScenePatched
    shown: Shown


class ResumedFrom(NamedTuple):
    """What a session goes on from: newest step and session time of its recording. `anchors`: where they are, when that
    was given anew; empty: as they were."""

    step: int
    now_ns: int
    anchors: Mapping[str, Pose] = MappingProxyType({})


class Stepper:
    """Drives one `SessionCore` against a front and a recorder.

    `clock` gives session time in nanoseconds. `state_period_ns`: how often rigid state is published and recorded.
    `chain`: `header_root` of the recording's header (any bytes when nothing is recorded). `resumed_from`: of the
    recording that `core` goes on from.
    """

    def __init__(
        self,
        core: SessionCore,
        front: FrontPort,
        recorder: RecorderPort | None,
        clock: Callable[[], int],
        state_period_ns: int,
        keyframe_period_ns: int,
        chain: bytes = b"",
        resumed_from: ResumedFrom | None = None,
    ) -> None:
        self.core = core
        self.front = front
        self.recorder = recorder
        self.clock = clock
        self.step_count = 0 if resumed_from is None else resumed_from.step + 1
        self._newest_step = 0
        self.last: StepOutcome | None = None
        self._ended: Exception | None = None
        self._ended_at: TracebackType | None = None
        self._host: deque[EntryMessage] = deque()
        self._scenes: deque[NextScene | NextPatch] = deque()
        #: Called with another scene before the step that loads it.
        self.on_scene: list[Callable[[NextScene | NextPatch], None]] = []
        self._state_period_ns = state_period_ns
        self._keyframe_period_ns = keyframe_period_ns
        self._next_state_ns = 0
        self._next_keyframe_ns = 0
        self._chain = chain
        self.ledger = SessionLedger()
        #: Worst lateness of a tick since the last published state, for the recording's plots. Set by the pacing loop.
        self.lateness_ns = 0
        #: Called after a state was published with its scene epoch and the times of `publish_now`: streams beside it.
        self.beside_state: list[Callable[[int, int, int], None]] = []
        #: Called with what was published, and with the entries of every step: for measurements and tests.
        self.on_state: Callable[[StateHeader, NDArray[np.float64]], None] | None = None
        self.on_entries: Callable[[Sequence[Entry]], None] | None = None
        #: Called after each part of a step with the `LateCause` that its time counts as. Set by the pacing loop.
        self.lap: Callable[[str], None] = unmeasured
        self._resumed_from = resumed_from
        self._last_now_ns = -1 if resumed_from is None else resumed_from.now_ns
        self._poses = np.zeros((len(core.world.bodies), 7))

    @property
    def paused(self) -> bool:
        return self.last is not None and self.last.decision.paused

    def post(self, message: EntryMessage) -> None:
        """Queues an input of the session's owner for the next step. Thread-safe (`deque.append`).

        Texts are cut to the length of a `Text`. Raises `ValueError` for anything else that the protocol does not take,
        `OwnershipError` when too many wait; an e-stop is not refused for that.
        """
        if len(self._host) >= MAX_HOST_ENTRIES and not isinstance(message, EStop):
            raise OwnershipError(f"more than {MAX_HOST_ENTRIES} inputs wait for one step: is the loop running?")
        self.say(message)

    def say(self, message: EntryMessage) -> None:
        """As `post`, of what befell the session itself: whatever its owner has posted, there is room for it."""
        if len(self._host) >= MAX_HOST_ENTRIES + ROOM_FOR_OURS:
            raise RuntimeError(f"{len(self._host)} inputs wait for one step: is the loop running?")
        self._host.append(checked(message))

    def change_scene(self, scene: NextScene | NextPatch) -> None:
        """Another scene, or another look of it, from the next step on. From any thread; of several that wait each gets
        a step of its own. Raises `RuntimeError` when too many do."""
        if len(self._scenes) >= MAX_SCENES:
            raise RuntimeError(f"more than {MAX_SCENES} changes of the scene wait: is the loop running?")
        self._scenes.append(scene)

    def step(self, n_ticks: int, plant: bytes = b"", *, publish: bool = True) -> StepOutcome:
        """Takes one step now. `plant`: see `SessionCore.step` (open sessions).

        `publish` false: the state that this step leads to is not there yet, its maker calls `publish` when it is.
        After one that raised, or that Ctrl-C broke off, no step is taken any more, whoever asks for it: half a step is
        in no journal, and what followed would not fit it. What ended the first is raised again (`ended_by`).
        """
        if self._ended is not None:
            raise self._ended.with_traceback(self._ended_at)  # which would grow with every time that it is raised
        try:
            return self._step(n_ticks, plant, publish)
        except BaseException as error:
            self._ended, self._ended_at = ended_by(error), error.__traceback__
            raise

    def _step(self, n_ticks: int, plant: bytes, publish: bool) -> StepOutcome:
        now_ns = self.clock()
        if now_ns <= self._last_now_ns:  # one step per instant: session time strictly grows
            now_ns = self._last_now_ns + 1
        if self.last is None and self._resumed_from is not None:
            n_ticks = 0  # it may be paused
        entries = self._gather(now_ns)
        if self.last is None:
            self._keyframe(now_ns)
        self._last_now_ns = now_ns
        try:
            outcome = self.core.step(now_ns, entries, n_ticks, plant, digest=self.recorder is not None, lap=self.lap)
        except Exception:
            if self.recorder is not None:  # what led to it is worth more than all before
                self.recorder.add_row(make_row(self._chain, self.step_count, now_ns, n_ticks, entries, CRASHED, plant))
                self.recorder.flush()
            raise
        end_ns = self.clock()
        if self.on_entries is not None:
            self.on_entries(entries)
        anew = self.last is None or not self.last.diverged
        if outcome.diverged and (anew or not (plant or outcome.decision.paused)):  # no resume but by a reset
            if not plant:  # a user's loop is not ours to pause
                self.say(Control(request_id=0, action="pause"))
            self.say(Marker(request_id=0, text=f"physics stands still until a reset: {outcome.diverged}"))
        self.last = outcome
        self.front.send_decision(self.step_count, outcome.decision)
        self._newest_step = self.step_count
        if publish:
            self.publish(end_ns)
        self.ledger.follow(outcome.decision, outcome.status)
        if self.recorder is not None:
            self._record(self.recorder, now_ns, n_ticks, entries, plant)
        self.step_count += 1
        self.lap(LateCause.OUTPUT)
        return outcome

    def _gather(self, now_ns: int) -> list[Entry]:
        """Host entries first. A long time between two steps is no entry: the authority sees it in `now_ns`."""
        entries = self.front.poll()
        host: list[Entry] = []
        if self.last is None and self._resumed_from is not None:
            # The ledger knows nobody yet: it learns the roster as a client would.
            past = self._resumed_from
            begin = (SessionResumed(now_ns - past.now_ns, dict(past.anchors)), GetSnapshot())
            host += [Entry(HOST, HOST, now_ns, message) for message in begin]
        if self._scenes:
            host += [Entry(HOST, HOST, now_ns, message) for message in self._announce_scene()]
        while self._host:
            host.append(Entry(HOST, HOST, now_ns, self._host.popleft()))
        return host + entries if host else entries

    def _announce_scene(self) -> Sequence[EntryMessage]:
        """Hands the next scene or patch to everybody who must have it before the step."""
        scene = self._scenes.popleft()
        messages: Sequence[EntryMessage]
        assets = scene.shown.info.asset_root, scene.shown.info.scene_hash
        if isinstance(scene, NextPatch):
            if self.recorder is not None:
                self.recorder.send_patch(*assets)
            messages = (scene.message,)
        else:
            self.core.prepared[scene.model_hash] = scene.plant
            bodies = scene.plant.world.bodies
            self._poses = np.zeros((len(bodies), 7))
            if self.recorder is not None:
                self.recorder.send_scene(scene.model_hash, scene.packed_model, bodies, *assets)
            messages = (scene.plant.scene, GetSnapshot())  # the ledger gets the new leases as a client would
        for follow in self.on_scene:
            follow(scene)
        return messages

    def publish(self, end_ns: int) -> None:
        """Sends the rigid state when it is due. `end_ns`: session time of the end of the tick it belongs to."""
        if self.last is None or end_ns < self._next_state_ns:
            return
        # Aims at a fixed rate; after a long gap it starts over instead of sending a burst.
        self._next_state_ns = max(self._next_state_ns + self._state_period_ns, end_ns)
        self.publish_now(end_ns)

    def publish_now(self, end_ns: int, shown_ns: int = -1) -> None:
        """Sends the rigid state, for somebody who keeps the rate himself. A step must have been taken.

        `end_ns`: as of `publish`. `shown_ns`: of a state that is sent again, the `end_ns` with which it was sent first.
        """
        assert self.last is not None
        decision, world = self.last.decision, self.core.world
        world.poses(self._poses)
        applied = tuple(s.applied for s in self.last.status if s.applied is not None)
        tick, sim_time = world.view().tick, world.view().sim_time
        shown_ns = end_ns if shown_ns < 0 else shown_ns
        header = StateHeader(
            decision.scene_epoch, decision.scene_revision, tick, sim_time, shown_ns, 0, 0, 0, applied
        )  # fmt: skip
        self.front.send_state(header, self._poses)
        for send in self.beside_state:
            send(decision.scene_epoch, end_ns, shown_ns)
        if self.on_state is not None:
            self.on_state(header, self._poses)
        if self.recorder is not None:
            self.recorder.add_state(self._newest_step, tick, sim_time, end_ns, self._poses, applied)
            self.recorder.add_metric("lateness_ms", self.lateness_ns * 1e-6)
            self.lateness_ns = 0

    def _record(
        self, recorder: RecorderPort, now_ns: int, n_ticks: int, entries: Sequence[Entry], plant: bytes
    ) -> None:
        assert self.last is not None
        row = make_row(self._chain, self.step_count, now_ns, n_ticks, entries, self.last.digest, plant)
        self._chain = row.chain
        decision = self.last.decision
        if decision.events or decision.outgoing or decision.presence:
            recorder.add_decision(self.step_count, now_ns, decision)
        recorder.add_row(row)
        lost = recorder.take_gap()
        if lost:
            self.say(RecordingGap(lost))
        if recorder.wants_keyframe or now_ns >= self._next_keyframe_ns:
            self._keyframe(now_ns)

    def _keyframe(self, now_ns: int) -> None:
        """Stores the state after the newest step, first that before any, so that verification can begin there."""
        if self.recorder is None:
            return
        self._next_keyframe_ns = now_ns + self._keyframe_period_ns
        state = self.core.snapshot()
        step = self.step_count if self.last is not None else self.step_count - 1
        frame = Keyframe(step, state.plant, state.authority, state.controller, state.status)
        self.recorder.add_keyframe(frame, self._chain)


def checked(message: EntryMessage) -> EntryMessage:
    """What a client's message has passed in the front: front and recorder would end at an input that breaks a limit.

    Raises `ValueError`.
    """
    try:
        texts = {name: getattr(message, name, "") for name in ("text", "reason", "label")}
        cut = {name: text[: MAX_TEXT - 3] + "..." for name, text in texts.items() if len(text) > MAX_TEXT}
        short: EntryMessage = msgspec.structs.replace(message, **cut) if cut else message
        # What is journaled is what is used: whole numbers in float fields become floats, lists tuples.
        return decode_entry(encode_entry(Entry(HOST, HOST, 0, short))).message
    except (TypeError, OverflowError, msgspec.ValidationError) as error:
        raise ValueError(f"{type(message).__name__} cannot be used: {error}") from error


def ended_by(error: BaseException) -> Exception:
    """What whoever goes on after an error is told: that error, unless it was an interrupt, which is not theirs."""
    if isinstance(error, Exception):
        return error
    ended = OwnershipError("a step was broken off by an interrupt, so the session cannot go on: close it")
    ended.__cause__ = error
    return ended


def session_clock(origin_ns: int) -> Callable[[], int]:
    """Session time [ns]: CLOCK_MONOTONIC minus the origin, the same in every process of this machine."""
    return lambda: time.monotonic_ns() - origin_ns
