"""`Stepper`: one step of a live session. Gathers entries, runs the core, sends the results, journals. No pacing.

Session time is stamped here, once per step, and passed to the pure core. Link and feed bound everything that is sent,
and count what they drop.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType, TracebackType
from typing import Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.journal.feed import RecorderFeed
from iris_session.journal.messages import RobotLabels
from iris_session.journal.rows import CRASHED, Keyframe, make_row
from iris_session.link import FrontLink
from iris_session.physics import World
from iris_session.protocol.client_messages import Control, Episode, EStop, GetSnapshot, Marker
from iris_session.protocol.common import MAX_TEXT, Pose
from iris_session.protocol.entries import (
    HOST,
    Entry,
    EntryMessage,
    Join,
    PhysicsDiverged,
    RecordingGap,
    ScenePatched,
    SessionResumed,
    decode_entry,
    encode_entry,
)
from iris_session.protocol.names import ControlAction, DenialReason, EpisodeAction, LateCause
from iris_session.protocol.server_messages import ROBOT_STATES, EpisodeChanged, Reply, RobotState, StateHeader
from iris_session.protocol.specs import RobotSpec
from iris_session.protocol.steps import Decision
from iris_session.session.core import Plant, SessionCore, StepOutcome, ignore_lap
from iris_session.session.deformables import DeformableSourceMesh
from iris_session.session.errors import OwnershipError
from iris_session.session.session_view import SessionView
from iris_session.session.shared_scene import SharedScene

#: Pending host entries; a script that posts more in one step gets an error.
MAX_HOST_ENTRIES: Final = 256
#: Room for as many more: e-stops, and entries of the session itself, which are a few a step.
RESERVED_HOST_ENTRIES: Final = 64
#: Pending scenes and patches; a step loads one.
MAX_PENDING_SCENES: Final = 64
#: Requests that wait for the owner of a user loop; more replace the oldest.
MAX_REQUESTS: Final = 64
#: Lost rows are logged at most this often; each loss is an event too.
GAP_LOG_PERIOD_NS: Final = 10_000_000_000

_log = logging.getLogger(__name__)


class NextScene(NamedTuple):
    """A scene that is to replace the present one. `packed_model`: for the recording; `shown`: for clients; `notices`:
    what is unclear about its robots, a line each.
    """

    plant: Plant
    model_hash: str
    packed_model: bytes
    shown: SharedScene
    deformables: Sequence[DeformableSourceMesh] = ()
    notices: tuple[str, ...] = ()


class NextPatch(NamedTuple):
    """A visual change of the scene. `shown`: the scene after it, for clients."""

    message: ScenePatched
    shown: SharedScene


class PendingInputs:
    """Queues for the next steps: inputs of the session's owner, scenes and patches. From any thread.

    Attributes:
        messages: Inputs of the owner and of the session itself, oldest first.
        scenes: Scenes and patches, each for a step of its own.
    """

    def __init__(self) -> None:
        self.messages: deque[EntryMessage] = deque()
        self.scenes: deque[NextScene | NextPatch] = deque()

    def post(self, message: EntryMessage) -> None:
        """Queue an input of the session's owner for the next step. Texts are cut to the length of a `Text`.

        Raises:
            ValueError: A value that the protocol does not allow.
            OwnershipError: The queue is full; an e-stop is accepted all the same.
        """
        is_full = len(self.messages) >= MAX_HOST_ENTRIES
        if is_full and isinstance(message, EStop) and any(isinstance(one, EStop) for one in self.messages.copy()):
            return  # an e-stop waits already
        if is_full and not isinstance(message, EStop):
            raise OwnershipError(f"queue of inputs full ({MAX_HOST_ENTRIES} wait for one step): is the loop running?")
        self.post_own(message)

    def post_own(self, message: EntryMessage) -> None:
        """Queue an entry of the session itself; it has room reserved beside what the owner has posted."""
        if len(self.messages) >= MAX_HOST_ENTRIES + RESERVED_HOST_ENTRIES:
            raise RuntimeError(f"queue of inputs full ({len(self.messages)} wait for one step): is the loop running?")
        self.messages.append(normalize_message(message))

    def queue_scene(self, scene: NextScene | NextPatch) -> None:
        """Load a scene or patch with the next step, each with a step of its own.

        Raises:
            RuntimeError: The queue is full.
        """
        if len(self.scenes) >= MAX_PENDING_SCENES:
            raise RuntimeError(f"queue of scene changes full ({MAX_PENDING_SCENES}): is the loop running?")
        self.scenes.append(scene)


class OwnerRequest(msgspec.Struct, frozen=True):
    """A request of a participant that only the owner of a user loop can fulfil, from `Session.poll_requests`.

    Attributes:
        kind: `reset`: put the scene into its initial state. `rerecord`: the same; the running episode was discarded,
            and the next one starts with the reset.
        participant: Id of the participant.
        name: Its name.
        label: Text of an episode.
        session_time_s: When it was asked [s].
    """

    kind: str
    participant: str
    name: str = ""
    label: str = ""
    session_time_s: float = 0.0


class ResumedFrom(NamedTuple):
    """Newest step and session time of the recording that is resumed. `anchors`: new poses; empty: as they were.
    `is_gap_known`: session time went on while the session was down.
    """

    step: int
    now_ns: int
    anchors: Mapping[str, Pose] = MappingProxyType({})
    is_gap_known: bool = True


class Stepper:
    """Drives one `SessionCore` against a front and a recorder.

    Args:
        core: The session as a pure function.
        front: Link to the front process.
        recorder: Feed of the recorder, `None` to record nothing.
        clock: Returns session time [ns].
        state_period_ns: How often rigid state is published and recorded.
        keyframe_period_ns: Distance of keyframes in the recording.
        chain: `header_root` of the recording's header (any bytes when nothing is recorded).
        resumed_from: The end of the recording that `core` was restored from.

    Attributes:
        inputs: Queues of the owner's inputs.
        last: Outcome of the newest step.
        view: Participants, leases and events so far.
        requests: What participants ask of the owner of a user loop, oldest first.
        lateness_ns: Worst lateness of a tick since the last recorded state, set by the pacing loop.
        on_scene: Called with a scene or patch before the step that loads it.
        on_publish: Called after a state was published, with scene epoch and the times of `publish_now`.
        on_state: Called with what was published; for measurements and tests.
        on_entries: Called with the entries of every step; for measurements and tests.
        on_decision: Called after every step with its decision and entries; for the task.
        list_notices: Returns what is said of robots that can only be watched; a denial to take one says it, too.
        on_lap: Called after each part of a step with the `LateCause` that its time counts as. The pacing loop sets it.
    """

    def __init__(
        self,
        core: SessionCore,
        front: FrontLink,
        recorder: RecorderFeed | None,
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
        self.inputs = PendingInputs()
        self.on_scene: list[Callable[[NextScene | NextPatch], None]] = []
        self._state_period_ns = state_period_ns
        self._keyframe_period_ns = keyframe_period_ns
        self._next_state_ns = 0
        self._next_keyframe_ns = 0
        self._lost_rows = self._next_gap_log_ns = 0
        self._chain = chain
        self.view = SessionView()
        self.requests: deque[OwnerRequest] = deque(maxlen=MAX_REQUESTS)
        self.lateness_ns = 0
        self.on_publish: list[Callable[[int, int, int], None]] = []
        self.on_state: Callable[[StateHeader, NDArray[np.float64]], None] | None = None
        self.on_entries: Callable[[Sequence[Entry]], None] | None = None
        self.on_decision: Callable[[Decision, Sequence[Entry]], None] | None = None
        self.list_notices: Callable[[], Sequence[str]] = tuple
        self.on_lap: Callable[[str], None] = ignore_lap
        self._resumed_from = resumed_from
        self._last_now_ns = -1 if resumed_from is None else resumed_from.now_ns
        self._poses = np.zeros((len(core.world.bodies), 7))
        #: A client reads the states of the robots: from then on they are published.
        self._publishes_robots = False

    @property
    def paused(self) -> bool:
        return self.last is not None and self.last.decision.paused

    def step(self, n_ticks: int, plant: bytes = b"", *, publish: bool = True) -> StepOutcome:
        """Take one step now.

        After a step that raised, or that Ctrl-C interrupted, every further call raises the same error (`end_error`):
        half a step is in no journal, and what followed would not fit it.

        Args:
            n_ticks: Ticks of physics, 0 or more.
            plant: See `SessionCore.step` (open sessions).
            publish: Publish the state when it is due. False: the state of this step does not exist yet, the caller
                publishes it later.
        """
        self.raise_if_ended()
        try:
            return self._step(n_ticks, plant, publish)
        except BaseException as error:
            self.end(error)
            raise

    def end(self, error: BaseException) -> None:
        """End the session by an error: every later step raises it. From any thread."""
        if self._ended is None:
            self._ended, self._ended_at = end_error(error), error.__traceback__

    def raise_if_ended(self) -> None:
        """Raise what has ended the session in an earlier step."""
        if self._ended is not None:
            raise self._ended.with_traceback(self._ended_at)  # else it would grow each time

    @property
    def has_ended(self) -> bool:
        """Return whether a step has raised."""
        return self._ended is not None

    def _step(self, n_ticks: int, plant: bytes, publish: bool) -> StepOutcome:
        now_ns = self.clock()
        if now_ns <= self._last_now_ns:  # one step per instant: session time strictly grows
            now_ns = self._last_now_ns + 1
        if self.last is None and self._resumed_from is not None:
            n_ticks = 0  # it may be paused
        entries = self._gather(now_ns)
        if self.last is None:
            self._record_keyframe(now_ns)
        self._last_now_ns = now_ns
        try:
            outcome = self.core.step(now_ns, entries, n_ticks, plant, digest=self.recorder is not None, lap=self.on_lap)
        except Exception:
            if self.recorder is not None:  # the steps before the error matter most in the recording
                self.recorder.add_row(make_row(self._chain, self.step_count, now_ns, n_ticks, entries, CRASHED, plant))
                self.recorder.flush()
            raise
        end_ns = self.clock()
        if self.on_entries is not None:
            self.on_entries(entries)
        for entry in entries:
            if isinstance(entry.message, Join) and ROBOT_STATES in entry.message.capabilities:
                self._publishes_robots = True
        if outcome.diverged and (self.last is None or not self.last.diverged):
            self.inputs.post_own(PhysicsDiverged(outcome.decision.scene_epoch, outcome.diverged[:MAX_TEXT]))
            self.inputs.post_own(Marker(request_id=0, text=f"physics stands still until a reset: {outcome.diverged}"))
        outcome = self._explain_denials(outcome)
        self.last = outcome
        self.front.send_decision(self.step_count, outcome.decision)
        self._newest_step = self.step_count
        if publish:
            self.publish(end_ns)
        self.view.apply_step(outcome.decision, outcome.status)
        for outgoing in outcome.decision.outgoing:  # replies to requests of the owner, which does not wait for them
            denial = outgoing.message.denial if isinstance(outgoing.message, Reply) else None
            if outgoing.connection == HOST and denial is not None:
                _log.warning("the session denied its owner: %s; %s", denial.message, denial.advice or denial.reason)
        if self.on_decision is not None:
            self.on_decision(outcome.decision, entries)
        if entries and self.core.config.authority.user_owned_loop:
            self._collect_requests(entries, outcome.decision)
        if self.recorder is not None:
            self._record(self.recorder, now_ns, n_ticks, entries, plant)
        self.step_count += 1
        self.on_lap(LateCause.OUTPUT)
        return outcome

    def _gather(self, now_ns: int) -> list[Entry]:
        """Return the entries of a step, host entries first. The authority sees a long gap in `now_ns`."""
        entries = self.front.poll()
        host: list[Entry] = []
        if self.last is None and self._resumed_from is not None:
            # The view is empty: it gets the participants by a snapshot, as a client does.
            past = self._resumed_from
            begin = (SessionResumed(now_ns - past.now_ns, dict(past.anchors), past.is_gap_known), GetSnapshot())
            host += [Entry(HOST, HOST, now_ns, message) for message in begin]
        if self.inputs.scenes:
            host += [Entry(HOST, HOST, now_ns, message) for message in self._announce_scene()]
        while self.inputs.messages:
            host.append(Entry(HOST, HOST, now_ns, self.inputs.messages.popleft()))
        return host + entries if host else entries

    def _announce_scene(self) -> Sequence[EntryMessage]:
        """Give the next scene or patch to recorder, front and callbacks before its step; return its entries."""
        scene = self.inputs.scenes.popleft()
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
                robots = label_robots(scene.plant.scene.robots, scene.plant.world)
                self.recorder.send_scene(scene.model_hash, scene.packed_model, bodies, *assets, robots)
            messages = (scene.plant.scene, GetSnapshot())  # the view gets the new leases as a client does
        for callback in self.on_scene:
            callback(scene)
        return messages

    def _collect_requests(self, entries: Sequence[Entry], decision: Decision) -> None:
        """Keep what the authority has left to the owner of a user loop: granted, or denied as `user_owned`."""
        for entry in entries:
            m = entry.message
            if isinstance(m, Control) and m.action == ControlAction.RESET:
                kind, label = m.action, ""
            elif isinstance(m, Episode) and m.action in (EpisodeAction.RESET, EpisodeAction.RERECORD):
                kind, label = m.action, m.label
            else:
                continue
            for outgoing in decision.outgoing:
                reply = outgoing.message
                if outgoing.connection != entry.connection or not isinstance(reply, Reply):
                    continue
                denial = reply.denial
                is_left = denial is None or denial.reason == DenialReason.USER_OWNED
                if kind == EpisodeAction.RERECORD and denial is None:
                    is_left = any(isinstance(e.body, EpisodeChanged) and e.body.verdict for e in decision.events)
                if reply.request_id == m.request_id and is_left and entry.connection != HOST:
                    sender = self.core.authority.find_sender(entry.connection)
                    self.requests.append(OwnerRequest(kind, *sender, label, entry.receive_ns * 1e-9))
                    break

    def is_state_due(self, end_ns: int) -> bool:
        """Return whether `publish` would publish now."""
        return self.last is not None and end_ns >= self._next_state_ns

    def make_state_due(self) -> None:
        """Publish the state after the next step, whenever the newest one was published."""
        self._next_state_ns = min(self._next_state_ns, self.clock())

    def publish(self, end_ns: int) -> None:
        """Publish the rigid state if it is due. `end_ns`: session time of the end of the tick it belongs to."""
        if not self.is_state_due(end_ns):
            return
        # Aims at a fixed rate; after a long gap it starts over instead of sending a burst.
        self._next_state_ns = max(self._next_state_ns + self._state_period_ns, end_ns)
        self.publish_now(end_ns)

    def publish_now(self, end_ns: int, shown_ns: int = -1) -> None:
        """Publish the rigid state, for a caller that keeps the rate itself. A step must have been taken.

        Args:
            end_ns: As for `publish`.
            shown_ns: For a state that is published again, the `end_ns` it was published with first.
        """
        assert self.last is not None
        decision, world = self.last.decision, self.core.world
        world.read_poses(self._poses)
        applied = tuple(s.applied for s in self.last.status if s.applied is not None)
        tick, sim_time = world.view().tick, world.view().sim_time
        shown_ns = end_ns if shown_ns < 0 else shown_ns
        header = StateHeader(
            decision.scene_epoch, decision.scene_revision, tick, sim_time, shown_ns, 0, 0, 0, applied
        )  # fmt: skip
        self.front.send_state(header, self._poses, self._read_robots())
        for callback in self.on_publish:
            callback(decision.scene_epoch, end_ns, shown_ns)
        if self.on_state is not None:
            self.on_state(header, self._poses)
        if self.recorder is not None:
            robots = world.robot_signals.read(world.data)
            if self.recorder.add_state(self._newest_step, tick, sim_time, end_ns, self._poses, applied, robots):
                self.recorder.add_metric(self._newest_step, end_ns, "lateness_ms", self.lateness_ns * 1e-6)
                self.lateness_ns = 0

    def _read_robots(self) -> tuple[RobotState, ...]:
        """Return the states of the robots once a client reads them; before, and without robots, nothing."""
        if not self._publishes_robots:
            return ()
        world = self.core.world
        return world.robot_states.read(world.data, world.view(), self.core.controller.get_goals())

    def _explain_denials(self, outcome: StepOutcome) -> StepOutcome:
        """Say in denials why a robot can only be watched: the authority knows those that can be driven."""
        outgoing = list(outcome.decision.outgoing)
        for i, one in enumerate(outgoing):
            denial = one.message.denial if isinstance(one.message, Reply) else None
            if denial is not None and denial.reason == DenialReason.UNKNOWN_TARGET:
                start = f"robot {denial.target!r} "
                text = next((notice for notice in self.list_notices() if notice.startswith(start)), denial.message)
                denial = msgspec.structs.replace(denial, message=text[:MAX_TEXT])
                outgoing[i] = msgspec.structs.replace(one, message=msgspec.structs.replace(one.message, denial=denial))
        if not outgoing:
            return outcome
        decision = msgspec.structs.replace(outcome.decision, outgoing=tuple(outgoing))
        return msgspec.structs.replace(outcome, decision=decision)

    def _record(
        self, recorder: RecorderFeed, now_ns: int, n_ticks: int, entries: Sequence[Entry], plant: bytes
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
            self._lost_rows += lost
            if now_ns >= self._next_gap_log_ns:
                _log.warning("gap in the recording: %d rows are lost", self._lost_rows)
                self._lost_rows, self._next_gap_log_ns = 0, now_ns + GAP_LOG_PERIOD_NS
            self.inputs.post_own(RecordingGap(lost))
        if recorder.wants_keyframe or now_ns >= self._next_keyframe_ns:
            self._record_keyframe(now_ns)

    def _record_keyframe(self, now_ns: int) -> None:
        """Record the state after the newest step (first: before any), so that verification can begin there."""
        if self.recorder is None:
            return
        self._next_keyframe_ns = now_ns + self._keyframe_period_ns
        state = self.core.snapshot()
        step = self.step_count if self.last is not None else self.step_count - 1
        frame = Keyframe(step, state.plant, state.authority, state.controller, state.status)
        self.recorder.add_keyframe(frame, self._chain)


def label_robots(robots: Sequence[RobotSpec], world: World) -> tuple[RobotLabels, ...]:
    """Return the names of the values that `world.robot_signals` reads."""
    units = world.robot_signals.units
    return tuple(RobotLabels(r.name, r.base_body, r.joints, u) for r, u in zip(robots, units, strict=True))


def normalize_message(message: EntryMessage) -> EntryMessage:
    """Return a message as it is journaled, checked as the front checks clients' messages.

    Front and recorder would end at an input that breaks a limit.

    Raises:
        ValueError: A value that the protocol does not allow.
    """
    try:
        texts = {name: getattr(message, name, "") for name in ("text", "reason", "label")}
        cut = {name: text[: MAX_TEXT - 3] + "..." for name, text in texts.items() if len(text) > MAX_TEXT}
        short: EntryMessage = msgspec.structs.replace(message, **cut) if cut else message
        # What is journaled is what is used: whole numbers in float fields become floats, lists tuples.
        return decode_entry(encode_entry(Entry(HOST, HOST, 0, short))).message
    except (TypeError, OverflowError, msgspec.ValidationError) as error:
        raise ValueError(f"{type(message).__name__} cannot be used: {error}") from error


def end_error(error: BaseException) -> Exception:
    """Return the error for callers after the one that failed: the same, but not an interrupt, which was not theirs."""
    if isinstance(error, Exception):
        return error
    ended = OwnershipError("a step was broken off by an interrupt, so the session cannot go on: close it")
    ended.__cause__ = error
    return ended


def make_session_clock(origin_ns: int) -> Callable[[], int]:
    """Return the clock of session time [ns]: CLOCK_MONOTONIC minus the origin, equal in all processes of a machine."""
    return lambda: time.monotonic_ns() - origin_ns
