"""What can be wrong with assets and scenes. Each text says what would have been right.

SceneBuildError           base
|-- AssetError            bytes of an asset that cannot be decoded: damaged, hostile, or made by a newer version
`-- AssetMissingError     an asset that the store does not have
"""

from __future__ import annotations


class SceneBuildError(Exception):
    """Base of all errors of this room."""


class AssetError(SceneBuildError):
    """The bytes are no asset of the kind that was asked for."""


class AssetMissingError(SceneBuildError):
    """The store has no such asset."""
