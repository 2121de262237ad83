"""Requests that wait for an answer, answers that wait to be fetched, and the leases that answers granted. Bounded."""

from __future__ import annotations

from iris_session.client.core.limits import MAX_GRANTED, MAX_PENDING
from iris_session.client.core.status import ConnectionCounters
from iris_session.protocol.common import Lease
from iris_session.protocol.server_messages import Reply


class PendingRequests:
    """Of one connection; `clear` for the next one. Request numbers go on."""

    def __init__(self, counters: ConnectionCounters) -> None:
        self._counters = counters
        self._pending: set[int] = set()
        self._replies: dict[int, Reply] = {}
        self._granted: dict[str, Lease] = {}
        self.next_request = 1

    def clear(self) -> None:
        """Nobody will answer what was asked on another connection."""
        self._granted.clear()
        self._pending.clear()
        self._replies.clear()

    def add_pending(self) -> None:
        """The request `next_request` was sent. Of too many the oldest is no longer waited for."""
        if len(self._pending) >= MAX_PENDING:
            self._pending.discard(min(self._pending))
        self._pending.add(self.next_request)
        self.next_request += 1

    def pop_reply(self, request_id: int) -> Reply | None:
        """The answer to a request, once."""
        return self._replies.pop(request_id, None)

    def discard(self, request_id: int) -> None:
        """Nobody waits for this answer any more."""
        self._pending.discard(request_id)
        self._replies.pop(request_id, None)

    def process_reply(self, reply: Reply) -> bool:
        """Takes an answer. False: a denial that nobody waits for, which is to be told another way."""
        self._granted.update((lease.target, lease) for lease in reply.leases)
        while len(self._granted) > MAX_GRANTED:
            del self._granted[next(iter(self._granted))]
        if reply.request_id in self._pending:
            self._pending.discard(reply.request_id)
            while len(self._replies) >= MAX_PENDING:
                del self._replies[next(iter(self._replies))]
                self._counters.inbox_dropped += 1
            self._replies[reply.request_id] = reply
            return True
        if reply.request_id:
            self._counters.unexpected_replies += 1
            return True
        return reply.denial is None

    def granted_lease(self, target: str) -> Lease | None:
        """The lease of the newest answer that spoke of `target`: it may be ahead of the event."""
        return self._granted.get(target)
