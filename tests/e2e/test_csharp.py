"""The C# client in a console, on both runtimes, with a live session on another machine, by the encrypted web wire."""

from __future__ import annotations

import json
import signal
import struct
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import psutil
import pytest
from numpy.typing import NDArray

from iris_session.protocol.server_messages import EpisodeChanged, ParticipantJoined, ParticipantLeft
from iris_session.recording import Recording
from iris_session.session.deformables import BOUND_M
from iris_session.streams.rigid import MAX_POSITION_ERROR_M
from tests.csharp.conftest import built as built  # noqa: PLC0414  a fixture
from tests.e2e import live_session
from tests.e2e.command_process import CommandProcess, Headset
from tests.e2e.session_process import DEADLINE_S, PATIENT_COMMAND, wait_until
from tests.e2e.virtual_network import Network, ServedSession, ip, require_namespaces
from tools.csharp.project import ROOT, Build
from tools.csharp.toolchain import RUNTIMES

pytestmark = pytest.mark.e2e

#: What a hand may be away from where it should be after a move of 10 cm [mm].
MOVE_MM: Final = 5.0
#: A headset that stood still has a fresh state within it [ms].
FRESH_MS: Final = 100.0
STILL_S: Final = 3.0
#: Draw calls of a frame that a Quest 3 can do.
DRAW_CALLS: Final = 200
#: What a body is drawn away from where the newest state has it, while the arms stand still [mm].
DRAWN_MM: Final = 1.0


#: Added to the bounds of streams: of a number in single precision [m].
ROUNDING: Final = 1e-6
#: Of the points of a cloud [m].
CLOUD_BOUND_M: Final = 0.001
#: States and frames of media that are compared with those of the session.
FRAMES: Final = 120
#: Of the frames that a Python client gets in the same time, without gateway: on a machine that has nothing else to do
#: nearly all arrive, on one that is overloaded the link of the gateway has no room for many.
SHARE: Final = 0.5

StartHeadset = Callable[..., Headset]
StartLive = Callable[..., CommandProcess]


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    require_namespaces()
    network = Network(tmp_path_factory.mktemp("network"))
    yield network
    network.close()


@pytest.fixture
def start(network: Network, built: Build) -> Iterator[StartHeadset]:
    """Start a headset on the machine of headsets; each `user` has an identity."""
    started: list[Headset] = []

    def start_one(runtime: str, user: str, *options: str) -> Headset:
        folder = network.headset.folder / user
        folder.mkdir(exist_ok=True)
        program = built.make_command(runtime, "headless")
        command = [*program, "run", "--json", "--identity", str(folder / "identity"), "--name", user, *options]
        started.append(Headset(network.headset.wrap_command(*command), folder, network.headset.environment()))
        return started[-1]

    yield start_one
    for headset in started:
        headset.close()


@pytest.fixture
def start_live(network: Network) -> Iterator[StartLive]:
    """Start `live_session` on the machine of sessions."""
    started: list[CommandProcess] = []

    def start_one(*arguments: str) -> CommandProcess:
        machine = network.server
        machine.close()
        command = machine.wrap_command(sys.executable, "-m", "tests.e2e.live_session", *arguments)
        environment = {**machine.environment(), "PYTHONPATH": str(ROOT)}
        started.append(CommandProcess(command, machine.folder, environment))
        return started[-1]

    yield start_one
    for process in reversed(started):
        process.close()


def pair(network: Network) -> str:
    """Return a new join code of the session."""
    done = network.server.run_command("pair", "--no-wait", "--json")
    assert done.returncode == 0, done.stderr
    code: str = json.loads(done.stdout.splitlines()[0])["code"]
    return code


def serve(network: Network, scene: str) -> ServedSession:
    """Serve a scene to the other machine, alone."""
    network.server.close()
    arguments = ("--interface", network.server.interface, "--name", scene)
    return network.server.serve(*arguments, scene=scene, command=PATIENT_COMMAND)


def serve_live(network: Network, start_live: StartLive, scene: str, recording: str = "") -> CommandProcess:
    """Serve a scene that can be commanded to the other machine, alone."""
    live = start_live("serve", scene, network.server.interface, recording)
    live.wait_for("serve")
    return live


def read_frames(path: Path) -> dict[int, NDArray[np.float64]]:
    """Return what a headset has received: rows of numbers by tick or time of capture."""
    data, at, frames = path.read_bytes(), 0, {}
    while at < len(data):
        key, count = struct.unpack_from("<qi", data, at)
        frames[key] = np.frombuffer(data, "<f8", count, at + 12)
        at += 12 + 8 * count
    return frames


