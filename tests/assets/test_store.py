"""The store: addresses, atomic files, and room that is made without taking what is in use."""

from __future__ import annotations

import errno
import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from filelock import FileLock, Timeout

from iris_session.assets.store import GRACE_S
from iris_session.scene import AssetMissingError, AssetStore, default_root


def age(store: AssetStore, address: str, seconds: float) -> None:
    """As if it had been used `seconds` ago."""
    path = store.path(address)
    then = path.stat().st_mtime - seconds
    os.utime(path, (then, then))


def test_put_and_get(tmp_path: Path) -> None:
    store = AssetStore(tmp_path)
    address = store.put(b"hello")
    assert address == hashlib.sha256(b"hello").hexdigest()
    assert store.path(address) == tmp_path / address[:2] / address
    assert store.put(memoryview(b"hello")) == address
    assert (store.get(address), store.size(address), address in store) == (b"hello", 5, True)
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == [store.path(address)]
    other = AssetStore(tmp_path)
    assert other.get(address) == b"hello"


def test_what_is_not_there(tmp_path: Path) -> None:
    store = AssetStore(tmp_path)
    missing = "0" * 64
    assert missing not in store
    assert not store.used(missing, 0)
    assert store.recall(missing) is None
    for call in (store.get, store.size):
        with pytest.raises(AssetMissingError, match="build the scene again"):
            call(missing)
    assert "../../etc/passwd" not in store
    for bad in ("", "../../etc/passwd", "A" * 64, "0" * 63):
        with pytest.raises(ValueError, match="no address"):
            store.path(bad)


def test_a_damaged_file_counts_as_missing(tmp_path: Path) -> None:
    store = AssetStore(tmp_path)
    address = store.put(b"hello")
    store.path(address).write_bytes(b"hellO")
    with pytest.raises(AssetMissingError, match="damaged"):
        store.get(address)
    assert address not in store
    assert store.put(b"hello") == address
    assert store.get(address) == b"hello"


def test_a_file_that_was_cut_off_by_a_crash_is_written_again(tmp_path: Path) -> None:
    """A rename can reach the disk before the bytes do."""
    store = AssetStore(tmp_path)
    address = store.put(b"hello")
    store.path(address).write_bytes(b"")
    assert not store.used(address, 5)
    assert store.put(b"hello") == address
    assert (store.get(address), store.used(address, 5)) == (b"hello", True)


def test_room_is_made_from_what_was_used_longest_ago(tmp_path: Path) -> None:
    store = AssetStore(tmp_path, limit_bytes=3_000)
    first, second, third = (store.put(bytes([k]) * 1_000) for k in range(3))
    for k, address in enumerate((first, second, third)):
        age(store, address, GRACE_S + 300 - 100 * k)
    assert store.used(first, 1_000)
    fresh = store.put(b"x" * 1_000)
    assert [a in store for a in (first, second, third, fresh)] == [True, False, True, True]
    assert store.evicted == 1


def test_what_is_recalled_is_used(tmp_path: Path) -> None:
    store = AssetStore(tmp_path, limit_bytes=2_000)
    keys = [f"{k:064x}" for k in range(2)]
    for k, key in enumerate(keys):
        store.remember(key, b"n" * 1_000)
        at = time.time() - GRACE_S - 300 + 100 * k
        os.utime(tmp_path / "index" / key[:2] / key, (at, at))
    assert store.recall(keys[0]) is not None
    store.put(b"x" * 1_000)
    assert [store.recall(key) is not None for key in keys] == [True, False]


def test_what_is_held_or_fresh_stays(tmp_path: Path) -> None:
    store = AssetStore(tmp_path, limit_bytes=2_000)
    held, old, young = (store.put(bytes([k]) * 1_000) for k in range(3))
    age(store, held, GRACE_S + 200)
    age(store, old, GRACE_S + 100)
    with store.hold([held]):
        AssetStore(tmp_path, limit_bytes=2_000).put(b"x" * 1_000)
        assert [a in store for a in (held, old, young)] == [True, False, True]
    AssetStore(tmp_path, limit_bytes=2_000).put(b"y" * 1_000)
    assert held not in store
    assert young in store
    assert not list((tmp_path / "holds").iterdir())


