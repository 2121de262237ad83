"""Identity of a client across connections and restarts: a secret and the last resume token.

On plain loopback the 128-bit secret in `hello` stands for the key; with CURVE the key itself does. In memory by
default: then a new process is a new participant. With a file, a killed and restarted process resumes its leases.
"""

from __future__ import annotations

import logging
import os
import secrets
import stat
from pathlib import Path

import msgspec

from iris_session.client.errors import IdentityError
from iris_session.system.files import write_atomic

SECRET_BYTES = 16  # 128 bits
_log = logging.getLogger(__name__)


class _Stored(msgspec.Struct, frozen=True):
    secret: bytes
    resume_token: bytes = b""


class Identity:
    """Identity of a client: a secret and the resume token of its last session.

    Args:
        secret: `SECRET_BYTES` random bytes.
        resume_token: Token of the last `Welcome`; single use.
        path: File that every change is written to at once, readable by its owner only; `None`: in memory.

    Raises:
        IdentityError: `secret` has another length.
    """

    def __init__(self, secret: bytes, resume_token: bytes = b"", path: Path | None = None) -> None:
        if len(secret) != SECRET_BYTES:
            raise IdentityError(f"an identity needs a secret of {SECRET_BYTES} bytes, got {len(secret)}")
        self.secret = secret
        self.path = path
        self._resume_token = resume_token
        self._warned = False

    @classmethod
    def in_memory(cls) -> Identity:
        """Create an identity that ends with the process.

        Returns:
            The identity.
        """
        return cls(secrets.token_bytes(SECRET_BYTES))

    @classmethod
    def from_file(cls, path: str | Path) -> Identity:
        """Read the identity at `path`, or create one there.

        Args:
            path: The identity file.

        Returns:
            The identity.

        Raises:
            IdentityError: The file is damaged, may be read by other users, or cannot be read or created.
        """
        path = Path(path)
        try:
            with path.open("rb") as file:
                status = os.fstat(file.fileno())  # of the open file: the path may be replaced meanwhile
                data = file.read()
        except FileNotFoundError:
            identity = cls(secrets.token_bytes(SECRET_BYTES), path=path)
            identity._write()
            return identity
        except OSError as error:
            raise IdentityError(f"identity file {path} cannot be read: {error.strerror}") from error
        mode = stat.S_IMODE(status.st_mode)
        if os.name == "posix" and mode & 0o077:
            raise IdentityError(f"identity file {path} may be read by others (mode {mode:o}): run chmod 600 on it")
        if os.name == "posix" and status.st_uid != os.geteuid():
            raise IdentityError(f"identity file {path} belongs to another user: give a file of your own")
        try:
            stored = msgspec.json.decode(data, type=_Stored)
        except msgspec.MsgspecError as error:
            raise IdentityError(f"identity file {path} is damaged ({error}): delete it to start anew") from error
        return cls(stored.secret, stored.resume_token, path)

    @property
    def resume_token(self) -> bytes:
        """Token of the last `Welcome`, single use; empty: join as a new participant."""
        return self._resume_token

    @resume_token.setter
    def resume_token(self, token: bytes) -> None:
        if token != self._resume_token:
            self._resume_token = token
            if self.path is not None:
                self._write()

    def remember(self, token: bytes) -> bool:
        """Set `resume_token`.

        A full disk does not end a participation: this process has the token, only another process could not resume
        with it.

        Args:
            token: Token of a `Welcome`.

        Returns:
            False when the file cannot be written; the first time a warning is logged.
        """
        try:
            self.resume_token = token
        except IdentityError as error:
            if not self._warned:
                _log.warning("%s: after a restart this client cannot resume", error)
            self._warned = True
            return False
        return True

    def _write(self) -> None:
        """Replace the file in one step, so that a kill leaves either the old or the new content.

        The new content goes to a new file with an unpredictable name: a file that is there already could be open in
        another process, or be a link to another place.
        """
        assert self.path is not None
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(self.path, msgspec.json.encode(_Stored(self.secret, self._resume_token)))
        except OSError as error:
            raise IdentityError(f"identity file {self.path} cannot be written: {error.strerror}") from error
