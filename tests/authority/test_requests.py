"""Leases by request: every mode, queue, consent, directors, scaling; no deadlock, every request gets one reply."""

from __future__ import annotations

import math

import pytest

from iris_session.authority import AuthorityConfig
from iris_session.protocol.client_messages import (
    Acquire,
    Assign,
    ClearEStop,
    Consent,
    Control,
    EStop,
    GetSnapshot,
    Grasp,
    Heartbeat,
    Release,
    SetMode,
    SetScale,
    Withdraw,
)
from iris_session.protocol.common import Target
from iris_session.protocol.entries import Lost
from iris_session.protocol.server_messages import (
    ConsentRequested,
    Feedback,
    Intervention,
    LeaseChanged,
    LeasesChanged,
    SamplesRejected,
    ScaleChanged,
    Snapshot,
)

from .table import MS, SECOND, Person, Table, proposal, robot


def with_mode(mode: str, **config: int) -> Table:
    return Table(AuthorityConfig(**config), robots=(robot("left", mode), robot("right", mode)))  # type: ignore[arg-type]


# --- exclusive and the queue ---


def test_queue_is_first_come_first_served_and_answers_when_granted() -> None:
    t = Table()
    anna, bert, carl = t.operator("left"), t.join(), t.join()
    for waiting in (bert, carl):
        waiting.does(Acquire(7, ("left",), wait=True))
        assert waiting.replies() == []
    assert t.last(LeaseChanged).lease.queue == (bert.id, carl.id)
    anna.does(Release())
    (reply,) = bert.replies()
    assert (reply.request_id, reply.ok, reply.leases[0].holder) == (7, True, bert.id)
    assert carl.replies() == []
    bert.does(Release(targets=(Target("left", reply.leases[0].lease_version),)))
    assert carl.replies()[0].ok


def test_queue_is_bounded_and_one_place_each() -> None:
    t = Table(AuthorityConfig(max_queue=1))
    t.operator("left")
    bert, carl = t.join(), t.join()
    bert.does(Acquire(1, ("left",), wait=True))
    assert bert.denied(Acquire(2, ("left",), wait=True)) == "queue_full"
    assert carl.denied(Acquire(1, ("left",), wait=True)) == "queue_full"
    bert.does(Release(9))
    assert [(r.request_id, r.ok) for r in bert.replies()] == [(1, False), (9, True)]
    carl.does(Acquire(1, ("left",), wait=True))
    assert carl.replies() == []


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (Acquire(1, ("nothing",)), "unknown_target"),
        (Acquire(1, (), ("nothing",)), "unknown_target"),
        (Acquire(1, ("left",), weight=float("nan")), "invalid"),
        (Acquire(1, ("left",), weight=0.0), "invalid"),
        (Release(1, (Target("nothing", 1),)), "unknown_target"),
        (Release(1, (Target("left", 1, "planet"),)), "unknown_value"),
        (Release(1, (Target("left", 1),)), "not_holder"),
        (Consent(1, 5, True), "unknown_request"),
        (Assign(1, ("left",), "p1"), "role"),
        (SetMode(1, "left", "shared"), "role"),
        (Grasp(1, "nothing", "hand/left"), "unknown_target"),
        (Grasp(1, "hammer", "foot"), "unknown_value"),
        (Grasp(1, "hammer", "hand/left"), "unaligned"),
    ],
)
def test_typed_denials(message: Acquire, reason: str) -> None:
    t = Table()
    assert t.join().denied(message) == reason


def test_observers_hold_nothing() -> None:
    t = Table()
    watcher = t.join("observer")
    assert watcher.denied(Acquire(1, ("left",))) == "role"
    assert watcher.denied(Grasp(1, "hammer", "hand/left")) == "role"


def test_release_with_an_old_token_is_denied() -> None:
    t = Table()
    anna = t.operator("left")
    assert anna.denied(Release(1, (Target("left", 0),))) == "lease_version"
    assert anna.asks(Release(1, (Target("left", anna.versions["left"]),) * 2)).ok


# --- withdrawn requests ---


