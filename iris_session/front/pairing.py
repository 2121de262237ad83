"""Pairing: an unknown key shows that it knows a join code, and is put on the allow-list.

A code has few attempts, and so has an address. One attempt after the other goes to `FileWorker`, which changes the
files of the home of keys; the answer is sent when that is done, and nothing else waits for it.
"""

from __future__ import annotations

import ipaddress
import sys
import time
from collections import deque
from functools import partial
from typing import Final, NamedTuple

from iris_session.front.audit import AuditTrail
from iris_session.front.connections import Outbox, Peer, Route
from iris_session.link.config import SECOND
from iris_session.link.sockets import peer_of
from iris_session.protocol import pairing
from iris_session.protocol.client_messages import Pair
from iris_session.protocol.limits import Drops, TokenBucket
from iris_session.protocol.names import AuditKind, RefusalCode
from iris_session.protocol.server_messages import Paired, Refused
from iris_session.security import JoinCode, KeyHome, KeyPair, KeysBusyError, KeysError, fingerprint, raw_key
from iris_session.security.file_worker import PATIENCE_S
from iris_session.security.join_codes import Attempt
from iris_session.security.keyring import Keyring, stranger_key

#: Of everybody together.
PER_SECOND: Final = 10.0
BURST: Final = 16
#: Of one address, before it counts against everybody.
ADDRESS_PER_SECOND: Final = 2.0
ADDRESS_BURST: Final = 12
#: How long an attempt may wait for its turn, and how many may: a client waits 5 s for the answer.
PATIENCE_NS: Final = 2 * SECOND
MAX_PENDING: Final = 32
#: Who paired last, and may ask again what was answered.
MAX_RECENTLY_PAIRED: Final = 32
#: Wrong codes of one address within `WINDOW_NS`: as many as two codes have.
ADDRESS_ATTEMPTS: Final = 10
WINDOW_NS: Final = 600 * SECOND
MAX_ADDRESSES: Final = 1024
#: Codes that could not be read (no descriptor left, a network drive) are read again after so long.
RETRY_S: Final = 1.0
REVOKED: Final = "this key was revoked just now"
BUSY: Final = "the list of keys is busy"
SHUT_OUT: Final = "too many wrong codes from this address"


class _PendingAttempt(NamedTuple):
    route: Route
    address: str
    key: str
    pair: Pair
    since_ns: int


