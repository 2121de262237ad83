"""Resume tokens: what lets a client that lost its connection come back as the same participant.

A token is 16 random bytes, bound to the key it was given to, valid once. It is used up by the first message of the
client that proves that its new `Welcome` (with the next token) arrived; a `Welcome` lost on the way costs nothing.
Only hashes are kept, so the memory handed back to the authority's process opens no door.
"""

from __future__ import annotations

import hashlib
import os

import msgspec


class _Record(msgspec.Struct, array_like=True):
    digest: bytes
    key_id: str
    participant_id: str


class _Handback(msgspec.Struct, array_like=True):
    next_connection: int
    records: list[_Record]


_decoder = msgspec.msgpack.Decoder(_Handback)


def _digest(token: bytes) -> bytes:
    return hashlib.blake2b(token, digest_size=16, person=b"iris-resume").digest()


class ResumeTokens:
    """Bounded table of tokens and the counter of connection numbers.

    `blob()` is handed to the next front, whenever something has `changed` since the last one.
    """

    def __init__(self, capacity: int, blob: bytes = b"") -> None:
        handback = _decoder.decode(blob) if blob else _Handback(1, [])
        self._capacity = capacity
        self._next_connection = handback.next_connection
        self._records = {record.digest: record for record in handback.records}
        self.changed = False

    def new_connection(self) -> int:
        """A connection number that no front of this session has used, from 1."""
        number = self._next_connection
        self._next_connection += 1
        self.changed = True
        return number

    def issue(self, key_id: str, participant_id: str) -> bytes:
        """A fresh token for `participant_id`. The oldest token is forgotten when the table is full."""
        token = os.urandom(16)
        digest = _digest(token)
        while len(self._records) >= self._capacity:
            del self._records[next(iter(self._records))]
        self.changed = True
        self._records[digest] = _Record(digest, key_id, participant_id)
        return token

    def find(self, token: bytes, key_id: str) -> str | None:
        """The participant that `token` stands for, when it is bound to `key_id`. Does not use the token up."""
        record = self._records.get(_digest(token))
        return record.participant_id if record is not None and record.key_id == key_id else None

    def retire(self, token: bytes) -> None:
        """Uses the token up."""
        self.changed = self._records.pop(_digest(token), None) is not None or self.changed

    def blob(self) -> bytes:
        self.changed = False
        return msgspec.msgpack.encode(_Handback(self._next_connection, list(self._records.values())))
