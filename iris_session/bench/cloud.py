"""`bench cloud`: depth pictures to sent clouds, in a camera process; alone, or beside a two-arm session at 500 Hz.

Alone, the session is a publisher whose scene does not move, and clouds are made one after the other. Beside a session
pictures come at `BESIDE_HZ`, in every second of alternating intervals.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from iris_session.bench.clients import ClientJob, make_operators
from iris_session.bench.cloud_camera import CloudCase
from iris_session.bench.cloud_stream import LEAD_S, WITH, plan_stream
from iris_session.bench.harness import Action, BenchRun, measure
from iris_session.bench.plugins import PluginProcess
from iris_session.bench.report import BenchReport, make_bar
from iris_session.demo.scenes import n_arms_scene
from iris_session.demo.scenes.generators import arm_names
from iris_session.physics import PacerStats
from iris_session.scene.builder import SceneBuilder
from iris_session.session.config import SessionConfig
from iris_session.session.scene_publisher import ScenePublisher
from iris_session.system.extras import require_package

CAMERA: Final = "iris_session.bench.cloud_camera:CameraPublisher"
BESIDE_HZ: Final = 15.0
ROOM: Final = "room"


def run_cloud(
    points: int = 2_000_000,
    cameras: int = 1,
    seconds: float = 20.0,
    seed: int = 0,
    beside: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Make clouds of depth pictures, and send them.

    Results are those of cells of 1 cm and 50,000 points; other cases are in objects of their own.
    """
    require_package("numba", "bench cloud")
    require_package("cv2", "bench cloud")
    cases = _make_cases(points, cameras, beside, progress)
    progress("making the pictures")
    with PluginProcess(CAMERA, cases, seed) as camera:
        camera.read()
        if beside:
            return _measure_beside(camera, seconds, seed, progress)
        with ScenePublisher(
            SceneBuilder("bench"), SessionConfig(control_port=0, state_port=0, record=False)
        ) as session:
            camera.ask("connect", session.address)
            found = {}
            for case in cases:
                progress(f"measuring {case.name}")
                found[case.name] = camera.ask("run", case.name, seconds / len(cases))
        progress("measuring the filters of numpy and open3d")
        compared = camera.ask("compare")
        if compared["open3d_voxel_ms"] is None:
            progress("open3d cannot be imported: pip install 'iris-session[open3d]', and libusb-1.0-0 of the system")
        results = {**found.pop(ROOM), **compared, **found}
    bars = [make_bar(results, "hz", ">=", 30.0)]
    bars += [make_bar(results, f"{name}.hz", ">=", 30.0) for name in found]
    return BenchReport(results, bars)


def _make_cases(points: int, cameras: int, beside: bool, progress: Callable[[str], None]) -> tuple[CloudCase, ...]:
    room = CloudCase(ROOM, cameras, points, 50_000, 0.01, BESIDE_HZ if beside else 0.0)
    if beside:
        return (room,)
    cases = [room, CloudCase("room_2cm_10k", cameras, points, 10_000, 0.02)]
    if (Path(os.environ.get("IRIS_DATA", "")) / "rgbd").is_dir():
        cases.append(CloudCase("recorded", cameras, 0, 50_000, 0.01))
    else:
        progress("no recorded frames: IRIS_DATA names no folder that has rgbd/")
    return tuple(cases)


# --- beside a session -------------------------------------------------------------------------------------------------


def _measure_beside(camera: PluginProcess, seconds: float, seed: int, progress: Callable[[str], None]) -> BenchReport:
    """Return the report of intervals with and without clouds."""
    plan = plan_stream(seconds)  # without a camera first
    readings: list[PacerStats] = []  # at the end of the lead and of each interval

    def read_ticks(run: BenchRun) -> None:
        stats = run.session.lateness()
        assert stats is not None
        readings.append(stats)

    actions: list[Action] = [(0.0, lambda run: camera.send("connect", run.session.address)), (LEAD_S, read_ticks)]
    for one in plan:
        if one.kind == WITH:
            actions.append((one.begin_s, lambda _: camera.send("run", ROOM, plan[0].length_s)))
        actions.append((one.end_s, read_ticks))
    got = measure(
        n_arms_scene(2).compile(),
        [*make_operators(arm_names(2)), ClientJob("observer", "observer")],
        plan[-1].end_s + 0.2,
        seed=seed,
        actions=actions,
        progress=progress,
    )
    camera.read()  # the answer to `connect`
    runs = [camera.read() for _ in plan[1::2]]
    counts = np.diff([(stats.late, stats.ticks) for stats in readings], axis=0)
    late, ticks = counts.reshape(-1, 2, 2).sum(axis=0).T.tolist()  # without and with a camera
    results = {
        **min(runs, key=lambda run: float(run["hz"])),  # the worst
        "late_tick_share": round(late[1] / max(1, ticks[1]), 6),
        "late_tick_share_without": round(late[0] / max(1, ticks[0]), 6),
        "ticks": sum(ticks),
        "rounds": len(runs),
        **got.summarize("late_causes", "scheduling", "drops"),
    }
    bound = max(0.001, results["late_tick_share_without"])
    bars = (make_bar(results, "hz", ">=", 10.0), make_bar(results, "late_tick_share", "<=", bound))
    return BenchReport(results, bars)
