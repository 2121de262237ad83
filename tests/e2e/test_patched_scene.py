"""A scene that its owner keeps patching: whoever hears of a look can have it, and what bends goes on."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from iris_session import Client, SceneBuilder, ScenePublisher, Session, SessionConfig
from iris_session.client import AssetStore
from iris_session.client.deformables import Deformables
from iris_session.client.fetched_scene import fetch_scene
from iris_session.demo.scenes import n_arms_scene, scene_path
from iris_session.protocol.scene import SetVisual
from tests.e2e.publisher import cloth, grid

pytestmark = pytest.mark.e2e

CONFIG = SessionConfig(control_port=0, state_port=0, beacon_port=0, record=False)
DEADLINE_S = 60.0
HZ = 60.0
#: Patches are that many states apart: 20 in a second.
APART = 3


class World:
    """A publisher in a thread of its own: a cloth that waves. A patch whenever one is `asked` for; while it is
    `restless`, many in a second."""

    def __init__(self) -> None:
        builder = SceneBuilder("patched")
        builder.add_plane("floor")
        builder.add_deformable("cloth", cloth(0.0), grid()[1])
        self.session = ScenePublisher(builder, CONFIG)
        self.asked = threading.Semaphore(0)
        self.restless = threading.Event()
        self._stop = threading.Event()
        self._colors = itertools.count()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> World:
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
            if self.asked.acquire(blocking=False) or (self.restless.is_set() and n % APART == 0):
                self.session.patch_scene(colored(0, next(self._colors)))
            self.session.set_vertices("cloth", cloth(n / HZ))
            self.session.publish(n / HZ)


def colored(visual: int, number: int) -> SetVisual:
    """A look that was never there before."""
    return SetVisual(visual, rgba=(0.5 + 0.4 * math.sin(number), 0.5, 0.5 + 0.4 * math.cos(number), 1.0))


@pytest.fixture
def world() -> Iterator[World]:
    with World() as world:
        yield world


@pytest.fixture
def opened() -> Iterator[list[Client]]:
    clients: list[Client] = []
    yield clients
    for client in clients:
        client.close()


def joined(session: Session | ScenePublisher, opened: list[Client], cache: Path) -> Client:
    client = Client(session.address, role="observer", name=cache.name, alignment="not_needed")
    client.assets.cache = AssetStore(cache)
    opened.append(client)
    return client.connect(DEADLINE_S)


def fetched_at_once(client: Client, address: str) -> None:
    """Asks one time."""
    fetch = client.assets.fetch([address])
    assert client.wait_for(lambda _: fetch.done, DEADLINE_S)
    fetch.check()
    assert fetch.bytes_received > 0


def test_whoever_hears_of_a_look_can_have_it_at_once(world: World, opened: list[Client], tmp_path: Path) -> None:
    ann = joined(world.session, opened, tmp_path / "ann")
    looks = [ann.mirror.scene_hash]
    for number in range(25):
        world.asked.release()
        assert ann.wait_for(lambda c: c.mirror.scene_hash != looks[-1], DEADLINE_S)
        looks.append(ann.mirror.scene_hash)
        if number < 20:
            fetched_at_once(ann, looks[-1])
    fetched_at_once(ann, looks[22])  # who hears late finds what others have replaced meanwhile

    world.restless.set()
    for number in range(5):
        late = joined(world.session, opened, tmp_path / f"late{number}")
        fetched_at_once(late, late.mirror.scene_hash)
        scene = fetch_scene(late, timeout_s=DEADLINE_S)
        assert scene.spec.deformables[0].name == "cloth"


def test_a_cloth_goes_on_while_the_scene_is_patched_all_the_time(
    world: World, opened: list[Client], tmp_path: Path
) -> None:
    ann = joined(world.session, opened, tmp_path / "ann")
    shapes = Deformables(ann)
    world.restless.set()
    assert ann.wait_for(lambda _: bool(shapes.update()), DEADLINE_S), "also who comes while it is"
    feed = ann.media.subscribe(shapes._meshes[0].stream)
    looks, drawn = {ann.mirror.scene_hash}, {shapes.scene_hash}
    moved = 0

    def goes_on(client: Client) -> bool:
        nonlocal moved
        moved += len(shapes.update())
        assert shapes.vertices.keys() == {"cloth"}
        assert shapes.fault == ""
        looks.add(client.mirror.scene_hash)
        drawn.add(shapes.scene_hash)
        return len(looks) > 20 and len(drawn) > 5 and moved > 20

    assert ann.wait_for(goes_on, DEADLINE_S), (len(looks), len(drawn), moved)
    world.restless.clear()

    def newest(client: Client) -> bool:
        goes_on(client)
        return shapes.scene_hash == client.mirror.scene_hash

    assert ann.wait_for(newest, DEADLINE_S)
    assert ann.media.subscribe(feed.stream) is feed, "it is the same subscription"
    assert shapes.capture_ns["cloth"] > 0
    assert np.isfinite(shapes.vertices["cloth"]).all()


def test_another_scene_and_its_look_can_be_had_as_soon_as_they_are_heard_of(
    opened: list[Client], tmp_path: Path
) -> None:
    with Session(scene_path("handover"), config=CONFIG) as session:
        stop = threading.Event()
        failed: list[BaseException] = []

        def watch() -> None:
            try:
                ann = joined(session, opened, tmp_path / "ann")
                seen = {""}
                while not stop.is_set():
                    ann.poll(0.01)
                    if ann.mirror.synced and ann.mirror.scene_hash not in seen:
                        seen.add(ann.mirror.scene_hash)
                        fetched_at_once(ann, ann.mirror.scene_hash)
                        heard.append(ann.mirror.scene_hash)
            except BaseException as error:  # of the thread whose test this is
                failed.append(error)

        heard: list[str] = []
        watcher = threading.Thread(target=watch)
        watcher.start()
        try:
            session.run(until=lambda: bool(heard or failed), seconds=DEADLINE_S)
            for number in range(3):
                loaded = session.load_scene(n_arms_scene(1 + number, objects=1).compile())
                session.run(until=loaded.done, seconds=DEADLINE_S)
                loaded.result()
                assert session.scene is not None
                for color in range(3):
                    n = len(heard)
                    session.patch_scene(colored(session.scene.visuals[0].id, 10 * number + color))
                    session.run(until=lambda n=n: len(heard) > n or bool(failed), seconds=DEADLINE_S)  # type: ignore[misc]
            assert failed == []
            assert len(heard) >= 10
        finally:
            stop.set()
            watcher.join()
