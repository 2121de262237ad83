"""Poses by name while scenes are loaded: never those of another body, in any order of arrival."""

from __future__ import annotations

import itertools
from collections.abc import Callable

from iris_session.client import Client, SceneState
from tests.client.session import BODIES, ClientSession, make_scene

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
