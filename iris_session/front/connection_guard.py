"""TCP connections of the front, before and beside what is said over them: the silent, the many, the floods.

Everything that is opened costs a descriptor and room in libzmq, whoever opened it. So whoever says no `hello` for a
while is closed, the oldest silent ones make room when there are many, and who sends far more than its limits is cut
off and named. People who behave see none of it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import zmq

from iris_session.front.audit import AuditTrail
from iris_session.front.connections import ClientTable, Connection, Peer
from iris_session.front.subscribers import Subscribers
from iris_session.front.traffic import Traffic
from iris_session.front.visitors import Visitor, Visitors, crowd
from iris_session.link.config import MEBIBYTE, MILLISECOND, SECOND, FrontLimits
from iris_session.link.sockets import close_tcp
from iris_session.protocol.limits import Drops, TokenBucket
from iris_session.protocol.names import AuditKind

LOOK_NS: Final = 250 * MILLISECOND
#: Who was cut off may say hello again after it.
BARRED_NS: Final = 3 * SECOND
#: TCP connections of one address within a second that are called a flood.
OPENED_PER_S: Final = 100
#: What is borne of somebody before hello, as a share of what is of a client.
STRANGERS_SHARE: Final = 0.25
#: Who was given up as silent may still stop everything for so long. Then its TCP connection goes, too: a headset that
#: sleeps, or a network in between, can keep it open for ever.
GIVEN_UP_NS: Final = 60 * SECOND
#: A flood is shown in the status for so long.
SHOWN_NS: Final = 60 * SECOND
MAX_REMEMBERED: Final = 256
MAX_SHOWN: Final = 8
#: What waits for one client before it is called the cause of too much memory: more than any honest one leaves lying.
HOG_BYTES: Final = MEBIBYTE // 4
#: What libzmq itself keeps for a connection that has said nothing: its buffers and queues.
STRANGER_BYTES: Final = 16 * 1024
BEFORE_HELLO: Final = "before hello"


class Doors:
    """A `Service`. The control socket's events are passed on to it, the state socket's it reads itself. `traffic`: of
    the control socket."""

    def __init__(
        self, clients: ClientTable, drops: Drops, audit: AuditTrail, limits: FrontLimits, traffic: Traffic | None = None
    ) -> None:
        self._clients = clients
        self._drops = drops
        self._audit = audit
        self._limits = limits
        self._traffic = traffic or Traffic()
        self._visitors = Visitors(drops)  # of the control socket
        self._subscribers = Subscribers(drops, limits, self.flood, self._count)
        self._barred: dict[str, int] = {}  # key id -> session time until which it may not say hello
        self._cut: dict[str, int] = {}  # address -> until when less is borne of its strangers
        self._shown: dict[tuple[str, str], tuple[int, str]] = {}
        self._opened: dict[str, int] = {}  # address -> connections since `_opened_ns`
        self._opened_ns = 0
        self._next_ns = 0

    # --- what happens ------------------------------------------------------------------------------------------------

    def opened(self, descriptor: int, now_ns: int) -> None:
        """A TCP connection to the control socket was accepted."""
        self._traffic.begin(descriptor)
        self._count(self._visitors.opened(descriptor, now_ns).address[0], now_ns)

    def closed(self, descriptor: int) -> None:
        """A TCP connection to the control socket has ended."""
        self._traffic.begin(descriptor)
        self._visitors.closed(descriptor)

    def watch_state(self, state: zmq.Socket[bytes], monitor: zmq.Socket[bytes]) -> None:
        """Looks after the subscribers of a state socket from now on, instead of those of the one before."""
        self._subscribers.watch(state, monitor)

    def busy(self, descriptor: int, now_ns: int) -> None:
        """A connection without `hello` does what it may: it pairs."""
        visitor = self._visitors.find(descriptor)
        if visitor is not None:
            visitor.quiet_ns = now_ns

    def excess(self, peer: Peer, connection: Connection | None, what: str, now_ns: int) -> bool:
        """One message that was not taken. With too many of them the TCP connection is cut off: true."""
        visitor = self._visitors.find(peer.descriptor) or self._visitors.opened(peer.descriptor, now_ns)
        if visitor.excess is None:
            share = 1.0 if connection is not None else STRANGERS_SHARE
            if connection is None and now_ns < self._cut.get(visitor.address[0], 0):
                share *= STRANGERS_SHARE  # back again, and again without hello
            limits = self._limits
            visitor.excess = TokenBucket(limits.excess_per_s * share, int(limits.excess_burst * share), now_ns)
        if visitor.excess.take(now_ns):
            return False
        self.flood(visitor.address[0], what, now_ns, connection)
        if not close_tcp(peer.descriptor, visitor.address):
            return False
        self._drops.count("flood_cut")
        _remember(self._cut, visitor.address[0], now_ns + BARRED_NS)
        if connection is not None:
            _remember(self._barred, connection.key_id, now_ns + BARRED_NS)
        return True

    def flood(
        self, address: str, what: str, now_ns: int, connection: Connection | None = None, warning: str = ""
    ) -> None:
        """Names somebody who sends more than its limits. `warning`: what the status says instead of that."""
        name = subject = ""
        if connection is not None:
            name, subject = connection.hello.name, connection.participant_id
        self._drops.count("flood")
        self._audit.note(AuditKind.FLOOD, now_ns, subject=subject, name=name, address=address, detail=what)
        self._shown.pop((address, what), None)
        while len(self._shown) >= MAX_SHOWN:
            del self._shown[next(iter(self._shown))]
        who = " ".join(part for part in (address, f"({name})" if name else "") if part) or "an address that is gone"
        self._shown[address, what] = (now_ns, warning or f"flood from {who}: {what}")

    def barred(self, key_id: str, now_ns: int) -> bool:
        """Whether this key was cut off a moment ago."""
        return now_ns < self._barred.get(key_id, 0)

    def warnings(self, now_ns: int) -> tuple[str, ...]:
        """The floods of the last minute, for the status."""
        return tuple(text for since_ns, text in self._shown.values() if now_ns - since_ns <= SHOWN_NS)

    # --- now and then ------------------------------------------------------------------------------------------------

    def turn(self, now_ns: int) -> None:
        """Closes who has been silent for too long, who is too many, and subscribers that talk."""
        self._subscribers.turn(now_ns)
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + LOOK_NS
        self._silent(now_ns)

    def shed(self, give_way: Callable[[], str] = lambda: "") -> str:
        """Makes room in memory: closes the client for which and from which most waits, or a quarter of those who said
        no hello, when they hold more together. `give_way`: lets go of something else instead, where nobody holds much,
        and says of what. Says who it was; empty, and counted, when nobody holds what is too much: whoever it is closed
        would be closed for nothing."""
        owners = self._owners()
        strangers = [descriptor for descriptor in self._visitors if descriptor not in owners]
        held = {descriptor: self._traffic.held(descriptor) for descriptor in (*owners, *strangers)}
        of_strangers = sum(held[descriptor] for descriptor in strangers)
        most = max((held[descriptor] for descriptor in owners), default=0)
        of_strangers += STRANGER_BYTES * len(strangers)
        if max(of_strangers, most) < HOG_BYTES:
            what = give_way()
            if not what:
                self._drops.count("memory_elsewhere")
            return what
        hog = max(owners, key=lambda descriptor: (held[descriptor], owners[descriptor].number), default=None)
        if strangers and most < of_strangers:
            strangers.reverse()  # of equal ones the newest
            strangers.sort(key=held.__getitem__, reverse=True)
            for descriptor in strangers[: max(1, len(strangers) // 4)]:
                self._visitors.close(descriptor, "memory")
            return "connections without hello"
        if hog is None or not close_tcp(hog, owners[hog].address):
            return ""
        client = owners[hog]
        _remember(self._barred, client.key_id, client.last_heard_ns + BARRED_NS)
        self._drops.count("memory")
        return f"{client.hello.name} from {client.address[0]}"

    def close(self) -> None:
        self._subscribers.close()

    def _owners(self) -> dict[int, Connection]:
        """Who said hello, by descriptor; of many on one connection the first: their gateway."""
        owners: dict[int, Connection] = {}
        for one in (*self._clients.by_number.values(), *self._clients.lost_lately):
            owners.setdefault(one.peer.descriptor, one)
        return owners

    def _silent(self, now_ns: int) -> None:
        self._clients.forget_given_up(now_ns - GIVEN_UP_NS)
        owners = self._owners()
        quiet: list[tuple[int, Visitor]] = []
        for descriptor, visitor in self._visitors.items():
            if descriptor in owners:
                visitor.quiet_ns = now_ns
            else:
                quiet.append((descriptor, visitor))
        limits = self._limits
        for descriptor in crowd(quiet, limits.strangers):
            self._visitors.close(descriptor, "strangers_too_many")
        for descriptor, visitor in quiet:
            late = now_ns - visitor.quiet_ns > limits.hello_timeout_ns
            if late and self._visitors.find(descriptor) is visitor:
                self._visitors.close(descriptor, "no_hello")

    def _count(self, address: str, now_ns: int) -> None:
        if now_ns - self._opened_ns > SECOND:
            self._opened_ns = now_ns
            self._opened.clear()
        if address in self._opened or len(self._opened) < MAX_REMEMBERED:
            self._opened[address] = self._opened.get(address, 0) + 1
            if self._opened[address] > OPENED_PER_S:
                self.flood(address, "connections", now_ns)


def _remember(table: dict[str, int], who: str, until_ns: int) -> None:
    table.pop(who, None)
    while len(table) >= MAX_REMEMBERED:
        del table[next(iter(table))]
    table[who] = until_ns
