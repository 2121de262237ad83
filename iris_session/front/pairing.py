"""Pairing: a client with an unknown key proves that it knows a join code, and its key is put on the allow-list.

A code has few attempts, and so has an address. One attempt after the other goes to `FileWorker`, which changes the
files of the home of keys; the answer is sent when that is done, and nothing else waits for it.
"""

from __future__ import annotations

import ipaddress
import logging
import time
from collections import deque
from functools import partial
from typing import Final, NamedTuple

from iris_session.front.connections import Peer, Route
from iris_session.front.context import FrontContext
from iris_session.link.config import SECOND
from iris_session.link.sockets import peer_of
from iris_session.protocol import pairing
from iris_session.protocol.client_messages import Pair
from iris_session.protocol.limits import TokenBucket
from iris_session.protocol.names import AuditKind, RefusalCode
from iris_session.protocol.server_messages import Paired, Refused
from iris_session.security import JoinCode, KeyHome, KeyPair, KeysBusyError, KeysError, compute_fingerprint, decode_key
from iris_session.security.join_codes import RedeemResult
from iris_session.security.keyring import parse_pairing_key
from iris_session.system.file_worker import LOCK_TIMEOUT_S

log = logging.getLogger(__name__)

#: Limit of all clients together.
PER_SECOND: Final = 10.0
BURST: Final = 16
#: Limit of one address, before an attempt counts against the limit of all.
ADDRESS_PER_SECOND: Final = 2.0
ADDRESS_BURST: Final = 12
#: How long an attempt may be pending, and how many may: a client waits 5 s for the answer.
PATIENCE_NS: Final = 2 * SECOND
MAX_PENDING: Final = 32
#: Wrong codes of one address within `WINDOW_NS`: as many as two codes have.
ADDRESS_ATTEMPTS: Final = 10
WINDOW_NS: Final = 600 * SECOND
MAX_ADDRESSES: Final = 1024
#: Codes that could not be read (no descriptor left, a network drive) are read again after so long.
RETRY_S: Final = 1.0
REVOKED: Final = "this key was revoked just now"
BUSY: Final = "the list of keys is busy"
TOO_MANY_WRONG: Final = "too many wrong codes from this address"


class _PendingAttempt(NamedTuple):
    route: Route
    address: str
    key: str
    pair: Pair
    since_ns: int


