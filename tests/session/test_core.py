"""The session is a function of its journal: same entries, same digests; snapshots are invisible."""

from __future__ import annotations

import json
import math
from pathlib import Path

import msgspec
import mujoco
import numpy as np
import pytest

from anchors.pose import distance
from iris_session.demo.scenes import scene_path
from iris_session.physics import ModelUnsupportedError, SimulationDivergedError, load_model
from iris_session.protocol.client_messages import Control
from iris_session.protocol.entries import ExternalReset
from iris_session.protocol.names import CommandKind
from iris_session.protocol.server_messages import Event, EventBody, Notice, SceneChanged, Snapshot
from iris_session.protocol.steps import Decision, OutgoingMessage
from iris_session.session.core import CROWDED_ENTRIES, SessionCore, encode_for_digest, read_plant_state
from tests.session.play import TICK_NS, entries, host, make_core, play
from tools.codegen.examples import make_full


def test_same_journal_gives_the_same_digests() -> None:
    one, two = make_core(), make_core()
    digests = play(one, 0, 200)
    assert digests == play(two, 0, 200)
    assert len(set(digests[:120])) == 120, "every tick shows in its digest"
    assert one.snapshot() == two.snapshot()


def test_hand_moves_the_robot() -> None:
    core = make_core()
    before = core.world.view().tip_pose("left")
    play(core, 0, 300)  # clutched from step 50 to the pause at 120: 28 mm
    after = core.world.view().tip_pose("left")
    assert 0.015 < after.p[1] - before.p[1] < 0.03


@pytest.mark.parametrize("at", [0, 49, 120, 150])
def test_restoring_a_snapshot_changes_nothing(at: int) -> None:
    """In the same core, and in another one that continues from it."""
    straight, restored, other = make_core(), make_core(), make_core()
    before = play(straight, 0, at)
    expected = play(straight, at, 200)
    assert play(restored, 0, at) == before
    state = restored.snapshot()
    restored.restore(state)
    other.restore(state)
    assert play(restored, at, 200) == expected
    assert play(other, at, 200) == expected


@pytest.mark.parametrize(("n", "crowded"), [(0, False), (CROWDED_ENTRIES - 1, False), (CROWDED_ENTRIES, True)])
def test_step_with_too_many_entries_is_marked(n: int, crowded: bool) -> None:
    core = make_core()
    told: list[bool] = []
    tick = core.controller.tick

    def noted(data: mujoco.MjData, crowded: bool = False) -> None:
        told.append(crowded)
        tick(data, crowded)

    core.controller.tick = noted  # type: ignore[method-assign]
    core.step(TICK_NS, [host(TICK_NS, Control(0, "resume")) for _ in range(n)], 2)
    assert told == [crowded, crowded]


def test_different_entry_gives_a_different_digest() -> None:
    core, other = make_core(), make_core()
    play(core, 0, 57)
    play(other, 0, 57)
    now_ns = 58 * TICK_NS
    assert core.step(now_ns, [], 1).digest != other.step(now_ns, [host(now_ns, Control(0, "pause"))], 1).digest


def test_digest_has_the_snapshot_that_the_recording_format_began_with() -> None:
    """A recording of an earlier version has the same digests: fields that `Snapshot` got later do not count."""
    vectors = json.loads((Path(__file__).parents[2] / "docs/protocol/golden.json").read_text())
    (earlier,) = [v for v in vectors["decode_only_server"] if v["name"] == "snapshot of before"]
    snapshot = make_full(Snapshot)
    assert snapshot.anchors
    notice = Event(1, 2, 3, Notice("info", "hello"))
    decision = Decision((), outgoing=(OutgoingMessage(5, snapshot), OutgoingMessage(5, notice)))
    (_, before), (_, other) = msgspec.msgpack.decode(encode_for_digest(decision))["outgoing"]
    expected = msgspec.msgpack.decode(bytes.fromhex(earlier["hex"]))[-1]
    for participant in expected["participants"]:
        del participant["alignment"]["pivot_world"]
    assert msgspec.msgpack.encode(before) == msgspec.msgpack.encode(expected)
    assert other == msgspec.to_builtins(notice)
    plain = Decision((), outgoing=(OutgoingMessage(5, notice),))
    assert encode_for_digest(plain) == msgspec.msgpack.encode(plain)


@pytest.mark.parametrize("cls", EventBody.__subclasses__(), ids=lambda cls: cls.__name__)
def test_digest_has_events_without_the_pivot_that_alignments_got_later(cls: type[EventBody]) -> None:
    event = Event(1, 2, 3, make_full(cls))
    decision = Decision((), outgoing=(OutgoingMessage(5, event),), events=(event,))
    expected = msgspec.to_builtins(decision)
    for body in (expected["outgoing"][0][1]["body"], expected["events"][0]["body"]):
        for holder in (body, body.get("participant")):
            if isinstance(holder, dict) and "alignment" in holder:
                del holder["alignment"]["pivot_world"]
    assert encode_for_digest(decision) == msgspec.msgpack.encode(expected)
    assert b"pivot_world" not in encode_for_digest(decision)


