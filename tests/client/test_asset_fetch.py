"""What was asked for: read when it is here, and only then."""

from __future__ import annotations

import mmap
from pathlib import Path

import pytest

from iris_session.client import AssetError, AssetStore
from iris_session.client.assets import AssetFetch
from tests.assets.test_store import stored

LOST, WAITED = "0" * 64, "1" * 64


def test_what_is_here_can_be_read_or_looked_at_where_it_lies(tmp_path: Path) -> None:
    cache = AssetStore(tmp_path)
    here = stored(cache, b"bytes of an asset")
    fetch = AssetFetch(cache, [here, LOST, WAITED], {here: 17}, None, None)
    fetch.on_found(here, 17, (), fetched=True)
    fetch.fail(LOST, AssetError(LOST, "unknown", "nobody has it"))
    assert fetch.read(here) == fetch.view(here) == b"bytes of an asset"
    assert isinstance(fetch.view(here).obj, mmap.mmap), "a large one is not in memory twice"
    for look in (fetch.read, fetch.view):
        with pytest.raises(AssetError, match="nobody has it"):
            look(LOST)
        with pytest.raises(AssetError, match="has not come yet"):
            look(WAITED)
    assert not fetch.done
