"""`client.scene`: the scene as a client knows it now. Everything is in the world frame; nothing here waits or sends."""

from __future__ import annotations

import threading
import time

from anchors.pose import PoseTuple
from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.scene_follower import SceneFollower
from iris_session.client.core.state_stream import Poses, SceneState
from iris_session.protocol.server_messages import PresenceItem


class ClientScene:
    """Newest state, poses by name, presence, and the version of the scene.

    Specification, meshes and textures come from `iris_session.fetch_scene`, interpolated poses from
    `iris_session.PoseBuffer`.
    """

    def __init__(self, connection: ClientConnection, lock: threading.RLock) -> None:
        self._connection = connection
        self._lock = lock
        self._follower = SceneFollower(connection)

    @property
    def state(self) -> SceneState | None:
        """The newest state: header, poses (n, 7) in the world, and its age when it was passed to the application."""
        return self._follower.state

    @property
    def poses(self) -> Poses | None:
        """Newest poses (n, 7) `x y z qw qx qy qz` of `mirror.bodies`, world frame, read-only.

        `None` without state, and for a moment after another scene was loaded.
        """
        return self._follower.poses

    @property
    def version(self) -> tuple[str, str, int] | None:
        """Session id, scene hash and scene epoch, all of one moment.

        `None` while they are not known, as between the event of another scene and its snapshot.
        """
        with self._lock:
            return self._follower.version

    @property
    def tick_period_ns(self) -> int:
        """Simulated time of one tick of the present scene [ns], 0 before the first welcome.

        Another scene that is loaded may have another.
        """
        return self._follower.tick_period_ns

    @property
    def presence(self) -> dict[tuple[str, str], PresenceItem]:
        """Heads and hands of every connected participant by `(participant, device)`, as they are now."""
        with self._lock:
            stream = self._connection.stream
            stream.retain_presence(self._connection.mirror.connected)
            return dict(stream.presence)

    def data_age_ns(self) -> int | None:
        """Return the age of the newest state now [ns].

        It grows while nothing comes, for any reason, and while a program that publishes its world is silent. A paused
        session continues to send: `state.header.sim_time` shows that physics stands.

        Returns:
            The age, or `None` before the first state.
        """
        state = self.state
        if state is None:
            return None
        return self._connection.clock.session_ns(time.monotonic_ns()) - state.header.session_time

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
        return self._follower.body_pose(body)

    def tip_pose(self, robot: str) -> PoseTuple | None:
        """Return `T_world_site` of a robot's end effector in the newest state.

        Args:
            robot: Name of the robot.

        Returns:
            `((x, y, z) [m], (w, x, y, z))`, or `None` when there is no such robot or no state yet.
        """
        return self._follower.tip_pose(robot)

    # --- for the client -----------------------------------------------------------------------------------------------

    def on_state(self, state: SceneState) -> None:
        """Take the newest state."""
        self._follower.on_state(state)

    def on_welcome(self) -> None:
        """Drop the state of another session."""
        self._follower.on_welcome()
