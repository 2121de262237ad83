"""Media budgets: which streams each client gets, at which level, decided four times a second and sent to the client.

The front's side of the media proxy: it decides which keys may hand in frames, and passes the levels to the thread.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import msgspec

from iris_session.front.connections import FrontConnection
from iris_session.front.context import FrontContext
from iris_session.front.key_budgets import HandshakeLimiter
from iris_session.front.media.budget import (
    LEVELS,
    MILLISECOND,
    NONE_LEVEL,
    SECOND,
    BudgetController,
    BudgetGrant,
    LinkMeasure,
    StateReport,
)
from iris_session.front.media.proxy import MediaProxy
from iris_session.front.media.scheduler import LOCAL, DeliveryCounters, MediaSubscriber, StreamStats
from iris_session.link.sockets import tcp_counts
from iris_session.link.tcp_guard import TcpFlood
from iris_session.protocol.limits import MAX_MEDIA_FRAME_BYTES, TokenBucket
from iris_session.protocol.media import StreamBudget
from iris_session.protocol.names import BudgetClass
from iris_session.protocol.status import ClientReport, DeliveryBudget, MediaStreamReport

PERIOD_NS: Final = 250 * MILLISECOND
MBIT: Final = 125_000.0
#: State frames between two reports of a client of which some should have arrived: a third of a second.
MIN_EXPECTED_FRAMES: Final = 20
#: Descriptions of streams are sent when they change: so often at once, then so many times a second. A source may change
#: its own with every frame.
DESCRIPTIONS_PER_S: Final = 1.0
DESCRIPTION_BURST: Final = 4
#: More than this is unread only of a peer whose key was accepted: before, libzmq takes one command of a frame's size.
UNAUTHENTICATED_BYTES: Final = 2 * MAX_MEDIA_FRAME_BYTES
#: Sources that a warning names.
MAX_NAMES: Final = 5


class _ClientState:
    """Measurements of one connection, and the budget that it was sent."""

    def __init__(self) -> None:
        self.report: ClientReport | None = None
        self.frames = 0  # that the state socket had sent at the time of the report
        self.counters = DeliveryCounters()
        self.grant = BudgetGrant({})
        self.streams: list[str] = []
        self.bytes_per_s = 0.0
        self.acknowledged: dict[int, int] = {}  # bytes by descriptor
        self.measured_ns = 0
        self.drops = 0
        self.budget: tuple[Any, ...] | None = None


class MediaService:
    """Decide who gets which media, and who may hand in frames. A `Service`. With `adapt_media`, slow links get less."""

    def __init__(self, context: FrontContext, proxy: MediaProxy, handshakes: HandshakeLimiter) -> None:
        self._context = context
        self._proxy = proxy
        self._handshakes = handshakes
        self._controller = BudgetController() if context.config.adapt_media else None
        self._states: dict[int, _ClientState] = {}
        self._stats: dict[str, StreamStats] = {}
        self._described: dict[str, StreamBudget] = {}  # as every client gets it, but for class and rate
        self._description_bucket = TokenBucket(DESCRIPTIONS_PER_S, DESCRIPTION_BURST, context.now_ns())
        self._senders: dict[int, FrontConnection] = {}  # of streams, by number, also of those that are lost
        self._refused: set[tuple[int, str]] = set()  # connection numbers, with the stream that another source has
        self._next_ns = 0
        self._connections_changed = False  # since the last tick
        proxy.is_source = self._is_source
        proxy.start()

    def tick(self, now_ns: int) -> None:
        """Take over which clients are admitted, and update the budgets when they are due."""
        for flood in self._proxy.pop_floods():
            self._refuse_flooder(flood, now_ns)
        self.sync_clients()
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + PERIOD_NS
            self._update_budgets(now_ns)
        elif not self._connections_changed:
            return
        self._connections_changed = False
        self._send_budgets()

    def sync_clients(self) -> None:
        """Update the thread's clients. Called before a client gets its `Welcome`."""
        here = {number for number, one in self._context.connections.by_number.items() if one.admitted}
        if here != set(self._states):
            self._connections_changed = True
            for number in [number for number in self._states if number not in here]:
                del self._states[number]
                if self._controller is not None:
                    self._controller.remove(number)
            for number in sorted(here - set(self._states)):
                self._states[number] = _ClientState()
            self._publish_levels()

    def end_sources(self, participant_id: str) -> None:
        """Remove the streams of a participant that has left. One that lost its connection has left after its grace."""
        known = self._senders | self._context.connections.by_number
        with self._proxy.lock:
            for number in [number for number, one in known.items() if one.participant_id == participant_id]:
                self._proxy.scheduler.end_sender(number)

    def close(self) -> None:
        self._proxy.close()

    # --- for the status ----------------------------------------------------------------------------------------------

    def report_streams(self) -> tuple[MediaStreamReport, ...]:
        """Return a report of every stream, with the rate of its full level and the age of its newest frame."""
        now_ns = self._context.now_ns()
        return tuple(
            MediaStreamReport(
                name,
                facts.hz,
                facts.rates[0] / MBIT,
                self._name_source(facts),
                facts.subscribers,
                facts.encoding,
                (now_ns - facts.received_ns) / MILLISECOND,
                facts.info.title,
                facts.info.audience,
                facts.info.fault,
                facts.info.detail,
                facts.is_stale(now_ns),
            )
            for name, facts in self._stats.items()
        )

    def list_warnings(self) -> tuple[str, ...]:
        """Return a warning for every stream that two sources send."""
        return tuple(
            f"another source sends the stream {name!r}, too, and is refused: give it a stream of another name"
            for name in sorted({stream for _, stream in self._refused})
        )

    def report_participant(self, number: int) -> dict[str, Any]:
        """Return the media fields of a `ParticipantReport`."""
        state = self._states.get(number)
        if state is None or not state.streams:
            return {}
        return {
            "budget_class": _lowest_class(state),
            "media": tuple(self._grade_stream(state, self._name_stream(stream)) for stream in state.streams),
            "media_bytes_per_s": state.bytes_per_s,
            "media_drops": state.drops,
        }

    # --- inside ------------------------------------------------------------------------------------------------------

    def _update_budgets(self, now_ns: int) -> None:
        proxy = self._proxy
        with proxy.lock:
            proxy.scheduler.sample_rates(now_ns)
            self._stats = proxy.scheduler.read_streams()
            self._refused = proxy.scheduler.list_refused(now_ns)
            reasons, superseded = proxy.scheduler.pop_drops()
            wanted = {number: proxy.scheduler.list_subscriptions(number) for number in self._states}
            tallies = {number: proxy.scheduler.read_counters(number) for number in self._states}
            readers = {number: proxy.scheduler.list_readers(number) for number in self._states}
        self._stop_lost_sources()
        self._note_senders()
        for reason, count in reasons.items():
            self._context.drops.count(reason, n=count)
        for number, count in superseded.items():
            self._context.drops.count("media_superseded", number if number in self._states else 0, count)
            if number in self._states:
                self._states[number].drops += count
        for number, state in self._states.items():
            state.streams = wanted[number]
            link_bytes_per_s = _measure_link(state, readers[number], now_ns)
            self._update_client(number, state, tallies[number], link_bytes_per_s, now_ns)
        self._describe_streams(now_ns)
        self._publish_levels()

    def _note_senders(self) -> None:
        """Keep who sends each stream: after its connection is lost, until it has left."""
        numbers = {facts.sender for facts in self._stats.values()}
        known = self._senders | self._context.connections.by_number
        self._senders = {number: known[number] for number in numbers if number in known}

    def _name_source(self, facts: StreamStats) -> str:
        """Return the name of the source of a stream: of its key, else of the participant that sends it."""
        sender = self._senders.get(facts.sender)
        return self._find_source_name(facts.source) or ("" if sender is None else sender.hello.name)

    def _describe_owner(self, stream: str) -> str:
        """Return who has a stream, for those whose frames are refused."""
        facts = self._stats[stream]
        if facts.sender == LOCAL:
            return "the session itself"
        sender = self._senders.get(facts.sender)
        if sender is None:
            return "another source"
        return f"{sender.role} {self._name_source(facts)!r} at {sender.address[0]}"

    def _describe_streams(self, now_ns: int) -> None:
        """Update the descriptions of streams: at once of new ones, of others as often as the rate allows."""
        found = {name: _describe_stream(name, facts, now_ns) for name, facts in self._stats.items()}
        shown = {name: self._described.get(name, one) for name, one in found.items()}
        self._described = found if shown == found or self._description_bucket.take(now_ns) else shown

    def _update_client(
        self, number: int, state: _ClientState, tally: DeliveryCounters, link_bytes_per_s: float, now_ns: int
    ) -> None:
        before, state.counters = state.counters, tally
        state.bytes_per_s = (tally.bytes - before.bytes) * 1e9 / PERIOD_NS
        report, fresh = self._context.connections.by_number[number].recent_report(now_ns), None
        if report is not None and report is not state.report:
            fresh = StateReport(report.age_ms_p50, self._missed_share(state, report))
        state.report = report or state.report
        limit = max(0.0, state.report.media_limit_mbit_per_s) * MBIT if state.report is not None else 0.0
        streams = {stream: self._stats[stream] for stream in state.streams if stream in self._stats}
        newest = {stream: facts.frame_bytes or 0 for stream, facts in streams.items()}
        measure = LinkMeasure(
            fresh, tally.delivered - before.delivered, tally.due - before.due, limit, newest, link_bytes_per_s
        )
        rates = {stream: facts.rates for stream, facts in streams.items()}
        if self._controller is not None:
            state.grant = self._controller.update(number, measure, rates, now_ns)

    def _missed_share(self, state: _ClientState, report: ClientReport) -> float:
        """Return the share of state frames that was missed. A client that got none cannot report that, but the
        front knows whether it sent some."""
        before, state.frames = state.frames, self._context.publisher.frames
        expected = report.delivered + report.missed
        if not expected:
            return 1.0 if state.report is not None and state.frames - before >= MIN_EXPECTED_FRAMES else 0.0
        return report.missed / expected

    def _publish_levels(self) -> None:
        subscribers = {}
        for number, state in self._states.items():
            key = self._context.find_channel_key(self._context.connections.by_number[number])
            subscribers[number] = MediaSubscriber(
                key, state.grant.levels, _initial_level(state.grant), state.grant.pace
            )
        with self._proxy.lock:
            self._proxy.scheduler.set_subscribers(subscribers, self._context.now_ns())

    def _refuse_flooder(self, flood: TcpFlood, now_ns: int) -> None:
        """Refuse new connections of a source that flooded, and report it by the names of the keys that it may have."""
        has_key = bool(flood.key_id) or flood.unread > UNAUTHENTICATED_BYTES
        if not has_key or self._context.keyring.key is None:
            self._context.guard.report_flood(flood.address, "media ingest", now_ns)
            return
        refused = self._handshakes.refuse_source(flood.address, flood.key_id, flood.opened_ns, now_ns)
        names = sorted(name for key in refused if (name := self._find_source_name(key)) is not None)
        if not names:  # reported already, or no source's key any more
            return
        shown = ", ".join(names[:MAX_NAMES])
        seconds = max(refused.values()) // SECOND
        text = f"flood from {flood.address}: media ingest, {shown} refused for {seconds} s"
        self._context.guard.report_flood(flood.address, f"media ingest, {shown}", now_ns, warning=text)

    def _stop_lost_sources(self) -> None:
        """Remove the streams of keys that may not hand in frames any more."""
        if self._context.keyring.key is None:
            return
        lost = {facts.source for facts in self._stats.values() if facts.source and not self._is_source(facts.source)}
        if lost:
            with self._proxy.lock:
                self._proxy.scheduler.stop_sources(lost)

    def _is_source(self, mark: str) -> bool:
        return self._find_source_name(mark) is not None

    def _find_source_name(self, mark: str) -> str | None:
        """Return the name of a key that may hand in frames, `None` for any other."""
        entry = self._context.keyring.find_key(mark)
        if entry is None or self._context.tokens.is_revoked(mark) or not self._context.keyring.may_hand_in_media(mark):
            return None
        return entry.name

    def _name_stream(self, stream: str) -> StreamBudget:
        """Return a stream without its description, which a report has once, not with each of hundreds of clients."""
        described = self._described.get(stream)
        return StreamBudget(stream) if described is None else StreamBudget(stream, encoding=described.encoding)

    def _grade_stream(self, state: _ClientState, described: StreamBudget) -> StreamBudget:
        """Return the budget of a stream with the class of this client, and its rate."""
        level = state.grant.levels.get(described.stream, _initial_level(state.grant))
        facts = self._stats.get(described.stream)
        rate = 0.0 if facts is None or level >= NONE_LEVEL else facts.rates[level]
        return msgspec.structs.replace(described, budget_class=LEVELS[level], mbit_per_s=round(rate / MBIT, 3))

    def _mark_taken(self, number: int, one: StreamBudget) -> StreamBudget:
        """Return the budget of a stream for a client, with who has the stream when this client sends to it in vain."""
        if (number, one.stream) not in self._refused or one.stream not in self._stats:
            return one
        return msgspec.structs.replace(one, taken_by=self._describe_owner(one.stream))

    def _send_budgets(self) -> None:
        """Send budgets that have changed, other than in their rates."""
        for number, state in self._states.items():
            streams = tuple(self._grade_stream(state, described) for described in self._described.values())
            if self._refused:
                streams = tuple(self._mark_taken(number, one) for one in streams)
            grant = state.grant
            shown = tuple(msgspec.structs.replace(one, mbit_per_s=0.0) for one in streams)
            content = (shown, _lowest_class(state), grant.reason)
            if content == state.budget:
                continue
            bound = round(grant.bytes_per_s / MBIT, 3)
            if self._context.outbox.send(
                self._context.connections.by_number[number],
                DeliveryBudget(_lowest_class(state), bound, grant.reason, streams),
            ):
                state.budget = content


