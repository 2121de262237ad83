"""docs/protocol/scene.json is complete, round-trips, reads the same in another library, is rejected where stated."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]
import msgspec
import pytest

from iris_session.protocol import names
from iris_session.protocol.scene import (
    MAX_SCENE_BYTES,
    MAX_THINGS,
    Material,
    PatchOp,
    SceneError,
    SceneSpec,
    apply_patch,
    check_scene,
    decode_scene,
    encode_scene,
)
from tests.codegen.test_interop import is_same_value, reverse_keys, unpack
from tools.codegen import schema

GOLDEN = json.loads((Path(__file__).parents[2] / "docs" / "protocol" / "scene.json").read_text())
KINDS = {kind.__name__: kind for group in ("scene", "arrays", "patch") for kind in schema.GROUPS[group]}
SCENES = {row["name"]: row for row in GOLDEN["scenes"]}
MALFORMED = {row["name"]: row for row in GOLDEN["malformed"]}
_spec_types = msgspec.msgpack.Decoder(SceneSpec)


def named(rows: list[dict[str, Any]]) -> list[Any]:
    return [pytest.param(row, id=row["name"]) for row in rows]


@pytest.mark.parametrize("row", named(GOLDEN["structs"]))
def test_every_struct_round_trips_also_in_another_library(row: dict[str, Any]) -> None:
    kind, data = KINDS[row["type"]], bytes.fromhex(row["hex"])
    value: Any = msgspec.convert(row["value"], kind)
    assert msgspec.msgpack.encode(value) == data
    assert msgspec.msgpack.decode(data, type=kind) == value
    packed = unpack(data)
    assert is_same_value(packed, row["value"])
    assert msgspec.msgpack.decode(msgpack.packb(reverse_keys(packed)), type=kind) == value


@pytest.mark.parametrize("row", named(GOLDEN["scenes"]))
def test_scenes_decode_to_their_value(row: dict[str, Any]) -> None:
    data = bytes.fromhex(row["hex"])
    spec = decode_scene(data)
    assert spec == msgspec.convert(row["value"], SceneSpec)
    assert hashlib.sha256(data).hexdigest() == row["address"]
    assert (encode_scene(spec) == data) == row["canonical"]
    if row["canonical"]:
        assert is_same_value(unpack(data), row["value"])


@pytest.mark.parametrize("row", named(GOLDEN["patches"]))
def test_patches_produce_the_stated_scene(row: dict[str, Any]) -> None:
    data = bytes.fromhex(row["hex"])
    ops: tuple[PatchOp, ...] = msgspec.msgpack.decode(data, type=tuple[PatchOp, ...])
    assert is_same_value(unpack(data), row["value"])
    assert msgspec.msgpack.encode(ops) == data
    before = decode_scene(bytes.fromhex(SCENES[row["before"]]["hex"]))
    after = encode_scene(apply_patch(before, ops))
    assert hashlib.sha256(after).hexdigest() == row["after"]
    changes_nothing = row["name"] != "every operation"
    assert (row["after"] == SCENES[row["before"]]["address"]) == changes_nothing


@pytest.mark.parametrize("row", named(GOLDEN["malformed"]))
def test_malformed_scenes_are_rejected(row: dict[str, Any]) -> None:
    """By types and bounds, which generated readers check, or by content."""
    data = bytes.fromhex(row["hex"])
    with pytest.raises(SceneError):
        decode_scene(data)
    if row["checked"]:
        _spec_types.decode(data)
    else:
        with pytest.raises(msgspec.DecodeError):
            _spec_types.decode(data)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("version 2", "version 2"),
        ("a body that is not there", "body 77"),
        ("33 levels of detail", "32"),
    ],
)
def test_rejections_name_the_value(name: str, expected: str) -> None:
    with pytest.raises(SceneError, match=expected):
        decode_scene(bytes.fromhex(MALFORMED[name]["hex"]))


def test_deep_or_long_scenes_are_rejected_early() -> None:
    with pytest.raises(SceneError):
        decode_scene(b"\x81\xa4deep" + b"\x91" * 100_000 + b"\xc0")
    with pytest.raises(SceneError, match="32000000"):
        decode_scene(bytes(MAX_SCENE_BYTES + 1))


def test_many_small_items_are_rejected_before_allocation() -> None:
    """32 MB may contain two million materials, which would take 600 MiB."""
    one = msgspec.msgpack.encode({"name": "", "rgba": [0, 0, 0, 0]})
    data = b"\x81\xa9materials\xdd" + (MAX_THINGS + 1).to_bytes(4, "big") + one * (MAX_THINGS + 1)
    with pytest.raises(SceneError, match="65536"):
        decode_scene(data)
    with pytest.raises(SceneError, match=r"65537.*65536"):
        check_scene(SceneSpec(materials=(Material("", (0.0, 0.0, 0.0, 0.0)),) * (MAX_THINGS + 1)))


def test_unreadable_scenes_are_not_written() -> None:
    whole = decode_scene(bytes.fromhex(SCENES["every kind of thing"]["hex"]))
    many = msgspec.structs.replace(whole, visuals=whole.visuals * 15_000)
    with pytest.raises(SceneError, match=r"150000 visuals, .* 32000000"):
        encode_scene(many)


def test_every_struct_and_kind_has_a_vector() -> None:
    listed = {row["name"] for row in GOLDEN["structs"]}
    assert listed >= {f"{name}/{make}" for name in KINDS for make in ("full", "least")}
    whole = decode_scene(bytes.fromhex(SCENES["every kind of thing"]["hex"]))
    for field in whole.__struct_fields__:
        assert getattr(whole, field) != getattr(SceneSpec(), field) or field == "version", field
    kinds = names.GeometryKind.ALL
    assert {visual.geometry.kind for visual in whole.visuals} - kinds == {"torus"}, "and an unknown one"
    assert {visual.geometry.kind for visual in whole.visuals} >= kinds
    assert {light.kind for light in whole.lights} == names.LightKind.ALL
    assert {texture.kind for texture in whole.textures} == names.TextureKind.ALL
    assert {part.dim for part in whole.deformables} == {1, 2, 3}
    encodings = {level.encoding for texture in whole.textures for level in texture.levels}
    assert encodings == set(schema.list_enums()["AssetEncoding"].values())
    done = {op["op"] for row in GOLDEN["patches"] for op in row["value"]}
    assert done == {struct.tag for struct in schema.list_structs("patch")}
