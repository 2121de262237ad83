"""Fixtures of the scene tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from iris_session.scene import AssetStore


@pytest.fixture
def store(tmp_path: Path) -> AssetStore:
    """An empty store of assets."""
    return AssetStore(tmp_path / "store")
