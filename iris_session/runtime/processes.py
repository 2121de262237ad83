"""The processes of a session besides the authority: front and recorder. Started, watched, replaced, ended.

A front that dies is replaced on the same ports (clients reconnect and resume); a recorder that dies is replaced and
goes on in a new part of the recording. Both are announced, neither stops a step. A process that dies again and again
is tried at growing distances.
"""

from __future__ import annotations

import datetime
import logging
import secrets
from collections.abc import Callable
from typing import Final

import msgspec
import numpy as np

from iris_session.physics import World
from iris_session.protocol.client_messages import Marker
from iris_session.protocol.common import Pose
from iris_session.recording import (
    CLOSED,
    OPEN,
    RecorderFeed,
    RecorderProcess,
    RecordingError,
    SessionHeader,
    header_root,
    pack_model,
)
from iris_session.recording.versions import environment
from iris_session.runtime.config import SessionConfig
from iris_session.runtime.core import SessionCore
from iris_session.runtime.errors import StartError
from iris_session.runtime.stepper import Stepper
from iris_session.transport import FrontConfig, FrontError, FrontProcess, SceneInfo

WATCH_PERIOD_NS: Final = 50_000_000
RESTART_BACKOFF_NS: Final = (0, 500_000_000, 1_000_000_000, 2_000_000_000, 5_000_000_000)
#: A process that lived this long is taken as healthy again.
HEALTHY_NS: Final = 30_000_000_000
#: A recorder says something twice a second. It is not ended when it hangs: a slow disk would delay its successor too.
HANGING_NS: Final = 5_000_000_000

_log = logging.getLogger(__name__)


class _Watch:
    """When a dead process may be started again."""

    def __init__(self) -> None:
        self.failures = 0
        self.restarts = 0
        self._last_ns = 0
        self._due_ns = 0

    def dead(self, now_ns: int) -> bool:
        """True when it is time to start it again; counts the restart."""
        if not self._due_ns:
            if now_ns - self._last_ns > HEALTHY_NS:
                self.failures = 0
            self._due_ns = now_ns + RESTART_BACKOFF_NS[min(self.failures, len(RESTART_BACKOFF_NS) - 1)]
        if now_ns < self._due_ns:
            return False
        self._due_ns = 0
        self._last_ns = now_ns
        self.failures += 1
        self.restarts += 1
        return True


