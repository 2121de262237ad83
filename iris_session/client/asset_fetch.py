"""What somebody asked for with `Client.fetch_assets`, and how far it is."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from iris_session.assets.cache import AssetCache
from iris_session.client.asset_workers import Decode
from iris_session.client.errors import AssetError


class AssetFetch:
    """Assets in the order in which they are wanted. `pending`: still to come; `failed`: will not come, and why.

    `decoded`: what `decode` made of each. `bytes_total`: of all assets, as far as their sizes are known; `bytes_done`:
    of those, that are here; `bytes_received`: of those, that came over the network. `cached`: assets that were here.
    `put_off`: why the session does not answer requests yet, in its words; empty while it does.
    """

    def __init__(
        self,
        cache: AssetCache,
        addresses: Iterable[str],
        sizes: Mapping[str, int],
        on_progress: Callable[[AssetFetch], None] | None,
        decode: Decode | None,
    ) -> None:
        self.addresses = tuple(dict.fromkeys(addresses))
        self.on_progress = on_progress
        self.decode = decode
        self.pending = dict.fromkeys(self.addresses)
        self.failed: dict[str, AssetError] = {}
        self.decoded: dict[str, Any] = {}
        self.refusal = ""
        self.bytes_received = 0
        self.cached = 0
        self._cache = cache
        self._sizes = {address: sizes[address] for address in self.addresses if address in sizes}
        self._done: dict[str, int] = {}

    @property
    def done(self) -> bool:
        """Nothing is to come any more; look at `failed`."""
        return not self.pending

    @property
    def bytes_done(self) -> int:
        return sum(self._done.values())

    @property
    def bytes_total(self) -> int:
        return sum(self._sizes.values())

    def read(self, address: str) -> bytes:
        """The bytes of an asset that is here. Raises its `AssetError` when it is not."""
        self._check_here(address)
        return self._cache.read(address)

    def view(self, address: str) -> memoryview:
        """As `read`, mapped instead of copied: whoever refuses it, for its size or its beginning, has not read it."""
        self._check_here(address)
        return self._cache.view(address)

    def check(self) -> None:
        """Raises the first `AssetError`, if there is one."""
        for error in self.failed.values():
            raise error

    def _check_here(self, address: str) -> None:
        if address in self.failed:
            raise self.failed[address]
        if address in self.pending:
            raise AssetError(address, "gone", f"asset {address} has not come yet")

    # --- for the client ----------------------------------------------------------------------------------------------

    def on_bytes(self, address: str, size: int, total: int, received: int = 0) -> None:
        """So many bytes of an asset are here."""
        if address in self.pending:
            self._done[address], self._sizes[address] = size, total
            self.bytes_received += received

    def on_found(self, address: str, size: int, decoded: Sequence[tuple[Decode, Any]], *, fetched: bool) -> None:
        """An asset is here; what functions made of it. Still pending, if ours was not among them."""
        if address not in self.pending:
            return
        value: Any = None
        if self.decode is not None:
            found = [made for decode, made in decoded if decode == self.decode]
            if not found:
                return
            value = found[0]
        if isinstance(value, AssetError):
            self.fail(address, value)
            return
        self._done[address] = self._sizes[address] = size
        self.cached += not fetched
        if self.decode is not None:
            self.decoded[address] = value
        del self.pending[address]

    def fail(self, address: str, error: AssetError) -> None:
        """An asset will not come."""
        if address in self.pending:
            del self.pending[address]
            self.failed[address] = error
