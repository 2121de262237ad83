"""Raw samples and observations of clients, on their way to the recorder: in batches, bounded in bytes.

They are recorded beside the journal, which holds what the authority used of them, so they are the first that is left
out: above the share of a key, above what all keys may have together, and while the recorder does not read. What is left
out is counted (`Drops`) and logged. Observers drive nothing: `PresenceLimiter` leaves of their samples what others see.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Final

import msgspec
import zmq

from iris_session.front.connections import FrontConnection
from iris_session.protocol.client_messages import Observation, Sample
from iris_session.protocol.limits import Drops, KeyedBuckets, TokenBucket
from iris_session.protocol.names import Role, SampleKind
from iris_session.protocol.status import ClientReport

log = logging.getLogger(__name__)

#: Bytes per second of one key. Both hands with all joints at 90 Hz, head and controllers are about 0.4 MB/s.
KEY_BYTES_PER_S: Final = 1 << 20
#: Bytes per second of the observers of one key: the presence that counts, and observations of sheets.
OBSERVER_BYTES_PER_S: Final = 256 << 10
#: Bytes per second of all keys together: a disk that takes these has room for the journal.
TOTAL_BYTES_PER_S: Final = 8 << 20
#: Seconds of either that may come at once.
BURST_S: Final = 2
#: A batch is sent when it has this many bytes, or at the next tick.
BATCH_BYTES: Final = 64 << 10
#: Batches in transit. At 100 a second, five seconds in which the recorder may hang; at most 32 MiB.
BATCHES_IN_TRANSIT: Final = 512
MAX_KEYS: Final = 256
LOG_PERIOD_NS: Final = 10_000_000_000
#: Drop reasons: above the share of the key, above that of all, and batches that the recorder did not take.
KEY_SHARE: Final = "raw_key_share"
TOTAL_SHARE: Final = "raw_total_share"
NOT_READ: Final = "recorder_queue_full"

#: Samples per second of one device of an observer: more than displays show of it.
PRESENCE_HZ: Final = 60
#: Devices of one observer: head, controllers, hands.
PRESENCE_DEVICES: Final = 8
#: Bytes per second of the samples of observers with one key: five devices at `PRESENCE_HZ` need half of it.
PRESENCE_BYTES_PER_S: Final = 128 << 10
#: Bytes per second of requests of observers with one key: they are in the journal.
REQUEST_BYTES_PER_S: Final = 32 << 10
#: Bytes of an encoded pose sample without its names.
_POSE_BYTES: Final = 200
PRESENCE_SHARE: Final = "presence_share"
REQUEST_SHARE: Final = "observer_request_share"

_encode = msgspec.msgpack.Encoder().encode


class RawFeed:
    """Forward samples and observations to the recorder: batches of `[connection, receive_ns, message bytes]`.

    A report on the delivery of states comes as `[participant, report]` in place of a message.
    Never blocks. Without an endpoint, or while `is_recorded` says no, nothing is forwarded. Messages are encoded again,
    not forwarded as received: so the recording holds nothing that the schema does not have, however large or deep a
    client made it. A `Service`.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint: str,
        drops: Drops,
        is_recorded: Callable[[], bool] = lambda: True,
    ) -> None:
        self._drops = drops
        self._is_recorded = is_recorded
        self._shares = KeyedBuckets(KEY_BYTES_PER_S, BURST_S * KEY_BYTES_PER_S, MAX_KEYS)
        self._observer_shares = KeyedBuckets(OBSERVER_BYTES_PER_S, BURST_S * OBSERVER_BYTES_PER_S, MAX_KEYS)
        self._total = TokenBucket(TOTAL_BYTES_PER_S, BURST_S * TOTAL_BYTES_PER_S)
        self._batch: list[tuple[int, int, bytes]] = []
        self._batch_bytes = 0
        self._left_out: dict[str, int] = {}  # since the last line of the log, by reason
        self._worst = ""  # name of the connection that was left out last
        self._next_log_ns = 0
        self._socket = context.socket(zmq.PUSH) if endpoint else None
        if self._socket is not None:
            self._socket.setsockopt(zmq.SNDHWM, BATCHES_IN_TRANSIT)
            self._socket.setsockopt(zmq.LINGER, 200)
            self._socket.connect(endpoint)

    def send(self, connection: FrontConnection, receive_ns: int, message: Sample | Observation) -> None:
        """Forward one message, unless it is above a share."""
        if self._socket is not None:
            self._send(connection, receive_ns, _encode(message))

    def send_report(self, connection: FrontConnection, receive_ns: int, report: ClientReport) -> None:
        """Forward the report of a participant, unless it is above a share."""
        if self._socket is not None and connection.participant_id:
            self._send(connection, receive_ns, _encode((connection.participant_id, report)))

    def _send(self, connection: FrontConnection, receive_ns: int, data: bytes) -> None:
        if not self._is_recorded():
            return
        shares = self._observer_shares if connection.role == Role.OBSERVER else self._shares
        if not shares.take(connection.key_id, receive_ns, len(data)):
            self._leave_out(KEY_SHARE, connection, 1)
        elif not self._total.take(receive_ns, len(data)):
            self._leave_out(TOTAL_SHARE, connection, 1)
        else:
            self._batch.append((connection.number, receive_ns, data))
            self._batch_bytes += len(data)
            if self._batch_bytes >= BATCH_BYTES:
                self._flush()

    def tick(self, now_ns: int) -> None:
        """Send what has come since the last batch; log what was left out."""
        self._flush()
        if self._left_out and now_ns >= self._next_log_ns:
            self._next_log_ns = now_ns + LOG_PERIOD_NS
            counts = ", ".join(f"{reason} {n}" for reason, n in self._left_out.items())
            whose = f", the last of {self._worst!r}" if self._worst else ""
            log.warning("raw samples are missing in the recording, the journal is whole: %s%s", counts, whose)
            self._left_out, self._worst = {}, ""

    def close(self) -> None:
        """Send the rest; it leaves within the linger time of the socket."""
        self._flush()

    def _flush(self) -> None:
        batch, self._batch, self._batch_bytes = self._batch, [], 0
        if not batch or self._socket is None:
            return
        try:
            self._socket.send(_encode(batch), zmq.DONTWAIT)
        except zmq.Again:
            self._leave_out(NOT_READ, None, len(batch))

    def _leave_out(self, reason: str, connection: FrontConnection | None, n: int) -> None:
        self._drops.count(reason, 0 if connection is None else connection.number, n)
        self._left_out[reason] = self._left_out.get(reason, 0) + n
        if connection is not None:
            self._worst = connection.hello.name


