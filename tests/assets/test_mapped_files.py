"""Files of a store: only what is served, by address, and what vanishes does not take anything with it."""

from __future__ import annotations

from pathlib import Path

from iris_session.assets.mapped_files import MAX_OPEN, AssetFiles
from tests.front.asset_rig import put


def test_bytes_and_sizes(tmp_path: Path) -> None:
    files = AssetFiles()
    data, empty, other = put(tmp_path, b"0123456789"), put(tmp_path, b""), put(tmp_path, b"other")
    files.serve([(str(tmp_path), (data, empty, "../../secret", "0" * 64))])
    assert (files.size(data), files.size(empty), files.size(other)) == (10, 0, None)
    assert bytes(files.chunk(data, 3, 4) or b"") == b"3456"
    assert files.chunk(data, 3, 8) is None
    assert bytes(files.chunk(empty, 0, 0) or b"") == b""
    assert files.size("0" * 64) is None  # named, but not there
    assert files.size("../../secret") is None


def test_several_stores_and_what_is_served_no_more(tmp_path: Path) -> None:
    files = AssetFiles()
    a, b = put(tmp_path / "1", b"a"), put(tmp_path / "2", b"b")
    files.serve([(str(tmp_path / "1"), (a,)), (str(tmp_path / "2"), (b,))])
    held = files.chunk(a, 0, 1)
    assert (files.size(a), files.size(b)) == (1, 1)
    files.serve([(str(tmp_path / "2"), (b,))])
    assert (files.size(a), files.size(b)) == (None, 1)
    assert bytes(held or b"") == b"a"  # on its way to somebody


def test_a_file_that_is_removed_or_no_file_at_all(tmp_path: Path) -> None:
    files = AssetFiles()
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
    files = AssetFiles()
    addresses = [put(tmp_path, b"%d" % i) for i in range(MAX_OPEN + 40)]
    files.serve([(str(tmp_path), addresses)])
    for _ in range(2):
        for i, address in enumerate(addresses):
            assert bytes(files.chunk(address, 0, len(str(i))) or b"") == b"%d" % i
    assert len(files._mapped) <= MAX_OPEN
