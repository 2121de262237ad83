"""A private folder: permissions, one lock for its writers, files that are replaced as a whole, JSON error positions."""

from __future__ import annotations

import contextlib
import json
import os
import re
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final, TypeVar

import msgspec
from filelock import FileLock, Timeout

from iris_session.protocol.errors import IrisError
from iris_session.system.files import write_atomic

LOCK: Final = "lock"
#: How long a command waits for another process to finish its change; a change takes milliseconds.
LOCK_TIMEOUT_S: Final = 5.0
#: Far above the size of any file here: a larger one is damaged or does not belong here.
MAX_FILE_BYTES: Final = 4_000_000
T = TypeVar("T")


class KeysError(IrisError):
    """The key home cannot be used. The message is one line that says what to do."""


class KeysBusyError(KeysError):
    """Another process is changing the key home; try again."""


class PrivateFolder:
    """A folder with mode 0700 whose files have mode 0600. Created by the first write."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def create(self) -> None:
        """Create the folder. Raises `KeysError` when another user owns it or may enter it."""
        try:
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            status = self.path.stat()
        except OSError as error:
            raise KeysError(f"{self.path} cannot be created: {error.strerror}; set IRIS_HOME elsewhere") from error
        check_private(self.path, status, f"chmod 700 {self.path}")

    def read(self, name: str) -> bytes | None:
        """Return the content of a file, `None` without one. Raises `KeysError` when other users may read it."""
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
        """Return a JSON file as `kind`, `None` without one. Raises `KeysError` for a damaged one, which stays."""
        data = self.read(name)
        if data is None:
            return None
        try:
            return msgspec.json.decode(data, type=kind)
        except msgspec.MsgspecError as error:
            text = describe_json_error(data.decode(errors="replace"), error)
        except (UnicodeDecodeError, RecursionError) as error:
            text = str(error)
        raise KeysError(f"{self.path / name} is damaged ({text}): repair it, or move it away")

    def write(self, name: str, data: bytes, *, durable: bool = True) -> None:
        """Replace a file as a whole, mode 0600. `durable`: it survives a power cut."""
        self.create()
        path = self.path / name
        try:
            write_atomic(path, data, durable=durable)
        except OSError as error:
            raise KeysError(f"{path} cannot be written: {error.strerror}") from error

    def write_json(self, name: str, value: object, *, durable: bool = True) -> None:
        """Replace a JSON file, indented for reading."""
        self.write(name, msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n", durable=durable)

    def signature(self, name: str) -> tuple[int, ...] | None:
        """Return a value that differs after each replacement, edit or change of permissions; `None` without a file."""
        try:
            status = (self.path / name).stat()
        except OSError:
            return None
        return status.st_ino, status.st_ctime_ns, status.st_size, status.st_mode

    @contextlib.contextmanager
    def lock(self, timeout_s: float = LOCK_TIMEOUT_S) -> Iterator[None]:
        """Hold the lock on this folder against all other processes. Raises `KeysBusyError` after `timeout_s`."""
        self.create()
        lock = FileLock(self.path / LOCK, timeout=timeout_s, mode=0o600)
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
    """Raise `KeysError` unless only this user can access a file or folder. `remedy`: the command that fixes it."""
    if os.name != "posix":
        return  # folders of a user are closed to others there by access lists
    if status.st_uid != os.geteuid():
        raise KeysError(f"{path} belongs to another user: use a file or folder of your own (IRIS_HOME)")
    if stat.S_IMODE(status.st_mode) & 0o077:
        raise KeysError(f"{path} can be used by other users of this machine: {remedy}")


_INDEX: Final = re.compile(r"\$\[(\d+)\]")
_BLANK: Final = re.compile(r"[\s\[,]*")


def describe_json_error(text: str, error: msgspec.MsgspecError) -> str:
    """Return a one-line description, with the line number, of why msgspec rejected a JSON list."""
    try:
        json.loads(text)
    except json.JSONDecodeError as malformed:
        return f"line {malformed.lineno}: {malformed.msg}"
    except RecursionError:
        return "nested too deep"
    except ValueError as other:  # a number of thousands of digits
        return str(other)
    found = _INDEX.search(str(error))
    if found is None:
        return str(error)
    return f"line {find_entry_line(text, int(found[1]))}: {error}"


def find_entry_line(text: str, index: int) -> int:
    """Return the line, from 1, in which entry `index` of a JSON list begins; of malformed JSON, the last one read."""
    decoder, at = json.JSONDecoder(), _skip_blank(text, 0)
    with suppress(ValueError, RecursionError):  # the file is being edited
        for _ in range(index):
            _, end = decoder.raw_decode(text, at)
            at = _skip_blank(text, end)
    return text.count("\n", 0, at) + 1


def _skip_blank(text: str, at: int) -> int:
    blank = _BLANK.match(text, at)
    return blank.end() if blank is not None else at