class PairingService:
    """Handle `Pair` messages. A `Service`: answers are sent by `tick`."""

    def __init__(self, context: FrontContext) -> None:
        self._keyring = context.keyring
        self._outbox = context.outbox
        self._audit = context.audit
        self._drops = context.drops
        self._pairs = TokenBucket(PER_SECOND, BURST)
        self._refusals = TokenBucket(PER_SECOND, BURST)
        self._pending: deque[_PendingAttempt] = deque()
        self._trying = False
        self._rates: dict[str, TokenBucket] = {}
        self._wrong: dict[str, tuple[int, int]] = {}  # network -> wrong attempts, since when [ns]
        self._signature: object = None
        self._read_error, self._retry_s = "", 0.0  # why the codes could not be read, and when they are read again
        self._codes: tuple[JoinCode, ...] = ()

    @property
    def has_open_code(self) -> bool:
        """True if a join code can be used now."""
        now_s = time.time()
        return any(code.is_open(now_s) for code in self._list_codes())

    def _list_codes(self) -> tuple[JoinCode, ...]:
        """Return the codes of this session, read again if their file has changed."""
        home, key = self._keyring.home, self._keyring.key
        if home is None or key is None:
            return ()
        signature = home.join_codes.signature
        if signature != self._signature or (self._read_error and time.monotonic() >= self._retry_s):
            self._signature = signature
            self._read_codes(home, key)
        return self._codes

    def _read_codes(self, home: KeyHome, key: KeyPair) -> None:
        """Read the join codes. Codes that cannot be read are tried again a second later, and logged once."""
        try:
            self._codes, read_error = home.join_codes.list_for_server(key.fingerprint), ""
        except KeysError as error:
            self._codes, read_error = (), str(error)
            self._retry_s = time.monotonic() + RETRY_S
            if read_error != self._read_error:
                log.warning("pairing does not work: %s", error)
        self._read_error = read_error

    def handle_pair(self, route: Route, peer: Peer, pair: Pair, now_ns: int) -> None:
        """Handle a `Pair`, of a key that is on the list or is not."""
        address = peer_of(peer.descriptor)[0]
        key = parse_pairing_key(peer.user_id)
        known = self._keyring.find_key(peer.user_id)
        if known is not None:
            key = known.key
        allowed = self._allow_address(address, now_ns)
        if self._has_exhausted_attempts(address, now_ns):  # before the limits that clients share
            self._audit.record(AuditKind.CODE_REFUSED, now_ns, address=address, detail="too many wrong codes")
            self._drops.count("pair_shut_out")
            if allowed:
                self._refuse(route, TOO_MANY_WRONG, "wait ten minutes")
        elif not allowed or not self._pairs.take(now_ns) or len(self._pending) >= MAX_PENDING:
            self._drops.count("pair_rate")
            if self._refusals.take(now_ns):
                advice = "try again in a second"
                self._outbox.send_to_route(route, Refused(RefusalCode.RATE, "too many pairing attempts", advice))
        elif self._keyring.key is None:
            self._refuse(route, "this session is not encrypted: it has no keys to pair", "say hello")
        elif not key:
            self._refuse(route, "this key was revoked while it was connected", "connect anew")
        elif route.on_behalf_of:
            self._refuse(route, "a key pairs for itself", "leave on_behalf_of empty")
        elif self._keyring.home is None:
            self._refuse(route, "this session takes its keys from a folder", "ask for your public key to be put there")
        elif compute_fingerprint(decode_key(key)) in self._keyring.pending_revocations:
            self._refuse(route, REVOKED, "ask for another join code")
        elif (earlier := self._find_earlier_answer(key, pair)) is not None:
            self._outbox.send_to_route(route, earlier)
        elif not self.has_open_code:
            mark = compute_fingerprint(decode_key(key))
            self._audit.record(AuditKind.CODE_REFUSED, now_ns, subject=mark, name=pair.name, address=address)
            self._refuse(route, "no join code can be used now", "run `iris-session pair` where the session runs")
        else:
            self._pending.append(_PendingAttempt(route, address, key, pair, now_ns))

    def _find_earlier_answer(self, key: str, pair: Pair) -> Paired | None:
        """Return the answer to an attempt that succeeded and is repeated, because the first answer was lost or late.

        The file of codes keeps it, so a front that was restarted since gives the same answer. `None` for another
        attempt, and for a key that has been taken off the list since.
        """
        entry = self._keyring.find_key(compute_fingerprint(decode_key(key)))
        for code in self._list_codes() if entry is not None else ():
            paired = code.paired is not None and code.paired.key == key
            if entry is not None and paired and pairing.is_same_proof(code.proof, pair.proof):
                return Paired(code.answer, entry.roles)
        return None

    def tick(self, now_ns: int) -> None:
        """Start the next attempt when the one before is done."""
        pending, self._pending = self._pending, deque()
        for one in pending:
            self._recheck_pending(one, now_ns)
        if self._trying or not self._pending or self._keyring.is_missing:  # a new list would have no other key
            return
        home, key = self._keyring.home, self._keyring.key
        assert home is not None
        assert key is not None
        first = self._pending[0]
        self._trying = self._keyring.files.submit(
            partial(_run_attempt, home, key, first), partial(self._on_attempt_done, first)
        )
        if self._trying:
            self._pending.popleft()

    def _recheck_pending(self, one: _PendingAttempt, now_ns: int) -> None:
        """Keep an attempt pending, or end it because of what happened since it came."""
        if now_ns - one.since_ns > PATIENCE_NS:
            self._refuse_busy(one.route)
        elif compute_fingerprint(decode_key(one.key)) in self._keyring.pending_revocations:
            self._refuse(one.route, REVOKED, "ask for another join code")
        elif self._has_exhausted_attempts(one.address, now_ns):
            self._refuse(one.route, TOO_MANY_WRONG, "wait ten minutes")
        elif (earlier := self._find_earlier_answer(one.key, one.pair)) is not None:
            self._outbox.send_to_route(one.route, earlier)  # another process of this user has paired meanwhile
        else:
            self._pending.append(one)

    def _on_attempt_done(self, pending: _PendingAttempt, outcome: RedeemResult | KeysError, now_ns: int) -> None:
        self._trying = False
        if isinstance(outcome, RedeemResult):
            self._answer(pending, outcome, now_ns)
        elif isinstance(outcome, KeysBusyError):
            self._refuse_busy(pending.route)
        else:
            log.warning("pairing does not work: %s", outcome)
            advice = "see the terminal of the session"
            self._refuse(pending.route, "the session cannot change its list of keys", advice)

    def close(self) -> None:
        """Do nothing: nothing was opened."""

    def _answer(self, pending: _PendingAttempt, attempt: RedeemResult, now_ns: int) -> None:
        mark = compute_fingerprint(decode_key(pending.key))
        entry = attempt.entry
        if entry is not None:
            self._wrong.pop(_network_prefix(pending.address), None)
            revoked = mark in self._keyring.pending_revocations  # since it asked: the later word counts
            if revoked or not self._keyring.confirm_pairing(mark):
                self._refuse(pending.route, REVOKED, "ask for another join code")
                return
            roles = ", ".join(entry.roles) or "any role"
            self._audit.record(
                AuditKind.PAIRED, now_ns, subject=mark, name=entry.name, address=pending.address, detail=roles
            )
            self._outbox.send_to_route(pending.route, Paired(attempt.answer, entry.roles))
            return
        self._count_wrong(pending.address, now_ns)
        kind = AuditKind.CODE_EXHAUSTED if attempt.exhausted else AuditKind.CODE_REFUSED
        self._audit.record(kind, now_ns, subject=mark, name=pending.pair.name, address=pending.address)
        advice = "run `iris-session pair` again" if not attempt.open_codes else "check the code"
        self._refuse(pending.route, "this join code is wrong, used or expired", advice)

    def _refuse_busy(self, route: Route) -> None:
        """Refuse without an attempt: the client may try again, and no attempt of the code is used."""
        self._drops.count("pair_busy")
        self._outbox.send_to_route(route, Refused(RefusalCode.RATE, BUSY, "try again"))

    def _refuse(self, route: Route, message: str, advice: str) -> None:
        self._drops.count("pair_refused")
        self._outbox.send_to_route(route, Refused(RefusalCode.CODE, message, advice))

    def _allow_address(self, address: str, now_ns: int) -> bool:
        """Return whether this address is within its rate limit, and use a token."""
        network = _network_prefix(address)
        bucket = self._rates.pop(network, None) or TokenBucket(ADDRESS_PER_SECOND, ADDRESS_BURST, now_ns)
        while len(self._rates) >= MAX_ADDRESSES:
            del self._rates[next(iter(self._rates))]
        self._rates[network] = bucket
        return bucket.take(now_ns)

    def _has_exhausted_attempts(self, address: str, now_ns: int) -> bool:
        wrong, since_ns = self._wrong.get(_network_prefix(address), (0, now_ns))
        return wrong >= ADDRESS_ATTEMPTS and now_ns - since_ns < WINDOW_NS

    def _count_wrong(self, address: str, now_ns: int) -> None:
        network = _network_prefix(address)
        wrong, since_ns = self._wrong.pop(network, (0, now_ns))
        if now_ns - since_ns >= WINDOW_NS:
            wrong, since_ns = 0, now_ns
        while len(self._wrong) >= MAX_ADDRESSES:
            del self._wrong[next(iter(self._wrong))]
        self._wrong[network] = (wrong + 1, since_ns)


def _run_attempt(home: KeyHome, key: KeyPair, pending: _PendingAttempt) -> RedeemResult:
    pair = pending.pair
    name = "".join(c for c in pair.name if c.isprintable()).strip() or "unnamed"
    return home.join_codes.redeem(key.raw_public, pending.key, pair.proof, name, home.clients, LOCK_TIMEOUT_S)


def _network_prefix(address: str) -> str:
    """Return the network that counts as one address: with IPv6, a household or lab has 2**64 addresses."""
    try:
        ip = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(ip, ipaddress.IPv6Address):
        mapped = ip.ipv4_mapped
        return str(mapped) if mapped else str(ipaddress.ip_network((ip, 64), strict=False))
    return address
