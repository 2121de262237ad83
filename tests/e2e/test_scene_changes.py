"""Scenes that are replaced or patched in a running session: all clients follow, late ones get the same, it replays."""

from __future__ import annotations

import itertools
import math
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from anchors.pose import distance
from iris_session import SceneBuilder, ScenePublisher, Session, SessionConfig
from iris_session.client import AssetStore, Client
from iris_session.client.deformables import Deformables
from iris_session.client.fetched_scene import fetch_scene
from iris_session.demo.scenes import n_arms_scene, scene_path
from iris_session.protocol.entries import SceneLoaded, decode_entries
from iris_session.protocol.scene import SceneSpec, SetVisual, decode_scene
from iris_session.protocol.server_messages import SceneChanged
from iris_session.recording import Recording
from tests.e2e import session_program
from tests.e2e.publisher_program import make_cloth, make_grid
from tests.e2e.scenario import Scenario
from tests.e2e.session_process import COMMAND, DEADLINE_S, SessionProcess, kill_all
from tests.e2e.session_program import RED
from tests.e2e.session_time import run_ticks, wait_until_recorded
from tests.loopback import make_loopback_address
from tests.recording.support import read

pytestmark = pytest.mark.e2e


@pytest.fixture
def scenario(tmp_path: Path) -> Iterator[Scenario]:
    folder = tmp_path / "server"
    folder.mkdir()
    recording = folder / "session.rrd"
    program = [sys.executable, session_program.__file__, make_loopback_address()]
    command = [*program, "scenes", str(recording), str(folder)]
    server = SessionProcess(folder, recording, command)
    scenario = Scenario(server)
    yield scenario
    scenario.close()
    kill_all([server])


def command_scene(scenario: Scenario, scene: str, answer: str = "loaded") -> None:
    """Have the session load one of the scenes of `session_program`, and wait for a text in its output."""
    count = scenario.server.output.count(answer)
    (scenario.server.folder / scene).touch()
    scenario.run_until(lambda: scenario.server.output.count(answer) > count, f"the session answers {answer!r}")


def wait_for_epoch(scenario: Scenario, epoch: int) -> None:
    def have_all_arrived() -> bool:
        states = [client.scene.state for client in scenario.clients]
        return all(s is not None and s.header.scene_epoch == epoch for s in states) and all(
            client.mirror.synced for client in scenario.clients
        )

    scenario.run_until(have_all_arrived, f"all clients have state of scene epoch {epoch}")


