"""USD stages: what people see of them and where, compared with what OpenUSD says itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from iris_session import AssetStore, SceneBuilder
from iris_session.protocol.names import GeometryKind
from iris_session.protocol.scene import SceneSpec
from iris_session.scene.nodes import to_matrix
from iris_session.scene.result import ComposedScene
from iris_session.simulators import SimulatorError, find_adapter

pytest.importorskip("pxr", reason="usd-core is not installed")

from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt


def make_stage(*, unit: float = 1.0, up: str = "Z") -> Any:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    UsdGeom.SetStageUpAxis(stage, up)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    return stage


def place(prim: Any, position: Any = (0, 0, 0), degrees: float = 0.0, scale: Any = (1, 1, 1)) -> Any:
    """Move, turn around x, and scale a prim; return its op that moves."""
    xform = UsdGeom.Xformable(prim)
    move = xform.AddTranslateOp()
    move.Set(Gf.Vec3d(*position))
    xform.AddRotateXOp().Set(degrees)
    xform.AddScaleOp().Set(Gf.Vec3f(*scale))
    return move


def make_square(stage: Any, path: str, *, quads: int = 1) -> Any:
    """Define squares of 1 side by side along x, whose normals are +z."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    points = [(x, y, 0) for x in range(quads + 1) for y in (0, 1)]
    mesh.CreatePointsAttr([Gf.Vec3f(*p) for p in points])
    mesh.CreateFaceVertexCountsAttr([4] * quads)
    mesh.CreateFaceVertexIndicesAttr([v for i in range(0, 2 * quads, 2) for v in (i, i + 2, i + 3, i + 1)])
    return mesh


def build(stage: Any, folder: Path) -> tuple[Any, ComposedScene]:
    adapter = find_adapter(stage)
    assert adapter is not None
    builder = SceneBuilder(adapter.name)
    adapter.build(builder)
    return adapter, builder.build(AssetStore(folder))


