"""A small table to play sessions on: an authority with two robots and an object, and people who send entries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec

from iris_session.authority import Authority, AuthorityConfig
from iris_session.protocol.client_messages import Acquire, Sample
from iris_session.protocol.common import IDENTITY, EventBody, Lease, Message, Pose, Target
from iris_session.protocol.entries import AlignmentProposal, Entry, Join
from iris_session.protocol.server_messages import Feedback, LeasesChanged, Reply
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.steps import Command, ControlStatus, Decision, FixedView

MS = 1_000_000
SECOND = 1_000_000_000
PERIOD = 2 * MS
SMALL = tuple(1e-8 if i % 7 == 0 else 0.0 for i in range(36))


def robot(name: str, mode: str = "exclusive", joints: int = 7) -> RobotSpec:
    names = tuple(f"{name}/joint{i + 1}" for i in range(joints))
    return RobotSpec(name, names, names, f"{name}/tcp", f"{name}/base", mode=mode)


def make_view(**changes: Any) -> FixedView:
    tips = {n: Pose((x, 0.0, 0.5), (1.0, 0.0, 0.0, 0.0)) for n, x in (("left", -0.5), ("right", 0.5), ("third", 2.0))}
    objects = {"hammer": Pose((0.0, 0.0, 0.2), (1.0, 0.0, 0.0, 0.0)), "board": IDENTITY}
    q = dict.fromkeys(tips, (0.0,) * 7)
    view = FixedView(tips=tips, q=q, objects=objects)
    return msgspec.structs.replace(view, **changes)


def single_changes(body: EventBody) -> tuple[EventBody, ...]:
    """Return an event of several leases as one event of each, any other as it is."""
    return body.to_single_changes() if isinstance(body, LeasesChanged) else (body,)


class Table:
    """An authority whose time moves by one period per step."""

    def __init__(
        self,
        config: AuthorityConfig | None = None,
        robots: Sequence[RobotSpec] = (),
        objects: Sequence[str] = (),
        frozen_ns: int = 3600 * SECOND,
    ) -> None:
        # Hands here keep still to the last bit.
        self.config = msgspec.structs.replace(config or AuthorityConfig(), frozen_ns=frozen_ns)
        self.robots = tuple(robots) or (robot("left"), robot("right"))
        self.objects = tuple(ObjectSpec(n, n) for n in (objects or ("hammer", "board")))
        self.authority = Authority(self.config, self.robots, self.objects)
        self.now_ns = SECOND
        self.view = make_view()
        self.control: tuple[ControlStatus, ...] = ()
        self.people = 0
        self.persons: dict[int, Person] = {}
        self.decision = Decision(())
        self.events: list[EventBody] = []

    def step(self, *entries: Entry, dt_ns: int = PERIOD, n_ticks: int = 1) -> Decision:
        self.now_ns += dt_ns
        view = msgspec.structs.replace(self.view, tick=self.view.tick + n_ticks)
        self.decision = self.authority.step(self.now_ns, entries, n_ticks, self.view, self.control)
        self.view = view
        self.events += [body for e in self.decision.events for body in single_changes(e.body)]
        for out in self.decision.outgoing:
            if isinstance(out.message, Feedback) and out.connection in self.persons:
                self.persons[out.connection].told[out.message.robot] = out.message
        return self.decision

    def wait(self, duration_ns: int) -> Decision:
        """Empty steps of 20 ms each, for at least `duration_ns`."""
        for _ in range(-(-duration_ns // (20 * MS))):
            self.step(dt_ns=20 * MS)
        return self.decision

    def host(self, message: Any) -> Entry:
        return Entry(0, 0, self.now_ns, message)

    def join(self, role: str = "operator", **fields: Any) -> Person:
        self.people += 1
        fields = {"key_id": f"key{self.people}", "name": f"person{self.people}", **fields}
        person = self.persons[self.people] = Person(self, self.people, fields["name"])
        self.step(Entry(self.people, self.people, self.now_ns, Join(role=role, **fields)))
        if self.decision.admitted:
            person.id = self.decision.admitted[0].participant_id
        return person

    def operator(self, *robots: str, **fields: Any) -> Person:
        """Joined, aligned, and holding `robots`."""
        person = self.join(**fields)
        self.step(person.says(proposal()))
        if robots:
            person.acquire(*robots)
        return person

    def command(self, name: str = "left") -> Command:
        return next(c for c in self.decision.commands if c.robot == name)

    def hold(self, name: str = "left") -> str:
        command = self.command(name)
        assert (command.kind == "hold") == (command.hold_reason != "") == (not command.sources)
        return command.hold_reason

    def last(self, kind: type) -> Any:
        """The newest event of one kind in the whole session."""
        return next(e for e in reversed(self.events) if isinstance(e, kind))

    def since(self, kind: type) -> list[Any]:
        """Events of one kind in the last step."""
        bodies = [body for e in self.decision.events for body in single_changes(e.body)]
        return [body for body in bodies if isinstance(body, kind)]


class Person:
    """One participant as seen from its own side of the wire."""

    def __init__(self, table: Table, connection: int, name: str) -> None:
        self.table = table
        self.connection = connection
        self.name = name
        self.id = ""
        self.seq = 0
        self.versions: dict[str, int] = {}
        self.told: dict[str, Feedback] = {}
        self.alignment_version = 1
        self.scene_epoch = 1
        self.tracking_epoch = 0

    def says(self, message: Any) -> Entry:
        return Entry(self.connection, self.connection, self.table.now_ns, message)

    def does(self, message: Message) -> Decision:
        return self.table.step(self.says(message))

    def replies(self) -> list[Reply]:
        mine = [o.message for o in self.table.decision.outgoing if o.connection == self.connection]
        return [m for m in mine if isinstance(m, Reply)]

    def feedback(self) -> list[Feedback]:
        mine = [o.message for o in self.table.decision.outgoing if o.connection == self.connection]
        return [m for m in mine if isinstance(m, Feedback)]

    def asks(self, message: Message) -> Reply:
        self.does(message)
        (reply,) = self.replies()
        self.learn(reply.leases)
        return reply

    def denied(self, message: Message) -> str:
        reply = self.asks(message)
        assert not reply.ok
        assert reply.denial is not None
        assert reply.denial.message
        return reply.denial.reason

    def learn(self, leases: Sequence[Lease]) -> None:
        for lease in leases:
            self.versions[lease.target] = lease.lease_version

    def acquire(self, *robots: str, **fields: Any) -> Reply:
        return self.asks(Acquire(1, robots, **fields))

    def target(self, name: str) -> Target:
        kind = "object" if name in ("hammer", "board") else "robot"
        return Target(name, self.versions.get(name, 0), kind)

    def sample(self, *names: str, age_ns: int = 0, p: tuple[float, float, float] = (0.0, 0.0, 1.0), **f: Any) -> Sample:
        """The next sample of the right controller, captured `age_ns` before the coming step."""
        self.seq += 1
        fields: dict[str, Any] = {
            "device": "controller/right",
            "kind": "pose",
            "seq": self.seq,
            "capture_ns": self.table.now_ns - age_ns,
            "scene_epoch": self.scene_epoch,
            "tracking_epoch": self.tracking_epoch,
            "alignment_version": self.alignment_version,
            "targets": tuple(self.target(n) for n in names),
            "pose": Pose(p, (1.0, 0.0, 0.0, 0.0)),
        }
        return Sample(**{**fields, **f})

    def sends(self, *names: str, **fields: Any) -> Decision:
        return self.does(self.sample(*names, **fields))

    def engage(self, *names: str, **fields: Any) -> Decision:
        """Opens the clutch, then closes it."""
        self.sends(*names, **{**fields, "clutch": False})
        return self.sends(*names, **{**fields, "clutch": True})


def proposal(**changes: Any) -> AlignmentProposal:
    """A good measurement of the tracking frame at (1, 0, 0)."""
    good = AlignmentProposal(Pose((1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), 0, SMALL, (0.0, -0.5, 0.0), 0.002)
    return msgspec.structs.replace(good, **changes)
