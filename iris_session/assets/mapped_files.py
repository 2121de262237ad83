"""Assets as files, mapped into memory, so that every reader is sent the same pages and none is copied.

A file of a store is never changed: it is put there whole by a rename, and taken away by an unlink, which leaves what is
mapped as it is. Which files may be served is told by address; no path is ever made of what a client says.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from iris_session.protocol.assets import is_address

#: Files that are mapped at once. What is on its way to somebody stays mapped until it has left.
MAX_OPEN: Final = 256


class AssetFiles:
    """Looks assets up by address. Belongs to one thread."""

    def __init__(self) -> None:
        self._roots: dict[str, str] = {}
        self._mapped: dict[str, memoryview] = {}

    def serve(self, stores: Iterable[tuple[str, Iterable[str]]]) -> None:
        """What may be served from now on, and nothing else: folders of stores, and addresses in each."""
        self._roots = {address: root for root, addresses in stores for address in addresses if is_address(address)}
        for address in [address for address in self._mapped if address not in self._roots]:
            del self._mapped[address]

    def size(self, address: str) -> int | None:
        """Bytes of an asset; `None` when it is not served, or its file cannot be read."""
        view = self._view(address)
        return None if view is None else len(view)

    def chunk(self, address: str, offset: int, length: int) -> memoryview | None:
        """These bytes. `None` as in `size`, or when the asset has not so many."""
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
            view = _map(Path(root) / address[:2] / address)
        except OSError:
            return None
        while len(self._mapped) >= MAX_OPEN:
            del self._mapped[next(iter(self._mapped))]
        self._mapped[address] = view
        return view


def _map(path: Path) -> memoryview:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        size = os.fstat(descriptor).st_size
        return memoryview(mmap.mmap(descriptor, size, prot=mmap.PROT_READ)) if size else memoryview(b"")
    finally:
        os.close(descriptor)
