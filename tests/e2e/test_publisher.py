"""A `ScenePublisher` in a process: what clients receive of a world without MuJoCo, its reset, and its end."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from iris_session.assets.store import AssetStore
from iris_session.client.deformables import Deformables
from iris_session.protocol.scene import decode_scene
from iris_session.protocol.server_messages import SceneChanged
from iris_session.session.deformables import BOUND_M
from iris_session.streams.rigid import MAX_POSITION_ERROR_M
from tests.e2e.scenario import Scenario
from tests.e2e.session_process import assert_all_end, list_descendants, run_command

pytestmark = pytest.mark.e2e

#: Added to the error bounds of the streams.
ROUNDING = 1e-6
#: The ball circles, and the cloth rises and falls with its time; a file `back` makes time begin anew.
SCRIPT = """
import math
import time
from pathlib import Path
from iris_session import SceneBuilder, ScenePublisher, SessionConfig

scene = SceneBuilder("lab")
scene.add_sphere("ball", radius=0.1, movable=True)
scene.add_deformable("cloth", [(0, 0, 1), (1, 0, 1), (0, 1, 1)], [(0, 1, 2)])
config = SessionConfig(control_port=0, state_port=0, record="session.rrd", beacon_port=0)
with ScenePublisher(scene, config) as session, session.signals():
    print(f"session on {session.address}, recording to {session.recording}", flush=True)
    begun = time.monotonic()
    while not session.stopping:
        if Path("back").exists():
            Path("back").unlink()
            begun = time.monotonic()
        t = time.monotonic() - begun
        z = 1.0 + 0.1 * math.sin(t)
        session.set_pose("ball", (math.cos(t), math.sin(t), 1.0))
        session.set_vertices("cloth", [(0, 0, z), (1, 0, z), (0, 1, z)])
        session.publish(t)
        time.sleep(0.005)
"""


def test_observers_receive_poses_and_vertices_of_a_world_without_mujoco(
    script_scenario: Scenario, tmp_path: Path
) -> None:
    scenario = script_scenario
    ann, late = scenario.join("ann", role="observer"), scenario.join("late", role="observer")
    shapes = Deformables(late)
    heights: set[float] = set()

    def has_seen_motion() -> bool:
        state = late.scene.state
        if state is not None and state.header.sim_time > 0.0:
            t = state.header.sim_time
            away = state.poses[0, :3] - (math.cos(t), math.sin(t), 1.0)
            assert np.linalg.norm(away) <= MAX_POSITION_ERROR_M + ROUNDING
        shapes.update()
        assert shapes.fault == ""
        if "cloth" in shapes.vertices:
            z = shapes.vertices["cloth"][:, 2]
            assert np.ptp(z) <= 2.0 * (BOUND_M + ROUNDING)
            heights.add(round(float(z[0]), 2))
        return len(heights) >= 4

    scenario.run_until(has_seen_motion, "the world moves")
    late.assets.cache = AssetStore(tmp_path / "cache")
    fetch = late.assets.fetch([late.mirror.scene_hash])
    scenario.run_until(lambda: fetch.done, "the specification was received")
    spec = decode_scene(fetch.read(late.mirror.scene_hash))
    assert [body.name for body in spec.bodies if body.moving] == [body.name for body in late.mirror.bodies] == ["ball"]

    (scenario.server.folder / "back").touch()
    scenario.run_until(lambda: ann.mirror.scene_epoch == late.mirror.scene_epoch == 2, "a new scene epoch")
    assert sum(isinstance(event.body, SceneChanged) for event in scenario.events["ann"]) == 1

    children = list_descendants(scenario.server.process.pid)
    scenario.server.kill()
    scenario.run_until(lambda: not any(c.connection.is_joined for c in scenario.clients), "both have disconnected")
    assert all("session_ended" in c.connection.counters.faults for c in scenario.clients)
    assert_all_end(children)
    report = scenario.server.verify()
    assert (report["ok"], report["unverified_steps"]) == (True, 0)
    refused = run_command("serve", "--resume", str(scenario.server.recording), cwd=tmp_path)
    assert refused.returncode == 2
    assert "open" in refused.stderr