class PresenceLimiter:
    """Limit what observers add to the journal: poses of few devices at the rate of displays, and few requests."""

    def __init__(self, drops: Drops) -> None:
        self._drops = drops
        self._shares = KeyedBuckets(PRESENCE_BYTES_PER_S, BURST_S * PRESENCE_BYTES_PER_S, MAX_KEYS)
        self._request_shares = KeyedBuckets(REQUEST_BYTES_PER_S, BURST_S * REQUEST_BYTES_PER_S, MAX_KEYS)

    def take_request(self, connection: FrontConnection, n_bytes: int, now_ns: int) -> str:
        """Take the bytes of a request of an observer. Return the drop reason above the share, else an empty string."""
        return "" if self._request_shares.take(connection.key_id, now_ns, n_bytes) else REQUEST_SHARE

    def limit(self, connection: FrontConnection, sample: Sample, now_ns: int) -> Sample | None:
        """Return the sample without what only a driver needs, or `None` when it is too early for another one.

        One that says that the headset was put on or taken off always passes.
        """
        due = connection.presence_due_ns
        edge = sample.worn is not connection.presence_worn
        if not edge and now_ns < due.get(sample.device, 0):
            return None
        n = _POSE_BYTES + 4 * (len(sample.device) + len(sample.kind))
        n += sum(8 * len(target.name) for target in sample.targets)
        full = sample.device not in due and len(due) >= PRESENCE_DEVICES
        if full or not self._shares.take(connection.key_id, now_ns, n):
            self._drops.count(PRESENCE_SHARE, connection.number)
            return None
        # A sample that is a little late does not delay those after it.
        period_ns = 1_000_000_000 // PRESENCE_HZ
        due[sample.device] = max(due.get(sample.device, 0), now_ns - period_ns // 2) + period_ns
        connection.presence_worn = sample.worn
        if not (sample.hand_joints or sample.q or sample.qd or sample.buttons):
            return sample
        q = sample.q if sample.kind == SampleKind.JOINTS else ()  # the authority rejects it, and says why
        return msgspec.structs.replace(sample, hand_joints=(), q=q[:1], qd=(), buttons=0)
