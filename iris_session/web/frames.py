"""Frames of a WebSocket, counted from its bytes before aiohttp reads them. Pure.

aiohttp answers pings and joins fragments by itself: what never becomes a message, like empty fragments, would cost time
that is counted nowhere.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from iris_session.protocol.limits import TokenBucket

#: Frames that are whole messages, somewhat more than `HubLimits` lets a browser send: the hub says why.
MESSAGES_PER_S, MESSAGE_BURST = 2000.0, 4000
#: All others: pings, pongs, closes, fragments. A browser answers a ping in 15 s, and sends small messages whole.
EXTRA_PER_S, EXTRA_BURST = 10.0, 40
#: The same of all connections of a network whose browsers have not joined.
NETWORK_EXTRA_PER_S, NETWORK_EXTRA_BURST = 50.0, 400

# A frame (RFC 6455, section 5.2): mark of the last one and opcode, mark of a mask and length, long length, mask.
_FINAL_AND_OPCODE: Final = 0x8F
_WHOLE: Final = (0x81, 0x82)
_MASKED: Final = 0x80
_LENGTH: Final = 0x7F
_LONG: Final = {126: 2, 127: 8}
_MASK_BYTES: Final = 4


class FrameMeter:
    """Counts and limits the frames of one WebSocket.

    Args:
        take_extra: Returns whether one more frame that is no whole message may come, besides the limit of this
            connection.
        now_ns: Time at which it begins.
    """

    def __init__(self, take_extra: Callable[[int], bool], now_ns: int) -> None:
        self._take_extra = take_extra
        self._messages = TokenBucket(MESSAGES_PER_S, MESSAGE_BURST, now_ns)
        self._extra = TokenBucket(EXTRA_PER_S, EXTRA_BURST, now_ns)
        self._head = b""  # of a frame, as far as it has come
        self._payload = 0  # bytes that are to come of a frame

    def feed(self, data: bytes, now_ns: int) -> bool:
        """Count the frames that begin in `data`. Return false at the first one above a limit."""
        if self._head:
            data, self._head = self._head + data, b""
        at, end = self._payload, len(data)
        while at < end:
            size = _find_head_size(data, at)
            if at + size > end:
                self._head = data[at:]
                at = end
                break
            if not self._take(data[at], now_ns):
                return False
            at += size + _read_length(data, at)
        self._payload = at - end
        return True

    def _take(self, first: int, now_ns: int) -> bool:
        if first & _FINAL_AND_OPCODE in _WHOLE:
            return self._messages.take(now_ns)
        return self._extra.take(now_ns) and self._take_extra(now_ns)


def _find_head_size(data: bytes, at: int) -> int:
    """Return the bytes of the head of the frame at `at`; 2 or more where it has not come so far."""
    if at + 2 > len(data):
        return 2
    second = data[at + 1]
    return 2 + _LONG.get(second & _LENGTH, 0) + (_MASK_BYTES if second & _MASKED else 0)


def _read_length(data: bytes, at: int) -> int:
    """Return the bytes of the payload of the frame at `at`, whose head is whole."""
    short = data[at + 1] & _LENGTH
    return int.from_bytes(data[at + 2 : at + 2 + _LONG[short]], "big") if short in _LONG else short
