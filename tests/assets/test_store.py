"""The store: verified content, atomic files, downloads that resume, holds, a bounded size, several processes."""

from __future__ import annotations

import errno
import fcntl
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

from iris_session.assets.errors import AssetMissingError, AssetStoreError
from iris_session.assets.store import GRACE_S, MAX_MAPPED_FILES, AssetStore, ServedAssets, default_root
from tests.front.asset_rig import put

DATA = os.urandom(100_000)
ADDRESS = hashlib.sha256(DATA).hexdigest()


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
    assert not store.mark_used(missing, 0)
    assert store.read_index(missing) is None
    for call in (store.get, store.size):
        with pytest.raises(AssetMissingError):
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
    assert not store.mark_used(address, 5)
    assert store.put(b"hello") == address
    assert (store.get(address), store.mark_used(address, 5)) == (b"hello", True)


def test_room_is_made_from_what_was_used_longest_ago(tmp_path: Path) -> None:
    store = AssetStore(tmp_path, max_bytes=3_000)
    first, second, third = (store.put(bytes([k]) * 1_000) for k in range(3))
    for k, address in enumerate((first, second, third)):
        age(store, address, GRACE_S + 300 - 100 * k)
    assert store.mark_used(first, 1_000)
    fresh = store.put(b"x" * 1_000)
    assert [a in store for a in (first, second, third, fresh)] == [True, False, True, True]
    assert store.evicted == 1


def test_what_is_recalled_is_used(tmp_path: Path) -> None:
    store = AssetStore(tmp_path, max_bytes=2_000)
    keys = [f"{k:064x}" for k in range(2)]
    for k, key in enumerate(keys):
        store.write_index(key, b"n" * 1_000)
        at = time.time() - GRACE_S - 300 + 100 * k
        os.utime(tmp_path / "index" / key[:2] / key, (at, at))
    assert store.read_index(keys[0]) is not None
    store.put(b"x" * 1_000)
    assert [store.read_index(key) is not None for key in keys] == [True, False]


def test_what_is_held_or_fresh_stays(tmp_path: Path) -> None:
    store = AssetStore(tmp_path, max_bytes=2_000)
    held, old, young = (store.put(bytes([k]) * 1_000) for k in range(3))
    age(store, held, GRACE_S + 200)
    age(store, old, GRACE_S + 100)
    with store.hold([held]):
        AssetStore(tmp_path, max_bytes=2_000).put(b"x" * 1_000)
        assert [a in store for a in (held, old, young)] == [True, False, True]
    AssetStore(tmp_path, max_bytes=2_000).put(b"y" * 1_000)
    assert held not in store
    assert young in store
    assert not list((tmp_path / "holds").iterdir())


def test_the_hold_of_a_dead_process_ends_with_it(tmp_path: Path) -> None:
    store = AssetStore(tmp_path, max_bytes=1_500)
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
    store = AssetStore(tmp_path, max_bytes=100)
    held = store.put(b"h" * 60)
    age(store, held, 10_000)
    replace, seen = os.replace, []

    def looked_at_meanwhile(source: str, target: Path) -> None:
        AssetStore(tmp_path)._read_holds()
        replace(source, target)
        seen.append(target)

    monkeypatch.setattr(os, "replace", looked_at_meanwhile)
    with store.hold([held]):
        monkeypatch.undo()
        assert len(seen) == 1
        AssetStore(tmp_path, max_bytes=100).put(b"n" * 60)
        assert held in store
    AssetStore(tmp_path, max_bytes=100).put(b"m" * 60)
    assert held not in store


def test_what_is_of_no_use_any_more_goes_unless_others_use_it(tmp_path: Path) -> None:
    store = AssetStore(tmp_path)
    address = store.put(b"a look of long ago")
    at = store.last_used_ns(address)
    with store.hold([address]):
        assert not store.discard(address, at)
    os.utime(store.path(address), ns=(at + 5, at + 5))  # another session has the same
    assert not store.discard(address, at)
    assert store.discard(address, at + 5)
    assert (address in store, store.last_used_ns(address), store.discard(address, 0)) == (False, 0, False)


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
    store = AssetStore(root, max_bytes=100)
    left = root / "cd" / f"cd{0:062x}.x_y1.part"  # of a process that was killed while it wrote
    left.write_bytes(b"p" * 50)
    os.utime(left, (0, 0))
    store.put(b"x" * 60)
    store.put(b"y" * 60)
    assert (mine.exists(), len(list(elsewhere.iterdir())), len(list((root / "cd").iterdir()))) == (True, 1, 1)
    assert not left.exists()
    assert store.evicted == 0


