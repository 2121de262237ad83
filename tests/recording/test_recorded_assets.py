"""Assets in files: whole, changed, cut, missing, in parts, hostile; copies of Rerun's tools and repairs keep them."""

from __future__ import annotations

import hashlib
import itertools
import shutil
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from iris_session.journal.messages import Batch, SceneAssets
from iris_session.protocol.scene import SceneSpec, decode_scene, list_assets
from iris_session.recording import Recording, summarise, verify
from iris_session.recording.reader import check_assets
from iris_session.recording.repair import repair
from iris_session.recording.writer import RrdWriter
from iris_session.rrd.assets import (
    ALL,
    NONE,
    SCENE,
    AssetCollector,
    AssetFault,
    AssetJoiner,
    AssetPiece,
    AssetQueue,
    RecordedScene,
    check_piece,
    list_recorded_assets,
)
from iris_session.rrd.index import add_index
from iris_session.scene import AssetStore, decode_mesh
from iris_session.scene.mujoco_scene import parse_mujoco
from tests.recording.support import SmallCore, journal
from tests.recording.test_optimized import optimize
from tests.scene.models import every_shape

STEPS = 40


class Shared:
    """A scene in a store, as a session shares it."""

    def __init__(self, root: Path) -> None:
        self.store = AssetStore(root)
        parsed = parse_mujoco(every_shape(), self.store)
        self.spec: SceneSpec = parsed.spec
        self.scene_hash = parsed.scene_hash
        self.assets = SceneAssets(-1, 0, str(root), self.scene_hash)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Shared:
    return Shared(tmp_path_factory.mktemp("shared"))


def record(path: Path, shared: Shared, recorded: str = SCENE) -> Path:
    """Record a session whose assets come in small pieces."""
    header, batch = journal(STEPS)
    writer = RrdWriter(path, "id", AssetQueue(recorded))
    writer.write_header(header)
    writer.add(Batch(assets=[shared.assets]))
    writer.write_assets(1 << 20)
    assert not list(_pieces(path)), "nothing is earlier than the first row"
    for i in range(0, STEPS, 20):
        keyframes = [k for k in batch.keyframes if i == 0 or k.step >= i]
        batch.keyframes = [k for k in batch.keyframes if k not in keyframes]
        writer.add(Batch(rows=batch.rows[i : i + 20], keyframes=keyframes))
        writer.flush()
        while i == 0 and writer.assets:
            writer.write_assets(5000)
    writer.close()
    return path


def _pieces(path: Path) -> Iterator[AssetPiece]:
    with Recording.open(path, warn=False) as recording:
        for item in recording.outline():
            if isinstance(item, AssetPiece):
                yield item


@pytest.fixture(scope="module")
def whole(shared: Shared, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("whole") / "session.rrd", shared)


def test_scene_can_be_shown_from_the_file_alone(whole: Path, shared: Shared) -> None:
    with Recording.open(whole) as recording:
        scenes = list(recording.scenes())
        assert scenes == [RecordedScene(-1, 0, shared.scene_hash, SCENE)]
        spec = decode_scene(recording.asset(scenes[0].hash))
        assert spec == shared.spec
        level = spec.meshes[0].levels[0]
        assert decode_mesh(recording.asset(level.address)).vertices == level.vertices
        with pytest.raises(LookupError, match="does not hold the asset 0000"):
            recording.asset("0" * 64)
        found = dict(recording.assets())
        assert summarise(recording).damage == ()
    wanted = {shared.scene_hash, *list_recorded_assets(shared.spec, SCENE)}
    assert found == {address: shared.store.get(address) for address in wanted}
    assert len({piece.address for piece in _pieces(whole)}) == len(wanted)
    assert sum(len(piece.data) for piece in _pieces(whole)) == sum(map(len, found.values())), "each once"


