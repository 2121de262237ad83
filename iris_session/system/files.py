"""Files that are replaced as a whole: a reader, or a crash at any time, finds the old content or the new one."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self


class Replacement:
    """New content of a file, in a temporary file beside it (mode 0600) under a name that cannot be guessed.

        with Replacement(path, durable=True) as replacement:
            replacement.file.write(data)

    Leaving the context commits unless `commit` or `discard` was called, and discards after an error. A link at `path`
    is replaced, not followed.

    Args:
        path: The file to replace, in an existing folder.
        durable: The new content and its name survive a power cut once `commit` has returned.
        permissions: Mode of the new file; `None` takes that of ordinary new files (0666 less the umask).
        suffix: Ending of the temporary name, for folders whose owner recognises leftovers by it.
    """

    def __init__(self, path: Path, *, durable: bool = False, permissions: int | None = 0o600, suffix: str = "") -> None:
        self.path = path
        self._durable = durable
        # The umask belongs to all threads, so the system applies it: it is not read by changing it for a moment.
        mode = 0o666 if permissions is None else 0o600
        #: Where the new content is until `commit`, for libraries that write to a path.
        self.temporary: Path
        descriptor, self.temporary = _create_file(path.parent, f".{path.name[:100]}-", suffix, mode)
        self._is_pending = True
        self.file: BinaryIO = os.fdopen(descriptor, "wb")
        if permissions is not None and permissions != 0o600:
            try:
                os.chmod(self.temporary, permissions)
            except BaseException:
                self.discard()
                raise

    def finish(self) -> None:
        """Write everything to the temporary file; with `durable`, to the disk. `commit` does it too."""
        if not self.file.closed:
            self.file.flush()
            if self._durable:
                os.fsync(self.file.fileno())
            self.file.close()

    def commit(self) -> None:
        """Replace the file with what was written. Of a durable file: wait until the folder is on the disk, too."""
        try:
            self.finish()
            os.replace(self.temporary, self.path)
            self._is_pending = False
        except BaseException:
            self.discard()
            raise
        if self._durable:
            sync_folder(self.path.parent)

    def discard(self) -> None:
        """Remove the temporary file; the old content stays."""
        self._is_pending = False
        with suppress(OSError):
            self.file.close()
        self.temporary.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._is_pending:
            return
        if error is None:
            self.commit()
        else:
            self.discard()


def write_atomic(
    path: Path,
    data: bytes | bytearray | memoryview,
    *,
    durable: bool = False,
    permissions: int | None = 0o600,
    suffix: str = "",
) -> None:
    """Replace the content of a file in one step; see `Replacement` for the arguments. Raises `OSError`."""
    with Replacement(path, durable=durable, permissions=permissions, suffix=suffix) as replacement:
        replacement.file.write(data)


def write_output(path: Path, data: bytes) -> None:
    """Write a file that a person named, completely or not at all. A link remains a link; a pipe or a device is written
    as it is. Raises `OSError`.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():  # opening a folder raises
        target.write_bytes(data)
    else:
        write_atomic(target, data, permissions=None)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable: else a power cut may bring back a file that was replaced."""
    if os.name != "posix":
        return  # folders cannot be opened there
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    except OSError:  # some network folders do not support it; the file itself is written
        pass
    finally:
        os.close(descriptor)


def _create_file(folder: Path, prefix: str, suffix: str, mode: int) -> tuple[int, Path]:
    """Create a file under a name that cannot be guessed, with `mode` less the umask. Return its descriptor and path."""
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL
    flags |= getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
    while True:
        path = folder / f"{prefix}{os.urandom(8).hex()}{suffix}"
        with suppress(FileExistsError):
            return os.open(path, flags, mode), path
