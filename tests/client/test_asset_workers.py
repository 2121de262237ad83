"""The threads that store assets: failed bytes leave the window."""

from __future__ import annotations

import threading
from pathlib import Path

from iris_session.client import AssetStore
from iris_session.client.assets import AssetFailed, AssetMissing, AssetWorkers, BytesStored, Result
from tests.assets.test_store import ADDRESS, DATA


def test_bytes_that_cannot_be_stored_are_released_before_the_failure_is_reported(tmp_path: Path) -> None:
    news = threading.Event()
    workers = AssetWorkers(AssetStore(tmp_path, max_bytes=1), news.set)
    found: list[Result] = []

    def wait_for(kind: type[Result]) -> None:
        while not any(isinstance(one, kind) for one in found):
            assert news.wait(30.0)
            news.clear()
            found.extend(workers.poll_results())

    workers.look_up(ADDRESS, ())
    wait_for(AssetMissing)
    workers.write(ADDRESS, memoryview(DATA))  # more than twice the cache limit
    wait_for(AssetFailed)
    workers.close()
    assert [type(one) for one in found] == [AssetMissing, BytesStored, AssetFailed]
    assert found[1] == BytesStored(len(DATA))