def _describe_stream(name: str, facts: StreamStats, now_ns: int) -> StreamBudget:
    info = facts.info
    return StreamBudget(
        name,
        encoding=facts.encoding,
        title=info.title,
        audience=info.audience,
        camera=info.camera,
        hz=info.hz,
        fault=info.fault,
        detail=info.detail,
        stale=facts.is_stale(now_ns),
    )


def _measure_link(state: _ClientState, readers: Iterable[int], now_ns: int) -> float:
    """Return the rate at which what was sent to the connections of one client was acknowledged since the last call, 0
    if that is not known."""
    counts = {reader: counts.acknowledged for reader in readers if (counts := tcp_counts(reader)) is not None}
    before, state.acknowledged = state.acknowledged, counts
    seconds, state.measured_ns = (now_ns - state.measured_ns) * 1e-9, now_ns
    n_bytes = sum(count - before[reader] for reader, count in counts.items() if count >= before.get(reader, count + 1))
    return n_bytes / seconds if seconds > 0.0 else 0.0


def _initial_level(grant: BudgetGrant) -> int:
    """Return the level of a stream that the controller has not seen for this client yet."""
    return NONE_LEVEL if grant.bytes_per_s and grant.reason else 0


def _lowest_class(state: _ClientState) -> str:
    return LEVELS[max(state.grant.levels.values(), default=0)] if state.streams else BudgetClass.FULL
