"""The cache of assets on disk: only what was hashed has its name, parts go on, several at once, and it is bounded."""

from __future__ import annotations

import fcntl
import hashlib
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from iris_session.assets.cache import IN_USE_S
from iris_session.client import AssetCache, AssetError

DATA = os.urandom(100_000)
ADDRESS = hashlib.sha256(DATA).hexdigest()


def test_what_was_stored_is_found_and_read(tmp_path: Path) -> None:
    cache = AssetCache(tmp_path)
    assert cache.find(ADDRESS) is None
    part = cache.begin(ADDRESS)
    part.append(DATA[:60_000])
    assert cache.find(ADDRESS) is None
    part.append(DATA[60_000:])
    assert part.finish()
    assert cache.find(ADDRESS) == DATA
    assert cache.read(ADDRESS) == bytes(cache.view(ADDRESS)) == DATA
    assert [path.name for path in tmp_path.glob("??/*")] == [ADDRESS]
    empty = hashlib.sha256(b"").hexdigest()
    assert cache.begin(empty).finish()
    assert (cache.find(empty), cache.read(empty), bytes(cache.view(empty))) == (b"", b"", b"")


def test_a_part_that_was_left_goes_on(tmp_path: Path) -> None:
    part = AssetCache(tmp_path).begin(ADDRESS)
    part.append(DATA[:40_000])
    part.close()
    again = AssetCache(tmp_path).begin(ADDRESS)
    assert again.offset == 40_000
    again.append(DATA[40_000:])
    assert again.finish()
    nothing = AssetCache(tmp_path).begin("0" * 64)
    nothing.close()
    assert len(list(tmp_path.glob("??/*"))) == 1


def test_wrong_bytes_never_get_the_name(tmp_path: Path) -> None:
    cache = AssetCache(tmp_path)
    part = cache.begin(ADDRESS)
    part.append(DATA[:-1] + b"?")
    assert not part.finish()
    assert part.offset == 0
    assert cache.find(ADDRESS) is None
    part.append(DATA)
    assert part.finish()


def test_damage_on_the_disk_is_found_and_taken_away(tmp_path: Path) -> None:
    cache = AssetCache(tmp_path)
    part = cache.begin(ADDRESS)
    part.append(DATA)
    assert part.finish()
    with cache.path(ADDRESS).open("r+b") as file:
        file.write(b"damaged")
    assert cache.find(ADDRESS) is None
    assert not cache.path(ADDRESS).exists()
    with pytest.raises(AssetError, match="fetch it again") as caught:
        cache.read(ADDRESS)
    assert caught.value.reason == "gone"


OTHER = """
import sys
from iris_session.client import AssetCache
part = AssetCache(sys.argv[1]).begin(sys.argv[2])
part.append(b"of somebody else")
print(part.offset, flush=True)
sys.stdin.read()
"""


def test_another_process_at_the_same_asset_does_no_harm(tmp_path: Path) -> None:
    command = [sys.executable, "-c", OTHER, str(tmp_path), ADDRESS]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        cache = AssetCache(tmp_path)
        ours = cache.begin(ADDRESS)
        assert ours.offset == 0
        ours.append(DATA)
        assert ours.finish()
        other.kill()
    late = cache.begin(ADDRESS)  # what the dead one left is nobody's
    assert late.offset == len(b"of somebody else")
    late.close()
    assert cache.find(ADDRESS) == DATA


def test_above_its_bound_the_longest_unused_goes(tmp_path: Path) -> None:
    cache = AssetCache(tmp_path, max_bytes=25_000)
    addresses = []
    for i in range(4):
        data = bytes([i]) * 10_000
        addresses.append(hashlib.sha256(data).hexdigest())
        part = cache.begin(addresses[-1])
        part.append(data)
        assert part.finish()
        os.utime(cache.path(addresses[-1]), (time.time() - 5000 + i,) * 2)
    old = cache.begin("0" * 64)
    old.append(b"x")
    old.close()
    os.utime(tmp_path / "00" / ("0" * 64 + ".part"), (1, 1))
    assert cache.find(addresses[0]) == bytes(10_000)  # used now
    assert cache.trim() == 20_000
    assert [cache.path(a).exists() for a in addresses] == [True, False, False, True]
    assert not (tmp_path / "00" / ("0" * 64 + ".part")).exists()


def stored(cache: AssetCache, data: bytes) -> str:
    address = hashlib.sha256(data).hexdigest()
    part = cache.begin(address)
    part.append(data)
    assert part.finish()
    return address


FULL_DISK = """
import resource, sys
from iris_session.client import AssetCache, AssetError
from iris_session.assets.cache import IN_USE_S
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
part = AssetCache(sys.argv[1]).begin(sys.argv[2])
try:
    part.append(sys.stdin.buffer.read())
except AssetError as error:
    part.close()
    print(error.reason, error)
"""


