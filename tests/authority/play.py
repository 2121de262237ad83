"""Random sessions of honest, careless and forging participants, checked in every step against independent books.

`Play` keeps the journal of what everyone sent and knows nothing of how the authority decides. A second authority runs
beside the first and is replaced by `restore(snapshot())` at random moments: both must agree byte for byte.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from random import Random
from typing import Any, Final

import msgspec

from anchors.pose import quat_from_yaw
from iris_session.authority import Authority, AuthorityConfig
from iris_session.authority.state import NO_REPLY, AuthorityState, Pending
from iris_session.protocol import client_messages as cm
from iris_session.protocol.common import Pose, Target
from iris_session.protocol.entries import (
    AlignmentAlarm,
    AlignmentProposal,
    AnchorLooks,
    CrossChecked,
    Entry,
    FrontRestarted,
    Join,
    Lost,
    ObjectsPlaced,
    SessionResumed,
    decode_entries,
    encode_entries,
)
from iris_session.protocol.server_messages import ConsentRequested, EpisodeChanged, LeaseChanged, Reply, Snapshot
from iris_session.protocol.session_mirror import SessionMirror
from iris_session.protocol.specs import ObjectRange, ObjectSpec, TaskSpec
from iris_session.protocol.steps import Command, Decision, FixedView, ObjectContact

from .alignment_books import AlignmentBooks
from .table import MS, SECOND, make_view, proposal, robot, single_changes

ROBOTS: Final = (robot("left"), robot("right", "priority"), robot("third", "shared"))
OBJECTS: Final = (ObjectSpec("hammer", "hammer"), ObjectSpec("board", "board"))
NAMES: Final = tuple(r.name for r in ROBOTS)
DEVICES: Final = ("head", "controller/left", "controller/right", "hand/left", "target", "joints", "foot")
CONFIG: Final = AuthorityConfig(
    heartbeat_timeout_ns=SECOND,
    grace_ns=2 * SECOND,
    max_participants=6,
    max_queue=3,
    max_consents=2,
    quota=8,
    announce_ns=200 * MS,
    slide_ns=50 * MS,
    countdown_ns=100 * MS,
    confirm_ns=300 * MS,
    takeover_ns=300 * MS,
    verdict_ns=500 * MS,
    task=TaskSpec("stack", "Stack them.", 3, objects=(ObjectRange("hammer", (0.0, 0.1), (0.0, 0.1)),)),
    anchors={
        "table": Pose((0.0, -0.5, 0.0), (1.0, 0.0, 0.0, 0.0)),
        "door": Pose((2.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)),
    },
)
#: Holds after which the clutch must be seen open before the robot may move again.
REARMED: Final = (
    "episode",
    "estop",
    "gap",
    "scene_changed",
    "rejected",
    "disconnected",
    "rearm",
    "stale",
    "not_worn",
    "untracked",
)
#: States of an episode after which the next one may have the same number.
REPEATED: Final = ("countdown", "cancelled", "discarded")
#: What an episode may become next, by its state.
NEXT: Final = {
    "countdown": {"running", "cancelled", "countdown"},
    "running": {"running", "confirm", "left", "closing"},
    "confirm": {"running", "confirm", "left", "closing"},
    "left": {"running", "left", "closing"},
    "closing": {"closing", "success", "failure", "discarded", "unknown"},
    **{s: {"countdown", "running"} for s in ("idle", "success", "failure", "discarded", "unknown", "cancelled")},
}
_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(Decision).decode


class Client:
    """What one participant believes of itself."""

    def __init__(self, connection: int, role: str, key: str) -> None:
        self.connection, self.role, self.key = connection, role, key
        self.id = ""
        self.seq = 0
        self.tracking_epoch = 0

    @property
    def device(self) -> str:
        return {"leader": "joints", "agent": "target"}.get(self.role, "controller/right")


class Play:
    """One session under random play. Every choice comes from `rng`."""

    def __init__(self, rng: Random, policy: str = "join-order") -> None:
        self.config = msgspec.structs.replace(CONFIG, policy=policy, assignments={"anna": ("left",)})
        self.authority, self.twin = self.fresh(), self.fresh()
        self.alignments = AlignmentBooks(self.config)
        self.journal: list[tuple[int, bytes, int, FixedView]] = []
        self.results: list[bytes] = []
        self.now_ns = SECOND
        self.entries: list[Entry] = []
        self.connections = 0
        self.people: list[Client] = []
        self.mirror = SessionMirror()
        self.decision = Decision(())
        self.consents = [1]
        self.view = make_view()
        self.request_id = 0
        #: Requests without a reply so far, as (connection, request id).
        self.open: set[tuple[int, int]] = set()
        self.opened: set[tuple[str, str, str]] = set()
        self.engagements: dict[tuple[str, str], int] = {}
        #: Where a device was that moved something, by (participant, connection, device, tracking epoch, engagement).
        self.moved_from: dict[tuple[str, int, str, int, int], tuple[int, Pose]] = {}
        self.newest_engagement = 0
        self.episode, self.ended = EpisodeChanged(0, "idle"), 0
        #: The objects of the task lie where they were placed since the last reset.
        self.is_placed = False
        self.moved = 0
        self.flush()
        self.host(cm.GetSnapshot(1))
        self.flush()
        for role in ("operator", "operator", "agent"):
            self.enter(role)
        self.rng = rng

    def fresh(self) -> Authority:
        return Authority(self.config, ROBOTS, OBJECTS)

    @property
    def state(self) -> AuthorityState:
        """For the books only: who holds what, and the counters that honest clients learn from events."""
        return self.authority._ctx.state

    def host(self, message: Any) -> None:
        self.add(0, message)

    def say(self, client: Client, message: Any) -> None:
        self.add(client.connection, message)

    def add(self, connection: int, message: Any) -> None:
        if hasattr(message, "request_id"):
            self.request_id += 1
            message = msgspec.structs.replace(message, request_id=self.request_id)
            if not isinstance(message, cm.GetSnapshot):
                self.open.add((connection, self.request_id))
        self.entries.append(Entry(connection, connection, self.now_ns, message))

    # --- steps ---

    def flush(self, n_ticks: int = 1) -> None:
        """One step of both authorities with everything said since the last one, and every check."""
        blob = encode_entries(self.entries)
        entries = decode_entries(blob)
        self.entries = []
        before = self.connected()
        self.alignments.begin(self.state)
        self.decision = self.authority.step(self.now_ns, entries, n_ticks, self.view)
        self.journal.append((self.now_ns, blob, n_ticks, self.view))
        self.results.append(_encode(self.decision))
        assert _decode(self.results[-1]) == self.decision, "a client's schema would not take this"
        assert _encode(self.twin.step(self.now_ns, entries, n_ticks, self.view)) == self.results[-1]
        self.view = self.moved_on(n_ticks)
        for admitted in self.decision.admitted:
            next(c for c in self.people if c.connection == admitted.connection).id = admitted.participant_id
        self.consents += [e.body.consent_id for e in self.decision.events if isinstance(e.body, ConsentRequested)]
        self.follow_events()
        self.check_commands(entries)
        self.alignments.check(self.state, self.decision, entries, self.now_ns)
        self.check_episodes(entries)
        self.check_urgent(entries)
        self.check_bounds()
        self.check_queue()
        self.check_replies()
        self.check_dropped(before, entries)

    def moved_on(self, n_ticks: int) -> FixedView:
        """The world a few ticks later: robots sway, grippers touch things, and now and then physics diverges."""
        tick = self.view.tick + n_ticks
        view = make_view(tick=tick, sim_time=0.002 * tick)
        if not n_ticks or not hasattr(self, "rng"):
            return view
        rng, nowhere = self.rng, self.rng.random() < 0.05
        lie = Pose((math.nan if nowhere else 0.001 * (tick % 50), 0.0, 0.2), (1.0, 0.0, 0.0, 0.0))
        touching = tuple(name for name in NAMES if rng.random() < 0.3)
        contacts = (ObjectContact("hammer", touching[:1], touching, ("table",) if rng.random() < 0.1 else ()),)
        return msgspec.structs.replace(
            view, objects={**view.objects, "hammer": lie}, contacts=contacts, forces={"left": rng.choice([0.0, 3.0])}
        )

    def swap(self) -> None:
        """A crash between two steps: a new process continues from the snapshot."""
        snapshot = self.twin.snapshot()
        assert snapshot == self.authority.snapshot()
        self.twin = self.fresh()
        self.twin.restore(snapshot)
        assert self.twin.snapshot() == snapshot
        self.check_late_joiner()

    def replay(self) -> None:
        """The journal alone gives the same effects and the same state."""
        again = self.fresh()
        for (now_ns, blob, n_ticks, view), result in zip(self.journal, self.results, strict=True):
            assert _encode(again.step(now_ns, decode_entries(blob), n_ticks, view)) == result
        assert again.snapshot() == self.authority.snapshot()

    # --- what people do ---

    def act(self) -> None:
        """One random action, by its weight."""
        weights = [weight for weight, _ in ACTIONS]
        action: Callable[[Play], None] = self.rng.choices([a for _, a in ACTIONS], weights)[0]
        action(self)

    def who(self) -> Client:
        """Mostly one of those present, sometimes one who is gone."""
        present = [c for c in self.people if self.still_here(c)]
        return self.rng.choice(present if present and self.rng.random() < 0.9 else self.people[-8:])

    def some(self) -> tuple[str, ...]:
        return tuple(self.rng.choices(NAMES, k=self.rng.choice([0, 1, 1, 1, 2, 3])))

    def wait(self) -> None:
        self.now_ns += self.rng.choice([0, 2, 2, 20, 20, 100, 140, 149, 151, 600, 1100]) * MS
        self.flush(self.rng.choice([0, 1, 1, 2]))

    def enter(self, role: str, old: Client | None = None) -> None:
        self.connections += 1
        client = Client(self.connections, role, old.key if old is not None else f"key{self.connections}")
        self.people.append(client)
        need = "not_needed" if role in ("agent", "leader") else "measured"
        gates = [c.connection for c in self.people if c.role == "gateway" and self.still_here(c)]
        through = gates[-1] if gates and role != "gateway" and len(self.people) % 2 else 0
        resume_of = old.id if old is not None else ""
        self.say(client, Join(client.key, role, "anna", alignment=need, resume_of=resume_of, gateway=through))
        self.flush()
        if role == "operator":
            self.say(client, proposal())

    def join(self) -> None:
        self.enter(self.rng.choice(["operator", "operator", "agent", "director", "observer", "leader", "gateway"]))

    def resume(self) -> None:
        old = self.who()
        self.enter(old.role, old)

    def trouble(self) -> None:
        messages = [
            Lost(),
            cm.Bye("x" * 500),
            cm.EStop("x" * 500),
            cm.Release(),
            cm.Release(),
            cm.Heartbeat(worn=False),
        ]
        self.say(self.who(), self.rng.choice(messages))

    def recover(self) -> None:
        self.flush()  # stops that are on their way are to be seen
        self.host(cm.ClearEStop(1, self.state.stop_seq))
        self.host(cm.Control(1, "resume"))
        for client in [c for c in self.people if self.still_here(c)]:
            self.say(client, cm.Heartbeat())
        self.flush()

    def request(self) -> None:
        client, names, rng = self.who(), self.some(), self.rng
        message = rng.choice(
            [
                cm.Acquire(1, names, wait=rng.random() < 0.7, weight=rng.choice([1.0, 2.0, math.nan])),
                cm.Acquire(1, names, ("hammer",)),
                cm.Grasp(1, "hammer", rng.choice(DEVICES)),
                cm.Release(1, tuple(Target(n, rng.randrange(4)) for n in names)),
                cm.Release(1, tuple(Target(n, self.state.robots[n].version) for n in names[:1])),
                cm.Consent(1, rng.choice(self.consents[-2:]), rng.random() < 0.7),
                cm.Withdraw(1, max(0, self.request_id - rng.randrange(6))),
                cm.SetScale(1, names, rng.choice([0.1, 1.0, 2.0, 9.0, math.nan])),
            ]
        )
        self.say(client, message)

    def direct(self) -> None:
        rng = self.rng
        person = rng.choice(["", "nobody", *(c.id for c in self.people[-6:])])
        pose = Pose((0.0, 1.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        seen = max(0, self.state.stop_seq - rng.randrange(2))
        message = rng.choice(
            [
                cm.Assign(1, self.some(), person),
                cm.SetMode(
                    1, rng.choice(NAMES), rng.choice(["exclusive", "request", "takeover", "priority", "shared"])
                ),
                cm.Control(1, rng.choice(["pause", "step", "reset"])),
                cm.PlaceAlignment(1, person, pose, rng.random() < 0.5),
                cm.Align(1, rng.choice(["start", "stop", "dance"]), person),
                cm.MoveAnchor(1, rng.choice(["table", "moon"]), pose),
                cm.Rename(1, person, rng.choice(["anna", "bert", " "])),
                cm.SetRole(1, person, rng.choice(["operator", "observer", "director", "agent", "gateway", "cook"])),
                FrontRestarted() if rng.random() < 0.2 else cm.ClearEStop(1, seen),
            ]
        )
        self.host(message)

    def record(self) -> None:
        """An episode: mostly what its people do with it, sometimes the places of its objects."""
        actions = [
            "start",
            "stop",
            "success",
            "success",
            "failure",
            "discard",
            "discard",
            "rerecord",
            "take_over",
            "reset",
        ]
        place = ObjectsPlaced(("hammer",), (Pose((0.1, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0)),), 1, 7)
        is_awaited = self.episode.state == "closing" or not self.is_placed
        if self.rng.random() < (0.7 if is_awaited else 0.1):
            return self.host(place)
        holders = [c for c in self.people if self.still_here(c) and {*self.held(c)} & {*NAMES}]
        client = self.rng.choice(holders) if holders and self.rng.random() < 0.6 else self.who()
        is_over = "countdown" in NEXT[self.episode.state] and self.episode.state != "countdown"
        if is_over and self.rng.random() < 0.8:
            return self.say(client, cm.Episode(1, "start", countdown_ns=self.rng.choice([0, None])))
        if self.rng.random() < 0.3:
            buttons = self.rng.choice([0, 0, 16, 32])
            return self.say(client, self.sample(client, (), "controller/right", False, buttons=buttons))
        return self.say(client, cm.Episode(1, self.rng.choice(actions)))

    def align(self) -> None:
        client = self.who()
        if self.rng.random() < 0.3:
            client.tracking_epoch += 1
            self.say(client, cm.TrackingEpoch(client.tracking_epoch))
        self.say(client, self.look(client, refused=self.rng.random() < 0.2))

    def look(self, client: Client, **fields: Any) -> AlignmentProposal:
        """A measurement that says something else than the last one, a little or a lot."""
        x, yaw = self.rng.choice([1.0, 1.0, 1.003, 1.005, 1.009, 1.05, 1.1]), self.rng.choice([0.0, 0.01, 0.05])
        T = Pose((x, 0.0, 0.0), quat_from_yaw(yaw))
        looks = (AnchorLooks("table", self.now_ns - SECOND, self.now_ns),) if x == 1.05 else ()
        return proposal(tracking_epoch=client.tracking_epoch, T_world_tracking=T, looks=looks, **fields)

    def watch(self) -> None:
        """What the front says of its own: alarms, comparisons of headsets, and a run that somebody starts or stops."""
        client, rng = self.who(), self.rng
        alarm = AlignmentAlarm(
            rng.choice(["changed", "differs", "differs", "jump", "boom"]),
            max(0, client.tracking_epoch - rng.choice([0, 0, 0, 1])),
            rng.choice(["table", "door", ""]),
            rng.choice([0.01, 0.2, math.nan]),
            beside=rng.choice([(), (), ("door",)]),
            shift_m=(0.05, 0.0, 0.0),
        )
        compared = CrossChecked(self.who().connection, "table", rng.choice([0.004, math.nan]), 0.0, 0.01, (0.0,) * 3, 9)
        self.say(client, rng.choice([alarm, compared, cm.Align(1, "start"), cm.Align(1, "stop")]))

    def go_on(self) -> None:
        """The session ends and goes on from its recording: a new process, and everybody is away."""
        self.flush()
        self.swap()
        gap_ns = self.rng.choice([0, 5, 3600]) * SECOND
        self.now_ns += gap_ns
        self.host(SessionResumed(gap_ns))
        self.flush(0)

    # --- samples ---

    def sample(self, client: Client, names: tuple[str, ...], device: str, clutch: bool, **forged: Any) -> cm.Sample:
        client.seq += 1
        p = self.state.participants.get(client.id)
        leases = {**self.state.robots, **self.state.objects}
        fields: dict[str, Any] = {
            "device": device,
            "kind": "joints" if device == "joints" else "pose",
            "seq": client.seq,
            "capture_ns": self.now_ns,
            "scene_epoch": self.state.scene_epoch,
            "tracking_epoch": client.tracking_epoch,
            "alignment_version": p.alignment.version if p is not None and p.alignment is not None else 0,
            "targets": tuple(Target(n, leases[n].version, leases[n].kind) for n in names),
            "clutch": clutch,
            "pose": Pose((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)),
            "q": (0.0,) * 7 if device == "joints" else (),
            "gripper": 0.25,
        }
        if forged.get("kind") == "twist":
            fields |= {"pose": None, "twist": (0.1, 0.0, 0.0, 0.0, 0.0, 0.1)}
        sample = cm.Sample(**{**fields, **forged})
        client.seq = max(client.seq, sample.seq)
        return sample

    def held(self, client: Client) -> tuple[str, ...]:
        leases = (*self.state.robots.values(), *self.state.objects.values())
        return tuple(lease.target for lease in leases if any(g.participant == client.id for g in lease.grants))

    def drive(self) -> None:
        """Acquires and aligns if needed, then opens and closes the clutch on everything held."""
        client = self.who()
        if not self.held(client):
            self.say(client, self.rng.choice([cm.Grasp(1, "hammer", client.device), cm.Acquire(1, self.some())]))
            if client.role == "operator":
                self.say(client, proposal(tracking_epoch=client.tracking_epoch))
            self.flush()
        for clutch in (False, True):
            self.say(client, self.sample(client, self.held(client), client.device, clutch))
            self.now_ns += 2 * MS
            self.flush()

    def keep_going(self) -> None:
        """Everyone sends one more sample, mostly with the clutch closed."""
        for client in [c for c in self.people if self.still_here(c)]:
            fields: Any = {}
            if client.device != "joints" and self.rng.random() < 0.2:
                far = Pose((3.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
                fields = self.rng.choice([{"kind": "twist"}, {"kind": "twist"}, {"pose": far}, {"tracked": False}])
            names = self.held(client) if self.rng.random() < 0.9 else ()
            self.say(client, self.sample(client, names, client.device, self.rng.random() < 0.9, **fields))
            if client.role == "operator" and self.rng.random() < 0.2:
                self.say(client, self.look(client))
        self.now_ns += 14 * MS
        self.flush()

    def odd_sample(self) -> None:
        client = self.who()
        fields: dict[str, Any] = {"worn": self.rng.random() < 0.7, "tracked": self.rng.random() < 0.7}
        if self.rng.random() < 0.2:
            fields["kind"] = "twist"
        device, clutch = self.rng.choice(DEVICES), self.rng.random() < 0.5
        names = self.some() if self.rng.random() < 0.7 else ()
        self.say(client, self.sample(client, names, device, clutch, **fields))

    def forge(self) -> None:
        client, rng = self.who(), self.rng
        wrong, x = rng.randrange(7), rng.choice([1e-3, math.nan, math.inf, 1e300, -1e300])
        forged: dict[str, Any] = rng.choice(
            [
                {"scene_epoch": wrong},
                {"tracking_epoch": wrong},
                {"alignment_version": wrong},
                {"seq": wrong},
                {"capture_ns": self.now_ns + rng.choice([-151, -100, 4, 6]) * MS},
                {"targets": tuple(Target(n, wrong) for n in self.some())},
                {"pose": Pose((x, 0.0, 1.0), (1.0, x, 0.0, 0.0))},
                {"gripper": x},
                {"q": (x,) * 7},
            ]
        )
        s = self.sample(client, self.some(), client.device, True, **forged)
        if rng.random() < 0.2:
            s = self.sample(client, (), client.device, True)
        claimed = client if rng.random() < 0.7 else self.who()
        self.entries.append(Entry(client.connection, claimed.connection, self.now_ns, s))

    # --- what must hold ---

    def follow_events(self) -> None:
        for out in self.decision.outgoing:
            if isinstance(out.message, Snapshot) and not self.mirror.synced:
                self.mirror.apply_snapshot(out.message)
        for event in self.decision.events:
            if self.mirror.synced and event.event_seq > self.mirror.event_seq:
                assert self.mirror.apply_event(event), "a gap in event_seq"

    def check_late_joiner(self) -> None:
        """Events alone give the same picture as a snapshot."""
        probe = self.fresh()
        probe.restore(self.authority.snapshot())
        out = probe.step(self.now_ns, [Entry(0, 0, self.now_ns, cm.GetSnapshot(1))], 0, self.view)
        (snapshot,) = [o.message for o in out.outgoing if isinstance(o.message, Snapshot)]
        late = SessionMirror()
        late.apply_snapshot(snapshot)
        if not out.events:
            assert late.mirror_hash() == self.mirror.mirror_hash()

    def check_commands(self, entries: list[Entry]) -> None:
        assert tuple(c.robot for c in self.decision.commands) == NAMES
        sent: dict[tuple[int, str, int], Entry] = {}
        shut: set[tuple[str, str, str]] = set()
        for e in entries:
            if isinstance(s := e.message, cm.Sample):
                shut |= self.note_clutch(e.connection, s)
                sent.setdefault((e.connection, s.device, s.seq), e)
        changes = [body for e in self.decision.events for body in single_changes(e.body)]
        changed = {body.lease.target for body in changes if isinstance(body, LeaseChanged)}
        for c in self.decision.commands:
            assert (c.kind == "hold") == (c.hold_reason != "") == (not c.sources)
            assert len(c.sources) <= 1 or self.state.robots[c.robot].mode == "shared"
            if self.state.robots[c.robot].mode == "shared":
                engaged = [g.participant for g in self.state.robots[c.robot].grants if g.engagement]
                assert [s.participant for s in c.sources] == engaged, "who is engaged drives"
            assert not c.sources or math.isclose(sum(s.weight for s in c.sources), 1.0)
            assert not c.sources or c.scale == self.mirror.leases[c.robot].scale
            assert 0.05 <= c.scale <= 5.0
            self.check_sources(c, sent)
            # With several holders the reason is that of one of them; the others' latches are their own.
            if c.hold_reason in REARMED and len(self.state.robots[c.robot].grants) == 1:
                # These two may be of one device, and another one, whose clutch was open, drives on.
                by_device = c.hold_reason in ("rearm", "untracked") and c.robot not in changed
                self.opened = {o for o in self.opened if o[2] != c.robot or (by_device and o not in shut)}

    def note_clutch(self, connection: int, s: cm.Sample) -> set[tuple[str, str, str]]:
        """Note where a sample opens the clutch; return where it does not."""
        client = next((c for c in self.people if c.connection == connection), None)
        named = {(client.id, s.device, t.name) for t in s.targets} if client is not None else set()
        if not s.clutch:
            self.opened |= named
        return named if s.clutch or not s.tracked else set()

    def check_sources(self, c: Command, sent: dict[tuple[int, str, int], Entry]) -> None:
        lease = self.state.robots[c.robot]
        grants = {g.participant: g for g in lease.grants}
        for s in c.sources:
            self.moved += 1
            payload = {"pose": s.pose_world, "twist": s.twist_world, "joints": s.q or None}
            assert [kind for kind, value in payload.items() if value is not None] == [c.kind], "kinds do not mix"
            assert s.participant in grants, "moved by one who does not hold it"
            p = self.state.participants[s.participant]
            assert p.connection > 0
            assert p.worn
            assert p.role in ("operator", "director", "agent", "leader")
            assert p.alignment is not None or s.device == "joints"
            assert not self.state.estop
            assert not self.state.paused
            assert self.state.episode is None or self.state.episode.state != "closing"
            assert s.pose_world is None or all(map(math.isfinite, (*s.pose_world.p, *s.pose_world.q)))
            if self.engagements.get((c.robot, s.participant)) != s.engagement:
                assert s.engagement > self.engagements.get((c.robot, s.participant), 0)
                assert (s.participant, s.device, c.robot) in self.opened, "engaged without an open clutch"
                self.engagements[(c.robot, s.participant)] = s.engagement
                self.opened.discard((s.participant, s.device, c.robot))
            if not s.new:
                assert self.now_ns - s.receive_ns <= 2 * CONFIG.freshness_ns
                continue
            e = sent[(p.connection, s.device, s.seq)]
            m = e.message
            assert isinstance(m, cm.Sample)
            assert e.connection_epoch == e.connection
            assert m.clutch
            if m.kind == "pose" and m.pose is not None:
                # An engagement moves its robot relative to where it began, but a target of a policy is a place.
                device = (p.id, p.connection, s.device, p.tracking_epoch, 0 if s.absolute else s.engagement)
                then, before = self.moved_from.get(device, (m.capture_ns, m.pose))
                bound = max(0, m.capture_ns - then) * 1e-9 * 10.0 + CONFIG.speed_slack_m
                assert math.dist(m.pose.p, before.p) <= bound, "nobody moves that fast"
                self.moved_from[device] = (m.capture_ns, m.pose)
            assert (m.scene_epoch, m.tracking_epoch) == (self.decision.scene_epoch, p.tracking_epoch)
            (version, *_) = [t.lease_version for t in m.targets if t.name == c.robot]
            assert grants[s.participant].version <= version <= lease.version
            assert -CONFIG.future_ns <= self.now_ns - m.capture_ns <= CONFIG.freshness_ns

    def check_episodes(self, entries: list[Entry]) -> None:
        """An episode goes from state to state as it may, and only one with its people becomes a success."""
        if self.decision.reset:
            self.is_placed = any(isinstance(e.message, ObjectsPlaced) for e in entries)
        for event in self.decision.events:
            if isinstance(one := event.body, EpisodeChanged):
                before, self.episode = self.episode, one
                assert one.state in NEXT[before.state]
                has_waited = self.now_ns - before.until_ns >= 5 * SECOND
                assert (before.state, one.state) != ("countdown", "running") or self.is_placed or has_waited
                grows = one.number - before.number
                begins = "countdown" in NEXT[before.state] and before.state != "countdown"
                assert grows == (begins and before.state not in REPEATED) or (before.state, grows) == ("discarded", 1)
                assert one.successes - before.successes == (one.state == "closing" and one.verdict == "success")
                by = self.state.participants.get(one.participant)
                assert one.verdict != "success" or before.state != "left" or (by is not None and by.role == "director")
                self.ended += one.state in ("success", "failure", "discarded", "unknown")

    def check_urgent(self, entries: list[Entry]) -> None:
        moving = {s.participant for c in self.decision.commands for s in c.sources}
        for e in entries:
            client = next((c for c in self.people if c.connection == e.connection and c.id), None)
            if client is None:
                continue
            if isinstance(e.message, Lost | cm.Bye):
                p = self.state.participants.get(client.id)
                assert p is None or p.connection != client.connection
                assert client.id not in moving or (p is not None and p.connection > 0)
            if isinstance(e.message, cm.EStop) and self.still_here(client):
                assert self.decision.estop
            if isinstance(e.message, cm.Release) and not e.message.targets and self.still_here(client):
                assert client.id not in moving

    def still_here(self, client: Client) -> bool:
        p = self.state.participants.get(client.id)
        return p is not None and p.connection == client.connection

    def check_bounds(self) -> None:
        state = self.state
        assert len(state.participants) <= CONFIG.max_participants + 1
        assert len(state.queue) <= CONFIG.max_queue
        assert len(state.consents) <= CONFIG.max_consents
        for lease in (*state.robots.values(), *state.objects.values()):
            assert len(lease.grants) <= CONFIG.max_sub_holders
            assert len(lease.grants) <= 1 or lease.mode in ("shared", "priority")
            assert all(1 <= g.version <= lease.version for g in lease.grants)
            assert not lease.override or lease.override in [g.participant for g in lease.grants[1:]]

    def check_replies(self) -> None:
        """Every request gets exactly one reply: at once, or when it no longer waits. Who is gone may get none."""
        for out in self.decision.outgoing:
            if isinstance(out.message, Reply):
                assert (out.connection, out.message.request_id) in self.open, "a second reply, or to nobody's request"
                self.open.remove((out.connection, out.message.request_id))
        people, state = self.state.participants, self.state
        waiting = {
            (people[w.participant].connection, w.request_id)
            for w in (*state.queue, *state.consents)
            if w.request_id != NO_REPLY
        }
        here = {p.connection for p in people.values()}
        assert {asked for asked in self.open if asked[0] in here} == waiting

    def connected(self) -> set[int]:
        return {p.connection for p in self.state.participants.values() if p.connection > 0}

    def check_dropped(self, before: set[int], entries: list[Entry]) -> None:
        """The front learns of every connection that the authority is done with, unless it said so itself."""
        if any(isinstance(e.message, FrontRestarted | SessionResumed) for e in entries):
            return
        known = {e.connection for e in entries if isinstance(e.message, Lost)}
        known |= {d.connection for d in self.decision.dropped}
        assert before - self.connected() <= known

    def check_queue(self) -> None:
        """No deadlock: nobody waits while holding, and every wait has a robot that is held or promised before it."""
        holding = {g.participant for name in NAMES for g in self.state.robots[name].grants}
        for i, w in enumerate(self.state.queue):
            assert w.participant not in holding
            if self.state.participants[w.participant].connection < 0:
                continue  # it keeps its place, and gets a robot when it is back
            assert w.any_robot or any(self.state.robots[n].grants or self.promised(i, n) for n in w.robots)

    def promised(self, place: int, name: str) -> bool:
        ahead: list[Pending] = self.state.queue[:place]
        return any(name in other.robots for other in ahead)


ACTIONS: Final[list[tuple[float, Callable[[Play], None]]]] = [
    (6.0, Play.keep_going),
    (5.0, Play.drive),
    (3.0, Play.request),
    (2.0, Play.wait),
    (1.5, Play.recover),
    (1.5, Play.forge),
    (1.0, Play.odd_sample),
    (1.0, Play.direct),
    (0.7, Play.trouble),
    (0.7, Play.align),
    (1.2, Play.record),
    (0.3, Play.watch),
    (0.05, Play.go_on),
    (0.5, Play.join),
    (0.4, Play.resume),
    (0.4, Play.swap),
]
