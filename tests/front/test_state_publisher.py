"""The state stream across scene changes: a visual patch leaves it alone, another scene restarts it."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from iris_session.front.state_publisher import StatePublisher
from iris_session.link.config import SceneInfo
from iris_session.protocol.server_messages import BodyInfo, StateHeader
from iris_session.streams.rigid import WINDOW

N = 100


class Sent:
    """In place of the socket."""

    def __init__(self) -> None:
        self.payloads: list[bytes] = []

    def send_multipart(self, frames: tuple[bytes, ...]) -> None:
        self.payloads.append(frames[2])


def rows(x: float) -> np.ndarray:
    poses = np.zeros((N, 7))
    poses[:, 0], poses[:, 3] = x, 1.0
    return poses


def info(name: str, patches: int, first: str = "body0") -> SceneInfo:
    names = (first, *(f"body{i}" for i in range(1, N)))
    bodies = tuple(BodyInfo(i, name, True) for i, name in enumerate(names))
    return SceneInfo(name, bodies=bodies, poses=rows(0.0).tobytes(), patches=patches)


@pytest.fixture
def sent() -> Sent:
    return Sent()


@pytest.fixture
def publisher(sent: Sent) -> StatePublisher:
    """Bodies that rest at x = 5 m for longer than they are repeated."""
    publisher = StatePublisher(sent, info("loaded", 0), lambda: 0)  # type: ignore[arg-type]
    publish(publisher, WINDOW + 5)
    return publisher


def publish(publisher: StatePublisher, times: int) -> None:
    for _ in range(times):
        header = StateHeader(1, 0, 1, 0.0, 0, 0, 0, 0)
        assert publisher.publish(msgspec.msgpack.encode(header), rows(5.0).tobytes())


def test_patch_repeats_no_body_in_the_state(publisher: StatePublisher, sent: Sent) -> None:
    seq, poses = publisher.read_keyframe()
    assert (np.frombuffer(poses).reshape(N, 7)[:, 0] == 5.0).all()
    publisher.set_scene(info("patched", 1))
    assert publisher.scene.scene_hash == "patched"
    assert publisher.read_keyframe() == (seq, poses), "who joins now sees them where they are"
    publish(publisher, 3)
    assert max(map(len, sent.payloads[-3:])) < 100
    assert len(sent.payloads[0]) > 12 * N


@pytest.mark.parametrize("other", [info("another", 0), info("patched", 1, first="another")], ids=["loaded", "bodies"])
def test_new_scene_begins_with_all_bodies(publisher: StatePublisher, sent: Sent, other: SceneInfo) -> None:
    publisher.set_scene(other)
    assert publisher.read_keyframe() == (0, other.poses)
    publish(publisher, 1)
    assert len(sent.payloads[-1]) > 12 * N
    assert publisher.read_keyframe()[0] == WINDOW + 6, "frames are numbered on"