@pytest.mark.long
def test_operators_continue_in_another_scene_and_it_replays(scenario: Scenario) -> None:
    ann, bob = scenario.join("ann"), scenario.join("bob")
    assert {client.scene.tick_period_ns for client in scenario.clients} == {2_000_000}
    ann.acquire(["left"])
    bob.acquire(["right"])
    hand = scenario.add_hand(ann, "left")
    scenario.engage(hand)
    hand.velocity = (0.0, 0.03, 0.0)
    scenario.run_for(0.5)

    command_scene(scenario, "table")
    wait_for_epoch(scenario, 2)
    assert ann.mirror.leases["left"].holder == ann.participant_id, "ann keeps her robot"
    assert "object3" in bob.mirror.body_index
    assert "hammer" not in bob.mirror.leases
    hand.velocity = (0.0, 0.0, 0.0)
    run_ticks(scenario, ann, 0.3)
    still = hand.tip[0]
    run_ticks(scenario, ann, 0.3)
    assert distance(hand.tip[0], still) < 1e-3, "a closed clutch must not move the robot"

    def has_moved() -> bool:
        if not scenario.is_following(hand):  # at first, and after a stall of a busy machine
            hand.velocity = (0.0, 0.0, 0.0)
            scenario.engage(hand)
        hand.velocity = (0.0, 0.05, 0.0)
        return distance(hand.tip[0], still) > 0.02

    scenario.run_until(has_moved, "ann moves the robot in the new scene")

    assert {client.scene.tick_period_ns for client in scenario.clients} == {1_000_000}
    command_scene(scenario, "slow", "0.25 s")
    command_scene(scenario, "missing", "no/such/scene.xml")
    hand.sending = False  # the next scene does not have her robot
    command_scene(scenario, "three")
    wait_for_epoch(scenario, 3)
    late = scenario.join("late", role="observer")
    wait_for_epoch(scenario, 3)
    assert sorted(late.mirror.robots) == ["arm1", "arm2", "arm3"]
    for client in scenario.clients:
        state = client.scene.state
        assert state is not None
        assert client.scene.tick_period_ns == client.mirror.tick_period_ns == 4_000_000
        assert state.header.sim_time == pytest.approx(4e-3 * state.header.tick)
    welcome = late.connection.welcome
    assert welcome is not None
    assert welcome.tick_period_ns == 4_000_000
    scenario.run_until(
        lambda: late.status(DEADLINE_S).tick_period_ns == 4_000_000, "the status reports it within a second"
    )
    scenario.run_until(lambda: len({c.mirror.event_seq for c in scenario.clients}) == 1, "all have the same events")
    assert len({c.mirror.mirror_hash() for c in scenario.clients}) == 1
    assert not ann.mirror.leases["arm1"].holder

    before = [client.connection.generation for client in scenario.clients]
    scenario.server.children()["front.main"].kill()

    scenario.run_until(
        lambda: before != [c.connection.generation for c in scenario.clients], "the clients have disconnected"
    )
    scenario.run_until(
        lambda: all(client.ready for client in scenario.clients), "all clients have joined the new front"
    )
    bob.acquire(["arm2"])
    wait_for_epoch(scenario, 3)
    assert len(scenario.clients[0].mirror.bodies) == len(late.mirror.bodies)
    welcomes = [client.connection.welcome for client in scenario.clients]
    assert [w.tick_period_ns for w in welcomes if w is not None] == [4_000_000] * 3, "the new front has the tick period"
    report = scenario.server.finish()
    assert (report["ok"], report["unverified_steps"]) == (True, 0)
    with Recording.open(scenario.server.recording) as recording:
        loads = [e.message for row in recording.rows() for e in decode_entries(row.entries)]
        assert [len(m.robots) for m in loads if isinstance(m, SceneLoaded)] == [2, 3]
    drawn = {entity.split("/")[2] for entity in read(scenario.server.recording) if entity.startswith("/scene/")}
    assert drawn == {"1", "2", "3"}, "the recording shows all three scenes"


@pytest.mark.long
def test_session_killed_in_its_second_scene_resumes_in_it(scenario: Scenario, tmp_path: Path) -> None:
    ann = scenario.join("ann")
    command_scene(scenario, "three")
    wait_for_epoch(scenario, 2)
    ann.acquire(["arm3"])
    scenario.run_until(lambda: ann.status(DEADLINE_S).recorder.bytes_written, "the recorder has begun its file")
    scenario.server.children()["recording.process"].kill()  # the next rows are in a part of their own
    hand = scenario.add_hand(ann, "arm3")
    scenario.engage(hand)
    scenario.run_until((scenario.server.folder / "session.part2.rrd").exists, "the next part of the recording")
    wait_until_recorded(scenario, scenario.server.recording, ann.session_now_ns())
    scenario.server.kill()
    resumed_file = scenario.server.folder / "session.resume2.rrd"
    resumed = SessionProcess(
        scenario.server.folder,
        resumed_file,
        [*COMMAND, "serve", "--resume", str(scenario.server.folder / "session.rrd")],
    )
    try:
        wait_for_epoch(scenario, 2)
        scenario.run_until(lambda: ann.ready and "name=ann " in resumed.output, "ann has reconnected")
        scenario.engage(hand)
        assert ann.mirror.leases["arm3"].holder == ann.participant_id
        assert ann.scene.tick_period_ns == 4_000_000
        assert resumed.finish()["ok"]
    finally:
        kill_all([resumed])


def fetch_spec(scenario: Scenario, client: Client) -> SceneSpec:
    """Fetch the specification of the current scene."""
    address = client.mirror.scene_hash
    fetch = client.assets.fetch([address])
    scenario.run_until(lambda: fetch.done, "the specification has come")
    return decode_scene(fetch.read(address))


