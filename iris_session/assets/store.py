"""`AssetStore`: assets as files below one folder, named by the SHA-256 of their bytes.

Layout: `<root>/<first two hex>/<hash>`; `<root>/index/<two hex>/<key>` remembers what was built from which raw content
(`build`), `<root>/holds/` what running processes use. Several processes may share a folder: files appear whole (rename)
and never change. When the files exceed `limit_bytes`, those used longest ago go, but nothing that a process holds and
nothing used within `GRACE_S`. What a process that was killed left half done goes when the next one opens the store.
Files and folders of others below the root are never touched.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from filelock import FileLock, Timeout

from iris_session.assets.errors import AssetMissingError

DEFAULT_LIMIT: Final = 4 << 30
#: A file used this short ago [s] stays: another process may be about to hold it.
GRACE_S: Final = 600.0
_ADDRESS: Final = re.compile(r"[0-9a-f]{64}")
_PART: Final = re.compile(r"tmp\w+\.part")
#: Of a hold: its note before it has its name, and a lock, which is of no use without the note.
_HALF_HELD: Final = re.compile(r"(tmp\w+\.new)(\.hold\.lock)?")
_INDEX: Final = "index"
_HOLDS: Final = "holds"


def default_root() -> Path:
    """`~/.cache/iris-session/assets`, or below `XDG_CACHE_HOME`. Raises `OSError` where there is no home."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "iris-session" / "assets"
    except RuntimeError:  # a user without an entry, as in containers
        raise OSError(errno.ENOENT, "this user has no home folder: set XDG_CACHE_HOME, or name a folder") from None


