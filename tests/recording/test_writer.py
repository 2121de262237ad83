"""Content for the Rerun viewer, read back with Rerun's own reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest

from iris_session.journal.messages import (
    Batch,
    DenialRecord,
    MetricRecord,
    RobotLabels,
    SceneAssets,
    SceneModel,
    StateFrame,
)
from iris_session.physics.load import compute_scene_hash, encode_model
from iris_session.protocol.common import Alignment, Denial, Lease, Pose
from iris_session.protocol.scene import (
    AddVisual,
    Geometry,
    PatchOp,
    RemoveVisual,
    SceneSpec,
    SetVisual,
    Visual,
    apply_patch,
    encode_scene,
)
from iris_session.protocol.server_messages import (
    AlignmentChanged,
    AnchorMoved,
    BodyInfo,
    EStopChanged,
    Event,
    EventKind,
    LeaseChanged,
    ParticipantInfo,
    ParticipantJoined,
    ParticipantLeft,
    PresenceItem,
    SamplesRejected,
)
from iris_session.protocol.specs import RobotSpec
from iris_session.recording import CLOSED, OPEN, Recording, SessionHeader, pack_model
from iris_session.recording.writer import RrdWriter
from iris_session.rrd.paths import part_path
from iris_session.scene import AssetStore
from iris_session.scene.mujoco_scene import parse_mujoco
from tests.recording.support import XML, column, make_header, read
from tests.scene.models import every_shape

IDENTITY_Q = (1.0, 0.0, 0.0, 0.0)


def begin(folder: Path, header: SessionHeader | None = None) -> RrdWriter:
    """Begin a file of a session, without bodies if no header is given."""
    writer = RrdWriter(folder / "w.rrd", "id")
    writer.write_header(header or SessionHeader("s", "n", "closed", 2_000_000))
    return writer


def finish(writer: RrdWriter) -> dict[str, list[Any]]:
    """Close a file and read it."""
    writer.close()
    return read(Path(writer.path))


def frame(step: int, poses: np.ndarray, presence: tuple[PresenceItem, ...] = ()) -> StateFrame:
    return StateFrame(step, step + 1, step * 0.002, step * 2_000_000 + 7, poses.tobytes(), presence)


def times(batches: list[Any]) -> list[int]:
    """Return the session times of the rows of an entity [ns]."""
    return [value.value for batch in batches for value in batch.column("session_time")]


def select(batches: list[Any], component: str) -> list[Any]:
    """Return the batches that have a component."""
    return [batch for batch in batches if component in batch.schema.names]


@pytest.mark.parametrize(("recording_class", "kind"), [(OPEN, np.float64), (CLOSED, np.float32)])
def test_poses_are_exact_where_no_simulation_gives_them(tmp_path: Path, recording_class: str, kind: type) -> None:
    path = tmp_path / "session.rrd"
    writer = RrdWriter(path, "r")
    header = make_header(recording_class)
    writer.write_header(header)
    poses = np.random.default_rng(1).normal(size=(len(header.bodies), 7))
    writer.add(Batch(states=[frame(0, poses)]))
    writer.close()
    with Recording.open(path, warn=False) as recording:
        (state,) = recording.states()
    assert state.poses.dtype == np.float64
    assert np.array_equal(state.poses, poses.astype(kind))


def test_transforms_are_the_poses_of_moving_bodies_when_they_change(tmp_path: Path) -> None:
    bodies = (BodyInfo(1, "a/b c", True), BodyInfo(2, "fixed", False), BodyInfo(3, "d", True))
    writer = begin(tmp_path, SessionHeader("s", "n", "closed", 2_000_000, bodies=bodies))
    poses = np.zeros((3, 7))
    poses[:, 3] = 1.0
    writer.add(Batch(states=[frame(0, poses)]))
    writer.flush()
    moved = poses.copy()
    moved[0] = (1, 2, 3, 0.5, -0.5, 0.5, 0.5)
    moved[1, 0] = 5.0
    jittered, crept = moved.copy(), moved.copy()
    jittered[2, :] += 1e-5
    crept[2, 0] += 2.5e-5
    writer.add(Batch(states=[frame(8, poses), frame(16, moved), frame(24, jittered), frame(32, crept)]))
    found = finish(writer)
    moving, still = found["/scene/1/bodies/a\\/b\\ c"], found["/scene/1/bodies/d"]
    assert column(moving, "Transform3D:translation") == [[[0.0, 0.0, 0.0]], [[1.0, 2.0, 3.0]]]
    assert column(moving, "Transform3D:quaternion")[-1] == [[-0.5, 0.5, 0.5, 0.5]], "Rerun has x y z w"
    assert (column(moving, "step"), column(still, "step")) == ([0, 16], [0, 32]), "no jitter"
    assert times(moving) == [7, 32_000_007]
    assert column(found["/state"], "sim_time_s") == [[0.002 * 8 * i] for i in range(5)]
    assert not any("fixed" in entity for entity in found)


def joined(participant: str, name: str, role: str = "operator") -> Event:
    return Event(1, 0, 1, ParticipantJoined(ParticipantInfo(participant, name, role, connected=True)))


def test_participants_are_drawn_once_and_move_with_their_captures(tmp_path: Path) -> None:
    writer = begin(tmp_path)
    none = np.zeros((0, 7))

    def person(x: float, capture_ns: int) -> tuple[PresenceItem, ...]:
        return (PresenceItem("p 1", "head", Pose((x, 0.0, 1.6), IDENTITY_Q), capture_ns),)

    states = [frame(0, none, person(0.1, 10)), frame(8, none, person(0.1, 10)), frame(16, none, person(0.3, 20))]
    writer.add(Batch(states=states, events=[joined("p 1", "Ada")]))
    found = finish(writer)
    head = found["/presence/p\\ 1/head"]
    poses, looks = select(head, "Transform3D:translation"), select(head, "Boxes3D:labels")
    assert (column(poses, "Transform3D:translation"), column(poses, "step")) == (
        [[[pytest.approx(0.1), 0.0, pytest.approx(1.6)]], [[pytest.approx(0.3), 0.0, pytest.approx(1.6)]]],
        [0, 16],
    )
    assert (column(looks, "Boxes3D:labels"), times(looks)) == ([["Ada · operator"]], [7])
    assert column(found["/presence/p\\ 1/head/view"], "Arrows3D:vectors") == [[[pytest.approx(0.3), 0.0, 0.0]]]


def test_participants_are_cleared_when_they_leave_or_have_no_pose(tmp_path: Path) -> None:
    writer = begin(tmp_path)
    none, ms = np.zeros((0, 7)), 1_000_000

    def seen(step: int, *devices: tuple[str, str]) -> StateFrame:
        items = tuple(PresenceItem(*key, Pose((0.0, 0.0, 1.0), IDENTITY_Q), step * 2 * ms) for key in devices)
        return frame(step, none, items)

    head, hand, other = ("p1", "head"), ("p1", "hand/left"), ("p2", "head")
    states = [seen(0, head, hand, other), seen(120, head, other), seen(130, head, other), seen(140, head, hand)]
    left = Event(2, 141, 282 * ms, ParticipantLeft("p2", "bye"))
    away = Event(3, 141, 282 * ms, ParticipantLeft("p1", "timeout", grace=True))
    writer.add(Batch(states=states, events=[joined("p1", "Ada"), left, away]))
    found = finish(writer)
    hands, clear = found["/presence/p1/hand/left"], "Clear:is_recursive"
    assert times(select(hands, clear)) == [260 * ms + 7], "the first state 0.25 s after its pose"
    drawn = select(hands, "Ellipsoids3D:half_sizes")
    assert times(drawn) == [7, 280 * ms + 7], "and it is drawn again with the next"
    assert not select(found["/presence/p1/head"], clear), "who is disconnected stays until poses are old"
    assert times(select(found["/presence/p2/head"], clear)) == [282 * ms]
    looks = [[b for b in found[f"/presence/{who}/head"] if "Boxes3D:colors" in b.schema.names] for who in ("p1", "p2")]
    assert column(looks[0], "Boxes3D:colors") != column(looks[1], "Boxes3D:colors")


def test_robots_are_labelled_by_their_holders(tmp_path: Path) -> None:
    path = tmp_path / "w.rrd"
    robots = (RobotSpec("left", (), (), "site", "base"), RobotSpec("cart", (), (), "site", "wheels"))
    bodies = (BodyInfo(1, "base", False), BodyInfo(2, "wheels", True))
    poses = np.array([[1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]] * 2)
    take = Event(2, 4, 8_000_100, LeaseChanged(Lease("left", "robot", "exclusive", "p1", 1), "acquired"))
    for part in (str(path), part_path(str(path), 2)):
        writer = RrdWriter(part, "id")
        writer.write_header(SessionHeader("s", "n", "closed", 2_000_000, robots=robots, bodies=bodies))
        writer.add(Batch(states=[frame(0, poses), frame(4, poses)], events=[joined("p1", "Ada"), take]))
        writer.close()
    found = read(path)
    assert column(found["/robots/left"], "Points3D:labels") == [["left"], ["left: Ada"]]
    assert column(found["/robots/left"], "Points3D:positions") == [[[1.0, 2.0, 3.0]]] * 2
    assert times(found["/robots/left"]) == [7, 8_000_100]
    assert column(found["/scene/1/bodies/wheels/label"], "Points3D:labels") == [["cart"]], "which moves with it"
    later = read(Path(part_path(str(path), 2)))
    assert column(later["/robots/left"], "Points3D:labels") == [["left: Ada"]], "its robots had holders before"


def test_timelines_grow_over_resets_and_have_the_time_of_day(tmp_path: Path) -> None:
    """Rows without a simulated time have that of the state before them."""
    path = tmp_path / "w.rrd"
    origin = 1_700_000_000 * 10**9
    writer = begin(tmp_path, SessionHeader("s", "n", "closed", 2_000_000, origin_utc_ns=origin))
    none = np.zeros((0, 7))
    states = [
        frame(0, none),
        frame(8, none),
        msgspec.structs.replace(frame(16, none), sim_time=0.004, sim_before=0.016),
    ]
    writer.add(Batch(states=states, metrics=[MetricRecord(17, states[2].session_time + 5, "late_ms", 1.0)]))
    found = finish(writer)
    assert [value.value for value in found["/state"][0].column("sim_time")] == [0, 16_000_000, 20_000_000]
    (late,) = found["/metrics/late_ms"]
    assert (late.column("sim_time")[0].value, late.column("step")[0].as_py()) == (20_000_000, 17)
    assert late.column("wall_time")[0].value == origin + states[2].session_time + 5
    with Recording.open(path, warn=False) as recording:
        assert [(state.tick, state.sim_time) for state in recording.states()] == [(1, 0.0), (9, 0.016), (17, 0.004)]


def test_events_and_denials_are_text_lines(tmp_path: Path) -> None:
    writer = begin(tmp_path)
    stop = Event(4, 9, 77, EStopChanged(True, "p1", "smoke", 2))
    denied = DenialRecord(9, 77, 3, Denial("held", "left is held", "ask for it", "left", "p2", "Ada"))
    writer.add(Batch(events=[stop], denials=[denied]))
    found = finish(writer)
    assert column(found["/events"], "TextLog:text") == [["E-STOP by p1: smoke"]]
    assert column(found["/events"], "TextLog:level") == [["CRITICAL"]]
    expected = "connection 3: held: left is held; held by Ada; ask for it"
    assert column(found["/denials"], "TextLog:text") == [[expected]]


def test_model_that_mujoco_refuses_does_not_stop_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "w.rrd"
    writer = begin(tmp_path, msgspec.structs.replace(make_header(), model=b"no zlib"))
    writer.close()
    assert "scene" in column(read(path)["/events/recorder"], "TextLog:text")[0][0]


OTHER = """
<mujoco><worldbody><body name="cup" pos="0 0 1"><freejoint/><geom name="g" type="box" size="0.1 0.2 0.3"/></body>
</worldbody></mujoco>"""


def other_scene(step: int) -> tuple[SceneModel, bytes]:
    """Return a scene with one body, and its binary model."""
    model = mujoco.MjModel.from_xml_string(OTHER)
    mjb = bytes(encode_model(model))
    row_ns = step * 2_000_000  # the state of that row is later, see `frame`
    return SceneModel(step, row_ns, compute_scene_hash(mjb), pack_model(mjb), (BodyInfo(1, "cup", moving=True),)), mjb


def test_new_scene_is_drawn_from_its_step_and_its_model_is_stored(tmp_path: Path) -> None:
    path = tmp_path / "w.rrd"
    header = make_header()
    writer = begin(tmp_path, header)
    cup, mjb = other_scene(8)
    first, second = np.zeros((len(header.bodies), 7)), np.array([[1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]])
    writer.add(Batch(states=[frame(0, first), frame(8, first)]))
    writer.add(Batch(scenes=[cup], states=[frame(16, second)]))
    found = finish(writer)
    was = found["/scene/1/bodies/ball/g\\/ball"]
    assert column(was, "step") == [0]
    assert column(was, "Ellipsoids3D:half_sizes") == [[[pytest.approx(0.1)] * 3]]
    assert column(found["/scene/1"], "step") == [8]
    assert column(found["/scene/1"], "Clear:is_recursive") == [[True]]
    box = found["/scene/2/bodies/cup/g"][0]
    assert column([box], "step") == [8]
    assert column(found["/scene/2/bodies/cup"], "Transform3D:translation") == [[[1.0, 2.0, 3.0]]]
    with Recording.open(path, warn=False) as recording:
        assert [state.poses.shape for state in recording.states()] == [first.shape, first.shape, (1, 7)]
        assert [state.bodies for state in recording.states()] == [header.bodies, header.bodies, cup.bodies]
        assert recording.model(cup.model_hash) == mjb
        with pytest.raises(LookupError, match="feed"):
            recording.model("feed" * 8)


def shared(store: AssetStore, model: mujoco.MjModel, **changes: Any) -> tuple[SceneSpec, SceneAssets]:
    """Store the specification of a model. Return its place."""
    spec = msgspec.structs.replace(parse_mujoco(model, store).spec, **changes)
    return spec, SceneAssets(-1, 0, str(store.root), store.put(encode_scene(spec)))


def drawn_visuals(path: Path) -> dict[str, list[Any]]:
    """Return the batches of the visuals of scenes."""
    found = {entity: select(batches, "InstancePoses3D:translations") for entity, batches in read(path).items()}
    return {entity: batches for entity, batches in found.items() if batches}


def begun(path: Path, assets: SceneAssets) -> tuple[RrdWriter, Any]:
    """Begin a file of the small session, with one state at step 0."""
    writer, header = RrdWriter(path, "id"), make_header()
    writer.write_header(header)
    writer.add(Batch(assets=[assets]))
    poses = np.zeros((len(header.bodies), 7))
    writer.add(Batch(states=[frame(0, poses)]))
    return writer, poses


def test_patch_changes_the_picture_from_its_step(tmp_path: Path) -> None:
    store = AssetStore(tmp_path / "assets")
    spec, assets = shared(store, mujoco.MjModel.from_xml_string(XML))
    writer, poses = begun(tmp_path / "w.rrd", assets)
    arrow = Visual(
        50, 1, "arrow", Pose((0.0, 0.0, 0.2), IDENTITY_Q), 0, Geometry("cylinder", (0.01, 0.01, 0.1)), -1, (0, 1, 0, 1)
    )
    moved = Pose((0.5, 0.0, 0.0), IDENTITY_Q)
    steps: list[list[PatchOp]] = [
        [SetVisual(1, rgba=(1.0, 0.0, 0.0, 1.0)), AddVisual(arrow), SetVisual(4, T_body_visual=moved)],
        [SetVisual(1, rgba=(1.0, 0.0, 0.0, 0.0)), RemoveVisual(50), SetVisual(6, group=0)],
        [SetVisual(1, rgba=(0.0, 0.0, 1.0, 1.0))],
    ]
    for i, ops in enumerate(steps, 1):
        spec = apply_patch(spec, ops)
        address = store.put(encode_scene(spec))
        writer.add(Batch(assets=[SceneAssets(10 * i, 100 * i, str(store.root), address)]))
        writer.add(Batch(states=[frame(10 * i, poses)]))
    writer.close()
    found = read(tmp_path / "w.rrd")
    ball = found["/scene/1/bodies/ball/g\\/ball"]

    def told(entity: str, name: str) -> list[tuple[int, Any]]:
        batches = [batch for batch in found[entity] if name in batch.schema.names]
        pairs = zip(column(batches, "step"), column(batches, name), strict=True)
        return [(step, value) for step, value in pairs if value is not None]

    assert [step for step, _ in told("/scene/1/bodies/ball/g\\/ball", "Ellipsoids3D:half_sizes")] == [0], (
        "the form once"
    )
    assert column(ball, "step") == [0, 10, 20, 30]
    assert told("/scene/1/bodies/ball/g\\/ball", "Ellipsoids3D:colors")[1:] == [
        (10, [0xFF0000FF]),
        (20, [0xFF000000]),
        (30, [0x0000FFFF]),
    ]
    hidden = told("/scene/1/bodies/ball/g\\/ball", "InstancePoses3D:scales")
    assert hidden == [(20, [[0.0, 0.0, 0.0]])]
    shown = told("/scene/1/bodies/ball/g\\/ball", "InstancePoses3D:translations")
    assert [step for step, _ in shown] == [0, 20, 30], "a pose without a scale has its full size again"
    assert told("/scene/1/bodies/tip/visual_4", "InstancePoses3D:translations")[-1] == (10, [[0.5, 0.0, 0.0]])
    assert told("/scene/1/bodies/ball/arrow", "Cylinders3D:lengths") == [(10, [pytest.approx(0.2)])]
    assert [step for step, _ in told("/scene/1/bodies/ball/arrow", "Clear:is_recursive")] == [20]
    assert [step for step, _ in told("/scene/1/bodies/post/visual_6", "Boxes3D:half_sizes")] == [20], (
        "hidden until then"
    )


def test_missing_assets_are_reported_and_others_written(tmp_path: Path) -> None:
    store = AssetStore(tmp_path / "assets")
    spec, assets = shared(store, every_shape())
    gone = spec.meshes[0].levels[0].address
    store.path(gone).unlink()
    writer, _ = begun(tmp_path / "w.rrd", assets)
    writer.close()
    found = read(tmp_path / "w.rrd")
    (text,) = column(found["/events/recorder"], "TextLog:text")
    assert "more cannot be drawn" in text[0]
    assert gone in text[0]
    drawn = len(drawn_visuals(tmp_path / "w.rrd"))
    whole = sum(visual.rgba[3] > 0 and visual.group < 3 for visual in spec.visuals)
    lost = sum(visual.geometry.mesh == 0 for visual in spec.visuals)
    assert (drawn, lost > 5) == (whole - lost, True)


def test_joints_grippers_and_tips_of_robots_are_plotted(tmp_path: Path) -> None:
    """Values of a robot of two joints and a gripper, and of one without joints and gripper."""
    robots = (RobotLabels("left", "base", ("left/hinge", "rail"), ("rad", "m")), RobotLabels("free", "base"))
    writer = begin(tmp_path, SessionHeader("s", "n", "closed", 2_000_000))
    writer.add(Batch(assets=[SceneAssets(robots=robots)]))
    tips = [((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), ((0.0, 0.0, 0.032), (1.0, 1.0, 1.0))]
    values = [np.array([0.5 + i, 0.25, 0.75, np.nan, *np.ravel(tips[i])]).tobytes() for i in range(2)]
    states = [msgspec.structs.replace(frame(8 * i, np.zeros((0, 7))), robots=values[i]) for i in range(2)]
    other = msgspec.structs.replace(frame(16, np.zeros((0, 7))), robots=values[0][8:])  # of another scene
    writer.add(Batch(states=[*states, other]))
    found = finish(writer)
    joints = found["/robots/left/joints"]
    assert column(select(joints, "SeriesLines:names"), "SeriesLines:names") == [["hinge [rad]", "rail [m]"]]
    rows = select(joints, "Scalars:scalars")
    assert column(rows, "Scalars:scalars") == [[0.5, 0.25], [1.5, 0.25]]
    assert times(rows) == [state.session_time for state in states]
    assert column(select(found["/robots/left/gripper"], "Scalars:scalars"), "Scalars:scalars") == [[0.75], [0.75]]
    speeds = column(select(found["/robots/left/tip_speed"], "Scalars:scalars"), "Scalars:scalars")
    assert speeds == [[pytest.approx(2.0)]], "32 mm in 16 ms; nothing is known of the first"
    assert sorted(entity for entity in found if "free" in entity) == ["/robots/free/tip_speed"]


def test_errors_of_alignments_and_rejected_samples_are_plotted_by_name(tmp_path: Path) -> None:
    path = tmp_path / "w.rrd"
    writer = begin(tmp_path)
    pose = Pose((0.0, 0.0, 0.0), IDENTITY_Q)
    stated = [Alignment(i, "measured", pose, 0, (), error / 2, error) for i, error in ((1, 0.004), (2, 0.002))]
    bodies: list[EventKind] = [
        *(AlignmentChanged("p1", one) for one in stated),
        AlignmentChanged("p2", msgspec.structs.replace(stated[0], offset=True)),
        *(SamplesRejected("p1", device, "stale", n) for device, n in (("head", 2), ("hand/left", 1), ("head", 5))),
        ParticipantLeft("p1", "bye"),
    ]
    events = [Event(2 + i, 10 * i, 100 * i, body) for i, body in enumerate(bodies)]
    writer.add(Batch(events=[joined("p1", "Ada"), *events], states=[frame(0, np.zeros((0, 7)))]))
    writer.add_report("p1", 50, 3.5)
    found = finish(writer)
    plots = {kind: found[f"/metrics/{kind}/p1"] for kind in ("alignment_mm", "rejected_samples", "state_age_ms")}
    values = {kind: select(batches, "Scalars:scalars") for kind, batches in plots.items()}
    assert column(values["alignment_mm"], "Scalars:scalars") == [[4.0], [2.0], [2.0]]
    assert times(values["alignment_mm"]) == [0, 100, 600], "until Ada left"
    assert column(values["rejected_samples"], "Scalars:scalars") == [[2.0], [3.0], [6.0], [6.0]]
    assert (column(values["state_age_ms"], "Scalars:scalars"), times(values["state_age_ms"])) == ([[3.5]], [50])
    names = [column(select(batches, "SeriesLines:names"), "SeriesLines:names") for batches in plots.values()]
    assert names == [
        [["Ada, at the robot, 95 % [mm]"]],
        [["Ada, since joining"]],
        [["Ada, 99 % of the states [ms]"]],
    ]
    assert not any("p2" in entity for entity in found if entity.startswith("/metrics")), (
        "an offset voids the stated error"
    )
    with Recording.open(path, warn=False) as recording:
        assert recording.metrics()["alignment_mm/p1"][1].tolist() == [4.0, 2.0, 2.0]
        assert recording.damage == []


def test_no_two_rows_of_an_entity_have_one_time(tmp_path: Path) -> None:
    """Events, denials, raw messages and changes of a lane of one step: dataframes have a row per entity and time."""
    path = tmp_path / "w.rrd"
    header = make_header()
    writer = begin(tmp_path, header)
    stops = [Event(i + 2, 4, 8_000_000, EStopChanged(i % 2 == 0, "p1", "", 1)) for i in range(3)]
    stops += [Event(i, 4, 8_000_000, SamplesRejected("p1", "head", "stale", i)) for i in (5, 6)]
    denied = DenialRecord(4, 8_000_000, 3, Denial("held", "left is held"))
    poses = np.zeros((len(header.bodies), 7))
    heads = [PresenceItem("p1", device, Pose((0, 0, 0), IDENTITY_Q), 5) for device in ("head", "hand/left")]
    states = [frame(0, poses, tuple(heads)), frame(8, poses + 1.0, tuple(heads))]
    for _ in range(3):
        writer.add_sample(3, 8_000_000, b"x")
    writer.add(Batch(events=[joined("p1", "Ada"), *stops], denials=[denied] * 2, states=states))
    writer.close()
    for entity, batches in read(path).items():
        for name in {
            name for batch in batches for name in batch.schema.names if ":" in name or name in ("data", "event")
        }:
            rows = [batch for batch in select(batches, name) if "session_time" in batch.schema.names]
            assert len(times(rows)) == len(set(times(rows))), f"{entity} {name}"
    assert times(read(path)["/events"]) == [1, *range(8_000_000, 8_000_005)]
    with Recording.open(path, warn=False) as recording:
        assert [sample.receive_ns for sample in recording.samples()] == [8_000_000] * 3
        assert [event.session_time for event in recording.events()] == [1] + [8_000_000] * 5
        assert len(list(recording.denials())) == 2


def test_later_part_clears_the_picture_of_the_one_before(tmp_path: Path) -> None:
    """Scene and people that part 1 showed at its end are not shown beside those of part 2."""
    path = Path(part_path(str(tmp_path / "w.rrd"), 2))
    writer = RrdWriter(path, "id")
    header = make_header()
    writer.write_header(header)
    writer.add(Batch(states=[frame(5, np.zeros((len(header.bodies), 7)))]))
    found = finish(writer)
    for entity in ("/scene", "/presence"):
        assert column(select(found[entity], "Clear:is_recursive"), "step") == [5]


def test_anchors_have_axes_and_the_worst_stated_error(tmp_path: Path) -> None:
    path = tmp_path / "w.rrd"
    writer = RrdWriter(path, "id")
    sheet = Pose((1.0, 2.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    writer.write_header(SessionHeader("s", "n", "closed", 2_000_000, anchors={"sheet 1": sheet}))
    aligned = [
        AlignmentChanged(who, Alignment(1, "measured", sheet, 0, (), error_m, 0.1))
        for who, error_m in (("p1", 0.002), ("p2", 0.005))
    ]
    moved = AnchorMoved("sheet 1", msgspec.structs.replace(sheet, p=(3.0, 0.0, 0.0)))
    bodies: list[EventKind] = [*aligned, moved, ParticipantLeft("p2", "")]
    events = [Event(i + 1, i, 100 * i, body) for i, body in enumerate(bodies, 1)]
    writer.add(Batch(events=events, states=[frame(0, np.zeros((0, 7)))]))
    found = finish(writer)
    assert column(found["/anchors/sheet\\ 1"], "Transform3D:translation") == [[[1.0, 2.0, 0.0]], [[3.0, 0.0, 0.0]]]
    assert column(found["/anchors/sheet\\ 1"], "Transform3D:quaternion")[0] == [[0.0, 0.0, 1.0, 0.0]]
    assert column(found["/anchors/sheet\\ 1/label"], "Points3D:labels") == [
        ["sheet 1"],
        ["sheet 1: 2.0 mm (95 %)"],
        ["sheet 1: 5.0 mm (95 %)"],
        ["sheet 1: 2.0 mm (95 %)"],
    ]
    sizes = column(found["/anchors/sheet\\ 1/error"], "Ellipsoids3D:half_sizes")
    assert [size[0][0] for size in sizes] == pytest.approx([0.0, 0.002, 0.005, 0.002])
