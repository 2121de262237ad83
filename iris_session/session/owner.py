"""What the owner of a session may do whatever advances its world: begin and end it, speak in it, see how it is.

`Session` (a MuJoCo scene) and `ScenePublisher` (any other world) add how the world goes on.
"""

from __future__ import annotations

import signal
import threading
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import Self

from iris_session.physics import Pacer
from iris_session.protocol.client_messages import ClearEStop, EStop, Marker
from iris_session.protocol.entries import EntryMessage
from iris_session.protocol.server_messages import Event
from iris_session.session.config import SessionConfig
from iris_session.session.errors import OwnershipError
from iris_session.session.processes import SessionProcesses
from iris_session.session.publishing import Publishing
from iris_session.session.scene_change import ScenePatches
from iris_session.session.status import SessionStatus, make_status
from iris_session.session.stepper import Stepper


class Owner(Publishing, ScenePatches):
    """One session, seen by the process that has it."""

    config: SessionConfig
    clock: Callable[[], int]
    _stop: threading.Event
    _processes: SessionProcesses | None = None
    _stepper: Stepper | None = None
    _pacer: Pacer | None = None
    _scheduling = "normal"
    _recorded: Path | None = None
    _ended = False  # by `close`, for good

    # --- life --------------------------------------------------------------------------------------------------------

    @abstractmethod
    def start(self) -> None: ...

    @abstractmethod
    def close(self) -> bool: ...

    @abstractmethod
    def post(self, message: EntryMessage) -> None: ...

    @abstractmethod
    def _unchanging(self) -> AbstractContextManager[object]:
        """Inside, no step is taken by a helper thread."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self.close()

    def stop(self) -> None:
        """Ends `run()` after the step in progress. May be called from another thread or a signal handler."""
        self._stop.set()

    @property
    def stopping(self) -> bool:
        """True from `stop()`, Ctrl-C, SIGTERM or `close()` on."""
        return self._stop.is_set()

    @contextmanager
    def signals(self) -> Iterator[None]:
        """Inside, Ctrl-C and SIGTERM end `run()` in order, also when they come before it. Main thread only."""
        with stop_on_signals(self._stop):
            yield

    # --- what the owner says -----------------------------------------------------------------------------------------

    def estop(self, reason: str = "") -> None:
        """Stops every robot, latched, whatever the `reason` is. Not a safety-rated stop."""
        self.post(EStop(reason=str(reason).encode("utf-8", "replace").decode()))

    def clear_estop(self) -> None:
        self.post(ClearEStop(request_id=0))

    def marker(self, text: str) -> None:
        """A note in the recording."""
        self.post(Marker(request_id=0, text=text))

    # --- what the owner sees -----------------------------------------------------------------------------------------

    def status(self) -> SessionStatus:
        """Who is here, who holds what, how late ticks are, what was dropped."""
        with self._unchanging():
            return make_status(self._stepper, self._pacer, self._processes, self._scheduling)

    def recent_events(self) -> list[Event]:
        """The newest events, oldest first (at most 200; the recording has them all)."""
        with self._unchanging():
            return [] if self._stepper is None else list(self._stepper.ledger.recent)

    @property
    def processes(self) -> SessionProcesses:
        """Front and recorder, for benchmarks and tests; not part of the public API."""
        return self._live()

    @property
    def address(self) -> str:
        """`host:port` of the control channel, which is all that a client needs."""
        return self._live().address

    @property
    def name(self) -> str:
        """As the session is known: `config.name`, with a number when another session on the network has that name."""
        return self.config.name if self._processes is None else self._processes.name

    @property
    def notes(self) -> tuple[str, ...]:
        """What people should know about how the session started (another name, other addresses), and what clients do
        not see of its present scene; one line each."""
        live = self._processes
        return () if live is None else tuple(dict.fromkeys((*live.notes, *live.scenes.notes)))

    @property
    def recording(self) -> Path | None:
        """Path of the recording, after `close()` too; None when nothing is recorded."""
        return self._recorded if self._processes is None else self._processes.recording

    def _check_open(self) -> None:
        if self._ended:
            raise OwnershipError(f"the session is closed: make another {type(self).__name__}")

    def _live(self) -> SessionProcesses:
        if self._processes is None:
            self._check_open()
            what = type(self).__name__
            raise OwnershipError(f"the session is not started: use `with {what}(...) as session`, or session.start()")
        return self._processes


@contextmanager
def stop_on_signals(stop: threading.Event) -> Iterator[None]:
    """Set `stop` on SIGINT and SIGTERM; a SIGINT after that raises `KeyboardInterrupt`. Main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def on_signal(number: int, _: FrameType | None) -> None:
        if stop.is_set() and number == signal.SIGINT:
            raise KeyboardInterrupt  # the second Ctrl-C does not wait
        stop.set()

    previous = {s: signal.signal(s, on_signal) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for s, handler in previous.items():
            signal.signal(s, handler)
