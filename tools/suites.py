"""Environments of benchmark suites, shared by one line each, in virtual environments of their own.

python -m tools.suites --list                        the cases
python -m tools.suites --json                        all of them: minutes to an hour, gigabytes of packages
python -m tools.suites robosuite fetch --json        suites, or environments whose name contains a text

Every case runs an environment alone, then shared with one observer, then driven by 5 cm where it has an arm; what is
measured is in `tools/suites_worker.py`. The last line of `--json` is one object; the exit status is 1 when fewer than
90 % of the cases pass. A virtual environment stays below `--folder` for the next run.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

ROOT: Final = Path(__file__).parents[1]
CASE_S: Final = 600.0
INSTALL_S: Final = 1800.0
PASS_SHARE: Final = 0.9
#: What suites that draw need to import without a screen.
_ENVIRON: Final = {"MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "egl", "SDL_VIDEODRIVER": "dummy"}


class Suite(NamedTuple):
    """A virtual environment: its packages, and the cases that run in it. `make`: a maker in `suites_worker`; `drive`:
    how participants drive, as in `share`.
    """

    packages: tuple[str, ...]
    make: str
    environments: tuple[str, ...]
    drive: str = "ctrl"


_GYMNASIUM: Final = ("gymnasium>=1.0", "imageio", "packaging")
_FETCH: Final = ("FetchReach-v4", "FetchPush-v4", "FetchSlide-v4", "FetchPickAndPlace-v4")
_META_WORLD: Final = ("reach-v3", "push-v3", "pick-place-v3", "drawer-open-v3", "door-open-v3", "button-press-v3")
_DM_CONTROL: Final = ("cartpole:swingup", "reacher:easy", "finger:turn_easy", "walker:walk", "humanoid:run")
SUITES: Final = {
    "gymnasium": Suite(
        (*_GYMNASIUM, "mujoco==3.3.7"),
        "make_gymnasium",
        ("Ant-v5", "HalfCheetah-v5", "Humanoid-v5", "Pusher-v5", "Reacher-v5", "Hopper-v5", "InvertedPendulum-v5"),
    ),
    "gymnasium-3.3.0": Suite(
        ("gymnasium>=1.0", "imageio", "packaging", "mujoco==3.3.0"), "make_gymnasium", ("Ant-v5", "Pusher-v5")
    ),
    "gymnasium-3.17": Suite((*_GYMNASIUM, "mujoco==3.17.*"), "make_gymnasium", ("Ant-v5", "Pusher-v5")),
    "gymnasium-4.0": Suite(
        ("gymnasium>=1.0", "imageio", "packaging", "mujoco==4.0.0"), "make_gymnasium", ("Ant-v5", "Pusher-v5")
    ),
    "fetch": Suite(("gymnasium-robotics>=1.3", "mujoco==3.3.7"), "make_robotics", _FETCH, "action"),
    "robotics": Suite(
        ("gymnasium-robotics>=1.3", "mujoco==3.3.7"),
        "make_robotics",
        ("HandReach-v3", "HandManipulateBlock-v1", "FrankaKitchen-v1", "AdroitHandDoor-v1", "PointMaze_UMaze-v3"),
    ),
    "metaworld": Suite(
        ("metaworld>=3.0", "imageio", "packaging", "mujoco==3.3.7"), "make_metaworld", _META_WORLD, "action"
    ),
    "robosuite": Suite(
        ("robosuite>=1.5", "mujoco==3.3.0"),
        "make_robosuite",
        ("Lift:Panda", "Stack:Panda", "Lift:Sawyer", "Lift:UR5e", "Lift:IIWA", "TwoArmLift:Panda+Panda"),
        "action",
    ),
    # The version that LIBERO builds on, with its controller; LIBERO's own assets are on no package index.
    "robosuite-1.4": Suite(
        ("robosuite==1.4.1", "mujoco==3.3.0"), "make_robosuite", ("Lift:Panda", "TwoArmLift:Panda+Panda"), "action"
    ),
    "ogbench": Suite(
        ("ogbench>=1.1", "mujoco==3.3.7"), "make_ogbench", ("cube-single-v0", "scene-v0", "puzzle-3x3-v0"), "action"
    ),
    "gym-aloha": Suite(("gym-aloha==0.1.5",), "make_aloha", ("AlohaInsertion-v0", "AlohaTransferCube-v0"), "action"),
    "dm_control": Suite(("dm_control>=1.0.30", "mujoco==3.8.*"), "make_dm_control", _DM_CONTROL),
    "dm_control-manipulation": Suite(
        ("dm_control>=1.0.30", "mujoco==3.8.*"), "make_manipulation", ("reach_site_features", "lift_brick_features")
    ),
    "myosuite": Suite(("myosuite>=2.8",), "make_gym", ("myoElbowPose1D6MRandom-v0", "myoHandReachFixed-v0")),
    "playground": Suite(("playground>=0.0.4",), "make_playground", ("PandaPickCube", "CartpoleBalance"), "action"),
}


def list_cases(wanted: list[str]) -> Iterator[tuple[str, str]]:
    """Return suite and environment of the cases whose names contain one of the texts; all without texts."""
    for suite, one in SUITES.items():
        for environment in one.environments:
            if not wanted or any(text == suite or text in environment for text in wanted):
                yield suite, environment


def make_venv(suite: str, folder: Path) -> Path:
    """Return the Python of the suite's virtual environment, made when it is not there. Raises `RuntimeError`."""
    place = folder / suite
    python = place / "bin" / "python"
    if (place / "complete").exists():
        return python
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    base = [name for name in project["dependencies"] if not name.startswith("mujoco")]
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    # First the suite as its users have it, then ours beside it.
    for command in (
        [sys.executable, "-m", "venv", "--clear", str(place)],
        [*install, *SUITES[suite].packages],
        [*install, *base, "rerun-sdk"],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=INSTALL_S)
        if done.returncode:
            lines = done.stderr.strip().splitlines() or ["no output"]
            raise RuntimeError(f"{suite} does not install: {lines[-1]}")
    (place / "complete").touch()
    return python