def bounds_of(spec: SceneSpec, body: str) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return lowest and highest corner in the world of what is drawn on a body, by the boxes of its visuals."""
    ids = {one.name: one for one in spec.bodies}
    corners = []
    for visual in spec.visuals:
        if visual.body != ids[body].id:
            continue
        T_world_visual = to_matrix(ids[body].T_world_body) @ to_matrix(visual.T_body_visual)
        if visual.geometry.kind == GeometryKind.MESH:
            mesh = spec.meshes[visual.geometry.mesh]
            low, high = np.array(mesh.low), np.array(mesh.high)
        else:
            half = np.array(visual.geometry.size)
            if visual.geometry.kind == GeometryKind.CAPSULE:
                half[2] += half[0]
            low, high = -half, half
        box = np.array([[(low, high)[(k >> d) & 1][d] for d in range(3)] for k in range(8)])
        corners.append(box @ T_world_visual[:3, :3].T + T_world_visual[:3, 3])
    found = np.concatenate(corners)
    return found.min(axis=0), found.max(axis=0)


def bounds_in_usd(stage: Any, path: str) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return the same as OpenUSD computes it, in metres with z up."""
    unit, up = UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)
    cache = UsdGeom.BBoxCache(Usd.TimeCode.EarliestTime(), ["default", "render"])
    found = cache.ComputeWorldBound(stage.GetPrimAtPath(path)).ComputeAlignedRange()
    corners = unit * np.array([list(found.GetCorner(k)) for k in range(8)])
    if up == "Y":
        corners = corners[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    return corners.min(axis=0), corners.max(axis=0)


@pytest.mark.parametrize(("unit", "up"), [(1.0, "Z"), (0.01, "Y")])
def test_bodies_are_where_openusd_says_in_every_unit_and_up_axis(unit: float, up: str, tmp_path: Path) -> None:
    stage = make_stage(unit=unit, up=up)
    scale = 1.0 / unit
    shapes = {
        "cube": UsdGeom.Cube.Define(stage, "/World/group/cube"),
        "ball": UsdGeom.Sphere.Define(stage, "/World/group/ball"),
        "can": UsdGeom.Cylinder.Define(stage, "/World/group/can"),
        "pill": UsdGeom.Capsule.Define(stage, "/World/group/pill"),
        "cone": UsdGeom.Cone.Define(stage, "/World/group/cone"),
        "tile": make_square(stage, "/World/group/tile"),
    }
    place(UsdGeom.Xform.Define(stage, "/World/group"), (1, 2, 3), 90.0, (scale, scale, scale))
    shapes["can"].CreateAxisAttr("X")
    for k, prim in enumerate(shapes.values()):
        UsdPhysics.RigidBodyAPI.Apply(prim.GetPrim())
        place(prim, (0.3 * k, 0.1, 0.2), 90.0 if k % 2 else 0.0, (0.1, 0.1, 0.1) if k else (0.1, 0.2, 0.3))
    adapter, made = build(stage, tmp_path)
    assert adapter.bodies == list(shapes)
    kinds = {body.name: v.geometry.kind for body in made.spec.bodies for v in made.spec.visuals if v.body == body.id}
    assert kinds == {
        **{"cube": GeometryKind.BOX, "ball": GeometryKind.SPHERE, "can": GeometryKind.CYLINDER},
        **{"pill": GeometryKind.CAPSULE, "cone": GeometryKind.MESH, "tile": GeometryKind.MESH},
    }
    for name in shapes:
        for ours, theirs in zip(bounds_of(made.spec, name), bounds_in_usd(stage, f"/World/group/{name}"), strict=True):
            assert ours == pytest.approx(theirs, abs=1e-5), name


def test_shapes_that_are_stretched_to_no_shape_become_meshes(tmp_path: Path) -> None:
    stage = make_stage()
    ball = UsdGeom.Sphere.Define(stage, "/World/egg")
    place(ball, scale=(0.1, 0.2, 0.3))
    _, made = build(stage, tmp_path)
    (visual,) = made.spec.visuals
    assert visual.geometry.kind == GeometryKind.MESH
    for ours, theirs in zip(bounds_of(made.spec, "egg"), bounds_in_usd(stage, "/World/egg"), strict=True):
        assert ours == pytest.approx(theirs, abs=2e-3)


def test_sync_reads_the_stage_as_it_is(tmp_path: Path) -> None:
    stage = make_stage(unit=0.01)
    move = place(UsdGeom.Cube.Define(stage, "/World/cube"), (100, 0, 0))
    UsdPhysics.RigidBodyAPI.Apply(stage.GetPrimAtPath("/World/cube"))
    adapter, _ = build(stage, tmp_path)
    move.Set(Gf.Vec3d(0, 50, 20))
    state = adapter.read_state()
    assert state.positions.tolist() == [[0.0, 0.5, 0.2]]
    assert state.time_s is None


def test_animations_are_read_at_a_time_code(tmp_path: Path) -> None:
    stage = make_stage()
    stage.SetTimeCodesPerSecond(10)
    stage.SetStartTimeCode(10)
    stage.SetEndTimeCode(30)
    move = place(UsdGeom.Cube.Define(stage, "/World/cube"))
    for code in (10, 20):
        move.Set(Gf.Vec3d(code, 0, 0), code)
    sheet = make_square(stage, "/World/sheet")
    points = np.array(sheet.GetPointsAttr().Get())
    sheet.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points), 10)
    sheet.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points + np.float32(1.0)), 20)
    adapter, made = build(stage, tmp_path)
    assert adapter.bodies == ["cube"]
    assert list(made.deformables) == ["sheet"]
    state = adapter.read_state(15.0)
    assert state.time_s == 0.5
    assert state.positions[0].tolist() == [15.0, 0.0, 0.0]
    assert state.vertices["sheet"] == pytest.approx(points + 0.5)


def test_instances_share_their_mesh(tmp_path: Path) -> None:
    stage = make_stage()
    make_square(stage, "/Prototypes/part/mesh")
    for k in range(3):
        prim = stage.DefinePrim(f"/World/part_{k}", "Xform")
        prim.GetReferences().AddInternalReference("/Prototypes/part")
        prim.SetInstanceable(True)
        place(prim, (2.0 * k, 0, 0))
        UsdPhysics.RigidBodyAPI.Apply(prim)
    UsdGeom.Imageable(stage.OverridePrim("/Prototypes")).MakeInvisible()
    UsdGeom.Scope.Define(stage, "/Prototypes").MakeInvisible()
    adapter, made = build(stage, tmp_path)
    assert adapter.bodies == ["part_0", "part_1", "part_2"]
    assert len(made.spec.visuals) == 3
    assert len(made.spec.meshes) == 1
    assert [pose.p[0] for pose in made.poses] == [0.0, 2.0, 4.0]


