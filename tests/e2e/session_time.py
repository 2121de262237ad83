"""Waits by what a session has done, not by the clock of the test: on a busy machine processes stand still for seconds.

A test that waits for half a second may read a state from before it, and the robot may have moved for none of it.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from iris_session.client import Client
from iris_session.recording import NotARecordingError, Recording
from tests.e2e.scenario import Scenario


def run_ticks(scenario: Scenario, client: Client, seconds: float) -> None:
    """Poll until `client` sees the physics `seconds` further than in a tick after this call."""
    begun_ns = client.session_now_ns()
    end = float("inf")

    def has_run() -> bool:
        nonlocal end
        state = client.scene.state
        if state is not None and state.header.session_time > begun_ns:
            end = min(end, state.header.sim_time + seconds)
        return client.ready and state is not None and state.header.sim_time >= end

    scenario.run_until(has_run, f"{seconds:g} s of physics")


def wait_until_recorded(scenario: Scenario, recording: Path, session_ns: int) -> None:
    """Poll until a step of session time `session_ns` or later is in the file."""

    def read_newest_ns() -> int:
        try:
            with Recording.open(recording, warn=False) as opened:
                return max((row.now_ns for row in opened.rows()), default=0)
        except (NotARecordingError, RuntimeError):  # not begun; of Rerun: a message was partly written
            return 0

    with ThreadPoolExecutor(1) as reader:  # on a busy machine it takes longer than the heartbeat timeout

        def is_recorded() -> bool:
            newest = reader.submit(read_newest_ns)
            scenario.run_until(newest.done, "the recording is read")
            return newest.result() >= session_ns

        scenario.run_until(is_recorded, "the file is up to date")
