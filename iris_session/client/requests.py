"""Requests of one client that wait for their replies. An `acquire` that gives up waiting is withdrawn."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import msgspec

from iris_session.client.core.connection import ClientConnection
from iris_session.client.errors import (
    ClientError,
    DeniedError,
    InvalidMessageError,
    NotConnectedError,
    RequestTimeoutError,
)
from iris_session.protocol.client_messages import Acquire, Withdraw
from iris_session.protocol.common import Denial
from iris_session.protocol.names import DenialReason, LeaseMode
from iris_session.protocol.server_messages import ProtocolFault, Reply

#: Time that a holder has to consent, where the session does not say.
CONSENT_TIMEOUT_S: Final = 15.0
#: Time to wait for the answer to a withdrawal: it takes one step.
WITHDRAW_TIMEOUT_S: Final = 1.0


class SentRequest(NamedTuple):
    """A request that was sent: its kind and number, the connection, and the last protocol fault before it."""

    kind: str
    request_id: int
    generation: int
    fault_before: ProtocolFault | None


class ClientRequests:
    """Sends requests of a client and waits for the replies.

    Args:
        connection: Its connection.
        lock: Of the connection.
        submit, answer, wait_for: Methods of the client.
    """

    def __init__(
        self,
        connection: ClientConnection,
        lock: threading.RLock,
        submit: Callable[[Any], int],
        answer: Callable[[int], Reply | None],
        wait_for: Callable[[Callable[[Any], bool], float], bool],
    ) -> None:
        self._connection = connection
        self._lock = lock
        self._submit = submit
        self._answer = answer
        self._wait_for = wait_for

    def request(self, message: Any, timeout_s: float) -> Reply:
        """Send a request and wait for its reply; see `Client.request`."""
        sent = self._send(message)
        reply = self._wait(sent, timeout_s)
        if reply is None:
            self._discard(sent)
            raise RequestTimeoutError(f"no answer to {sent.kind} within {timeout_s:g} s")
        return self._require_granted(reply)

    def acquire(self, message: Acquire, timeout_s: float) -> Reply:
        """Send an `acquire` and wait for its reply; withdraw it when none comes in time. See `Client.acquire`."""
        sent = self._send(message)
        reply = self._wait(sent, timeout_s)
        if reply is None:
            raise self._withdraw(sent, timeout_s)
        return self._require_granted(reply)

    def compute_consent_s(self, message: Acquire) -> float:
        """Return the time [s] that the holders of the wanted robots have to consent, 0 when none is asked."""
        mirror = self._connection.mirror
        wanted = message.robots or tuple(mirror.leases)
        if not any(mirror.leases[name].mode == LeaseMode.REQUEST for name in wanted if name in mirror.leases):
            return 0.0
        return mirror.consent_timeout_ns * 1e-9 or CONSENT_TIMEOUT_S

    def _withdraw(self, sent: SentRequest, timeout_s: float) -> ClientError:
        """Take back an `acquire`; return the error that says what it waited for."""
        text, denial = f"no robots or objects within {timeout_s:g} s: ", None
        try:
            answer = self._wait(self._send(Withdraw(0, sent.request_id)), WITHDRAW_TIMEOUT_S)
            reply = self._answer(sent.request_id)
        finally:
            self._discard(sent)
        if reply is not None and reply.denial is not None:
            denial = self._add_holder_name(reply.denial)
            if denial.reason != DenialReason.WITHDRAWN:
                return DeniedError(denial)  # it was decided just before
            text += DeniedError.describe(denial)
        elif answer is None:
            text += "the session does not answer; the request is withdrawn as soon as it does"
        elif answer.denial is not None:
            text += f"it cannot be withdrawn, and may be granted later: {DeniedError.describe(answer.denial)}"
        else:
            text += "they were granted too late, and given back; the request is withdrawn"
        return RequestTimeoutError(text, denial)

    def _send(self, message: Any) -> SentRequest:
        with self._lock:
            fault, request_id = self._connection.last_protocol_fault, self._submit(message)
            return SentRequest(type(message).__name__, request_id, self._connection.generation, fault)

    def _wait(self, sent: SentRequest, timeout_s: float) -> Reply | None:
        """Wait for a reply; `None`: there is none yet.

        Raises:
            InvalidMessageError: The session rejected the message.
            NotConnectedError: The connection was lost.
        """
        connection = self._connection
        replies: list[Reply] = []

        def is_lost() -> bool:
            return connection.generation != sent.generation or not connection.is_joined

        def is_over(_: object) -> bool:
            reply = self._answer(sent.request_id)
            if reply is not None:
                replies.append(reply)
            return bool(replies) or connection.last_protocol_fault is not sent.fault_before or is_lost()

        self._wait_for(is_over, timeout_s)
        if replies:
            return replies[0]
        fault = connection.last_protocol_fault
        if is_lost():
            self._discard(sent)
            raise NotConnectedError(f"connection lost while waiting for the answer to {sent.kind}")
        if fault is not None and fault is not sent.fault_before:
            self._discard(sent)
            raise InvalidMessageError(f"the session rejected {sent.kind}: {fault.message}")
        return None

    def _discard(self, sent: SentRequest) -> None:
        with self._lock:
            self._connection.requests.discard(sent.request_id)

    def _require_granted(self, reply: Reply) -> Reply:
        """Return a reply that is not a denial. Raises `DeniedError`."""
        if reply.denial is not None:
            raise DeniedError(self._add_holder_name(reply.denial))
        return reply

    def _add_holder_name(self, denial: Denial) -> Denial:
        holder = self._connection.mirror.participants.get(denial.holder)
        if holder is None or denial.holder_name:
            return denial
        return msgspec.structs.replace(denial, holder_name=holder.name)
