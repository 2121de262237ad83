"""The picture in the headset: what a behaviour sees of the world, late as it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from anchors.pose import PoseTuple, Vec3, compose
from iris_session.client import Client, PoseBuffer, SceneState, ShownPoses
from iris_session.client.core.scene_follower import pose_at


class Display:
    """What the person sees, world frame: `OperatorView` of the behaviours. The picture is late on purpose."""

    def __init__(self, client: Client, delay_s: float) -> None:
        self._client = client
        self.buffer = PoseBuffer(int(delay_s * 1e9))
        self.hands: dict[str, PoseTuple] = {}
        self._vertices: dict[str, tuple[NDArray[np.floating], int]] = {}
        #: A behaviour has asked for a vertex: somebody must tell where they are.
        self.wants_vertices = False
        self._epoch = 0
        self._shown: ShownPoses | None = None
        self._now_ns = 0

    def take(self, state: SceneState) -> None:
        """A new state came."""
        if state.header.scene_epoch != self._epoch:
            self._epoch = state.header.scene_epoch
            self.buffer.clear()
            self._vertices.clear()
        self.buffer.add(state.header.session_time, state.poses)

    def take_vertices(self, deformable: str, p_world: NDArray[np.floating], capture_ns: int) -> None:
        """New positions of all vertices of a deformable came [m], in the order of the model, and of which session time
        they are."""
        self._vertices[deformable] = p_world, capture_ns

    def refresh(self, session_ns: int) -> None:
        """The next picture."""
        self._now_ns = max(self._now_ns, session_ns)
        self._shown = self.buffer.poses_at(self._now_ns)

    @property
    def ready(self) -> bool:
        return self._shown is not None

    @property
    def session_time_ns(self) -> int:
        return self._now_ns

    @property
    def estop(self) -> bool:
        return self._client.mirror.estop

    def body_pose(self, name: str) -> PoseTuple | None:
        index = self._client.mirror.body_index.get(name)
        return None if index is None else self._pose(index)

    def tip_pose(self, robot: str) -> PoseTuple | None:
        tip = self._client.mirror.find_tip(robot)
        body = None if tip is None else self._pose(tip[0])
        return None if tip is None or body is None else compose(body, (tip[1].p, tip[1].q))

    def vertex(self, deformable: str, index: int) -> Vec3 | None:
        self.wants_vertices = True
        shown = self._vertices.get(deformable)
        if shown is None or not 0 <= index < len(shown[0]):
            return None
        x, y, z = shown[0][index].tolist()
        return (x, y, z)

    def vertices_ns(self, deformable: str) -> int:
        shown = self._vertices.get(deformable)
        return 0 if shown is None else shown[1]

    def lease_version(self, robot: str) -> int | None:
        return self._client.lease_version(robot)

    def device_pose(self, device: str) -> PoseTuple:
        return self.hands[device]

    def _pose(self, index: int) -> PoseTuple | None:
        shown = self._shown
        return None if shown is None or index >= len(shown.poses) else pose_at(shown.poses, index)
