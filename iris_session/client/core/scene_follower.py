"""Scene of a client: pairs the newest poses with the bodies they belong to, over resets, patches and loaded scenes.

Poses travel by row, names of rows by snapshot and events, on two channels: after another scene was loaded, state of
either scene may come before or after the event. Poses are shown only while both are of the same bodies.
"""

from __future__ import annotations

from anchors.pose import PoseTuple, compose
from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.state_stream import Poses, SceneState


def pose_at(poses: Poses, index: int) -> PoseTuple:
    """Return row `index` of poses (n, 7) `x y z qw qx qy qz` as `((x, y, z), (w, x, y, z))`."""
    x, y, z, qw, qx, qy, qz = poses[index].tolist()
    return ((x, y, z), (qw, qx, qy, qz))


class SceneFollower:
    """Newest state of a connection, with the bodies of its mirror. Everything is in the world frame.

    Attributes:
        state: The newest state: header, poses (n, 7), and its age when it was passed to the application.
    """

    def __init__(self, connection: ClientConnection) -> None:
        self.state: SceneState | None = None
        self._connection = connection
        self._session_id = ""

    def on_state(self, state: SceneState) -> None:
        """Take the newest state."""
        self.state = state

    def on_welcome(self) -> None:
        """Drop the state of another session; call it after every welcome."""
        welcome = self._connection.welcome
        if welcome is not None and welcome.session_id != self._session_id:
            self._session_id, self.state = welcome.session_id, None

    @property
    def version(self) -> tuple[str, str, int] | None:
        """Session id, scene hash and scene epoch, all of one moment.

        `None` while they are not known, as between the event of another scene and its snapshot.
        """
        welcome, mirror = self._connection.welcome, self._connection.mirror
        if welcome is None or not mirror.synced:
            return None
        return welcome.session_id, mirror.scene_hash, mirror.scene_epoch

    @property
    def tick_period_ns(self) -> int:
        """Simulated time of one tick of the present scene [ns], 0 before the first welcome.

        Another scene that is loaded may have another.
        """
        welcome = self._connection.welcome
        return self._connection.mirror.tick_period_ns or (0 if welcome is None else welcome.tick_period_ns)

    @property
    def poses(self) -> Poses | None:
        """Newest poses (n, 7) `x y z qw qx qy qz` of `mirror.bodies`, world frame, read-only.

        `None` without state, and for a moment after another scene was loaded.
        """
        state = self.state
        if state is None or state.header.scene_epoch < self._connection.mirror.bodies_since:
            return None
        return state.poses

    def body_pose(self, body: str) -> PoseTuple | None:
        """Return `T_world_body` in the newest state.

        Bodies with poses are those in `client.mirror.bodies`: all of a MuJoCo scene, of a publisher's only those that
        can move. Poses of the others are in the specification: `fetch_scene(client).spec.bodies`.

        Args:
            body: Name of the body.

        Returns:
            `((x, y, z) [m], (w, x, y, z))`, or `None` when there is no such body or no state yet, as for a moment
            after another scene was loaded.
        """
        poses, index = self.poses, self._connection.mirror.body_index.get(body)
        return None if poses is None or index is None or index >= len(poses) else pose_at(poses, index)

    def tip_pose(self, robot: str) -> PoseTuple | None:
        """Return `T_world_site` of a robot's end effector in the newest state.

        Args:
            robot: Name of the robot.

        Returns:
            `((x, y, z) [m], (w, x, y, z))`, or `None` when there is no such robot or no state yet.
        """
        poses, tip = self.poses, self._connection.mirror.find_tip(robot)
        if poses is None or tip is None or tip[0] >= len(poses):
            return None
        index, T_body_site = tip
        return compose(pose_at(poses, index), (T_body_site.p, T_body_site.q))
