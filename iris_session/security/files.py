"""A private folder: permissions, one lock for its writers, files that are replaced as a whole."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final, TypeVar

import msgspec
from filelock import FileLock, Timeout

from iris_session.security.lines import trouble
from iris_session.system.files import write_atomic

LOCK: Final = "lock"
#: How long a command waits for another process to finish its change; a change takes milliseconds.
PATIENCE_S: Final = 5.0
#: No file of ours comes near it: a larger one is damaged, or somebody else's.
MAX_FILE_BYTES: Final = 4_000_000
T = TypeVar("T")


class KeysError(Exception):
    """The home of keys cannot be used. The text is one line that says what to do."""


class KeysBusyError(KeysError):
    """Another process is changing the home of keys; it may be tried again."""


class PrivateFolder:
    """A folder with mode 0700 whose files have mode 0600. Made when something is first written."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def make(self) -> None:
        """Makes the folder. Raises `KeysError` when it belongs to somebody else or others may enter it."""
        try:
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            status = self.path.stat()
        except OSError as error:
            raise KeysError(f"{self.path} cannot be made: {error.strerror}; set IRIS_HOME to another folder") from error
        check_private(self.path, status, f"chmod 700 {self.path}")

    def read(self, name: str) -> bytes | None:
        """Content of a file, `None` when it is not there. Raises `KeysError` when others may read it."""
        path = self.path / name
        try:
            with path.open("rb") as file:
                status = os.fstat(file.fileno())
                check_private(path, status, f"chmod 600 {path}")
                data = file.read(min(status.st_size, MAX_FILE_BYTES) + 1)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise KeysError(f"{path} cannot be read: {error.strerror}") from error
        if len(data) > MAX_FILE_BYTES:
            raise KeysError(f"{path} is larger than {MAX_FILE_BYTES} bytes: it is damaged, move it away")
        return data

    def read_json(self, name: str, kind: type[T]) -> T | None:
        """A JSON file as `kind`. Raises `KeysError` for one that is damaged: it is not replaced."""
        data = self.read(name)
        if data is None:
            return None
        try:
            return msgspec.json.decode(data, type=kind)
        except msgspec.MsgspecError as error:
            text = trouble(data.decode(errors="replace"), error)
        except (UnicodeDecodeError, RecursionError) as error:
            text = str(error)
        raise KeysError(f"{self.path / name} is damaged ({text}): repair it, or move it away")

    def write(self, name: str, data: bytes, *, durable: bool = True) -> None:
        """Replaces a file as a whole, mode 0600. `durable`: it survives a power cut."""
        self.make()
        path = self.path / name
        try:
            write_atomic(path, data, durable=durable)
        except OSError as error:
            raise KeysError(f"{path} cannot be written: {error.strerror}") from error

    def write_json(self, name: str, value: object, *, durable: bool = True) -> None:
        """Replaces a JSON file, indented for people."""
        self.write(name, msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n", durable=durable)

    def signature(self, name: str) -> tuple[int, ...] | None:
        """Changes whenever a file was replaced, edited, or got other permissions; `None` while there is none."""
        try:
            status = (self.path / name).stat()
        except OSError:
            return None
        return status.st_ino, status.st_ctime_ns, status.st_size, status.st_mode

    @contextlib.contextmanager
    def locked(self, patience_s: float = PATIENCE_S) -> Iterator[None]:
        """The right to change files here, against all other processes. Raises `KeysBusyError` after `patience_s`."""
        self.make()
        lock = FileLock(self.path / LOCK, timeout=patience_s, mode=0o600)
        try:
            lock.acquire(poll_interval=0.01)
        except Timeout:
            raise KeysBusyError(f"another process is changing {self.path}: try again") from None
        except OSError as error:
            raise KeysError(f"{self.path / LOCK} cannot be opened: {error.strerror}") from error
        try:
            yield
        finally:
            lock.release()


def check_private(path: Path, status: os.stat_result, remedy: str) -> None:
    """Raises `KeysError` when a file or folder is not this user's alone. `remedy`: the command that makes it so."""
    if os.name != "posix":
        return  # folders of a user are closed to others there by access lists
    if status.st_uid != os.geteuid():
        raise KeysError(f"{path} belongs to another user: take a file or folder of your own (IRIS_HOME)")
    if stat.S_IMODE(status.st_mode) & 0o077:
        raise KeysError(f"{path} can be used by other users of this machine: {remedy}")