def make_bolts(stage: Any) -> Any:
    bolts = UsdGeom.PointInstancer.Define(stage, "/World/bolts")
    for k, size in enumerate((0.1, 0.2)):
        UsdGeom.Cube.Define(stage, f"/World/bolts/kinds/kind_{k}").CreateSizeAttr(size)
    bolts.CreatePrototypesRel().SetTargets([f"/World/bolts/kinds/kind_{k}" for k in range(2)])
    bolts.CreateProtoIndicesAttr([0, 1, 0])
    bolts.CreatePositionsAttr([Gf.Vec3f(k, 0, 0) for k in range(3)])
    bolts.CreateScalesAttr([Gf.Vec3f(1), Gf.Vec3f(2), Gf.Vec3f(1)])
    place(bolts, (0, 1, 0))
    return bolts


def test_point_instancers_have_one_shape_an_instance(tmp_path: Path) -> None:
    stage = make_stage()
    make_bolts(stage)
    UsdGeom.Cube.Define(stage, "/World/thing")
    UsdPhysics.RigidBodyAPI.Apply(stage.GetPrimAtPath("/World/thing"))
    _, made = build(stage, tmp_path)
    static = [v for v in made.spec.visuals if v.body == 0]
    assert [v.T_body_visual.p for v in static] == [(0.0, 1.0, 0.0), (1.0, 1.0, 0.0), (2.0, 1.0, 0.0)]
    assert [round(v.geometry.size[0], 6) for v in static] == [0.05, 0.2, 0.05]


def test_instances_that_are_animated_are_bodies(tmp_path: Path) -> None:
    stage = make_stage()
    bolts = make_bolts(stage)
    for code in (0, 10):
        bolts.GetPositionsAttr().Set([Gf.Vec3f(k, 0, 0.1 * code) for k in range(3)], code)
    adapter, made = build(stage, tmp_path)
    assert adapter.bodies == ["bolts_0", "bolts_1", "bolts_2"]
    assert len(made.spec.visuals) == 3
    assert adapter.read_state(5.0).positions[:, 2].tolist() == pytest.approx([0.5] * 3)


def bind(stage: Any, prim: Any, name: str, color: Any, **inputs: float) -> Any:
    material = UsdShade.Material.Define(stage, f"/World/looks/{name}")
    shader = UsdShade.Shader.Define(stage, f"/World/looks/{name}/shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    if color is not None:
        shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*color))
    for key, value in inputs.items():
        shader.CreateInput(key, Sdf.ValueTypeNames.Float).Set(value)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)
    return shader


def test_looks_are_those_of_the_materials_and_display_colours(tmp_path: Path) -> None:
    stage = make_stage()
    strip = make_square(stage, "/World/strip", quads=2)
    bind(stage, strip.GetPrim(), "red", (1.0, 0.0, 0.0), roughness=0.25, metallic=1.0)
    subset = UsdGeom.Subset.CreateGeomSubset(strip, "right", "face", Vt.IntArray([1]), "materialBind")
    bind(stage, subset.GetPrim(), "glass", (0.0, 0.2140411, 0.0), opacity=0.5)
    plain = UsdGeom.Cube.Define(stage, "/World/plain")
    plain.CreateDisplayColorAttr([Gf.Vec3f(0.2140411, 1.0, 0.0)])
    _, made = build(stage, tmp_path)
    spec = made.spec
    shown = [spec.materials[v.material] if v.material >= 0 else v for v in spec.visuals]
    assert [tuple(round(c, 4) for c in one.rgba) for one in shown] == [
        (1.0, 0.0, 0.0, 1.0),
        (0.0, 0.5, 0.0, 0.5),  # linear colours become sRGB
        (0.5, 1.0, 0.0, 1.0),
    ]
    assert (shown[0].metallic, shown[0].roughness) == (1.0, 0.25)


