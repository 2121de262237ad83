"""Poses by name while scenes are loaded: never those of another body, in any order of arrival."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable

import pytest

from iris_session.client import Client, SceneState, SessionMirror
from iris_session.client.deformables import Deformables
from iris_session.protocol.server_messages import Event, SceneChanged, Snapshot
from tests.client.session import BODIES, ClientSession, make_scene
from tests.client.threads import ThreadedClient

ORDERS = list(itertools.permutations(BODIES))[1:]
#: `ClientSession` places them there from its second scene on.
Y = {body.name: float(body.id) for body in make_scene().bodies}


def test_poses_by_name_never_belong_to_another_body(session: ClientSession, join: Callable[..., Client]) -> None:
    client = join()
    wrong: list[tuple[str, float, int, int]] = []
    seen: list[int] = []  # epochs in which all were present

    def record() -> None:
        poses = {name: client.scene.body_pose(name) for name in BODIES}
        state = client.scene.state
        if state is None or session.scene.bodies == make_scene().bodies:
            return
        found = {name: pose[0][1] for name, pose in poses.items() if pose is not None}
        epoch = state.header.scene_epoch
        if epoch > 1:
            wrong.extend((name, y, epoch, client.mirror.scene_epoch) for name, y in found.items() if y != Y[name])
        if len(found) == len(BODIES):
            seen.append(epoch)

    def on_state(_: SceneState) -> None:
        record()

    client.on_state = on_state
    for epoch, order in enumerate(ORDERS, start=2):
        session.load_reordered(*order)

        def shown(_: Client, epoch: int = epoch) -> bool:
            record()
            return bool(seen) and seen[-1] == epoch

        assert client.wait_for(shown), (epoch, seen[-1:], client.mirror.synced)
        assert [body.name for body in client.mirror.bodies] == list(order)
    assert wrong == []
    tip = client.scene.tip_pose("left")
    assert tip is not None
    assert tip[0][1] == Y["left/hand"]


def test_bodies_keep_their_poses_after_a_reset_until_the_next_state(
    session: ClientSession, join: Callable[..., Client]
) -> None:
    client = join()
    assert client.wait_for(lambda c: c.scene.state is not None)
    session.reset()

    def both(_: Client) -> bool:
        assert client.scene.body_pose(BODIES[0]) is not None
        state = client.scene.state
        return state is not None and state.header.scene_epoch == client.mirror.scene_epoch == 2

    assert client.wait_for(both)


class Slow(SessionMirror):
    """Lets another thread run whenever the hash is read."""

    meanwhile: Callable[[], None] | None = None
    _hash = ""

    @property
    def scene_hash(self) -> str:  # type: ignore[override]
        seen, meanwhile, self.meanwhile = self._hash, self.meanwhile, None
        if meanwhile is not None:
            threading.Thread(target=meanwhile, daemon=True).start()
            time.sleep(0.02)
        return seen

    @scene_hash.setter
    def scene_hash(self, scene_hash: str) -> None:
        self._hash = scene_hash


def test_hash_and_epoch_of_a_scene_are_consistent_in_any_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    with ThreadedClient() as ann:
        client = ann.client
        mirror, changed = Slow(), threading.Event()
        mirror.apply_snapshot(Snapshot(0, 0, 1, 0, "first", 0, 0.0, 0, (), ()))
        client.connection.mirror = mirror

        def hear() -> None:
            with client._lock:  # as `poll` does
                mirror.apply_event(Event(1, 0, 0, SceneChanged(2, 0, "new_scene")))
                mirror.apply_snapshot(Snapshot(0, 1, 2, 0, "second", 0, 0.0, 0, (), ()))
            changed.set()

        followed: list[tuple[str, int]] = []
        shapes = Deformables(client)
        monkeypatch.setattr(shapes, "_follow", lambda scene_hash, epoch: followed.append((scene_hash, epoch[1])))
        mirror.meanwhile = hear
        shapes.update()
        assert changed.wait(30.0)
        shapes.update()
        assert followed == [("first", 1), ("second", 2)]