class PairingService:
    """A `Service`. `take` gets every `Pair`; answers are sent in `turn`."""

    def __init__(self, keyring: Keyring, outbox: Outbox, audit: AuditTrail, drops: Drops) -> None:
        self._keyring = keyring
        self._outbox = outbox
        self._audit = audit
        self._drops = drops
        self._pairs = TokenBucket(PER_SECOND, BURST)
        self._complaints = TokenBucket(PER_SECOND, BURST)
        self._pending: deque[_PendingAttempt] = deque()
        self._trying = False
        self._recently_paired: dict[
            str, tuple[bytes, Paired]
        ] = {}  # who has paired lately: proof and answer, by fingerprint
        self._rates: dict[str, TokenBucket] = {}
        self._wrong: dict[str, tuple[int, int]] = {}  # network -> wrong attempts, since when [ns]
        self._signature: object = None
        self._unread, self._again_s = "", 0.0  # why the codes could not be read, and when they are read again
        self._codes: tuple[JoinCode, ...] = ()

    @property
    def has_open_code(self) -> bool:
        """Whether a join code can be used now."""
        home, key = self._keyring.home, self._keyring.key
        if home is None or key is None:
            return False
        signature = home.codes.signature
        if signature != self._signature or (self._unread and time.monotonic() >= self._again_s):
            self._signature = signature
            self._read_codes(home, key)
        now_s = time.time()
        return any(code.open(now_s) for code in self._codes)

    def _read_codes(self, home: KeyHome, key: KeyPair) -> None:
        """What cannot be read now is read again a second later, and complained about once."""
        try:
            self._codes, unread = home.codes.of(key.fingerprint), ""
        except KeysError as error:
            self._codes, unread = (), str(error)
            self._again_s = time.monotonic() + RETRY_S
            if unread != self._unread:
                self._log_error(error)
        self._unread = unread

    def handle_pair(self, route: Route, peer: Peer, pair: Pair, now_ns: int) -> None:
        """One `Pair` of a key that is on the list, or is not."""
        address = peer_of(peer.descriptor)[0]
        key = stranger_key(peer.user_id)
        known = self._keyring.find(peer.user_id)
        if known is not None:
            key = known.key
        taken = self._allow_address(address, now_ns)
        if self._has_exhausted_attempts(address, now_ns):  # before all that others have a share in
            self._audit.record(AuditKind.CODE_REFUSED, now_ns, address=address, detail="too many wrong codes")
            self._drops.count("pair_shut_out")
            if taken:
                self._refuse(route, SHUT_OUT, "wait ten minutes")
        elif not taken or not self._pairs.take(now_ns) or len(self._pending) >= MAX_PENDING:
            self._drops.count("pair_rate")
            if self._complaints.take(now_ns):
                advice = "try again in a second"
                self._outbox.send_to_route(route, Refused(RefusalCode.RATE, "many pair at once", advice))
        elif self._keyring.key is None:
            self._refuse(route, "this session is not encrypted: nobody pairs with it", "say hello")
        elif not key:
            self._refuse(route, "this key was revoked while it was connected", "connect anew")
        elif route.on_behalf_of:
            self._refuse(route, "a key pairs for itself", "leave on_behalf_of empty")
        elif self._keyring.home is None:
            self._refuse(route, "this session takes its keys from a folder", "ask for your public key to be put there")
        elif fingerprint(raw_key(key)) in self._keyring.revoking:
            self._refuse(route, REVOKED, "ask for another join code")
        elif (again := self._find_earlier_answer(key, pair)) is not None:
            self._outbox.send_to_route(route, again)
        elif not self.has_open_code:
            mark = fingerprint(raw_key(key))
            self._audit.record(AuditKind.CODE_REFUSED, now_ns, subject=mark, name=pair.name, address=address)
            self._refuse(route, "no join code can be used now", "run `iris-session pair` where the session runs")
        else:
            self._pending.append(_PendingAttempt(route, address, key, pair, now_ns))

    def _find_earlier_answer(self, key: str, pair: Pair) -> Paired | None:
        """The answer to an attempt that succeeded, where it is made again: the first may have been lost, or too late.
        `None` where it is another one, and for a key that is off the list by now."""
        mark = fingerprint(raw_key(key))
        proof, answer = self._recently_paired.get(mark, (b"", None))
        return answer if pairing.is_same_proof(proof, pair.proof) and self._keyring.find(mark) is not None else None

    def tick(self, now_ns: int) -> None:
        """Begins the next attempt when the one before is done."""
        waiting, self._pending = self._pending, deque()
        for one in waiting:
            self._recheck_pending(one, now_ns)
        if self._trying or not self._pending:
            return
        home, key = self._keyring.home, self._keyring.key
        assert home is not None
        assert key is not None
        first = self._pending[0]
        self._trying = self._keyring.files.submit(
            partial(_run_attempt, home, key, first), partial(self._on_attempt_done, first, key)
        )
        if self._trying:
            self._pending.popleft()

    def _recheck_pending(self, one: _PendingAttempt, now_ns: int) -> None:
        """Lets an attempt wait on, or ends it: much may have happened since it came."""
        if now_ns - one.since_ns > PATIENCE_NS:
            self._refuse_busy(one.route)
        elif fingerprint(raw_key(one.key)) in self._keyring.revoking:
            self._refuse(one.route, REVOKED, "ask for another join code")
        elif self._has_exhausted_attempts(one.address, now_ns):
            self._refuse(one.route, SHUT_OUT, "wait ten minutes")
        else:
            self._pending.append(one)

    def _on_attempt_done(
        self, waiting: _PendingAttempt, key: KeyPair, outcome: Attempt | KeysError, now_ns: int
    ) -> None:
        self._trying = False
        if isinstance(outcome, Attempt):
            self._answer(waiting, outcome, key, now_ns)
        elif isinstance(outcome, KeysBusyError):
            self._refuse_busy(waiting.route)
        else:
            self._log_error(outcome)
            advice = "whoever runs the session finds more at its terminal"
            self._refuse(waiting.route, "the session cannot change its list of keys", advice)

    def close(self) -> None:
        """Nothing was opened."""

    def _answer(self, waiting: _PendingAttempt, attempt: Attempt, key: KeyPair, now_ns: int) -> None:
        client = raw_key(waiting.key)
        mark = fingerprint(client)
        entry = attempt.entry
        if entry is not None:
            self._wrong.pop(_network_prefix(waiting.address), None)
            revoked = mark in self._keyring.revoking  # since it asked: the later word counts
            if revoked or not self._keyring.paired(mark):
                self._refuse(waiting.route, REVOKED, "ask for another join code")
                return
            roles = ", ".join(entry.roles) or "any role"
            self._audit.record(
                AuditKind.PAIRED, now_ns, subject=mark, name=entry.name, address=waiting.address, detail=roles
            )
            paired = Paired(pairing.make_server_proof(attempt.secret, key.raw_public, client), entry.roles)
            self._recently_paired.pop(mark, None)
            while len(self._recently_paired) >= MAX_RECENTLY_PAIRED:
                del self._recently_paired[next(iter(self._recently_paired))]
            self._recently_paired[mark] = waiting.pair.proof, paired
            self._outbox.send_to_route(waiting.route, paired)
            return
        self._count_wrong(waiting.address, now_ns)
        kind = AuditKind.CODE_EXHAUSTED if attempt.exhausted else AuditKind.CODE_REFUSED
        self._audit.record(kind, now_ns, subject=mark, name=waiting.pair.name, address=waiting.address)
        advice = "run `iris-session pair` anew" if not attempt.open_codes else "look at the code again"
        self._refuse(waiting.route, "this join code is wrong, used or expired", advice)

    def _refuse_busy(self, route: Route) -> None:
        """Nothing was tried: the same may be asked again, and no attempt is lost."""
        self._drops.count("pair_busy")
        self._outbox.send_to_route(route, Refused(RefusalCode.RATE, BUSY, "try again"))

    def _refuse(self, route: Route, message: str, advice: str) -> None:
        self._drops.count("pair_refused")
        self._outbox.send_to_route(route, Refused(RefusalCode.CODE, message, advice))

    def _allow_address(self, address: str, now_ns: int) -> bool:
        """Whether this address may ask now."""
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

    @staticmethod
    def _log_error(error: KeysError) -> None:
        print(f"iris-session: pairing does not work: {error}", file=sys.stderr, flush=True)


def _run_attempt(home: KeyHome, key: KeyPair, waiting: _PendingAttempt) -> Attempt:
    pair = waiting.pair
    name = "".join(c for c in pair.name if c.isprintable()).strip() or "unnamed"
    return home.codes.attempt(key.raw_public, waiting.key, pair.proof, name, home.clients, PATIENCE_S)


def _network_prefix(address: str) -> str:
    """What counts as one address: with IPv6, a household or lab has 2**64 of them."""
    try:
        ip = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(ip, ipaddress.IPv6Address):
        mapped = ip.ipv4_mapped
        return str(mapped) if mapped else str(ipaddress.ip_network((ip, 64), strict=False))
    return address