def test_a_disk_that_cannot_be_written_still_gives_what_it_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = AssetStore(tmp_path)
    address = store.put(b"hello")
    store.write_index(address, b"note")

    def refused(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "read-only file system")

    monkeypatch.setattr(os, "utime", refused)
    monkeypatch.setattr(os, "replace", refused)
    assert (store.put(b"hello"), store.mark_used(address, 5), store.read_index(address)) == (address, True, b"note")
    assert not store.mark_used("0" * 64, 5)
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
    store = AssetStore(tmp_path)
    assert store.trim() == 0
    assert address not in store


def test_what_another_process_takes_up_while_room_is_made_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It marks as used what it has built before, and then holds it: both may come after we have looked."""
    store = AssetStore(tmp_path, max_bytes=1_500)
    taken, other = store.put(b"t" * 1_000), store.put(b"o" * 400)
    for address in (taken, other):
        age(store, address, GRACE_S + 100)
    files = store._iterate_files

    def taken_up_after() -> Iterator[tuple[os.DirEntry[str], os.stat_result]]:
        yield from files()
        AssetStore(tmp_path).mark_used(taken, 1_000)

    monkeypatch.setattr(store, "_iterate_files", taken_up_after)
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
    store = AssetStore(tmp_path, max_bytes=64_000)
    looks: list[None] = []
    held = store._read_holds
    monkeypatch.setattr(store, "_read_holds", lambda: looks.append(None) or held())
    for number in range(300):
        store.put(number.to_bytes(4, "little") * 250)
    assert 0 < len(looks) <= 130
    assert store.evicted == 0


def test_default_roots(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_root() == AssetStore().root == tmp_path / "iris-session" / "assets"
    assert default_root("client-assets") == tmp_path / "iris-session" / "client-assets"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert default_root() == Path.home() / ".cache" / "iris-session" / "assets"

    def homeless(_: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", homeless)
    with pytest.raises(OSError, match="set XDG_CACHE_HOME"):
        default_root()


def test_files_of_killed_processes_are_removed_by_the_next_scan(tmp_path: Path) -> None:
    """A power cut between two files of a hold, or within one of an asset; what is young may be another's at work."""
    store = AssetStore(tmp_path)
    address = store.put(b"hello")
    hold = store.hold([address])
    holds, folder = tmp_path / "holds", store.path(address).parent
    left = [
        holds / "tmpa1_.new",
        holds / "tmpb2.new.hold.lock",
        folder / f"{address}.c3.part",
        tmp_path / f"index/ab/ab{0:062x}.d4.part",
    ]
    dead = [holds / "tmpe5.new.hold", holds / "tmpe5.new.hold.lock"]
    young = [holds / "tmpf6.new", holds / "tmpf6.new.hold.lock", folder / f"{address}.g7.part"]
    others = [holds / "notes.new", holds / "tmp.txt", folder / "mine.part"]
    living = list(holds.iterdir())
    for path in (*left, *dead, *young, *others):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"half")
    then = store.path(address).stat().st_mtime - 2 * GRACE_S
    for path in (*left, *dead, *others, *living, store.path(address)):
        os.utime(path, (then, then))
    AssetStore(tmp_path).trim()
    assert not [path for path in (*left, *dead) if path.exists()]
    assert all(path.exists() for path in (*young, *others, *living))
    assert store.get(address) == b"hello"
    hold.release()


# --- downloads ---


def test_what_was_stored_is_found_and_read(tmp_path: Path) -> None:
    cache = AssetStore(tmp_path)
    assert cache.find(ADDRESS) is None
    part = cache.open_part(ADDRESS)
    part.append(DATA[:60_000])
    assert cache.find(ADDRESS) is None
    part.append(DATA[60_000:])
    assert part.finish()
    assert cache.find(ADDRESS) == DATA
    assert cache.get(ADDRESS) == bytes(cache.view(ADDRESS)) == DATA
    assert [path.name for path in tmp_path.glob("??/*")] == [ADDRESS]
    empty = hashlib.sha256(b"").hexdigest()
    assert cache.open_part(empty).finish()
    assert (cache.find(empty), cache.get(empty), bytes(cache.view(empty))) == (b"", b"", b"")