def find_process(served: ServedSession, module: str) -> psutil.Process:
    """Return a process of a session by its module."""
    children = psutil.Process(served.process.pid).children(recursive=True)
    return next(one for one in children if module in " ".join(one.cmdline()))


def test_two_headsets_find_pair_align_and_move_arms(network: Network, start: StartHeadset) -> None:
    serve(network, "aloha")
    assert start("mono", "eve", "--code", "AAAA-AAAA-AAAA").process.wait(DEADLINE_S) == 2
    stranger = start("mono", "eve", "--address", "https://10.77.1.1:7725").do("join")
    assert (stranger["ok"], stranger["problem"]) == (False, "UnknownCertificate")
    ann, bob = start("mono", "ann", "--code", pair(network)), start("dotnet", "bob", "--code", pair(network))
    for headset in (ann, bob):
        assert headset.pair_and_join()["bodies"] > 0
    for headsets in ((ann, bob), (ann,)):  # those who saw a sheet before are asked to glance at it once more
        for wait in [headset.begin("align") for headset in headsets]:
            aligned = wait()
            assert aligned["true_m"] <= aligned["stated_m"]
    drawn = ann.do("draw")  # by the Unity layer on stand-ins of the engine
    assert drawn["ok"], str(drawn)
    assert 0 < drawn["draws"] <= DRAW_CALLS
    assert drawn["error_mm"] <= DRAWN_MM, str(drawn)
    assert drawn["people"] > 0
    assert bob.do("acquire south/left")["ok"]
    assert ann.do("until lease_changed")["what"] == "south/left by bob"
    denied = ann.do("acquire south/left")
    assert (denied["reason"], denied["holder"]) == ("held", "bob")
    assert ann.do("acquire north/right")["ok"]
    for wait in [ann.begin("move north/right 0 0 0.1"), bob.begin("move south/left 0 0 0.1")]:
        moved = wait()
        assert moved["error_mm"] <= MOVE_MM, str(moved)
    assert ann.do("estop")["ok"]
    assert bob.do("view")["stopped"]
    network.server.close()
    assert ann.do("draw dimmed")["dimmed"]
    assert [headset.end() for headset in (ann, bob)] == [1, 0]


@pytest.mark.long
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_what_fails_costs_neither_lease_nor_alignment(network: Network, start: StartHeadset, runtime: str) -> None:
    """Front and gateway are killed, the headset stands still, and is killed."""
    served = serve(network, "handover")
    user = f"kim-{runtime}"
    headset = start(runtime, user, "--code", pair(network))
    headset.pair_and_join()
    assert headset.do("align")["ok"]
    assert headset.do("acquire left")["ok"]
    for module in ("web.gateway", "front.main"):
        epoch = headset.do("view")["epoch"]
        find_process(served, module).kill()
        back = headset.wait_until_back(epoch)
        assert (back["resumed"], back["ours"], back["alignment"]) == (True, ["left"], "Aligned")
        assert headset.do("align")["ok"]
        assert headset.do("move left 0 0 0.05")["error_mm"] <= MOVE_MM
    headset.process.send_signal(signal.SIGSTOP)
    threading.Event().wait(STILL_S)
    headset.process.send_signal(signal.SIGCONT)
    measured = headset.do("measure 2")
    assert 0.0 <= measured["recovery_ms"] <= FRESH_MS, str(measured)
    headset.process.kill()
    headset.process.wait()
    again = start(runtime, user, "--address", "https://10.77.1.1:7725")
    joined = again.do("join")
    assert (joined["ok"], joined["resumed"]) == (True, True)
    view = again.do("view")
    assert view["ours"] == ["left"]
    assert view["alignment"] != "Aligned", "tracking has begun anew"
    assert again.do("align")["ok"]
    assert again.do("move left 0 0 0.05")["error_mm"] <= MOVE_MM
    assert again.end() == 0
    served.process.send_signal(signal.SIGINT)
    assert served.process.wait(DEADLINE_S) == 0


