"""Frames of a publisher in the session: their rate, what is between them, resets, times. The clock is the test's."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from iris_session.authority import AuthorityConfig
from iris_session.control import ControlConfig
from iris_session.physics.carrier import Carrier
from iris_session.protocol.client_messages import Marker
from iris_session.protocol.entries import HOST, Entry, ExternalReset, Join, decode_entries
from iris_session.protocol.names import Role
from iris_session.protocol.server_messages import MarkerAdded, SceneChanged
from iris_session.recording.journal import CRASHED
from iris_session.session.core import CoreConfig, CoreState, SessionCore
from iris_session.session.draft import Frame, SceneDraft
from iris_session.session.errors import OwnershipError
from iris_session.session.publish_loop import REPEAT_NS, PublishedVertices, PublishLoop
from iris_session.session.stepper import Stepper
from tests.session.loops import Watch, wait_for
from tests.session.published import CLOTH, UNIT, composed
from tests.session.test_stepper import MS, Front, Recorder

PERIOD_NS = 16 * MS


class Rig:
    """A publisher's loop whose clock the test moves; the helper thread is real."""

    def __init__(self, period_ns: int = PERIOD_NS) -> None:
        self.now_ns = 1000 * MS
        scene = composed()
        self.draft = SceneDraft(scene)
        carrier = Carrier(scene.moving, scene.poses)
        config = CoreConfig(AuthorityConfig(user_owned_loop=True), ControlConfig(), (), ())
        self.config, self.model = config, carrier.model
        self.front, self.recorder = Front(), Recorder()
        core = SessionCore(carrier.model, config)
        self.stepper = Stepper(core, self.front, self.recorder, lambda: self.now_ns, MS, 10**15, b"root")
        self.entries: list[Entry] = []
        self.stepper.on_entries = self._note
        self.shown: list[tuple[float, float, int]] = []  # x of the red box and of a vertex, scene epoch
        self.vertices = PublishedVertices(scene)
        self.stepper.on_publish.append(self._show)
        self.loop = PublishLoop(carrier, self.vertices, self.stepper, Watch(), period_ns)  # type: ignore[arg-type]

    def _note(self, entries: Sequence[Entry]) -> None:
        self.entries += entries

    def _show(self, epoch: int, end_ns: int, shown_ns: int) -> None:
        assert self.front.states[-1].session_time == shown_ns, "what bends has the time of the state"
        (mesh,) = self.vertices.meshes
        red = self.stepper.core.world.data.xpos[1]
        self.shown.append((float(red[0]), float(mesh.vertices()[0, 0]), epoch))

    def publish(self, x: float, anew: bool = False, delay_ns: int = 0) -> None:
        self.draft.set_pose("red", (x, 0.0, 0.0), UNIT)
        self.draft.set_vertices("cloth", CLOTH + np.float32(x))
        self.loop.offer(self.draft.make_frame(self.now_ns - delay_ns, self.now_ns * 1e-9, anew))

    def xs(self) -> list[float]:
        return [x for x, _, _ in self.shown]


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.loop.close()


def test_who_joins_before_the_first_frame_sees_the_scene_as_composed(rig: Rig) -> None:
    assert rig.shown == [(0.0, 0.0, 1)]
    assert rig.front.n_bodies == 5
    rig.now_ns += 3600 * 1000 * MS
    wait_for(lambda: len(rig.shown) == 2)
    assert rig.front.states[-1].session_time == rig.now_ns, "nobody has said that it is otherwise: it is so now"
    assert rig.loop.warnings() == ()


def test_poses_and_vertices_of_a_frame_go_out_together_with_its_time(rig: Rig) -> None:
    for x in (1.0, 2.0, 3.0):
        rig.now_ns += PERIOD_NS
        rig.publish(x, delay_ns=5 * MS)
        wait_for(lambda x=x: rig.shown[-1] == (x, x, 1))  # type: ignore[misc]
        assert rig.front.states[-1].session_time == rig.now_ns - 5 * MS
        assert rig.front.states[-1].tick == round(rig.now_ns * 1e-6)
    assert rig.loop.superseded == 0


