"""The threads that store assets: what came and could not be stored fills the window no more."""

from __future__ import annotations

import threading
from pathlib import Path

from iris_session.client import AssetStore
from iris_session.client.asset_workers import AssetFailed, AssetMissing, AssetWorkers, BytesStored, Result
from tests.assets.test_store import ADDRESS, DATA


def test_bytes_that_cannot_be_stored_are_let_go_of_before_it_is_told_why(tmp_path: Path) -> None:
    news = threading.Event()
    workers = AssetWorkers(AssetStore(tmp_path, max_bytes=1), news.set)
    found: list[Result] = []

    def until(kind: type[Result]) -> None:
        while not any(isinstance(one, kind) for one in found):
            assert news.wait(30.0)
            news.clear()
            found.extend(workers.poll_results())

    workers.look_up(ADDRESS, ())
    until(AssetMissing)
    workers.write(ADDRESS, memoryview(DATA))  # more than twice what the cache may hold
    until(AssetFailed)
    workers.close()
    assert [type(one) for one in found] == [AssetMissing, BytesStored, AssetFailed]
    assert found[1] == BytesStored(len(DATA))
