"""A `ScenePublisher` in a process: what clients receive, resets, its end; and files that are shown without physics."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from anchors.pose import compose
from iris_session.assets.store import AssetStore
from iris_session.client.deformables import Deformables
from iris_session.protocol.scene import decode_scene
from iris_session.protocol.server_messages import SceneChanged
from iris_session.session.deformables import BOUND_M
from iris_session.streams.rigid import MAX_POSITION_ERROR_M, MAX_ROTATION_ERROR_RAD
from tests.e2e import publisher_program
from tests.e2e.scenario import Scenario
from tests.e2e.session_process import SessionProcess, assert_all_end, kill_all, list_descendants, run_command

pytestmark = pytest.mark.e2e

#: Added to the error bounds of the stream, for times and products.
ROUNDING = 1e-6


@pytest.fixture
def scenario(tmp_path: Path) -> Iterator[Scenario]:
    folder = tmp_path / "server"
    folder.mkdir()
    recording = folder / "session.rrd"
    command = [sys.executable, publisher_program.__file__, str(recording), str(folder)]
    server = SessionProcess(folder, recording, command)
    scenario = Scenario(server)
    yield scenario
    scenario.close()
    kill_all([server])


class CheckingObserver:
    """An observer that compares each state and frame with the world at its time."""

    def __init__(self, scenario: Scenario, name: str, stream: str) -> None:
        self.client = scenario.join(name, role="observer")
        self.shapes = Deformables(self.client)
        self.feed = self.client.media.subscribe(stream)
        self.poses = self.vertices = 0
        self._time_of: dict[int, float] = {}  # session time -> simulated time
        self._seen = -1

    def check(self) -> None:
        state = self.client.scene.state
        if state is not None and state.header.state_seq != self._seen:
            self._seen = state.header.state_seq
            self._time_of[state.header.session_time] = state.header.sim_time
            if state.header.sim_time > 0.0:
                self._check_poses(state.poses, state.header.sim_time)
                self.poses += 1
        moved = self.shapes.update()
        assert self.shapes.fault == ""
        frame = self.feed.newest
        if moved and frame is not None and self._time_of.get(frame.header.capture_ns, 0.0) > 0.0:
            away = self.shapes.vertices["cloth"] - publisher_program.make_cloth(self._time_of[frame.header.capture_ns])
            assert np.linalg.norm(away, axis=1).max() <= BOUND_M + ROUNDING
            self.vertices += 1

    def _check_poses(self, poses: np.ndarray, t: float) -> None:
        ball, crate, base, upper, fore = poses
        self._assert_close(ball, (*publisher_program.get_ball_position(t), *publisher_program.rotate(t, 0)))
        self._assert_close(crate, (0.0, 2.0, 0.2, 1.0, 0.0, 0.0, 0.0))
        self._assert_close(base, (0.0, -1.0, 0.5, 1.0, 0.0, 0.0, 0.0))
        T_world_upper = ((0.0, -1.0, 0.6), publisher_program.rotate(publisher_program.get_joint_angle(t), 2))
        self._assert_close(upper, (*T_world_upper[0], *T_world_upper[1]))
        p, q = compose(T_world_upper, ((0.4, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))  # type: ignore[arg-type]
        self._assert_close(fore, (*p, *q))

    @staticmethod
    def _assert_close(seen: np.ndarray, expected: tuple[float, ...]) -> None:
        assert np.linalg.norm(seen[:3] - expected[:3]) <= MAX_POSITION_ERROR_M + ROUNDING
        dot = min(1.0, abs(float(seen[3:] @ np.array(expected[3:]))))
        assert 2.0 * np.arccos(dot) <= MAX_ROTATION_ERROR_RAD + ROUNDING


def check_more(scenario: Scenario, observers: list[CheckingObserver], more: int = 20) -> None:
    """Wait until each has checked `more` states and shapes."""
    goals = [(w.poses + more, w.vertices + more) for w in observers]

    def enough() -> bool:
        for observer in observers:
            observer.check()
        return all(w.poses >= p and w.vertices >= v for w, (p, v) in zip(observers, goals, strict=True))

    scenario.run_until(enough, "all observers receive the moving world")


def test_observers_receive_poses_and_vertices_of_a_world_without_mujoco(scenario: Scenario, tmp_path: Path) -> None:
    composed = publisher_program.build_scene(tmp_path).build(AssetStore(tmp_path / "store"))
    stream = composed.deformables["cloth"].stream
    ann = CheckingObserver(scenario, "ann", stream)
    check_more(scenario, [ann])
    late = CheckingObserver(scenario, "late", stream)
    check_more(scenario, [ann, late])

    client = late.client
    client.assets.cache = AssetStore(tmp_path / "cache")
    assert client.mirror.scene_hash == composed.scene_hash, "the scene of the builder"
    fetch = client.assets.fetch([composed.scene_hash])
    scenario.run_until(lambda: fetch.done, "the specification was received")
    spec = decode_scene(fetch.read(composed.scene_hash))
    assert spec == composed.spec
    assert tuple(body.name for body in client.mirror.bodies) == publisher_program.NAMES
    assert {body.id: body.name for body in spec.bodies if body.moving} == {b.id: b.name for b in client.mirror.bodies}

    (scenario.server.folder / "back").touch()
    scenario.run_until(lambda: client.mirror.scene_epoch == ann.client.mirror.scene_epoch == 2, "a new scene epoch")
    check_more(scenario, [ann, late])
    assert sum(isinstance(event.body, SceneChanged) for event in scenario.events["ann"]) == 1

    children = list_descendants(scenario.server.process.pid)
    scenario.server.kill()
    scenario.run_until(lambda: not any(c.connection.is_joined for c in scenario.clients), "both have disconnected")
    assert all("session_ended" in c.connection.counters.faults for c in scenario.clients)
    assert_all_end(children)
    report = scenario.server.verify()
    assert (report["ok"], report["unverified_steps"]) == (True, 0)
    assert report["last_step"] > 50
    refused = run_command("serve", "--resume", str(scenario.server.recording), cwd=tmp_path)
    assert refused.returncode == 2
    assert "open" in refused.stderr
