"""The hub: who is behind a gateway, what waits for whom, tickets, limits, and why a socket is closed.

Pure: bytes, times and random bytes come in as arguments; no sockets, clocks or threads. `server` reads and writes the
WebSockets, `gateway` the sockets of the session. A browser here is anything that holds a WebSocket, apps included.
"""

from __future__ import annotations

import base64
import hashlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Final

import msgspec

from iris_session.protocol.client_messages import Disconnected, wrap_message
from iris_session.protocol.codec import Bytes, encode_client, encode_server
from iris_session.protocol.errors import MalformedError, ProtocolError, ProtocolVersionError
from iris_session.protocol.limits import Drops, KeyedBuckets, TokenBucket, find_network
from iris_session.protocol.names import PROTOCOL_VERSION, FaultCode
from iris_session.protocol.server_messages import ROBOT_STATES, TOPIC_ROBOTS, ProtocolFault, ServerEnvelope
from iris_session.web.wire import (
    CLOSE_LIMIT,
    CLOSE_NOT_ALLOWED,
    CLOSE_TOO_SLOW,
    CLOSE_VERSION,
    CONTROL,
    STATE,
    ClientHead,
    Ticket,
    decode_frames,
    encode_frames,
    encode_gateway_message,
    peek_client_message,
    peek_server_message,
    splice_name,
)

SECOND: Final = 1_000_000_000
#: Random bytes of a name, and of a ticket.
NAME_BYTES: Final = 6
TICKET_BYTES: Final = 32
_NAME_PREFIX: Final = "web-"
#: All names have this length; no bulk frame of the session has (they are multiples of 56 bytes).
NAME_LENGTH: Final = len(_NAME_PREFIX) + 2 * NAME_BYTES
#: Client messages that are larger are not looked into.
_SMALL: Final = 256
#: Faults after which a connection is over for the session.
_ENDING_FAULTS: Final = frozenset({FaultCode.DROPPED, FaultCode.REVOKED, FaultCode.HELLO, FaultCode.SESSION_ENDED})
_BYE: Final = "bye"
_HELLO: Final = "hello"
_PAIR: Final = "pair"
#: Networks whose pairing attempts and messages without a `welcome` are counted.
MAX_NETWORKS: Final = 1024
#: Identities that the session has welcomed, and whose messages without a `welcome` count for themselves.
MAX_IDENTITIES: Final = 256
#: Answers to malformed messages of one browser.
_FAULTS_PER_S, _FAULT_BURST = 2.0, 5
#: Requests of one identity for assets that the session does not serve: each costs the session an answer.
_UNKNOWN_PER_S, _UNKNOWN_BURST = 0.5, 32
#: Media sockets that one browser opens: each is a handshake of the gateway's key, and the session allows 8 a second.
_MEDIA_PER_S, _MEDIA_BURST = 0.5, 8
_WELCOME, _FAULT, _REFUSED, _BUDGET = "welcome", "protocol_fault", "refused", "delivery_budget"


class HubLimits(msgspec.Struct, frozen=True):
    """Bounds of what browsers can cause in a gateway. What a participant may send is bounded by the session besides.

    Attributes:
        browsers: WebSockets for control at once; a session has 64 connections.
        messages_per_s, message_burst: Messages of one browser.
        bytes_per_s, byte_burst: Their bytes.
        pair_per_s, pair_burst: Pairing attempts of one network; the session counts wrong ones against the gateway.
        early_per_s, early_burst: Messages without a `welcome`, and hellos, of one network, and of one identity that
            the session has welcomed before: the session counts those against the gateway.
        early_shared_per_s, early_shared_burst: More of them, which all networks share.
        queued_messages, queued_bytes: Control messages that wait for one browser; a snapshot has at most 32 MB.
        total_bytes: Control messages that wait for all browsers together.
        join_ns: Time until the session has welcomed a browser.
        silence_ns: Longest time without a message of a browser, which sends heartbeats twice a second.
        ticket_ns: Life of a ticket; a new one is sent after half of it.
    """

    browsers: int = 96
    messages_per_s: float = 1500.0
    message_burst: int = 3000
    bytes_per_s: float = 4.0 * (1 << 20)
    byte_burst: int = 8 << 20
    pair_per_s: float = 20 / 600
    pair_burst: int = 20
    early_per_s: float = 2.0
    early_burst: int = 20
    early_shared_per_s: float = 100.0
    early_shared_burst: int = 400
    queued_messages: int = 1024
    queued_bytes: int = 48 << 20
    total_bytes: int = 128 << 20
    join_ns: int = 20 * SECOND
    silence_ns: int = 15 * SECOND
    ticket_ns: int = 600 * SECOND