def test_finest_levels_are_what_a_client_needs(shared: Shared) -> None:
    names = list_recorded_assets(shared.spec, SCENE)
    for thing in (*shared.spec.meshes, *shared.spec.textures):
        assert thing.levels[0].address in names
    assert set(names) <= set(list_recorded_assets(shared.spec, ALL)) == set(list_assets(shared.spec))
    assert list_recorded_assets(shared.spec, NONE) == {}
    mesh = shared.spec.meshes[0]
    coarse = msgspec.structs.replace(mesh.levels[0], address="c" * 64)
    spec = SceneSpec(meshes=(msgspec.structs.replace(mesh, name="arm", levels=(*mesh.levels, coarse)),))
    assert list_recorded_assets(spec, SCENE) == {mesh.levels[0].address: "mesh arm"}
    assert list_recorded_assets(spec, ALL) == {mesh.levels[0].address: "mesh arm", "c" * 64: "mesh arm, level 1"}


def test_changed_byte_of_an_asset_is_found_and_named(whole: Path, shared: Shared, tmp_path: Path) -> None:
    path = Path(shutil.copy(whole, tmp_path))
    assert add_index(path)
    mesh = shared.spec.meshes[0]
    address = mesh.levels[0].address
    data = bytearray(path.read_bytes())
    at = data.find(shared.store.get(address)[-40:])
    assert at > 0
    data[at + 20] ^= 1
    path.write_bytes(data)
    report = verify(path, SmallCore)
    assert not report.ok
    (problem,) = [one for one in report.problems if one.field == "asset"]
    assert problem.text.startswith(f"asset {address[:12]} (mesh {mesh.name or 0}) is not ")
    with Recording.open(path, warn=False) as recording:
        summary = summarise(recording)
        assert problem.text in summary.damage
        assert summary.assets.present == summary.assets.expected - 1
        with pytest.raises(LookupError):
            recording.asset(address)
    assert problem.text in repair(path, tmp_path / "repaired.rrd").damage


def test_copies_of_rerun_and_repaired_files_keep_them(whole: Path, tmp_path: Path) -> None:
    copy = optimize(tmp_path / "copy.rrd", whole, "--split-size-ratio", "1")
    repair(whole, tmp_path / "repaired.rrd")
    with Recording.open(whole) as recording:
        before = dict(recording.assets())
    for path in (copy, tmp_path / "repaired.rrd"):
        with Recording.open(path) as recording:
            assert dict(recording.assets()) == before
            assert check_assets(recording).list_problems(finished=True) == []


# --- joining ----------------------------------------------------------------------------------------------------------


def pieces(data: bytes, size: int, is_scene: bool = False) -> list[AssetPiece]:
    address = hashlib.sha256(data).hexdigest()
    return [AssetPiece(address, i, len(data), is_scene, data[i : i + size]) for i in range(0, max(1, len(data)), size)]


def test_joiner_returns_an_asset_once() -> None:
    joiner = AssetJoiner()
    found = [joiner.add(piece) for piece in (*pieces(b"abcdef", 2), *pieces(b"", 1), *pieces(b"abcdef", 3))]
    assert found == [None, None, b"abcdef", b"", None, None]
    assert (list(joiner.whole.values()), joiner.changed) == ([6, 0], {})


def test_pieces_with_impossible_numbers_are_refused() -> None:
    good = pieces(b"abc", 3)[0]
    assert check_piece(good) == good
    for fields in ({"offset": -1}, {"total": 2}, {"total": 1 << 40}, {"offset": 1}, {"address": "../../etc/passwd"}):
        with pytest.raises(ValueError, match="of an asset"):
            check_piece(good._replace(**fields))  # type: ignore[arg-type]


def test_what_could_not_be_recorded_is_no_damage() -> None:
    scene, gone = pieces(b"no specification", 99, is_scene=True)[0], "7" * 64
    for order in itertools.permutations(
        [RecordedScene(-1, 0, scene.address, SCENE), scene, AssetFault(gone, "it cannot be read")]
    ):
        found = AssetCollector()
        for item in order:
            found.add(item)
        summary = found.summarise()
        assert found.list_problems(finished=True) == []
        assert (summary.expected, summary.present) == (1, 1)
        assert summary.left_out == ("asset 777777777777: it cannot be read",)
        found.add(RecordedScene(5, 6, gone, SCENE))
        assert found.list_problems(finished=True) == []
        assert found.summarise().left_out == (f"asset {gone[:12]} (specification of the scene): it cannot be read",)
