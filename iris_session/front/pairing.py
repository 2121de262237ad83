"""Pairing: a client with an unknown key proves that it knows a join code, and its key is put on the allow-list.

A client with a socket of its own pairs the CURVE key of this socket. A person behind a gateway pairs a web identity,
and the proofs are over the key of the gateway's certificate in place of the session's.

A code has few attempts, and so has an address. One attempt after the other goes to `FileWorker`, which changes the
files of the home of keys; the answer is sent when that is done, and nothing else waits for it.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from functools import partial
from typing import Final, NamedTuple

from iris_session.front.admission import CERTIFICATE_HASH_BYTES
from iris_session.front.connections import FrontConnection, Peer, Route
from iris_session.front.context import FrontContext
from iris_session.link.config import SECOND
from iris_session.link.sockets import peer_of
from iris_session.protocol import pairing
from iris_session.protocol.client_messages import Pair
from iris_session.protocol.limits import KeyedBuckets, TokenBucket, find_network
from iris_session.protocol.names import AuditKind, RefusalCode
from iris_session.protocol.server_messages import Paired, Refused
from iris_session.security import (
    CURVE,
    WEB,
    JoinCode,
    KeyHome,
    KeyPair,
    KeysBusyError,
    KeysError,
    compute_fingerprint,
    decode_key,
    encode_key,
)
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
#: How many addresses a gateway counts as: it limits those of the people behind it.
GATEWAY_FACTOR: Final = 8
MAX_ADDRESSES: Final = 1024
#: Codes that could not be read (no descriptor left, a network drive) are read again after so long.
RETRY_S: Final = 1.0
NO_WEB_CODE: Final = "no join code can be used behind this gateway now"
REVOKED: Final = "this key was revoked just now"
BUSY: Final = "the list of keys is busy"
TOO_MANY_WRONG: Final = "too many wrong codes from this address"


class _Source(NamedTuple):
    """Origin of attempts that is limited: a network, or a gateway, which counts as `factor` networks."""

    name: str
    address: str
    factor: int = 1


class _PendingAttempt(NamedTuple):
    """`web_key`: of the certificate of the gateway, empty for a CURVE key."""

    route: Route
    source: _Source
    key: str
    pair: Pair
    since_ns: int
    web_key: bytes = b""


class PairingService:
    """Handle `Pair` messages. A `Service`: answers are sent by `tick`."""

    def __init__(self, context: FrontContext) -> None:
        self._context = context
        self._pairs = TokenBucket(PER_SECOND, BURST)
        self._refusals = TokenBucket(PER_SECOND, BURST)
        self._pending: deque[_PendingAttempt] = deque()
        self._trying = False
        self._address_rates = KeyedBuckets(ADDRESS_PER_SECOND, ADDRESS_BURST, MAX_ADDRESSES)
        self._gateway_rates = KeyedBuckets(PER_SECOND / 2, ADDRESS_BURST, MAX_ADDRESSES)
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
        home, key = self._context.keyring.home, self._context.keyring.key
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

    def handle_pair(
        self, route: Route, peer: Peer, pair: Pair, now_ns: int, gateway: FrontConnection | None = None
    ) -> None:
        """Handle a `Pair`, of a key that is on the list or is not. `gateway`: that of a person behind one."""
        address = peer_of(peer.descriptor)[0]
        if gateway is None:
            source = _Source(find_network(address), address)
        else:
            source = _Source(f"gateway {gateway.key_id}", address, GATEWAY_FACTOR)
        rates = self._address_rates if gateway is None else self._gateway_rates
        allowed = rates.take(source.name, now_ns)
        if self._has_exhausted_attempts(source, now_ns):  # before the limits that clients share
            self._context.audit.record(AuditKind.CODE_REFUSED, now_ns, address=address, detail="too many wrong codes")
            self._context.drops.count("pair_shut_out")
            if allowed:
                self._refuse(route, TOO_MANY_WRONG, "wait ten minutes")
        elif not allowed or not self._pairs.take(now_ns) or len(self._pending) >= MAX_PENDING:
            self._context.drops.count("pair_rate")
            if self._refusals.take(now_ns):
                advice = "try again in a second"
                self._context.outbox.send_to_route(
                    route, Refused(RefusalCode.RATE, "too many pairing attempts", advice)
                )
        elif self._context.keyring.key is None:
            self._refuse(route, "this session is not encrypted: it has no keys to pair", "say hello")
        elif self._context.keyring.home is None:
            self._refuse(route, "this session takes its keys from a folder", "ask for your public key to be put there")
        elif gateway is not None:
            self._handle_web_pair(route, source, pair, now_ns, gateway)
        else:
            known = self._context.keyring.find_key(peer.user_id)
            key = parse_pairing_key(peer.user_id) if known is None else known.key
            if key:
                self._handle_known_key(_PendingAttempt(route, source, key, pair, now_ns), now_ns)
            else:
                self._refuse(route, "this key was revoked while it was connected", "connect anew")

    def _handle_web_pair(
        self, route: Route, source: _Source, pair: Pair, now_ns: int, gateway: FrontConnection
    ) -> None:
        """Handle a `Pair` of a person behind a gateway."""
        web_key = gateway.hello.certificate_hash
        if len(web_key) != CERTIFICATE_HASH_BYTES:
            self._refuse(route, "this gateway has no certificate to pair with", "pair at the session's own address")
        elif len(pair.identity) != pairing.KEY_BYTES:
            text = f"pair has an identity of {len(pair.identity)} bytes, behind a gateway it is {pairing.KEY_BYTES}"
            self._refuse(route, text, "send the SHA-256 of the secret of your hello")
        else:
            key = encode_key(pair.identity)
            self._handle_known_key(_PendingAttempt(route, source, key, pair, now_ns, web_key), now_ns)

    def _handle_known_key(self, attempt: _PendingAttempt, now_ns: int) -> None:
        """Answer an attempt whose key is known, or put it in the queue."""
        route, mark = attempt.route, compute_fingerprint(decode_key(attempt.key))
        entry = self._context.keyring.find_entry(mark)
        if mark in self._context.keyring.pending_revocations:
            self._refuse(route, REVOKED, "ask for another join code")
        elif entry is not None and entry.kind != (WEB if attempt.web_key else CURVE):
            self._refuse(route, f"this key is on the list as one of kind {entry.kind}", "make a new one")
        elif (earlier := self._find_earlier_answer(attempt)) is not None:
            self._context.outbox.send_to_route(route, earlier)
        elif self._trying or self._has_open_code_for(attempt.web_key):
            self._pending.append(attempt)  # the attempt that runs may be of the same key, and has used its code
        else:
            self._refuse_without_code(attempt, now_ns)

    def _refuse_without_code(self, attempt: _PendingAttempt, now_ns: int) -> None:
        mark = compute_fingerprint(decode_key(attempt.key))
        self._context.audit.record(
            AuditKind.CODE_REFUSED, now_ns, subject=mark, name=attempt.pair.name, address=attempt.source.address
        )
        text = NO_WEB_CODE if attempt.web_key and self.has_open_code else "no join code can be used now"
        self._refuse(attempt.route, text, "run `iris-session pair` where the session runs")

    def _has_open_code_for(self, web_key: bytes) -> bool:
        now_s = time.time()
        return any(code.is_open(now_s) and code.find_secret(web_key) for code in self._list_codes())

    def _find_earlier_answer(self, attempt: _PendingAttempt) -> Paired | None:
        """Return the answer to an attempt that succeeded and is repeated, because the first answer was lost or late.

        The file of codes keeps it, so a front that was restarted since gives the same answer. `None` for another
        attempt, and for a key that has been taken off the list since.
        """
        entry = self._context.keyring.find_entry(compute_fingerprint(decode_key(attempt.key)))
        for code in self._list_codes() if entry is not None else ():
            paired = code.paired is not None and code.paired.key == attempt.key
            if entry is not None and paired and pairing.is_same_proof(code.proof, attempt.pair.proof):
                return Paired(code.answer, entry.roles)
        return None

    def tick(self, now_ns: int) -> None:
        """Start the next attempt when the one before is done."""
        pending, self._pending = self._pending, deque()
        for one in pending:
            self._recheck_pending(one, now_ns)
        if self._trying or not self._pending or self._context.keyring.is_missing:  # a new list would have no other key
            return
        home, key = self._context.keyring.home, self._context.keyring.key
        assert home is not None
        assert key is not None
        first = self._pending[0]
        if not self._has_open_code_for(first.web_key):
            self._pending.popleft()
            self._refuse_without_code(first, now_ns)
            return
        self._trying = self._context.keyring.files.submit(
            partial(_run_attempt, home, key, first), partial(self._on_attempt_done, first)
        )
        if self._trying:
            self._pending.popleft()

    def _recheck_pending(self, one: _PendingAttempt, now_ns: int) -> None:
        """Keep an attempt pending, or end it because of what happened since it came."""
        if now_ns - one.since_ns > PATIENCE_NS:
            self._refuse_busy(one.route)
        elif compute_fingerprint(decode_key(one.key)) in self._context.keyring.pending_revocations:
            self._refuse(one.route, REVOKED, "ask for another join code")
        elif self._has_exhausted_attempts(one.source, now_ns):
            self._refuse(one.route, TOO_MANY_WRONG, "wait ten minutes")
        elif (earlier := self._find_earlier_answer(one)) is not None:
            self._context.outbox.send_to_route(one.route, earlier)  # another process of this user has paired meanwhile
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

    def _answer(self, pending: _PendingAttempt, attempt: RedeemResult, now_ns: int) -> None:
        mark = compute_fingerprint(decode_key(pending.key))
        entry = attempt.entry
        if entry is not None:
            self._wrong.pop(pending.source.name, None)
            revoked = mark in self._context.keyring.pending_revocations  # since it asked: the later word counts
            if revoked or not self._context.keyring.confirm_pairing(mark):
                self._refuse(pending.route, REVOKED, "ask for another join code")
                return
            roles = ", ".join(entry.roles) or "any role"
            self._context.audit.record(
                AuditKind.PAIRED, now_ns, subject=mark, name=entry.name, address=pending.source.address, detail=roles
            )
            self._context.outbox.send_to_route(pending.route, Paired(attempt.answer, entry.roles))
            return
        self._count_wrong(pending.source, now_ns)
        kind = AuditKind.CODE_EXHAUSTED if attempt.exhausted else AuditKind.CODE_REFUSED
        self._context.audit.record(kind, now_ns, subject=mark, name=pending.pair.name, address=pending.source.address)
        advice = "run `iris-session pair` again" if not attempt.open_codes else "check the code"
        self._refuse(pending.route, "this join code is wrong, used or expired", advice)

    def _refuse_busy(self, route: Route) -> None:
        """Refuse without an attempt: the client may try again, and no attempt of the code is used."""
        self._context.drops.count("pair_busy")
        self._context.outbox.send_to_route(route, Refused(RefusalCode.RATE, BUSY, "try again"))

    def _refuse(self, route: Route, message: str, advice: str) -> None:
        self._context.drops.count("pair_refused")
        self._context.outbox.send_to_route(route, Refused(RefusalCode.CODE, message, advice))

    def _has_exhausted_attempts(self, source: _Source, now_ns: int) -> bool:
        wrong, since_ns = self._wrong.get(source.name, (0, now_ns))
        return wrong >= ADDRESS_ATTEMPTS * source.factor and now_ns - since_ns < WINDOW_NS

    def _count_wrong(self, source: _Source, now_ns: int) -> None:
        wrong, since_ns = self._wrong.pop(source.name, (0, now_ns))
        if now_ns - since_ns >= WINDOW_NS:
            wrong, since_ns = 0, now_ns
        while len(self._wrong) >= MAX_ADDRESSES:
            del self._wrong[next(iter(self._wrong))]
        self._wrong[source.name] = (wrong + 1, since_ns)


def _run_attempt(home: KeyHome, key: KeyPair, pending: _PendingAttempt) -> RedeemResult:
    pair = pending.pair
    name = "".join(c for c in pair.name if c.isprintable()).strip() or "unnamed"
    return home.join_codes.redeem(
        key.raw_public, pending.key, pair.proof, name, home.clients, LOCK_TIMEOUT_S, pending.web_key
    )
