"""Recordings of what is hard to replay are bit-identical, and one changed byte of a journal is found and named."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import mujoco
import numpy as np
import pytest

from anchors.pose import PoseTuple, distance
from iris_session.client import Client
from iris_session.demo.scenes import scene_path
from iris_session.physics import load_model
from iris_session.protocol.client_messages import Sample
from iris_session.protocol.entries import Lost, decode_entries
from iris_session.recording import JournalRow, Recording
from iris_session.recording.messages import Batch
from iris_session.session.verification import verify_recording
from tests.e2e.conftest import Server, Stage, verify
from tests.recording.support import write

pytestmark = pytest.mark.e2e


@pytest.fixture
def recorded(stage: Stage) -> Path:
    """A short session in which somebody drives, drops out in the middle of a motion, and comes back."""
    identity = str(stage.server.folder / "ann.identity")
    hand = stage.hand(stage.join("ann", identity=identity), "left")
    watcher = stage.join("watcher", "observer")
    hand.client.acquire(["left"])
    stage.engage(hand)
    hand.velocity = (0.0, 0.1, 0.0)
    stage.seconds(0.5)
    lease = watcher.mirror.leases["left"]
    hand.client._sockets.close()  # the network is gone: no `bye`, the lease waits
    stage.clients.remove(hand.client)
    stage.hands.remove(hand)
    stage.run(lambda: watcher.mirror.leases["left"].expires_ns > 0, "the lease is kept for a while")
    back = stage.hand(stage.join("ann", identity=identity), "left")
    stage.run(lambda: watcher.mirror.leases["left"].expires_ns == 0, "ann has come back to it")
    assert watcher.mirror.leases["left"].holder == lease.holder
    stage.engage(back)
    stage.server.finish()
    return stage.server.recording


def _edited(path: Path, target: Path, change: Callable[[JournalRow], JournalRow]) -> Path:
    """A copy of the journal at `path` in which `change` was made to every row."""
    with Recording.open(path) as recording:
        batch = Batch(rows=[change(row) for row in recording.rows()], keyframes=list(recording.keyframes()))
        return write(target, recording.header, batch)


def test_a_disconnect_while_holding_and_one_changed_byte(recorded: Path, tmp_path: Path) -> None:
    report = verify(recorded)
    assert report["recording_class"] == "closed"
    with Recording.open(recorded) as recording:
        rows = list(recording.rows())
    assert any(isinstance(e.message, Lost) for row in rows for e in decode_entries(row.entries))
    victim = next(row for row in reversed(rows) if _sample_entry(row) >= 0)
    entry = _sample_entry(victim)

    def change(row: JournalRow) -> JournalRow:
        if row.step != victim.step:
            return row
        blob = bytearray(row.entries)
        at = len(blob) - sum(row.entry_lengths) + sum(row.entry_lengths[:entry])
        blob[at + row.entry_lengths[entry] // 2] ^= 0x01
        return msgspec.structs.replace(row, entries=bytes(blob))

    same = verify_recording(_edited(recorded, tmp_path / "same.rrd", lambda row: row))
    assert same.ok, same.line()
    changed = verify(_edited(recorded, tmp_path / "changed.rrd", change), status=1)
    assert f"FAILED at step {victim.step}, entry {entry}" in changed["line"]
    first = changed["problems"][0]
    assert (first["step"], first["entry"], first["kind"]) == (victim.step, entry, "changed")


def _sample_entry(row: JournalRow) -> int:
    """Index of the first sample of a row, -1 without one."""
    for i, entry in enumerate(decode_entries(row.entries)):
        if isinstance(entry.message, Sample):
            return i
    return -1


class Leader:
    """A leader robot of the same kind as the left arm: streams `q` and `qd` at 60 Hz."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self._model = load_model(scene_path("handover"))
        self._data = mujoco.MjData(self._model)
        mujoco.mj_resetDataKeyframe(self._model, self._data, 0)
        self._columns = [int(self._model.joint(name).qposadr[0]) for name in client.mirror.robots["left"].joints]
        self.home = self._data.qpos[self._columns].copy()
        self.offset = np.zeros(len(self._columns))
        self.swing = 0.0
        self.clutch = False
        self._began = time.monotonic()
        self._next = 0.0

    def step(self) -> None:
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + 1.0 / 60.0
        q, qd = self.joints(now)
        self.client.send_sample(
            "joints", kind="joints", robots=["left"], clutch=self.clutch, q=tuple(q.tolist()), qd=tuple(qd.tolist())
        )

    def joints(self, now: float) -> tuple[np.ndarray, np.ndarray]:
        t = now - self._began
        q, qd = self.home + self.offset, np.zeros_like(self.home)
        q[3] += self.swing * math.sin(2.0 * t)
        qd[3] = 2.0 * self.swing * math.cos(2.0 * t)
        return q, qd

    def tip(self) -> PoseTuple:
        """Where the follower's tip is when it stands as the leader does now."""
        self._data.qpos[self._columns] = self.joints(time.monotonic())[0]
        mujoco.mj_forward(self._model, self._data)
        robot = self.client.mirror.robots["left"]
        x, y, z = self._data.body(robot.site_body).xpos + self._data.body(robot.site_body).xmat.reshape(
            3, 3
        ) @ np.array(robot.T_body_site.p)
        return (float(x), float(y), float(z)), (1.0, 0.0, 0.0, 0.0)


def test_a_leader_robot_that_starts_apart_ramps_and_then_leads(serve: Callable[..., Server]) -> None:
    """Kinesthetic teaching: 0.5 rad apart at the start gives no jump; then the arm follows within centimetres."""
    stage = Stage(serve())
    try:
        client = stage.join("teacher", "leader")
        client.acquire(["left"])
        stage.run(lambda: client.scene.tip_pose("left") is not None, "a first picture")
        leader = Leader(client)
        leader.offset[0] = 0.5
        stage.hands.append(leader)  # type: ignore[arg-type]
        tips: list[tuple[int, PoseTuple]] = []

        def note() -> None:
            state, tip = client.scene.state, client.scene.tip_pose("left")
            if state is not None and tip is not None and (not tips or tips[-1][0] != state.header.tick):
                tips.append((state.header.tick, tip))

        closed_at = 0.0

        def hold_on() -> None:
            """Closes the clutch; again, as people do, when no sample counted while it was open."""
            nonlocal closed_at
            followed = client.scene.state is not None and bool(client.scene.state.header.applied)
            if not followed and time.monotonic() > closed_at + 3.0:
                leader.clutch = False
                stage.seconds(0.3)
                leader.clutch, closed_at = True, time.monotonic()

        def caught_up() -> bool:
            note()
            if closed_at:
                hold_on()
            return distance(tips[-1][1][0], leader.tip()[0]) < 0.01

        stage.seconds(0.2)
        assert not caught_up(), "it must start apart"
        hold_on()
        stage.run(caught_up, "the follower has caught up")
        leader.swing = 0.2
        until = time.monotonic() + 2.0
        errors: list[float] = []
        while time.monotonic() < until:
            stage.step()
            note()
            errors.append(distance(tips[-1][1][0], leader.tip()[0]))
        assert sorted(errors)[len(errors) // 2] < 0.04, "it must follow the swinging leader"
        for (tick0, a), (tick1, b) in itertools.pairwise(tips):
            assert distance(a[0], b[0]) <= 1.5 * max(0.017, (tick1 - tick0) * 0.002), "a jump"
        stage.server.finish()
    finally:
        stage.close()
