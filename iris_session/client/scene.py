"""`client.scene`: the scene as a client knows it now. Nothing here waits or sends."""

from __future__ import annotations

import threading
import time

from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.scene_follower import SceneFollower
from iris_session.client.errors import ClientError
from iris_session.protocol.server_messages import ROBOT_STATES, PresenceItem, RobotState


class ClientScene(SceneFollower):
    """Newest state, poses by name, presence, and the version of the scene. Everything is in the world frame.

    Specification, meshes and textures come from `iris_session.fetch_scene`, interpolated poses from
    `iris_session.PoseBuffer`.

    Attributes:
        state: The newest state: header, poses (n, 7), and its age when it was passed to the application.
    """

    def __init__(self, connection: ClientConnection, lock: threading.RLock) -> None:
        super().__init__(connection)
        self._lock = lock

    @property
    def version(self) -> tuple[str, str, int] | None:
        """Session id, scene hash and scene epoch, all of one moment.

        `None` while they are not known, as between the event of another scene and its snapshot.
        """
        with self._lock:
            return super().version

    @property
    def presence(self) -> dict[tuple[str, str], PresenceItem]:
        """Heads and hands of every connected participant by `(participant, device)`, as they are now."""
        with self._lock:
            stream = self._connection.stream
            stream.retain_presence(self._connection.mirror.connected)
            return dict(stream.presence)

    def robot_state(self, robot: str) -> RobotState | None:
        """Return the newest measured and commanded values of a robot: joints, gripper, end effector, force, target.

        Args:
            robot: Name of the robot.

        Returns:
            The values, units and conventions as in `RobotState`; `None` when there is no such robot or no state yet.

        Raises:
            ClientError: The client was made without `robot_states=True`.
        """
        if ROBOT_STATES not in self._connection.hello.capabilities:
            raise ClientError("states of robots are not received: make the client with robot_states=True")
        with self._lock:
            states = self._connection.stream.robots
        return next((one for one in states.robots if one.robot == robot), None) if states is not None else None

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
