"""What a client knows: mixin of `Client` that reads the mirror, the newest state, presence, clock and counters."""

from __future__ import annotations

import dataclasses
import threading
import time
from typing import Any

from anchors.pose import PoseTuple, compose
from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.state_stream import Poses, SceneState
from iris_session.protocol.common import Alignment
from iris_session.protocol.server_messages import PresenceItem
from iris_session.protocol.session_mirror import SessionMirror


def pose_at(poses: Poses, index: int) -> PoseTuple:
    """Row `index` of poses (n, 7) `x y z qw qx qy qz` as a pose."""
    x, y, z, qw, qx, qy, qz = poses[index].tolist()
    return ((x, y, z), (qw, qx, qy, qz))


class SceneView:
    """Everything is in the world frame. Nothing here waits or sends."""

    connection: ClientConnection
    _lock: threading.RLock
    _state: SceneState | None

    @property
    def participant_id(self) -> str:
        """Our id in this session, empty before the first welcome."""
        return self.connection.participant_id

    @property
    def mirror(self) -> SessionMirror:
        """The shared session state: `participants`, `leases`, `robots`, `bodies`, `paused`, `estop`, `event_seq`."""
        return self.connection.mirror

    @property
    def scene_DOT_version(self) -> tuple[str, str, int] | None:
        """Session id, scene hash and scene epoch, all of one moment; `None` while they are not known, as between
        hearing of another scene and its snapshot."""
        with self._lock:
            welcome, mirror = self.connection.welcome, self.connection.mirror
            if welcome is None or not mirror.synced:
                return None
            return welcome.session_id, mirror.scene_hash, mirror.scene_epoch

    @property
    def scene_DOT_state(self) -> SceneState | None:
        """The newest scene: header, poses (n, 7) in the world, age where it was handed over."""
        return self._state

    @property
    def scene_DOT_tick_period_ns(self) -> int:
        """Simulated time of one tick of the present scene [ns], 0 before the first welcome. Another scene that is
        loaded may have another."""
        welcome = self.connection.welcome
        return self.connection.mirror.tick_period_ns or (0 if welcome is None else welcome.tick_period_ns)

    @property
    def scene_DOT_presence(self) -> dict[tuple[str, str], PresenceItem]:
        """Heads and hands of everyone who is connected by `(participant, device)`, as they are now."""
        with self._lock:
            self.connection.stream.retain_presence(self.connection.mirror.connected)
            return dict(self.connection.stream.presence)

    @property
    def alignment(self) -> Alignment | None:
        """Our own `T_world_tracking` as accepted by the session, `None` before."""
        return self.connection.mirror.alignment(self.participant_id)

    def session_now_ns(self) -> int:
        """Session time now [ns], by our estimate; its error is at most `clock_error_ns()`."""
        return self.connection.clock.session_ns(time.monotonic_ns())

    def scene_DOT_data_age_ns(self) -> int | None:
        """Age of the newest scene [ns] now: it grows while nothing comes, whatever the reason, and while a program that
        publishes its world is silent. `None`: no scene yet.

        A paused session goes on sending: `state.header.sim_time` tells that physics stands.
        """
        state = self._state
        return None if state is None else self.session_now_ns() - state.header.session_time

    def clock_error_ns(self) -> int:
        """Bound of the error of `session_now_ns()` [ns]."""
        return self.connection.clock.error_bound_ns(time.monotonic_ns())

    def scene_DOT_body_pose(self, body: str) -> PoseTuple | None:
        """`T_world_body` in the newest scene; `None` when there is no such body or no scene yet, as for a moment after
        another one was loaded.

        Bodies whose poses come are those in `mirror.bodies`: all of a MuJoCo scene, of a publisher's only those that
        can move. Where something else stands is in the specification: `fetch_scene(client).spec.bodies`.
        """
        poses, index = self._placed, self.connection.mirror.body_index.get(body)
        return None if poses is None or index is None or index >= len(poses) else pose_at(poses, index)

    def scene_DOT_tip_pose(self, robot: str) -> PoseTuple | None:
        """`T_world_site` of a robot's end effector in the newest scene."""
        poses, tip = self._placed, self.connection.mirror.tip(robot)
        return None if poses is None or tip is None or tip[0] >= len(poses) else compose(pose_at(poses, tip[0]), tip[1])

    @property
    def _placed(self) -> Poses | None:
        """Newest poses of the bodies in `mirror`: none while those that came last are of the bodies before them."""
        state = self._state
        return None if state is None or state.header.scene_epoch < self.connection.mirror.bodies_since else state.poses

    def lease_version(self, target: str) -> int | None:
        """Our fencing token for a robot or object, `None` when it is not ours."""
        return self.connection.lease_version(target)

    def counters(self) -> dict[str, Any]:
        """Every count of something received, dropped, rejected or lost, by part."""
        connection, mirror = self.connection, self.connection.mirror
        return {
            "control": dataclasses.asdict(connection.counters),
            "state": dataclasses.asdict(connection.stream.counters),
            "events": {
                "gaps": mirror.gaps,
                "discarded": mirror.discarded,
                "held_overflow": mirror.held_overflow,
            },
            "clock": {"rejected": connection.clock.rejected, "rtt_ns": connection.clock.rtt_ns},
        }
