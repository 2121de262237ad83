"""User loops under several versions of MuJoCo, each in an environment of its own with the base install alone.

python tools/user_loop_versions.py 3.3.0 3.3.7 4.0.0    makes the environments, then checks each
python tools/user_loop_versions.py --borrow 3.3.0       the same with all other packages of this environment: faster
python tools/user_loop_versions.py --here               checks the MuJoCo of this environment

Each check runs a loop with `begin_tick()/end_tick()` and one that is attached, with an observer, and compares both with
the trajectory without a session, bit for bit. Arms that are near one another are slowed. Then a policy moves an arm by
5 cm in a user's loop and in the session's, and where rerun is installed both recordings, with a contact in them, are
verified. The last line is one JSON object; the exit status is 1 if a check fails.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import json
import math
import os
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
STEPS = 400
#: Two arms and a ball that falls beside them. Written here, because the demo scenes need a newer MuJoCo than 3.3.0.
JOINT = '<joint name="{n}{i}" axis="{axis}" damping="5" armature="0.1"/>'
ARM = f"""<body name="{{n}}" pos="0 {{y}} 0.5" gravcomp="1">{JOINT.format(n="{n}", i=1, axis="0 0 1")}
<geom size="0.05"/><body name="{{n}}_upper" pos="0 0 0.3" gravcomp="1">{JOINT.format(n="{n}", i=2, axis="0 1 0")}
<geom size="0.05"/><body name="{{n}}_lower" pos="0.3 0 0" gravcomp="1">{JOINT.format(n="{n}", i=3, axis="0 1 0")}
<geom size="0.05"/><body name="{{n}}_wrist" pos="0 0 -0.2" gravcomp="1">{JOINT.format(n="{n}", i=4, axis="1 0 0")}
{JOINT.format(n="{n}", i=5, axis="0 1 0")}{JOINT.format(n="{n}", i=6, axis="0 0 1")}
<geom size="0.04"/><site name="{{n}}_tip" pos="0 0 -0.05"/></body></body></body></body>"""
MOTOR = '<position name="{n}{i}" joint="{n}{i}" kp="500"/>'
SCENE = f"""<mujoco><worldbody><geom type="plane" size="2 2 0.1"/>{ARM.format(n="left", y=0.4)}
{ARM.format(n="right", y=-0.4)}<body name="ball" pos="0 0 1"><freejoint/><geom size="0.1"/></body></worldbody><actuator>
{"".join(MOTOR.format(n=n, i=i) for n in ("left", "right") for i in range(1, 7))}</actuator></mujoco>"""
#: A policy moves the end effector up by so much [m], in so many seconds, and waits until so little is left.
MOVE_M, MOVE_S = 0.05, 1.0
MOST_LEFT_M, MOST_S = 0.002, 30.0
#: Holds that end only when the clutch is opened and closed again: a busy machine may cause one.
OPEN_CLUTCH = {"rearm", "rejected", "stale", "gap"}


def run_checks() -> dict[str, Any]:
    """Return the results with the MuJoCo of this environment."""
    import mujoco
    import numpy as np

    from iris_session import Client, ControlConfig, Session, SessionConfig

    model = mujoco.MjModel.from_xml_string(SCENE)
    config = SessionConfig(
        control_port=0, state_port=0, record=False, realtime=False, control=ControlConfig(output="targets")
    )

    def simulate(data: Any, step: Any) -> Any:
        states = []
        for i in range(STEPS):
            if i == STEPS // 2:
                mujoco.mj_resetData(model, data)
            data.ctrl[:] = 0.3 * np.sin(3.0 * data.time)
            step(data)
            states.append(np.concatenate(([data.time], data.qpos, data.qvel, data.ctrl)))
        return np.array(states)

    def advance(data: Any) -> None:
        mujoco.mj_step(model, data)

    def watch(session: Session) -> Client:
        client = Client(session.address, role="observer", name="watcher")
        client.start()
        return client

    results: dict[str, Any] = {"mujoco": mujoco.__version__}
    expected = simulate(mujoco.MjData(model), advance)
    data = mujoco.MjData(model)
    with Session(model, data, config) as session:

        def tick(data: Any) -> None:
            session.begin_tick()
            mujoco.mj_step(model, data)
            session.end_tick()

        session.begin_tick()  # participants can join from here on
        session.end_tick()
        with watch(session):
            results["ticks_identical"] = bool(np.array_equal(simulate(data, tick), expected))
            results["ticks_observed"] = len(session.status().participants) == 1
    data = mujoco.MjData(model)
    session = Session.attach(model, data, config)
    with watch(session):
        mujoco.MjModel.from_xml_string("<mujoco/>")
        results["attach_identical"] = bool(np.array_equal(simulate(data, advance), expected))
        results["attach_observed"] = len(session.status().participants) == 1
        results["targets"] = len(session.targets()) == 2
    session.close()
    results["proximity_slows"] = is_slowed(model)
    results |= drive(model, own_loop=False) | drive(model, own_loop=True)
    results["ok"] = all(value for name, value in results.items() if name != "mujoco")
    return results


def is_slowed(model: Any) -> bool:
    """Return whether arms whose wrists swing towards each other, 5 cm apart, are slowed, and not on the way back."""
    import mujoco
    import numpy as np

    from iris_session import ControlConfig
    from iris_session.control.proximity import ProximityLimiter
    from iris_session.physics import find_robots

    data = mujoco.MjData(model)
    for name, turned in (("left", -0.5), ("right", 0.5)):
        data.joint(f"{name}1").qpos[0], data.joint(f"{name}3").qpos[0] = turned * math.pi, math.radians(-10.0)
    mujoco.mj_forward(model, data)
    limiter, swing = ProximityLimiter(model, find_robots(model).robots, ControlConfig()), np.eye(6)[2]
    closing, opening = (
        [factors.min() for factors in limiter.compute_speed_factors(data, [way * swing, way * swing]).robots]
        for way in (-1.0, 1.0)
    )
    return bool(max(closing) < 1.0 == min(opening))


def drive(model: Any, own_loop: bool) -> dict[str, Any]:
    """Return whether a leased robot follows its target in a user's loop, or in the session's; and its recording."""
    import mujoco

    from iris_session import Client, Session, SessionConfig

    def move(address: str) -> None:
        with Client(address, role="agent", name="policy", devices=("target",)) as client:
            client.acquire(["left"])
            assert client.wait_for(lambda c: c.scene.tip_pose("left") is not None)
            (x, y, z), q = client.scene.tip_pose("left")
            goal, steps, begin = (x, y, z + MOVE_M), round(60 * MOVE_S), time.monotonic()
            for i in itertools.count():
                target = (x, y, z + MOVE_M * min(1.0, i / steps)), q
                feedback = client.feedback.get("left")
                may_close = feedback is not None and feedback.hold_reason not in OPEN_CLUTCH
                client.send_sample("target", target, robots=["left"], clutch=may_close)
                client.sleep(1 / 60)
                left.append(math.dist(client.scene.tip_pose("left")[0], goal))
                if (i >= steps and left[-1] < MOST_LEFT_M) or time.monotonic() > begin + MOST_S:
                    break

    def tick(session: Session, data: Any) -> None:
        session.begin_tick()
        mujoco.mj_step(model, data)
        session.end_tick()

    left: list[float] = []
    data = mujoco.MjData(model)
    can_record = importlib.util.find_spec("rerun") is not None
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "session.rrd" if can_record else False
        config = SessionConfig(control_port=0, state_port=0, record=record)
        with Session(model, None if own_loop else data, config) as session:
            begin = time.monotonic()
            if own_loop:
                session.run(seconds=0.1)
            else:
                tick(session, data)
            policy = threading.Thread(target=move, args=(session.address,))
            policy.start()
            if own_loop:
                session.run(until=lambda: not policy.is_alive())
            while policy.is_alive():
                tick(session, data)
                time.sleep(max(0.0, begin + data.time - time.monotonic()))
            policy.join()
        name = "run" if own_loop else "user_loop"
        results: dict[str, Any] = {f"{name}_driven": bool(left) and left[-1] < MOST_LEFT_M}
        if not results[f"{name}_driven"]:
            print(f"{name}: {1e3 * left[-1] if left else math.nan:.1f} mm left", file=sys.stderr)
        if can_record:
            from iris_session.session.verification import verify_recording

            report = verify_recording(Path(session.recording))
            results[f"{name}_verified"] = report.ok
            print(*report.problems[:3], sep="\n", file=sys.stderr)
    return results


def check_version(version: str, folder: Path, borrow: bool) -> dict[str, Any]:
    """Make an environment with `version` and the base install, or the packages of this one; return its results."""
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    python = folder / "bin" / "python"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    base = [name for name in project["dependencies"] if not name.startswith("mujoco")]
    packages = ["--no-deps", f"mujoco=={version}"] if borrow else [f"mujoco=={version}", *base]
    pip = [str(python), "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-compile"]
    subprocess.run([*pip, *packages], check=True, stdout=subprocess.DEVNULL)
    if borrow:  # they come after those of the environment
        site = sysconfig.get_path("platlib", vars={"base": str(folder), "platbase": str(folder)})
        Path(site, "borrowed.pth").write_text(sysconfig.get_path("platlib"), encoding="utf-8")
    done = subprocess.run(
        [str(python), __file__, "--here"],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        timeout=300.0,
    )
    lines = done.stdout.splitlines()
    if not lines or not lines[-1].startswith("{"):
        return {"mujoco": version, "ok": False, "error": done.stderr.strip().splitlines()[-1:]}
    results: dict[str, Any] = json.loads(lines[-1])
    return results


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("versions", nargs="*", help="versions of MuJoCo, for example 3.3.0 3.3.7 4.0.0")
    parser.add_argument("--borrow", action="store_true", help="use the other packages of this environment")
    parser.add_argument("--here", action="store_true", help="check the MuJoCo of this environment")
    args = parser.parse_args()
    if args.here:
        results = run_checks()
        print(json.dumps(results))
        return 0 if results["ok"] else 1
    cases = []
    for version in args.versions:
        with tempfile.TemporaryDirectory(prefix=f"mujoco-{version}-") as folder:
            cases.append(check_version(version, Path(folder), args.borrow))
        print(json.dumps(cases[-1]), flush=True)
    print(json.dumps({"cases": cases, "ok": bool(cases) and all(case["ok"] for case in cases)}))
    return 0 if cases and all(case["ok"] for case in cases) else 1


if __name__ == "__main__":
    raise SystemExit(main())
