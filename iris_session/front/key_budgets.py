"""Budgets of keys: what one key may send and cause, over all its connections.

The rates of `protocol.limits` bound each connection and message type. They alone would let one key multiply its share
by opening more connections, and spend it on what costs everyone most. `KeyBudget` holds the token buckets of one key,
`KeyBudgets` those of all keys. `intake` and `admission` take from them, and refuse what is above with a typed reason.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeVar

import msgspec

from iris_session.link.config import SECOND, FrontLimits
from iris_session.protocol.entries import Entry
from iris_session.protocol.limits import Drops, KeyedBuckets, KeyLimits, TokenBucket, find_network
from iris_session.security.zap import ZAP_CONTROL, ZAP_INGEST, ZAP_MEDIA, ZAP_STATE

K = TypeVar("K")
V = TypeVar("V")

#: What a budget counts, each with the field of `KeyLimits` that has its burst. Above it, the drop reason is
#: `key_messages`, and so on.
_BURSTS: Final = {
    "bytes": "byte_burst",
    "messages": "message_burst",
    "requests": "request_burst",
    "events": "event_burst",
    "estops": "estop_burst",
}
#: Connections refused: of a key that opens too many, or was disconnected for a flood a moment ago.
KEY_CONNECTIONS: Final = "key_connections"
KEY_BANNED: Final = "key_banned"
#: Connections to media ingest refused: of a key that flooded it before.
MEDIA_BACKOFF: Final = "media_backoff"
#: E-stops above the budget of their key, merged into the next one.
ESTOPS_MERGED: Final = "estops_merged"

#: Keys whose budgets are remembered; those with connections are never forgotten.
MAX_KEYS: Final = 256
#: Budgets without use are full again after this, so they can be forgotten.
FORGET_NS: Final = 60_000_000_000
#: E-stops that wait are looked for this often.
PERIOD_NS: Final = 50_000_000

#: A key that flooded media ingest is refused there for so long: twice as long each time, up to the last.
FIRST_BACKOFF_NS: Final = SECOND
MAX_BACKOFF_NS: Final = 60 * SECOND
#: A connection is noted later than it was accepted, by up to this on a busy machine.
ACCEPT_SLACK_NS: Final = SECOND


class KeyBudget:
    """Token buckets of one key.

    Attributes:
        is_gateway: The key may be a gateway's.
        parent: Budget of the gateway's key of a participant behind a gateway, which pays too.
        rejections: Token bucket of rejected messages of all its connections.
        used_ns: Session time of its last use.
        connections: Connections that use it.
    """

    def __init__(
        self, limits: FrontLimits, now_ns: int = 0, *, is_gateway: bool = False, parent: KeyBudget | None = None
    ) -> None:
        key, factor = limits.key, limits.key.gateway_factor if is_gateway else 1
        self.is_gateway = is_gateway
        self.parent = parent
        self._buckets = {
            name: TokenBucket(getattr(key, name) * factor, getattr(key, burst) * factor, now_ns)
            for name, burst in _BURSTS.items()
        }
        self.rejections = TokenBucket(limits.excess_per_s * factor, limits.excess_burst * factor, now_ns)
        self.used_ns = now_ns
        self.connections = 0

    def take(self, now_ns: int, **amounts: int) -> str:
        """Take amounts by name, as in `KeyLimits`. Return the drop reason of the first that is above the budget, empty
        for none."""
        self.used_ns = now_ns
        for name, n in amounts.items():
            if n and not self._buckets[name].take(now_ns, n):
                return f"key_{name}"
        return self.parent.take(now_ns, **amounts) if self.parent is not None else ""


class KeyBudgets:
    """Budgets of all keys. A `Service`: `tick` offers e-stops that waited for a token.

    Args:
        limits: Limits of the front.
        offer: Queues an entry for the authority.
    """

    def __init__(self, limits: FrontLimits, offer: Callable[[Entry], bool]) -> None:
        self._limits = limits
        self._offer = offer
        self._budgets: dict[str, KeyBudget] = {}  # the most recently found comes last
        self._late: dict[str, tuple[KeyBudget, Entry]] = {}  # the newest e-stop above the budget of each key
        self._next_ns = 0

    def __len__(self) -> int:
        return len(self._budgets)

    def find(self, key_id: str, now_ns: int, *, is_gateway: bool = False, parent: KeyBudget | None = None) -> KeyBudget:
        """Return the budget of a key, a full one for a key that was not seen lately.

        Args:
            key_id: The key, or the hash of the secret that stands for it.
            now_ns: Session time.
            is_gateway: Whether the key may be a gateway's.
            parent: Budget of the gateway that speaks for it.
        """
        budget = self._budgets.pop(key_id, None)
        if budget is None or budget.is_gateway is not is_gateway:  # the roles of the key have changed
            self._forget(now_ns)
            budget = KeyBudget(self._limits, now_ns, is_gateway=is_gateway, parent=parent)
        budget.parent = parent
        self._budgets[key_id] = budget
        return budget

    def hold_estop(self, key_id: str, budget: KeyBudget, entry: Entry) -> None:
        """Keep an e-stop above the budget, in place of an earlier one, until there is a token."""
        self._late[key_id] = budget, entry

    def tick(self, now_ns: int) -> None:
        """Offer e-stops that waited for a token. A stop is delayed and merged, never lost."""
        if not self._late or now_ns < self._next_ns:
            return
        self._next_ns = now_ns + PERIOD_NS
        for key_id, (budget, entry) in list(self._late.items()):
            if not budget.take(now_ns, estops=1):
                self._offer(msgspec.structs.replace(entry, receive_ns=now_ns))
                del self._late[key_id]

    def _forget(self, now_ns: int) -> None:
        """Forget budgets that are full again, and the least recently found ones of keys without connections."""
        if len(self._budgets) < MAX_KEYS:
            return
        idle = [key_id for key_id, budget in self._budgets.items() if not budget.connections]
        old = [key_id for key_id in idle if now_ns - self._budgets[key_id].used_ns > FORGET_NS]
        for key_id in old or idle[: len(self._budgets) - MAX_KEYS + 1]:
            del self._budgets[key_id]


class HandshakeLimiter:
    """Limit how often a key opens connections to each channel: each costs memory before its first message.

    Keys that flooded media ingest are refused there: for 1 s, then 2, 4 ... 60 s. libzmq names the key of a connection
    with its first whole message. So when a connection is closed before that, all keys are refused that have connected
    from its address since it was opened: its own is among them, if it has one. Connections that are open stay. A key
    that floods no more for as long as it was last refused for, and a minute, begins anew.

    Args:
        limits: Of keys.
        drops: Drop counters.
        is_gateway: Returns whether a key may be a gateway's.
        is_banned: Returns whether a key was disconnected for a flood a moment ago; it may connect to control, where
            its hello is refused with the reason.
    """

    def __init__(
        self,
        limits: KeyLimits,
        drops: Drops,
        is_gateway: Callable[[str], bool],
        is_banned: Callable[[str, int], bool],
    ) -> None:
        self._limits = limits
        self._drops = drops
        self._is_gateway = is_gateway
        self._is_banned = is_banned
        self._buckets = KeyedBuckets(limits.handshakes, limits.handshake_burst, MAX_KEYS)
        self._subscribers = KeyedBuckets(limits.subscriber_handshakes, limits.subscriber_handshake_burst, MAX_KEYS)
        self._sources: dict[tuple[str, str], int] = {}  # handshakes at media ingest by network and key; the newest last
        self._refused: dict[str, tuple[int, int]] = {}  # key -> until when it is refused there, and for how long

    def allow(self, domain: bytes, key_id: str, address: str, now_ns: int) -> bool:
        """Return whether a key may open one more connection to a channel, and use its token."""
        if domain == ZAP_INGEST and now_ns < self._refused.get(key_id, (0, 0))[0]:
            self._drops.count(MEDIA_BACKOFF)
            return False
        if domain != ZAP_CONTROL and self._is_banned(key_id, now_ns):
            self._drops.count(KEY_BANNED)
            return False
        factor = self._limits.gateway_factor if self._is_gateway(key_id) else 1
        buckets = self._subscribers if domain in (ZAP_STATE, ZAP_MEDIA) else self._buckets
        if not buckets.take((domain, key_id), now_ns, factor=factor):
            self._drops.count(KEY_CONNECTIONS)
            return False
        if domain == ZAP_INGEST:
            remember(self._sources, (find_network(address), key_id), now_ns)
        return True

    def refuse_source(self, address: str, key_id: str, opened_ns: int, now_ns: int) -> dict[str, int]:
        """Refuse the key of a connection to media ingest that was closed for a flood, or those of which it had one.

        Args:
            address: Of the connection.
            key_id: Its key, empty where it is not known.
            opened_ns: Session time at which it was opened.
            now_ns: Session time.

        Returns:
            For how long each key is refused [ns], without those that are refused already.
        """
        network, since_ns = find_network(address), opened_ns - ACCEPT_SLACK_NS
        seen = [key for (where, key), at_ns in self._sources.items() if where == network and at_ns >= since_ns]
        refused: dict[str, int] = {}
        for key in [key_id] if key_id else seen:
            until_ns, last_ns = self._refused.get(key, (-FORGET_NS, 0))
            if now_ns < until_ns:
                continue  # the flood for which it is refused
            if now_ns - until_ns > FORGET_NS:
                last_ns = 0
            refused[key] = min(max(2 * last_ns, FIRST_BACKOFF_NS), MAX_BACKOFF_NS)
            remember(self._refused, key, (now_ns + refused[key], refused[key]))
        return refused


def remember(table: dict[K, V], key: K, value: V) -> None:
    """Put a value into a bounded table; the one that was put there first is forgotten."""
    table.pop(key, None)
    while len(table) >= MAX_KEYS:
        del table[next(iter(table))]
    table[key] = value


def describe_excess(reason: str, limits: KeyLimits) -> str:
    """Return the text of a message that was rejected for `reason`, that of `KeyBudget.take`."""
    amount = {
        "key_messages": f"{limits.messages:g} messages a second",
        "key_bytes": f"{limits.bytes:g} bytes a second",
        "key_requests": f"requests worth {limits.requests:g} units a second",
        "key_events": f"{limits.events:g} events a second",
    }[reason]
    return f"this key is above {amount}, over all its connections"