def test_patch_is_the_same_for_present_and_late_clients_and_after_resume(scenario: Scenario) -> None:
    ann = scenario.join("ann")
    ann.acquire(["left"])
    hand = scenario.add_hand(ann, "left")
    scenario.engage(hand)
    before = fetch_spec(scenario, ann)
    command_scene(scenario, "patch", "patched")
    scenario.run_until(lambda: ann.mirror.scene_revision == 2, "both patches were received")
    scenario.keep_engaged(hand)
    changes = [e.body for e in scenario.events["ann"] if isinstance(e.body, SceneChanged)]
    late = scenario.join("late", role="observer")
    scenario.run_until(lambda: late.mirror.event_seq == ann.mirror.event_seq, "both have the same events")
    assert late.mirror.scene_hash == ann.mirror.scene_hash == changes[-1].scene_hash
    assert late.mirror.mirror_hash() == ann.mirror.mirror_hash()
    after = fetch_spec(scenario, late)
    assert fetch_spec(scenario, ann) == after
    assert [v.name for v in after.visuals] == [*(v.name for v in before.visuals), "lamp"]
    red = [msgspec.structs.replace(v, rgba=RED) for v in before.visuals]
    assert list(after.visuals[:60]) == red[:60]
    assert after.visuals[60:-1] == before.visuals[60:]

    wait_until_recorded(scenario, scenario.server.recording, ann.session_now_ns())
    scenario.server.kill()
    resumed_file = scenario.server.folder / "session.resume2.rrd"
    command = [*COMMAND, "serve", "--resume", str(scenario.server.folder / "session.rrd")]
    resumed = SessionProcess(scenario.server.folder, resumed_file, command)
    try:
        scenario.run_until(lambda: ann.ready and "name=ann " in resumed.output, "ann has reconnected")
        assert ann.mirror.scene_hash == changes[-1].scene_hash
        assert resumed.finish()["ok"]
        for part in (scenario.server.folder / "session.rrd", resumed_file):
            assert "/scene/1/world/lamp" in read(part), "the recording shows the patch"
        with Recording.open(resumed_file) as recording:
            assert [scene.hash for scene in recording.scenes()] == [changes[-1].scene_hash]
            assert decode_scene(recording.asset(changes[-1].scene_hash)) == after
    finally:
        kill_all([resumed])


# --- patches by a publisher and by a session in this process ---------------------------------------------------------


CONFIG = SessionConfig(control_port=0, state_port=0, beacon_port=0, record=False)
HZ = 60.0
#: States between two patches: 20 patches a second.
PATCH_INTERVAL = 3


class PublisherThread:
    """A publisher of a waving cloth in a thread. Patches once per release of `requests`, at 20 Hz while `patching`."""

    def __init__(self) -> None:
        builder = SceneBuilder("patched")
        builder.add_plane("floor")
        builder.add_deformable("cloth", make_cloth(0.0), make_grid()[1])
        self.session = ScenePublisher(builder, CONFIG)
        self.requests = threading.Semaphore(0)
        self.patching = threading.Event()
        self._stop = threading.Event()
        self._colors = itertools.count()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> PublisherThread:
        self.session.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self.session.__exit__(None, None, None)

    def _run(self) -> None:
        for n in itertools.count():
            if self._stop.wait(1.0 / HZ):
                return
            if self.requests.acquire(blocking=False) or (self.patching.is_set() and n % PATCH_INTERVAL == 0):
                self.session.patch_scene(set_unique_color(0, next(self._colors)))
            self.session.set_vertices("cloth", make_cloth(n / HZ))
            self.session.publish(n / HZ)


def set_unique_color(visual: int, number: int) -> SetVisual:
    """Return an operation that gives a visual a colour that no other `number` gives."""
    return SetVisual(visual, rgba=(0.5 + 0.4 * math.sin(number), 0.5, 0.5 + 0.4 * math.cos(number), 1.0))


@pytest.fixture
def publisher() -> Iterator[PublisherThread]:
    with PublisherThread() as publisher:
        yield publisher


@pytest.fixture
def opened() -> Iterator[list[Client]]:
    clients: list[Client] = []
    yield clients
    for client in clients:
        client.close()


def join_observer(session: Session | ScenePublisher, opened: list[Client], cache: Path) -> Client:
    client = Client(session.address, role="observer", name=cache.name, alignment="not_needed")
    client.assets.cache = AssetStore(cache)
    opened.append(client)
    return client.connect(DEADLINE_S)