class SessionProcesses:
    """Front and recorder of one session. `start` raises `StartError` with one line."""

    def __init__(
        self,
        config: SessionConfig,
        world: World,
        origin_ns: int,
    ) -> None:
        self._config = config
        self._origin_ns = origin_ns
        self.session_id = secrets.token_hex(8)
        self.recording = config.recording_path()
        self._scene, self._tick_period_ns = _scene_info(world), world.tick_period_ns
        self.state_period_ns = round(1e9 / config.state_hz)
        self.recorder: RecorderProcess | None = None
        self.feed: RecorderFeed | None = None
        self.front: FrontProcess | None = None
        self._front_watch = _Watch()
        self._recorder_watch = _Watch()
        self._recorder_hangs = False
        self._next_watch_ns = 0
        self._address = ""

    def start(self) -> None:
        """Starts the recorder, then the front; ends both again when one fails."""
        try:
            if self.recording is not None:
                self.recorder = RecorderProcess(self.recording, self._origin_ns)
                self.recorder.start()
                self.feed = RecorderFeed(self.recorder.feed_endpoint, self.recording.parent)
            self.front = FrontProcess(self._front_config(), self._scene)
            ports = self.front.start()
            self._address = f"{ports.host}:{ports.control}"
        except (FrontError, RecordingError) as error:
            self.close()
            raise StartError(str(error)) from error
        except BaseException:
            self.close()
            raise

    def _front_config(self) -> FrontConfig:
        config = self._config
        return FrontConfig(
            host=config.host,
            control_port=config.control_port,
            state_port=config.state_port,
            session_id=self.session_id,
            session_name=config.name,
            origin_ns=self._origin_ns,
            tick_period_ns=self._tick_period_ns,
            state_period_ns=self.state_period_ns,
            curve_secret_file=config.curve_key,
            curve_clients_dir=config.curve_clients,
            anchors={name: Pose(*T_world_anchor) for name, T_world_anchor in config.anchors.items()},
            recorder_endpoint="" if self.recorder is None else self.recorder.samples_endpoint,
        )

    @property
    def address(self) -> str:
        """`host:port` of the control channel; it stays the same when the front is replaced."""
        return self._address

    def make_stepper(self, core: SessionCore, clock: Callable[[], int], *, user_owned: bool) -> Stepper:
        """The stepper of this session's core, tied to the front's link and the recorder's feed."""
        assert self.front is not None
        chain = b""
        if self.feed is not None:
            header = self._header(core, OPEN if user_owned else CLOSED)
            self.feed.header(header)
            chain = header_root(header)
        keyframe_ns = round(self._config.keyframe_s * 1e9)
        return Stepper(core, self.front.link, self.feed, clock, self.state_period_ns, keyframe_ns, chain)

    def _header(self, core: SessionCore, recording_class: str) -> SessionHeader:
        return SessionHeader(
            session_id=self.session_id,
            session_name=self._config.name,
            recording_class=recording_class,
            tick_period_ns=self._tick_period_ns,
            config=msgspec.msgpack.encode(core.config),
            model=pack_model(core.world.model_bytes()),
            scene_hash=core.world.scene_hash,
            robots=core.config.robots,
            objects=core.config.objects,
            bodies=core.world.bodies,
            versions=environment(),
            created_utc=datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds"),
        )

    def watch(self, stepper: Stepper) -> None:
        """Replaces what has died. Call after every step: it looks at most every 50 ms."""
        now_ns = stepper.clock()
        if now_ns < self._next_watch_ns:
            return
        self._next_watch_ns = now_ns + WATCH_PERIOD_NS
        if self.front is not None and not self.front.alive and self._front_watch.dead(now_ns):
            stepper.post(Marker(request_id=0, text=f"the front process ended and {_replaced(self.front.restart)}"))
        if self.recorder is not None and not self.recorder.alive and self._recorder_watch.dead(now_ns):
            failure = self.recorder.failure or "the recorder ended"
            stepper.post(Marker(request_id=0, text=f"{failure}; it {_replaced(self.recorder.restart)}"))
        hangs = self.feed is not None and self.feed.silence_ns > HANGING_NS
        if hangs and not self._recorder_hangs:
            stepper.post(Marker(request_id=0, text="the recorder hangs: what it does not take waits on the disk"))
        self._recorder_hangs = hangs

    @property
    def front_pid(self) -> int:
        return 0 if self.front is None else self.front.pid

    @property
    def recorder_pid(self) -> int:
        return 0 if self.recorder is None else self.recorder.pid

    def drops(self) -> dict[str, int]:
        """Everything that was not delivered, by reason."""
        drops: dict[str, int] = {}
        if self.front is not None:
            drops.update(self.front.link.status.drops)
            drops["state_to_front"] = self.front.link.state_drops
        if self.feed is not None:
            drops["journal_rows"] = self.feed.stats.dropped_rows
            drops["recorded_items"] = self.feed.stats.dropped_items
        return {reason: count for reason, count in drops.items() if count}

    def restarts(self) -> dict[str, int]:
        return {"front": self._front_watch.restarts, "recorder": self._recorder_watch.restarts}

    def close(self) -> None:
        """Ends the front (its clients are told), then finishes the recording. May be called twice."""
        if self.front is not None:
            self.front.close()
            self.front = None
        if self.feed is not None:
            if not self.feed.close():
                _log.error("the end of the recording is missing: the recorder did not write all of it in time")
            self.feed = None
        if self.recorder is not None:
            self.recorder.close()
            self.recorder = None


def _replaced(restart: Callable[[], None]) -> str:
    """Starts a process anew. One that cannot be started now (no memory, a full disk) ends no session."""
    try:
        restart()
    except (FrontError, RecordingError) as error:
        return f"is not replaced: {error}"
    return "was replaced"


def _scene_info(world: World) -> SceneInfo:
    poses = np.zeros((len(world.bodies), 7))
    world.poses(poses)
    return SceneInfo(world.scene_hash, world.robot_infos, world.bodies, poses.tobytes())