def test_of_frames_that_come_too_fast_the_newest_wins_and_the_others_are_counted(rig: Rig) -> None:
    for i in range(160):  # 1 kHz for 160 ms, of which the state takes every 16th
        rig.now_ns += MS
        rig.publish(float(i))
    rig.now_ns += PERIOD_NS
    wait_for(lambda: rig.xs()[-1] == 159.0)
    taken = len(rig.shown) - 1
    assert taken <= 12
    assert rig.loop.superseded == 160 - taken
    assert rig.xs() == sorted(rig.xs())


def test_a_frame_that_comes_before_its_time_is_shown_when_it_is_due(rig: Rig) -> None:
    rig.publish(1.0)
    rig.now_ns += PERIOD_NS - 2 * MS  # jitter of a source with about the rate of the state
    rig.publish(2.0)
    assert rig.xs()[-1] == 1.0
    rig.now_ns += 2 * MS
    wait_for(lambda: rig.xs()[-1] == 2.0)
    assert rig.loop.superseded == 0


def test_while_nothing_is_published_the_session_goes_on(rig: Rig) -> None:
    rig.now_ns += 100 * MS
    rig.publish(1.0, delay_ns=40 * MS)
    before = rig.front.states[-1].session_time
    join = Join("key", Role.OBSERVER, "ann", devices=(), alignment="not_needed")
    rig.front.waiting.append(Entry(1, 1, rig.now_ns, join))
    rig.stepper.post(Marker(0, "quiet"))
    rig.now_ns += REPEAT_NS
    wait_for(lambda: any(isinstance(e.body, MarkerAdded) for d in rig.front.decisions for e in d.events))
    wait_for(lambda: len(rig.shown) == 3)
    assert rig.shown[-1] == (1.0, 1.0, 1), "for those who joined meanwhile"
    assert rig.front.states[-1].session_time == before, "as old as the source is"
    # People go on: their heads and hands are recorded with it.
    wait_for(lambda: rig.recorder.state_times[-1] == before + REPEAT_NS)
    idle = [row for row in rig.recorder.rows if not row.n_ticks]
    assert idle
    assert not any(row.plant for row in idle), "the plant's state is in the rows where it changed"
    rig.publish(2.0, delay_ns=60 * MS)
    times = [state.session_time for state in rig.front.states]
    assert times == sorted(times), "a source that got slower does not make time go back"
    assert rig.recorder.state_times == sorted(set(rig.recorder.state_times))


def test_frames_that_waited_while_the_source_was_silent_keep_their_times(rig: Rig) -> None:
    """A robot's link that hangs for half a second, and then brings everything: no two poses a nanosecond apart."""
    rig.now_ns += PERIOD_NS
    rig.publish(1.0, delay_ns=5 * MS)
    begun_ns, sent = rig.now_ns, len(rig.front.states)
    rig.now_ns += 2 * REPEAT_NS
    wait_for(lambda: len(rig.front.states) > sent)
    captured = [begun_ns + n * PERIOD_NS for n in range(20)]
    first = len(rig.front.states)
    for n, capture_ns in enumerate(captured):
        rig.publish(2.0 + n, delay_ns=rig.now_ns - capture_ns)
        rig.now_ns += PERIOD_NS
    assert [state.session_time for state in rig.front.states[first:]] == captured
    assert rig.recorder.state_times == sorted(set(rig.recorder.state_times)), "what was recorded is in its order"


