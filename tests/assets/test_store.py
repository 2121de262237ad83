"""The content store: verified content, atomic files, resumable downloads, holds, bounded size, several processes."""

from __future__ import annotations

import errno
import hashlib
import os
import random
import resource
from pathlib import Path

import pytest

from iris_session.assets.errors import AssetMissingError, AssetStoreError
from iris_session.assets.store import GRACE_S, MAX_MAPPED_FILES, AssetStore, ServedAssets
from tests.front.fakes import put

#: Ends with another byte than the wrong copies below.
DATA = random.Random(1).randbytes(99_999) + b"!"
ADDRESS = hashlib.sha256(DATA).hexdigest()


def set_age(store: AssetStore, address: str, seconds: float) -> None:
    """Set the last use of an asset to `seconds` ago."""
    path = store.path(address)
    then = path.stat().st_mtime - seconds
    os.utime(path, (then, then))


def test_missing_assets(tmp_path: Path) -> None:
    store = AssetStore(tmp_path)
    missing = "0" * 64
    assert missing not in store
    assert not store.mark_used(missing, 0)
    assert store.read_index(missing) is None
    with pytest.raises(AssetMissingError):
        store.get(missing)
    assert "../../etc/passwd" not in store
    for bad in ("", "../../etc/passwd", "A" * 64, "0" * 63):
        with pytest.raises(ValueError, match="address"):
            store.path(bad)


@pytest.mark.parametrize("damaged", [b"hellO", b"", b"hello!"], ids=["changed", "cut by a crash", "longer"])
def test_damaged_file_counts_as_missing_and_is_written_again(tmp_path: Path, damaged: bytes) -> None:
    store = AssetStore(tmp_path)
    address = store.put(b"hello")
    store.path(address).write_bytes(damaged)
    with pytest.raises(AssetMissingError) as caught:
        store.get(address)
    assert (caught.value.reason, caught.value.address) == ("gone", address)
    assert store.put(b"hello") == address
    store.path(address).write_bytes(damaged)
    assert store.find(address) is None
    assert not store.path(address).exists()
    with pytest.raises(AssetMissingError):
        store.view(address)
    assert store.put(b"hello") == address
    assert (store.get(address), store.mark_used(address, 5)) == (b"hello", True)


def test_links_and_pipes_in_the_folder_count_as_missing_and_are_replaced(tmp_path: Path) -> None:
    """Another user of a shared folder puts them there: the asset behind a link may change at any time."""
    store, elsewhere = AssetStore(tmp_path / "store"), tmp_path / "elsewhere"
    elsewhere.write_bytes(b"hello")
    os.utime(elsewhere, (1, 1))
    address = hashlib.sha256(b"hello").hexdigest()
    path = store.path(address)
    path.parent.mkdir(parents=True)
    for plant in (lambda: path.symlink_to(elsewhere), lambda: path.symlink_to(path), lambda: os.mkfifo(path)):
        plant()
        assert address not in store
        assert (store.find(address), store.mark_used(address, 5), store.last_used_ns(address)) == (None, False, 0)
        assert not store.discard(address, elsewhere.stat().st_mtime_ns)
        for call in (store.get, store.view):
            with pytest.raises(AssetMissingError):
                call(address)
        assert store.put(b"hello") == address
        assert (store.get(address), path.is_symlink()) == (b"hello", False)
        path.unlink()
    note = tmp_path / "store" / "index" / address[:2] / address
    note.parent.mkdir(parents=True)
    note.symlink_to(elsewhere)
    assert store.read_index(address) is None
    store.write_index(address, b"note")
    assert store.read_index(address) == b"note"
    assert (elsewhere.read_bytes(), elsewhere.stat().st_mtime) == (b"hello", 1)


def test_least_recently_used_assets_are_evicted(tmp_path: Path) -> None:
    store = AssetStore(tmp_path, max_bytes=3_000)
    first, second, third = (store.put(bytes([k]) * 1_000) for k in range(3))
    for k, address in enumerate((first, second, third)):
        set_age(store, address, GRACE_S + 300 - 100 * k)
    assert store.mark_used(first, 1_000)
    fresh = store.put(b"x" * 1_000)
    assert [a in store for a in (first, second, third, fresh)] == [True, False, True, True]
    assert store.evicted == 1


