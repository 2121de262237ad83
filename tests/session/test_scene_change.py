"""Scene changes in a core and a stepper: identical replay, and snapshots across the change."""

from __future__ import annotations

import mujoco
import pytest

from iris_session import Session
from iris_session.demo.scenes import n_arms_scene, scene_path
from iris_session.physics import FoundRobots, Pacer, find_objects, find_robots
from iris_session.physics.load import compute_scene_hash, decode_model, encode_model
from iris_session.protocol.entries import SceneLoaded
from iris_session.session.core import SessionCore
from iris_session.session.errors import ConfigError, OwnershipError
from iris_session.session.scene_change import adopt_timestep, prepare_scene
from iris_session.session.shared_scene import SharedScenes
from iris_session.session.tick_times import TickTimes
from tests.session.play import TICK_NS, entries, host, make_core
from tests.session.test_session import QUIET
from tests.session.test_stepper import Rig

AT = 90  # step of the change: Ann's clutch is closed since step 50


def bench_scene(timestep: float = 0.002) -> mujoco.MjModel:
    spec = n_arms_scene(2, objects=3)
    spec.option.timestep = timestep
    return spec.compile()


def loaded(model: mujoco.MjModel, state: bytes = b"") -> SceneLoaded:
    return SceneLoaded(compute_scene_hash(encode_model(model)), find_robots(model).robots, find_objects(model), state)


def with_models(*models: mujoco.MjModel) -> SessionCore:
    """Return a core that can build the scenes that are loaded later, as a replay does."""
    first = make_core()
    known = {compute_scene_hash(encode_model(m)): bytes(encode_model(m)) for m in models}
    return SessionCore(first.world.model, first.config, lambda model_hash: decode_model(known[model_hash]))


def play(core: SessionCore, first: int, last: int, change: SceneLoaded) -> list[bytes]:
    digests = []
    for i in range(first, last):
        now_ns = (i + 1) * TICK_NS
        begin = [host(now_ns, change)] if i == AT else []
        digests.append(core.step(now_ns, begin + entries(i, 1 if i < AT else 2), 1).digest)
    return digests


@pytest.mark.parametrize(("at", "timestep"), [(40, 0.001), (AT + 1, 0.002), (130, 0.001)])
def test_restoring_a_snapshot_before_or_after_a_scene_change(at: int, timestep: float) -> None:
    model = bench_scene(timestep)
    scene = loaded(model)
    straight = with_models(model)
    play(straight, 0, at, scene)
    state = straight.snapshot()
    expected = play(straight, at, 150, scene)
    fresh, later = with_models(model), with_models(model)
    fresh.restore(state)
    play(later, 0, 140, scene)
    later.restore(state)  # back over the change, or within the new scene
    assert play(fresh, at, 150, scene) == expected
    assert play(later, at, 150, scene) == expected
    straight.restore(straight.snapshot())
    assert straight.snapshot() == fresh.snapshot()


def test_loop_uses_the_timestep_of_a_new_scene_at_once() -> None:
    rig = Rig()
    rig.steps(30)
    pacer = Pacer(TICK_NS, rig.stepper.clock())
    times = TickTimes(TICK_NS, rig.stepper.clock)
    scene = prepare_scene(rig.stepper.core, SharedScenes(False, "test"), bench_scene(0.001), b"", FoundRobots(()), None)
    rig.stepper.inputs.queue_scene(scene)
    assert not adopt_timestep(rig.stepper, pacer, times, pacer.next_deadline_ns)
    rig.steps(1)
    assert adopt_timestep(rig.stepper, pacer, times, pacer.next_deadline_ns)
    assert (pacer.period_ns, times.compute_lateness()) == (1_000_000, None)
    assert pacer.next_deadline_ns == rig.stepper.clock() + 1_000_000
    stats = pacer.get_stats(rig.stepper.clock())
    assert (stats.finished, stats.late, stats.missing) == (1, 0, 0)
    assert not adopt_timestep(rig.stepper, pacer, times, pacer.next_deadline_ns)


@pytest.mark.usefixtures("simulation")
def test_load_scene_requires_a_running_session(model: mujoco.MjModel) -> None:
    session = Session(str(scene_path("handover")))
    with pytest.raises(OwnershipError, match="run"):
        session.load_scene(bench_scene())
    with Session(str(scene_path("handover")), config=QUIET) as run:
        run.run(seconds=0.01)
        with pytest.raises(ConfigError, match=r"robots\[0\] is 3"):
            run.load_scene(bench_scene(), robots=[3])  # type: ignore[list-item]
        change = run.load_scene(bench_scene())  # between two runs
        change.result(timeout=60)
        run.run(seconds=0.05)
        assert run.objects == find_objects(bench_scene())
    with Session(model, mujoco.MjData(model), config=QUIET) as mine:
        mine.begin_tick()
        with pytest.raises(OwnershipError, match="loop"):
            mine.load_scene(bench_scene())
        mine.end_tick()