def test_a_publisher_that_falls_silent_is_said_until_it_speaks(rig: Rig) -> None:
    for x in range(1, 5):
        rig.now_ns += PERIOD_NS
        rig.publish(float(x), delay_ns=40 * MS)
    shown_ns = rig.now_ns - 40 * MS
    for silence_ms in (900, 1000, 1100):
        sent = len(rig.front.states)
        rig.now_ns += silence_ms * MS
        wait_for(lambda sent=sent: len(rig.front.states) > sent)  # type: ignore[misc]
        assert rig.front.states[-1].session_time == shown_ns, "its age is that of the silence"
        assert len(rig.loop.warnings()) == (silence_ms > 900)
    assert rig.loop.warnings() == ("nothing was published for 3.0 s: the program that publishes stands still",)
    rig.now_ns += PERIOD_NS
    rig.publish(6.0, delay_ns=40 * MS)
    assert rig.front.states[-1].session_time == rig.now_ns - 40 * MS
    assert rig.loop.warnings() == ()


def test_states_between_two_frames_of_a_slow_source_are_not_repeated(rig: Rig) -> None:
    """A pose that is seen twice is a halt for whoever interpolates."""
    for x in range(1, 5):
        steps = rig.stepper.step_count
        rig.publish(float(x))
        rig.now_ns += 100 * MS
        wait_for(lambda steps=steps: rig.stepper.step_count > steps + 1)  # type: ignore[misc]
    assert rig.xs() == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_a_state_of_a_low_rate_is_not_repeated_between_two_frames() -> None:
    rig = Rig(period_ns=1000 * MS)
    try:
        for x in range(1, 31):  # ten a second, of which the state takes one
            steps = rig.stepper.step_count
            rig.now_ns += 100 * MS
            rig.publish(float(x))
            wait_for(lambda steps=steps: rig.stepper.step_count > steps)  # type: ignore[misc]
        assert len(set(rig.xs())) == len(rig.xs())
    finally:
        rig.loop.close()


def test_a_reset_is_told_with_the_frame_that_brings_it_even_when_that_one_is_superseded(rig: Rig) -> None:
    rig.publish(1.0)
    rig.now_ns += MS
    rig.publish(2.0, anew=True)
    rig.publish(3.0)
    assert not any(isinstance(entry.message, ExternalReset) for entry in rig.entries)
    rig.now_ns += PERIOD_NS
    wait_for(lambda: rig.xs()[-1] == 3.0)
    assert [entry.connection for entry in rig.entries if isinstance(entry.message, ExternalReset)] == [HOST]
    assert rig.shown[-1] == (3.0, 3.0, 2)
    changes = [e.body for d in rig.front.decisions for e in d.events if isinstance(e.body, SceneChanged)]
    assert len(changes) == 1


def test_the_journal_gives_the_same_again_from_any_keyframe(rig: Rig) -> None:
    for i in range(6):
        rig.now_ns += 100 * MS
        rig.publish(float(i), anew=i == 3)
        steps = rig.stepper.step_count
        rig.now_ns += 50 * MS
        wait_for(lambda steps=steps: rig.stepper.step_count > steps)  # type: ignore[misc]
        rig.recorder.wants_keyframe = i == 2
    rig.loop.close()
    (_, keyframe, *_) = rig.recorder.keyframes
    for state in (None, keyframe):
        core = SessionCore(rig.model, rig.config)
        first = 0
        if state is not None:
            core.restore(CoreState(state.plant, state.authority, state.controller, state.status))
            first = state.step + 1
        rows = [row for row in rig.recorder.rows if row.step >= first]
        assert rows
        for row in rows:
            entries = decode_entries(row.entries)
            assert core.step(row.now_ns, entries, row.n_ticks, row.plant).digest == row.digest


def test_the_last_frame_is_shown_at_the_end_and_none_after_it(rig: Rig) -> None:
    rig.publish(1.0)
    rig.publish(2.0)
    rig.loop.close()
    assert rig.xs()[-1] == 2.0
    with pytest.raises(OwnershipError, match="closed"):
        rig.publish(3.0)


class Late:
    """A lock before which the session is closed, once: `publish` was under way in another thread."""

    def __init__(self, rig: Rig) -> None:
        self._lock, self._closes = threading.Lock(), [threading.Thread(target=rig.loop.close)]

    def __enter__(self) -> None:
        while self._closes:
            thread = self._closes.pop()
            thread.start()
            thread.join()
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


