"""Answers `GetStatus`: the authority's half of the report, which comes about once a second, and what the front sees.

Whoever may say `hello` may ask, also while the authority stands still and lets nobody in: that is when people ask.
Memory is bounded: fixed rings per connection, and nothing of connections that are gone.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import msgspec

from iris_session.front.connections import ConnectionTable, FrontConnection, Outbox
from iris_session.link.config import FrontConfig
from iris_session.protocol.client_messages import Sample
from iris_session.protocol.limits import Drops
from iris_session.protocol.status import (
    AlignmentReport,
    AssetsReport,
    ClientReport,
    GetStatus,
    MediaStreamReport,
    ParticipantReport,
    Quantiles,
    StatusReport,
    compute_quantiles,
)

#: Samples of one connection whose way is remembered: five devices at 90 Hz for a second, one for six.
DELAYS: Final = 512
ROLL_NS: Final = 1_000_000_000
#: A report of a client that is older says nothing about now.
STALE_REPORT_NS: Final = 3_000_000_000
#: Of fewer frames of state than this in some seconds no 99th percentile is told: it would be the latest one, and of a
#: scene that stands still, whose state is sent again four times a second, one that was late would be blamed for long.
MIN_DELAYS: Final = 25
#: A report is made at most this often, however many ask.
REUSE_NS: Final = 200_000_000

_decode_report = msgspec.msgpack.Decoder(StatusReport).decode


class _ConnectionStats:
    """What the front measures of one connection."""

    __slots__ = ("delays_ns", "report", "reported_ns", "samples", "samples_per_s")

    def __init__(self) -> None:
        self.delays_ns: deque[int] = deque(maxlen=DELAYS)
        self.samples = 0
        self.samples_per_s = 0.0
        self.report: ClientReport | None = None
        self.reported_ns = 0

    def recent_report(self, now_ns: int) -> ClientReport | None:
        """The newest report of the client, unless it is too old."""
        return self.report if now_ns - self.reported_ns <= STALE_REPORT_NS else None


class Telling(NamedTuple):
    """What the rest of the front tells the desk: numbers that live elsewhere, asked for when somebody asks us.

    `publish_delays_ns`: end of tick to the state socket, of the frames of the last seconds. `heard_ns`: session time of
    the authority's last word, 0 before it. `authority`: its newest half of the report, encoded; empty before it.
    """

    publish_delays_ns: Sequence[int] = ()
    heard_ns: int = 0
    authority: bytes = b""
    stalled: bool = False
    entries: int = 0  # sent to the authority since the start
    warnings: tuple[str, ...] = ()  # of the front
    media: tuple[MediaStreamReport, ...] = ()
    assets: AssetsReport | None = None


class StatusService:
    """One per front. A `Service`: `turn` rolls the rates."""

    def __init__(
        self, config: FrontConfig, clients: ConnectionTable, outbox: Outbox, drops: Drops, tell: Callable[[], Telling]
    ) -> None:
        self._config = config
        self._clients = clients
        self._outbox = outbox
        self._drops = drops
        self._tell = tell
        #: What a participant gets of media, as fields of its row.
        self.media_row: Callable[[int], dict[str, Any]] = lambda _number: {}
        #: The authority's half of a participant's alignment report with that of the front: connection, half, now.
        self.alignment_report: Callable[[int, AlignmentReport | None, int], AlignmentReport | None] = (
            lambda _number, half, _now_ns: half
        )
        self._stats: dict[int, _ConnectionStats] = {}
        self._lost: dict[str, str] = {}  # participant id -> why its connection was lost
        self._rolled_ns = 0
        self._entries = 0
        self._entries_per_s = 0.0
        self._made: StatusReport | None = None
        self._made_ns = 0

    def record_sample(self, connection: int, sample: Sample, now_ns: int) -> None:
        """A sample has come in."""
        line = self._find_stats(connection)
        line.samples += 1
        line.delays_ns.append(now_ns - sample.capture_ns)

    def record_report(self, connection: int, report: ClientReport, now_ns: int) -> None:
        """A client tells how state arrives."""
        line = self._find_stats(connection)
        numbers = [value for value in msgspec.structs.astuple(report) if isinstance(value, float)]
        if all(map(math.isfinite, numbers)):
            line.report, line.reported_ns = report, now_ns
        else:
            self._drops.count("report_not_finite", connection)

    def find_report(self, connection: int, now_ns: int) -> ClientReport | None:
        """The newest report of a client, `None` without one of the last seconds."""
        line = self._stats.get(connection)
        return None if line is None else line.recent_report(now_ns)

    def record_disconnect(self, connection: FrontConnection, reason: str) -> None:
        """The front lost a connection: its participant may wait in the roster for a while."""
        self._stats.pop(connection.number, None)
        if connection.participant_id:
            self._lost.pop(connection.participant_id, None)
            self._lost[connection.participant_id] = reason
            while len(self._lost) > self._config.limits.connections:
                del self._lost[next(iter(self._lost))]

    def send_report(self, connection: FrontConnection, question: GetStatus, now_ns: int) -> None:
        """Answers. Rates are limited as those of every message; many who ask get one and the same report."""
        if self._made is None or now_ns - self._made_ns > REUSE_NS:
            self._made, self._made_ns = self._make_report(now_ns), now_ns
        report = msgspec.structs.replace(self._made, request_id=question.request_id, session_time=now_ns)
        self._outbox.send(connection, report)

    def tick(self, now_ns: int) -> None:
        """Once a second: rates."""
        elapsed_ns = now_ns - self._rolled_ns
        if elapsed_ns < ROLL_NS:
            return
        self._rolled_ns = now_ns
        entries = self._tell().entries
        self._entries_per_s = (entries - self._entries) / elapsed_ns * 1e9
        self._entries = entries
        for number in [n for n in self._stats if n not in self._clients.by_number]:
            del self._stats[number]
        for line in self._stats.values():
            line.samples_per_s = line.samples / elapsed_ns * 1e9
            line.samples = 0
            if not line.samples_per_s:
                line.delays_ns.clear()  # what was measured is not of now

    def close(self) -> None:
        """Nothing was opened."""

    def _find_stats(self, connection: int) -> _ConnectionStats:
        line = self._stats.get(connection)
        if line is None:
            line = self._stats[connection] = _ConnectionStats()
        return line

    def _make_report(self, now_ns: int) -> StatusReport:
        telling = self._tell()
        config = self._config
        half = _decode_report(telling.authority) if telling.authority else StatusReport(0, "", "", 0)
        drops, delays = dict(half.drops), telling.publish_delays_ns
        for reason, count in self._drops.by_reason.items():
            drops[reason] = drops.get(reason, 0) + count
        by_participant = {c.participant_id: c for c in self._clients.by_number.values() if c.participant_id}
        return msgspec.structs.replace(
            half,
            session_id=config.session_id,
            session_name=config.session_name,
            stalled=telling.stalled,
            step_to_publish=compute_quantiles(delays) if len(delays) >= MIN_DELAYS else None,
            participants=tuple(self._merge_row(row, by_participant.get(row.id), now_ns) for row in half.participants),
            drops=drops,
            warnings=(*half.warnings, *telling.warnings),
            connections=len(self._clients),
            entries_per_s=self._entries_per_s,
            authority_silent_ns=now_ns - telling.heard_ns if telling.heard_ns else -1,
            media=telling.media,
            assets=telling.assets,
        )

    def _merge_row(self, row: ParticipantReport, connection: FrontConnection | None, now_ns: int) -> ParticipantReport:
        """The authority's row of a participant with what the front knows of its connection."""
        if connection is None:
            return msgspec.structs.replace(row, connected=False, lost=self._lost.get(row.id, ""))
        line = self._stats.get(connection.number) or _ConnectionStats()
        report = line.recent_report(now_ns)
        host, port = connection.address
        measured = {} if report is None else _client_fields(report)
        return msgspec.structs.replace(
            row,
            address=f"{host}:{port}" if host else "",
            software=connection.hello.software,
            heard_ns=now_ns - connection.last_heard_ns,
            samples_per_s=line.samples_per_s,
            capture_to_receive=compute_quantiles(line.delays_ns),
            drops=self._drops.by_connection.get(connection.number, 0),
            reported=report is not None,
            alignment_report=self.alignment_report(connection.number, row.alignment_report, now_ns),
            **measured,
            **self.media_row(connection.number),
        )


def _client_fields(report: ClientReport) -> dict[str, Any]:
    expected = report.delivered + report.missed
    measured = report.delivered > 0 and report.age_ms_p99 > 0.0  # 0: what came was sent again, and has no age
    return {
        "state_age": Quantiles(report.age_ms_p50, report.age_ms_p99) if measured else None,
        "missed_share": report.missed / expected if expected else 0.0,
        "rtt_ms": report.rtt_ms,
        "bytes_per_s": report.bytes_per_s,
    }