def fetch_once(client: Client, address: str) -> None:
    """Fetch an asset with a single request."""
    fetch = client.assets.fetch([address])
    assert client.wait_for(lambda _: fetch.done, DEADLINE_S)
    fetch.check()
    assert fetch.bytes_received > 0


def test_announced_specification_can_be_fetched_at_once(
    publisher: PublisherThread, opened: list[Client], tmp_path: Path
) -> None:
    ann = join_observer(publisher.session, opened, tmp_path / "ann")
    hashes = [ann.mirror.scene_hash]
    for number in range(25):
        publisher.requests.release()
        assert ann.wait_for(lambda c: c.mirror.scene_hash != hashes[-1], DEADLINE_S)
        hashes.append(ann.mirror.scene_hash)
        if number < 20:
            fetch_once(ann, hashes[-1])
    fetch_once(ann, hashes[22])  # a late request finds a replaced one, too

    publisher.patching.set()
    for number in range(5):
        late = join_observer(publisher.session, opened, tmp_path / f"late{number}")
        fetch_once(late, late.mirror.scene_hash)
        scene = fetch_scene(late, timeout_s=DEADLINE_S)
        assert scene.spec.deformables[0].name == "cloth"


def test_cloth_is_streamed_while_the_scene_is_patched_continuously(
    publisher: PublisherThread, opened: list[Client], tmp_path: Path
) -> None:
    ann = join_observer(publisher.session, opened, tmp_path / "ann")
    shapes = Deformables(ann)
    publisher.patching.set()
    assert ann.wait_for(lambda _: bool(shapes.update()), DEADLINE_S), "a client that joins meanwhile receives the cloth"
    feed = ann.media.subscribe(shapes._meshes[0].stream)
    announced, drawn = {ann.mirror.scene_hash}, {shapes.scene_hash}
    moved = 0

    def is_streamed(client: Client) -> bool:
        nonlocal moved
        moved += len(shapes.update())
        assert shapes.vertices.keys() == {"cloth"}
        assert shapes.fault == ""
        announced.add(client.mirror.scene_hash)
        drawn.add(shapes.scene_hash)
        return len(announced) > 20 and len(drawn) > 5 and moved > 20

    assert ann.wait_for(is_streamed, DEADLINE_S), (len(announced), len(drawn), moved)
    publisher.patching.clear()

    def is_newest_drawn(client: Client) -> bool:
        is_streamed(client)
        return shapes.scene_hash == client.mirror.scene_hash

    assert ann.wait_for(is_newest_drawn, DEADLINE_S)
    assert ann.media.subscribe(feed.stream) is feed, "the subscription stays"
    assert shapes.capture_ns["cloth"] > 0
    assert np.isfinite(shapes.vertices["cloth"]).all()


def test_replaced_scene_and_its_patches_can_be_fetched_at_once(opened: list[Client], tmp_path: Path) -> None:
    with Session(scene_path("handover"), config=CONFIG) as session:
        stop = threading.Event()
        failed: list[BaseException] = []

        def watch() -> None:
            try:
                ann = join_observer(session, opened, tmp_path / "ann")
                seen = {""}
                while not stop.is_set():
                    ann.poll(0.01)
                    if ann.mirror.synced and ann.mirror.scene_hash not in seen:
                        seen.add(ann.mirror.scene_hash)
                        fetch_once(ann, ann.mirror.scene_hash)
                        fetched.append(ann.mirror.scene_hash)
            except BaseException as error:  # raised again by the thread of the test
                failed.append(error)

        fetched: list[str] = []
        watcher = threading.Thread(target=watch)
        watcher.start()
        try:
            session.run(until=lambda: bool(fetched or failed), seconds=DEADLINE_S)
            for number in range(3):
                loaded = session.load_scene(n_arms_scene(1 + number, objects=1).compile())
                session.run(until=loaded.done, seconds=DEADLINE_S)
                loaded.result()
                assert session.scene is not None
                for color in range(3):
                    n = len(fetched)
                    session.patch_scene(set_unique_color(session.scene.visuals[0].id, 10 * number + color))
                    session.run(until=lambda n=n: len(fetched) > n or bool(failed), seconds=DEADLINE_S)  # type: ignore[misc]
            assert failed == []
            assert len(fetched) >= 10
        finally:
            stop.set()
            watcher.join()
