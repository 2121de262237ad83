"""Random schema-valid entries for a whole session core: numbers, names and lengths that no honest client would send.

`tools/fuzz_state_machines.py` runs it for long. Whatever comes, a step never raises, commands stay typed, memory stays
bounded and joints keep their limits.
"""

from __future__ import annotations

import math
from random import Random
from typing import Any, Final, get_args

import msgspec
import numpy as np

from iris_session.demo.scenes import n_arms_scene
from iris_session.protocol import client_messages as cm
from iris_session.protocol import entries as em
from iris_session.protocol import names
from iris_session.protocol.common import Pose, Target
from iris_session.protocol.entries import HOST, Entry, EntryMessage, decode_entries, encode_entries
from iris_session.protocol.scene import SetVisual
from iris_session.protocol.steps import Decision
from iris_session.session.core import CoreConfig, SessionCore
from tests.session.replay_stress import make_config

MS: Final = 1_000_000
FLOATS: Final = (0.0, -0.0, 1.0, 0.5, -1.0, math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 1e-3, 999.0, 1e10)
COUNTS: Final = (0, 1, 2, 3, 7, 2**31, 2**63 - 1)
TIMES: Final = (-(2**63), -1, 0, 2**63 - 1)
WORDS: Final = ("", "x", "ß" * 64, "arm1", "arm2", "arm3", "arm4", "object1", "p1", "p2", "host", "left\n[red]")
ENUMS: Final[dict[str, tuple[str, ...]]] = {
    "device": tuple(sorted(names.Device.ALL)),
    "mode": tuple(sorted(names.LeaseMode.ALL)),
    "role": tuple(sorted(names.Role.ALL)),
    "action": tuple(sorted(names.ControlAction.ALL | names.EpisodeAction.ALL | names.AlignAction.ALL)),
    "kind": tuple(sorted(names.AlarmKind.ALL)),
    "alignment": ("measured", "not_needed", "placed"),
}
_MESSAGES: Final = tuple(kind for kind in get_args(EntryMessage) if kind is not em.Join)
#: Rare, or nothing would live long enough to be interesting.
_ENDING: Final = (
    em.Lost,
    cm.Bye,
    em.FrontRestarted,
    em.SessionResumed,
    em.AlignmentAlarm,
    cm.EStop,
    em.ExternalReset,
    em.StalledGap,
    em.SceneLoaded,
)
_decision = msgspec.msgpack.Decoder(Decision)