@pytest.mark.long
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_wrong_code_and_wrong_certificate_are_refused_and_all_of_aloha_comes(
    network: Network, start: StartHeadset, runtime: str
) -> None:
    serve(network, "aloha")
    user = f"dan-{runtime}"
    at = ("--address", "https://10.77.1.1:7725")
    wrong = start(runtime, user, "--code", "AAAA-AAAA-AAAA")
    assert not wrong.wait_for("pair")["ok"]
    assert wrong.process.wait(DEADLINE_S) == 2
    stranger = start(runtime, user, *at).do("join")
    assert (stranger["ok"], stranger["problem"]) == (False, "UnknownCertificate")
    headset = start(runtime, user, "--code", pair(network))
    headset.pair_and_join()
    scene = headset.do("scene")
    assert scene["ok"], str(scene)
    assert scene["equal"] == scene["assets"] > 0
    assert scene["fetched"] > 0
    assert headset.end() == 0

    network.server.close()  # another machine takes its address
    network.server.serve("--interface", network.server.interface, command=PATIENT_COMMAND, keys=f"other-{runtime}")
    again = start(runtime, user, *at).do("join")
    assert (again["ok"], again["problem"]) == (False, "WrongCertificate")


@pytest.mark.long
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_contact_is_felt_and_an_episode_goes_on_after_the_network_was_cut(
    network: Network, start: StartHeadset, start_live: StartLive, runtime: str
) -> None:
    recording = network.server.folder / f"{runtime}.rrd"
    live = serve_live(network, start_live, "handover", str(recording))
    headset = start(runtime, f"eva-{runtime}", "--code", pair(network))
    headset.pair_and_join()
    assert headset.do("align")["ok"]
    assert headset.do("acquire left")["ok"]
    assert headset.do("episode start")["ok"]
    headset.wait_for_view(lambda v: v["episode"] == "1 running", "the countdown is over")
    touched = headset.do("touch left 0 0 -0.6")
    assert touched["ok"], str(touched)
    assert touched["contact_n"] > 0
    assert touched["pulse"] > 0
    before = headset.do("view")
    assert before["episode"] == "1 running"

    machine = network.headset
    ip("-n", machine.name, "link", "set", machine.interface, "down")
    lost = headset.wait_for_view(lambda v: v["phase"] != "Ready" and v["unsent"] > before["unsent"], "it notices")
    wait_until(lambda: "ParticipantLeft" in live.do("events")["kinds"], "the session says that it left")
    ip("-n", machine.name, "link", "set", machine.interface, "up")
    back = headset.wait_until_back(before["epoch"])
    assert (back["resumed"], back["ours"], back["alignment"]) == (True, ["left"], "Aligned")
    headset.wait_for_view(lambda v: v["episode"] == "1 running", "its leader is back")
    assert back["unsent"] >= lost["unsent"]
    assert headset.do("align")["ok"]
    assert headset.do("move left 0 0 0.05")["error_mm"] <= MOVE_MM
    assert headset.do("episode success")["ok"]
    assert headset.end() == 0
    assert live.end() == 0
    with Recording.open(recording) as recorded:
        bodies = [event.body for event in recorded.events()]
    (left,) = [k for k, body in enumerate(bodies) if isinstance(body, ParticipantLeft) and body.grace]
    (joined,) = [k for k, body in enumerate(bodies) if isinstance(body, ParticipantJoined) and body.resumed]
    assert left < joined
    states = [body.state for body in bodies if isinstance(body, EpisodeChanged)]
    assert states == ["countdown", "running", "left", "running", "success"]


@pytest.mark.long
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_patched_scene_and_another_one_are_followed(
    network: Network, start: StartHeadset, start_live: StartLive, runtime: str
) -> None:
    live = serve_live(network, start_live, "handover")
    headset = start(runtime, f"fay-{runtime}", "--code", pair(network))
    headset.pair_and_join()
    assert headset.do("align")["ok"]
    assert headset.do("acquire left")["ok"]
    first = headset.do("scene")
    assert first["ok"], str(first)

    patch = live.do("patch")
    headset.wait_for_view(lambda v: v["scene"] == patch["hash"], "it knows of the patch")
    patched = headset.do("scene")
    assert (patched["ok"], patched["hash"], patched["equal"]) == (True, patch["hash"], patched["assets"])
    assert patched["fetched"] == first["fetched"] + 1, "of the assets, only the specification is another"
    assert patched["added_parts"] > 0
    lamp = headset.do(f"visual {patch['lamp']}")
    assert (lamp["kind"], lamp["body"]) == ("sphere", -1)
    assert lamp["position"] == pytest.approx(live_session.LAMP_POSITION, abs=1e-6)
    for visual in (patch["lamp"], *patch["painted"]):
        assert headset.do(f"visual {visual}")["rgba"] == pytest.approx(live_session.GREEN, abs=1e-6)

    other = live.do("scene")
    headset.wait_for_view(lambda v: v["scene"] == other["hash"], "it knows of the other scene")
    shown = headset.do("scene")
    assert (shown["ok"], shown["hash"], shown["equal"]) == (True, other["hash"], shown["assets"])
    assert headset.do("body object3")["ok"]
    assert not headset.do("body hammer")["ok"]
    view = headset.do("view")
    assert (view["ours"], view["alignment"]) == (["left"], "Aligned")
    assert headset.do("move left 0 0 0.05")["error_mm"] <= MOVE_MM


