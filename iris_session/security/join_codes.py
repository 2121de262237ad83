"""`join_codes.json`: codes with which a new key can pair. Stores the stretched secret, never the code itself.

A code admits one key, within minutes, and becomes void after five wrong attempts in total. Used and void codes are
kept for a while without their secret, so that the command that created one can report its outcome, and so that a key
that has paired gets the same answer again, also from a front that was restarted before it could answer.
"""

from __future__ import annotations

import os
import time
from typing import Final

import msgspec

from iris_session.protocol import pairing
from iris_session.security.allow_list import CURVE, WEB, AllowedKey, AllowList, validate_roles
from iris_session.security.curve import KeyPair, compute_fingerprint, decode_key
from iris_session.security.private_folder import LOCK_TIMEOUT_S, KeysError, PrivateFolder

FILE: Final = "join_codes.json"
MAX_CODES: Final = 32
ATTEMPTS: Final = 5
#: How long the outcome of a code is kept.
MEMORY_S: Final = 3600.0
#: By how much clocks may be put back while a code can still be used.
CLOCK_SLACK_S: Final = 60.0


class JoinCode(msgspec.Struct, frozen=True):
    """One join code.

    `secret`: the stretched code, empty when it is used or void. `server`: fingerprint of the server key that it is
    bound to. `name`: name under which the key is listed, empty for the name that the client gives. `expires`, `made`:
    UTC seconds; a code is invalid before `made`, so setting a clock back by hours gives it no more time. `paired`: the
    key that it admitted; `proof`: what this key proved, `answer`: the session's proof for it. `web_secret`: the code
    stretched for `web_key`, the SHA-256 of the public key in the certificate of a gateway; both empty for a code that
    cannot be used behind one.
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
    proof: bytes = b""
    answer: bytes = b""
    web_secret: bytes = b""
    web_key: bytes = b""

    def is_open(self, now_s: float) -> bool:
        """Return True while the code can be used."""
        return bool(self.secret) and self.attempts_left > 0 and self.made - CLOCK_SLACK_S <= now_s < self.expires

    def find_secret(self, web_key: bytes) -> bytes:
        """Return the secret for a proof over `web_key`, empty: over the key of the session. Empty if there is none."""
        if not web_key:
            return self.secret
        return self.web_secret if self.web_key == web_key else b""

    def without_secrets(self) -> JoinCode:
        """Return the code as it is kept when it is used, void or expired."""
        return msgspec.structs.replace(self, secret=b"", web_secret=b"")


class RedeemResult(msgspec.Struct, frozen=True):
    """Outcome of one attempt to redeem a code. `entry`: the key, now listed. `answer`: the session's proof for it.

    Without an entry, `exhausted` codes became void by this attempt and `open_codes` can still be used.
    """

    entry: AllowedKey | None = None
    answer: bytes = b""
    exhausted: int = 0
    open_codes: int = 0


class JoinCodes:
    """Creates join codes and checks proofs of them. Times are UTC seconds."""

    def __init__(self, folder: PrivateFolder) -> None:
        self._folder = folder

    @property
    def signature(self) -> tuple[int, ...] | None:
        """A value that differs after every change of the file, for polling."""
        return self._folder.signature(FILE)

    def read(self) -> list[JoinCode]:
        """Return all stored codes, oldest first."""
        return self._folder.read_json(FILE, list[JoinCode]) or []

    def create(
        self,
        server: KeyPair,
        *,
        minutes: float = 10.0,
        roles: tuple[str, ...] = (),
        name: str = "",
        web_key: bytes = b"",
    ) -> tuple[str, JoinCode]:
        """Create a code for sessions with this server key. Returns its text `XXXX-XXXX-XXXX` and the stored entry.

        `web_key`: SHA-256 of the public key (SubjectPublicKeyInfo) in the certificate of the sessions' gateway; with
        it, the code can be used behind that gateway, too.
        """
        code = pairing.make_code(os.urandom(pairing.CODE_BYTES))
        now_s = time.time()
        made = JoinCode(
            os.urandom(8).hex(),
            server.fingerprint,
            pairing.stretch_code(code, server.raw_public),
            now_s + 60.0 * minutes,
            validate_roles(roles),
            name,
            made=now_s,
            web_secret=pairing.stretch_code(code, web_key) if web_key else b"",
            web_key=web_key,
        )
        with self._folder.lock():
            codes = self._read_recent(now_s)
            if sum(one.is_open(now_s) for one in codes) >= MAX_CODES:
                raise KeysError(f"{MAX_CODES} join codes are open, which is the limit: wait until some expire")
            self._folder.write_json(FILE, [*codes, made])
        return code, made

    def cancel(self, code_id: str) -> None:
        """Make a code void."""
        with self._folder.lock():
            codes = [one for one in self._read_recent(time.time()) if one.id != code_id or one.paired]
            self._folder.write_json(FILE, codes)

    def find_code(self, code_id: str) -> JoinCode | None:
        """Return a code in its present state, `None` when it is not kept any more."""
        return next((one for one in self.read() if one.id == code_id), None)

    def list_for_server(self, server: str) -> tuple[JoinCode, ...]:
        """Return the stored codes for the server key with fingerprint `server`: open, used and void ones."""
        return tuple(one for one in self.read() if one.server == server)

    def redeem(
        self,
        server_public: bytes,
        client_key: str,
        proof: bytes,
        name: str,
        clients: AllowList,
        timeout_s: float = LOCK_TIMEOUT_S,
        web_key: bytes = b"",
    ) -> RedeemResult:
        """Check the proof of `client_key` (Z85) against every open code in constant time.

        A right proof uses its code up and adds the key to the list. A wrong one counts against every open code that it
        could have been meant for. Raises `KeysError`; `KeysBusyError` can be retried.

        `web_key`: of the gateway's certificate, for a web identity; empty: `client_key` is a CURVE key.
        """
        server, now_s = compute_fingerprint(server_public), time.time()
        proved_to = web_key or server_public
        with self._folder.lock(timeout_s):
            codes = self._read_recent(now_s)
            known: JoinCode | None = None
            for one in codes:
                if _is_meant(one, server, web_key, now_s):
                    secret = one.find_secret(web_key)
                    expected = pairing.make_client_proof(secret, proved_to, decode_key(client_key))
                    if pairing.is_same_proof(expected, proof) and known is None:
                        known = one
            if known is None:
                return self._count_failed_attempt(codes, server, web_key, now_s)
            kind = WEB if web_key else CURVE
            entry, listed = clients.plan_entry(known.name or name, client_key, known.roles, rename=True, kind=kind)
            answer = pairing.make_server_proof(known.find_secret(web_key), proved_to, decode_key(client_key))
            used = msgspec.structs.replace(known.without_secrets(), paired=entry, proof=proof, answer=answer)
            # The code first: a process that dies in between has admitted no key, and the code is used up all the same.
            self._write_used(codes, known, used)
            try:
                clients.replace_all(listed)
            except KeysError:
                self._write_used(codes, known, known.without_secrets())
                raise
            return RedeemResult(entry, answer)

    def _write_used(self, codes: list[JoinCode], known: JoinCode, used: JoinCode) -> None:
        self._folder.write_json(FILE, [used if one is known else one for one in codes])

    def _count_failed_attempt(self, codes: list[JoinCode], server: str, web_key: bytes, now_s: float) -> RedeemResult:
        after, exhausted = [], 0
        for one in codes:
            if _is_meant(one, server, web_key, now_s):
                one = msgspec.structs.replace(one, attempts_left=one.attempts_left - 1)  # noqa: PLW2901
                if not one.attempts_left:
                    one = one.without_secrets()  # noqa: PLW2901
                    exhausted += 1
            after.append(one)
        self._folder.write_json(FILE, after, durable=False)  # a power cut interrupts guessing as well
        still_open = sum(_is_meant(one, server, web_key, now_s) for one in after)
        return RedeemResult(exhausted=exhausted, open_codes=still_open)

    def _read_recent(self, now_s: float) -> list[JoinCode]:
        """Return the codes without those that expired long ago; expired ones lose their secret."""
        return [
            one if now_s < one.expires else one.without_secrets()
            for one in self.read()
            if now_s < one.expires + MEMORY_S
        ]


def _is_meant(code: JoinCode, server: str, web_key: bytes, now_s: float) -> bool:
    """Return whether an attempt at a session, behind the gateway with `web_key`, can be meant for a code."""
    return code.server == server and code.is_open(now_s) and bool(code.find_secret(web_key))
