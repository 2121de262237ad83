"""A session in a user's script, attached by one line: a participant drives, and the script simply ends."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e.scenario import Scenario
from tests.e2e.session_process import assert_all_end, list_descendants, run_verify

pytestmark = pytest.mark.e2e

SCRIPT = """
import time
from pathlib import Path
import mujoco
from iris_session import Session, SessionConfig, authority
from iris_session.demo.scenes import scene_path

model = mujoco.MjModel.from_xml_path(str(scene_path("handover")))
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, 0)
config = SessionConfig(
    name="mine", control_port=0, state_port=0, record="session.rrd", authority=authority.AuthorityConfig()
)
session = Session.attach(model, data, config)
print(f"session on {session.address}, recording to {session.recording}", flush=True)
while not Path("end").exists():
    mujoco.mj_step(model, data)
    time.sleep(0.0015)
print("ended in order", flush=True)
"""


def test_attached_script_without_close_ends_in_order(script_scenario: Scenario, tmp_path: Path) -> None:
    scenario = script_scenario
    hand = scenario.drive("ann", "left")
    before = hand.tip
    hand.velocity = (0.0, 0.1, 0.0)
    scenario.run_until(lambda: hand.tip[0][1] - before[0][1] > 0.03, "the robot follows")
    children = list_descendants(scenario.server.process.pid)
    (tmp_path / "end").touch()
    scenario.run_until(lambda: scenario.server.process.poll() is not None, "the script ends")
    assert scenario.server.process.returncode == 0, scenario.server.output
    assert "ended in order" in scenario.server.output
    assert_all_end(children)
    scenario.run_until(lambda: "session_ended" in hand.client.connection.counters.faults, "ann is told")
    report = run_verify(scenario.server.recording)
    assert (report["recording_class"], report["finished"]) == ("open", True)
