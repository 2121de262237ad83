"""Who gets which media: the front's side of the media proxy. Decides four times a second, and tells every client."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from iris_session.front.connections import ConnectionTable, FrontConnection, Outbox
from iris_session.front.media.budget import (
    MILLISECOND,
    NOTHING,
    BudgetController,
    BudgetGrant,
    LinkMeasure,
    StateReport,
)
from iris_session.front.media.proxy import MediaProxy
from iris_session.front.media.scheduler import DeliveryCounters, MediaSubscriber, StreamStats
from iris_session.protocol.limits import Drops
from iris_session.protocol.media import CLASSES, StreamBudget
from iris_session.protocol.names import BudgetClass, Role
from iris_session.protocol.status import ClientReport, DeliveryBudget, MediaStreamReport
from iris_session.security.keyring import Keyring

PERIOD_NS: Final = 250 * MILLISECOND
MBIT: Final = 125_000.0
#: State frames between two reports of a client, of which some should have come: a third of a second.
MIN_EXPECTED_FRAMES: Final = 20
#: Roles that may hand in frames from elsewhere.
SOURCES: Final = frozenset({Role.CAMERA, Role.SOURCE})
#: Keys that may not, and are remembered for a look.
MAX_REFUSED: Final = 256


class _ClientState:
    """What is known of one connection, and what it knows."""

    def __init__(self) -> None:
        self.report: ClientReport | None = None
        self.frames = 0  # that the state socket had sent when it came
        self.counters = DeliveryCounters()
        self.grant = BudgetGrant({})
        self.wanted: list[str] = []
        self.bytes_per_s = 0.0
        self.drops = 0
        self.budget: tuple[Any, ...] | None = None


class MediaService:
    """A `Service`. `adapt`: slow links get less.

    `report_of(connection, now_ns)`: the newest of a client; `revoked(key)`: it may do nothing; `state_frames`: sent by
    the state socket so far.
    """

    def __init__(
        self,
        proxy: MediaProxy,
        clients: ConnectionTable,
        outbox: Outbox,
        keyring: Keyring,
        drops: Drops,
        report_of: Callable[[int, int], ClientReport | None],
        revoked: Callable[[str], bool],
        state_frames: Callable[[], int],
        *,
        adapt: bool = True,
    ) -> None:
        self._proxy = proxy
        self._clients = clients
        self._outbox = outbox
        self._keyring = keyring
        self._drops = drops
        self._report_of = report_of
        self._revoked = revoked
        self._state_frames = state_frames
        self._controller = BudgetController() if adapt else None
        self._states: dict[int, _ClientState] = {}
        self._facts: dict[str, StreamStats] = {}
        self._names: dict[str, str] = {}  # of sources, by key
        self._next_ns = 0
        self._clients_changed = False  # since the last turn
        proxy.start()

    def tick(self, now_ns: int) -> None:
        """Lets in who came and out who left, at once; looks at everybody now and then."""
        if self._proxy.undecided:
            self._decide_sources()
        self.sync_clients()
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + PERIOD_NS
            self._update_budgets(set(self._states), now_ns)
        elif not self._clients_changed:
            return
        self._clients_changed = False
        self._send_budgets()

    def sync_clients(self) -> None:
        """Lets the thread know who is there, before it hears of them."""
        here = {number for number, one in self._clients.by_number.items() if one.admitted}
        if here != set(self._states):
            self._clients_changed = True
            self._sync_table(here)
            self._publish_levels()

    def close(self) -> None:
        self._proxy.close()

    # --- for the status ----------------------------------------------------------------------------------------------

    def report_streams(self) -> tuple[MediaStreamReport, ...]:
        """Every stream, at its best."""
        return tuple(
            MediaStreamReport(
                name, facts.hz, facts.rates[0] / MBIT, self._names.get(facts.source, ""), facts.subscribers
            )
            for name, facts in self._facts.items()
        )

    def report_participant(self, number: int) -> dict[str, Any]:
        """Fields of a `ParticipantReport`."""
        told = self._states.get(number)
        if told is None or not told.wanted:
            return {}
        return {
            "budget_class": _lowest_class(told),
            "media": tuple(self._make_stream_budget(told, stream) for stream in told.wanted),
            "media_bytes_per_s": told.bytes_per_s,
            "media_drops": told.drops,
        }

    # --- inside ------------------------------------------------------------------------------------------------------

    def _sync_table(self, here: set[int]) -> None:
        for number in [number for number in self._states if number not in here]:
            del self._states[number]
            if self._controller is not None:
                self._controller.remove(number)
        for number in sorted(here - set(self._states)):
            self._states[number] = _ClientState()

    def _update_budgets(self, here: set[int], now_ns: int) -> None:
        self._sync_table(here)
        proxy = self._proxy
        with proxy.lock:
            proxy.scheduler.sample_rates(now_ns)
            self._facts = proxy.scheduler.read_streams()
            reasons, superseded = proxy.scheduler.pop_drops()
            wanted = {number: proxy.scheduler.list_subscriptions(number) for number in self._states}
            tallies = {number: proxy.scheduler.read_counters(number) for number in self._states}
        self._decide_sources(again=True)
        for reason, count in reasons.items():
            self._drops.count(reason, n=count)
        for number, count in superseded.items():
            self._drops.count("media_superseded", number if number in self._states else 0, count)
            if number in self._states:
                self._states[number].drops += count
        for number, told in self._states.items():
            told.wanted = wanted[number]
            self._update_client(number, told, tallies[number], now_ns)
        self._publish_levels()

    def _update_client(self, number: int, told: _ClientState, tally: DeliveryCounters, now_ns: int) -> None:
        before, told.counters = told.counters, tally
        told.bytes_per_s = (tally.bytes - before.bytes) * 1e9 / PERIOD_NS
        report, fresh = self._report_of(number, now_ns), None
        if report is not None and report is not told.report:
            fresh = StateReport(report.age_ms_p50, self._missed_share(told, report))
        told.report = report or told.report
        limit = max(0.0, told.report.media_limit_mbit_per_s) * MBIT if told.report is not None else 0.0
        measure = LinkMeasure(fresh, tally.taken - before.taken, tally.due - before.due, limit)
        rates = {stream: self._facts[stream].rates for stream in told.wanted if stream in self._facts}
        if self._controller is not None:
            told.grant = self._controller.update(number, measure, rates, now_ns)

    def _missed_share(self, told: _ClientState, report: ClientReport) -> float:
        """Of state. Who was delivered nothing at all cannot know what was missed, but we know whether we sent it."""
        before, told.frames = told.frames, self._state_frames()
        expected = report.delivered + report.missed
        if not expected:
            return 1.0 if told.report is not None and told.frames - before >= MIN_EXPECTED_FRAMES else 0.0
        return report.missed / expected

    def _publish_levels(self) -> None:
        listeners = {
            number: MediaSubscriber(
                self._find_key(self._clients.by_number[number]), told.grant.levels, _initial_level(told.grant)
            )
            for number, told in self._states.items()
        }
        with self._proxy.lock:
            self._proxy.scheduler.set_subscribers(listeners)

    def _find_key(self, connection: FrontConnection) -> str:
        """The key of the TCP connections that may carry this connection's media: of people behind a gateway, its."""
        if self._keyring.key is None:
            return ""
        gateway = self._clients.by_number.get(connection.gateway)
        return connection.key_id if gateway is None else gateway.key_id

    def _decide_sources(self, *, again: bool = False) -> None:
        """Who may hand in frames: keys with the role, as the list is now. Whoever just came; `again`: everybody."""
        if self._keyring.key is None:
            return
        proxy = self._proxy
        with proxy.lock:
            looked = proxy.undecided | (proxy.sources | proxy.refused if again else set())
            proxy.undecided = set()
            names = {mark: name for mark in looked if (name := self._find_source_name(mark)) is not None}
            proxy.scheduler.stop_sources(looked.intersection(proxy.sources).difference(names))
            proxy.sources = proxy.sources.difference(looked).union(names)
            refused = proxy.refused.difference(names).union(looked.difference(names))
            proxy.refused = refused if len(refused) <= MAX_REFUSED else set()  # many keys: each is asked about anew
        self._names = {mark: name for mark, name in self._names.items() if mark not in looked} | names

    def _find_source_name(self, mark: str) -> str | None:
        """Name of a key that may hand in frames."""
        entry = self._keyring.find_key(mark)
        if entry is None or self._revoked(mark) or not (not entry.roles or SOURCES.intersection(entry.roles)):
            return None
        return entry.name

    def _make_stream_budget(self, told: _ClientState, stream: str) -> StreamBudget:
        level = told.grant.levels.get(stream, _initial_level(told.grant))
        facts = self._facts.get(stream)
        rate = 0.0 if facts is None or level >= NOTHING else facts.rates[level]
        return StreamBudget(stream, CLASSES[level], round(rate / MBIT, 3))

    def _send_budgets(self) -> None:
        """Tells what has changed: rates alone are no reason."""
        for number, told in self._states.items():
            streams = tuple(self._make_stream_budget(told, stream) for stream in self._facts)
            grant = told.grant
            content = (tuple((s.stream, s.budget_class) for s in streams), _lowest_class(told), grant.reason)
            if content == told.budget:
                continue
            bound = round(grant.bytes_per_s / MBIT, 3)
            if self._outbox.send(
                self._clients.by_number[number], DeliveryBudget(_lowest_class(told), bound, grant.reason, streams)
            ):
                told.budget = content


def _initial_level(grant: BudgetGrant) -> int:
    """The level of a stream that the controller has not seen for this client yet."""
    return NOTHING if grant.bytes_per_s and grant.reason else 0


def _lowest_class(told: _ClientState) -> str:
    return CLASSES[max(told.grant.levels.values(), default=0)] if told.wanted else BudgetClass.FULL