def test_reset_restores_the_initial_state_in_a_new_epoch() -> None:
    core = make_core()
    start = core.world.view().tip_pose("left")
    play(core, 0, 300)
    now_ns = 301 * TICK_NS
    outcome = core.step(now_ns, [host(now_ns, Control(0, "reset"))], 0)
    assert outcome.decision.scene_epoch == 2
    assert distance(core.world.view().tip_pose("left").p, start.p) < 1e-12
    for i in range(301, 400):  # samples of the old epoch count no more
        outcome = core.step((i + 1) * TICK_NS, entries(i), 1)
        assert outcome.decision.commands[0].kind == CommandKind.HOLD
    assert distance(core.world.view().tip_pose("left").p, start.p) < 1e-3


def test_initial_state_is_used_at_start_and_by_reset() -> None:
    model = load_model(scene_path("handover"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.joint("hammer").qpos[0] += 0.05
    plain = make_core(model)
    core = SessionCore(model, msgspec.structs.replace(plain.config, initial_state=read_plant_state(model, data)))
    moved = core.world.view().object_pose("hammer").p
    assert moved[0] - plain.world.view().object_pose("hammer").p[0] == pytest.approx(0.05)
    core.step(TICK_NS, [], 1)
    core.step(2 * TICK_NS, [host(2 * TICK_NS, Control(0, "reset"))], 0)
    assert core.world.view().object_pose("hammer").p == moved


def test_diverged_physics_stops_until_a_reset() -> None:
    core = make_core()
    play(core, 0, 10)
    core.world.data.qvel[0] = math.nan
    outcome = core.step(11 * TICK_NS, [], 1)
    assert "NaN" in outcome.diverged
    tick = core.world.view().tick
    outcome = core.step(12 * TICK_NS, [], 5)
    assert outcome.diverged
    assert core.world.view().tick == tick
    now_ns = 13 * TICK_NS
    outcome = core.step(now_ns, [host(now_ns, Control(0, "reset"))], 1)
    assert outcome.diverged == ""
    assert core.world.view().tick == 1


# --- a plant that is advanced elsewhere -------------------------------------------------------------------------------


class Plant:
    """A user's simulation of the demo scene."""

    def __init__(self) -> None:
        self.model = load_model(scene_path("handover"))
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)

    def state(self) -> bytes:
        return read_plant_state(self.model, self.data)


def test_open_session_writes_ctrl_and_does_not_step_physics() -> None:
    plant = Plant()
    core = make_core(plant.model, user_owned_loop=True)
    states: list[bytes] = []
    digests: list[bytes] = []
    for i in range(200):
        states.append(plant.state())
        digests.append(core.step((i + 1) * TICK_NS, entries(i), 1, states[-1]).digest)
        assert core.world.data.time == plant.data.time
        plant.data.ctrl[:] = core.world.data.ctrl
        mujoco.mj_step(plant.model, plant.data)
    other = make_core(plant.model, user_owned_loop=True)
    assert [other.step((i + 1) * TICK_NS, entries(i), 1, states[i]).digest for i in range(200)] == digests


def test_robots_hold_after_an_external_reset() -> None:
    plant = Plant()
    core = make_core(plant.model, user_owned_loop=True)
    for i in range(200):
        core.step((i + 1) * TICK_NS, entries(i), 1, plant.state())
        plant.data.ctrl[:] = core.world.data.ctrl
        mujoco.mj_step(plant.model, plant.data)
    home = plant.data.ctrl.copy()
    mujoco.mj_resetDataKeyframe(plant.model, plant.data, 0)
    now_ns = 201 * TICK_NS
    outcome = core.step(now_ns, [host(now_ns, ExternalReset())], 1, plant.state())
    assert outcome.decision.scene_epoch == 2
    assert any(isinstance(e.body, SceneChanged) and e.body.cause == "external" for e in outcome.decision.events)
    assert not outcome.decision.reset
    columns = [plant.model.actuator(a).id for a in core.config.robots[0].actuators]
    assert not np.allclose(home[columns], plant.data.qpos[:7], atol=1e-3)
    np.testing.assert_allclose(core.world.data.ctrl[columns], plant.data.qpos[:7], atol=1e-9)


def test_plant_state_that_is_not_finite_raises() -> None:
    plant = Plant()
    core = make_core(plant.model, user_owned_loop=True)
    plant.data.qvel[3] = math.inf
    with pytest.raises(SimulationDivergedError, match="finite"):
        core.step(TICK_NS, [], 1, plant.state())


def test_sleeping_islands_are_refused_with_the_flag() -> None:
    model = load_model(scene_path("handover"))
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    with pytest.raises(ModelUnsupportedError, match='<flag sleep="enable"/>'):
        make_core(model)
