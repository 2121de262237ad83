"""A scene at rest: states are left out, rows wait for others, and nothing of it is lost."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from iris_session.journal import feed as feed_module
from iris_session.journal.feed import REST_NS, REST_STATE_NS, STILL, RestFilter
from iris_session.journal.messages import StateFrame
from iris_session.protocol.client_messages import Heartbeat, Marker
from iris_session.protocol.common import Applied, Pose
from iris_session.protocol.entries import Entry, EntryMessage
from iris_session.protocol.server_messages import Event, MarkerAdded, PresenceItem
from iris_session.protocol.steps import Decision
from iris_session.recording import Recording, header_root, make_row, verify
from iris_session.recording.process import FLUSH_S, REST_FLUSH_S, STATUS_S
from iris_session.rrd.paths import part_path
from tests.recording.support import TICK_NS, LoopRecorder, SmallCore, loop_recorder, make_header

STATE_NS = 16_000_000
SECOND_NS = 1_000_000_000


class Scene:
    """States of a scene with three numbers, at the state rate, and what a filter admits of them."""

    def __init__(self) -> None:
        self.filter = RestFilter()
        self.now_ns = 0
        self.values = np.array([0.0, 1.0, np.nan])
        self.recorded: list[StateFrame] = []

    def show(self, seconds: float = 0.0, **fields: object) -> int:
        """Show states for some time, at least one. Return how many were recorded."""
        until, before = self.now_ns + round(seconds * 1e9), len(self.recorded)
        while True:
            self.now_ns += STATE_NS
            frame = StateFrame(0, 0, 0.0, self.now_ns, b"", **fields)  # type: ignore[arg-type]
            self.recorded += self.filter.admit_frame(frame, self.values.copy())
            if self.now_ns >= until:
                return len(self.recorded) - before

    def times(self) -> list[int]:
        return [frame.session_time for frame in self.recorded]


@pytest.fixture
def scene() -> Scene:
    """A scene at rest."""
    made = Scene()
    assert made.show(3.0) == REST_NS // STATE_NS
    return made


def test_a_scene_at_rest_has_a_state_every_half_minute(scene: Scene) -> None:
    assert 9 <= scene.show(300.0) <= 10
    assert max(np.diff(scene.times())) < REST_STATE_NS + STATE_NS


@pytest.mark.parametrize("at", [0, 1])
def test_the_rest_is_recorded_up_to_its_end(scene: Scene, at: int) -> None:
    scene.show(5.0)
    still_ns = scene.now_ns
    scene.values[at] += 2 * STILL
    assert scene.show() == 2
    assert scene.times()[-2:] == [still_ns, still_ns + STATE_NS]
    assert scene.show(1.9) > 110, "it is recorded as before until it rests again"


def test_a_slow_motion_is_recorded_to_a_micrometre(scene: Scene) -> None:
    scene.values[0] += 0.9 * STILL
    assert scene.show() == 0
    scene.values[0] += 0.9 * STILL
    assert scene.show() == 2


@pytest.mark.parametrize("value", [np.nan, 1.0])
def test_what_there_is_or_is_no_more_has_moved(scene: Scene, value: float) -> None:
    scene.values[1 if np.isnan(value) else 2] = value
    assert scene.show() == 2


def test_another_number_of_values_is_another_state(scene: Scene) -> None:
    scene.values = np.zeros(5)
    assert scene.show() == 2


def test_people_and_samples_are_motion(scene: Scene) -> None:
    head = PresenceItem("p1", "head", Pose((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)), 5)
    assert scene.show(presence=(head,)) == 2
    applied = (Applied("left", "p1", "hand/left", 5, 6, 7, 8),)
    assert scene.show(3.0, applied=applied) > 100
    assert scene.show(1.0, applied=applied) == 0, "the newest sample stays applied while a robot rests"
    assert scene.show() == 2


def test_a_new_file_or_scene_begins_with_a_state(scene: Scene) -> None:
    scene.filter.reset()
    assert scene.show() == 1


# --- in the feed of a session, and the loop of its recorder -----------------------------------------------------------


class RestingSession:
    """A session at rest: steps whose times jitter, states that do not change, and what the test says at a step."""

    def __init__(self, recorder: LoopRecorder, keyframe_s: float = 1e9) -> None:
        self.recorder, self.feed = recorder, recorder.feed
        self.core, self.random = SmallCore(), random.Random(0)
        header = make_header()
        self.chain = header_root(header)
        self.step = 0
        self.now_ns = 0
        self.wall_s = 0.0
        self._keyframe_ns = self._next_keyframe_ns = round(keyframe_s * 1e9)
        self._next_state_ns = 0
        self.poses = np.tile((0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0), (len(header.bodies), 1))
        self.feed.send_header(header)
        self.feed.add_keyframe(self.core.keyframe(-1), self.chain)

    def take(self, messages: Sequence[EntryMessage] = (), decision: Decision | None = None) -> None:
        """Take a step."""
        self.now_ns = max(self.now_ns + 1, self.step * TICK_NS + round(self.random.gauss(0.0, 20_000.0)))
        entries = [Entry(3, 3, self.now_ns, message) for message in messages]
        if self.now_ns >= self._next_state_ns:
            self._next_state_ns += STATE_NS
            self.feed.add_state(self.step, self.step, self.step * 2e-3, self.now_ns, self.poses)
        row = make_row(self.chain, self.step, self.now_ns, 1, entries, self.core.step(self.now_ns, entries, 1))
        self.chain = row.chain
        if decision is not None:
            self.feed.add_decision(self.step, self.now_ns, decision)
        self.feed.add_row(row)
        if self.now_ns >= self._next_keyframe_ns:
            self._next_keyframe_ns += self._keyframe_ns
            self.feed.add_keyframe(self.core.keyframe(self.step), self.chain)
        self.step += 1

    def rest(self, seconds: float) -> None:
        """Take steps, and let the loop of the recorder write what is due, on the same clock."""
        for _ in range(round(seconds * 1e9) // TICK_NS):
            self.take()
            if self.step % 15 == 0:
                self.write_due()

    def write_due(self) -> None:
        """Let the recorder receive all that was sent, and write what is due."""
        loop = self.recorder.loop
        self.feed.flush()
        while loop._feed.poll(0 if self.feed._window and loop._received >= self.feed._window[-1][0] else 1000):
            loop._has_news = bool(loop._drain()) or loop._has_news
            if loop._received == self.feed._next - 1:
                break
        loop._write_due(self.now_ns * 1e-9)
        while self.feed._socket.poll(0):
            self.feed.flush()

    def begin(self) -> None:
        """Let the recorder begin, and the scene come to rest."""
        while not self.feed._socket.poll(20):  # until the sockets have found each other
            self.recorder.loop._send_status(-1)
        self.rest(2.5)


@pytest.fixture
def one() -> Iterator[LoopRecorder]:
    with loop_recorder() as found:
        yield found


@pytest.fixture
def session(one: LoopRecorder) -> RestingSession:
    made = RestingSession(one)
    made.begin()
    return made


def read_steps(one: LoopRecorder) -> list[int]:
    with Recording.open(one.path, warn=False) as recording:
        return [row.step for row in recording.rows()]


def test_rows_at_rest_wait_for_others(session: RestingSession, one: LoopRecorder) -> None:
    sizes = set()
    for _ in range(20):
        session.rest(0.5)
        sizes.add(one.loop._writer.stream.size)
    assert 4 <= len(sizes) <= 6
    assert len(read_steps(one)) > session.step - 2000 * REST_FLUSH_S


@pytest.mark.parametrize(
    ("messages", "waits"),
    [((Heartbeat(False),), True), ((Heartbeat(False), Heartbeat(True)), True), ((Marker(1, "m"),), False)],
)
def test_only_heartbeats_wait(
    session: RestingSession, one: LoopRecorder, messages: Sequence[EntryMessage], waits: bool
) -> None:
    while one.loop._rest_at - session.now_ns * 1e-9 < 1.5:
        session.rest(0.03)
    session.take(messages)
    step = session.step - 1
    session.rest(FLUSH_S + 0.03)
    assert (step not in read_steps(one)) == waits


def test_a_step_that_crashed_and_a_keyframe_do_not_wait(session: RestingSession, one: LoopRecorder) -> None:
    while one.loop._rest_at - session.now_ns * 1e-9 < 1.5:
        session.rest(0.03)
    session.feed.add_keyframe(session.core.keyframe(session.step - 1), session.chain)
    step = session.step - 1
    session.rest(FLUSH_S + 0.03)
    assert max(read_steps(one)) >= step
    session.feed.add_row(make_row(session.chain, session.step, session.now_ns + 1, 1, [], b""))
    session.feed.flush()
    one.loop._feed.poll(30_000)
    one.loop._drain()
    one.loop._write_due(session.now_ns * 1e-9 + FLUSH_S)
    assert read_steps(one)[-1] == session.step


def test_rows_that_wait_are_not_confirmed_and_a_killed_recorder_loses_none(
    session: RestingSession, one: LoopRecorder
) -> None:
    while one.loop._rest_at - session.now_ns * 1e-9 < 1.5:
        session.rest(0.03)
    session.rest(1.0)  # with two statuses meanwhile
    assert STATUS_S < 1.0
    assert max(read_steps(one)) < session.step - 400
    one.kill()
    session.take()
    one.begin(2)
    one.pump()
    session.rest(1.0)
    one.finish()
    report = verify(one.path, SmallCore)
    assert (report.ok, report.parts, report.gaps) == (True, 2, []), report.line()
    assert report.last_step > session.step - 100
    with Recording([part_path(str(one.path), 2)]) as recording:
        assert list(recording.states()), "the picture of the second part begins with a state"


@pytest.mark.parametrize("has_state", [True, False])
def test_the_end_of_a_session_waits_for_nothing(session: RestingSession, one: LoopRecorder, has_state: bool) -> None:
    while one.loop._rest_at - session.now_ns * 1e-9 < 1.5:
        session.rest(0.03)
    session.rest(0.3)
    if not has_state:
        session.feed._rest.reset()
    session.feed.close(0.0)
    one.loop._feed.poll(30_000)
    one.loop._drain()
    one.loop._write_due(session.now_ns * 1e-9 + FLUSH_S)
    assert read_steps(one) == list(range(session.step))
    with Recording.open(one.path, warn=False) as recording:
        is_newest = list(recording.states())[-1].step > session.step - 10
    assert is_newest == has_state


def test_the_newest_state_is_recorded_before_a_scene_and_an_event(session: RestingSession, one: LoopRecorder) -> None:
    session.rest(3.0)
    marker = Event(1, session.step, session.now_ns, MarkerAdded("p1", "now"))
    session.take(decision=Decision(commands=(), events=(marker,)))
    event_step = session.step - 1
    session.rest(3.0)
    session.feed.send_patch("", "")
    patch_step = session.step
    session.rest(0.3)
    one.pump()
    one.finish()
    with Recording.open(one.path) as recording:
        steps = [state.step for state in recording.states()]
    for step in (event_step, patch_step):
        assert any(step - 10 < one <= step for one in steps), step
    assert sum(patch_step <= one for one in steps) > 10, "states begin anew with the scene"
    assert len(steps) < 200


def test_an_hour_at_rest_is_small(one: LoopRecorder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feed_module, "RATE_NS", 10 * SECOND_NS)
    session = RestingSession(one, keyframe_s=5.0)
    session.begin()
    session.rest(2.5)
    before, since_ns = one.loop._writer.size_with_index, session.now_ns
    assert session.feed.stats.bytes_per_hour == 0, "scene and assets come first"
    session.rest(32.0)  # with a state
    per_hour = (one.loop._writer.size_with_index - before) * 3600e9 / (session.now_ns - since_ns)
    assert per_hour < 20e6
    assert session.feed.stats.bytes_per_hour == pytest.approx(per_hour, rel=0.3)
    one.pump()
    one.finish()
    assert verify(one.path, None).ok
