"""From the front to the authority: entries within their credit, heartbeats of the front, counters. Never waits."""

from __future__ import annotations

from typing import Final

import zmq

from iris_session.front.context import FrontContext
from iris_session.link import messages as link
from iris_session.link.config import MILLISECOND
from iris_session.protocol.entries import Entry, encode_entries

STATUS_NS: Final = 500 * MILLISECOND


class Uplink:
    """Send pending entries over the link."""

    def __init__(self, context: FrontContext, socket: zmq.Socket[bytes]) -> None:
        self._context = context
        self._socket = socket
        self._max_unacknowledged = context.config.limits.unacknowledged
        self._batches = 0
        self._reported = (-1, -1, -1)
        self._next_beat_ns = self._next_status_ns = 0

    def flush(self) -> None:
        """Send pending entries as far as credit goes. Urgent entries have credits of their own."""
        limit = self._max_unacknowledged
        used = self._batches - self._context.authority.acknowledged
        batch: list[Entry] = []
        if used < limit:
            batch = self._context.coalescer.take_batch() if self._context.coalescer else []
        elif self._context.coalescer.urgent and used < 2 * limit:
            batch = self._context.coalescer.take_batch(urgent_only=True)
        if self._context.tokens.changed and (batch or self._is_authority_listening):
            state = link.TokenState(self._context.authority.step, self._context.tokens.encode())
            self._socket.send_multipart((link.HANDBACK, link.encoder.encode(state)), zmq.DONTWAIT)
        if batch:
            self._socket.send_multipart((link.ENTRIES, encode_entries(batch)), zmq.DONTWAIT)
            self._batches += 1
            self._context.authority.entries += len(batch)

    def tick(self, now_ns: int) -> None:
        """Send the front's heartbeat and its counters when they are due."""
        if now_ns >= self._next_beat_ns and self._is_authority_listening:
            self._next_beat_ns = now_ns + link.BEAT_NS
            self._socket.send_multipart((link.BEAT, b""), zmq.DONTWAIT)
        if now_ns >= self._next_status_ns:
            self._next_status_ns = now_ns + STATUS_NS
            self._report()

    @property
    def _is_authority_listening(self) -> bool:
        """True if the authority reads the link, as far as the front knows."""
        return self._context.authority.heard_ns > 0 and not self._context.authority.stalled

    def _report(self) -> None:
        """Send the counters if they have changed and the authority is not stalled."""
        drops, authority = self._context.drops, self._context.authority
        now = (drops.version, len(self._context.connections), authority.entries)
        if now == self._reported or authority.stalled:
            return
        self._reported = now
        status = link.FrontStatus(
            len(self._context.connections),
            drops.by_reason,
            drops.by_connection,
            authority.stalls,
            self._context.publisher.frames,
            authority.entries,
        )
        self._socket.send_multipart((link.STATUS, link.encoder.encode(status)), zmq.DONTWAIT)