def test_the_hold_of_a_dead_process_ends_with_it(tmp_path: Path) -> None:
    store = AssetStore(tmp_path, limit_bytes=1_500)
    address = store.put(b"x" * 1_000)
    age(store, address, GRACE_S + 100)
    program = (
        "import os, sys; from iris_session.scene import AssetStore\n"
        "hold = AssetStore(sys.argv[1]).hold([sys.argv[2]]); os._exit(0)"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path), address], check=True, timeout=120)
    assert list((tmp_path / "holds").glob("*.hold"))
    store.put(b"y" * 1_000)
    assert address not in store
    assert not list((tmp_path / "holds").glob("*.hold"))


def test_a_hold_is_whole_and_locked_from_the_moment_it_can_be_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process makes room while a hold is being made: nothing of it may be taken for one of a dead process."""
    store = AssetStore(tmp_path, limit_bytes=100)
    held = store.put(b"h" * 60)
    age(store, held, 10_000)
    replace, seen = os.replace, []

    def looked_at_meanwhile(source: str, target: Path) -> None:
        AssetStore(tmp_path)._held()
        replace(source, target)
        seen.append(target)

    monkeypatch.setattr(os, "replace", looked_at_meanwhile)
    with store.hold([held]):
        monkeypatch.undo()
        assert len(seen) == 1
        AssetStore(tmp_path, limit_bytes=100).put(b"n" * 60)
        assert held in store
    AssetStore(tmp_path, limit_bytes=100).put(b"m" * 60)
    assert held not in store


def test_what_is_of_no_use_any_more_goes_unless_others_use_it(tmp_path: Path) -> None:
    store = AssetStore(tmp_path)
    address = store.put(b"a look of long ago")
    at = store.used_at(address)
    with store.hold([address]):
        assert not store.discard(address, at)
    os.utime(store.path(address), ns=(at + 5, at + 5))  # another session has the same
    assert not store.discard(address, at)
    assert store.discard(address, at + 5)
    assert (address in store, store.used_at(address), store.discard(address, 0)) == (False, 0, False)


def test_what_others_have_below_the_root_is_left_alone(tmp_path: Path) -> None:
    """Somebody gives a folder that has folders of two letters, or links, of their own."""
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
    store = AssetStore(root, limit_bytes=100)
    left = root / "cd" / "tmpx_y1.part"  # of a process that was killed while it wrote
    left.write_bytes(b"p" * 50)
    os.utime(left, (0, 0))
    store.put(b"x" * 60)
    store.put(b"y" * 60)
    assert (mine.exists(), len(list(elsewhere.iterdir())), len(list((root / "cd").iterdir()))) == (True, 1, 1)
    assert not left.exists()
    assert store.evicted == 1


def test_a_disk_that_cannot_be_written_still_gives_what_it_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = AssetStore(tmp_path)
    address = store.put(b"hello")
    store.remember(address, b"note")

    def refused(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "read-only file system")

    monkeypatch.setattr(os, "utime", refused)
    monkeypatch.setattr(os, "replace", refused)
    assert (store.put(b"hello"), store.used(address, 5), store.recall(address)) == (address, True, b"note")
    assert not store.used("0" * 64, 5)
    with pytest.raises(OSError, match="read-only"):
        store.put(b"more")
    with pytest.raises(OSError, match="read-only"):
        store.hold([address])
    assert not list(tmp_path.rglob("*.part"))
    assert not list((tmp_path / "holds").glob("*"))


def test_a_file_that_goes_while_the_store_is_looked_through(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    address = AssetStore(tmp_path).put(b"hello")
    scan = os.scandir

    class Gone:
        """The entries of a folder whose files another process takes after they were listed."""

        def __init__(self, path: str) -> None:
            with scan(path) as entries:
                self.entries = list(entries)
            for entry in self.entries:
                if entry.name == address:
                    os.unlink(entry.path)

        def __enter__(self) -> Iterator[os.DirEntry[str]]:
            return iter(self.entries)

        def __exit__(self, *_: object) -> None: ...

    monkeypatch.setattr(os, "scandir", Gone)
    assert address not in AssetStore(tmp_path)


def test_what_another_process_takes_up_while_room_is_made_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It marks as used what it has built before, and then holds it: both may come after we have looked."""
    store = AssetStore(tmp_path, limit_bytes=1_500)
    taken, other = store.put(b"t" * 1_000), store.put(b"o" * 400)
    for address in (taken, other):
        age(store, address, GRACE_S + 100)
    files = store._files

    def taken_up_after() -> Iterator[tuple[os.DirEntry[str], os.stat_result]]:
        yield from files()
        AssetStore(tmp_path).used(taken, 1_000)

    monkeypatch.setattr(store, "_files", taken_up_after)
    store.put(b"n" * 1_000)
    assert (taken in store, other in store, store.evicted) == (True, False, 1)


