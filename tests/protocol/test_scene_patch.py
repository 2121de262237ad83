"""Visual patches: atomic, and merged patches equal their sequence."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.scene import (
    AddMaterial,
    AddVisual,
    Body,
    Geometry,
    Material,
    PatchOp,
    RemoveVisual,
    SceneError,
    SceneSpec,
    SetVisual,
    Visual,
    apply_patch,
    decode_scene,
    encode_scene,
    merge_patches,
)

RED = (1.0, 0.0, 0.0, 1.0)
UP = Pose((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))


def box(number: int, **fields: object) -> Visual:
    plain = Visual(number, 0, f"box{number}", IDENTITY, 0, Geometry("box", (0.1, 0.1, 0.1)), -1, (0.5, 0.5, 0.5, 1.0))
    return Visual(**{**{f: getattr(plain, f) for f in plain.__struct_fields__}, **fields})  # type: ignore[arg-type]


SPEC = SceneSpec(
    bodies=(Body(0, "world", -1, IDENTITY, IDENTITY, False),),
    visuals=(box(1), box(2), box(3)),
    materials=(Material("grey", RED),),
)


def test_patch_changes_only_what_it_names() -> None:
    ops: list[PatchOp] = [
        SetVisual(1, rgba=RED),
        SetVisual(2, group=4, T_body_visual=UP),
        RemoveVisual(3),
        AddMaterial(Material("gold", RED)),
        AddVisual(box(9, material=1)),
    ]
    after = apply_patch(SPEC, ops)
    assert after.visuals == (box(1, rgba=RED), box(2, group=4, T_body_visual=UP), box(9, material=1))
    assert after.materials == (*SPEC.materials, Material("gold", RED))
    assert decode_scene(encode_scene(after)) == after


@pytest.mark.parametrize(
    ("ops", "expected"),
    [
        ([SetVisual(1, rgba=RED), SetVisual(7, rgba=RED)], "no visual 7"),
        ([RemoveVisual(7)], "no visual 7"),
        ([AddVisual(box(2))], "already"),
        ([AddVisual(box(9, material=1))], "material 1, .* 1"),
        ([AddVisual(box(9, body=5))], "body 5"),
        ([RemoveVisual(1), SetVisual(1, rgba=RED)], "no visual 1"),
    ],
)
def test_invalid_patch_raises(ops: list[PatchOp], expected: str) -> None:
    with pytest.raises(SceneError, match=expected):
        apply_patch(SPEC, ops)


IDS = st.integers(1, 5)
OPS = st.one_of(
    st.builds(SetVisual, IDS, rgba=st.sampled_from([None, RED]), group=st.sampled_from([None, 1, 2])),
    st.builds(SetVisual, IDS, T_body_visual=st.sampled_from([None, UP, IDENTITY])),
    st.builds(RemoveVisual, IDS),
    st.builds(lambda n: AddVisual(box(n)), IDS),
    st.just(AddMaterial(Material("gold", RED))),
)


@given(st.lists(OPS, max_size=12))
def test_merged_patches_equal_their_sequence(ops: list[PatchOp]) -> None:
    spec, done = SPEC, ()
    for op in ops:
        try:
            spec = apply_patch(spec, [op])
        except SceneError:
            continue
        done = merge_patches(done, [op])
    assert encode_scene(apply_patch(SPEC, done)) == encode_scene(spec), "and so the hash is the same"
    about = [op for op in done if isinstance(op, SetVisual)]
    assert len({op.visual for op in about}) == len(about)