@pytest.mark.long
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_bodies_a_cloth_and_a_cloud_arrive_as_the_session_has_them(
    network: Network, start: StartHeadset, start_live: StartLive, runtime: str, tmp_path: Path
) -> None:
    """Every frame arrives, or was dropped and counted; how many arrive is compared with a Python client."""
    live = serve_live(network, start_live, "cloth")
    headset = start(runtime, f"gil-{runtime}", "--code", pair(network), "--role", "observer")
    headset.pair_and_join()
    scene = headset.do("scene")
    assert scene["ok"], str(scene)
    assert scene["deformables"] == [live_session.CLOTH]
    watcher = start_live("watch", live.results[0]["address"], pair(network))
    watcher.wait_for("watch")
    files = {name: tmp_path / name for name in ("state", "cloth", "cloud", "truth.npz", "python.npz")}
    followed = headset.do(f"follow {FRAMES} {files['state']}")
    cloth = headset.do(f"media {live_session.CLOTH} {FRAMES} {files['cloth']}")
    cloud = headset.do(f"media {live_session.CLOUD} {FRAMES} {files['cloud']}")
    assert (followed["ok"], cloth["ok"], cloud["ok"]) == (True, True, True), f"{followed}, {cloth}, {cloud}"
    assert (cloth["points"], cloud["points"]) == (144, live_session.SIDE**2)
    watcher.do(f"write {files['python.npz']}")
    live.do(f"truth {files['truth.npz']}")
    truth, python = np.load(files["truth.npz"]), np.load(files["python.npz"])

    poses = dict(zip(truth["ticks"].tolist(), truth["poses"], strict=True))
    names = followed["bodies"]
    states = read_frames(files["state"])
    assert len(states) == FRAMES
    for tick, row in states.items():
        away = row.reshape(len(names), 7)[:, :3] - poses[tick][:, :3]
        assert np.linalg.norm(away, axis=1).max() <= MAX_POSITION_ERROR_M + ROUNDING

    vertices = dict(zip(truth["cloth_ns"].tolist(), truth["cloth"], strict=True))
    known = dict(zip(python["cloth_ns"].tolist(), python["cloth"], strict=True))
    frames = read_frames(files["cloth"])
    for at, numbers in frames.items():
        away = numbers.reshape(-1, 3) - vertices[at]
        assert np.linalg.norm(away, axis=1).max() <= BOUND_M + ROUNDING
        if at in known:
            assert np.array_equal(numbers.reshape(-1, 3), known[at])
    assert np.ptp([numbers[2::3].mean() for numbers in frames.values()]) > 10.0 * BOUND_M, "the cloth moves"
    assert_as_many(frames, known, cloth)

    clouds = dict(zip(truth["cloud_ns"].tolist(), truth["cloud"].tolist(), strict=True))
    known = dict(zip(python["cloud_ns"].tolist(), python["cloud"], strict=True))
    frames = read_frames(files["cloud"])
    for at, numbers in frames.items():
        points = numbers.reshape(-1, 3)
        wanted = live_session.make_cloud(clouds[at])
        column = np.rint((points[:, :2] - wanted[0, :2]) / live_session.SPACING_M).astype(int)
        order = column[:, 0] * live_session.SIDE + column[:, 1]
        assert np.array_equal(np.sort(order), np.arange(len(wanted)))
        assert np.linalg.norm(points - wanted[order], axis=1).max() <= CLOUD_BOUND_M
    assert_as_many(frames, known, cloud)
    print(json.dumps({"cloth": cloth, "cloud": cloud, "states_hz": (FRAMES - 1) / followed["seconds"]}))


def assert_as_many(
    frames: dict[int, NDArray[np.float64]], known: dict[int, NDArray[np.float64]], result: dict[str, Any]
) -> None:
    """Fail unless all frames have arrived that were not counted as dropped, and enough beside the Python client's."""
    missing = result["published"] - result["frames"]
    assert 0 <= missing <= result["dropped"] + result["replaced"], str(result)
    first, last = max(min(frames), min(known)), min(max(frames), max(known))
    count, expected = (sum(first <= at <= last for at in one) for one in (frames, known))
    assert count >= SHARE * expected > 0, f"{count} frames, {expected} at the Python client"
