"""`SessionBase`: operations of the program that embeds a session, common to all ways in which its world advances.

`Session` (a MuJoCo scene) and `ScenePublisher` (any other world) add how the world advances.
"""

from __future__ import annotations

import os
import signal
import threading
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

from iris_session.physics import Pacer
from iris_session.protocol.client_messages import ClearEStop, Episode, EStop, Marker
from iris_session.protocol.entries import EntryMessage, OwnerListens, ScenePatched
from iris_session.protocol.media import StreamInfo
from iris_session.protocol.names import EpisodeAction, MediaEncoding
from iris_session.protocol.scene import PatchOp, SceneError, SceneSpec
from iris_session.protocol.server_messages import EpisodeChanged, Event
from iris_session.session.config import SessionConfig
from iris_session.session.errors import ConfigError, OwnershipError
from iris_session.session.processes import SessionProcesses
from iris_session.session.scene_change import check_patch
from iris_session.session.status import DataFault, SessionStatus, make_session_status
from iris_session.session.stepper import NextPatch, OwnerRequest, PendingInputs, Stepper


class SessionBase:
    """Base of `Session` and `ScenePublisher`: one session, as seen by the process that owns it."""

    config: SessionConfig
    clock: Callable[[], int]
    _stop: threading.Event
    _inputs: PendingInputs
    _processes: SessionProcesses | None = None
    _stepper: Stepper | None = None
    _pacer: Pacer | None = None
    _scheduling = "normal"
    _recording: Path | None = None  # of the closed session
    _is_closed = False
    _listens = False  # to requests
    _process = 0  # that has started it
    _start_notes: tuple[str, ...] = ()

    # --- life --------------------------------------------------------------------------------------------------------

    @abstractmethod
    def start(self) -> None: ...

    @abstractmethod
    def close(self) -> bool: ...

    def _find_data_fault(self) -> DataFault | None:
        """Return what is not finite in the data of a user loop."""
        return None

    @abstractmethod
    def _hold_steps(self) -> AbstractContextManager[object]:
        """Return a context in which no helper thread takes a step."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self.close()

    def stop(self) -> None:
        """End `run()` after the step in progress. May be called from another thread or a signal handler."""
        self._stop.set()

    @property
    def stopping(self) -> bool:
        """True from `stop()`, Ctrl-C, SIGTERM or `close()` on."""
        return self._stop.is_set()

    @contextmanager
    def signals(self) -> Iterator[None]:
        """Make Ctrl-C, SIGTERM and SIGHUP set `stopping` and end `run()` inside the context, also before it.

        SIGHUP stays ignored where it was (`nohup`). A second Ctrl-C raises `KeyboardInterrupt`. In another thread than
        the main one the context does nothing.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def on_signal(number: int, _: FrameType | None) -> None:
            if self._stop.is_set() and number == signal.SIGINT:
                raise KeyboardInterrupt  # the second Ctrl-C interrupts at once
            if number == signal.SIGHUP:
                _leave_terminal()
            self._stop.set()

        numbers = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            numbers.append(signal.SIGHUP)
        previous = {s: signal.signal(s, on_signal) for s in numbers}
        try:
            yield
        finally:
            for s, handler in previous.items():
                signal.signal(s, handler)

    # --- inputs of the owner -----------------------------------------------------------------------------------------

    def post(self, message: EntryMessage) -> None:
        """Queue an input of the owner (connection 0, rights of a director) for the next step. From any thread.

        Args:
            message: A message of `iris_session.protocol.client_messages`.

        Raises:
            ValueError: A value that the protocol does not allow.
            OwnershipError: The queue is full, or the session is closed; a `ScenePublisher` must be started, too.
        """
        self._require_steps()
        self._inputs.post(message)

    def estop(self, reason: str = "") -> None:
        """Stop every robot until `clear_estop()`. Not a safety-rated stop.

        Args:
            reason: Text for participants and the recording; any text is accepted.

        Raises:
            OwnershipError: The session is closed; a `ScenePublisher` must be started, too.
        """
        self.post(EStop(reason=str(reason).encode("utf-8", "replace").decode()))

    def clear_estop(self) -> None:
        """Allow motion again after an e-stop. Participants must clutch again.

        It ends the stops of all steps so far. When another comes before the next step, the session stays stopped;
        `status().stops` lists who has stopped it.
        """
        seen = 0 if self._stepper is None else self._stepper.core.authority.stop_seq
        self.post(ClearEStop(request_id=0, stop_seq=seen))

    def marker(self, text: str) -> None:
        """Put a note into the recording, and show it to participants.

        Args:
            text: The note.

        Raises:
            ValueError: `text` is not a valid string.
        """
        self.post(Marker(request_id=0, text=text))

    @property
    def episode(self) -> EpisodeChanged | None:
        """The present or last episode; `None` before the first, unless there is a task."""
        return None if self._stepper is None else self._stepper.core.authority.episode

    def start_episode(self, label: str = "", *, countdown_s: float | None = None) -> None:
        """Start an episode with the next step. What the session denies is in its log; `episode` says how it stands.

        Args:
            label: Free text about it.
            countdown_s: Time until it is recorded, 0 to 60 [s]; `None` for 3.
        """
        countdown_ns = None if countdown_s is None else round(countdown_s * 1e9)
        self.post(Episode(0, EpisodeAction.START, label, countdown_ns))

    def end_episode(self, verdict: str = EpisodeAction.SUCCESS) -> None:
        """Give the verdict of the episode: `success`, `failure`, `unknown`; `stop` lets robots hold until it comes."""
        self.post(Episode(0, verdict))

    def discard_episode(self, *, again: bool = False) -> None:
        """Discard the episode, or cancel its countdown. It is asked for twice: call it again within 3 s.

        Args:
            again: Count down to the same number again.
        """
        self.post(Episode(0, EpisodeAction.RERECORD if again else EpisodeAction.DISCARD))

    def take_over_episode(self) -> None:
        """Lead the episode from the next step on, instead of a participant."""
        self.post(Episode(0, EpisodeAction.TAKE_OVER))

    def poll_requests(self) -> list[OwnerRequest]:
        """Return what participants ask of your loop, oldest first, each once: to reset, to record an episode again.

        Until the first call such requests are denied (`user_owned`), because a loop that does not look would never
        answer; they are returned all the same. `run()` resets by itself and leaves no requests.

        Returns:
            At most 64 requests since the last call. Fulfil them by resetting your world: the session sees by itself
            that time goes back; call `reset()` where it does not.

        Raises:
            OwnershipError: The session is closed, or a `ScenePublisher` is not started.
        """
        if not self._listens:
            self.post(OwnerListens())
            self._listens = True
        found: list[OwnerRequest] = []
        while self._stepper is not None and self._stepper.requests:
            found.append(self._stepper.requests.popleft())
        return found

    def publish_media(
        self,
        stream: str,
        frames: bytes | Mapping[str, bytes],
        *,
        capture_ns: int | None = None,
        encoding: str = MediaEncoding.BYTES,
        info: StreamInfo | None = None,
    ) -> bool:
        """Publish the newest frame of a media stream to every client that subscribed to it. From any thread.

        Publish that of a stream at rest again at least every 10 s: a front that is restarted has lost it.

        Args:
            stream: Name of the stream.
            frames: Bytes of the frame, or bytes by class: `full`, and the coarser `half` and `quarter`. For a class
                that is left out, clients get every second or fourth frame of the next better one. Empty, with `info`:
                no frame, only the description.
            capture_ns: Session time of the capture [ns], as of `session.clock()`. Default: now.
            encoding: Format of the bytes, for the subscribers.
            info: Description of the stream, for clients that have not subscribed to it and for status. Give it with the
                first frames, when it changes, and once a second; the default leaves it as it was.

        Returns:
            False when the frame is dropped: the front accepts none now, or the session is closing.

        Raises:
            ValueError: A name that no stream can have or that belongs to a deformable of the scene, an unknown class,
                more than 8 MiB, or an `info` with a value out of range.
            OwnershipError: The session is not started.
        """
        processes = self._require_started()
        if stream in processes.own_stream_names():
            raise ValueError(f"stream {stream!r} carries the vertices of a deformable of the scene: take another name")
        front = processes.front
        if front is None:  # the session is closing
            return False
        last = None if self._stepper is None else self._stepper.last
        epoch = 0 if last is None else last.decision.scene_epoch
        now_ns = self.clock()
        capture_ns = now_ns if capture_ns is None else capture_ns
        return front.publish_media(stream, frames, capture_ns, epoch, encoding, info=info, sent_ns=now_ns)

    def patch_scene(self, *ops: PatchOp) -> None:
        """Change how the scene is drawn for every client: colours, visibility, poses of visuals, decoration.

        Physics is not affected. The change is seen as a whole, with the next step. From any thread.

        Args:
            ops: At most 64 operations, which refer to the specification `session.scene`.

        Raises:
            ConfigError: An operation does not fit the scene; nothing is changed.
            OwnershipError: The session is not started.
        """
        scenes = self._require_started().scenes
        self._require_steps()
        try:
            checked = check_patch(ops)
            with scenes.lock:
                shown = scenes.patch(checked)
                self._inputs.queue_scene(NextPatch(ScenePatched(checked, shown.info.scene_hash), shown))
                scenes.show(shown)
        except (SceneError, OSError, RuntimeError) as error:
            raise ConfigError(f"patch_scene: {error}") from error

    # --- state of the session ----------------------------------------------------------------------------------------

    def status(self) -> SessionStatus:
        """Return the status of the session. It may be called before `start` and after `close`.

        Returns:
            Participants and their leases, lateness of ticks, drops and restarts.
        """
        processes, stepper = self._processes, self._stepper
        with self._hold_steps():
            own: dict[str, Any] = {"scheduling": self._scheduling, "data_fault": self._find_data_fault()}
            if processes is not None:
                own |= {"drops": processes.count_drops(), "restarts": processes.count_restarts()}
            if stepper is None or stepper.last is None:
                return SessionStatus(**own)
            return make_session_status(stepper, self._pacer, **own)

    def recent_events(self) -> list[Event]:
        """Return the newest events.

        Returns:
            At most 200 events, oldest first; the recording has them all.
        """
        with self._hold_steps():
            return [] if self._stepper is None else list(self._stepper.view.recent)

    @property
    def scene(self) -> SceneSpec | None:
        """Specification from which clients draw the scene, with all patches; `None` when the session shares none."""
        newest = self._require_started().scenes.newest
        return None if newest is None else newest.spec

    @property
    def processes(self) -> SessionProcesses:
        """Front and recorder, for benchmarks and tests; not part of the public API."""
        return self._require_started()

    @property
    def address(self) -> str:
        """`host:port` of the control channel, which is all that a client needs."""
        return self._require_started().address

    @property
    def name(self) -> str:
        """Name of the session: `config.name`, with a number when another session on the network has that name."""
        return self.config.name if self._processes is None else self._processes.name

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user, one line each: how the session started (another name, other addresses), which robots can
        only be watched, and which parts of the present scene clients do not see."""
        live = self._processes
        shown = () if live is None else (*live.notes, *live.scenes.notes)
        return tuple(dict.fromkeys((*self._start_notes, *self._list_world_notes(), *shown)))

    @property
    def recording(self) -> Path | None:
        """Path of the recording, after `close()` too; `None` when nothing is recorded."""
        return self._recording if self._processes is None else self._processes.recording

    def _list_world_notes(self) -> Sequence[str]:
        """Return notes about the robots, or about the simulation."""
        return ()

    @property
    def _is_forked(self) -> bool:
        """True in a child that was forked from the process of the session, which has none of it."""
        return self._process not in (0, os.getpid())

    def _require_steps(self) -> None:
        """Raise `OwnershipError` where no step will take an input any more."""
        self._require_open()

    def _require_open(self) -> None:
        if self._is_closed:
            raise OwnershipError(f"the session is closed: make another {type(self).__name__}")

    def _require_started(self) -> SessionProcesses:
        if self._processes is None:
            self._require_open()
            name = type(self).__name__
            raise OwnershipError(f"the session is not started: use `with {name}(...) as session`, or session.start()")
        return self._processes


def _leave_terminal() -> None:
    """Write no more to a terminal that was closed: every write to it would be an error."""
    with suppress(OSError), open(os.devnull, "wb") as nowhere:
        for stream in (1, 2):
            if os.isatty(stream):
                os.dup2(nowhere.fileno(), stream)