class Closing(msgspec.Struct, frozen=True):
    """Code and reason with which a WebSocket is closed."""

    code: int
    reason: str


class Browser:
    """One WebSocket for control and state.

    Attributes:
        name: What the gateway calls it in `on_behalf_of`.
        address: Of its peer; of IPv6 its network.
        identity: SHA-256 of the secret in its hello, empty before.
        reads_robots: Its newest hello asks for the states of the robots.
        epoch: Connection epoch of its present `welcome`, 0 without one: then it gets no state, media and assets.
        has_budget: The session has sent its delivery budget, so that it may subscribe to media.
        outgoing: Control messages that wait, oldest first.
        latest: The newest message of each topic that waits.
        superseded: Messages of state that were replaced by newer ones before they were sent.
        closing: Why it is to be closed, `None` while it is not.
        wake: Called when something waits, or when `closing` is set.
    """

    def __init__(self, name: str, address: str, limits: HubLimits, now_ns: int) -> None:
        self.name = name
        self.address = find_network(address)
        self.identity = b""
        self.reads_robots = False
        self.epoch = 0
        self.has_budget = False
        self.outgoing: deque[bytes] = deque()
        self.latest: dict[bytes, bytes] = {}
        self.superseded = 0
        self.closing: Closing | None = None
        self.wake: Callable[[], None] = _do_nothing
        self.queued_bytes = 0
        self.opened_ns = now_ns
        self.heard_ns = now_ns
        self.said_hello = False
        self.ticket = b""
        self.ticket_ns = 0
        self.messages = TokenBucket(limits.messages_per_s, limits.message_burst, now_ns)
        self.bytes = TokenBucket(limits.bytes_per_s, limits.byte_burst, now_ns)
        self.faults = TokenBucket(_FAULTS_PER_S, _FAULT_BURST, now_ns)
        self.media_opens = TokenBucket(_MEDIA_PER_S, _MEDIA_BURST, now_ns)

    @property
    def is_admitted(self) -> bool:
        """True while the session has welcomed it."""
        return self.epoch > 0 and self.closing is None

    def close(self, code: int, reason: str) -> None:
        """Let the WebSocket be closed. The first reason counts."""
        if self.closing is None:
            self.closing = Closing(code, reason)
        self.outgoing.clear()
        self.latest.clear()
        self.queued_bytes = 0
        self.wake()


