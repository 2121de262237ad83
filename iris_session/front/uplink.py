"""From the front to the authority: entries within their credit, signs of life, counters. Never waits."""

from __future__ import annotations

import zmq

from iris_session.front.coalescer import Coalescer
from iris_session.front.connections import ConnectionTable
from iris_session.front.downlink import Downlink
from iris_session.front.state_publisher import StatePublisher
from iris_session.link import messages as link
from iris_session.link.config import MILLISECOND
from iris_session.protocol.entries import Entry, encode_entries
from iris_session.protocol.limits import Drops
from iris_session.security.resume_tokens import ResumeTokens

STATUS_NS = 500 * MILLISECOND


class Uplink:
    """`stalled`: the authority does not step; `stalls`: how often that was so."""

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        unacknowledged: int,
        coalescer: Coalescer,
        downlink: Downlink,
        tokens: ResumeTokens,
        clients: ConnectionTable,
        drops: Drops,
        publisher: StatePublisher,
    ) -> None:
        self._socket = socket
        self._unacknowledged = unacknowledged
        self._coalescer = coalescer
        self._downlink = downlink
        self._tokens = tokens
        self._clients = clients
        self._drops = drops
        self._publisher = publisher
        self.stalled = False
        self.stalls = 0
        self.entries = 0
        self._batches = 0
        self._reported = (-1, -1, -1)
        self._next_beat_ns = self._next_status_ns = 0

    def flush(self) -> None:
        """Sends what waits, as far as credit goes; urgent entries have credits of their own."""
        limit = self._unacknowledged
        used = self._batches - self._downlink.acknowledged
        batch: list[Entry] = []
        if used < limit:
            batch = self._coalescer.take_batch() if self._coalescer else []
        elif self._coalescer.urgent and used < 2 * limit:
            batch = self._coalescer.take_batch(urgent_only=True)
        if self._tokens.changed and (batch or self._is_authority_listening):
            self._socket.send_multipart((link.HANDBACK, self._tokens.encode()), zmq.DONTWAIT)
        if batch:
            self._socket.send_multipart((link.ENTRIES, encode_entries(batch)), zmq.DONTWAIT)
            self._batches += 1
            self.entries += len(batch)

    def tick(self, now_ns: int) -> None:
        """Says that the front lives, and what it counted."""
        if now_ns >= self._next_beat_ns and self._is_authority_listening:
            self._next_beat_ns = now_ns + link.BEAT_NS
            self._socket.send_multipart((link.BEAT, b""), zmq.DONTWAIT)
        if now_ns >= self._next_status_ns:
            self._next_status_ns = now_ns + STATUS_NS
            self._report()

    @property
    def _is_authority_listening(self) -> bool:
        """Whether the authority takes what is sent, as far as we know."""
        return self._downlink.heard_ns > 0 and not self.stalled

    def _report(self) -> None:
        """Counters to the authority, while it listens."""
        drops = self._drops
        now = (drops.version, len(self._clients), self.entries)
        if now == self._reported or self.stalled:
            return
        self._reported = now
        status = link.FrontStatus(
            len(self._clients),
            drops.by_reason,
            drops.by_connection,
            self.stalls,
            self._publisher.frames,
            self.entries,
        )
        self._socket.send_multipart((link.STATUS, link.encoder.encode(status)), zmq.DONTWAIT)
