"""Who gets which media: the front's side of the media proxy. Decides four times a second, and tells every client."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from iris_session.front.connections import ClientTable, Connection, Outbox
from iris_session.front.media.budget import (
    MILLISECOND,
    NOTHING,
    BudgetController,
    Grant,
    Measure,
    Report,
)
from iris_session.front.media.proxy import MediaProxy
from iris_session.front.media.scheduler import Listener, StreamFacts, Tally
from iris_session.protocol.media import CLASSES, StreamBudget
from iris_session.protocol.names import BudgetClass, Role
from iris_session.protocol.status import ClientReport, DeliveryBudget, MediaStreamReport
from iris_session.protocol.token_bucket import Drops
from iris_session.security.keyring import Keyring

LOOK_NS: Final = 250 * MILLISECOND
MBIT: Final = 125_000.0
#: State frames between two reports of a client, of which some should have come: a third of a second.
MANY_FRAMES: Final = 20
#: Roles that may hand in frames from elsewhere.
SOURCES: Final = frozenset({Role.CAMERA, Role.SOURCE})
#: Keys that may not, and are remembered for a look.
MAX_REFUSED: Final = 256


class _Told:
    """What is known of one connection, and what it knows."""

    def __init__(self) -> None:
        self.report: ClientReport | None = None
        self.frames = 0  # that the state socket had sent when it came
        self.tally = Tally()
        self.grant = Grant({})
        self.wanted: list[str] = []
        self.bytes_per_s = 0.0
        self.drops = 0
        self.budget: tuple[Any, ...] | None = None


class MediaDesk:
    """A `Service`. `adapt`: slow links get less.

    `report_of(connection, now_ns)`: the newest of a client; `revoked(key)`: it may do nothing; `state_frames`: sent by
    the state socket so far.
    """

    def __init__(
        self,
        proxy: MediaProxy,
        clients: ClientTable,
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
        self._told: dict[int, _Told] = {}
        self._facts: dict[str, StreamFacts] = {}
        self._names: dict[str, str] = {}  # of sources, by key
        self._next_ns = 0
        self._met = False  # since the last turn
        proxy.start()

    def turn(self, now_ns: int) -> None:
        """Lets in who came and out who left, at once; looks at everybody now and then."""
        if self._proxy.asking:
            self._decide()
        self.meet()
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + LOOK_NS
            self._look(set(self._told), now_ns)
        elif not self._met:
            return
        self._met = False
        self._tell()

    def meet(self) -> None:
        """Lets the thread know who is there, before it hears of them."""
        here = {number for number, one in self._clients.by_number.items() if one.admitted}
        if here != set(self._told):
            self._met = True
            self._take_over(here)
            self._publish()

    def close(self) -> None:
        self._proxy.close()

    # --- for the status ----------------------------------------------------------------------------------------------

    def streams(self) -> tuple[MediaStreamReport, ...]:
        """Every stream, at its best."""
        return tuple(
            MediaStreamReport(
                name, facts.hz, facts.rates[0] / MBIT, self._names.get(facts.source, ""), facts.subscribers
            )
            for name, facts in self._facts.items()
        )

    def row(self, number: int) -> dict[str, Any]:
        """Fields of a `ParticipantReport`."""
        told = self._told.get(number)
        if told is None or not told.wanted:
            return {}
        return {
            "budget_class": _lowest(told),
            "media": tuple(self._budget_of(told, stream) for stream in told.wanted),
            "media_bytes_per_s": told.bytes_per_s,
            "media_drops": told.drops,
        }

    # --- inside ------------------------------------------------------------------------------------------------------

    def _take_over(self, here: set[int]) -> None:
        for number in [number for number in self._told if number not in here]:
            del self._told[number]
            if self._controller is not None:
                self._controller.forget(number)
        for number in sorted(here - set(self._told)):
            self._told[number] = _Told()

    def _look(self, here: set[int], now_ns: int) -> None:
        self._take_over(here)
        proxy = self._proxy
        with proxy.lock:
            proxy.hub.look(now_ns)
            self._facts = proxy.hub.streams()
            reasons, superseded = proxy.hub.take_drops()
            wanted = {number: proxy.hub.wanted(number) for number in self._told}
            tallies = {number: proxy.hub.tally(number) for number in self._told}
        self._decide(again=True)
        for reason, count in reasons.items():
            self._drops.count(reason, n=count)
        for number, count in superseded.items():
            self._drops.count("media_superseded", number if number in self._told else 0, count)
            if number in self._told:
                self._told[number].drops += count
        for number, told in self._told.items():
            told.wanted = wanted[number]
            self._measure(number, told, tallies[number], now_ns)
        self._publish()

    def _measure(self, number: int, told: _Told, tally: Tally, now_ns: int) -> None:
        before, told.tally = told.tally, tally
        told.bytes_per_s = (tally.bytes - before.bytes) * 1e9 / LOOK_NS
        report, fresh = self._report_of(number, now_ns), None
        if report is not None and report is not told.report:
            fresh = Report(report.age_ms_p50, self._missed_share(told, report))
        told.report = report or told.report
        limit = max(0.0, told.report.media_limit_mbit_per_s) * MBIT if told.report is not None else 0.0
        measure = Measure(fresh, tally.taken - before.taken, tally.due - before.due, limit)
        rates = {stream: self._facts[stream].rates for stream in told.wanted if stream in self._facts}
        if self._controller is not None:
            told.grant = self._controller.update(number, measure, rates, now_ns)

    def _missed_share(self, told: _Told, report: ClientReport) -> float:
        """Of state. Who was delivered nothing at all cannot know what was missed, but we know whether we sent it."""
        before, told.frames = told.frames, self._state_frames()
        expected = report.delivered + report.missed
        if not expected:
            return 1.0 if told.report is not None and told.frames - before >= MANY_FRAMES else 0.0
        return report.missed / expected

    def _publish(self) -> None:
        listeners = {
            number: Listener(self._user_of(self._clients.by_number[number]), told.grant.levels, _first(told.grant))
            for number, told in self._told.items()
        }
        with self._proxy.lock:
            self._proxy.hub.allow(listeners)

    def _user_of(self, connection: Connection) -> str:
        """The key of the TCP connections that may carry this connection's media: of people behind a gateway, its."""
        if self._keyring.key is None:
            return ""
        gateway = self._clients.by_number.get(connection.gateway)
        return connection.key_id if gateway is None else gateway.key_id

    def _decide(self, *, again: bool = False) -> None:
        """Who may hand in frames: keys with the role, as the list is now. Whoever just came; `again`: everybody."""
        if self._keyring.key is None:
            return
        proxy = self._proxy
        with proxy.lock:
            looked = proxy.asking | (proxy.sources | proxy.refused if again else set())
            proxy.asking = set()
            names = {mark: name for mark in looked if (name := self._source_name(mark)) is not None}
            proxy.hub.stop_sources(looked.intersection(proxy.sources).difference(names))
            proxy.sources = proxy.sources.difference(looked).union(names)
            refused = proxy.refused.difference(names).union(looked.difference(names))
            proxy.refused = refused if len(refused) <= MAX_REFUSED else set()  # many keys: each is asked about anew
        self._names = {mark: name for mark, name in self._names.items() if mark not in looked} | names

    def _source_name(self, mark: str) -> str | None:
        """Name of a key that may hand in frames."""
        entry = self._keyring.find_key(mark)
        if entry is None or self._revoked(mark) or not (not entry.roles or SOURCES.intersection(entry.roles)):
            return None
        return entry.name

    def _budget_of(self, told: _Told, stream: str) -> StreamBudget:
        level = told.grant.levels.get(stream, _first(told.grant))
        facts = self._facts.get(stream)
        rate = 0.0 if facts is None or level >= NOTHING else facts.rates[level]
        return StreamBudget(stream, CLASSES[level], round(rate / MBIT, 3))

    def _tell(self) -> None:
        """Tells what has changed: rates alone are no reason."""
        for number, told in self._told.items():
            streams = tuple(self._budget_of(told, stream) for stream in self._facts)
            grant = told.grant
            content = (tuple((s.stream, s.budget_class) for s in streams), _lowest(told), grant.reason)
            if content == told.budget:
                continue
            bound = round(grant.bytes_per_s / MBIT, 3)
            if self._outbox.send(
                self._clients.by_number[number], DeliveryBudget(_lowest(told), bound, grant.reason, streams)
            ):
                told.budget = content


def _first(grant: Grant) -> int:
    """The level of a stream that the controller has not seen for this client yet."""
    return NOTHING if grant.bytes_per_s and grant.reason else 0


def _lowest(told: _Told) -> str:
    return CLASSES[max(told.grant.levels.values(), default=0)] if told.wanted else BudgetClass.FULL
