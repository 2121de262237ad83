"""The store: addresses, atomic files, and room that is made without taking what is in use."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from iris_session.scene import AssetMissingError, AssetStore, default_root
from iris_session.scene.store import GRACE_S


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
    assert not store.used(missing)
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


def test_room_is_made_from_what_was_used_longest_ago(tmp_path: Path) -> None:
    store = AssetStore(tmp_path, limit_bytes=3_000)
    first, second, third = (store.put(bytes([k]) * 1_000) for k in range(3))
    for k, address in enumerate((first, second, third)):
        age(store, address, GRACE_S + 300 - 100 * k)
    assert store.used(first)
    fresh = store.put(b"x" * 1_000)
    assert [a in store for a in (first, second, third, fresh)] == [True, False, True, True]
    assert store.evicted == 1


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


def test_where_it_lies(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_root() == tmp_path / "iris-session" / "assets"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert default_root() == Path.home() / ".cache" / "iris-session" / "assets"