def test_a_part_that_was_left_goes_on(tmp_path: Path) -> None:
    part = AssetStore(tmp_path).open_part(ADDRESS)
    part.append(DATA[:40_000])
    part.close()
    again = AssetStore(tmp_path).open_part(ADDRESS)
    assert again.offset == 40_000
    again.append(DATA[40_000:])
    assert again.finish()
    nothing = AssetStore(tmp_path).open_part("0" * 64)
    nothing.close()
    assert len(list(tmp_path.glob("??/*"))) == 1


def test_wrong_bytes_never_get_the_name(tmp_path: Path) -> None:
    cache = AssetStore(tmp_path)
    part = cache.open_part(ADDRESS)
    part.append(DATA[:-1] + b"?")
    assert not part.finish()
    assert part.offset == 0
    assert cache.find(ADDRESS) is None
    part.append(DATA)
    assert part.finish()


def test_damage_on_the_disk_is_found_and_taken_away(tmp_path: Path) -> None:
    cache = AssetStore(tmp_path)
    part = cache.open_part(ADDRESS)
    part.append(DATA)
    assert part.finish()
    with cache.path(ADDRESS).open("r+b") as file:
        file.write(b"damaged")
    assert cache.find(ADDRESS) is None
    assert not cache.path(ADDRESS).exists()
    for read in (cache.view, cache.get):
        with pytest.raises(AssetMissingError) as caught:
            read(ADDRESS)
        assert (caught.value.reason, caught.value.address) == ("gone", ADDRESS)


OTHER = """
import sys
from iris_session.assets.store import AssetStore
part = AssetStore(sys.argv[1]).open_part(sys.argv[2])
part.append(b"of somebody else")
print(part.offset, flush=True)
sys.stdin.read()
"""


def test_another_process_at_the_same_asset_does_no_harm(tmp_path: Path) -> None:
    command = [sys.executable, "-c", OTHER, str(tmp_path), ADDRESS]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        cache = AssetStore(tmp_path)
        ours = cache.open_part(ADDRESS)
        assert ours.offset == 0
        ours.append(DATA)
        assert ours.finish()
        other.kill()
    late = cache.open_part(ADDRESS)  # what the dead one left is nobody's
    assert late.offset == len(b"of somebody else")
    late.close()
    assert cache.find(ADDRESS) == DATA


def test_above_its_bound_the_longest_unused_goes(tmp_path: Path) -> None:
    cache = AssetStore(tmp_path, max_bytes=100_000)
    addresses = []
    for i in range(4):
        data = bytes([i]) * 10_000
        addresses.append(hashlib.sha256(data).hexdigest())
        part = cache.open_part(addresses[-1])
        part.append(data)
        assert part.finish()
        os.utime(cache.path(addresses[-1]), (time.time() - 5000 + i,) * 2)
    old = cache.open_part("0" * 64)
    old.append(b"x")
    old.close()
    os.utime(tmp_path / "00" / ("0" * 64 + ".part"), (1, 1))
    assert cache.find(addresses[0]) == bytes(10_000)  # used now
    assert AssetStore(tmp_path, max_bytes=25_000).trim() == 20_000
    assert [cache.path(a).exists() for a in addresses] == [True, False, False, True]
    assert not (tmp_path / "00" / ("0" * 64 + ".part")).exists()


def stored(cache: AssetStore, data: bytes) -> str:
    address = hashlib.sha256(data).hexdigest()
    part = cache.open_part(address)
    part.append(data)
    assert part.finish()
    return address


FULL_DISK = """
import resource, sys
from iris_session.assets.store import AssetStore
from iris_session.assets.errors import AssetStoreError
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
part = AssetStore(sys.argv[1]).open_part(sys.argv[2])
try:
    part.append(sys.stdin.buffer.read())
except AssetStoreError as error:
    part.close()
    print(error.reason, error)
"""


