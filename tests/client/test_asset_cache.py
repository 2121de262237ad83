"""The cache of assets on disk: only what was hashed has its name, parts go on, several at once, and it is bounded."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

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
    assert cache.find(ADDRESS) == len(DATA)
    assert cache.read(ADDRESS) == bytes(cache.view(ADDRESS)) == DATA
    assert [path.name for path in tmp_path.glob("??/*")] == [ADDRESS]
    empty = hashlib.sha256(b"").hexdigest()
    assert cache.begin(empty).finish()
    assert (cache.find(empty), cache.read(empty), bytes(cache.view(empty))) == (0, b"", b"")


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
    assert cache.find(ADDRESS) == len(DATA)


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
    assert cache.find(addresses[0]) == 10_000  # used now
    assert cache.trim() == 20_000
    assert [cache.path(a).exists() for a in addresses] == [True, False, False, True]
    assert not (tmp_path / "00" / ("0" * 64 + ".part")).exists()


def test_a_folder_that_cannot_be_used_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(AssetError, match="cannot be used") as caught:
        AssetCache(tmp_path / "file").begin(ADDRESS)
    assert caught.value.reason == "cache"
    with pytest.raises(ValueError, match="no address"):
        AssetCache(tmp_path).path("../../etc/passwd")


def test_the_default_folder_is_that_of_caches(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert AssetCache().folder == tmp_path / "iris-session" / "client-assets"
