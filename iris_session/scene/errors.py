"""Errors of scenes. Each text says what is wrong and what would be right.

SceneBuildError           base
`-- AssetDecodeError      bytes of an asset that cannot be decoded: damaged, hostile, or made by a newer version
"""

from __future__ import annotations

from iris_session.protocol.errors import IrisError


class SceneBuildError(IrisError):
    """A scene cannot be built, read or written as asked. Base of the errors of this package."""


class AssetDecodeError(SceneBuildError):
    """The bytes are not an asset of the expected kind."""