class Hub:
    """Browsers of one gateway.

    Attributes:
        drops: Counters of what was refused or dropped, by reason.
    """

    def __init__(self, limits: HubLimits | None = None, drops: Drops | None = None) -> None:
        self.limits = HubLimits() if limits is None else limits
        self.drops = Drops() if drops is None else drops
        self._browsers: dict[str, Browser] = {}
        self._pairs = KeyedBuckets(self.limits.pair_per_s, self.limits.pair_burst, MAX_NETWORKS)
        self._early = KeyedBuckets(self.limits.early_per_s, self.limits.early_burst, MAX_NETWORKS)
        self._early_shared = TokenBucket(self.limits.early_shared_per_s, self.limits.early_shared_burst)
        self._welcomed: dict[bytes, TokenBucket] = {}  # by identity; the one that was welcomed last comes last
        self._unknown_assets = KeyedBuckets(_UNKNOWN_PER_S, _UNKNOWN_BURST, MAX_IDENTITIES)
        self._tickets: dict[bytes, tuple[Browser, int]] = {}  # with the time at which each expires

    def __len__(self) -> int:
        return len(self._browsers)

    def __iter__(self) -> Iterator[Browser]:
        return iter(list(self._browsers.values()))

    # --- life of a browser --------------------------------------------------------------------------------------------

    def open_browser(self, random: bytes, address: str, now_ns: int) -> Browser | None:
        """Return a new browser, `None` when there are too many. `random`: `NAME_BYTES` bytes.

        Browsers without a welcome make room: the oldest of the address that has the most of them.
        """
        name = f"{_NAME_PREFIX}{random[:NAME_BYTES].hex()}"
        if len(self._browsers) >= self.limits.browsers:
            self._evict_waiting()
        if len(self._browsers) >= self.limits.browsers or name in self._browsers:
            self.drops.count("web_full")
            return None
        browser = self._browsers[name] = Browser(name, address, self.limits, now_ns)
        return browser

    def _evict_waiting(self) -> None:
        by_address: dict[str, list[Browser]] = {}
        for browser in self._browsers.values():
            if not browser.epoch:
                by_address.setdefault(browser.address, []).append(browser)
        if by_address:
            oldest = max(by_address.values(), key=len)[0]
            del self._browsers[oldest.name]
            self._reject(oldest, CLOSE_LIMIT, "web_evicted", "too many clients that have not joined: come again")

    def close_browser(self, browser: Browser) -> bytes | None:
        """Remove a browser whose WebSocket is closed. Return the message for the session, if it has a connection."""
        self._browsers.pop(browser.name, None)
        message = (
            encode_client(wrap_message(Disconnected(), browser.epoch, browser.name)) if browser.said_hello else None
        )
        self._leave(browser)
        browser.close(CLOSE_NOT_ALLOWED, "closed")
        return message

    def close_all(self, code: int, reason: str) -> None:
        """Let all WebSockets be closed; the session does not know these connections any more."""
        for browser in self:
            self._leave(browser)
            browser.close(code, reason)

    def find(self, name: str) -> Browser | None:
        """Return the browser with a name."""
        return self._browsers.get(name)

    def _leave(self, browser: Browser) -> None:
        """Note that the session has no connection for a browser any more."""
        browser.epoch = 0
        browser.has_budget = browser.said_hello = False
        browser.latest.clear()
        for ticket, (owner, _) in list(self._tickets.items()):
            if owner is browser:
                del self._tickets[ticket]
        browser.ticket = b""

    def _reject(self, browser: Browser, code: int, drop: str, text: str) -> None:
        self.drops.count(drop)
        browser.close(code, text)

    def note_unknown_asset(self, browser: Browser, now_ns: int) -> None:
        """Note that a browser asked for an asset that the session does not serve; too many close its WebSocket."""
        if not self._unknown_assets.take(browser.identity, now_ns):
            self._reject(browser, CLOSE_LIMIT, "web_flood", "too many requests for assets that are not served")

    def allow_media(self, browser: Browser, now_ns: int) -> bool:
        """Return whether a browser may open one more media socket now."""
        if browser.media_opens.take(now_ns):
            return True
        self.drops.count("web_flood")
        return False

    # --- from browsers to the session ---------------------------------------------------------------------------------

    def receive(self, browser: Browser, data: Bytes, now_ns: int) -> bytes | None:
        """Return the envelope to send to the session for a binary message, `None` when there is none.

        What does not fit closes the browser's WebSocket, and is counted. Nothing raises.
        """
        if browser.closing is not None:
            return None
        browser.heard_ns = now_ns
        if not browser.messages.take(now_ns) or not browser.bytes.take(now_ns, len(data)):
            self._reject(browser, CLOSE_LIMIT, "web_flood", "more messages than a client may send: send less")
            return None
        try:
            channel, frames = decode_frames(data)
            if channel != CONTROL or len(frames) != 1:
                text = f"channel {channel} with {len(frames)} frames: expected channel {CONTROL} with one"
                self._reject(browser, CLOSE_NOT_ALLOWED, "web_malformed", text)
                return None
            envelope = splice_name(frames[0], browser.name)
        except ProtocolVersionError as error:
            self._reject(browser, CLOSE_VERSION, "web_version", str(error))
            return None
        except ProtocolError as error:
            self._reject(browser, CLOSE_NOT_ALLOWED, f"web_{error.code}", str(error))
            return None
        return envelope if self._check_message(browser, frames[0], now_ns) else None

    def _take_early(self, browser: Browser, now_ns: int) -> bool:
        """Return whether a message that the session may count against the gateway is within the limits of its identity,
        if that was welcomed before, or of its network. What is above closes the browser's WebSocket."""
        own = self._welcomed.get(browser.identity)
        if own is not None and own.take(now_ns):
            return True  # whatever others behind the same address send
        if self._early.take(browser.address, now_ns) or self._early_shared.take(now_ns):
            return True
        self._reject(browser, CLOSE_LIMIT, "web_flood", "too many messages before the welcome: come again")
        return False

    def _identify(self, browser: Browser, secret: bytes) -> bool:
        """Note the identity of a browser, which is that of its first hello: what it is allowed depends on that."""
        identity = hashlib.sha256(secret).digest()
        if browser.identity and browser.identity != identity:
            self._reject(browser, CLOSE_NOT_ALLOWED, "web_identity", "a WebSocket has one identity: open another one")
            return False
        browser.identity = identity
        return True

    def _check_message(self, browser: Browser, envelope: memoryview, now_ns: int) -> bool:
        """Return whether a message is for the session. What is not MessagePack is answered as the session would.

        Note a hello, after which the session has a connection to lose, and a bye, after which it has none.
        """
        malformed, head = None, ClientHead()
        try:
            head = peek_client_message(envelope)
        except MalformedError as error:
            malformed = error
        kind = head.type
        if kind == _HELLO and not self._identify(browser, head.secret):
            return False
        if (kind == _HELLO or not browser.epoch) and not self._take_early(browser, now_ns):
            return False
        if malformed is not None:
            self.drops.count("web_malformed")
            if browser.faults.take(now_ns):
                fault = ServerEnvelope(PROTOCOL_VERSION, browser.epoch, ProtocolFault(malformed.code, str(malformed)))
                self._queue(browser, encode_frames(CONTROL, (encode_server(fault),)))
            return False
        if kind == _PAIR and not self._pairs.take(browser.address, now_ns):
            text = "too many pairing attempts from this address: wait a minute"
            self._reject(browser, CLOSE_LIMIT, "web_pair_rate", text)
            return False
        if kind == _HELLO:
            browser.reads_robots = isinstance(head.capabilities, list) and ROBOT_STATES in head.capabilities
        if kind == _BYE and browser.said_hello:
            self._leave(browser)
        elif kind != _BYE:
            browser.said_hello = True
        return True

    # --- from the session to browsers ---------------------------------------------------------------------------------

    def deliver(self, frames: Sequence[bytes], now_ns: int) -> bool:
        """Queue a message of the control channel for the browser that its last frame names.

        Return false when the last frame is not the name of a browser: the message is the gateway's own.
        """
        name = frames[-1]
        if len(name) != NAME_LENGTH or not name.startswith(_NAME_PREFIX.encode()):
            return False
        browser = self._browsers.get(name.decode("ascii", "replace"))
        if browser is None or browser.closing is not None:
            self.drops.count("web_unknown_name")
            return True
        body = frames[:-1]
        self._note_server_message(browser, body[0], now_ns)
        self._queue(browser, encode_frames(CONTROL, body))
        return True

    def _note_server_message(self, browser: Browser, envelope: bytes, now_ns: int) -> None:
        head = peek_server_message(envelope)
        if head.type == _WELCOME:
            self._leave(browser)
            browser.said_hello = True
            browser.epoch = head.connection_epoch
            self._note_welcomed(browser.identity, now_ns)
        elif head.type == _BUDGET:
            browser.has_budget = True
            browser.wake()
        elif head.type == _FAULT and head.code in _ENDING_FAULTS:
            self._leave(browser)
            browser.opened_ns = now_ns  # it has time to say hello again
        elif head.type == _REFUSED and not browser.epoch:
            browser.said_hello = False

    def _note_welcomed(self, identity: bytes, now_ns: int) -> None:
        limits = self.limits
        bucket = self._welcomed.pop(identity, None)
        self._welcomed[identity] = bucket or TokenBucket(limits.early_per_s, limits.early_burst, now_ns)
        if len(self._welcomed) > MAX_IDENTITIES:
            del self._welcomed[next(iter(self._welcomed))]

    def _queue(self, browser: Browser, message: bytes) -> None:
        """Queue a control message. A browser for which too much waits does not read: its WebSocket is closed. When too
        much waits for all together, it is that for which most waits."""
        limits = self.limits
        browser.outgoing.append(message)
        browser.queued_bytes += len(message)
        if len(browser.outgoing) > limits.queued_messages or browser.queued_bytes > limits.queued_bytes:
            self._reject_slow(browser)
        elif len(message) > _SMALL:
            while sum(other.queued_bytes for other in self._browsers.values()) > limits.total_bytes:
                self._reject_slow(max(self._browsers.values(), key=lambda other: other.queued_bytes))
        browser.wake()

    def _reject_slow(self, browser: Browser) -> None:
        self._reject(browser, CLOSE_TOO_SLOW, "web_too_slow", "control messages are not read")

    def publish(self, frames: Sequence[Bytes]) -> None:
        """Set the newest message of a topic of the state channel for every admitted browser that reads it."""
        topic = bytes(frames[0])
        readers = [b for b in self._browsers.values() if b.is_admitted and (b.reads_robots or topic != TOPIC_ROBOTS)]
        if not readers:
            return
        message = encode_frames(STATE, frames)
        for browser in readers:
            browser.superseded += topic in browser.latest
            browser.latest[topic] = message
            browser.wake()

    @staticmethod
    def take_message(browser: Browser) -> bytes | None:
        """Remove and return the oldest control message that waits for a browser."""
        if not browser.outgoing:
            return None
        message = browser.outgoing.popleft()
        browser.queued_bytes -= len(message)
        return message

    @staticmethod
    def take_latest(browser: Browser) -> bytes | None:
        """Remove and return a newest value that waits for a browser; the topic that waits longest comes first."""
        if not browser.latest:
            return None
        return browser.latest.pop(next(iter(browser.latest)))

    # --- tickets and time ---------------------------------------------------------------------------------------------

    def needs_ticket(self, browser: Browser, now_ns: int) -> bool:
        """Return whether a browser is to get a ticket: after its welcome, and before the last one expires."""
        return browser.is_admitted and (not browser.ticket or now_ns - browser.ticket_ns >= self.limits.ticket_ns // 2)

    def issue_ticket(self, browser: Browser, random: bytes, now_ns: int) -> None:
        """Make a ticket of `TICKET_BYTES` random bytes and queue it. The one before stays valid until it expires."""
        text = base64.urlsafe_b64encode(random).rstrip(b"=")
        self._tickets[text] = browser, now_ns + self.limits.ticket_ns
        browser.ticket, browser.ticket_ns = text, now_ns
        self._queue(browser, encode_gateway_message(Ticket(text.decode(), self.limits.ticket_ns // SECOND)))

    def find_ticket(self, text: str, now_ns: int) -> Browser | None:
        """Return the browser whose ticket this is, `None` for one that is wrong or has expired."""
        browser, expires_ns = self._tickets.get(text.encode("utf-8", "replace"), (None, 0))
        if browser is None or now_ns >= expires_ns or not browser.is_admitted:
            self.drops.count("web_ticket")
            return None
        return browser

    def tick(self, now_ns: int) -> None:
        """Close browsers that were not welcomed in time or are silent, and forget tickets that have expired."""
        for browser in self:
            if browser.closing is not None:
                continue
            if not browser.epoch and now_ns - browser.opened_ns > self.limits.join_ns:
                self._reject(browser, CLOSE_LIMIT, "web_no_hello", "the session has not welcomed this client in time")
            elif now_ns - browser.heard_ns > self.limits.silence_ns:
                self._reject(browser, CLOSE_LIMIT, "web_silent", "nothing was heard: send heartbeats")
        for ticket, (_, expires_ns) in list(self._tickets.items()):
            if now_ns >= expires_ns:
                del self._tickets[ticket]


def _do_nothing() -> None:
    return
