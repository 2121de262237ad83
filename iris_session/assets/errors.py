"""Errors of asset stores.

AssetStoreError            an `OSError`: the folder cannot be used, or is full (`reason` "cache")
`-- AssetMissingError      the store does not have the asset, or its file was damaged (`reason` "gone")
"""

from __future__ import annotations

from iris_session.protocol.errors import IrisError


class AssetStoreError(IrisError, OSError):
    """A store cannot read or keep assets.

    Attributes:
        address: Address of the asset; empty when the error concerns the whole store.
        reason: "cache" or "gone", as in the `reason` of a client's `AssetError`.
    """

    def __init__(self, message: str, address: str = "", reason: str = "cache") -> None:
        super().__init__(message)
        self.address = address
        self.reason = reason


class AssetMissingError(AssetStoreError):
    """The store does not have the asset, or removed its file because it was damaged."""

    def __init__(self, message: str, address: str) -> None:
        super().__init__(message, address, "gone")
