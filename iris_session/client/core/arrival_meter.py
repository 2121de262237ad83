"""Report of a client about itself, once a second: ages and gaps of the state at the application, rate of its media."""

from __future__ import annotations

from typing import Final

from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.state_stream import SceneState
from iris_session.protocol.status import ClientReport, Quantiles, compute_quantiles

PERIOD_NS: Final = 1_000_000_000
#: Maximum number of ages per period, of state and of media: more frames than are ever sent in a second.
MAX_AGES: Final = 512


class ArrivalMeter:
    """Collects ages and gaps of what the application was given."""

    def __init__(self) -> None:
        self._ages_ns: list[int] = []
        self._media_ages_ns: list[int] = []
        self._media_bytes = 0
        self._ages: Quantiles | None = None
        self._shown_ns = -1
        self._delivered = 0
        self._missed = 0
        self._seq = 0
        self._bytes = 0
        self._since_ns = -1

    def record(self, state: SceneState) -> None:
        """Record a state that was passed to the application.

        One that is sent again, because its source is silent, is as old as that silence: its age does not count. The
        first of a connection may be one of those.
        """
        seq = state.header.state_seq
        if 0 < self._seq < seq:
            self._missed += seq - self._seq - 1
        self._seq = seq
        self._delivered += 1
        if len(self._ages_ns) < MAX_AGES and self._shown_ns not in (-1, state.header.session_time):
            self._ages_ns.append(state.age_ns)
        self._shown_ns = state.header.session_time

    def record_media(self, n_bytes: int, age_ns: int) -> None:
        """Record a frame of any stream: the bytes of its message, and its age [ns]."""
        self._media_bytes += n_bytes
        if len(self._media_ages_ns) < MAX_AGES:
            self._media_ages_ns.append(age_ns)

    def poll_report(
        self, connection: ClientConnection, now_ns: int, media_limit_mbit_per_s: float = 0.0
    ) -> ClientReport | None:
        """Return the report of the last second when it is due and the connection is joined, else `None`."""
        if not connection.is_joined:
            self._since_ns, self._seq, self._ages, self._shown_ns = -1, 0, None, -1
            return None
        received = connection.stream.counters.bytes_received
        if self._since_ns < 0:
            self._start_period(received, now_ns)
            return None
        elapsed_ns = now_ns - self._since_ns
        if elapsed_ns < PERIOD_NS:
            return None
        if self._ages_ns or not self._delivered:
            self._ages = compute_quantiles(self._ages_ns)
        media_ages = compute_quantiles(self._media_ages_ns)
        report = ClientReport(
            0.0 if self._ages is None else self._ages.p50,
            0.0 if self._ages is None else self._ages.p99,
            self._delivered,
            self._missed,
            connection.clock.rtt_ns * 1e-6,
            (received - self._bytes) / elapsed_ns * 1e9,
            self._media_bytes / elapsed_ns * 1e9,
            0.0 if media_ages is None else media_ages.p50,
            media_limit_mbit_per_s=media_limit_mbit_per_s,
        )
        self._start_period(received, now_ns)
        return report

    def _start_period(self, received: int, now_ns: int) -> None:
        self._since_ns, self._bytes = now_ns, received
        self._ages_ns.clear()
        self._media_ages_ns.clear()
        self._delivered = self._missed = self._media_bytes = 0
