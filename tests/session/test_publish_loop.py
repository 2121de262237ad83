"""Publish loop: rate of frames, steps between them, resets, times. Tests own the clock and poll like the helper."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from iris_session.authority import AuthorityConfig
from iris_session.control import ControlConfig
from iris_session.physics.kinematic_model import KinematicModel
from iris_session.protocol.client_messages import Marker
from iris_session.protocol.entries import HOST, Entry, ExternalReset, Join
from iris_session.protocol.names import Role
from iris_session.protocol.server_messages import MarkerAdded, SceneChanged
from iris_session.session.core import CoreConfig, SessionCore
from iris_session.session.errors import OwnershipError
from iris_session.session.pending_state import PendingState
from iris_session.session.publish_loop import REPEAT_NS, PublishedVertices, PublishLoop
from iris_session.session.stepper import Stepper
from tests.session.loops import Watch
from tests.session.published import CLOTH, UNIT, composed
from tests.session.test_stepper import MS, Front, Recorder

PERIOD_NS = 16 * MS


class PublishLoopRig:
    """A publish loop with a clock of the test. Its helper thread runs only after `loop.start()`."""

    def __init__(self, period_ns: int = PERIOD_NS) -> None:
        self.now_ns = 1000 * MS
        scene = composed()
        self.pending = PendingState(scene)
        kinematic_model = KinematicModel(scene.moving, scene.poses)
        config = CoreConfig(AuthorityConfig(user_owned_loop=True), ControlConfig(), (), ())
        core = SessionCore(kinematic_model.model, config)
        self.front, self.recorder = Front(), Recorder(core)
        self.stepper = Stepper(core, self.front, self.recorder, lambda: self.now_ns, MS, 10**15, b"root")
        self.entries: list[Entry] = []
        self.stepper.on_entries = self.entries.extend
        self.shown: list[tuple[float, float, int]] = []  # x of the red box and of a vertex, scene epoch
        self.vertices = PublishedVertices(scene)
        self.stepper.on_publish.append(self._record)
        self.loop = PublishLoop(kinematic_model, self.vertices, self.stepper, Watch(), period_ns)  # type: ignore[arg-type]

    def _record(self, epoch: int, end_ns: int, shown_ns: int) -> None:
        assert self.front.states[-1].session_time == shown_ns, "deformables have the time of the state"
        (mesh,) = self.vertices.meshes
        red = self.stepper.core.world.data.xpos[1]
        self.shown.append((float(red[0]), float(mesh.vertices()[0, 0]), epoch))

    def publish(self, x: float, anew: bool = False, delay_ns: int = 0) -> None:
        self.pending.set_pose("red", (x, 0.0, 0.0), UNIT)
        self.pending.set_vertices("cloth", CLOTH + np.float32(x))
        self.loop.offer(self.pending.make_frame(self.now_ns - delay_ns, self.now_ns * 1e-9, anew))

    def xs(self) -> list[float]:
        return [x for x, _, _ in self.shown]

    def advance(self, ns: int) -> None:
        """Move the clock, and poll as the helper does."""
        self.now_ns += ns
        self.loop.poll()


@pytest.fixture
def rig() -> Iterator[PublishLoopRig]:
    rig = PublishLoopRig()
    yield rig
    rig.loop.close()


def test_composed_scene_is_shown_before_the_first_frame(rig: PublishLoopRig) -> None:
    assert rig.shown == [(0.0, 0.0, 1)]
    assert rig.front.n_bodies == 5
    rig.advance(3600 * 1000 * MS)
    assert len(rig.shown) == 2
    assert rig.front.states[-1].session_time == rig.now_ns, "the composed scene is the current one"
    assert rig.loop.warnings() == ()


def test_poses_and_vertices_of_a_frame_are_published_with_its_time(rig: PublishLoopRig) -> None:
    for x in (1.0, 2.0, 3.0):
        rig.now_ns += PERIOD_NS
        rig.publish(x, delay_ns=5 * MS)
        assert rig.shown[-1] == (x, x, 1)
        assert rig.front.states[-1].session_time == rig.now_ns - 5 * MS
        assert rig.front.states[-1].tick == round(rig.now_ns * 1e-6)
    assert rig.loop.superseded == 0


def test_newest_of_too_many_frames_is_published_and_others_are_counted(rig: PublishLoopRig) -> None:
    for i in range(160):  # 1 kHz for 160 ms, of which the state takes every 16th
        rig.now_ns += MS
        rig.publish(float(i))
    rig.advance(PERIOD_NS)
    assert rig.xs()[-1] == 159.0
    taken = len(rig.shown) - 1
    assert taken <= 12
    assert rig.loop.superseded == 160 - taken
    assert rig.xs() == sorted(rig.xs())


def test_session_steps_while_nothing_is_published(rig: PublishLoopRig) -> None:
    rig.now_ns += 100 * MS
    rig.publish(1.0, delay_ns=40 * MS)
    before = rig.front.states[-1].session_time
    join = Join("key", Role.OBSERVER, "ann", devices=(), alignment="not_needed")
    rig.front.waiting.append(Entry(1, 1, rig.now_ns, join))
    rig.stepper.inputs.post(Marker(0, "quiet"))
    rig.advance(REPEAT_NS)
    assert any(isinstance(e.body, MarkerAdded) for d in rig.front.decisions for e in d.events)
    assert len(rig.shown) == 3
    assert rig.shown[-1] == (1.0, 1.0, 1), "for clients that joined meanwhile"
    assert rig.front.states[-1].session_time == before, "a repeated state keeps its time"
    # In the recording time advances: heads and hands of participants move.
    assert rig.recorder.state_times[-1] == before + REPEAT_NS
    idle = [row for row in rig.recorder.rows if not row.n_ticks]
    assert idle
    assert not any(row.plant for row in idle), "the plant state is in the rows where it changed"
    rig.publish(2.0, delay_ns=60 * MS)
    times = [state.session_time for state in rig.front.states]
    assert times == sorted(times), "time does not go back when the source gets slower"
    assert rig.recorder.state_times == sorted(set(rig.recorder.state_times))


def test_silent_publisher_is_a_warning_until_its_next_frame(rig: PublishLoopRig) -> None:
    for x in range(1, 5):
        rig.now_ns += PERIOD_NS
        rig.publish(float(x), delay_ns=40 * MS)
    shown_ns = rig.now_ns - 40 * MS
    for silence_ms in (900, 1000, 1100):
        sent = len(rig.front.states)
        rig.advance(silence_ms * MS)
        assert len(rig.front.states) > sent
        assert rig.front.states[-1].session_time == shown_ns, "its age includes the silence"
        assert len(rig.loop.warnings()) == (silence_ms > 900)
    (warning,) = rig.loop.warnings()
    assert "3.0 s" in warning
    rig.now_ns += PERIOD_NS
    rig.publish(6.0, delay_ns=40 * MS)
    assert rig.front.states[-1].session_time == rig.now_ns - 40 * MS
    assert rig.loop.warnings() == ()


def test_state_is_not_repeated_between_two_frames_of_a_slow_source(rig: PublishLoopRig) -> None:
    """A client that interpolates would show a repeated pose as a halt."""
    for x in range(1, 5):
        steps = rig.stepper.step_count
        rig.publish(float(x))
        rig.advance(100 * MS)
        assert rig.stepper.step_count > steps + 1
    assert rig.xs() == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_reset_of_a_superseded_frame_comes_with_the_newer_frame(rig: PublishLoopRig) -> None:
    rig.publish(1.0)
    rig.now_ns += MS
    rig.publish(2.0, anew=True)
    rig.publish(3.0)
    assert not any(isinstance(entry.message, ExternalReset) for entry in rig.entries)
    rig.advance(PERIOD_NS)
    assert rig.xs()[-1] == 3.0
    assert [entry.connection for entry in rig.entries if isinstance(entry.message, ExternalReset)] == [HOST]
    assert rig.shown[-1] == (3.0, 3.0, 2)
    changes = [e.body for d in rig.front.decisions for e in d.events if isinstance(e.body, SceneChanged)]
    assert len(changes) == 1


def test_journal_replays_identically_from_any_keyframe(rig: PublishLoopRig) -> None:
    for i in range(6):
        rig.now_ns += 100 * MS
        rig.publish(float(i), anew=i == 3)
        steps = rig.stepper.step_count
        rig.advance(50 * MS)
        assert rig.stepper.step_count > steps
        rig.recorder.wants_keyframe = i == 2
    rig.loop.close()
    assert rig.recorder.verify(0) > rig.recorder.verify(1) > 0


def test_close_publishes_the_pending_frame_and_no_later_one(rig: PublishLoopRig) -> None:
    rig.publish(1.0)
    rig.publish(2.0)
    rig.loop.close()
    assert rig.xs()[-1] == 2.0
    with pytest.raises(OwnershipError, match="closed"):
        rig.publish(3.0)


def test_error_beside_a_step_of_the_helper_is_raised_by_the_next_offer(rig: PublishLoopRig) -> None:
    faults = [OSError("no descriptor left")]

    def break_down(_: object) -> None:
        if faults:  # once: the helper's, not that of the call after it
            raise faults.pop()

    rig.loop._processes.supervise = break_down  # type: ignore[method-assign]
    rig.now_ns += 100 * MS
    rig.loop._run_helper()
    with pytest.raises(OSError, match="no descriptor left"):
        rig.publish(1.0)