def run_case(suite: str, environment: str, folder: Path) -> dict[str, Any]:
    """Return the results of one case."""
    one, row = SUITES[suite], {"suite": suite, "env": environment, "passed": False}
    try:
        python = make_venv(suite, folder)
        done = subprocess.run(
            [str(python), "-m", "tools.suites_worker", one.make, environment, one.drive],
            capture_output=True,
            text=True,
            check=False,
            cwd=folder,  # nothing there shadows a package
            env={**os.environ, **_ENVIRON, "PYTHONPATH": str(ROOT)},
            timeout=CASE_S,
        )
    except (RuntimeError, subprocess.TimeoutExpired) as error:
        return row | {"error": str(error).splitlines()[-1]}
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if not lines:
        return row | {"error": (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]}
    return row | json.loads(lines[-1])


def format_table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Return the lines of the table of docs/suites.md."""
    yield (
        "| suite | environment | MuJoCo | robots | bodies off [mm] | same bits | reset | 5 cm, left [mm] | gripper | "
        "verified | added per step [ms] |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|---|"
    words = {True: "yes", False: "**no**", None: "-"}
    for row in rows:
        if "error" in row:
            yield f"| {row['suite']} | {row['env']} | | **{row['error'][:120]}** | | | | | | | |"
            continue
        off = "-" if row["driven_mm_off"] is None else str(row["driven_mm_off"])
        cells = (
            row["suite"],
            row["env"],
            row["mujoco"],
            ", ".join(row["robots"]) or "-",
            str(row["poses_mm"]),
            words[row["identical"]],
            words[row["follows_reset"]],
            off,
            words[row["gripper"]],
            words[row["verified"]],
            f"{row['ms_per_step_p50']} (of {row['alone_ms_per_step_p50']})",
        )
        yield f"| {' | '.join(cells)} |"


def main() -> int:
    """Run the cases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wanted", nargs="*", metavar="SUITE|ENV")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "iris-suites")
    parser.add_argument("--list", action="store_true", help="print the cases")
    output = parser.add_mutually_exclusive_group()
    output.add_argument("--json", action="store_true", help="end with one JSON object")
    output.add_argument("--markdown", action="store_true", help="end with the table of docs/suites.md")
    arguments = parser.parse_args()
    cases = list(list_cases(arguments.wanted))
    if arguments.list or not cases:
        print(*(f"{suite}: {environment}" for suite, environment in cases or list_cases([])), sep="\n")
        return 0 if cases else 2
    arguments.folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for suite, environment in cases:
        rows.append(run_case(suite, environment, arguments.folder.absolute()))
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    passed = sum(row["passed"] for row in rows)
    if arguments.markdown:
        print(*format_table(rows), sep="\n")
    elif arguments.json:
        print(json.dumps({"cases": rows, "passed": passed, "of": len(rows)}))
    else:
        print(f"{passed} of {len(rows)} pass")
    return 0 if passed >= PASS_SHARE * len(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
