"""A session whose world is not MuJoCo's, with real processes: what clients see of it, resets, how it ends; and files
that are shown as they are."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from anchors.pose import compose
from iris_session.assets.store import AssetStore
from iris_session.client import Client
from iris_session.client.deformables import Deformables
from iris_session.protocol.scene import decode_scene, list_assets
from iris_session.protocol.server_messages import SceneChanged
from iris_session.session.deformables import BOUND_M
from iris_session.streams.rigid import MAX_POSITION_ERROR_M, MAX_ROTATION_ERROR_RAD
from tests.e2e import publisher
from tests.e2e.conftest import Server, Stage, end_all, iris, none_left, relatives

pytestmark = pytest.mark.e2e

#: The stream is exact to its bound beside the rounding of times and products.
ROUNDING = 1e-6


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    folder = tmp_path / "server"
    folder.mkdir()
    recording = folder / "session.rrd"
    command = [sys.executable, "-m", "tests.e2e.publisher", str(recording), str(folder)]
    server = Server(folder, recording, ["env", f"PYTHONPATH={Path(__file__).parents[2]}", *command])
    stage = Stage(server)
    yield stage
    stage.close()
    end_all([server])


class Watcher:
    """Somebody who looks, and checks whatever comes against the time it is of."""

    def __init__(self, stage: Stage, name: str, stream: str) -> None:
        self.client = stage.join(name, role="observer")
        self.shapes = Deformables(self.client)
        self.feed = self.client.media.subscribe(stream)
        self.poses = self.vertices = 0
        self._time_of: dict[int, float] = {}  # session time -> time of the world
        self._seen = -1

    def look(self) -> None:
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
            away = self.shapes.vertices["cloth"] - publisher.cloth(self._time_of[frame.header.capture_ns])
            assert np.linalg.norm(away, axis=1).max() <= BOUND_M + ROUNDING
            self.vertices += 1

    def _check_poses(self, poses: np.ndarray, t: float) -> None:
        ball, crate, base, upper, fore = poses
        self._same(ball, (*publisher.ball(t), *publisher.turned(t, 0)))
        self._same(crate, (0.0, 2.0, 0.2, 1.0, 0.0, 0.0, 0.0))
        self._same(base, (0.0, -1.0, 0.5, 1.0, 0.0, 0.0, 0.0))
        T_world_upper = ((0.0, -1.0, 0.6), publisher.turned(publisher.turn(t), 2))
        self._same(upper, (*T_world_upper[0], *T_world_upper[1]))
        p, q = compose(T_world_upper, ((0.4, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))  # type: ignore[arg-type]
        self._same(fore, (*p, *q))

    @staticmethod
    def _same(seen: np.ndarray, expected: tuple[float, ...]) -> None:
        assert np.linalg.norm(seen[:3] - expected[:3]) <= MAX_POSITION_ERROR_M + ROUNDING
        dot = min(1.0, abs(float(seen[3:] @ np.array(expected[3:]))))
        assert 2.0 * np.arccos(dot) <= MAX_ROTATION_ERROR_RAD + ROUNDING


def looks(stage: Stage, watchers: list[Watcher], more: int = 20) -> None:
    """Until each has checked so many states and shapes more."""
    goals = [(w.poses + more, w.vertices + more) for w in watchers]

    def enough() -> bool:
        for watcher in watchers:
            watcher.look()
        return all(w.poses >= p and w.vertices >= v for w, (p, v) in zip(watchers, goals, strict=True))

    stage.run(enough, "everybody sees the world move")


def test_everybody_sees_a_world_that_mujoco_does_not_know(stage: Stage, tmp_path: Path) -> None:
    composed = publisher.builder(tmp_path).build(AssetStore(tmp_path / "store"))
    stream = composed.deformables["cloth"].stream
    ann = Watcher(stage, "ann", stream)
    looks(stage, [ann])
    late = Watcher(stage, "late", stream)
    looks(stage, [ann, late])

    client = late.client
    client.assets.cache = AssetStore(tmp_path / "cache")
    assert client.mirror.scene_hash == composed.scene_hash, "the scene is the builder's"
    fetch = client.assets.fetch([composed.scene_hash])
    stage.run(lambda: fetch.done, "the specification has come")
    spec = decode_scene(fetch.read(composed.scene_hash))
    assert spec == composed.spec
    rest = client.assets.fetch(list_assets(spec))
    stage.run(lambda: rest.done, "its assets have come")
    rest.check()
    assert tuple(body.name for body in client.mirror.bodies) == publisher.NAMES
    assert {body.id: body.name for body in spec.bodies if body.moving} == {b.id: b.name for b in client.mirror.bodies}

    (stage.server.folder / "back").touch()
    stage.run(lambda: client.mirror.scene_epoch == ann.client.mirror.scene_epoch == 2, "time has gone back")
    looks(stage, [ann, late])
    assert sum(isinstance(event.body, SceneChanged) for event in stage.events["ann"]) == 1

    children = relatives(stage.server.process.pid)
    stage.server.process.kill()
    stage.server.process.wait()
    stage.run(lambda: not any(c.connection.is_joined for c in stage.clients), "both know that the session is gone")
    assert all("session_ended" in c.connection.counters.faults for c in stage.clients)
    none_left(children)
    report = stage.server.verify()
    assert (report["ok"], report["unverified_steps"]) == (True, 0)
    assert report["last_step"] > 50
    refused = iris("serve", "--resume", str(stage.server.recording), cwd=tmp_path)
    assert refused.returncode == 2
    assert "class 'open'" in refused.stderr


def test_a_file_is_shown_to_everybody_as_it_is(tmp_path: Path, serve: Callable[..., Server]) -> None:
    publisher.builder(tmp_path)
    server = serve(str(tmp_path / "corner.off"), "--name", "shelf")
    stage = Stage(server)
    try:
        ann: Client = stage.join("ann", role="observer")
        stage.run(lambda: ann.scene.state is not None, "she sees the scene")
        fetch = ann.assets.fetch([ann.mirror.scene_hash])
        stage.run(lambda: fetch.done, "the specification has come")
        (visual,) = decode_scene(fetch.read(ann.mirror.scene_hash)).visuals
        assert visual.geometry.kind == "mesh"
        assert ann.scene.state is not None
        assert ann.scene.state.poses.shape == (0, 7), "nothing moves"
        assert "without robots" in server.output
        assert server.finish()["ok"]
    finally:
        stage.close()