def test_textures_lie_on_the_mesh_as_in_usd(tmp_path: Path) -> None:
    from PIL import Image

    picture = tmp_path / "picture.png"
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(picture)
    stage = make_stage()
    square = make_square(stage, "/World/square")
    coordinates = UsdGeom.PrimvarsAPI(square).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
    coordinates.Set([Gf.Vec2f(0, 0), Gf.Vec2f(1, 0), Gf.Vec2f(1, 1), Gf.Vec2f(0, 1)])
    shader = bind(stage, square.GetPrim(), "printed", None)
    texture = UsdShade.Shader.Define(stage, "/World/looks/printed/texture")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(str(picture))
    texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(texture.ConnectableAPI(), "rgb")
    adapter = find_adapter(stage)
    builder = SceneBuilder("stage")
    assert adapter is not None
    adapter.build(builder)
    (item,) = builder._content.items
    assert item.mesh is not None
    assert item.mesh.uv is not None
    assert item.appearance.images
    at = {tuple(p[:2].tolist()): tuple(uv.tolist()) for p, uv in zip(*_corners(item.mesh), strict=True)}
    assert at == {(0.0, 0.0): (0.0, 1.0), (1.0, 0.0): (1.0, 1.0), (1.0, 1.0): (1.0, 0.0), (0.0, 1.0): (0.0, 0.0)}


def _corners(mesh: Any) -> tuple[Any, Any]:
    """Return positions and texture coordinates of all corners."""
    flat = mesh.index.ravel()
    return mesh.position[flat], mesh.uv[flat]


def test_guides_hidden_prims_and_what_cannot_be_shown(tmp_path: Path) -> None:
    stage = make_stage()
    UsdGeom.Cube.Define(stage, "/World/body/shown")
    UsdGeom.Cube.Define(stage, "/World/body/collision").CreatePurposeAttr("guide")
    UsdGeom.Cube.Define(stage, "/World/body/hidden").MakeInvisible()
    broken = make_square(stage, "/World/body/broken")
    broken.GetFaceVertexIndicesAttr().Set([0, 1, 2, 99])
    UsdGeom.BasisCurves.Define(stage, "/World/body/hair")
    adapter, made = build(stage, tmp_path)
    assert len(made.spec.visuals) == 1
    assert [note.split(":")[0] for note in adapter.notes] == ["/World/body/broken", "/World/body/hair"]


def test_arms_are_found_by_their_joints(tmp_path: Path) -> None:
    stage = make_stage()
    names = ["base", "one", "two", "three", "hand", "left", "right"]
    above = {"one": "base", "two": "one", "three": "two", "hand": "three", "left": "hand", "right": "hand"}
    for cell, name in [(cell, name) for cell in ("one", "two") for name in names]:
        prim = UsdGeom.Cube.Define(stage, f"/World/{cell}/Arm/{name}").GetPrim()
        UsdPhysics.RigidBodyAPI.Apply(prim)
        if name in above:
            kind = {"hand": UsdPhysics.FixedJoint, "left": UsdPhysics.PrismaticJoint}.get(
                name, UsdPhysics.RevoluteJoint
            )
            joint = kind.Define(stage, f"/World/{cell}/Arm/{name}/joint")
            joint.CreateBody0Rel().SetTargets([f"/World/{cell}/Arm/{above[name]}"])
            joint.CreateBody1Rel().SetTargets([f"/World/{cell}/Arm/{name}"])
    adapter, _ = build(stage, tmp_path)
    robot, other = adapter.robots
    assert (robot.name, robot.base_body, robot.tip_body) == ("Arm", "base", "hand")
    assert robot.finger_bodies == ("left", "right")
    assert (other.name, other.tip_body) == ("Arm_2", "hand_2")


def test_files_are_opened_and_wrong_ones_refused(tmp_path: Path) -> None:
    stage = make_stage()
    UsdGeom.Cube.Define(stage, "/World/cube")
    path = tmp_path / "lab.usda"
    stage.Export(str(path))
    adapter, made = build(path, tmp_path)
    assert adapter.bodies == ["cube"]
    assert len(made.spec.visuals) == 1
    (tmp_path / "wrong.usda").write_text("no stage")
    for wrong in (tmp_path / "wrong.usda", tmp_path / "missing.usd"):
        with pytest.raises(SimulatorError, match="USD stage") as caught:
            find_adapter(wrong)
        assert "\n" not in str(caught.value)