def test_a_disk_that_takes_no_more_says_so_and_what_it_took_is_gone_on_with(tmp_path: Path) -> None:
    command = [sys.executable, "-c", FULL_DISK, str(tmp_path), ADDRESS]
    done = subprocess.run(command, input=DATA, stdout=subprocess.PIPE, check=True, timeout=120)
    assert done.stdout.startswith(b"cache the cache of assets")
    again = AssetCache(tmp_path).begin(ADDRESS)
    assert again.offset == 50_000
    again.append(DATA[50_000:])
    assert again.finish()
    assert AssetCache(tmp_path).find(ADDRESS) == DATA


def test_a_part_that_is_being_written_stays_however_old_it_is(tmp_path: Path) -> None:
    """A link that stood still for longer than assets are kept: what then comes is not lost."""
    cache = AssetCache(tmp_path, max_bytes=100_000)
    parts = [cache.begin(ADDRESS), cache.begin(ADDRESS)]  # the common one, and one of our own
    left = cache.begin("1" * 64)
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
    cache = AssetCache(tmp_path)
    common, own = cache.begin(ADDRESS), cache.begin(ADDRESS)
    for part in (common, own):
        part.append(DATA[:40_000])
        part.close()
    assert [path.name for path in tmp_path.glob("??/*")] == [f"{ADDRESS}.part"]


def test_what_another_finishes_just_then_is_not_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the opening of its part and the lock on it: then it has the name of the asset."""
    cache = AssetCache(tmp_path)
    other = cache.begin(ADDRESS)
    other.append(DATA)
    lock = fcntl.flock

    def finished_first(descriptor: int, how: int) -> None:
        monkeypatch.undo()
        assert other.finish()
        lock(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", finished_first)
    late = cache.begin(ADDRESS)
    assert late.offset == 0
    late.append(b"other bytes")
    late.close()
    assert cache.find(ADDRESS) == DATA


def test_private_parts_of_processes_that_were_killed_do_not_pile_up(tmp_path: Path) -> None:
    """Nobody can go on with them, so they need not wait a week as common ones do."""
    cache = AssetCache(tmp_path)
    folder = cache.path(ADDRESS).parent
    folder.mkdir()
    common, dead, young = (folder / f"{ADDRESS}{end}.part" for end in ("", ".123-0123abcd", ".124-4567abcd"))
    for path, seconds in ((common, 2 * IN_USE_S), (dead, 2 * IN_USE_S), (young, 0.0)):
        path.write_bytes(b"begun")
        os.utime(path, (time.time() - seconds,) * 2)
    assert cache.trim() == 10
    assert [path.exists() for path in (common, dead, young)] == [True, False, True]


def test_more_than_twice_its_bound_is_never_stored(tmp_path: Path) -> None:
    """All of it was used just now: a session cannot fill the disk by naming ever more."""
    cache = AssetCache(tmp_path, max_bytes=1 << 20)
    for i in range(2):
        stored(cache, bytes([i]) * (1 << 20))
    part = cache.begin(ADDRESS)
    with pytest.raises(AssetError, match=r"full.*more than 1 MiB") as caught:
        part.append(DATA)
    assert caught.value.reason == "cache"
    part.close()
    for path in tmp_path.glob("??/*"):
        os.utime(path, (1, 1))
    assert stored(cache, DATA[:-1]) != ADDRESS, "there is room again"


def test_what_another_session_left_under_a_name_costs_one_more_fetch_and_no_more(tmp_path: Path) -> None:
    """A session that sends other bytes than those of the address, and is left in the middle of them."""
    for lie in (b"x" * 40_000, DATA[:-1] + b"?", DATA + b"longer than the asset"):
        part = AssetCache(tmp_path).begin(ADDRESS)
        part.append(lie)
        part.close()
        again = AssetCache(tmp_path).begin(ADDRESS)
        assert again.offset == len(lie)
        again.append(DATA[again.offset :])
        assert not again.finish()
        assert again.offset == 0
        assert AssetCache(tmp_path).find(ADDRESS) is None
        again.close()
    assert stored(AssetCache(tmp_path), DATA) == ADDRESS


def test_parts_of_other_people_in_a_shared_folder_do_no_harm(tmp_path: Path) -> None:
    """Nor do links that somebody put there: nothing is written where they lead."""
    cache, elsewhere = AssetCache(tmp_path / "cache"), tmp_path / "elsewhere"
    elsewhere.write_bytes(b"precious")
    path = cache.path(ADDRESS)
    path.parent.mkdir(parents=True)
    path.with_name(path.name + ".part").symlink_to(elsewhere)
    assert stored(cache, DATA) == ADDRESS
    assert elsewhere.read_bytes() == b"precious"


def test_a_folder_that_cannot_be_used_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(AssetError, match="cannot be used") as caught:
        AssetCache(tmp_path / "file").begin(ADDRESS)
    assert caught.value.reason == "cache"
    assert "client.assets.cache = AssetCache(folder)" in str(caught.value), "how to name another one"
    assert "XDG_CACHE_HOME" in str(caught.value)
    with pytest.raises(ValueError, match="no address"):
        AssetCache(tmp_path).path("../../etc/passwd")


def test_the_default_folder_is_that_of_caches(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert AssetCache().folder == tmp_path / "iris-session" / "client-assets"