def test_a_hold_ends_in_whatever_thread(tmp_path: Path) -> None:
    """A scene is made by one thread and let go by another: a lock that stays open costs a descriptor each time."""
    store = AssetStore(tmp_path)
    with ThreadPoolExecutor(1) as other:
        hold = other.submit(store.hold, [store.put(b"x")]).result()
        lock = FileLock(next((tmp_path / "holds").glob("*.lock")))
        with pytest.raises(Timeout):
            lock.acquire(blocking=False)
        hold.release()
        assert not other.submit(lambda: hold._lock.is_locked).result()
    assert not list((tmp_path / "holds").iterdir())


def test_when_all_is_in_use_the_disk_is_not_looked_through_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = AssetStore(tmp_path, limit_bytes=64_000)
    looks: list[None] = []
    held = store._held
    monkeypatch.setattr(store, "_held", lambda: looks.append(None) or held())
    for number in range(300):
        store.put(number.to_bytes(4, "little") * 250)
    assert 0 < len(looks) <= 130
    assert store.evicted == 0


def test_where_it_lies(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_root() == tmp_path / "iris-session" / "assets"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert default_root() == Path.home() / ".cache" / "iris-session" / "assets"

    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", homeless)
    with pytest.raises(OSError, match="set XDG_CACHE_HOME"):
        default_root()


def test_what_killed_processes_left_is_gone_with_the_next_start(tmp_path: Path) -> None:
    """A power cut between two files of a hold, or within one of an asset; what is young may be another's at work."""
    store = AssetStore(tmp_path)
    address = store.put(b"hello")
    hold = store.hold([address])
    holds, folder = tmp_path / "holds", store.path(address).parent
    left = [
        holds / "tmpa1_.new",
        holds / "tmpb2.new.hold.lock",
        folder / "tmpc3.part",
        tmp_path / "index/ab/tmpd4.part",
    ]
    dead = [holds / "tmpe5.new.hold", holds / "tmpe5.new.hold.lock"]
    young = [holds / "tmpf6.new", holds / "tmpf6.new.hold.lock", folder / "tmpg7.part"]
    others = [holds / "notes.new", holds / "tmp.txt", folder / "mine.part"]
    living = list(holds.iterdir())
    for path in (*left, *dead, *young, *others):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"half")
    then = store.path(address).stat().st_mtime - 2 * GRACE_S
    for path in (*left, *dead, *others, *living, store.path(address)):
        os.utime(path, (then, then))
    AssetStore(tmp_path)
    assert not [path for path in (*left, *dead) if path.exists()]
    assert all(path.exists() for path in (*young, *others, *living))
    assert store.get(address) == b"hello"
    hold.release()
