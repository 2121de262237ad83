"""`AssetStore`: assets as files below one folder, named by the SHA-256 of their bytes. Sessions and clients use it.

Layout below the root, where `<hash>` and `<key>` are 64 lower-case hex digits:

    <hash[:2]>/<hash>               an asset; the name is given only after its bytes were hashed, and it never changes
    <hash[:2]>/<hash>.part          a partial download, locked while it is written; the next download resumes it
    <hash[:2]>/<hash>.<word>.part   a file that one process writes; nothing resumes it
    index/<key[:2]>/<key>           what was built from the raw content with this key (`scene.asset_builder`)
    holds/                          addresses that running processes hold

Any number of processes and threads may share a folder. Above `max_bytes` the files that were used longest ago are
removed, but none that a process holds and none used within `GRACE_S`. Other files below the root are never touched.
A symbolic link, or anything else that is no regular file, counts as a missing file and is never followed: another user
may have put it there.

Sessions and clients have separate default folders. Nothing but verified content could get from a client into the
folder of a session, so they may share one (`client.assets.cache = AssetStore()`), and an asset then lies on disk once.
It is not the default because a hostile session that a client joins could fill the shared folder, so that assets this
machine's own session does not hold at the moment are removed and have to be built again, and could find out which
assets are there by watching what the client does not fetch.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import mmap
import os
import re
import stat
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO, Final

from filelock import FileLock, Timeout

from iris_session.assets.errors import AssetMissingError, AssetStoreError
from iris_session.protocol.assets import is_address

try:
    import fcntl
except ImportError:  # a system without these locks: every process writes parts of its own
    fcntl = None  # type: ignore[assignment]

DEFAULT_MAX_BYTES: Final = 4 << 30
#: A file used this short ago [s] stays: another process may be about to hold it.
GRACE_S: Final = 600.0
#: Downloads beyond this multiple of `max_bytes` are refused: a session cannot fill the disk by naming ever more assets.
MAX_OVERFILL: Final = 2
#: A resumable part that was not written for so long [s] is removed. Others are removed after `GRACE_S`.
STALE_PART_S: Final = 7 * 86_400.0
#: The folder is scanned after so many bytes were written, since other processes write to it too.
SCAN_EVERY_BYTES: Final = 64 << 20
#: Files that `ServedAssets` maps at once. Chunks on their way to a reader keep their file mapped until they have left.
MAX_MAPPED_FILES: Final = 256

_PART: Final = re.compile(r"([0-9a-f]{64})(\.\w[\w-]*)?\.part")
#: Neither a link nor a pipe that another user put into the folder may be followed or waited for.
_OPEN_FLAGS: Final = (
    getattr(os, "O_CLOEXEC", 0)
    | getattr(os, "O_BINARY", 0)
    | getattr(os, "O_NOFOLLOW", 0)
    | getattr(os, "O_NONBLOCK", 0)
)
#: Systems that set the times of links only through them.
_FOLLOW_SYMLINKS: Final = os.utime not in os.supports_follow_symlinks
_INDEX: Final = "index"
_HOLDS: Final = "holds"
_ADVICE: Final = "use another folder (client.assets.cache = AssetStore(folder)), or set XDG_CACHE_HOME"


def default_root(name: str = "assets") -> Path:
    """Return `$XDG_CACHE_HOME/iris-session/<name>`, by default below `~/.cache`.

    Args:
        name: "assets" for sessions, "client-assets" for clients.

    Raises:
        OSError: This user has no home folder.
    """
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        return Path(base).expanduser() / "iris-session" / name
    except RuntimeError:  # a user without an entry, as in containers
        raise OSError(errno.ENOENT, "this user has no home folder: set XDG_CACHE_HOME, or name a folder") from None


class Hold:
    """Assets that stay in the store until `release`, or until this process ends, however it ends."""

    def __init__(self, folder: Path, addresses: Iterable[str]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=folder, suffix=".new")
        self._path = Path(f"{name}.hold")
        self._lock = FileLock(f"{self._path}.lock", thread_local=False)  # another thread may release it
        try:
            with os.fdopen(handle, "w") as file:
                file.write("\n".join(sorted(set(addresses))))
            self._lock.acquire()
            os.replace(name, self._path)  # from the moment others can see it, it is complete and locked
        except BaseException as error:
            Path(name).unlink(missing_ok=True)
            self.release()
            if isinstance(error, NotImplementedError):  # raised by filelock on some file systems
                raise OSError(errno.ENOLCK, f"{folder} is on a file system without locks") from error
            raise

    def release(self) -> None:
        """Allow the store to remove these assets again."""
        self._path.unlink(missing_ok=True)
        self._lock.release()
        Path(self._lock.lock_file).unlink(missing_ok=True)

    def __enter__(self) -> Hold:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


class AssetStore:
    """Folder of assets by content hash, created with the first write. Safe for several threads and processes.

    Attributes:
        root: The folder.
        max_bytes: Size above which the least recently used files are removed [bytes].
        evicted: Number of files that this object removed to make room.
    """

    def __init__(self, root: str | os.PathLike[str] | None = None, max_bytes: int = DEFAULT_MAX_BYTES) -> None:
        """Name the folder; nothing is read or written yet.

        Args:
            root: The folder; by default `~/.cache/iris-session/assets`.
            max_bytes: Size of the store [bytes].
        """
        self.root = Path(root) if root is not None else default_root()
        self.max_bytes = max_bytes
        self.evicted = 0
        self._lock = threading.Lock()  # of the three below
        self._total = 0
        self._scan_above = -(1 << 62)  # the first write scans the folder, also after a `discard`
        self._unscanned = 0
        self._is_scanning = False

    # --- reading ------------------------------------------------------------------------------------------------------

    def path(self, address: str) -> Path:
        """Build the path of an asset, present or not.

        Args:
            address: Content hash, 64 lower-case hex digits.

        Returns:
            The path.

        Raises:
            ValueError: `address` is not 64 lower-case hex digits.
        """
        if not is_address(address):
            raise ValueError(f"{address[:80]!r} is no address of an asset: expected 64 digits 0-9, a-f")
        return self.root / address[:2] / address

    def __contains__(self, address: object) -> bool:
        return isinstance(address, str) and is_address(address) and _find_status(self.path(address)) is not None

    def get(self, address: str) -> bytes:
        """Read an asset, check its hash, and mark it as used. A damaged file is removed.

        Args:
            address: Content hash, 64 lower-case hex digits.

        Returns:
            Its bytes.

        Raises:
            AssetMissingError: The store does not have it, or its file was damaged.
            AssetStoreError: The folder cannot be used.
        """
        view = self.find(address)
        if view is None:
            raise self._missing_error(address)
        return bytes(view)

    def find(self, address: str) -> memoryview | None:
        """Find an asset, check its hash, and mark it as used. A damaged file is removed.

        Args:
            address: Content hash, 64 lower-case hex digits.

        Returns:
            Its bytes, mapped; `None` without it.

        Raises:
            AssetStoreError: The folder cannot be used.
        """
        try:
            view = self._read_verified(address)
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise self._unusable_error(error) from error
        if view is not None:
            _touch(self.path(address))
        return view

    def view(self, address: str) -> memoryview:
        """Map an asset, without checking its hash again.

        Args:
            address: Content hash, 64 lower-case hex digits.

        Returns:
            Its bytes.

        Raises:
            AssetMissingError: The store does not have it.
        """
        try:
            return map_file(self.path(address))[0]
        except OSError as error:
            raise self._missing_error(address) from error

    def open_file(self, address: str) -> tuple[BinaryIO, int]:
        """Open an asset to be read in pieces, without checking its hash.

        Args:
            address: Content hash, 64 lower-case hex digits.

        Returns:
            Its file, to be closed by the caller, and its size [bytes].

        Raises:
            OSError: The store does not have it, or its file cannot be read.
            ValueError: `address` is not 64 lower-case hex digits.
        """
        descriptor, status = _open_regular_file(self.path(address))
        return os.fdopen(descriptor, "rb"), status.st_size

    # --- writing ------------------------------------------------------------------------------------------------------

    def put(self, data: bytes | bytearray | memoryview) -> str:
        """Store bytes. Costs one hash when the store has them already.

        Args:
            data: The bytes.

        Returns:
            Their address.

        Raises:
            OSError: The folder cannot be written.
        """
        view = memoryview(data).cast("B")
        address = hashlib.sha256(view).hexdigest()
        if not self.mark_used(address, len(view)):
            self._write(self.path(address), view)
        return address

    def open_part(self, address: str) -> AssetPart:
        """Open a part of an asset to write to; it may have bytes of an earlier download.

        Args:
            address: Content hash, 64 lower-case hex digits.

        Returns:
            The part.

        Raises:
            AssetStoreError: The folder cannot be used.
        """
        path = self.path(address)
        try:
            try:
                return AssetPart(self, address, *_open_part_file(path))
            except FileNotFoundError:  # the first asset that begins with these digits
                path.parent.mkdir(parents=True, exist_ok=True)
                return AssetPart(self, address, *_open_part_file(path))
        except OSError as error:
            raise self._unusable_error(error) from error

    def read_index(self, key: str) -> bytes | None:
        """Read a note and mark it as used.

        Args:
            key: A SHA-256 in hex.

        Returns:
            The note stored under `key`, `None` without one.
        """
        path = self._index_path(key)
        try:
            note = bytes(map_file(path)[0])
        except OSError:
            return None
        _touch(path)
        return note

    def write_index(self, key: str, note: bytes) -> None:
        """Store a note.

        Args:
            key: A SHA-256 in hex.
            note: Bytes to be read by `read_index`.

        Raises:
            OSError: The folder cannot be written.
        """
        self._write(self._index_path(key), note)

    # --- use and removal ----------------------------------------------------------------------------------------------

    def hold(self, addresses: Iterable[str]) -> Hold:
        """Keep assets from being removed by any process, for as long as a scene is shared.

        Args:
            addresses: Content hashes of the assets.

        Returns:
            The hold, to be released; it ends with this process at the latest.

        Raises:
            OSError: The folder cannot be written, or its file system has no locks.
        """
        return Hold(self.root / _HOLDS, addresses)

    def mark_used(self, address: str, size: int) -> bool:
        """Mark an asset as used now.

        Args:
            address: Content hash.
            size: Its size [bytes].

        Returns:
            False without it, and when it has another size: a crash truncated it.
        """
        path = self.path(address)
        status = _find_status(path)
        return status is not None and status.st_size == size and _touch(path)

    def last_used_ns(self, address: str) -> int:
        """Look up when an asset was last used, for `discard`.

        Args:
            address: Content hash.

        Returns:
            The time [ns since 1970], 0 without it.
        """
        status = _find_status(self.path(address))
        return 0 if status is None else status.st_mtime_ns

    def discard(self, address: str, last_used_ns: int) -> bool:
        """Remove an asset that is of no more use.

        Args:
            address: Content hash.
            last_used_ns: When it was last used, as far as the caller knows.

        Returns:
            False: it stays, because a process holds it or has used it after `last_used_ns`.
        """
        path = self.path(address)
        status = _find_status(path)
        if status is not None and status.st_mtime_ns == last_used_ns and address not in self._read_holds():
            with contextlib.suppress(OSError):
                path.unlink()
                self._uncount(status.st_size)
                return True
        return False

    def trim(self) -> int:
        """Remove stale parts, and files beyond `max_bytes`.

        Returns:
            Size of the files that remain [bytes].
        """
        self._scan(0)
        with self._lock:
            return self._total

    def reserve(self, n_bytes: int) -> None:
        """Make room for a download, which has its bytes written to an `AssetPart` next.

        Args:
            n_bytes: Number of bytes.

        Raises:
            AssetStoreError: `MAX_OVERFILL * max_bytes` are in use already.
        """
        limit = MAX_OVERFILL * self.max_bytes
        if not self._make_room(n_bytes) and self._total > limit:
            self._scan(n_bytes)  # files may have been removed, or aged, since the last scan
        with self._lock:
            if self._total > limit:
                self._total -= n_bytes
                raise AssetStoreError(
                    f"asset store {self.root} is full: {self._total >> 20} MiB were used in the last minutes; "
                    f"{_ADVICE}, or allow more than {self.max_bytes >> 20} MiB: AssetStore(max_bytes=...)"
                )

    # --- inside -------------------------------------------------------------------------------------------------------

    def _missing_error(self, address: str) -> AssetMissingError:
        return AssetMissingError(f"asset {address} is not in {self.root}: build the scene or fetch it again", address)

    def _unusable_error(self, error: OSError | ValueError) -> AssetStoreError:
        reason = getattr(error, "strerror", None) or error
        return AssetStoreError(f"asset store {self.root} cannot be used: {reason}; {_ADVICE}")

    def _read_verified(self, address: str) -> memoryview | None:
        """Return the bytes of an asset; remove its file and return `None` when they have another hash."""
        path = self.path(address)
        view, status = map_file(path)
        if hashlib.sha256(view).hexdigest() == address:
            return view
        with contextlib.suppress(OSError):  # a disk that cannot be written
            if os.path.samestat(status, os.stat(path, follow_symlinks=False)):  # not replaced by a good one meanwhile
                path.unlink()
                self._uncount(status.st_size)
        return None

    def _index_path(self, key: str) -> Path:
        if not is_address(key):
            raise ValueError(f"{key[:80]!r} is no key: expected 64 digits 0-9, a-f")
        return self.root / _INDEX / key[:2] / key

    def _write(self, path: Path, data: bytes | bytearray | memoryview) -> None:
        self._make_room(len(data))
        name = ""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(dir=path.parent, prefix=f"{path.name}.", suffix=".part")
            with os.fdopen(handle, "wb") as file:
                file.write(data)
            os.replace(name, path)
        except BaseException:
            self._uncount(len(data))
            if name:
                Path(name).unlink(missing_ok=True)
            raise

    def _make_room(self, n_bytes: int) -> bool:
        """Count `n_bytes` as stored, and scan the folder when it may be too full. Return whether it was scanned.

        Where everything is in use, only every 64th part of `max_bytes` that is written causes a scan.
        """
        with self._lock:
            self._total += n_bytes
            self._unscanned += n_bytes
            full = self._total > self._scan_above or self._unscanned >= SCAN_EVERY_BYTES
            if not full or self._is_scanning:
                return False
            self._is_scanning = True
        try:
            self._scan(n_bytes)
        finally:
            self._is_scanning = False
        return True

    def _uncount(self, n_bytes: int) -> None:
        """Count `n_bytes` as no longer stored: they were removed, or could not be written."""
        with self._lock:
            self._total = max(0, self._total - n_bytes)

    def _scan(self, n_bytes: int) -> None:
        """Remove what processes left half-made, then the files used longest ago until `n_bytes` more fit.

        The lock is not held meanwhile: a large folder takes a while, and other threads go on writing.
        """
        unscanned = self._unscanned
        held, now = self._read_holds(), time.time()
        files: list[tuple[float, int, os.DirEntry[str]]] = []
        for entry, status in self._iterate_files():
            age_s = now - status.st_mtime
            part = _PART.fullmatch(entry.name)
            if part and age_s > (GRACE_S if part[2] else STALE_PART_S) and _remove_part(entry.path):
                continue
            files.append((status.st_mtime, status.st_size, entry))
        total = n_bytes + sum(size for _, size, _ in files)
        for used, size, entry in sorted(files, key=lambda item: item[0]):
            if total <= self.max_bytes or now - used < GRACE_S:
                break
            if entry.name in held:
                continue
            with contextlib.suppress(OSError):
                if os.stat(entry.path, follow_symlinks=False).st_mtime != used:  # used meanwhile
                    continue
                if is_address(entry.name):
                    os.unlink(entry.path)
                elif not _remove_part(entry.path):
                    continue
                total -= size
                self.evicted += 1
        with self._lock:
            self._unscanned = max(0, self._unscanned - unscanned)  # written by others during the scan
            self._total = total + self._unscanned
            self._scan_above = max(self.max_bytes, total + self.max_bytes // 64)

    def _iterate_files(self) -> Iterator[tuple[os.DirEntry[str], os.stat_result]]:
        """Yield the files of assets, of the index, and parts. No holds, and no files of others."""
        for folder in (self.root, self.root / _INDEX):
            for sub in _list_entries(folder):
                if len(sub.name) == 2 and sub.is_dir(follow_symlinks=False):
                    for entry in _list_entries(sub.path):
                        ours = is_address(entry.name) or _PART.fullmatch(entry.name)
                        if ours and entry.name[:2] == sub.name and entry.is_file(follow_symlinks=False):
                            with contextlib.suppress(FileNotFoundError):  # removed by another process meanwhile
                                yield entry, entry.stat(follow_symlinks=False)

    def _read_holds(self) -> set[str]:
        """Return addresses that a living process holds. Notes of dead processes are removed."""
        held: set[str] = set()
        for path in (self.root / _HOLDS).glob("*.hold"):
            lock = FileLock(f"{path}.lock")
            try:
                lock.acquire(blocking=False)
            except (Timeout, OSError, NotImplementedError):  # held, or unknown: then it counts as held
                with contextlib.suppress(OSError):
                    held.update(path.read_text().split())
                continue
            with contextlib.suppress(OSError):  # a folder that this user may only read
                path.unlink(missing_ok=True)
            lock.release()
            with contextlib.suppress(OSError):
                Path(lock.lock_file).unlink(missing_ok=True)
        return held


class AssetPart:
    """The bytes of one asset that have come so far. Belongs to one thread.

    Attributes:
        offset: Number of bytes present.
    """

    def __init__(self, store: AssetStore, address: str, path: Path, descriptor: int) -> None:
        self._store = store
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
        """Write the next bytes.

        Raises:
            AssetStoreError: They cannot be written, or the store is full.
        """
        self._store.reserve(len(data))
        rest = memoryview(data)
        while rest:
            try:
                written = self._file.write(rest)
            except OSError as error:
                self._store._uncount(len(rest))
                raise self._store._unusable_error(error) from error
            self._hash.update(rest[:written])
            self.offset += written
            rest = rest[written:]

    def finish(self) -> bool:
        """Give the asset its name. False when the bytes have another hash: they are thrown away.

        Raises:
            AssetStoreError: The folder cannot be used.
        """
        if self._hash.hexdigest() != self._address:
            self.restart()
            return False
        try:
            os.replace(self._path, self._store.path(self._address))
            self._file.close()
        except OSError as error:
            raise self._store._unusable_error(error) from error
        return True

    def restart(self) -> None:
        """Throw away the bytes that are present.

        Raises:
            AssetStoreError: The folder cannot be used.
        """
        try:
            self._file.seek(0)
            self._file.truncate()
        except OSError as error:
            raise self._store._unusable_error(error) from error
        self._store._uncount(self.offset)
        self._hash = hashlib.sha256()
        self.offset = 0

    def close(self) -> None:
        """Keep a resumable part for the next download; remove an empty one, and one that cannot be resumed."""
        if not self.offset or self._path.name != f"{self._address}.part":
            with contextlib.suppress(OSError):
                self._path.unlink()  # raises for one that was finished
                self._store._uncount(self.offset)
        self._file.close()


class ServedAssets:
    """Assets that a session serves, mapped: every reader is sent the same pages. Belongs to one thread.

    Assets are looked up in a table by address: no path is ever made of what a client sends.
    """

    def __init__(self) -> None:
        self._roots: dict[str, str] = {}
        self._mapped: dict[str, memoryview] = {}

    def serve(self, stores: Iterable[tuple[str, Iterable[str]]]) -> None:
        """Serve these assets and no others from now on.

        Args:
            stores: Roots of stores, with addresses in each.
        """
        self._roots = {address: root for root, addresses in stores for address in addresses if is_address(address)}
        for address in [address for address in self._mapped if address not in self._roots]:
            del self._mapped[address]

    def size(self, address: str) -> int | None:
        """Return the size of an asset [bytes]; `None` when it is not served, or its file cannot be read."""
        view = self._view(address)
        return None if view is None else len(view)

    def chunk(self, address: str, offset: int, length: int) -> memoryview | None:
        """Return bytes of an asset; `None` as in `size`, or when it ends before `offset + length`."""
        view = self._view(address)
        return None if view is None or offset + length > len(view) else view[offset : offset + length]

    def _view(self, address: str) -> memoryview | None:
        view = self._mapped.get(address)
        if view is not None:
            return view
        root = self._roots.get(address)
        if root is None:
            return None
        try:
            view, _ = map_file(Path(root) / address[:2] / address)
        except OSError:
            return None
        while len(self._mapped) >= MAX_MAPPED_FILES:
            del self._mapped[next(iter(self._mapped))]
        self._mapped[address] = view
        return view


def map_file(path: Path) -> tuple[memoryview, os.stat_result]:
    """Return the bytes of a file, mapped, and its status. Processes that map the same file share its pages.

    Raises:
        FileNotFoundError: It is missing, or no regular file.
        OSError: It cannot be read.
    """
    descriptor, status = _open_regular_file(path)
    try:
        size = status.st_size
        return memoryview(mmap.mmap(descriptor, size, access=mmap.ACCESS_READ) if size else b""), status
    finally:
        os.close(descriptor)


def _open_regular_file(path: Path) -> tuple[int, os.stat_result]:
    """Open a file to be read. Return descriptor and status. Raises as `map_file`."""
    try:
        descriptor = os.open(path, os.O_RDONLY | _OPEN_FLAGS)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _not_regular_error(path) from error
        raise
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode):
        os.close(descriptor)
        raise _not_regular_error(path)
    return descriptor, status


def _not_regular_error(path: Path) -> FileNotFoundError:
    return FileNotFoundError(errno.ENOENT, "a link, or no regular file", str(path))


def _find_status(path: Path) -> os.stat_result | None:
    """Return the status of a regular file; `None` when it is missing, a link, or anything else."""
    try:
        status = os.stat(path, follow_symlinks=False)
    except OSError:
        return None
    return status if stat.S_ISREG(status.st_mode) else None


def _open_part_file(path: Path) -> tuple[Path, int]:
    """Open a part that no other process writes: the resumable one, or else a new one. Raises `OSError`."""
    resumable = path.with_name(f"{path.name}.part")
    if fcntl is not None:
        descriptor = -1
        try:
            descriptor = os.open(resumable, os.O_RDWR | os.O_CREAT | _OPEN_FLAGS, 0o600)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # It may have been finished, and so renamed, between opening and locking.
            status = _find_status(resumable)
            if status is not None and os.path.samestat(os.fstat(descriptor), status):
                return resumable, descriptor
        except FileNotFoundError:
            if descriptor < 0:
                raise  # there is no such folder
        except OSError:
            pass  # written by another process, or a file system without locks
        if descriptor >= 0:
            os.close(descriptor)
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f"{path.name}.", suffix=".part")
    if fcntl is not None:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return Path(name), descriptor


def _remove_part(path: str) -> bool:
    """Remove a part unless a process holds its lock, and return whether it was removed."""
    try:
        if fcntl is not None:
            descriptor = os.open(path, os.O_RDONLY | _OPEN_FLAGS)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            finally:
                os.close(descriptor)
        os.unlink(path)
    except OSError:
        return False
    return True


def _touch(path: Path) -> bool:
    """Mark a file as used now; false without it. A file that may only be read counts as present."""
    try:
        os.utime(path, follow_symlinks=_FOLLOW_SYMLINKS)
    except FileNotFoundError:
        return False
    except OSError:
        return path.exists()
    return True


def _list_entries(folder: Path | str) -> list[os.DirEntry[str]]:
    """Return the entries of a folder; none where it is missing or may not be read."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        return list(entries)
    return []
