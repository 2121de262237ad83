"""Random sessions of the real authority, control and physics, re-run from their journal in a fresh process.

People of every role drive four arms of four lease modes and three objects by pose, twist, absolute target and joints;
in between come e-stops, pauses, resets, gaps, losses, resumes, recentred headsets, mode changes, forged and broken
samples. The journal and snapshots at random steps go to a file; another process with another hash seed continues from
every snapshot and must give the same digests.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from random import Random
from typing import Any, Final

import msgspec
import mujoco
import numpy as np

from anchors.pose import Vec3, quat_from_rotvec
from iris_session.authority import AuthorityConfig
from iris_session.control import ControlConfig
from iris_session.demo.scenes import n_arms_scene
from iris_session.physics import decode_model, find_objects, find_robots
from iris_session.protocol import client_messages as cm
from iris_session.protocol import entries as em
from iris_session.protocol.common import Pose, Target
from iris_session.protocol.entries import HOST, Entry, Join, decode_entries, encode_entries
from iris_session.session.core import CoreConfig, CoreState, SessionCore, read_plant_state

MS: Final = 1_000_000
ROOT: Final = Path(__file__).resolve().parents[2]
MODES: Final = ("exclusive", "shared", "priority", "takeover")
#: Role, device and kind of sample of the people; the first two also take objects by hand.
CASTS: Final = (
    ("operator", "controller/right", "pose"),
    ("operator", "hand/left", "pose"),
    ("operator", "desktop", "twist"),
    ("agent", "target", "pose"),
    ("leader", "joints", "joints"),
    ("director", "controller/left", "pose"),
)
GOOD: Final = tuple(1e-8 if i % 7 == 0 else 0.0 for i in range(36))


class Row(msgspec.Struct, frozen=True, array_like=True):
    """One step: its inputs and the digest it gave."""

    now_ns: int
    entries: bytes
    n_ticks: int
    plant: bytes
    digest: bytes


class Journal(msgspec.Struct, array_like=True):
    """A whole session, as another process needs it. `frames`: state before the step of that number."""

    model: bytes
    config: bytes
    rows: list[Row] = []
    frames: dict[int, CoreState] = {}


class Person(msgspec.Struct):
    """The state of one participant as it knows it."""

    connection: int
    role: str
    device: str
    kind: str
    key: str
    id: str = ""
    seq: int = 0
    tracking_epoch: int = 0
    clutch: bool = False
    p: Vec3 = (0.0, 0.0, 1.0)
    turn: Vec3 = (0.0, 0.0, 0.0)


def make_config(model: Any, user_owned: bool) -> CoreConfig:
    robots = tuple(
        msgspec.structs.replace(r, mode=mode) for r, mode in zip(find_robots(model).robots, MODES, strict=True)
    )
    authority = AuthorityConfig(
        heartbeat_timeout_ns=1000 * MS, grace_ns=500 * MS, max_participants=8, user_owned_loop=user_owned
    )
    return CoreConfig(authority, ControlConfig(), robots, find_objects(model))


class Stress:
    """One random session. `open`: the plant is a simulation of its own, as in a user's loop."""

    def __init__(self, seed: int, *, open_loop: bool) -> None:
        self.rng = Random(seed)
        model = n_arms_scene(len(MODES), 3).compile()
        self.config = make_config(model, open_loop)
        self.core = SessionCore(model, self.config)
        encoded = msgspec.msgpack.encode(self.config)
        self.journal = Journal(self.core.world.encode_model(), encoded)
        self.model = model
        self.user: Any = None
        if open_loop:
            self.user = mujoco.MjData(model)
            mujoco.mj_setState(model, self.user, np.frombuffer(self.core.world.save_state()), _state_kind())
        self.now_ns = 1000 * MS
        self.entries: list[Entry] = []
        self.people: list[Person] = []
        self.connections = 0
        self.moved = 0
        self.held_ticks = [0] * len(self.config.robots)
        self.kinds: set[str] = set()
        for cast, robot in zip(CASTS, (0, 1, 1, 2, 3, 2), strict=True):
            self.enter(cast)
            self.say(self.people[-1], cm.Acquire(1, (self.config.robots[robot].name,)))

    @property
    def state(self) -> Any:
        """Apply replies and events as honest clients do."""
        return self.core.authority._ctx.state

    # --- one step ---

    def step(self) -> None:
        rng = self.rng
        self.now_ns += rng.choices([2, 0, 20, 160, 700], [300, 3, 3, 1, 0.3])[0] * MS
        n_ticks = 1 if self.user is not None else rng.choices([1, 0, 2], [20, 2, 1])[0]
        if self.user is not None and rng.random() < 0.1:
            n_ticks = 0
        for person in self.people:
            if rng.random() < 0.15:
                self.sample(person)
        if rng.random() < 0.05:
            self.act()
        if rng.random() < 0.02:
            self.journal.frames[len(self.journal.rows)] = self.core.snapshot()
        if rng.random() < 0.01:
            self.swap()
        self.take(n_ticks)

    def take(self, n_ticks: int) -> None:
        """Take one step with all entries since the last one."""
        blob = encode_entries(self.entries)
        self.entries = []
        plant = read_plant_state(self.model, self.user) if self.user is not None else b""
        before = self.core.controller._joints.q.copy(), self.core.controller._joints.v.copy()
        drivers, ctrl = self.list_drivers(), self.core.world.ctrl.copy() if self.user is None else self.user.ctrl.copy()
        outcome = self.core.step(self.now_ns, decode_entries(blob), n_ticks, plant)
        self.journal.rows.append(Row(self.now_ns, blob, n_ticks, plant, outcome.digest))
        for admitted in outcome.decision.admitted:
            next(p for p in self.people if p.connection == admitted.connection).id = admitted.participant_id
        if not any(e.body.__class__.__name__ == "SceneChanged" for e in outcome.decision.events):
            self.check_motion(*before, n_ticks, drivers)
            self.check_ctrl(ctrl, n_ticks)
        self.check_holds([c.kind == "hold" for c in outcome.decision.commands], n_ticks)
        self.kinds |= {c.kind for c in outcome.decision.commands}
        self.moved += sum(c.kind != "hold" for c in outcome.decision.commands)
        assert not outcome.diverged
        if self.user is not None and n_ticks:
            self.user.ctrl[:] = self.core.world.data.ctrl
            self.user.xfrc_applied[:] = self.core.world.data.xfrc_applied
            mujoco.mj_step(self.model, self.user)
            if self.rng.random() < 0.5:  # `end_tick` shows the new state before the next step, a callback does not
                self.core.world.restore_state(read_plant_state(self.model, self.user))

    def list_drivers(self) -> list[bool]:
        """Return whether control drives each robot; in a user loop some are the owner's."""
        sharing = self.core.sharing
        return [True] * len(self.config.robots) if sharing is None else [bool(r.drivers) for r in sharing._robots]

    def check_motion(self, q: Any, v: Any, n_ticks: int, drivers: list[bool]) -> None:
        """Check that commanded joints keep their limits of velocity and acceleration.

        Only those that measured joints have left behind beyond their bound are taken along, and stop at once.
        """
        joints, x = self.core.controller._joints, self.core.world.data.qpos[self.core.controller._qpos]
        jumped = np.abs(joints.q - q) > joints.velocity * joints.dt * n_ticks + 1e-9
        good = ~jumped | (np.abs(joints.q - x) < np.abs(q - x))
        slower = np.abs(joints.v) <= np.abs(v)
        good &= slower | (np.abs(joints.v - v) <= joints.acceleration * joints.dt * n_ticks + 1e-9)
        for columns, before, now in zip(self.core.controller._columns, drivers, self.list_drivers(), strict=True):
            if before and now:
                assert good[columns].all()

    def check_ctrl(self, ctrl: Any, n_ticks: int) -> None:
        """Check that `ctrl` never jumps: control keeps its limits, giving back adds at most as much."""
        if self.user is None or not n_ticks:
            return
        for out in self.core.controller.list_outputs():
            change = np.abs(self.core.world.ctrl - ctrl)[out.actuators]
            assert (change <= 2.0 * out.rates * self.core.controller._dt + 1e-9).all()

    def check_holds(self, holds: list[bool], n_ticks: int) -> None:
        """Check that a robot that holds for 0.2 s rests: at 2.5 rad/s and 40 rad/s^2 it stops within 32 ticks."""
        joints, columns = self.core.controller._joints, self.core.controller._columns
        for i, hold in enumerate(holds):
            self.held_ticks[i] = self.held_ticks[i] + n_ticks if hold else 0
            if self.held_ticks[i] > 100:
                assert not joints.v[columns[i]].any(), f"robot {i} moves after {self.held_ticks[i]} ticks of hold"

    def swap(self) -> None:
        """Continue the session in a fresh core."""
        state = self.core.snapshot()
        self.core = SessionCore(self.model, self.config)
        self.core.restore(state)
        assert self.core.snapshot() == state

    # --- what people do ---

    def say(self, person: Person, message: Any) -> None:
        self.entries.append(Entry(person.connection, person.connection, self.now_ns, message))

    def host(self, message: Any) -> None:
        self.entries.append(Entry(HOST, HOST, self.now_ns, message))

    def enter(self, cast: tuple[str, str, str], old: Person | None = None) -> None:
        self.connections += 1
        role, device, kind = cast
        person = Person(self.connections, role, device, kind, old.key if old else f"key{self.connections}")
        if old is not None:
            self.people.remove(old)
            person.id = old.id
        self.people.append(person)
        needs = "measured" if role in ("operator", "director") and kind == "pose" else "not_needed"
        runs = ("run:1",) if self.rng.random() < 0.5 else ()
        self.say(person, Join(person.key, role, role, alignment=needs, resume_of=person.id, capabilities=runs))
        self.align(person)

    def align(self, person: Person) -> None:
        x, yaw = self.rng.choice([0.0, 0.1]), self.rng.choice([0.0, 0.4])
        T = Pose((x, 0.0, 0.0), quat_from_rotvec((0.0, 0.0, yaw)))
        self.say(person, em.AlignmentProposal(T, person.tracking_epoch, GOOD, (0.0, 0.0, 0.0), 0.002))

    def held(self, person: Person) -> list[Any]:
        leases = (*self.state.robots.values(), *self.state.objects.values())
        return [lease for lease in leases if any(g.participant == person.id for g in lease.grants)]

    def sample(self, person: Person, **forged: Any) -> None:
        rng = self.rng
        held = self.held(person)
        follows = any(g.engagement and g.participant == person.id for lease in held for g in lease.grants)
        if rng.random() < (0.02 if person.clutch and follows else 0.3):
            person.clutch = not person.clutch
        person.seq += 1
        person.p = tuple(x + rng.uniform(-0.01, 0.012) for x in person.p)  # type: ignore[assignment]
        person.turn = tuple(x + rng.uniform(-0.02, 0.02) for x in person.turn)  # type: ignore[assignment]
        alignment = getattr(self.state.participants.get(person.id), "alignment", None)
        fields: dict[str, Any] = {
            "device": person.device,
            "kind": person.kind,
            "seq": person.seq,
            "capture_ns": self.now_ns - rng.choice([0, 5, 140]) * MS,
            "scene_epoch": self.state.scene_epoch,
            "tracking_epoch": person.tracking_epoch,
            "alignment_version": alignment.version if alignment is not None else 0,
            "targets": tuple(Target(lease.target, lease.version, lease.kind) for lease in held),
            "clutch": person.clutch,
            "gripper": rng.choice([None, 0.0, 1.0, rng.random()]),
        }
        fields |= self.payload(person, held)
        self.say(person, cm.Sample(**{**fields, **forged}))

    def payload(self, person: Person, held: list[Any]) -> dict[str, Any]:
        rng = self.rng
        if person.kind == "twist":
            return {"twist": tuple(rng.uniform(-0.5, 0.5) for _ in range(6))}
        if person.kind == "joints":
            name = next((lease.target for lease in held if lease.kind == "robot"), self.config.robots[0].name)
            now = self.core.world.view().joints(name)
            return {"q": tuple(x + 0.3 * math.sin(1e-9 * self.now_ns + i) for i, x in enumerate(now)), "qd": (0.1,) * 7}
        p = person.p
        if person.device == "target" and held:
            p = self.core.world.view().tip_pose(self.config.robots[0].name).p
        return {"pose": Pose(p, quat_from_rotvec(person.turn))}

    def act(self) -> None:
        """Make one random event."""
        rng, person = self.rng, self.rng.choice(self.people)
        robots = [r.name for r in self.config.robots]
        choice = rng.choices(
            ["acquire", "grasp", "release", "trouble", "direct", "align", "forge", "recover"],
            [8, 2, 0.5, 0.3, 0.7, 0.7, 0.7, 4],
        )[0]
        if choice == "acquire":
            names = tuple(rng.sample(robots, rng.choice([0, 1, 1, 2])))
            self.say(person, cm.Acquire(1, names, wait=rng.random() < 0.5, weight=rng.choice([1.0, 2.0])))
        elif choice == "grasp" and person.kind == "pose":
            self.say(person, cm.Grasp(1, rng.choice(self.config.objects).name, person.device))
        elif choice == "release":
            self.say(person, cm.Release(1))
        elif choice == "align":
            self.align(person)
        elif choice == "trouble":
            self.trouble(person)
        elif choice == "direct":
            self.direct(person, robots)
        elif choice == "forge":
            self.forge(person)
        else:
            self.recover()

    def recover(self) -> None:
        self.host(cm.ClearEStop(1, self.core.authority.stop_seq))
        self.host(cm.Control(1, "resume"))
        for person in self.people:
            self.say(person, cm.Heartbeat())
        if len(self.people) < len(CASTS):
            self.enter(self.rng.choice(CASTS))

    def trouble(self, person: Person) -> None:
        rng = self.rng
        what = rng.choice(["lost", "bye", "estop", "worn", "recentre", "resume", "front"])
        cast = (person.role, person.device, person.kind)
        if what == "lost":
            self.say(person, em.Lost("net"))
            self.enter(cast, person)
        elif what == "resume":
            self.enter(cast, person)
        elif what == "bye":
            self.say(person, cm.Bye())
            self.people.remove(person)
        elif what == "recentre":
            person.tracking_epoch += 1
            self.say(person, cm.TrackingEpoch(person.tracking_epoch))
            self.align(person)
        elif what == "front":
            self.host(em.FrontRestarted())
            for other in tuple(self.people):
                self.enter((other.role, other.device, other.kind), other)
        else:
            self.say(person, cm.EStop("stop") if what == "estop" else cm.Heartbeat(worn=False))

    def direct(self, person: Person, robots: list[str]) -> None:
        rng = self.rng
        messages = [
            cm.Control(1, "pause"),
            cm.Control(1, "reset"),
            cm.Control(1, "step", 3),
            cm.SetMode(1, rng.choice(robots), rng.choice([*MODES, "request"])),
            cm.SetScale(1, (rng.choice(robots),), rng.choice([0.1, 0.5, 1, 3.0, math.nan])),
            cm.Assign(1, tuple(rng.sample(robots, 1)), rng.choice(["", person.id])),
            cm.PlaceAlignment(1, person.id, Pose((0.2, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), rng.random() < 0.5),
            cm.Episode(1, rng.choice(["start", "success", "rerecord", "rerecord"]), countdown_ns=0),
            em.ObjectsPlaced(("hammer", "cube"), (Pose((0.2, 0.1, 0.5), (1.0, 0.0, 0.0, 0.0)),) * 2),
            em.StalledGap(200 * MS),
            em.RecordingGap(3),
        ]
        if self.user is not None and rng.random() < 0.2:
            mujoco.mj_resetDataKeyframe(self.model, self.user, 0)
            messages = [em.ExternalReset()]
        self.host(rng.choice(messages))

    def forge(self, person: Person) -> None:
        x = self.rng.choice([1e-3, math.nan, math.inf, 1e300])
        forged: list[dict[str, Any]] = [
            {"pose": Pose((x, 0.0, 1.0), (1.0, x, 0.0, 0.0))},
            {"gripper": x},
            {"q": (x,) * 7},
            {"twist": (x,) * 6},
            {"worn": False},
            {"tracked": False},
            {"scene_epoch": 99},
            {"seq": 0},
            {"alignment_version": 77},
            {"capture_ns": self.now_ns - 151 * MS},
        ]
        self.sample(person, **self.rng.choice(forged))


def _state_kind() -> int:
    return int(mujoco.mjtState.mjSTATE_INTEGRATION)


def play(seed: int, steps: int, *, open_loop: bool) -> Stress:
    """Play a session of `steps` random steps."""
    stress = Stress(seed, open_loop=open_loop)
    for _ in range(steps):
        stress.step()
    return stress


def replay(journal: Journal, span: int) -> list[str]:
    """Replay the whole journal, then `span` steps from every frame. Return the differences."""
    model = decode_model(journal.model)
    config = msgspec.msgpack.decode(journal.config, type=CoreConfig)
    found = []
    for first in (0, *journal.frames):
        core = SessionCore(model, config)
        if first:
            core.restore(journal.frames[first])
        last = min(len(journal.rows), first + span) if first else len(journal.rows)
        for step in range(first, last):
            row = journal.rows[step]
            outcome = core.step(row.now_ns, decode_entries(row.entries), row.n_ticks, row.plant)
            if outcome.digest != row.digest:
                found.append(f"from {first}: step {step} differs")
                break
            frame = journal.frames.get(step + 1)
            if frame is not None and not _same(core.snapshot(), frame, with_plant=not row.plant):
                found.append(f"from {first}: the snapshot after step {step} differs")
                break
    return found


def _same(a: CoreState, b: CoreState, *, with_plant: bool) -> bool:
    """Compare states except the plant of an open session, which the next step sets."""
    return a == (b if with_plant else msgspec.structs.replace(b, plant=a.plant))


def replay_elsewhere(journal: Journal, span: int = 60) -> list[str]:
    """Run `replay` in a fresh process with another hash seed."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "journal"
        path.write_bytes(msgspec.msgpack.encode(journal))
        command = [sys.executable, "-m", "tests.session.replay_stress", str(path), str(span)]
        env = {**os.environ, "PYTHONHASHSEED": "77"}
        done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    return done.stdout.splitlines() if done.returncode == 0 else [done.stderr]


if __name__ == "__main__":
    print("\n".join(replay(msgspec.msgpack.decode(Path(sys.argv[1]).read_bytes(), type=Journal), int(sys.argv[2]))))
