"""The queue of assets: bounded pieces, each asset once, and what cannot be read is counted and never fatal."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
import pytest

from iris_session.journal.messages import SceneAssets
from iris_session.protocol.scene import encode_scene, list_assets
from iris_session.rrd import assets as asset_queue
from iris_session.rrd.assets import ALL, PIECE_BYTES, SCENE, AssetQueue, AssetRows, list_recorded_assets
from tests.recording.test_recorded_assets import Shared

S = 1_000_000_000


@pytest.fixture
def shared(tmp_path: Path) -> Shared:
    return Shared(tmp_path / "store")


def drain(queue: AssetQueue, now_ns: int = S, max_bytes: int = 3000) -> AssetRows:
    """Read until nothing comes."""
    found = AssetRows([], [], [])
    while any(rows := queue.read(now_ns, max_bytes)):
        assert sum(len(piece.data) for piece in rows.pieces) <= max_bytes
        for all_rows, new in zip(found, rows, strict=True):
            all_rows.extend(new)  # type: ignore[arg-type]
    return found


def patched(shared: Shared, name: str) -> SceneAssets:
    """Put another specification of the scene into the store."""
    spec = msgspec.structs.replace(shared.spec, name=name)
    return SceneAssets(5, 6, str(shared.store.root), shared.store.put(encode_scene(spec)))


@pytest.mark.parametrize("recorded", [SCENE, ALL])
def test_pieces_are_bounded_and_each_asset_comes_once(shared: Shared, recorded: str) -> None:
    queue = AssetQueue(recorded)
    queue.add_scene(shared.assets, is_patch=False)
    queue.add_scene(patched(shared, "another"), is_patch=False)
    rows = drain(queue)
    wanted = {one.hash for one in rows.scenes} | set(list_recorded_assets(shared.spec, recorded))
    assert len(rows.scenes) == 2
    assert sum(piece.offset == 0 for piece in rows.pieces) == len({p.address for p in rows.pieces}) == len(wanted)
    assert {piece.address for piece in rows.pieces} == wanted
    assert rows.pieces[0].is_scene
    assert not queue
    assert queue.left_out == 0
    assert all(len(piece.data) <= PIECE_BYTES for piece in rows.pieces)


@pytest.mark.parametrize("fault", ["missing", "damaged", "shorter", "too large"])
def test_asset_that_cannot_be_read_is_counted(shared: Shared, fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    address = max(list_recorded_assets(shared.spec, SCENE), key=lambda one: len(shared.store.view(one)))
    path = shared.store.path(address)
    data = path.read_bytes()
    queue = AssetQueue(SCENE)
    queue.add_scene(shared.assets, is_patch=False)
    if fault == "shorter":
        one = queue.read(S, 100)
        while not (one.pieces and one.pieces[-1].address == address):
            one = queue.read(S, 100)
        os.truncate(path, 50)
    elif fault == "damaged":
        path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    elif fault == "too large":
        monkeypatch.setattr(asset_queue, "MAX_ASSET_BYTES", len(data) - 1)
    else:
        path.unlink()
    rows = drain(queue)
    assert [one.address for one in rows.faults] == [address]
    assert queue.left_out == 1
    assert not queue


def test_scene_that_is_no_specification_is_counted(shared: Shared) -> None:
    queue = AssetQueue(SCENE)
    queue.add_scene(SceneAssets(-1, 0, str(shared.store.root), shared.store.put(b"no scene")), is_patch=False)
    queue.add_scene(SceneAssets(-1, 0, str(shared.store.root), "not a hash"), is_patch=False)
    rows = drain(queue)
    assert len(rows.faults) == queue.left_out == 1
    assert "no scene specification" in rows.faults[0].text


def test_limit_of_bytes_leaves_out_what_does_not_fit(shared: Shared) -> None:
    sizes = {address: len(shared.store.view(address)) for address in list_recorded_assets(shared.spec, SCENE)}
    room = len(shared.store.view(shared.scene_hash)) + sum(sizes.values()) - 1
    queue = AssetQueue(SCENE, room)
    queue.add_scene(shared.assets, is_patch=False)
    rows = drain(queue)
    assert sum(len(piece.data) for piece in rows.pieces) <= room
    assert len(rows.faults) == 1
    assert "budget" in rows.faults[0].text
    assert set(list_assets(shared.spec)) >= {one.address for one in rows.faults}
