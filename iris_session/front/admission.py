"""Answer `hello`: check identity, role and limits, and send `Welcome` once the authority has admitted the client.

Keys, secrets and tokens do not go beyond this module: the authority sees key ids and participant ids.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Final, Protocol

from iris_session.front.connection_guard import max_connections_per_key
from iris_session.front.connections import FrontConnection, Peer, Route
from iris_session.front.context import FrontContext
from iris_session.front.key_budgets import KeyBudget
from iris_session.link.sockets import peer_of
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.entries import Entry, Join
from iris_session.protocol.limits import KeyedBuckets, RateLimiter, TokenBucket, count_events, weigh_request
from iris_session.protocol.names import AuditKind, DenialReason, RefusalCode, Role
from iris_session.protocol.server_messages import Endpoints, Refused, Welcome
from iris_session.protocol.steps import Admitted
from iris_session.security import compute_fingerprint

SECRET_BYTES = 16  # 128 bits, made by the client
#: Sources of hellos that have a token bucket of their own.
MAX_SOURCES: Final = 256
#: Secret of a person behind a gateway: its SHA-256 is the web identity.
WEB_SECRET_BYTES: Final = 32
#: SHA-256 of the public key in a gateway's certificate.
CERTIFICATE_HASH_BYTES: Final = 32


class ClientChannel(Protocol):
    """A channel beside control and state, which must know a client before the client gets its `Welcome`."""

    def sync_clients(self) -> None:
        """Take over which clients are admitted."""
        ...


class _RefusedError(Exception):
    """End the handling of one hello with a refusal."""

    def __init__(self, code: str, message: str, advice: str = "") -> None:
        super().__init__(message)
        self.answer = Refused(code, message, advice)


class Admission:
    """Admit or refuse clients. `channels` learn of an admitted client before it does."""

    def __init__(self, context: FrontContext, channels: Sequence[ClientChannel]) -> None:
        self._context = context
        self._channels = channels
        limits = context.config.limits
        #: A source is a key, an address in a session without keys, or behind a gateway a secret. Each has a few hellos
        #: of its own, so that a new client is admitted during a flood of others; beyond them it uses shared ones.
        self._own_hellos = KeyedBuckets(limits.hellos_per_source, limits.hello_source_burst, MAX_SOURCES)
        self._shared_hellos = TokenBucket(limits.hellos_per_second, limits.hello_burst)
        self._rates: dict[int, RateLimiter] = {}

    def handle_hello(self, route: Route, peer: Peer, hello: Hello, now_ns: int) -> Entry | None:
        """Handle a hello. Return the entry for the authority, or `None` after a refusal, which is sent here."""
        try:
            connection, join = self._accept(route, peer, hello, now_ns)
        except _RefusedError as refused:
            self._context.drops.count(f"hello_{refused.answer.code}")
            self._context.outbox.send_to_route(route, refused.answer)
            return None
        connection.last_heard_ns = now_ns
        self._context.connections.add(connection)
        return Entry(connection.number, connection.number, now_ns, join)

    def _accept(self, route: Route, peer: Peer, hello: Hello, now_ns: int) -> tuple[FrontConnection, Join]:
        if not self._allow_hello(route, peer, hello, now_ns):
            raise _RefusedError(RefusalCode.RATE, "too many hellos at once", "try again in a second")
        gateway = self._require_gateway(route, peer, now_ns)
        key_id = self._make_key_id(peer, hello, gateway)
        web = gateway is not None and len(hello.secret) == WEB_SECRET_BYTES
        if self._context.guard.is_banned(key_id, now_ns):
            raise _RefusedError(
                RefusalCode.RATE, "this client was disconnected for flooding", "send less; try again soon"
            )
        roles, address = self._find_roles(key_id, gateway, web=web), peer_of(peer.descriptor)
        if roles is None:
            if web:  # an unknown CURVE key does not get that far
                self._context.audit.record(
                    AuditKind.KEY_REFUSED, now_ns, subject=key_id, name=hello.name, address=address[0], detail="web"
                )
            raise _RefusedError(
                RefusalCode.UNPAIRED, "this device is not paired with this session", "pair it with a join code"
            )
        budget = self._take_budget(key_id, hello, gateway, now_ns)
        resume_of = self._find_resumed(hello, key_id, address[0], now_ns)
        # A resuming client replaces a connection that may still be counted: twice the limit, so that it is bounded.
        limit = self._context.config.limits.connections
        if len(self._context.connections) >= (2 * limit if resume_of else limit):
            raise _RefusedError(RefusalCode.FULL, f"all {limit} connections are in use", "try again later")
        self._check_share(gateway.key_id if gateway else key_id, resumes=bool(resume_of))
        if web:
            self._check_share(key_id, resumes=bool(resume_of))
        number = self._context.tokens.allocate_connection()
        connection = FrontConnection(
            number, route, peer, address, key_id, hello, gateway.number if gateway else 0, budget
        )
        connection.web = web
        join = Join(
            key_id,
            hello.role,
            hello.name,
            hello.software,
            hello.devices,
            hello.capabilities,
            hello.alignment,
            resume_of,
            connection.gateway,
            roles,
        )
        return connection, join

    def _allow_hello(self, route: Route, peer: Peer, hello: Hello, now_ns: int) -> bool:
        """Return whether the hello is within the limits of its TCP connection, of its key, and of all. The
        first does not apply to a gateway's, which speaks for many participants; behind it the secret is the key."""
        if not route.on_behalf_of:
            rates = self._rates.setdefault(peer.descriptor, RateLimiter())
            if not rates.allow(Hello, now_ns):
                return False
        elif self.find_gateway(route.routing_id, peer) is not None:
            return self._take_hello(compute_fingerprint(hello.secret, b"iris-secret"), now_ns)
        return self._take_hello(peer.user_id or peer_of(peer.descriptor)[0], now_ns)

    def _take_hello(self, source: str, now_ns: int) -> bool:
        return self._own_hellos.take(source, now_ns) or self._shared_hellos.take(now_ns)

    def _take_budget(self, key_id: str, hello: Hello, gateway: FrontConnection | None, now_ns: int) -> KeyBudget:
        """Return the budget of a key, less what a hello causes. Raises `_RefusedError` when it is used up."""
        if gateway is not None:
            budget = self._context.budgets.find(key_id, now_ns, parent=gateway.budget)
        else:
            encrypted = self._context.keyring.key is not None
            is_gateway = self._context.keyring.may_be_gateway(key_id) if encrypted else hello.role == Role.GATEWAY
            budget = self._context.budgets.find(key_id, now_ns, is_gateway=is_gateway)
        reason = budget.take(now_ns, requests=weigh_request(hello), events=count_events(hello))
        if reason:
            self._context.drops.count(reason)
            raise _RefusedError(RefusalCode.RATE, "this key joins too often", "try again in some seconds")
        return budget

    def _check_share(self, key_id: str, *, resumes: bool) -> None:
        """Raise `_RefusedError` when a key has as many connections as one key may have.

        `resumes`: the connection replaces one that may still be counted, so twice as many are bounded.
        """
        share = max_connections_per_key(self._context.config.limits.connections)
        if self._context.keyring.key is not None and not self._context.keyring.may_be_gateway(key_id):
            share = min(share, self._context.config.limits.key.connections)
        if self._count_connections(key_id) >= (2 * share if resumes else share):
            advice = "close some of them, or give each device a key of its own"
            raise _RefusedError(RefusalCode.FULL, f"this key has {share} connections already", advice)
        if not resumes and self._context.tokens.count_participants(key_id) >= 2 * share:
            advice = "wait until they have expired, or resume one of them"
            raise _RefusedError(RefusalCode.FULL, f"this key has {2 * share} participants already", advice)

    def _count_connections(self, key_id: str) -> int:
        """Return the number of connections of one key, those behind it included."""
        connections = self._context.connections.by_number
        gateways = {number for number, one in connections.items() if one.key_id == key_id}
        return sum(one.gateway in gateways or one.key_id == key_id for one in connections.values())

    def remove_peer(self, descriptor: int) -> None:
        """Forget a TCP connection that was closed: its descriptor may be used again."""
        self._rates.pop(descriptor, None)

    def find_gateway(self, routing_id: bytes, peer: Peer) -> FrontConnection | None:
        """Return the admitted gateway that this peer is, or `None`."""
        gateway = self._context.connections.find(Route(routing_id), peer)
        return gateway if gateway is not None and gateway.admitted and gateway.hello.role == Role.GATEWAY else None

    def report_forged_gateway(self, route: Route, peer: Peer, now_ns: int) -> None:
        """Record that a client which is no gateway spoke on behalf of another."""
        address = peer_of(peer.descriptor)[0]
        sender = self._context.connections.find(Route(route.routing_id), peer)
        self._context.audit.record(
            AuditKind.GATEWAY_REFUSED,
            now_ns,
            subject=sender.key_id if sender is not None else peer.user_id,
            name=sender.hello.name if sender is not None else "",
            address=address,
            detail=f"on behalf of {route.on_behalf_of}",
        )

    def _require_gateway(self, route: Route, peer: Peer, now_ns: int) -> FrontConnection | None:
        """Return the gateway that speaks, `None` for a client that speaks for itself. Raises `_RefusedError`."""
        if not route.on_behalf_of:
            return None
        gateway = self.find_gateway(route.routing_id, peer)
        if gateway is None:
            self.report_forged_gateway(route, peer, now_ns)
            raise _RefusedError(
                RefusalCode.GATEWAY_ONLY,
                "only an admitted participant with role 'gateway' may speak on behalf of others",
                "leave on_behalf_of empty",
            )
        return gateway

    def _make_key_id(self, peer: Peer, hello: Hello, gateway: FrontConnection | None) -> str:
        """Return the key's fingerprint, or that of the client's secret where it has no key of its own."""
        if gateway is None and peer.user_id:
            return peer.user_id
        if len(hello.secret) < SECRET_BYTES:
            raise _RefusedError(
                RefusalCode.IDENTITY,
                f"hello has a secret of {len(hello.secret)} bytes, at least {SECRET_BYTES} are needed",
                "make 16 random bytes once, keep them, and send them in every hello",
            )
        if gateway is not None and len(hello.secret) == WEB_SECRET_BYTES:
            return compute_fingerprint(hashlib.sha256(hello.secret).digest())
        if gateway is not None and self._serves_people(gateway):
            raise _RefusedError(
                RefusalCode.IDENTITY,
                f"hello has a secret of {len(hello.secret)} bytes, behind this gateway it is {WEB_SECRET_BYTES}",
                f"make {WEB_SECRET_BYTES} random bytes once, keep them, and send them in every hello",
            )
        return compute_fingerprint((gateway.key_id.encode() if gateway else b"") + hello.secret, b"iris-secret")

    def _serves_people(self, gateway: FrontConnection) -> bool:
        """Return whether those behind a gateway need identities of their own: it is that of the session, or shows them
        a certificate to pair with."""
        if self._context.keyring.key is None:
            return False
        return bool(gateway.hello.certificate_hash) or gateway.key_id == self._context.keyring.own_gateway

    def _find_roles(self, key_id: str, gateway: FrontConnection | None, *, web: bool) -> tuple[str, ...] | None:
        """Return the roles that the key may join with, empty for any role, `None` if it is not listed (any more).
        Raises `_RefusedError`."""
        if self._context.tokens.is_revoked(key_id):
            return None
        if web:
            self._context.keyring.reload_if_changed()  # as at the handshake of a CURVE key
        roles = self._context.keyring.find_roles(key_id, gateway.key_id if gateway else "", web=web)
        if web and roles == ():
            text = "no role of this key may be taken behind this gateway"
            raise _RefusedError(DenialReason.ROLE, text, "ask the person who runs the session for another role")
        return roles

    def _find_resumed(self, hello: Hello, key_id: str, address: str, now_ns: int) -> str:
        """Return the participant that a resume token names, empty without a token. Raises `_RefusedError`."""
        if not hello.resume_token:
            return ""
        participant_id = self._context.tokens.find_participant(hello.resume_token, key_id)
        if participant_id is None:
            is_known = self._context.tokens.is_known(hello.resume_token)
            kind = AuditKind.TOKEN_MISUSED if is_known else AuditKind.TOKEN_REFUSED
            self._context.audit.record(
                kind, now_ns, subject=key_id, name=hello.name, address=address, detail=hello.role
            )
            raise _RefusedError(
                RefusalCode.RESUME_TOKEN, "this resume token is used, unknown, or of another key", "join without one"
            )
        return participant_id

    def send_welcome(self, admitted: Admitted, now_ns: int, tick_period_ns: int) -> None:
        """Send `Welcome` with a fresh resume token, unless the connection has ended. `tick_period_ns`: of the present
        scene."""
        connection = self._context.connections.by_number.get(admitted.connection)
        if connection is None:
            return
        config = self._context.config
        gateway = self._context.connections.by_number.get(connection.gateway)
        behind = gateway.key_id if gateway is not None else ""
        token = self._context.tokens.issue(
            connection.key_id, admitted.participant_id, connection.hello.resume_token, behind, web=connection.web
        )
        connection.admitted = True
        self._context.keyring.record_join(connection.key_id)
        connection.participant_id, connection.role = admitted.participant_id, admitted.role
        for channel in self._channels:
            channel.sync_clients()
        self._context.outbox.send(
            connection,
            Welcome(
                config.session_id,
                config.session_name,
                config.session_kind,
                admitted.participant_id,
                connection.number,
                admitted.role,
                token,
                admitted.resumed,
                now_ns,
                config.heartbeat_ns,
                tick_period_ns,
                config.state_period_ns,
                Endpoints(
                    self._context.ports.state,
                    self._context.ports.media,
                    self._context.ports.assets,
                    config.web_port,
                    self._context.ports.media_ingest,
                ),
                self._context.ports.key_fingerprint,
                config.task_robots,
            ),
        )

    def expire_tokens(self, participant_id: str) -> None:
        """Invalidate the tokens of a participant that has left for good."""
        self._context.tokens.remove_participant(participant_id)

    def confirm(self, connection: FrontConnection) -> None:
        """Retire the token that a client resumed with: the client has proved that it has its `Welcome`."""
        if connection.hello.resume_token:
            self._context.tokens.use_up(connection.hello.resume_token)
