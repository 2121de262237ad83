"""`iris-session demo NAME`: a whole session on this machine with emulated operators, recorded and verified."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING

from iris_session.cli.common import (
    CommandError,
    Commands,
    add_command,
    add_session_options,
    make_number_type,
    open_scene,
    parse_seconds,
    print_result,
    refuse_options,
)
from iris_session.cli.view import live_viewer

if TYPE_CHECKING:
    from iris_session.client.stream_meter import StreamMeasurement
    from iris_session.demo.demos import Demo
    from iris_session.demo.run import DemoResult
    from iris_session.session.session import Session


def register(commands: Commands) -> None:
    parser = add_command(
        commands,
        "demo",
        run,
        help="emulated operators hand over objects, fold a cloth, or stow soft bodies",
        description="Run a whole session with emulated operators in other processes. Exit status 0 only if every "
        "object changed hands by contact alone (or was folded, or stowed) and the recording verifies bit for bit.\n\n"
        "  handover   arms made of primitives hand over a hammer; needs no data\n"
        "  panda      the same with Franka Panda arms\n"
        "  aloha      two ALOHA stations: two operators with two arms each exchange a red and a blue board\n"
        "  cloth      two operators fold a cloth: each takes a corner\n"
        "  soft       two operators stow a soft body each in one box\n"
        "  cloud      handover before two depth cameras; an observer watches their point cloud and pictures. The\n"
        "             cameras are drawn: needs OpenGL without a display (Debian: libegl1 libgl1-mesa-dri)\n\n"
        "The models of panda and aloha come from IRIS_DATA or the package mujoco-menagerie.\n\n"
        "`handover SCENE` plans the handover of an object between two arms of your scene, or says why none is possible "
        "before it starts. Each handover is an episode of a task in the recording.",
        examples="""
            iris-session demo handover
            iris-session demo handover --seed 7 --json
            iris-session demo handover --operators 8 --observers 8
            iris-session demo handover scene.xml --object cube --episodes 10 --record cube.rrd
            iris-session demo aloha --profile busy-wifi
            iris-session demo panda --latency 40
            iris-session demo cloud --record cloud.rrd
        """,
    )
    parser.add_argument("demo", choices=("handover", "panda", "aloha", "cloth", "soft", "cloud"))
    parser.add_argument("scene", nargs="?", help="for handover: your scene, a file or a name as of `serve`")
    plan = parser.add_argument_group("handover in your scene")
    plan.add_argument("--object", default="", metavar="NAME", help="the object (default: the only free body)")
    plan.add_argument("--from", default="", metavar="ROBOT", help="who gives (default: the nearest)")
    plan.add_argument("--to", default="", metavar="ROBOT", help="who takes (default: the other)")
    text = "handovers; with several the object lies a little elsewhere in each (default: 1)"
    count = make_number_type(int, "a number of handovers: give 1 to 1000", 1, 1000)
    plan.add_argument("--episodes", type=count, metavar="N", help=text)
    parser.add_argument("--operators", type=int, default=2, metavar="N", help="operators in pairs, 2 to 8 (default: 2)")
    parser.add_argument("--observers", type=int, default=0, metavar="N", help="observers; 0 to 16 (default: 0)")
    parser.add_argument("--seed", type=int, default=0, help="random seed of the emulated operators")
    parser.add_argument("--timeout", type=parse_seconds, metavar="S", help="at most so long (150, 60 more per episode)")
    link = parser.add_mutually_exclusive_group()
    link.add_argument("--profile", default="", metavar="NAME", help="link of every operator (docs/evidence/links.md)")
    delay = make_number_type(float, "a delay: give 0 to 10000 milliseconds, for example 40", 0.0, 10_000.0)
    link.add_argument("--latency", type=delay, metavar="MS", help="delay of every operator's link, each way")
    add_session_options(parser)
    parser.set_defaults(control_port=0, state_port=0)


def run(arguments: argparse.Namespace) -> int:
    """Run one demo and print its summary."""
    from iris_session.cli.live import TerminalView
    from iris_session.cli.serve import make_session_config
    from iris_session.demo.run import run_demo
    from iris_session.netsim.profiles import load_profile

    profile = arguments.profile if arguments.latency is None else f"{arguments.latency:f}ms"
    if profile:
        load_profile(profile)  # fails before anything is started
    play = _make_demo(arguments)
    timeout_s = arguments.timeout or 90.0 + 60.0 * (arguments.episodes or 1)
    config = make_session_config(arguments, arguments.demo)
    out = sys.stderr if arguments.json else sys.stdout

    @contextmanager
    def show(session: Session) -> Iterator[Callable[[], None]]:
        for note in session.notes:  # the address of the page among them
            print(note, file=out, flush=True)
        view = TerminalView(session, out, f"demo {arguments.demo} on {session.address}")
        with live_viewer(session.recording, out) if arguments.view else nullcontext(), view.open() as update:
            yield update

    if play.cameras:
        print("preparing the cameras: the first time takes some seconds", file=out, flush=True)
    result = run_demo(play, config, timeout_s, show, profile, arguments.seed)
    print_result(arguments, result, format_summary(result))
    return 130 if result.interrupted else 0 if result.ok else 1


def _make_demo(arguments: argparse.Namespace) -> Demo:
    """Return the demo of the arguments: a packaged one, or the handover in a scene."""
    from iris_session.demo.demos import make_demo, make_planned_handover

    if arguments.scene is None:
        why = ": name the scene, such as `iris-session demo handover scene.xml`"
        refuse_options(arguments, ("object", "from", "to", "episodes"), why)
        return make_demo(arguments.demo, arguments.operators, arguments.observers, arguments.seed)
    if arguments.demo != "handover":
        raise CommandError(f"demo {arguments.demo} has its own scene: `iris-session demo handover {arguments.scene}`")
    if arguments.operators != 2:
        raise CommandError(f"--operators {arguments.operators}: two people hand over an object of your scene")
    return make_planned_handover(
        open_scene(arguments.scene),
        arguments.object,
        getattr(arguments, "from"),
        arguments.to,
        episodes=arguments.episodes or 1,
        observers=arguments.observers,
        seed=arguments.seed,
    )


def format_summary(result: DemoResult) -> list[str]:
    """Return the result as a few lines."""
    outcome = "ok" if result.ok else "interrupted" if result.interrupted else "FAILED"
    lines = [f"demo {result.demo}: {outcome} after {result.seconds:.1f} s"]
    lines += [
        f"  handover of {h.object}: {h.giver} -> {h.receiver} at {h.at_s:.1f} s, both held it for {h.duration_s:.2f} s"
        for h in result.handovers
    ]
    if result.episodes:
        successes = result.episodes.count("success")
        lines.append(f"  {successes} of {len(result.episodes)} episodes are successes")
    lines += [f"  {g.deformable} {g.goal} at {g.at_s:.1f} s" for g in result.goals if g.at_s is not None]
    lines += [
        f"  alignment of {name}: stated {a['stated_p95']:.1f} mm (95 %), true {a['at_sheet']:.1f} mm at the sheet"
        for name, a in result.alignment_mm.items()
    ]
    pace = f"lateness p99 {result.lateness_ms_p99:.2f} ms, real-time factor {result.real_time_factor:.3f}"
    lines.append(f"  late ticks {result.late_tick_share * 100:.3f} %, {pace}")
    lines += [f"  state age p99 at {name}: {age:.1f} ms" for name, age in result.state_age_ms_p99.items()]
    lines += [_format_stream(name, one) for name, streams in result.streams.items() for one in streams]
    lines.append(f"  recording {result.recording}: {result.verification}" if result.recording else "  not recorded")
    lines += [f"  note: {note}" for note in result.notes]
    lines += [f"  problem: {problem}" for problem in result.problems]
    if result.recording:
        lines.append(f"look at it: iris-session view {result.recording}")
    return lines


def _format_stream(observer: str, one: StreamMeasurement) -> str:
    size = (
        "" if one.points is None or one.voxel_m is None else f"{one.points:,} points of {100.0 * one.voxel_m:.1f} cm, "
    )
    age = "" if one.age_ms is None else f", age {one.age_ms:.0f} ms, p99 {one.age_ms_p99:.0f} ms"
    return f"  {one.encoding} {one.stream} at {observer}: {size}{one.hz:.1f} Hz{age}"
