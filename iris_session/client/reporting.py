"""What a client tells the session about itself once a second, and what it can ask the session about everybody."""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections.abc import Callable
from typing import Final, Self

from iris_session.client.connection import Connection
from iris_session.client.errors import NotConnectedError, RequestTimeoutError
from iris_session.client.state_stream import SceneState
from iris_session.client.status import Phase
from iris_session.protocol.status import ClientReport, GetStatus, Quantiles, StatusReport, compute_quantiles

PERIOD_NS: Final = 1_000_000_000
#: Frames of one period that are remembered: more than are ever sent in a second.
MAX_AGES: Final = 512
#: A question without an answer is put again; twice a second is below the limit of its type.
RETRY_S: Final = 0.5


class ArrivalMeter:
    """Gathers how state arrives at the application, for `ClientReport`. Pure: times are passed in."""

    def __init__(self) -> None:
        self._ages_ns: list[int] = []
        self._ages: Quantiles | None = None
        self._shown_ns = -1
        self._delivered = 0
        self._missed = 0
        self._seq = 0
        self._bytes = 0
        self._since_ns = -1

    def delivered(self, state: SceneState) -> None:
        """A frame was handed to the application.

        One that is sent again, because its source is silent, is as old as that silence, and says nothing of its way.
        The first of a connection may be one of those.
        """
        seq = state.header.state_seq
        if 0 < self._seq < seq:
            self._missed += seq - self._seq - 1
        self._seq = seq
        self._delivered += 1
        if len(self._ages_ns) < MAX_AGES and self._shown_ns not in (-1, state.header.session_time):
            self._ages_ns.append(state.age_ns)
        self._shown_ns = state.header.session_time

    def take(self, connection: Connection, now_ns: int) -> ClientReport | None:
        """The report of the last second, when it is due and there is a session to tell it."""
        if not connection.joined:
            self._since_ns, self._seq, self._ages, self._shown_ns = -1, 0, None, -1
            return None
        received = connection.stream.counters.bytes_received
        if self._since_ns < 0:
            self._start(received, now_ns)
            return None
        elapsed_ns = now_ns - self._since_ns
        if elapsed_ns < PERIOD_NS:
            return None
        if self._ages_ns or not self._delivered:
            self._ages = compute_quantiles(self._ages_ns)
        report = ClientReport(
            0.0 if self._ages is None else self._ages.p50,
            0.0 if self._ages is None else self._ages.p99,
            self._delivered,
            self._missed,
            connection.clock.rtt_ns * 1e-6,
            (received - self._bytes) / elapsed_ns * 1e9,
        )
        self._start(received, now_ns)
        return report

    def _start(self, received: int, now_ns: int) -> None:
        self._since_ns, self._bytes = now_ns, received
        self._ages_ns.clear()
        self._delivered = self._missed = 0


class Reporting:
    """Mixin of `Client`: asks the session how it does."""

    connection: Connection
    _lock: threading.RLock

    @abstractmethod
    def wait_for(self, condition: Callable[[Self], bool], timeout_s: float = 5.0) -> bool: ...

    @abstractmethod
    def _send_soon(self) -> None: ...

    def status(self, timeout_s: float = 5.0) -> StatusReport:
        """Everybody, every robot, late ticks and their causes, ages by stage, recorder, drops: as the session sees it.

        Works while the session stands still too, for a client that it has not let in yet (after `open`). Raises
        `RequestTimeoutError` without an answer, `NotConnectedError` when no session is there to be asked.
        """
        asked, asked_s = -1, 0.0

        def answered(client: Reporting) -> bool:
            nonlocal asked, asked_s
            with client._lock:
                connection, now_s = client.connection, time.monotonic()
                again = connection.generation != asked or now_s - asked_s > RETRY_S
                if again and StatusReport not in connection.latest and _ask(connection):
                    asked, asked_s = connection.generation, now_s
                    client._send_soon()
                return StatusReport in connection.latest

        with self._lock:
            self.connection.latest.pop(StatusReport, None)
        self.wait_for(answered, timeout_s)
        with self._lock:
            report = self.connection.latest.pop(StatusReport, None)
        if isinstance(report, StatusReport):
            return report
        if asked < 0:
            raise NotConnectedError(self.connection.describe())
        raise RequestTimeoutError(f"no status within {timeout_s:g} s")


def _ask(connection: Connection) -> bool:
    """False: nobody to ask now. While joining there is: whoever takes our hello also takes the question."""
    return (connection.joined or connection.phase is Phase.JOINING) and connection._queue(GetStatus())
