"""Answer `GetStatus`: the authority's half of the report, which comes about once a second, and the front's half.

Every client that has said `hello` may ask, also while the authority is stalled and admits none: that is when users
need the status. Memory is bounded: fixed rings per connection, which end with it.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from dataclasses import dataclass, field
from typing import Any, Final

import msgspec

from iris_session.alignment.service import AlignmentService
from iris_session.front.asset_service import AssetService
from iris_session.front.connections import FrontConnection
from iris_session.front.context import FrontContext
from iris_session.front.media.service import MediaService
from iris_session.protocol.client_messages import Sample
from iris_session.protocol.names import ThermalState
from iris_session.protocol.status import (
    ClientReport,
    GetStatus,
    ParticipantReport,
    Quantiles,
    StatusReport,
    compute_quantiles,
)

#: Samples of one connection whose delay is kept: five devices at 90 Hz for a second, one for six.
DELAYS: Final = 512
ROLL_NS: Final = 1_000_000_000
#: With fewer state frames in the last seconds no 99th percentile is reported: it would be the latest frame, and in a
#: scene at rest, whose state is sent again four times a second, one late frame would be reported for long.
MIN_DELAYS: Final = 25
#: Charge below which a headset is warned about: Quest 3 lasts two hours, so this is a quarter of an hour.
LOW_BATTERY: Final = 0.15
#: Dropped frames per frame drawn that are warned about: from here on people see it (assumed).
DROPPED_SHARE: Final = 0.1
#: A report is made at most this often, however many ask.
REUSE_NS: Final = 200_000_000

_decode_report = msgspec.msgpack.Decoder(StatusReport).decode


@dataclass(slots=True)
class _ConnectionStats:
    """Measurements of one connection."""

    delays_ns: deque[int] = field(default_factory=lambda: deque(maxlen=DELAYS))
    samples: int = 0
    samples_per_s: float = 0.0


class StatusService:
    """Measure connections and answer `GetStatus`. A `Service`: `tick` updates the rates."""

    def __init__(
        self, context: FrontContext, media: MediaService, assets: AssetService, alignment: AlignmentService
    ) -> None:
        self._context = context
        self._media = media
        self._assets = assets
        self._alignment = alignment
        self._stats: defaultdict[int, _ConnectionStats] = defaultdict(_ConnectionStats)
        self._disconnected: dict[str, str] = {}  # participant id -> reason
        self._rolled_ns = 0
        self._entries = 0
        self._entries_per_s = 0.0
        self._made: StatusReport | None = None
        self._made_ns = 0

    def record_sample(self, connection: int, sample: Sample, now_ns: int) -> None:
        """Record a sample that was received."""
        stats = self._stats[connection]
        stats.samples += 1
        stats.delays_ns.append(now_ns - sample.capture_ns)

    def record_report(self, connection: FrontConnection, report: ClientReport, now_ns: int) -> None:
        """Record a client's report of how state arrives."""
        numbers = [value for value in msgspec.structs.astuple(report) if isinstance(value, float)]
        if all(map(math.isfinite, numbers)):
            connection.report, connection.reported_ns = report, now_ns
        else:
            self._context.drops.count("report_not_finite", connection.number)

    def record_disconnect(self, connection: FrontConnection, reason: str) -> None:
        """Record why a connection was disconnected: its participant may stay in the roster for a while."""
        self._stats.pop(connection.number, None)
        if connection.participant_id:
            self._disconnected.pop(connection.participant_id, None)
            self._disconnected[connection.participant_id] = reason
            while len(self._disconnected) > self._context.config.limits.connections:
                del self._disconnected[next(iter(self._disconnected))]

    def send_report(self, connection: FrontConnection, question: GetStatus, now_ns: int) -> None:
        """Send the report. Many requests at once get the same one."""
        if self._made is None or now_ns - self._made_ns > REUSE_NS:
            self._made, self._made_ns = self._make_report(now_ns), now_ns
        report = msgspec.structs.replace(self._made, request_id=question.request_id, session_time=now_ns)
        self._context.outbox.send(connection, report)

    def tick(self, now_ns: int) -> None:
        """Update the rates once a second."""
        elapsed_ns = now_ns - self._rolled_ns
        if elapsed_ns < ROLL_NS:
            return
        self._rolled_ns = now_ns
        entries = self._context.authority.entries
        self._entries_per_s = (entries - self._entries) / elapsed_ns * 1e9
        self._entries = entries
        for number in [n for n in self._stats if n not in self._context.connections.by_number]:
            del self._stats[number]
        for stats in self._stats.values():
            stats.samples_per_s = stats.samples / elapsed_ns * 1e9
            stats.samples = 0
            if not stats.samples_per_s:
                stats.delays_ns.clear()  # measured too long ago

    def _make_report(self, now_ns: int) -> StatusReport:
        authority, config = self._context.authority, self._context.config
        half = _decode_report(authority.report) if authority.report else StatusReport(0, "", "", 0)
        drops, delays = dict(half.drops), self._context.publisher.read_recent_delays_ns()
        for reason, count in self._context.drops.by_reason.items():
            drops[reason] = drops.get(reason, 0) + count
        by_participant = {c.participant_id: c for c in self._context.connections.by_number.values() if c.participant_id}
        people = tuple(self._merge_row(row, by_participant.get(row.id), now_ns) for row in half.participants)
        warnings = (*half.warnings, *self._context.guard.list_warnings(now_ns), *self._media.list_warnings())
        return msgspec.structs.replace(
            half,
            session_id=config.session_id,
            session_name=config.session_name,
            stalled=authority.stalled,
            step_to_publish=compute_quantiles(delays) if len(delays) >= MIN_DELAYS else None,
            participants=people,
            drops=drops,
            warnings=(*warnings, *(text for person in people for text in list_device_warnings(person))),
            connections=len(self._context.connections),
            entries_per_s=self._entries_per_s,
            authority_silent_ns=now_ns - authority.heard_ns if authority.heard_ns else -1,
            media=self._media.report_streams(),
            assets=self._assets.report(),
        )

    def _merge_row(self, row: ParticipantReport, connection: FrontConnection | None, now_ns: int) -> ParticipantReport:
        """Return the authority's row of a participant, completed with its connection."""
        if connection is None:
            return msgspec.structs.replace(row, connected=False, lost=self._disconnected.get(row.id, ""))
        stats = self._stats.get(connection.number) or _ConnectionStats()
        report = connection.recent_report(now_ns)
        host, port = connection.address
        measured = {} if report is None else _client_fields(report)
        return msgspec.structs.replace(
            row,
            address=f"{host}:{port}" if host else "",
            software=connection.hello.software,
            heard_ns=now_ns - connection.last_heard_ns,
            samples_per_s=stats.samples_per_s,
            capture_to_receive=compute_quantiles(stats.delays_ns),
            drops=self._context.drops.by_connection.get(connection.number, 0),
            reported=report is not None,
            alignment_report=self._alignment.complete_report(connection.number, row.alignment_report, now_ns),
            **measured,
            **self._media.report_participant(connection.number),
        )


