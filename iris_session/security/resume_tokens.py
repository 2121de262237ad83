"""Resume tokens: a client that reconnects with one comes back as the same participant.

A token is 16 random bytes, bound to the key it was issued to, valid once. It is used up by the first message of the
client that proves that its new `Welcome` (with the next token) arrived; a lost `Welcome` costs nothing. Only hashes
are stored, so the table handed back to the authority's process grants no access.
"""

from __future__ import annotations

import hashlib
import os

import msgspec


class _TokenRecord(msgspec.Struct, array_like=True):
    digest: bytes
    key_id: str
    participant_id: str
    behind: str = ""  # key of the gateway that connects the participant
    web: bool = False  # `key_id` is a web identity


class _TokenState(msgspec.Struct, array_like=True):
    next_connection: int
    records: list[_TokenRecord]
    revoked: list[str] = []


_decoder = msgspec.msgpack.Decoder(_TokenState)


def _hash_token(token: bytes) -> bytes:
    return hashlib.blake2b(token, digest_size=16, person=b"iris-resume").digest()


def encode_handback(last_connection: int, blob: bytes = b"") -> bytes:
    """Return `blob` (empty: no tokens) for a front whose connection numbers begin above `last_connection`.

    Raises `msgspec.DecodeError` for bytes that are not an encoded table.
    """
    state = _decoder.decode(blob) if blob else _TokenState(1, [])
    state.next_connection = max(state.next_connection, last_connection + 1)
    return msgspec.msgpack.encode(state)


class ResumeTokens:
    """Bounded table of tokens and the counter of connection numbers.

    `encode()` is handed to the next front, whenever the table has `changed` since the last call.
    """

    def __init__(self, capacity: int, blob: bytes = b"") -> None:
        state = _decoder.decode(blob) if blob else _TokenState(1, [])
        self._capacity = capacity
        self._next_connection = state.next_connection
        self._records = {record.digest: record for record in state.records}
        self._revoked = dict.fromkeys(state.revoked)
        self.changed = False

    def allocate_connection(self) -> int:
        """Return a connection number that no front of this session has used, from 1."""
        number = self._next_connection
        self._next_connection += 1
        self.changed = True
        return number

    def issue(
        self, key_id: str, participant_id: str, previous: bytes = b"", behind: str = "", *, web: bool = False
    ) -> bytes:
        """Return a new token for `participant_id`, which keeps at most one other: the `previous` one that it came with.

        `behind`: key of the gateway that connects it. `web`: `key_id` is a web identity. A full table drops its oldest
        token: that of the participant that has been disconnected for longest, since those who left have none
        (`remove_participant`).
        """
        token = os.urandom(16)
        digest = _hash_token(token)
        keep = _hash_token(previous)
        for record in [one for one in self._records.values() if one.participant_id == participant_id]:
            if record.digest != keep:
                del self._records[record.digest]
        while len(self._records) >= self._capacity:
            del self._records[next(iter(self._records))]
        self.changed = True
        self._records[digest] = _TokenRecord(digest, key_id, participant_id, behind, web)
        return token

    def find_participant(self, token: bytes, key_id: str) -> str | None:
        """Return the participant of `token` if it is bound to `key_id`. Does not use the token up."""
        record = self._records.get(_hash_token(token))
        return record.participant_id if record is not None and record.key_id == key_id else None

    def is_known(self, token: bytes) -> bool:
        """Return whether `token` is that of a participant, with whatever key."""
        return _hash_token(token) in self._records

    def count_participants(self, key_id: str) -> int:
        """Return the number of participants of a key, disconnected ones and those behind it included."""
        return len({one.participant_id for one in self._records.values() if key_id in (one.key_id, one.behind)})

    def use_up(self, token: bytes) -> None:
        """Use up a token."""
        self.changed = self._records.pop(_hash_token(token), None) is not None or self.changed

    def remove_participant(self, participant_id: str) -> None:
        """Use up every token of a participant."""
        for record in [one for one in self._records.values() if one.participant_id == participant_id]:
            del self._records[record.digest]
            self.changed = True

    def revoke_key(self, key_id: str) -> list[str]:
        """Use up every token of a key, of a gateway those of its clients too. Returns the participants, each once."""
        theirs = [record for record in self._records.values() if key_id in (record.key_id, record.behind)]
        for record in theirs:
            del self._records[record.digest]
        self._revoked.pop(key_id, None)
        while len(self._revoked) >= self._capacity:
            del self._revoked[next(iter(self._revoked))]
        self._revoked[key_id] = None
        self.changed = True
        return list(dict.fromkeys(record.participant_id for record in theirs))

    def reinstate_key(self, key_id: str) -> None:
        """Forget that a key was revoked: it was allowed again."""
        self.changed = self.changed or key_id in self._revoked
        self._revoked.pop(key_id, None)

    @property
    def curve_keys(self) -> set[str]:
        """CURVE keys that participants have connected with, those of their gateways included."""
        return {one.behind or one.key_id for one in self._records.values()}

    @property
    def web_keys(self) -> set[str]:
        """Web identities of participants."""
        return {one.key_id for one in self._records.values() if one.web}

    @property
    def revoked_keys(self) -> tuple[str, ...]:
        """Keys that were revoked in this session and not allowed again since, the latest last."""
        return tuple(self._revoked)

    def is_revoked(self, key_id: str) -> bool:
        """Return True if this key was revoked in this session and not allowed again since."""
        return key_id in self._revoked

    def encode(self) -> bytes:
        """Return the table as bytes and reset `changed`."""
        self.changed = False
        return msgspec.msgpack.encode(
            _TokenState(self._next_connection, list(self._records.values()), list(self._revoked))
        )
