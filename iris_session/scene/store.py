"""`AssetStore`: assets as files below one folder, named by the SHA-256 of their bytes.

Layout: `<root>/<first two hex>/<hash>`; `<root>/index/<two hex>/<key>` remembers what was built from which raw content
(`build`), `<root>/holds/` what running processes use. Several processes may share a folder: files appear whole (rename)
and never change. When the files exceed `limit_bytes`, those used longest ago go, but nothing that a process holds and
nothing used within `GRACE_S`.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from filelock import FileLock, Timeout

from iris_session.scene.errors import AssetMissingError

DEFAULT_LIMIT: Final = 4 << 30
#: A file used this short ago [s] stays: another process may be about to hold it.
GRACE_S: Final = 600.0
_ADDRESS: Final = re.compile(r"[0-9a-f]{64}")
_INDEX: Final = "index"
_HOLDS: Final = "holds"


def default_root() -> Path:
    """`~/.cache/iris-session/assets`, or below `XDG_CACHE_HOME`."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if base else Path.home() / ".cache") / "iris-session" / "assets"


class Hold:
    """Assets that stay in the store until `release`, or until this process ends however it ends."""

    def __init__(self, folder: Path, addresses: Iterable[str]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=folder, suffix=".hold")
        self._path = Path(name)
        self._lock = FileLock(f"{name}.lock")
        self._lock.acquire()
        with os.fdopen(handle, "w") as file:
            file.write("\n".join(sorted(set(addresses))))

    def release(self) -> None:
        self._path.unlink(missing_ok=True)
        self._lock.release()
        Path(self._lock.lock_file).unlink(missing_ok=True)

    def __enter__(self) -> Hold:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


class AssetStore:
    """See the module. `evicted`: files that this process removed to make room. Thread-safe, as renames are."""

    def __init__(self, root: Path | str | None = None, limit_bytes: int = DEFAULT_LIMIT) -> None:
        self.root = Path(root) if root is not None else default_root()
        self.limit_bytes = limit_bytes
        self.evicted = 0
        self.root.mkdir(parents=True, exist_ok=True)
        self._total = sum(entry.stat().st_size for entry in self._files())

    # --- assets -------------------------------------------------------------------------------------------------------

    def put(self, data: bytes | bytearray | memoryview) -> str:
        """Keeps `data`; returns its address. Costs a hash when the store has it already."""
        address = hashlib.sha256(data).hexdigest()
        path = self.path(address)
        if not _touch(path):
            self._write(path, data)
        return address

    def get(self, address: str) -> bytes:
        """The bytes. Raises `AssetMissingError`; a file that was damaged on the disk is removed too."""
        path = self.path(address)
        try:
            data = path.read_bytes()
        except OSError:
            raise AssetMissingError(f"asset {address} is not in {self.root}: build the scene again") from None
        if hashlib.sha256(data).hexdigest() != address:
            path.unlink(missing_ok=True)
            raise AssetMissingError(f"asset {address} was damaged on the disk and is gone: build the scene again")
        return data

    def path(self, address: str) -> Path:
        """Where an asset lies, or would. Raises `ValueError` for what is no address."""
        if not _ADDRESS.fullmatch(address):
            raise ValueError(f"{address!r} is no address of an asset: 64 hex digits, lower case")
        return self.root / address[:2] / address

    def size(self, address: str) -> int:
        """Bytes of an asset. Raises `AssetMissingError`."""
        try:
            return self.path(address).stat().st_size
        except OSError:
            raise AssetMissingError(f"asset {address} is not in {self.root}: build the scene again") from None

    def __contains__(self, address: object) -> bool:
        return isinstance(address, str) and _ADDRESS.fullmatch(address) is not None and self.path(address).is_file()

    def hold(self, addresses: Iterable[str]) -> Hold:
        """Keeps these from being removed, by any process. For as long as a scene is shared."""
        return Hold(self.root / _HOLDS, addresses)

    # --- what was built from what -------------------------------------------------------------------------------------

    def recall(self, key: str) -> bytes | None:
        """What `remember` was told for `key`, a SHA-256 in hex; marks it as used."""
        path = self._index(key)
        try:
            note = path.read_bytes()
        except OSError:
            return None
        _touch(path)
        return note

    def remember(self, key: str, note: bytes) -> None:
        self._write(self._index(key), note)

    def used(self, address: str) -> bool:
        """Marks an asset as used now; false when it is not there."""
        return _touch(self.path(address))

    # --- inside -------------------------------------------------------------------------------------------------------

    def _index(self, key: str) -> Path:
        if not _ADDRESS.fullmatch(key):
            raise ValueError(f"{key!r} is no key: 64 hex digits")
        return self.root / _INDEX / key[:2] / key

    def _write(self, path: Path, data: bytes | bytearray | memoryview) -> None:
        self._make_room(len(data))
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
            os.replace(name, path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
        self._total += len(data)

    def _files(self) -> Iterator[os.DirEntry[str]]:
        """Files of assets and of the index, not holds."""
        folders = [self.root, self.root / _INDEX]
        for folder in folders:
            with contextlib.suppress(FileNotFoundError), os.scandir(folder) as entries:
                for entry in entries:
                    if entry.is_dir() and len(entry.name) == 2:
                        with os.scandir(entry.path) as files:
                            yield from files

    def _make_room(self, n_bytes: int) -> None:
        if self._total + n_bytes <= self.limit_bytes:
            return
        held, now = self._held(), time.time()
        found = []
        for entry in self._files():
            with contextlib.suppress(FileNotFoundError):
                status = entry.stat()
                found.append((status.st_mtime, status.st_size, entry))
        self._total = sum(size for _, size, _ in found)
        for used, size, entry in sorted(found, key=lambda item: item[0]):
            if self._total + n_bytes <= self.limit_bytes or now - used < GRACE_S:
                return
            if entry.name not in held:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(entry.path)
                    self._total -= size
                    self.evicted += 1

    def _held(self) -> set[str]:
        """Addresses that a living process holds. Notes of dead ones are removed."""
        held: set[str] = set()
        for path in (self.root / _HOLDS).glob("*.hold"):
            lock = FileLock(f"{path}.lock")
            try:
                lock.acquire(blocking=False)
            except Timeout:
                with contextlib.suppress(FileNotFoundError):
                    held.update(path.read_text().split())
                continue
            path.unlink(missing_ok=True)
            lock.release()
            Path(lock.lock_file).unlink(missing_ok=True)
        return held


def _touch(path: Path) -> bool:
    """Marks a file as used now; false when it is not there."""
    try:
        os.utime(path)
    except FileNotFoundError:
        return False
    return True