def test_a_disk_that_takes_no_more_says_so_and_what_it_took_is_gone_on_with(tmp_path: Path) -> None:
    command = [sys.executable, "-c", FULL_DISK, str(tmp_path), ADDRESS]
    done = subprocess.run(command, input=DATA, stdout=subprocess.PIPE, check=True, timeout=120)
    assert done.stdout.startswith(b"cache ")
    again = AssetStore(tmp_path).open_part(ADDRESS)
    assert again.offset == 50_000
    again.append(DATA[50_000:])
    assert again.finish()
    assert AssetStore(tmp_path).find(ADDRESS) == DATA


def test_a_part_that_is_being_written_stays_however_old_it_is(tmp_path: Path) -> None:
    """A link that stood still for longer than assets are kept: what then comes is not lost."""
    cache = AssetStore(tmp_path, max_bytes=100_000)
    parts = [cache.open_part(ADDRESS), cache.open_part(ADDRESS)]  # the common one, and one of our own
    left = cache.open_part("1" * 64)
    for part in (*parts, left):
        part.append(DATA[:40_000])
    left.close()
    for path in tmp_path.glob("??/*.part"):
        os.utime(path, (1, 1))
    assert cache.trim() == 80_000
    for part in parts:
        part.append(DATA[40_000:])
        assert part.finish()
    assert cache.find(ADDRESS) == DATA


def test_only_the_common_part_is_left_for_another_time(tmp_path: Path) -> None:
    cache = AssetStore(tmp_path)
    common, own = cache.open_part(ADDRESS), cache.open_part(ADDRESS)
    for part in (common, own):
        part.append(DATA[:40_000])
        part.close()
    assert [path.name for path in tmp_path.glob("??/*")] == [f"{ADDRESS}.part"]


