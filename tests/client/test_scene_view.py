"""Poses by name while scenes are loaded: never those of another body, whatever comes first."""

from __future__ import annotations

import itertools
from collections.abc import Callable

from iris_session.client import Client, SceneState
from tests.client.harness import BODIES, LiveSession, scene

ORDERS = list(itertools.permutations(BODIES))[1:]
#: `LiveSession` puts them there, from its second scene on.
Y = {body.name: float(body.id) for body in scene().bodies}


def test_bodies_of_another_scene_are_where_they_are_and_not_where_others_were(
    session: LiveSession, join: Callable[..., Client]
) -> None:
    client = join()
    wrong: list[tuple[str, float, int, int]] = []
    seen: list[int] = []  # epochs in which all were there

    def look() -> None:
        poses = {name: client.body_pose(name) for name in BODIES}
        state = client.state
        if state is None or session._shown.bodies == scene().bodies:
            return
        found = {name: pose[0][1] for name, pose in poses.items() if pose is not None}
        epoch = state.header.scene_epoch
        if epoch > 1:
            wrong.extend((name, y, epoch, client.mirror.scene_epoch) for name, y in found.items() if y != Y[name])
        if len(found) == len(BODIES):
            seen.append(epoch)

    def on_state(_: SceneState) -> None:
        look()

    client.on_state = on_state
    for epoch, order in enumerate(ORDERS, start=2):
        session.load_in_order(*order)

        def shown(_: Client, epoch: int = epoch) -> bool:
            look()
            return bool(seen) and seen[-1] == epoch

        assert client.wait_for(shown, 30.0), (epoch, seen[-1:], client.mirror.synced)
        assert [body.name for body in client.mirror.bodies] == list(order)
    assert wrong == []
    tip = client.tip_pose("left")
    assert tip is not None
    assert tip[0][1] == Y["left/hand"]


def test_after_a_reset_bodies_are_where_they_were_until_the_next_state(
    session: LiveSession, join: Callable[..., Client]
) -> None:
    client = join()
    assert client.wait_for(lambda c: c.state is not None)
    session.reset()

    def both(_: Client) -> bool:
        assert client.body_pose(BODIES[0]) is not None
        state = client.state
        return state is not None and state.header.scene_epoch == client.mirror.scene_epoch == 2

    assert client.wait_for(both, 30.0)
