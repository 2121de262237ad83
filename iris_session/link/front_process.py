"""`FrontProcess`: the parent's side of the front process: how it starts, when it counts as hanging, how it ends."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec
import zmq

from iris_session.link.config import FrontConfig, FrontError, FrontStart, Ports, SceneInfo
from iris_session.link.front_link import FrontLink
from iris_session.link.media_source import MediaSource
from iris_session.protocol.media import StreamInfo
from iris_session.system.process import ChildProcess
from iris_session.system.supervised import SHORT_RESTART_DELAYS_NS, NoReport, SupervisedProcess, describe_exit

#: Longest path of a folder that leaves room for the names of folder and socket in it [bytes].
LONGEST_FOLDER: Final = 75
#: Time for a front to listen [s].
START_S: Final = 60.0
#: A front sends something at least every `messages.BEAT_NS`, even when busy; one that is silent for so long hangs.
HANGING_NS: Final = 1_500_000_000
#: The same for a front that the system does not schedule.
STARVED_NS: Final = 15_000_000_000
#: From this silence on the processor time of the front is sampled.
_QUIET_NS: Final = 500_000_000


class FrontProcess:
    """The front process of a session, and its successors after a restart.

        process = FrontProcess(config, scene)
        ports = process.start()
        while ...:
            entries = process.link.poll()
            announcements = process.poll(now_ns)  # restarts on the same ports, resume tokens stay valid
        process.close()

    The front runs in a session of its own, so Ctrl-C in the terminal reaches only the parent, which then closes it.

    Attributes:
        media_endpoint: Endpoint to which processes of this session publish media; it is the same for every front.
        anchors: Present `T_world_anchor` for successors of this front; the running one gets them by events.
    """

    def __init__(self, config: FrontConfig, scene: SceneInfo) -> None:
        self._scene = scene
        self._folder = tempfile.TemporaryDirectory(prefix="iris-", dir=_find_socket_folder())  # mode 0700
        self.media_endpoint = f"ipc://{self._folder.name}/media"
        self._config = msgspec.structs.replace(config, media_endpoint=self.media_endpoint)
        self.anchors = config.anchors
        self._generation = 0
        self._spawned_s = 0.0
        self._source = MediaSource(self.media_endpoint)
        self._starvation = StarvationDetector()
        self.link = FrontLink(config)
        self._supervised = SupervisedProcess(
            "the front process",
            self._spawn,
            NoReport,
            delays_ns=SHORT_RESTART_DELAYS_NS,
            prepare=self._open_link,
            find_fault=lambda _: self._find_fault(),
            describe_exit=lambda status: f"ended ({self.link.failure})" if self.link.failure else describe_exit(status),
        )

    @property
    def pid(self) -> int:
        """Process id of the present front, 0 when there is none."""
        return self._supervised.pid

    @property
    def restarts(self) -> int:
        """Number of times that the front was replaced."""
        return self._supervised.restarts

    def start(self, timeout_s: float = START_S) -> Ports:
        """Start the front and wait until it listens.

        Raises:
            FrontError: A port in use, a missing key, a wrong address; one line says what to do.
        """
        try:
            process = self._supervised.start_now()
        except (OSError, zmq.ZMQError) as error:
            raise FrontError(f"the front process cannot be started: {error.strerror or error}") from error
        text = f"the front process was not ready after {timeout_s:g} s"
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            is_running = process.is_running
            self.link.receive()
            if self.link.ports is not None:
                return self.link.ports
            if self.link.failure or not is_running:
                text = self.link.failure or "the front process ended at its start, see its messages above"
                break
            time.sleep(0.002)
        self.close()
        raise FrontError(text)

    def poll(self, now_ns: int) -> list[str]:
        """Replace a front that died or hangs, on the same ports. Never waits: `link.ports` is set when it is ready.

        Args:
            now_ns: Session time.

        Returns:
            What is to be announced, one line each.
        """
        return self._supervised.poll(now_ns)

    def set_scene(self, scene: SceneInfo) -> None:
        """Set the scene of this front and its successors."""
        self._scene = scene
        self.link.send_scene(scene)

    def _find_fault(self) -> str:
        """Return the reason to replace a front that runs, empty while it works."""
        silence_ns = self.link.silence_ns
        if self.link.ports is None and time.monotonic() - self._spawned_s > START_S:
            return f"did not listen within {START_S:g} s"
        if self.link.overrun:
            return "read nothing any more"
        if silence_ns < _QUIET_NS:
            self._starvation.clear()
            return ""
        starved = self._starvation.sample(self.pid, time.monotonic_ns())
        is_hanging = silence_ns > (STARVED_NS if starved else HANGING_NS)
        return f"said nothing for {silence_ns * 1e-9:.1f} s" if is_hanging else ""

    def _open_link(self) -> None:
        """Listen for the next front, which takes the ports of the one before."""
        ports = self.link.ports
        if ports is not None:
            self._config = msgspec.structs.replace(
                self._config,
                control_port=ports.control,
                state_port=ports.state,
                media_port=ports.media,
                media_ingest_port=ports.media_ingest,
                assets_port=ports.assets,
            )
        self._generation += 1
        endpoint = self.link.open(Path(self._folder.name) / f"front-{self._generation}")
        config = msgspec.structs.replace(self._config, anchors=self.anchors)
        self._start = FrontStart(config, self._scene, endpoint, os.getpid(), self.link.handback)

    def _spawn(self) -> ChildProcess:
        self._spawned_s = time.monotonic()
        start = msgspec.msgpack.encode(self._start)
        return ChildProcess("iris_session.front.main", config=start, own_session=True)

    def publish_media(
        self,
        stream: str,
        frames: bytes | Mapping[str, bytes],
        capture_ns: int,
        scene_epoch: int,
        encoding: str,
        *,
        info: StreamInfo | None = None,
        sent_ns: int = 0,
    ) -> bool:
        """Send a frame to the present front; see `MediaSource.publish`."""
        return self._source.publish(stream, frames, capture_ns, scene_epoch, encoding, info=info, sent_ns=sent_ns)

    def close(self, timeout_s: float = 2.0) -> None:
        """Notify clients that the session ends, end the front, remove the link. May be called twice."""
        self._source.close()
        self._supervised.stop_restarts(timeout_s)
        self.link.send_end()
        is_ready = self.link.ports is not None
        self._supervised.close(0.2 if is_ready and timeout_s else 0.05, exit_s=timeout_s if is_ready else 0.0)
        self.link.close()
        self._folder.cleanup()


def _find_socket_folder() -> str | None:
    """Return a folder short enough for socket paths, which have at most 107 bytes; `None` when the default is."""
    return None if len(os.fsencode(tempfile.gettempdir())) <= LONGEST_FOLDER else "/tmp"


#: Share of the time since the first sample that a starved process waited for a processor.
_STARVED_SHARE: Final = 0.5


class StarvationDetector:
    """Detector of a silent process that does not hang but is not scheduled. Only a hanging process should be replaced.

    The successor of a starved process would not be scheduled either, would take longer than the old one to answer, and
    would cost every client its connection. Linux only; elsewhere, and for a process that has ended, nothing counts as
    starved.

    `sample` costs some 30 us: call it only while the process is silent, and `clear` when it is no longer.
    """

    def __init__(self) -> None:
        self._pid = 0
        self._first_ns = 0
        self._ran_ns = 0
        self._waited_ns = 0

    def clear(self) -> None:
        """Begin anew with the next sample."""
        self._pid = 0

    def sample(self, pid: int, now_ns: int) -> bool:
        """Return whether the process mostly could not run since the first sample, which only begins the count."""
        try:
            ran_ns, waited_ns = _read_times(pid)
            ready = _read_state(pid) == "R"
        except (OSError, ValueError, IndexError):
            return False
        if pid != self._pid:
            self._pid, self._first_ns, self._ran_ns, self._waited_ns = pid, now_ns, ran_ns, waited_ns
            return ready
        enough_ns = _STARVED_SHARE * (now_ns - self._first_ns)
        # The kernel counts a wait when it ends; a wait in progress shows only in the state.
        return waited_ns - self._waited_ns >= enough_ns or (ready and ran_ns - self._ran_ns < enough_ns)


def _read_times(pid: int) -> tuple[int, int]:
    """Return time on a processor and time ready without one [ns] (Documentation/scheduler/sched-stats.rst)."""
    ran, waited, _ = Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii").split()
    return int(ran), int(waited)


def _read_state(pid: int) -> str:
    """Return the state letter of proc_pid_stat(5): R running or ready, T stopped. It follows the name, which may hold
    anything."""
    return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[0]
