"""Another scene in a running session, with real processes: everybody stays, late joiners see the same, it replays."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
import pytest

from anchors.pose import distance
from iris_session.client import Client
from iris_session.protocol.entries import SceneLoaded, decode_entries
from iris_session.protocol.scene import SceneSpec, decode_scene
from iris_session.protocol.server_messages import SceneChanged
from iris_session.recording import Recording
from tests.e2e.conftest import COMMAND, Server, Stage, end_all
from tests.e2e.scene_server import RED
from tests.recording.support import read

pytestmark = pytest.mark.e2e


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    folder = tmp_path / "server"
    folder.mkdir()
    recording = folder / "session.rrd"
    command = [sys.executable, str(Path(__file__).with_name("scene_server.py")), str(recording), str(folder)]
    server = Server(folder, recording, command)
    stage = Stage(server)
    yield stage
    stage.close()
    end_all([server])


def order(stage: Stage, scene: str, answer: str = "loaded") -> None:
    """Has the session load one of the scenes of `scene_server`, and waits for what it says."""
    said = stage.server.output.count(answer)
    (stage.server.folder / scene).touch()
    stage.run(lambda: stage.server.output.count(answer) > said, f"the session answers {answer!r}")


def in_epoch(stage: Stage, epoch: int) -> None:
    def there() -> bool:
        states = [client.scene.state for client in stage.clients]
        return all(s is not None and s.header.scene_epoch == epoch for s in states) and all(
            client.mirror.synced for client in stage.clients
        )

    stage.run(there, f"everybody sees scene epoch {epoch}")


def test_operators_go_on_in_another_scene_and_it_replays(stage: Stage) -> None:
    ann, bob = stage.join("ann"), stage.join("bob")
    assert {client.scene.tick_period_ns for client in stage.clients} == {2_000_000}
    ann.acquire(["left"])
    bob.acquire(["right"])
    hand = stage.hand(ann, "left")
    stage.engage(hand)
    hand.velocity = (0.0, 0.03, 0.0)
    stage.seconds(0.5)

    order(stage, "table")
    in_epoch(stage, 2)
    assert ann.mirror.leases["left"].holder == ann.participant_id, "she keeps her robot"
    assert "object3" in bob.mirror.body_index
    assert "hammer" not in bob.mirror.leases
    hand.velocity = (0.0, 0.0, 0.0)
    stage.seconds(0.3)
    still = hand.tip[0]
    stage.seconds(0.3)
    assert distance(hand.tip[0], still) < 1e-3, "a clutch that is still closed moves nothing"

    def driven() -> bool:
        if not stage.following(hand):  # at first, and after a stall of a busy machine
            hand.velocity = (0.0, 0.0, 0.0)
            stage.engage(hand)
        hand.velocity = (0.0, 0.05, 0.0)
        return distance(hand.tip[0], still) > 0.02

    stage.run(driven, "she drives on")

    assert {client.scene.tick_period_ns for client in stage.clients} == {1_000_000}
    order(stage, "slow", "ConfigError: the model has a timestep of 0.25 s")
    order(stage, "missing", "does not exist")
    hand.sending = False  # her robot is about to be gone
    order(stage, "three")
    in_epoch(stage, 3)
    late = stage.join("late", role="observer")
    in_epoch(stage, 3)
    assert sorted(late.mirror.robots) == ["arm1", "arm2", "arm3"]
    for client in stage.clients:
        state = client.scene.state
        assert state is not None
        assert client.scene.tick_period_ns == client.mirror.tick_period_ns == 4_000_000
        assert state.header.sim_time == pytest.approx(4e-3 * state.header.tick)
    welcome = late.connection.welcome
    assert welcome is not None
    assert welcome.tick_period_ns == 4_000_000
    stage.run(lambda: late.status().tick_period_ns == 4_000_000, "reports tell it, a second later")
    stage.run(lambda: len({c.mirror.event_seq for c in stage.clients}) == 1, "all know the same")
    assert len({c.mirror.mirror_hash() for c in stage.clients}) == 1
    assert not ann.mirror.leases["arm1"].holder

    before = [client.connection.generation for client in stage.clients]
    stage.server.children()["front.main"].kill()

    stage.run(lambda: before != [c.connection.generation for c in stage.clients], "the connections are lost")
    stage.run(lambda: all(client.ready for client in stage.clients), "everybody is back at the front that replaced it")
    bob.acquire(["arm2"])
    in_epoch(stage, 3)
    assert len(stage.clients[0].mirror.bodies) == len(late.mirror.bodies)
    told = [client.connection.welcome for client in stage.clients]
    assert [w.tick_period_ns for w in told if w is not None] == [4_000_000] * 3, "the new front knows"
    report = stage.server.finish()
    assert (report["ok"], report["unverified_steps"]) == (True, 0)
    with Recording.open(stage.server.recording) as recording:
        loads = [e.message for row in recording.rows() for e in decode_entries(row.entries)]
        assert [len(m.robots) for m in loads if isinstance(m, SceneLoaded)] == [2, 3]
    drawn = {entity.split("/")[2] for entity in read(stage.server.recording) if entity.startswith("/scene/")}
    assert drawn == {"1", "2", "3"}, "each in its time"


def test_a_session_that_was_killed_in_its_second_scene_goes_on_there(stage: Stage, tmp_path: Path) -> None:
    ann = stage.join("ann")
    order(stage, "three")
    in_epoch(stage, 2)
    ann.acquire(["arm3"])
    stage.run(lambda: ann.status().recorder.bytes_written, "the recorder has begun its file")
    stage.server.children()["recording.process"].kill()  # what follows is in a part of its own
    hand = stage.hand(ann, "arm3")
    stage.engage(hand)
    stage.run((stage.server.folder / "session.part2.rrd").exists, "the recording goes on")
    engaged_ns = ann.session_now_ns()

    def newest_row() -> int:
        try:
            with Recording.open(stage.server.recording, warn=False) as recording:
                return max((row.now_ns for row in recording.rows()), default=0)
        except RuntimeError:  # of Rerun's: a message was half written when it looked
            return 0

    def recorded() -> bool:
        with ThreadPoolExecutor(1) as reader:  # on a busy machine it takes longer than anybody may be silent
            newest = reader.submit(newest_row)
            stage.run(newest.done, "the recording is read")
        return newest.result() > engaged_ns

    stage.run(recorded, "what she does is in the file")
    stage.server.process.kill()
    stage.server.process.wait()
    resumed_file = stage.server.folder / "session.resume2.rrd"
    resumed = Server(
        stage.server.folder, resumed_file, [*COMMAND, "serve", "--resume", str(stage.server.folder / "session.rrd")]
    )
    try:
        in_epoch(stage, 2)
        stage.run(lambda: ann.ready and "name=ann " in resumed.output, "she is back")
        stage.engage(hand)
        assert ann.mirror.leases["arm3"].holder == ann.participant_id
        assert ann.scene.tick_period_ns == 4_000_000
        assert resumed.finish()["ok"]
    finally:
        end_all([resumed])


def spec_of(stage: Stage, client: Client) -> SceneSpec:
    """The scene as a client that comes now gets it."""
    address = client.mirror.scene_hash
    fetch = client.assets.fetch([address])
    stage.run(lambda: fetch.done, "the specification has come")
    return decode_scene(fetch.read(address))


def test_what_is_painted_is_the_same_for_those_who_were_there_and_who_came_late_or_after(stage: Stage) -> None:
    ann = stage.join("ann")
    ann.acquire(["left"])
    hand = stage.hand(ann, "left")
    stage.engage(hand)
    before = spec_of(stage, ann)
    order(stage, "paint", "painted")
    stage.run(lambda: ann.mirror.scene_revision == 2, "both patches have come")
    assert stage.following(hand), "robots go on while things are painted"
    changes = [e.body for e in stage.events["ann"] if isinstance(e.body, SceneChanged)]
    late = stage.join("late", role="observer")
    stage.run(lambda: late.mirror.event_seq == ann.mirror.event_seq, "both know the same")
    assert late.mirror.scene_hash == ann.mirror.scene_hash == changes[-1].scene_hash
    assert late.mirror.mirror_hash() == ann.mirror.mirror_hash()
    after = spec_of(stage, late)
    assert spec_of(stage, ann) == after
    assert [v.name for v in after.visuals] == [*(v.name for v in before.visuals), "lamp"]
    red = [msgspec.structs.replace(v, rgba=RED) for v in before.visuals]
    assert list(after.visuals[:60]) == red[:60]
    assert after.visuals[60:-1] == before.visuals[60:]

    stage.server.process.kill()
    stage.server.process.wait()
    resumed_file = stage.server.folder / "session.resume2.rrd"
    command = [*COMMAND, "serve", "--resume", str(stage.server.folder / "session.rrd")]
    resumed = Server(stage.server.folder, resumed_file, command)
    try:
        stage.run(lambda: ann.ready and "name=ann " in resumed.output, "she is back")
        assert ann.mirror.scene_hash == changes[-1].scene_hash
        assert resumed.finish()["ok"]
        for part in (stage.server.folder / "session.rrd", resumed_file):
            assert "/scene/1/world/lamp" in read(part), "the picture shows what was painted"
    finally:
        end_all([resumed])
