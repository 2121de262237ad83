"""Visual changes of a scene while people are in it: what a patch may hold, and what a scene is after it.

Everything here concerns drawing only. Bodies, joints and what collides change with another scene. A patch is applied
whole or not at all; after it the scene has the hash of its new specification.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import msgspec

from iris_session.protocol.common import Count, Pose
from iris_session.protocol.scene import SceneError, SceneSpec, Visual, check_scene
from iris_session.protocol.scene_looks import Int32, Material, Mesh, Ref, Rgba

#: Operations of one patch, and all that a scene may have had since it was loaded.
MAX_OPS: Final = 64
MAX_PATCHES: Final = 1024


class SetVisual(msgspec.Struct, frozen=True, tag_field="op", tag="set_visual"):
    """Changes how a visual is drawn; what is not given stays. `rgba` with alpha 0 hides it."""

    visual: Count
    rgba: Rgba | None = None
    group: Int32 | None = None
    material: Ref | None = None
    T_body_visual: Pose | None = None


class AddVisual(msgspec.Struct, frozen=True, tag_field="op", tag="add_visual"):
    """Decoration on a body (0: the world). Its `id` must be free."""

    visual: Visual


class RemoveVisual(msgspec.Struct, frozen=True, tag_field="op", tag="remove_visual"):
    visual: Count


class AddMesh(msgspec.Struct, frozen=True, tag_field="op", tag="add_mesh"):
    """At the end of the list, for visuals that come after it."""

    mesh: Mesh


class AddMaterial(msgspec.Struct, frozen=True, tag_field="op", tag="add_material"):
    """At the end of the list, for visuals that come after it."""

    material: Material


PatchOp = SetVisual | AddVisual | RemoveVisual | AddMesh | AddMaterial


def patched(spec: SceneSpec, ops: Sequence[PatchOp]) -> SceneSpec:
    """The scene after a patch. Raises `SceneError` that says what does not fit; nothing is changed then.

    `totals` stay those of the scene as it was loaded.
    """
    if len(ops) > MAX_PATCHES:
        raise SceneError(f"{len(ops)} operations at once, at most {MAX_PATCHES}")
    visuals = {visual.id: visual for visual in spec.visuals}
    meshes, materials = list(spec.meshes), list(spec.materials)
    for op in ops:
        if isinstance(op, AddVisual):
            if op.visual.id in visuals:
                raise SceneError(f"there is a visual {op.visual.id} already: take an id that is free")
            visuals[op.visual.id] = op.visual
        elif isinstance(op, AddMesh):
            meshes.append(op.mesh)
        elif isinstance(op, AddMaterial):
            materials.append(op.material)
        elif op.visual not in visuals:
            raise SceneError(f"there is no visual {op.visual}")
        elif isinstance(op, SetVisual):
            visuals[op.visual] = _set(visuals[op.visual], op)
        else:
            del visuals[op.visual]
    after = msgspec.structs.replace(
        spec, visuals=tuple(visuals.values()), meshes=tuple(meshes), materials=tuple(materials)
    )
    check_scene(after)
    return after


def merged(before: Iterable[PatchOp], ops: Iterable[PatchOp]) -> tuple[PatchOp, ...]:
    """One list of operations that does what both do, in as few as there is something to say of each visual."""
    found: list[PatchOp] = list(before)
    for op in ops:
        earlier = next((i for i in range(len(found) - 1, -1, -1) if _about(found[i]) == _about(op)), -1)
        old = found[earlier] if earlier >= 0 else None
        if isinstance(op, SetVisual) and isinstance(old, SetVisual):
            found[earlier] = msgspec.structs.replace(old, **_given(op))
        elif isinstance(op, SetVisual) and isinstance(old, AddVisual):
            found[earlier] = AddVisual(_set(old.visual, op))
        elif isinstance(op, RemoveVisual) and isinstance(old, AddVisual):
            del found[earlier]  # what it refers to may serve others: lists keep their order
        elif isinstance(op, RemoveVisual) and isinstance(old, SetVisual):
            found[earlier] = op
        else:
            found.append(op)
    return tuple(found)


def _about(op: PatchOp) -> int | None:
    """Id of the visual that an operation is about; additions to lists are about themselves only."""
    if isinstance(op, AddVisual):
        return op.visual.id
    return op.visual if isinstance(op, SetVisual | RemoveVisual) else None


def _given(op: SetVisual) -> dict[str, object]:
    fields = ("rgba", "group", "material", "T_body_visual")
    return {name: getattr(op, name) for name in fields if getattr(op, name) is not None}


def _set(visual: Visual, op: SetVisual) -> Visual:
    return msgspec.structs.replace(visual, **_given(op))