class Hold:
    """Assets that stay in the store until `release`, or until this process ends however it ends."""

    def __init__(self, folder: Path, addresses: Iterable[str]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=folder, suffix=".new")
        self._path = Path(f"{name}.hold")
        self._lock = FileLock(f"{self._path}.lock", thread_local=False)  # another thread may release it
        try:
            with os.fdopen(handle, "w") as file:
                file.write("\n".join(sorted(set(addresses))))
            self._lock.acquire()
            os.replace(name, self._path)  # whoever sees it finds it whole, and locked
        except BaseException as error:
            Path(name).unlink(missing_ok=True)
            self.release()
            if isinstance(error, NotImplementedError):  # what filelock says of a file system
                raise OSError(errno.ENOLCK, f"{folder} is on a file system without locks") from error
            raise

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
        self._total = self._tidied()
        self._look_at = limit_bytes

    # --- assets -------------------------------------------------------------------------------------------------------

    def put(self, data: bytes | bytearray | memoryview) -> str:
        """Keeps `data`; returns its address. Costs a hash when the store has it already."""
        view = memoryview(data).cast("B")
        address = hashlib.sha256(view).hexdigest()
        if not self.used(address, len(view)):
            self._write(self.path(address), view)
        return address

    def get(self, address: str) -> bytes:
        """The bytes. Raises `AssetMissingError`; a file that was damaged on the disk is removed too."""
        path = self.path(address)
        try:
            data = path.read_bytes()
        except OSError:
            raise AssetMissingError(f"asset {address} is not in {self.root}: build the scene again", address) from None
        if hashlib.sha256(data).hexdigest() != address:
            with contextlib.suppress(OSError):  # a disk that cannot be written: `put` says so
                path.unlink()
            raise AssetMissingError(
                f"asset {address} was damaged on the disk and is gone: build the scene again", address
            )
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
            raise AssetMissingError(f"asset {address} is not in {self.root}: build the scene again", address) from None

    def __contains__(self, address: object) -> bool:
        return isinstance(address, str) and _ADDRESS.fullmatch(address) is not None and self.path(address).is_file()

    def used_at(self, address: str) -> int:
        """When an asset was used last [ns since 1970], for `discard`; 0 when it is not there."""
        try:
            return self.path(address).stat().st_mtime_ns
        except OSError:
            return 0

    def discard(self, address: str, used_at: int) -> bool:
        """Removes an asset that is of no use any more, unless somebody holds it, or has used it since. Whether it
        did."""
        path = self.path(address)
        with contextlib.suppress(OSError):
            status = path.stat()
            if status.st_mtime_ns == used_at and address not in self._held():
                path.unlink()
                self._total -= status.st_size
                return True
        return False

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

    def used(self, address: str, n_bytes: int) -> bool:
        """Marks an asset as used now; false when it is not there, or has not its length: cut off by a crash."""
        path = self.path(address)
        with contextlib.suppress(FileNotFoundError):
            return path.stat().st_size == n_bytes and _touch(path)
        return False

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

    def _files(self) -> Iterator[tuple[os.DirEntry[str], os.stat_result]]:
        """Files of assets and of the index, and parts that a crash left. No holds, nothing that is not ours."""
        for folder in (self.root, self.root / _INDEX):
            for sub in _entries(folder):
                if len(sub.name) == 2 and sub.is_dir(follow_symlinks=False):
                    for entry in _entries(sub.path):
                        ours = _ADDRESS.fullmatch(entry.name) and entry.name[:2] == sub.name
                        if (ours or _PART.fullmatch(entry.name)) and entry.is_file(follow_symlinks=False):
                            with contextlib.suppress(FileNotFoundError):  # taken by another process meanwhile
                                yield entry, entry.stat(follow_symlinks=False)

    def _tidied(self) -> int:
        """Takes away what processes that are gone left half done; what is young may be somebody's at work. Bytes of
        all files."""
        with contextlib.suppress(OSError):  # a folder that we may only read
            self._held()
        old = time.time() - GRACE_S
        found, total = [], 0
        for entry, status in self._files():
            total += status.st_size
            if _PART.fullmatch(entry.name):
                found.append(entry)
        holds = self.root / _HOLDS
        for entry in _entries(holds):
            half = _HALF_HELD.fullmatch(entry.name)
            if half and not (holds / f"{half[1]}.hold").exists():
                found.append(entry)
        for entry in found:
            with contextlib.suppress(OSError):
                if entry.stat(follow_symlinks=False).st_mtime < old:
                    os.unlink(entry.path)
        return total  # with the parts: the next time that room is made it is counted anew

    def _make_room(self, n_bytes: int) -> None:
        if self._total + n_bytes <= self._look_at:
            return
        held, now = self._held(), time.time()
        found = [(status.st_mtime, status.st_size, entry) for entry, status in self._files()]
        self._total = sum(size for _, size, _ in found)
        for used, size, entry in sorted(found, key=lambda item: item[0]):
            if self._total + n_bytes <= self.limit_bytes or now - used < GRACE_S:
                break
            if entry.name not in held:
                with contextlib.suppress(FileNotFoundError):
                    if os.stat(entry.path, follow_symlinks=False).st_mtime == used:  # nobody has used it meanwhile
                        os.unlink(entry.path)
                        self._total -= size
                        self.evicted += 1
        # Where everything is in use, not every file is looked at again for each that comes.
        self._look_at = max(self.limit_bytes, self._total + n_bytes + self.limit_bytes // 64)

    def _held(self) -> set[str]:
        """Addresses that a living process holds. Notes of dead ones are removed."""
        held: set[str] = set()
        for path in (self.root / _HOLDS).glob("*.hold"):
            lock = FileLock(f"{path}.lock")
            try:
                lock.acquire(blocking=False)
            except (Timeout, OSError, NotImplementedError):  # or nobody can tell: then it counts
                with contextlib.suppress(OSError):
                    held.update(path.read_text().split())
                continue
            path.unlink(missing_ok=True)
            lock.release()
            Path(lock.lock_file).unlink(missing_ok=True)
        return held


def _touch(path: Path) -> bool:
    """Marks a file as used now; false when it is not there. Where that is not allowed, what is there can be read."""
    try:
        os.utime(path)
    except FileNotFoundError:
        return False
    except OSError:
        return path.exists()
    return True


def _entries(folder: Path | str) -> list[os.DirEntry[str]]:
    """What is in a folder; nothing where it is not there, or not ours to read."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        return list(entries)
    return []