def test_held_and_recent_assets_are_kept(tmp_path: Path) -> None:
    store = AssetStore(tmp_path, max_bytes=2_000)
    held, old, young = (store.put(bytes([k]) * 1_000) for k in range(3))
    set_age(store, held, GRACE_S + 200)
    set_age(store, old, GRACE_S + 100)
    with store.hold([held]):
        AssetStore(tmp_path, max_bytes=2_000).put(b"x" * 1_000)
        assert [a in store for a in (held, old, young)] == [True, False, True]
    AssetStore(tmp_path, max_bytes=2_000).put(b"y" * 1_000)
    assert held not in store
    assert young in store
    assert not list((tmp_path / "holds").iterdir())


def test_hold_ends_with_its_process(tmp_path: Path) -> None:
    store = AssetStore(tmp_path, max_bytes=1_500)
    address = store.put(b"x" * 1_000)
    set_age(store, address, GRACE_S + 100)
    hold = store.hold([address])
    hold._lock.release()  # as the system does at the end of a process
    assert list((tmp_path / "holds").glob("*.hold"))
    store.put(b"y" * 1_000)
    assert address not in store
    assert not list((tmp_path / "holds").glob("*.hold"))


def test_discard_removes_assets_that_no_other_session_uses(tmp_path: Path) -> None:
    store = AssetStore(tmp_path)
    address = store.put(b"a replaced visual")
    at = store.last_used_ns(address)
    with store.hold([address]):
        assert not store.discard(address, at)
    os.utime(store.path(address), ns=(at + 5, at + 5))  # held by another session too
    assert not store.discard(address, at)
    assert store.discard(address, at + 5)
    assert (address in store, store.last_used_ns(address), store.discard(address, 0)) == (False, 0, False)


