"""The session is a function of its journal: same entries, same digests; snapshots are invisible."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import mujoco
import pytest

from iris_session.protocol.client_messages import Control
from iris_session.protocol.server_messages import EpisodeChanged, Event, EventBody, Notice, Snapshot
from iris_session.protocol.steps import Decision, OutgoingMessage
from iris_session.session.core import SessionCore, encode_for_digest, read_plant_state
from tests.session.play import TICK_NS, host, make_core, play
from tools.codegen.examples import make_full


@pytest.mark.parametrize("at", [0, 49, 120, 150])
def test_restoring_a_snapshot_changes_nothing(at: int) -> None:
    """In the same core, and in another one that continues from it."""
    straight, restored, other = make_core(), make_core(), make_core()
    before = play(straight, 0, at)
    expected = play(straight, at, 200)
    assert len(set((before + expected)[:120])) == 120, "every tick shows in its digest"
    assert play(restored, 0, at) == before
    state = restored.snapshot()
    restored.restore(state)
    other.restore(state)
    assert play(restored, at, 200) == expected
    assert play(other, at, 200) == expected


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


def test_digest_has_the_four_fields_of_episodes_that_do_not_say_who_started_them() -> None:
    before = EpisodeChanged(3, "running", "stack", "p1")
    digested = encode_for_digest(Decision((), events=(Event(1, 2, 3, before),)))
    assert msgspec.msgpack.decode(digested)["events"][0]["body"] == {
        **{"event": "episode_changed", "number": 3},
        **{"state": "running", "label": "stack", "participant": "p1"},
    }
    led = Decision((), events=(Event(1, 2, 3, msgspec.structs.replace(before, started_by="p1")),))
    assert encode_for_digest(led) == msgspec.msgpack.encode(led)


def test_initial_state_is_used_at_start_and_by_reset(model: mujoco.MjModel) -> None:
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