def test_a_request_that_is_withdrawn_is_never_granted() -> None:
    t = Table()
    anna, bert, carl = t.operator("left"), t.join(), t.join()
    bert.does(Acquire(7, ("left",), wait=True))
    carl.does(Acquire(8, ("left",), wait=True))
    carl.does(Withdraw(9, 8))
    denied, done = carl.replies()
    assert (denied.request_id, done.request_id, done.ok, done.leases) == (8, 9, True, ())
    assert denied.denial is not None
    assert (denied.denial.reason, denied.denial.target) == ("withdrawn", "left")
    assert (denied.denial.holder, denied.denial.holder_name) == (anna.id, anna.name)
    assert "place 2 of 2" in denied.denial.message
    assert t.last(LeaseChanged).lease.queue == (bert.id,)
    t.step(anna.says(Release()), bert.says(Release()))
    assert t.hold() == "no_lease"


def test_a_request_that_was_granted_meanwhile_is_given_back() -> None:
    """The reply with the lease and the withdrawal have crossed on their way."""
    t = Table()
    anna, bert = t.operator(), t.operator()
    anna.acquire("right")
    assert anna.asks(Acquire(5, ("left", "right"), ("hammer",))).ok
    bert.does(Acquire(6, ("left",), wait=True))
    reply = anna.asks(Withdraw(6, 5))
    assert (reply.ok, [(lease.target, lease.holder) for lease in reply.leases]) == (
        True, [("left", ""), ("hammer", "")],
    )  # fmt: skip
    assert bert.replies()[0].ok
    assert t.hold("right") == "no_sample", "an earlier request had granted that one"
    assert anna.asks(Withdraw(7, 5)).leases == ()


# --- request ---


def test_request_mode_asks_the_holder() -> None:
    t = with_mode("request")
    anna, bert, carl = t.operator("left"), t.join(), t.join()
    bert.does(Acquire(1, ("left",)))
    asked = t.last(ConsentRequested)
    assert (asked.target, asked.requester, asked.holder) == ("left", bert.id, anna.id)
    assert carl.denied(Acquire(1, ("left",))) == "consent_pending"
    assert carl.denied(Consent(2, asked.consent_id, True)) == "role"
    anna.engage("left")
    anna.does(Consent(2, asked.consent_id, True))
    assert anna.replies()[0].ok
    assert bert.replies()[0].leases[0].holder == bert.id
    assert t.hold() == "no_sample"
    assert (t.last(LeaseChanged).cause, t.last(LeaseChanged).previous_holder) == ("consent", anna.id)


def test_consent_refused_by_a_director_times_out_or_resolves_itself() -> None:
    t = with_mode("request", max_consents=1)
    anna, bert, boss = t.operator("left"), t.join(), t.join("director")
    carl = t.operator("right")
    bert.does(Acquire(1, ("left",)))
    assert t.join().denied(Acquire(1, ("right",))) == "queue_full"
    boss.does(Consent(1, t.last(ConsentRequested).consent_id, False))
    denial = bert.replies()[0].denial
    assert denial is not None
    assert (denial.reason, denial.holder) == ("consent_refused", anna.id)
    bert.does(Acquire(2, ("left", "right")))
    ids = [e.consent_id for e in t.since(ConsentRequested)]
    carl.does(Consent(1, ids[1], True))
    assert bert.replies() == []
    anna.does(Release())
    assert bert.replies()[0].ok
    anna.does(Acquire(3, ("left",)))
    for _ in range(160):
        t.step(*(p.says(p.sample()) for p in (anna, bert)), dt_ns=100 * MS)
        if anna.replies():
            break
    assert anna.replies()[0].denial.reason == "consent_refused"  # type: ignore[union-attr]


# --- takeover ---


def test_takeover_is_granted_at_once_and_the_old_holder_is_told() -> None:
    t = with_mode("takeover")
    anna, bert = t.operator("left"), t.operator()
    anna.engage("left")
    assert bert.acquire("left").ok
    assert t.hold() == "no_sample"
    assert anna.feedback() == [Feedback("left", "hold", "no_lease")]
    assert (t.last(LeaseChanged).cause, t.last(LeaseChanged).previous_holder) == ("takeover", anna.id)
    anna.sends("left", clutch=True)
    assert t.hold() == "no_sample"
    bert.engage("left")
    assert t.command().sources[0].participant == bert.id