def test_foreign_files_below_the_root_are_kept(tmp_path: Path) -> None:
    """The given folder has folders of two letters, or links, of its own."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / ("ab" + "0" * 62)).write_bytes(b"v" * 1_000)
    root = tmp_path / "root"
    (root / "g1").mkdir(parents=True)
    mine = root / "g1" / "robot.stl"
    mine.write_bytes(b"m" * 1_000)
    (root / "ab").symlink_to(elsewhere)
    (root / "cd").mkdir()
    (root / "cd" / ("cd" + "0" * 62)).symlink_to(mine)
    os.utime(mine, (0, 0))
    os.utime(elsewhere / ("ab" + "0" * 62), (0, 0))
    store = AssetStore(root, max_bytes=100)
    left = root / "cd" / f"cd{0:062x}.x_y1.part"  # of a process that was killed while writing
    left.write_bytes(b"p" * 50)
    os.utime(left, (0, 0))
    store.put(b"x" * 60)
    store.put(b"y" * 60)
    assert (mine.exists(), len(list(elsewhere.iterdir())), len(list((root / "cd").iterdir()))) == (True, 1, 1)
    assert not left.exists()
    assert store.evicted == 0


def test_read_only_disk_serves_what_it_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = AssetStore(tmp_path)
    address = store.put(b"hello")
    store.write_index(address, b"note")

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "read-only file system")

    monkeypatch.setattr(os, "utime", refuse)
    monkeypatch.setattr(os, "replace", refuse)
    assert (store.put(b"hello"), store.mark_used(address, 5), store.read_index(address)) == (address, True, b"note")
    assert not store.mark_used("0" * 64, 5)
    with pytest.raises(OSError, match="read-only"):
        store.put(b"more")
    with pytest.raises(OSError, match="read-only"):
        store.hold([address])
    assert not list(tmp_path.rglob("*.part"))
    assert not list((tmp_path / "holds").glob("*"))


# --- downloads ---


def test_partial_download_is_resumed(tmp_path: Path) -> None:
    part = AssetStore(tmp_path).open_part(ADDRESS)
    part.append(DATA[:40_000])
    part.close()
    again = AssetStore(tmp_path).open_part(ADDRESS)
    assert again.offset == 40_000
    again.append(DATA[40_000:])
    assert AssetStore(tmp_path).find(ADDRESS) is None
    assert again.finish()
    assert AssetStore(tmp_path).find(ADDRESS) == DATA
    nothing = AssetStore(tmp_path).open_part("0" * 64)
    nothing.close()
    assert len(list(tmp_path.glob("??/*"))) == 1


def test_two_processes_can_download_the_same_asset(tmp_path: Path) -> None:
    other = AssetStore(tmp_path).open_part(ADDRESS)
    other.append(b"of another process")
    cache = AssetStore(tmp_path)
    ours = cache.open_part(ADDRESS)
    assert ours.offset == 0
    ours.append(DATA)
    assert ours.finish()
    other.close()
    late = cache.open_part(ADDRESS)  # the part of the other is free
    assert late.offset == len(b"of another process")
    late.close()
    assert cache.find(ADDRESS) == DATA


def store_part(cache: AssetStore, data: bytes) -> str:
    address = hashlib.sha256(data).hexdigest()
    part = cache.open_part(address)
    part.append(data)
    assert part.finish()
    return address


def test_full_disk_is_reported_and_the_part_is_resumed(tmp_path: Path) -> None:
    part = AssetStore(tmp_path).open_part(ADDRESS)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    try:
        with pytest.raises(AssetStoreError) as caught:
            part.append(DATA)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert caught.value.reason == "cache"
    part.close()
    again = AssetStore(tmp_path).open_part(ADDRESS)
    assert again.offset == 50_000
    again.append(DATA[50_000:])
    assert again.finish()
    assert AssetStore(tmp_path).find(ADDRESS) == DATA


def test_disk_use_never_exceeds_twice_the_limit(tmp_path: Path) -> None:
    """All assets were just used: a session cannot fill the disk by naming more of them."""
    cache = AssetStore(tmp_path, max_bytes=1 << 20)
    for i in range(2):
        store_part(cache, bytes([i]) * (1 << 20))
    part = cache.open_part(ADDRESS)
    with pytest.raises(AssetStoreError, match="1 MiB") as caught:
        part.append(DATA)
    assert caught.value.reason == "cache"
    part.close()
    for path in tmp_path.glob("??/*"):
        os.utime(path, (1, 1))
    assert store_part(cache, DATA[:-1]) != ADDRESS, "there is room again"


def test_wrong_part_of_another_session_costs_one_repeated_download(tmp_path: Path) -> None:
    """A session sends other bytes than those of the address and is closed halfway."""
    for lie in (b"x" * 40_000, DATA[:-1] + b"?", DATA + b"longer than the asset"):
        part = AssetStore(tmp_path).open_part(ADDRESS)
        part.append(lie)
        part.close()
        again = AssetStore(tmp_path).open_part(ADDRESS)
        assert again.offset == len(lie)
        again.append(DATA[again.offset :])
        assert not again.finish()
        assert again.offset == 0
        assert AssetStore(tmp_path).find(ADDRESS) is None
        again.close()
    assert store_part(AssetStore(tmp_path), DATA) == ADDRESS


def test_unusable_folder_raises(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(AssetStoreError) as caught:
        AssetStore(tmp_path / "file").open_part(ADDRESS)
    assert caught.value.reason == "cache"
    assert "XDG_CACHE_HOME" in str(caught.value)
    with pytest.raises(ValueError, match="address"):
        AssetStore(tmp_path).path("../../etc/passwd")


# --- served assets ---


def test_served_bytes_and_sizes(tmp_path: Path) -> None:
    files = ServedAssets()
    data, empty, other = put(tmp_path, b"0123456789"), put(tmp_path, b""), put(tmp_path, b"other")
    files.serve([(str(tmp_path), (data, empty, "../../secret", "0" * 64))])
    assert (files.size(data), files.size(empty), files.size(other)) == (10, 0, None)
    assert bytes(files.chunk(data, 3, 4) or b"") == b"3456"
    assert files.chunk(data, 3, 8) is None
    assert bytes(files.chunk(empty, 0, 0) or b"") == b""
    assert files.size("0" * 64) is None  # named, but missing
    assert files.size("../../secret") is None


def test_number_of_open_files_is_bounded(tmp_path: Path) -> None:
    files = ServedAssets()
    addresses = [put(tmp_path, b"%d" % i) for i in range(MAX_MAPPED_FILES + 40)]
    files.serve([(str(tmp_path), addresses)])
    for _ in range(2):
        for i, address in enumerate(addresses):
            assert bytes(files.chunk(address, 0, len(str(i))) or b"") == b"%d" % i
    assert len(files._mapped) <= MAX_MAPPED_FILES