def test_a_publish_that_was_under_way_at_the_end_takes_no_step_after_it(rig: Rig) -> None:
    """Front and recorder are gone then."""
    rig.publish(1.0)
    rig.now_ns += PERIOD_NS
    rig.loop._pending_lock = Late(rig)  # type: ignore[assignment]
    with pytest.raises(OwnershipError, match="closed"):
        rig.publish(2.0)
    assert rig.xs()[-1] == 1.0


def test_no_step_follows_one_that_failed_in_the_publishers_thread(rig: Rig) -> None:
    rig.publish(1.0)
    steps = rig.stepper.core.step

    def broken(*_: object, **__: object) -> None:
        rig.stepper.core.step = steps  # type: ignore[method-assign]
        raise KeyError("the core is broken")

    with rig.loop.lock:  # the helper waits
        rig.now_ns += 100 * MS
        rig.stepper.core.step = broken  # type: ignore[method-assign,assignment]
        with pytest.raises(KeyError, match="broken"):
            rig.publish(2.0)
    rows = len(rig.recorder.rows)
    assert rig.recorder.rows[-1].digest == CRASHED
    rig.loop._helper.join(10.0)
    depths = []
    for _ in range(3):
        with pytest.raises(KeyError, match="broken") as caught:
            rig.publish(3.0)
        depths.append(len(caught.traceback))
    assert len(set(depths)) == 1, "who tries again and again does not fill the memory"
    rig.loop.close()
    assert len(rig.recorder.rows) == rows


def test_ctrl_c_within_a_step_ends_the_session_and_the_journal_before_it(rig: Rig) -> None:
    rig.publish(1.0)
    steps = rig.stepper.core.step

    def interrupted(*_: object, **__: object) -> None:
        rig.stepper.core.step = steps  # type: ignore[method-assign]
        raise KeyboardInterrupt

    with rig.loop.lock:  # the helper waits
        rig.now_ns += 100 * MS
        rig.stepper.core.step = interrupted  # type: ignore[method-assign,assignment]
        with pytest.raises(KeyboardInterrupt):
            rig.publish(2.0)
    rows = len(rig.recorder.rows)
    with pytest.raises(OwnershipError, match="broken off by an interrupt"):
        rig.publish(3.0)
    rig.loop.close()
    assert len(rig.recorder.rows) == rows
    assert rig.recorder.rows[-1].digest != CRASHED, "nothing of the step is at fault"


def test_what_was_shown_is_not_sent_again_when_something_newer_has_just_come(rig: Rig) -> None:
    rig.now_ns += PERIOD_NS
    rig.publish(1.0)
    wait_for(lambda: rig.xs()[-1] == 1.0)
    step, publishers = rig.stepper.step, [threading.Thread(target=rig.publish, args=(2.0,))]

    def meanwhile(n_ticks: int, plant: bytes = b"", *, publish: bool = True) -> None:
        if n_ticks == 0 and publishers:
            publisher = publishers.pop()
            publisher.start()
            publisher.join()  # it finds the lock taken, and leaves its frame
        step(n_ticks, plant, publish=publish)

    rig.stepper.step = meanwhile  # type: ignore[method-assign,assignment]
    rig.now_ns += REPEAT_NS
    wait_for(lambda: rig.xs()[-1] == 2.0)
    assert rig.xs() == [0.0, 1.0, 2.0]


def test_what_stops_the_helper_is_raised_where_it_is_seen(rig: Rig) -> None:
    def broken() -> list[Entry]:
        raise RuntimeError("the link is broken")

    rig.front.poll = broken  # type: ignore[method-assign]
    rig.now_ns += 100 * MS
    wait_for(lambda: rig.loop._error)
    with pytest.raises(RuntimeError, match="the link is broken"):
        rig.loop.offer(Frame(rig.now_ns, 1.0, np.zeros((5, 7)), {}))
    rig.loop.close()  # what comes after it must go on