def test_an_agent_takes_no_robot_out_of_an_engaged_hand() -> None:
    t = with_mode("takeover")
    anna, agent = t.operator("left"), t.join("agent", alignment="not_needed")
    anna.engage("left")
    denial = agent.acquire("left").denial
    assert denial is not None
    assert (denial.reason, denial.holder, denial.holder_name, denial.target) == ("held", anna.id, anna.name, "left")
    assert "2 s" in denial.advice
    assert agent.denied(Acquire(1, ("right", "left"))) == "held"
    assert t.command().sources[0].participant == anna.id
    assert t.operator().acquire("left").ok, "people take from people"


def test_an_agent_takes_a_robot_whose_holder_stands_by_or_never_drove() -> None:
    t = with_mode("takeover")
    anna, agent = t.operator("left", "right"), t.join("agent", alignment="not_needed")
    assert agent.acquire("right").ok
    anna.engage("left")
    stand_by(t, anna, 50, agent)
    assert agent.denied(Acquire(1, ("left",))) == "held", "it opens the clutch to reach further"
    agent.does(Acquire(2, ("left",), wait=True))
    assert agent.replies()[0].denial is not None  # it holds another
    agent.does(Release())
    agent.does(Acquire(3, ("left",), wait=True))
    stand_by(t, anna, 20, agent)
    assert t.last(LeaseChanged).lease.holder == anna.id
    stand_by(t, anna, 60, agent)
    assert t.last(LeaseChanged).lease.holder == agent.id


# --- priority ---


def test_human_preempts_agent_and_the_agent_gets_the_robot_back() -> None:
    t = with_mode("priority")
    agent = t.join("agent", alignment="not_needed")
    agent.acquire("left")
    agent.engage("left", device="target")
    assert t.command().sources[0].absolute
    human, other = t.operator(), t.operator()
    reply = human.acquire("left")
    assert reply.leases[0].sub_holders == (agent.id, human.id)
    assert reply.leases[0].weights == (1.0, 0.0)
    assert other.denied(Acquire(1, ("left",))) == "held"
    assert t.command().sources[0].participant == agent.id  # standing by changes nothing
    human.sends("left")
    human.sends("left", clutch=True)
    assert t.since(Intervention) == [Intervention("left", human.id, agent.id, True)]
    assert t.command().sources[0].participant == human.id
    agent.engage("left", device="target")
    assert t.command().sources[0].participant == human.id
    human.sends("left")
    assert t.since(Intervention) == [Intervention("left", human.id, agent.id, False)]
    assert t.hold() == "rearm"
    agent.sends("left", device="target", clutch=True)
    assert t.hold() == "rearm"
    agent.engage("left", device="target")
    assert t.command().sources[0].participant == agent.id
    human.sends("left", clutch=True)
    assert t.last(Intervention).active


@pytest.mark.parametrize("leaving", ["human", "agent", "mode"])
def test_an_intervention_ends_when_either_side_leaves(leaving: str) -> None:
    t, agent, human = intervened()
    boss = t.join("director")
    if leaving == "human":
        human.does(Release())
        assert t.hold() == "rearm"
    elif leaving == "agent":
        agent.does(Release())
        assert t.command().sources[0].participant == human.id
    else:
        boss.does(SetMode(1, "left", "exclusive"))
        assert t.last(LeaseChanged).lease.holder == human.id
        assert t.hold() == "rearm"
    assert not t.last(Intervention).active
    assert len(t.last(LeaseChanged).lease.sub_holders) == 0


def intervened() -> tuple[Table, Person, Person]:
    """An agent and a human who has taken over from it, in mode `priority`."""
    t = with_mode("priority")
    agent, human = t.join("agent", alignment="not_needed"), t.operator()
    agent.acquire("left")
    agent.engage("left", device="target")
    human.acquire("left")
    human.engage("left")
    assert t.last(Intervention) == Intervention("left", human.id, agent.id, True)
    assert t.command().sources[0].participant == human.id
    return t, agent, human