class Fuzz:
    """A session core under random entries. The seed determines every choice."""

    def __init__(self, seed: int) -> None:
        self.rng = Random(seed)
        model = n_arms_scene(4, 3).compile()
        config = make_config(model, user_owned=False)
        authority = msgspec.structs.replace(
            config.authority, quota=32, anchors={"table": Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))}
        )
        assert config.robots[0].name in WORDS
        settled = CoreConfig(authority, config.control, config.robots, config.objects)
        self.core = SessionCore(model, settled, lambda _: model)
        self.model_hash = self.core.world.scene_hash
        self.scenes = 0
        self.now_ns = 1000 * MS
        self.connections = 0
        self.seq = 0
        self.moved = 0
        self.rejected: set[str] = set()
        self.largest = 0

    @property
    def state(self) -> Any:
        return self.core.authority._ctx.state

    def step(self, n_entries: int) -> None:
        rng = self.rng
        self.now_ns += rng.choices([2, 0, 30, 200], [50, 2, 2, 0.2])[0] * MS
        entries = [self.entry() for _ in range(n_entries)]
        if rng.random() < 0.3:
            clear = cm.ClearEStop(1, self.core.authority.stop_seq)
            entries += [Entry(HOST, HOST, self.now_ns, m) for m in (clear, cm.Control(1, "resume"))]
        if rng.random() < 0.04:
            entries.insert(0, Entry(HOST, HOST, self.now_ns, self.scene()))
        entries = decode_entries(encode_entries(entries))
        before, scene = self.core.controller._joints.q.copy(), self.core.scene
        outcome = self.core.step(self.now_ns, entries, rng.choice([0, 1, 1]))
        encoded = msgspec.msgpack.encode(outcome.decision)
        _decision.decode(encoded)  # a client's schema takes it
        joints, n = self.core.controller._joints, len(self.core.scene.robots)
        self.scenes += self.core.scene is not scene
        assert len(outcome.decision.commands) == n
        assert np.isfinite(joints.q).all()
        # When its owner has moved the robots, they hold where they stand now.
        moved = any(e.connection == HOST and isinstance(e.message, em.ExternalReset) for e in entries)
        if self.core.scene is scene and not outcome.decision.reset and not moved:
            x = self.core.world.data.qpos[self.core.controller._qpos]
            jumped = np.abs(joints.q - before) > joints.velocity * joints.dt + 1e-9
            assert (np.abs(joints.q - x) < np.abs(before - x))[jumped].all()  # taken along by joints that were pushed
        assert not outcome.diverged
        self.moved += sum(c.kind != "hold" for c in outcome.decision.commands)
        for p in self.state.participants.values():
            self.rejected |= set(p.rejected)
        if rng.random() < 0.02:
            snapshot = self.core.snapshot()
            self.largest = max(self.largest, len(snapshot.authority))
            self.core.restore(snapshot)
            assert self.core.snapshot() == snapshot

    def entry(self) -> Entry:
        rng = self.rng
        present = [p.connection for p in self.state.participants.values() if p.connection > 0]
        if len(present) < 3 or rng.random() < 0.02:
            self.connections += 1
            role = rng.choice([*ENUMS["role"], "operator", "director", "leader", "agent", "king"])
            alignment = rng.choice(ENUMS["alignment"])
            if rng.random() < 0.8:
                role, alignment = rng.choice(["operator", "director", "leader", "agent"]), "not_needed"
            join = em.Join(
                rng.choice(WORDS), role, rng.choice(WORDS), alignment=alignment, gateway=rng.choice([0, 0, 3])
            )
            return Entry(self.connections, self.connections, self.now_ns, join)
        connection = rng.choice([*present, *present, *present, HOST, 2**40])
        kind = rng.choice(_MESSAGES) if rng.random() < 0.3 else rng.choice([cm.Sample, cm.Sample, cm.Acquire, cm.Grasp])
        if issubclass(kind, _ENDING) and rng.random() < 0.97:
            kind = cm.Sample
        if kind is em.SceneLoaded:
            message: Any = self.scene()
        else:
            message = self.sample(connection) if kind is cm.Sample else self.message(kind)
        claimed = connection if rng.random() < 0.95 else rng.choice(COUNTS)
        received = self.now_ns if rng.random() < 0.97 else rng.choice(TIMES)
        return Entry(connection, claimed, received, message)

    def scene(self) -> em.SceneLoaded:
        """The same model with some of its robots and objects, in any order."""
        rng, config = self.rng, self.core.config
        robots = rng.sample(config.robots, rng.randrange(1, len(config.robots) + 1))
        objects = rng.sample(config.objects, rng.randrange(len(config.objects) + 1))
        return em.SceneLoaded(self.model_hash, tuple(robots), tuple(objects))

    def message(self, kind: type) -> Any:
        return kind(**{f.name: self.value(f.name, str(f.type)) for f in msgspec.structs.fields(kind)})

    def value(self, name: str, kind: str) -> Any:
        """A value that the schema takes, of a field by its name and type."""
        rng = self.rng
        number = rng.choice(FLOATS) if rng.random() < 0.2 else rng.uniform(0.1, 2.0)
        if name in ("tracking_epoch", "ticks", "request_id"):
            return 0 if rng.random() < 0.95 else rng.choice((1, 2**63 - 1))
        if name in ("robots", "objects", "devices", "capabilities", "beside", "moved"):
            known = [r.name for r in self.core.scene.robots] if name == "robots" else WORDS
            return tuple(rng.choice(known if rng.random() < 0.9 else WORDS) for _ in range(rng.randrange(4)))
        if name == "targets":
            return self.targets()
        if name == "ops":
            return tuple(SetVisual(rng.randrange(50), group=rng.randrange(6)) for _ in range(rng.randrange(4)))
        if name in ("T_world_tracking", "T_tracking_anchor", "T_world_anchor", "pose"):
            return self.pose()
        if name == "alternative":
            return rng.choice((None, self.pose()))
        if name == "residuals_px":
            return (number,) * rng.choice([0, 2])
        if name == "poses":
            return tuple(Pose((0.1 * n, 0.5, rng.choice((0.5, math.nan))), (1.0, 0.0, 0.0, 0.0)) for n in range(3))
        if name == "grip_poses":
            return tuple(self.pose() for _ in range(rng.randrange(4)))
        if name == "anchors":
            return {"table": self.pose()} if rng.random() < 0.5 else {}
        if name == "looks":
            times = ((rng.choice(COUNTS), self.now_ns - rng.randrange(10**10)) for _ in range(rng.randrange(3)))
            return tuple(em.AnchorLooks(rng.choice(("table", *WORDS)), *rng.sample(pair, 2)) for pair in times)
        if name == "anchor_id":
            return rng.choice(("table", *WORDS))
        if name in ("covariance", "q", "qd", "hand_joints", "shift_m"):
            return (number,) * rng.choice([0, 1, 3, 6, 7, 9, 36])
        if name in ("pivot_world", "p_world", "p_grip_tip"):
            return (number, 0.0, rng.choice(FLOATS))
        if "float" in kind:
            return number
        if "bool" in kind:
            return rng.random() < 0.5
        if "max_length=512" in kind:
            return rng.choice(("", "stop", "ß" * 512))
        if "int" in kind:
            return rng.choice(COUNTS) if rng.random() < 0.5 else rng.choice((self.now_ns, self.state.scene_epoch))
        return rng.choice((*ENUMS.get(name, WORDS), rng.choice(WORDS)))

    def targets(self) -> tuple[Target, ...]:
        rng = self.rng
        leases = (*self.state.robots.values(), *self.state.objects.values())
        chosen = [rng.choice(leases) for _ in range(rng.randrange(4))]
        honest = tuple(Target(lease.target, lease.version, lease.kind) for lease in chosen)
        return honest if rng.random() < 0.9 else (*honest, Target(rng.choice(WORDS), rng.choice(COUNTS), "ship"))

    def pose(self) -> Pose:
        rng = self.rng
        if rng.random() < 0.8:
            return Pose((0.5, rng.uniform(-0.005, 0.005), 1.0), (1.0, 0.0, 0.0, 0.0))
        p, q = (tuple(rng.choice(FLOATS) for _ in range(n)) for n in (3, 4))
        return Pose(p, q)  # type: ignore[arg-type]

    def sample(self, connection: int) -> cm.Sample:
        """Mostly right, with one or two fields of any value."""
        rng = self.rng
        p = next((p for p in self.state.participants.values() if p.connection == connection), None)
        held = [
            Target(lease.target, lease.version, lease.kind)
            for lease in (*self.state.robots.values(), *self.state.objects.values())
            if p is not None and any(g.participant == p.id for g in lease.grants)
        ]
        usual = ("controller/right", "target", "desktop", "joints", "hand/left")[connection % 5]
        device = usual if rng.random() < 0.9 else rng.choice(ENUMS["device"])
        kind = {"joints": "joints", "desktop": "twist"}.get(device, "pose")
        self.seq += 1
        good: dict[str, Any] = {
            "device": device,
            "kind": kind,
            "seq": self.seq,
            "capture_ns": self.now_ns,
            "scene_epoch": self.state.scene_epoch,
            "tracking_epoch": p.tracking_epoch if p is not None else 0,
            "alignment_version": p.alignment.version if p is not None and p.alignment is not None else 0,
            "targets": tuple(held[:8]) if kind == "pose" else tuple(t for t in held if t.kind == "robot")[:8],
            "clutch": rng.random() < 0.8,
            "gripper": rng.choice([None, 0.0, 1.0]),
            "pose": Pose((0.5, rng.uniform(-0.005, 0.005), 1.0), (1.0, 0.0, 0.0, 0.0)),
            "twist": (0.1, 0.0, 0.0, 0.0, 0.0, 0.1),
            "q": tuple(self.core.world.view().joints(self.core.scene.robots[0].name)) if kind == "joints" else (),
        }
        for f in rng.sample(msgspec.structs.fields(cm.Sample), rng.choice([0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 2])):
            good[f.name] = (
                tuple(rng.choice(FLOATS) for _ in range(6)) if f.name == "twist" else self.value(f.name, str(f.type))
            )
        return cm.Sample(**good)


def run(seed: int, entries: int, per_step: int = 20) -> Fuzz:
    """`entries` random entries in steps of up to `per_step`, now and then a flood."""
    fuzz = Fuzz(seed)
    while entries > 0:
        n = fuzz.rng.choice([1, 3, per_step, 20 * per_step]) if fuzz.rng.random() < 0.1 else fuzz.rng.randrange(4)
        fuzz.step(n)
        entries -= n
    return fuzz
