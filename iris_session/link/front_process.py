"""`FrontProcess`: the parent's side of the front process, which starts, supervises, restarts and ends it.

Its only thread runs for some milliseconds while a front is replaced: ending a process that hangs and starting another
takes longer than a tick.
"""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec
import zmq

from iris_session.link.config import FrontConfig, FrontError, FrontStart, Ports, SceneInfo
from iris_session.link.front_link import FrontLink
from iris_session.link.media_source import MediaSource
from iris_session.protocol.common import Pose
from iris_session.protocol.media import StreamInfo
from iris_session.system.process import ChildProcess

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
        entries = process.link.poll()
        ...
        if not process.alive:
            process.restart()          # same ports, resume tokens stay valid
        process.close()

    The front runs in a session of its own, so Ctrl-C in the terminal reaches only the parent, which then closes it.
    """

    def __init__(self, config: FrontConfig, scene: SceneInfo) -> None:
        self._scene = scene
        self._folder = tempfile.TemporaryDirectory(prefix="iris-", dir=_find_socket_folder())  # mode 0700
        #: Endpoint to which processes of this session publish media; it is the same for every front.
        self.media_endpoint = f"ipc://{self._folder.name}/media"
        self._config = msgspec.structs.replace(config, media_endpoint=self.media_endpoint)
        self._generation = 0
        self._process: ChildProcess | None = None
        self._spawned_s = 0.0
        self._replacing: threading.Thread | None = None
        self._failure: FrontError | None = None
        self._source = MediaSource(self.media_endpoint)
        self._starvation = StarvationDetector()
        self.link = FrontLink(config)

    @property
    def pid(self) -> int:
        """Process id of the present front, 0 when there is none."""
        return 0 if self._process is None else self._process.pid

    @property
    def scene(self) -> SceneInfo:
        """The scene of this front and its successors."""
        return self._scene

    @property
    def alive(self) -> bool:
        """True while the front runs, reads its link and sends, or is being replaced."""
        if self._replacing is not None and self._replacing.is_alive():
            return True
        return not self.fault

    @property
    def fault(self) -> str:
        """Reason to replace the front, empty while it works."""
        process = self._process
        if process is None or not process.is_running:
            return f"ended ({self.link.failure})" if self.link.failure else "ended"
        if self.link.ports is None and time.monotonic() - self._spawned_s > START_S:
            return f"did not listen within {START_S:g} s"
        if self.link.overrun:
            return "read nothing any more"
        return "" if not self._is_hanging(process.pid) else f"said nothing for {self.link.silence_ns * 1e-9:.1f} s"

    def _is_hanging(self, pid: int) -> bool:
        silence_ns = self.link.silence_ns
        if silence_ns < _QUIET_NS:
            self._starvation.clear()
            return False
        starved = self._starvation.sample(pid, time.monotonic_ns())
        return silence_ns > (STARVED_NS if starved else HANGING_NS)

    @property
    def restarts(self) -> int:
        return max(0, self._generation - 1)

    def start(self, timeout_s: float = START_S) -> Ports:
        """Start the front and wait until it listens.

        Raises:
            FrontError: A port in use, a missing key, a wrong address; one line says what to do.
        """
        self._process = self._spawn(self._open_link())
        return self.wait_ready(timeout_s)

    def restart(self) -> None:
        """Replace a front that died or hangs, on the same ports. Does not wait: `link.ports` is set when it is ready.

        Raises:
            FrontError: The last try failed: the system gives no process, or no room for its files. Try again.
        """
        self._finish_replacing()
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
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
        start = self._open_link()
        self._replacing = threading.Thread(target=self._replace, args=(self._process, start), name="iris-front")
        self._replacing.start()

    def _replace(self, old: ChildProcess | None, start: FrontStart) -> None:
        if old is not None:
            old.close()  # dead or silent, so no step depends on it
        try:
            self._process = self._spawn(start)
        except FrontError as error:
            self._process, self._failure = None, error

    def _finish_replacing(self) -> None:
        if self._replacing is not None:
            self._replacing.join()
            self._replacing = None

    def set_scene(self, scene: SceneInfo) -> None:
        """Set the scene of this front and its successors."""
        self._scene = scene
        self.link.send_scene(scene)

    def set_anchors(self, anchors: dict[str, Pose]) -> None:
        """Set the present `T_world_anchor` for successors of this front; the running one gets them by events."""
        self._config = msgspec.structs.replace(self._config, anchors=anchors)

    def wait_ready(self, timeout_s: float) -> Ports:
        """Wait for `Ready`. Raises `FrontError` when the front fails, dies or is silent for `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            # In this order: once the thread has ended, the process is the new one.
            replacing = self._replacing is not None and self._replacing.is_alive()
            running = replacing or (self._process is not None and self._process.is_running)
            self.link.receive()
            if self.link.ports is not None:
                return self.link.ports
            if self.link.failure or not running:
                text = self.link.failure or str(self._failure or "")
                text = text or "the front process ended at its start, see its messages above"
                self.close()
                raise FrontError(text)
            time.sleep(0.002)
        self.close()
        raise FrontError(f"the front process was not ready after {timeout_s:g} s")

    def _open_link(self) -> FrontStart:
        """Listen for the next front and return its start configuration."""
        self._generation += 1
        try:
            endpoint = self.link.open(Path(self._folder.name) / f"front-{self._generation}")
        except zmq.ZMQError as error:
            raise _make_start_error(error) from error
        return FrontStart(self._config, self._scene, endpoint, os.getpid(), self.link.handback)

    def _spawn(self, start: FrontStart) -> ChildProcess:
        self._spawned_s = time.monotonic()
        try:
            return ChildProcess("iris_session.front.main", config=msgspec.msgpack.encode(start), own_session=True)
        except OSError as error:
            raise _make_start_error(error) from error

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

    def _stop_process(self, patience_s: float) -> None:
        if self._process is not None:
            self._process.close(exit_s=patience_s, terminate_s=0.2 if patience_s else 0.05)

    def close(self, timeout_s: float = 2.0) -> None:
        """Notify clients that the session ends, end the front, remove the link. May be called twice."""
        self._finish_replacing()
        self._source.close()
        self.link.send_end()
        self._stop_process(timeout_s if self.link.ports is not None else 0.0)
        self._process = None
        self.link.close()
        self._folder.cleanup()


def _make_start_error(error: OSError | zmq.ZMQError) -> FrontError:
    return FrontError(f"the front process cannot be started: {error.strerror or error}")


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