def drive_on(t: Table, agent: Person, duration_ns: int, *others: Person, n_ticks: int = 1) -> None:
    """The agent tries to drive all the time; the others are silent but connected."""
    for i in range(duration_ns // (20 * MS)):
        sample = agent.says(agent.sample("left", device="target", clutch=i % 2 == 1))
        t.step(sample, *(p.says(Heartbeat()) for p in others), dt_ns=20 * MS, n_ticks=n_ticks)


def stand_by(t: Table, human: Person, samples: int, *others: Person) -> None:
    """The human sends samples with an open clutch; the others are silent but connected."""
    for _ in range(samples):
        t.step(human.says(human.sample("left")), *(p.says(Heartbeat()) for p in others), dt_ns=20 * MS)


def test_an_intervention_lasts_through_the_grace_period_of_a_lost_human() -> None:
    t, agent, human = intervened()
    t.step(human.says(Lost("net")))
    lease = t.last(LeaseChanged).lease
    assert (lease.holder, lease.expires_ns) == (human.id, t.now_ns + 30 * SECOND)
    assert t.hold() == "disconnected"
    drive_on(t, agent, 29 * SECOND)
    assert t.hold() == "disconnected", "the agent waits"
    assert t.last(Intervention).active
    assert agent.told["left"].hold_reason == "intervention"
    drive_on(t, agent, 2 * SECOND)
    assert t.last(Intervention) == Intervention("left", human.id, agent.id, False), "the grace period has ended"
    assert t.command().sources[0].participant == agent.id


def test_a_human_who_comes_back_is_still_in_charge() -> None:
    t, agent, human = intervened()
    t.step(human.says(Lost("net")))
    drive_on(t, agent, 5 * SECOND)
    back = resume(t, human)
    assert t.last(LeaseChanged).lease.holder == human.id
    drive_on(t, agent, 5 * SECOND, back)
    assert t.last(Intervention).active, "nothing of its hand is known yet"
    back.sends("left")
    back.sends("left", clutch=True)
    assert t.command().sources[0].participant == human.id, "it opened the clutch to close it again"
    back.sends("left")
    assert not t.last(Intervention).active, "it let go"


def resume(t: Table, human: Person) -> Person:
    """A new connection of a participant that was lost, with the fencing token of its robot and a new alignment."""
    back = t.join(key_id=f"key{human.connection}", name=human.name, resume_of=human.id)
    assert back.id == human.id
    t.step(back.says(proposal()))
    back.versions = {"left": t.last(LeaseChanged).lease.lease_version}
    back.alignment_version = 2
    return back


@pytest.mark.parametrize("why", ["untracked", "not_worn", "stale", "estop", "rejected"])
def test_a_human_who_cannot_drive_is_not_idle(why: str) -> None:
    """Only its own open clutch counts: for two seconds, when something else has ended its engagement."""
    t, agent, human = intervened()
    boss = t.join("director")
    if why == "untracked":
        human.sends("left", tracked=False)
        drive_on(t, agent, SECOND, human, boss)
        human.sends("left", tracked=False)
    elif why == "not_worn":
        human.sends("left", worn=False)
    elif why == "estop":
        boss.does(EStop())
        assert boss.asks(ClearEStop(1, 1)).ok
    elif why == "rejected":
        human.sends("left", clutch=True, scene_epoch=7)
    drive_on(t, agent, 10 * SECOND, human, boss)
    assert t.last(Intervention).active
    if why != "estop":
        assert t.hold() == why
    stand_by(t, human, 95, agent)
    assert t.last(Intervention).active, "an open clutch arms the robot first"
    human.sends("left", clutch=True)
    assert t.command().sources[0].participant == human.id
    human.does(Heartbeat(worn=False))
    stand_by(t, human, 105, agent)
    assert not t.last(Intervention).active, "it stood by with an open clutch"


def test_an_open_clutch_while_tracking_is_lost_is_no_word_of_the_human() -> None:
    t, agent, human = intervened()
    for _ in range(200):
        lost = human.says(human.sample("left", tracked=False, clutch=False))
        t.step(lost, agent.says(Heartbeat()), dt_ns=20 * MS)
    assert (t.hold(), t.last(Intervention).active) == ("untracked", True)


def test_open_clutches_far_apart_are_no_idle_time() -> None:
    """One sample in a second says nothing of the time between."""
    t, agent, human = intervened()
    human.sends("left", tracked=False)
    for _ in range(6):
        human.sends("left")
        drive_on(t, agent, SECOND, human)
    assert t.last(Intervention).active


@pytest.mark.parametrize("stop", ["pause", "estop"])
def test_an_open_clutch_during_a_pause_or_an_estop_gives_nothing_back(stop: str) -> None:
    t, agent, human = intervened()
    boss = t.join("director")
    boss.does(Control(1, "pause") if stop == "pause" else EStop())
    stand_by(t, human, 250, agent, boss)
    assert t.last(Intervention).active, "five seconds in which it could not drive"
    assert boss.asks(Control(2, "resume") if stop == "pause" else ClearEStop(2, 1)).ok
    stand_by(t, human, 95, agent, boss)
    assert t.last(Intervention).active, "the time counts from the end of the stop"
    stand_by(t, human, 15, agent, boss)
    assert not t.last(Intervention).active


@pytest.mark.parametrize("policy", ["join-order", "nearest"])
def test_a_human_without_a_wish_gets_the_robot_of_an_agent(policy: str) -> None:
    t = Table(AuthorityConfig(policy=policy), robots=(robot("left", "priority"),))
    agent, human, other = t.join("agent", alignment="not_needed"), t.operator(), t.operator()
    agent.acquire()
    agent.engage("left", device="target")
    t.step(*(p.says(p.sample(device="head")) for p in (human, other)))
    reply = human.asks(Acquire(1, wait=True))
    assert reply.leases[0].sub_holders == (agent.id, human.id)
    assert t.command().sources[0].participant == agent.id, "it stands by"
    human.engage("left")
    assert t.command().sources[0].participant == human.id
    other.does(Acquire(2, wait=True))
    assert other.replies() == []
    agent.does(Release())
    human.does(Release())
    assert other.replies()[0].leases[0].holder == other.id


def test_a_leader_arm_is_a_human_hand() -> None:
    t = with_mode("priority")
    joints = {"device": "joints", "kind": "joints", "pose": None, "q": (0.0,) * 7}
    agent, leader = t.join("agent", alignment="not_needed"), t.join("leader", alignment="not_needed")
    agent.acquire("left")
    agent.engage("left", device="target")
    assert leader.acquire("left").ok
    leader.engage("left", **joints)
    assert t.command().sources[0].participant == leader.id
    assert leader.acquire("right").ok
    assert t.operator().denied(Acquire(1, ("right",))) == "held"


# --- shared ---


def test_shared_robot_blends_by_normalised_weights() -> None:
    t = with_mode("shared", max_sub_holders=2)
    anna, bert = t.operator(), t.operator()
    anna.acquire("left", weight=3.0)
    lease = bert.acquire("left").leases[0]
    assert (lease.holder, lease.sub_holders, lease.weights) == (anna.id, (anna.id, bert.id), (3.0, 1.0))
    assert t.join().denied(Acquire(1, ("left",))) == "held"
    assert t.hold() == "no_sample"
    anna.engage("left", gripper=1.0)
    assert [s.weight for s in t.command().sources] == [1.0]
    bert.engage("left", gripper=0.0)
    assert [(s.participant, s.weight) for s in t.command().sources] == [(anna.id, 0.75), (bert.id, 0.25)]
    assert t.command().gripper == 0.75
    bert.acquire("left", weight=3.0)
    assert [s.weight for s in t.command().sources] == [0.5, 0.5]
    anna.sends("left")
    assert [(s.participant, s.weight) for s in t.command().sources] == [(bert.id, 1.0)]
    twist = {"kind": "twist", "pose": None, "twist": (0.1, 0.0, 0.0, 0.0, 0.0, 0.0)}
    anna.engage("left", **twist)
    assert t.since(SamplesRejected)[0].reason == "kind"  # poses and twists cannot be blended
    assert [s.participant for s in t.command().sources] == [bert.id]
    bert.sends("left")
    anna.engage("left", **twist)
    assert (t.command().kind, t.command().gripper) == ("twist", None)
    bert.engage("left")
    assert t.last(SamplesRejected).reason == "kind"
    bert.engage("left", **twist)
    assert len(t.command().sources) == 2
    bert.sends("left", clutch=True)
    assert [s.participant for s in t.command().sources] == [anna.id], "changing the kind ends one's own engagement"
    anna.sends("left", clutch=True)
    assert t.command().kind == "pose", "who drives alone may change it"


# --- directors ---


def test_director_assigns_frees_and_changes_modes() -> None:
    t = Table()
    anna, bert, boss, watcher = t.operator("left"), t.operator(), t.join("director"), t.join("observer")
    anna.engage("left")
    assert boss.asks(Assign(1, ("left", "right"), bert.name)).ok
    assert (t.hold("left"), t.hold("right")) == ("no_sample", "no_sample")
    assert anna.feedback()[0].hold_reason == "no_lease"
    assert boss.asks(Assign(1, ("left", "right"))).leases[0].holder == ""
    assert boss.denied(Assign(1, ("left",), "nobody")) == "unknown_participant"
    assert boss.denied(Assign(1, ("nothing",), bert.id)) == "unknown_target"
    assert boss.denied(Assign(1, ("left",), watcher.id)) == "role"
    assert boss.denied(SetMode(1, "nothing", "shared")) == "unknown_target"
    assert boss.denied(SetMode(1, "left", "anarchy")) == "unknown_value"
    assert boss.asks(SetMode(1, "left", "shared")).leases[0].mode == "shared"
    assert anna.acquire("left").ok
    assert bert.acquire("left").ok
    assert boss.asks(SetMode(1, "left", "exclusive")).leases[0].holder == anna.id
    assert bert.denied(Acquire(1, ("left",))) == "held"


def test_consent_of_one_holder_takes_nothing_from_another() -> None:
    t = with_mode("request")
    anna, bert, carl = t.operator("left"), t.join(), t.join()
    bert.does(Acquire(1, ("left", "right")))
    asked = t.last(ConsentRequested)
    assert asked.target == "left"
    assert carl.acquire("right").ok
    anna.does(Consent(2, asked.consent_id, True))
    denial = bert.replies()[0].denial
    assert denial is not None
    assert (denial.reason, denial.target, denial.holder) == ("held", "right", carl.id)
    assert t.last(LeaseChanged).lease.holder == carl.id


# --- motion scaling ---


def lease_scale(t: Table, name: str = "left") -> float:
    """What a late joiner is told."""
    late = t.join("observer")
    t.step(late.says(GetSnapshot(1)))
    (seen,) = [o.message for o in t.decision.outgoing if isinstance(o.message, Snapshot)]
    return next(lease.scale for lease in seen.leases if lease.target == name)


def commanded(t: Table, anna: Person, name: str = "left") -> float:
    """What control is told while `anna` drives."""
    anna.sends(name, clutch=True)
    assert t.command(name).kind == "pose"
    return t.command(name).scale


def test_a_holder_sets_the_scale_of_its_robot_and_everybody_sees_it() -> None:
    t = Table()
    anna = t.operator("left")
    anna.engage("left")
    t.step()
    t.step()
    assert t.command().scale == 1.0
    reply = anna.asks(SetScale(5, ("left",), 0.25))
    assert (reply.ok, reply.leases[0].target, reply.leases[0].scale) == (True, "left", 0.25)
    assert t.since(ScaleChanged) == [ScaleChanged("left", 0.25, anna.id)]
    assert t.command().scale == 0.25, "in the very step, without a new sample"
    engagement = t.command().sources[0].engagement
    assert commanded(t, anna) == 0.25
    assert t.command().sources[0].engagement == engagement, "it ends no engagement"
    assert lease_scale(t) == 0.25
    assert t.command("right").scale == 1.0


@pytest.mark.parametrize("scale", [math.nan, math.inf, -math.inf, 0.0, -1.0, 0.049, 5.001, 1e308])
def test_a_scale_out_of_range_is_denied_with_the_range(scale: float) -> None:
    t = Table()
    anna = t.operator("left")
    denial = anna.asks(SetScale(1, ("left",), scale)).denial
    assert denial is not None
    assert denial.reason == "invalid"
    assert "0.05" in denial.advice
    assert "5" in denial.advice
    assert lease_scale(t) == 1.0


def test_only_holder_and_directors_may_set_it() -> None:
    t = Table()
    anna, bert, boss = t.operator("left"), t.operator("right"), t.join("director")
    denial = bert.asks(SetScale(1, ("right", "left"), 0.5)).denial
    assert denial is not None
    assert (denial.reason, denial.target, denial.holder, denial.holder_name) == (
        "not_holder", "left", anna.id, anna.name
    )  # fmt: skip
    assert lease_scale(t, "right") == 1.0, "all or none"
    assert t.join("observer").denied(SetScale(1, ("left",), 0.5)) == "not_holder"
    assert bert.denied(SetScale(1, ("elbow",), 0.5)) == "unknown_target"
    assert bert.denied(SetScale(1, ("hammer",), 0.5)) == "unknown_target"
    assert boss.asks(SetScale(1, ("left",), 0.5)).ok
    assert t.since(ScaleChanged) == [ScaleChanged("left", 0.5, boss.id)]
    anna.engage("left")
    assert t.command().scale == 0.5
    t.step(t.host(SetScale(0, ("left",), 0.75)))
    assert t.since(ScaleChanged) == [ScaleChanged("left", 0.75, "host")]
    anna.does(Release())
    assert boss.denied(SetScale(1, ("left",), 0.5)) == "not_holder", "there is nobody to set it for"


def test_it_ends_with_the_lease() -> None:
    t = Table(robots=(robot("left", "takeover"), robot("right")))
    anna, bert, boss = t.operator("left"), t.operator(), t.join("director")
    for take in (
        lambda: bert.acquire("left"),
        lambda: boss.does(Assign(1, ("left",), anna.id)),
        lambda: anna.does(Release()),
    ):
        holder = next(p for p in (anna, bert) if p.id == t.last(LeaseChanged).lease.holder)
        assert holder.asks(SetScale(1, ("left",), 0.2)).ok
        take()
        assert t.last(LeaseChanged).lease.scale == lease_scale(t) == 1.0
    anna.acquire("left")
    anna.engage("left")
    assert t.command().scale == 1.0, "nor does it come back to whoever had set it"


def test_leases_of_one_request_are_one_event() -> None:
    """Everyone gets every event: a request that names forty targets must not make forty of them."""
    objects = [f"part{i}" for i in range(30)]
    t = Table(robots=[robot(f"arm{i}") for i in range(10)], objects=objects)
    anna = t.join()
    t.step(anna.says(Acquire(1, tuple(lease.name for lease in t.robots), tuple(objects))))
    (acquired,) = t.decision.events
    assert isinstance(acquired.body, LeasesChanged)
    assert acquired.body.cause == "acquired"
    assert [lease.holder for lease in acquired.body.leases] == [anna.id] * 40
    assert acquired.body.previous_holders == ("",) * 40
    t.step(anna.says(Release(2)))
    (released,) = t.decision.events
    assert isinstance(released.body, LeasesChanged)
    assert [
        (lease.holder, who) for lease, who in zip(released.body.leases, released.body.previous_holders, strict=True)
    ] == [("", anna.id)] * 40


def test_a_lease_of_a_disconnected_holder_says_since_when_and_until_when() -> None:
    """Its holder cannot be asked: a program that crashed, or a tab that was closed."""
    t = Table()
    anna = t.operator("left")
    t.step(anna.says(Lost("silent")))
    t.wait(4 * SECOND)
    denial = t.operator().acquire("left").denial
    assert denial is not None
    assert (denial.reason, denial.holder, denial.holder_name) == ("held", anna.id, anna.name)
    assert "disconnected 4 s ago, free in 26 s" in denial.message
    assert "ask the holder" not in denial.advice
    assert "wait" in denial.advice
    assert "identity=" in denial.advice