def _client_fields(report: ClientReport) -> dict[str, Any]:
    expected = report.delivered + report.missed
    measured = report.delivered > 0 and report.age_ms_p99 > 0.0  # 0: all frames were sent again, and have no age
    return {
        "state_age": Quantiles(report.age_ms_p50, report.age_ms_p99) if measured else None,
        "missed_share": report.missed / expected if expected else 0.0,
        "rtt_ms": report.rtt_ms,
        "bytes_per_s": report.bytes_per_s,
        "display_hz": report.display_hz,
        "battery": report.battery,
        "charging": report.charging,
        "thermal": report.thermal,
        "dropped_frames": report.dropped_frames,
        "shown_age_ms": report.shown_age_ms,
    }


def list_device_warnings(person: ParticipantReport) -> list[str]:
    """Return what should be done about the device of a participant before it fails in an episode."""
    if not person.connected:
        return []
    found = []
    if 0.0 <= person.battery < LOW_BATTERY and not person.charging:
        found.append(f"{person.name}: battery at {person.battery:.0%}: charge or change the headset before an episode")
    if person.thermal == ThermalState.HOT:
        found.append(f"{person.name}: the headset is hot and slows down: let it cool before an episode")
    drawn = person.display_hz
    if person.dropped_frames > DROPPED_SHARE * drawn > 0.0:
        found.append(
            f"{person.name}: {person.dropped_frames} frames were dropped in the last second, {drawn:.0f} drawn: the "
            "scene or the media are too much for the headset"
        )
    return found
