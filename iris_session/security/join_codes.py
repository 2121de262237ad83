"""`join_codes.json`: codes that a new key can pair with. Never the code itself, only what it is stretched to.

A code is good for one key, for minutes, and for five wrong attempts of anybody. Used and void ones stay a while without
their secret, so that the command that made one can tell what has become of it.
"""

from __future__ import annotations

import os
import time
from typing import Final

import msgspec

from iris_session.protocol import pairing
from iris_session.security.allow_list import AllowedKey, AllowList, checked_roles
from iris_session.security.curve import KeyPair, fingerprint, raw_key
from iris_session.security.files import PATIENCE_S, KeysError, PrivateFolder

FILE: Final = "join_codes.json"
MAX_CODES: Final = 32
ATTEMPTS: Final = 5
#: How long the end of a code can be asked for.
MEMORY_S: Final = 3600.0
#: By how much clocks may be put back while a code can still be used.
CLOCK_SLACK_S: Final = 60.0


class JoinCode(msgspec.Struct, frozen=True):
    """One code. `secret`: what it is stretched to, empty when it is used or void. `server`: fingerprint of the
    session's key that it is bound to. `name`: under which the key is listed, empty for the name that the client gives.
    `expires`, `made`: UTC seconds; a code is not good before it was made, so a clock that is put back by hours gives it
    no more time. `paired`: the key that it let in.
    """

    id: str
    server: str
    secret: bytes
    expires: float
    roles: tuple[str, ...] = ()
    name: str = ""
    attempts_left: int = ATTEMPTS
    paired: AllowedKey | None = None
    made: float = 0.0

    def open(self, now_s: float) -> bool:
        """Whether it can still be used."""
        return bool(self.secret) and self.attempts_left > 0 and self.made - CLOCK_SLACK_S <= now_s < self.expires


class Attempt(msgspec.Struct, frozen=True):
    """What became of a proof. `entry`: the key is on the list. `secret`: of the code that it knew.

    Else `exhausted` codes became void by this attempt, `open_codes` can still be used.
    """

    entry: AllowedKey | None = None
    secret: bytes = b""
    exhausted: int = 0
    open_codes: int = 0


class JoinCodes:
    """Makes codes and takes proofs. Times are UTC seconds."""

    def __init__(self, folder: PrivateFolder) -> None:
        self._folder = folder

    @property
    def signature(self) -> tuple[int, ...] | None:
        """Differs after every change of the file: for who watches it."""
        return self._folder.signature(FILE)

    def read(self) -> list[JoinCode]:
        """All that is known of codes, oldest first."""
        return self._folder.read_json(FILE, list[JoinCode]) or []

    def make(
        self, server: KeyPair, *, minutes: float = 10.0, roles: tuple[str, ...] = (), name: str = ""
    ) -> tuple[str, JoinCode]:
        """A new code `XXXX-XXXX-XXXX` for sessions with this server key, and what is kept of it."""
        code = pairing.make_code(os.urandom(pairing.CODE_BYTES))
        now_s = time.time()
        made = JoinCode(
            os.urandom(8).hex(),
            server.fingerprint,
            pairing.stretch_code(code, server.raw_public),
            now_s + 60.0 * minutes,
            checked_roles(roles),
            name,
            made=now_s,
        )
        with self._folder.locked():
            codes = self._remembered(now_s)
            if sum(one.open(now_s) for one in codes) >= MAX_CODES:
                raise KeysError(f"{MAX_CODES} join codes can be used now: wait until some expire")
            self._folder.write_json(FILE, [*codes, made])
        return code, made

    def cancel(self, code_id: str) -> None:
        """Makes a code void."""
        with self._folder.locked():
            codes = [one for one in self._remembered(time.time()) if one.id != code_id or one.paired]
            self._folder.write_json(FILE, codes)

    def find(self, code_id: str) -> JoinCode | None:
        """What has become of a code, `None` when it is forgotten."""
        return next((one for one in self.read() if one.id == code_id), None)

    def of(self, server: str) -> tuple[JoinCode, ...]:
        """Those that are not used, void or expired, for the session whose key has the fingerprint `server`."""
        now_s = time.time()
        ours = (one for one in self.read() if one.server == server)
        return tuple(one for one in ours if one.secret and one.attempts_left > 0 and now_s < one.expires)

    def attempt(
        self,
        server_public: bytes,
        client_key: str,
        proof: bytes,
        name: str,
        clients: AllowList,
        patience_s: float = PATIENCE_S,
    ) -> Attempt:
        """Takes the proof of `client_key` (Z85), compared with every open code in constant time.

        The right one uses the code up and puts the key on the list; a wrong one counts against every open code,
        because it could have been meant for any of them. Raises `KeysError`; `KeysBusyError` may be tried again.
        """
        server, now_s = fingerprint(server_public), time.time()
        with self._folder.locked(patience_s):
            codes = self._remembered(now_s)
            known: JoinCode | None = None
            for one in codes:
                if one.server == server and one.open(now_s):
                    expected = pairing.make_client_proof(one.secret, server_public, raw_key(client_key))
                    if pairing.is_same_proof(expected, proof) and known is None:
                        known = one
            if known is None:
                return self._wrong(codes, server, now_s)
            entry, listed = clients.with_key(known.name or name, client_key, known.roles, rename=True)
            # The code first: a process that dies in between has let nobody in, and the code is used up all the same.
            self._mark(codes, known, entry)
            try:
                clients.replace(listed)
            except KeysError:
                self._mark(codes, known, None)
                raise
            return Attempt(entry, known.secret)

    def _mark(self, codes: list[JoinCode], known: JoinCode, entry: AllowedKey | None) -> None:
        used = msgspec.structs.replace(known, secret=b"", paired=entry)
        self._folder.write_json(FILE, [used if one is known else one for one in codes])

    def _wrong(self, codes: list[JoinCode], server: str, now_s: float) -> Attempt:
        after, exhausted = [], 0
        for one in codes:
            if one.server == server and one.open(now_s):
                left = one.attempts_left - 1
                one = msgspec.structs.replace(one, attempts_left=left, secret=one.secret if left else b"")  # noqa: PLW2901
                exhausted += left == 0
            after.append(one)
        self._folder.write_json(FILE, after, durable=False)  # a power cut ends the guessing too
        still_open = sum(one.server == server and one.open(now_s) for one in after)
        return Attempt(exhausted=exhausted, open_codes=still_open)

    def _remembered(self, now_s: float) -> list[JoinCode]:
        """The codes without those that expired long ago; expired ones lose their secret."""
        return [
            one if now_s < one.expires else msgspec.structs.replace(one, secret=b"")
            for one in self.read()
            if now_s < one.expires + MEMORY_S
        ]
