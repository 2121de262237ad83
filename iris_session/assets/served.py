"""`ServedAssets`: the assets that a session gives out, mapped from its stores."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final

from iris_session.assets.store import map_file
from iris_session.protocol.assets import is_address

#: Files mapped at once. Chunks on their way to a reader keep their file mapped until they have left.
MAX_MAPPED_FILES: Final = 256


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
