"""Assets on this machine's disk, by the SHA-256 of their bytes: kept across sessions, shared by all processes.

Layout: `FOLDER/ab/abcd...`, and `abcd....part` beside it while bytes of it come. A file has its final name only once
its bytes have been hashed, so no session can put others under a name; a part that was left goes on where it ends, and
is thrown away when what it becomes has another hash. Who writes a part holds a lock of the system on it; another
process that fetches the same asset meanwhile writes one of its own.
"""

from __future__ import annotations

import contextlib
import hashlib
import mmap
import os
import threading
import time
from pathlib import Path
from typing import Final

from iris_session.client.errors import AssetError
from iris_session.protocol.assets import is_address

try:
    import fcntl
except ImportError:  # a system without such locks: every process writes parts of its own
    fcntl = None  # type: ignore[assignment]

DEFAULT_MAX_BYTES: Final = 4 << 30
#: What was used so lately is not taken away. Where that alone is twice what the cache may hold, nothing more is stored.
IN_USE_S: Final = 600.0
FULL: Final = 2
#: A part that nobody has written to for so long is of no use. A private one is of none once its process has ended.
STALE_PART_S: Final = 7 * 86_400.0
#: The folder is looked through after so many bytes were stored.
TRIM_EVERY: Final = 64 << 20
PART: Final = ".part"
ADDRESS_DIGITS: Final = 64
#: What to do when the folder cannot be used, for error texts.
ANOTHER: Final = "name another folder: client.assets.cache = AssetCache(folder), or set XDG_CACHE_HOME"


def default_folder() -> Path:
    """`$XDG_CACHE_HOME/iris-session/client-assets`, by default below `~/.cache`."""
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "iris-session" / "client-assets"


class AssetCache:
    """A folder, made when something is first stored. Any thread may use it; raises `AssetError` when it cannot be used.

    Above `max_bytes` the assets that were used longest ago are taken away; twice as many are never stored.
    """

    def __init__(self, folder: str | os.PathLike[str] | None = None, max_bytes: int = DEFAULT_MAX_BYTES) -> None:
        self.folder = default_folder() if folder is None else Path(folder)
        self.max_bytes = max_bytes
        self._lock = threading.Lock()  # of the three below
        self._trimming = False
        self._unlooked = TRIM_EVERY  # so the first that is stored looks through what is there
        self._held = 0

    def path(self, address: str) -> Path:
        """Where an asset lies, or would. Raises `ValueError` for what is no address."""
        if not is_address(address):
            raise ValueError(f"{address[:80]!r} is no address of an asset: 64 digits 0-9, a-f")
        return self.folder / address[:2] / address

    def find(self, address: str) -> memoryview | None:
        """An asset that is here, mapped and hashed; `None` when it is not. A damaged one is taken away."""
        path = self.path(address)
        try:
            view, status = _mapped(path)
            if hashlib.sha256(view).hexdigest() == address:
                os.utime(path)
                return view
            if os.path.samestat(status, os.stat(path)):  # nobody has put a good one there meanwhile
                path.unlink(missing_ok=True)
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise _unusable(self.folder, error) from error
        return None

    def read(self, address: str) -> bytes:
        """The bytes of an asset that `find` found, or that was stored. Raises `AssetError` when they are gone."""
        return bytes(self.view(address))

    def view(self, address: str) -> memoryview:
        """As `read`, mapped instead of copied."""
        try:
            return _mapped(self.path(address))[0]
        except OSError as error:
            raise AssetError(address, "gone", f"asset {address} is not in {self.folder}: fetch it again") from error

    def begin(self, address: str) -> Part:
        """The part of an asset that is here already, to be gone on with. Raises `AssetError`."""
        path = self.path(address)
        try:
            try:
                return Part(self, address, *_open_part(path))
            except FileNotFoundError:  # the first asset that begins like this
                path.parent.mkdir(parents=True, exist_ok=True)
                return Part(self, address, *_open_part(path))
        except OSError as error:
            raise _unusable(self.folder, error) from error

    def stored(self, size: int) -> None:
        """So many bytes were written: makes room now and then. Raises `AssetError` when there is none."""
        most = FULL * self.max_bytes
        with self._lock:
            self._unlooked += size
            self._held += size
            look = not self._trimming and (self._unlooked >= TRIM_EVERY or self._held > most)
            if look:
                self._trimming, self._unlooked = True, 0
        if look:
            held = self.trim()
            with self._lock:
                self._trimming, self._held = False, held + self._unlooked
        if self._held > most:
            text = f"the cache of assets {self.folder} is full: {self._held >> 20} MiB were used in the last minutes"
            more = f"or allow more than {self.max_bytes >> 20} MiB: AssetCache(max_bytes=...)"
            raise AssetError("", "cache", f"{text}; {ANOTHER}, {more}")

    def trim(self) -> int:
        """Takes away what is too much, the longest unused first. The bytes that stay."""
        now = time.time()
        found: list[tuple[float, int, Path]] = []
        for path in self.folder.glob("??/*"):
            with contextlib.suppress(OSError):
                status = path.stat()
                found.append((status.st_mtime, status.st_size, path))
        total = sum(size for _, size, _ in found)
        for used, size, path in sorted(found):
            private = path.name.endswith(PART) and len(path.name) > ADDRESS_DIGITS + len(PART)
            stale = path.name.endswith(PART) and now - used > (IN_USE_S if private else STALE_PART_S)
            if not stale and (total <= self.max_bytes or now - used < IN_USE_S):
                continue
            with contextlib.suppress(OSError):
                if not (path.name.endswith(PART) and _is_written(path)):
                    path.unlink()
                    total -= size
        return total