def test_what_another_finishes_just_then_is_not_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the opening of its part and the lock on it: then it has the name of the asset."""
    cache = AssetStore(tmp_path)
    other = cache.open_part(ADDRESS)
    other.append(DATA)
    lock = fcntl.flock

    def finished_first(descriptor: int, how: int) -> None:
        monkeypatch.undo()
        assert other.finish()
        lock(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", finished_first)
    late = cache.open_part(ADDRESS)
    assert late.offset == 0
    late.append(b"other bytes")
    late.close()
    assert cache.find(ADDRESS) == DATA


def test_private_parts_of_processes_that_were_killed_do_not_pile_up(tmp_path: Path) -> None:
    """Nobody can go on with them, so they need not wait a week as common ones do."""
    cache = AssetStore(tmp_path)
    folder = cache.path(ADDRESS).parent
    folder.mkdir()
    common, dead, young = (folder / f"{ADDRESS}{end}.part" for end in ("", ".123-0123abcd", ".124-4567abcd"))
    for path, seconds in ((common, 2 * GRACE_S), (dead, 2 * GRACE_S), (young, 0.0)):
        path.write_bytes(b"begun")
        os.utime(path, (time.time() - seconds,) * 2)
    assert cache.trim() == 10
    assert [path.exists() for path in (common, dead, young)] == [True, False, True]


def test_more_than_twice_its_bound_is_never_stored(tmp_path: Path) -> None:
    """All of it was used just now: a session cannot fill the disk by naming ever more."""
    cache = AssetStore(tmp_path, max_bytes=1 << 20)
    for i in range(2):
        stored(cache, bytes([i]) * (1 << 20))
    part = cache.open_part(ADDRESS)
    with pytest.raises(AssetStoreError, match=r"full.*more than 1 MiB") as caught:
        part.append(DATA)
    assert caught.value.reason == "cache"
    part.close()
    for path in tmp_path.glob("??/*"):
        os.utime(path, (1, 1))
    assert stored(cache, DATA[:-1]) != ADDRESS, "there is room again"


def test_what_another_session_left_under_a_name_costs_one_more_fetch_and_no_more(tmp_path: Path) -> None:
    """A session that sends other bytes than those of the address, and is left in the middle of them."""
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
    assert stored(AssetStore(tmp_path), DATA) == ADDRESS


def test_parts_of_other_people_in_a_shared_folder_do_no_harm(tmp_path: Path) -> None:
    """Nor do links that somebody put there: nothing is written where they lead."""
    cache, elsewhere = AssetStore(tmp_path / "cache"), tmp_path / "elsewhere"
    elsewhere.write_bytes(b"precious")
    path = cache.path(ADDRESS)
    path.parent.mkdir(parents=True)
    path.with_name(path.name + ".part").symlink_to(elsewhere)
    assert stored(cache, DATA) == ADDRESS
    assert elsewhere.read_bytes() == b"precious"


def test_a_folder_that_cannot_be_used_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(AssetStoreError, match="cannot be used") as caught:
        AssetStore(tmp_path / "file").open_part(ADDRESS)
    assert caught.value.reason == "cache"
    assert "client.assets.cache = AssetStore(folder)" in str(caught.value), "how to name another one"
    assert "XDG_CACHE_HOME" in str(caught.value)
    with pytest.raises(ValueError, match="no address"):
        AssetStore(tmp_path).path("../../etc/passwd")


def test_a_client_and_a_session_can_share_a_folder(tmp_path: Path) -> None:
    """The client finds what the session stored, and its downloads remove nothing that the session holds."""
    session, client = AssetStore(tmp_path, max_bytes=2_000), AssetStore(tmp_path, max_bytes=2_000)
    held, old = session.put(b"h" * 1_000), session.put(b"o" * 1_000)
    for address in (held, old):
        age(session, address, GRACE_S + 100)
    with session.hold([held]):
        fetched = stored(client, b"f" * 1_000)
        assert [address in session for address in (held, old, fetched)] == [True, False, True]
        assert client.find(held) == b"h" * 1_000


# --- served assets ---


def test_bytes_and_sizes(tmp_path: Path) -> None:
    files = ServedAssets()
    data, empty, other = put(tmp_path, b"0123456789"), put(tmp_path, b""), put(tmp_path, b"other")
    files.serve([(str(tmp_path), (data, empty, "../../secret", "0" * 64))])
    assert (files.size(data), files.size(empty), files.size(other)) == (10, 0, None)
    assert bytes(files.chunk(data, 3, 4) or b"") == b"3456"
    assert files.chunk(data, 3, 8) is None
    assert bytes(files.chunk(empty, 0, 0) or b"") == b""
    assert files.size("0" * 64) is None  # named, but not there
    assert files.size("../../secret") is None


def test_several_stores_and_what_is_served_no_more(tmp_path: Path) -> None:
    files = ServedAssets()
    a, b = put(tmp_path / "1", b"a"), put(tmp_path / "2", b"b")
    files.serve([(str(tmp_path / "1"), (a,)), (str(tmp_path / "2"), (b,))])
    held = files.chunk(a, 0, 1)
    assert (files.size(a), files.size(b)) == (1, 1)
    files.serve([(str(tmp_path / "2"), (b,))])
    assert (files.size(a), files.size(b)) == (None, 1)
    assert bytes(held or b"") == b"a"  # on its way to somebody


def test_a_file_that_is_removed_or_no_file_at_all(tmp_path: Path) -> None:
    files = ServedAssets()
    a, link = put(tmp_path, b"a"), "ab" + "0" * 62
    (tmp_path / "ab").mkdir(exist_ok=True)
    (tmp_path / "ab" / link).symlink_to("/etc/passwd")
    folder = "cd" + "0" * 62
    (tmp_path / "cd" / folder).mkdir(parents=True)
    files.serve([(str(tmp_path), (a, link, folder))])
    assert files.size(a) == 1
    (tmp_path / a[:2] / a).unlink()
    assert bytes(files.chunk(a, 0, 1) or b"") == b"a"  # mapped: as it was
    assert files.size(link) is None
    assert files.size(folder) is None


def test_many_files_are_not_open_at_once(tmp_path: Path) -> None:
    files = ServedAssets()
    addresses = [put(tmp_path, b"%d" % i) for i in range(MAX_MAPPED_FILES + 40)]
    files.serve([(str(tmp_path), addresses)])
    for _ in range(2):
        for i, address in enumerate(addresses):
            assert bytes(files.chunk(address, 0, len(str(i))) or b"") == b"%d" % i
    assert len(files._mapped) <= MAX_MAPPED_FILES