class Part:
    """What has come of one asset so far; belongs to one thread. `offset`: bytes that are here."""

    def __init__(self, cache: AssetCache, address: str, path: Path, descriptor: int) -> None:
        self._cache = cache
        self._address = address
        self._path = path
        self._file = os.fdopen(descriptor, "r+b", buffering=0)
        self._hash = hashlib.sha256()
        self.offset = 0
        if os.fstat(descriptor).st_size:
            while block := self._file.read(1 << 20):
                self._hash.update(block)
                self.offset += len(block)

    def append(self, data: bytes | memoryview) -> None:
        """The next bytes. Raises `AssetError` when they cannot be written."""
        rest = memoryview(data)
        while rest:
            try:
                written = self._file.write(rest)
            except OSError as error:
                raise _unusable(self._cache.folder, error) from error
            self._hash.update(rest[:written])
            self.offset += written
            rest = rest[written:]
        self._cache.stored(len(data))

    def finish(self) -> bool:
        """Stores what is here as the asset. False when these are not its bytes: it begins anew then."""
        if self._hash.hexdigest() != self._address:
            self.restart()
            return False
        try:
            os.replace(self._path, self._cache.path(self._address))
            self._file.close()
        except OSError as error:
            raise _unusable(self._cache.folder, error) from error
        return True

    def restart(self) -> None:
        """Throws away what is here."""
        try:
            self._file.seek(0)
            self._file.truncate()
        except OSError as error:
            raise _unusable(self._cache.folder, error) from error
        self._hash = hashlib.sha256()
        self.offset = 0

    def close(self) -> None:
        """Leaves what is here for another time; a private part, or one without bytes, is of no use then."""
        if not self.offset or self._path.name != self._address + PART:
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)
        self._file.close()


def _mapped(path: Path) -> tuple[memoryview, os.stat_result]:
    """The bytes of a file without copying them: other processes that read it share the pages."""
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0))
    try:
        status = os.fstat(descriptor)
        size = status.st_size
        mapped = memoryview(mmap.mmap(descriptor, size, access=mmap.ACCESS_READ) if size else b"")
        return mapped, status
    finally:
        os.close(descriptor)


def _open_part(path: Path) -> tuple[Path, int]:
    """A part that nobody else writes: the common one, or else one of our own. Raises `OSError`."""
    common = path.with_name(path.name + PART)
    if fcntl is not None:
        descriptor = -1
        try:
            descriptor = os.open(common, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # It may have been finished, and so renamed, between opening and locking.
            if os.path.samestat(os.fstat(descriptor), os.stat(common)):
                return common, descriptor
        except FileNotFoundError:
            if descriptor < 0:
                raise  # there is no such folder
        except OSError:
            pass  # somebody else's, or a file system without locks
        if descriptor >= 0:
            os.close(descriptor)
    own = path.with_name(f"{path.name}.{os.getpid()}-{os.urandom(4).hex()}{PART}")
    descriptor = os.open(own, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o600)
    if fcntl is not None:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return own, descriptor


def _is_written(path: Path) -> bool:
    """Whether somebody holds the lock of a part. Raises `OSError`."""
    written = False
    if fcntl is not None:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            written = True
        finally:
            os.close(descriptor)
    return written


def _unusable(folder: Path, error: OSError | ValueError) -> AssetError:
    why = getattr(error, "strerror", None) or error
    return AssetError("", "cache", f"the cache of assets {folder} cannot be used: {why}; {ANOTHER}")
