"""Episodes: countdown, verdicts, people who leave, who may do what, closing, buttons."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from iris_session.authority import Authority, AuthorityConfig
from iris_session.protocol.client_messages import Acquire, Bye, Control, Episode, EStop, Heartbeat, Release, SetRole
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import ExternalReset, Join, Lost, ObjectsPlaced, OwnerListens, SceneLoaded
from iris_session.protocol.server_messages import EpisodeChanged, Notice
from iris_session.protocol.specs import ObjectRange, TaskSpec

from .table import MS, SECOND, Person, Table, robot

CONFIG = AuthorityConfig(heartbeat_timeout_ns=600 * SECOND, gap_ns=600 * SECOND)
TASK = TaskSpec("pour", "Pour the cup.", 50, ("left", "right"), recorded=14, successes=11)
PLACED = msgspec.structs.replace(TASK, objects=(ObjectRange("hammer", (0.0, 0.1), (0.0, 0.1)),))
A, B = 1 << 4, 1 << 5


def meet(task: TaskSpec | None = None, **settings: Any) -> tuple[Table, Person, Person, Person]:
    """Ann drives the left robot, Bob the right one, and a director is at the desk."""
    t = Table(msgspec.structs.replace(CONFIG, task=task, **settings))
    return t, t.operator("left", name="ann"), t.operator("right", name="bob"), t.join("director", name="desk")


def begin(person: Person, label: str = "") -> None:
    assert person.asks(Episode(1, "start", label, 0)).ok
    assert now(person.table).state == "running"


def now(t: Table) -> EpisodeChanged:
    found: EpisodeChanged = t.last(EpisodeChanged)
    return found


def states(t: Table) -> list[tuple[int, str]]:
    return [(e.number, e.state) for e in t.events if isinstance(e, EpisodeChanged)]


def test_two_people_record_a_success_of_a_task() -> None:
    t, ann, bob, _ = meet(TASK)
    assert ann.asks(Episode(1, "start", "blue cup")).ok
    assert now(t) == EpisodeChanged(
        15,
        "countdown",
        "blue cup",
        ann.id,
        "pour",
        "Pour the cup.",
        50,
        11,
        ann.id,
        "ann",
        ann.id,
        0,
        t.now_ns + 3 * SECOND,
    )
    assert bob.denied(Episode(1, "start")) == "episode_state"
    t.wait(2900 * MS)
    assert now(t).state == "countdown"
    t.wait(100 * MS)
    assert (now(t).state, now(t).started_ns, now(t).robots) == ("running", t.now_ns, ("left", "right"))
    assert bob.asks(Episode(1, "success")).ok
    assert t.decision.reset
    assert [(e.state, e.verdict) for e in t.since(EpisodeChanged)] == [("closing", "success"), ("success", "")]
    end = now(t)
    assert (end.label, end.started_by_name, end.participant, end.successes) == ("blue cup", "ann", bob.id, 12)
    begin(ann)
    assert (now(t).number, now(t).successes) == (16, 12)


def test_an_episode_without_a_task_ends_at_once_and_resets_nothing() -> None:
    t, ann, *_ = meet()
    begin(ann)
    assert now(t).robots == ("left", "right")
    assert ann.asks(Episode(1, "failure", "dropped")).ok
    assert not t.decision.reset
    assert [(e.state, e.label) for e in t.since(EpisodeChanged)] == [("failure", "dropped")]
    assert ann.asks(Episode(1, "reset")).ok
    assert t.decision.reset


@pytest.mark.parametrize("how", ["estop", "pause", "left", "discard"])
def test_a_countdown_is_cancelled_and_its_number_used_again(how: str) -> None:
    t, ann, bob, desk = meet()
    assert ann.asks(Episode(1, "start")).ok
    assert ann.denied(Episode(1, "success")) == "episode_state"
    person, message = {
        "estop": (bob, EStop()),
        "pause": (desk, Control(1, "pause")),
        "left": (ann, Lost()),
        "discard": (ann, Episode(1, "discard")),
    }[how]
    person.does(message)
    assert states(t) == [(1, "countdown"), (1, "cancelled")]
    t.wait(4 * SECOND)
    assert states(t)[-1] == (1, "cancelled")
    if how in ("estop", "pause"):
        assert desk.denied(Episode(1, "start")) == how.replace("pause", "episode_state")
    else:
        begin(bob)
        assert now(t).number == 1


def test_the_desk_takes_over_an_episode_whose_starter_was_killed() -> None:
    t, _, bob, desk = meet()
    begin(bob, "pour")
    bob.does(Lost())
    assert (now(t).state, now(t).until_ns) == ("left", t.now_ns + 10 * SECOND)
    assert desk.denied(Episode(1, "success")) == "episode_state"
    assert desk.asks(Episode(1, "take_over")).ok
    assert (now(t).state, now(t).led_by, now(t).started_by_name) == ("running", desk.id, "bob")
    t.wait(11 * SECOND)
    assert desk.asks(Episode(1, "success")).ok
    assert (now(t).state, now(t).label, now(t).started_by) == ("success", "pour", bob.id)


def test_an_episode_that_is_not_taken_over_is_unknown() -> None:
    t, ann, *_ = meet()
    begin(ann)
    ann.does(Lost())
    t.wait(9900 * MS)
    assert now(t).state == "left"
    t.wait(100 * MS)
    assert (now(t).state, now(t).participant) == ("unknown", "host")


def test_a_leader_that_resumes_goes_on() -> None:
    t, ann, *_ = meet()
    begin(ann)
    ann.does(Lost())
    t.step(
        msgspec.structs.replace(
            t.host(Join("key1", "operator", "ann", resume_of=ann.id)), connection=9, connection_epoch=9
        )
    )
    assert now(t).state == "running"


def test_the_holder_of_a_robot_that_leaves_makes_it_unknown_at_once() -> None:
    t, ann, bob, _ = meet()
    begin(ann)
    bob.does(Bye())
    assert states(t)[-1] == (1, "unknown")


@pytest.mark.parametrize("returns", [True, False])
def test_a_holder_whose_connection_is_lost_may_return_and_until_then_it_is_no_success(returns: bool) -> None:
    t, ann, bob, _ = meet()
    begin(ann)
    bob.does(Lost())
    assert now(t).state == "left"
    assert ann.denied(Episode(1, "success")) == "episode_state"
    t.wait(5 * SECOND)
    if returns:
        join = t.host(Join("key2", "operator", "bob", resume_of=bob.id))
        t.step(msgspec.structs.replace(join, connection=9, connection_epoch=9))
        assert now(t).state == "running"
        assert ann.asks(Episode(1, "success")).ok
    else:
        t.wait(5 * SECOND)
        assert states(t)[-1] == (1, "unknown")


def test_an_episode_that_was_stopped_by_an_estop_is_no_success() -> None:
    _, ann, _, _ = meet()
    begin(ann)
    ann.does(EStop())
    assert ann.denied(Episode(1, "success")) == "estop"
    assert ann.asks(Episode(1, "failure")).ok


def test_a_leader_that_says_goodbye_makes_it_unknown_at_once_and_the_scene_is_reset() -> None:
    t, ann, *_ = meet(TASK)
    begin(ann)
    ann.does(Bye())
    assert [(e.state, e.verdict) for e in t.since(EpisodeChanged)] == [("closing", "unknown"), ("unknown", "")]
    assert t.decision.reset
    assert now(t).successes == 11


def test_a_command_of_the_terminal_starts_an_episode_and_another_one_ends_it() -> None:
    t, ann, _, desk = meet()
    assert desk.asks(Episode(1, "start")).ok
    desk.does(Bye())
    t.wait(3 * SECOND)
    assert (now(t).state, now(t).led_by, now(t).started_by_name) == ("running", "", "desk")
    for _ in range(2):
        assert t.join("agent").asks(Episode(1, "rerecord")).ok
    t.wait(3 * SECOND)
    assert states(t)[-1] == (1, "running")
    ann.does(Lost())
    t.wait(10 * SECOND)
    assert states(t)[-1] == (1, "unknown")


def test_who_holds_nothing_of_it_may_not_end_it_or_take_it_over() -> None:
    t, ann, bob, desk = meet()
    bob.does(Release(1))
    begin(ann)
    denial = bob.asks(Episode(1, "success")).denial
    assert denial is not None
    assert (denial.reason, denial.holder_name, denial.advice) == (
        "held",
        "ann",
        "ask ann or a director, or take it over",
    )
    assert bob.denied(Episode(1, "take_over")) == "held"
    assert t.join("observer").denied(Episode(1, "start")) == "role"
    assert bob.denied(Episode(1, "dance")) == "unknown_value"
    ann.does(Heartbeat(worn=False))
    assert bob.asks(Episode(1, "take_over")).ok
    assert now(t).led_by == bob.id
    assert desk.asks(Episode(1, "take_over")).ok
    assert desk.asks(Episode(1, "unknown")).ok
    assert desk.denied(Episode(1, "success")) == "episode_state"


def test_a_discard_is_asked_for_twice() -> None:
    t, ann, *_ = meet()
    begin(ann)
    assert ann.asks(Episode(1, "discard")).ok
    assert (now(t).state, now(t).until_ns) == ("confirm", t.now_ns + 3 * SECOND)
    t.wait(3 * SECOND)
    assert now(t).state == "running"
    assert ann.asks(Episode(1, "discard")).ok
    t.wait(2 * SECOND)
    assert ann.asks(Episode(1, "discard")).ok
    assert states(t)[-1] == (1, "discarded")


def test_recording_again_discards_resets_and_counts_down_to_the_same_number() -> None:
    t, ann, bob, _ = meet()
    begin(ann, "blue")
    assert bob.asks(Episode(1, "rerecord")).ok
    assert now(t).state == "confirm"
    assert bob.asks(Episode(1, "rerecord")).ok
    assert t.decision.reset
    assert states(t)[-3:] == [(1, "closing"), (1, "discarded"), (1, "countdown")]
    assert (now(t).label, now(t).led_by) == ("blue", ann.id)
    t.wait(3 * SECOND)
    assert states(t)[-1] == (1, "running")


def test_robots_hold_until_the_verdict_is_in() -> None:
    t, ann, *_ = meet()
    begin(ann)
    ann.engage("left")
    assert t.command().kind == "pose"
    assert ann.asks(Episode(1, "stop")).ok
    assert (now(t).state, now(t).verdict, t.hold()) == ("closing", "", "episode")
    ann.engage("left")
    assert t.hold() == "episode"
    assert ann.asks(Episode(1, "success")).ok
    ann.sends("left", clutch=True)
    assert t.hold() != "episode"
    ann.engage("left")
    assert t.command().kind == "pose"


def test_a_verdict_that_never_comes_is_unknown() -> None:
    t, ann, *_ = meet()
    begin(ann)
    assert ann.asks(Episode(1, "stop")).ok
    assert ann.denied(Episode(1, "stop")) == "episode_state"
    t.wait(60 * SECOND)
    assert states(t)[-1] == (1, "unknown")


def test_robots_hold_until_the_objects_are_placed() -> None:
    t, ann, *_ = meet(PLACED)
    place = ObjectsPlaced(("hammer",), (Pose((0.0, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0)),), 15)
    t.step(t.host(place))
    assert t.decision.reset
    begin(ann)
    t.step(t.host(place))
    assert not t.decision.reset
    ann.engage("left")
    assert ann.asks(Episode(1, "success")).ok
    assert (now(t).state, t.decision.reset, t.hold()) == ("closing", False, "episode")
    assert ann.denied(Episode(1, "discard")) == "episode_state"
    t.wait(100 * MS)
    t.step(t.host(place))
    assert (t.decision.reset, states(t)[-1], now(t).participant) == (True, (15, "success"), ann.id)
    begin(ann)
    assert ann.asks(Episode(1, "success")).ok
    t.wait(5 * SECOND)
    assert states(t)[-1] == (16, "success")


@pytest.mark.parametrize("message", [Control(1, "reset"), SceneLoaded("other", (robot("left"),))])
def test_a_reset_or_another_scene_in_the_middle_makes_it_unknown(message: Any) -> None:
    t, ann, *_ = meet()
    begin(ann)
    t.step(t.host(message))
    assert states(t)[-1] == (1, "unknown")


def test_an_episode_that_begins_in_the_step_of_a_reset_begins_with_the_reset_scene() -> None:
    t, ann, _, desk = meet(TASK, countdown_ns=0)
    t.step(desk.says(Control(1, "reset")), ann.says(Episode(1, "start")))
    assert states(t)[-1] == (15, "running")
    for _ in range(2):
        assert ann.asks(Episode(1, "rerecord")).ok
    assert t.decision.reset
    t.wait(SECOND)
    assert states(t)[-1] == (15, "running")


def test_a_reset_in_the_countdown_places_the_objects_of_the_episode_that_begins() -> None:
    t, ann, _, desk = meet(PLACED)
    assert ann.asks(Episode(1, "start")).ok
    assert t.authority.next_episode == 15
    assert desk.asks(Control(1, "reset")).ok
    t.step(t.host(ObjectsPlaced(("hammer",), (Pose((0.0, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0)),), 15)))
    assert t.decision.reset
    t.wait(3 * SECOND)
    assert states(t)[-1] == (15, "running")
    assert t.authority.next_episode == 16


def test_in_a_user_loop_a_repetition_waits_for_the_owner() -> None:
    t, ann, *_ = meet(user_owned_loop=True)
    assert ann.denied(Episode(1, "reset")) == "user_owned"
    begin(ann)
    assert ann.denied(Episode(1, "rerecord")) == "user_owned"
    t.step(t.host(OwnerListens()))
    for _ in range(2):
        assert ann.asks(Episode(1, "rerecord")).ok
    assert (now(t).state, now(t).verdict, t.decision.reset) == ("closing", "discarded", False)
    t.step(t.host(ExternalReset()))
    assert states(t)[-2:] == [(1, "discarded"), (1, "countdown")]
    t.wait(3 * SECOND)
    assert states(t)[-1] == (1, "running")


def press(person: Person, buttons: int, **fields: Any) -> None:
    person.sends(buttons=0, **fields)
    person.sends(buttons=buttons, **fields)


def notices(t: Table) -> list[tuple[str, str]]:
    """Return whom the last step has told why, of what it refused."""
    return [(e.participant, e.reason) for e in t.since(Notice)]


def test_who_holds_no_robot_of_it_starts_and_resets_nothing() -> None:
    t, ann, bob, desk = meet(msgspec.structs.replace(TASK, robots=("left",)))
    denial = bob.asks(Episode(1, "start")).denial
    assert denial is not None
    assert (denial.reason, denial.message, denial.advice) == (
        "not_holder",
        "you hold no robot of the task: left",
        "acquire one first, or ask its holder or a director",
    )
    assert bob.denied(Episode(1, "reset")) == "not_holder"
    assert not t.decision.reset
    for person in (desk, ann):
        begin(person)
        assert person.asks(Episode(1, "failure")).ok
    eve = meet()[0].join()
    assert eve.denied(Episode(1, "start")) == "not_holder"


def test_in_a_scene_without_robots_everybody_starts_episodes() -> None:
    t = Table(CONFIG)
    t.step(t.host(SceneLoaded("hands", ())))
    begin(t.join())


def test_with_its_verdict_an_episode_closes_once_whoever_leaves_or_wants_to_lead() -> None:
    t, ann, bob, desk = meet(PLACED)
    t.step(t.host(ObjectsPlaced((), (), 15)))
    begin(desk)
    assert ann.asks(Episode(1, "success")).ok
    assert desk.denied(Episode(1, "take_over")) == "episode_state"
    desk.does(Bye())
    bob.does(Bye())
    assert states(t)[-2:] == [(15, "running"), (15, "closing")]
    assert now(t).successes == 12


@pytest.mark.parametrize("steps", [["reset start"], ["start reset"], ["reset", "start"], ["count", "reset"]])
@pytest.mark.parametrize("is_placed", [True, False])
def test_an_episode_begins_when_the_objects_of_a_reset_are_placed(steps: list[str], is_placed: bool) -> None:
    t, ann, _, desk = meet(PLACED)
    place = ObjectsPlaced(("hammer",), (Pose((0.0, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0)),), 15)
    t.step(t.host(place))
    words = {
        "reset": desk.says(Control(1, "reset")),
        "start": ann.says(Episode(1, "start", countdown_ns=0)),
        "count": ann.says(Episode(1, "start", countdown_ns=2 * MS)),
    }
    for step in steps:
        t.step(*(words[word] for word in step.split()))
    assert (now(t).state, t.authority.next_episode) == ("countdown", 15)
    if is_placed:
        t.step(t.host(place))
        assert t.decision.reset
    else:
        t.wait(4900 * MS)
        assert now(t).state == "countdown"
        t.wait(100 * MS)
    t.step()
    assert (states(t)[-2:], t.decision.reset) == ([(15, "countdown"), (15, "running")], False)


def test_buttons_of_a_holder_start_and_end_it() -> None:
    t, ann, bob, _ = meet()
    ann.sends(buttons=A)
    ann.sends(buttons=A)
    assert states(t) == []  # held since before it was seen
    press(ann, A)
    ann.sends(buttons=A)
    assert states(t) == [(1, "countdown")]
    press(ann, B)
    assert states(t)[-1] == (1, "cancelled")
    t.wait(SECOND)
    press(ann, A)
    t.wait(4 * SECOND)
    press(bob, B)
    assert now(t).state == "confirm"
    press(bob, A)
    assert states(t)[-1] == (1, "failure")
    t.wait(SECOND)
    press(ann, A)
    t.wait(4 * SECOND)
    press(bob, A)
    assert states(t)[-1] == (2, "success")
    press(ann, B)
    bob.does(Release(1))
    t.wait(SECOND)
    press(bob, A)
    assert (states(t)[-1], t.since(Notice)) == ((2, "success"), [])


def test_of_two_people_who_press_at_once_the_second_is_told_why_nothing_comes_of_it() -> None:
    t, ann, bob, _ = meet()
    refused = [(bob.id, "episode_state")]
    press(ann, A)
    press(bob, A)
    assert (states(t), notices(t)) == ([(1, "countdown")], refused)
    assert t.last(Notice).text == "bob: episode 1 has not begun; discard cancels it"
    t.wait(3 * SECOND)
    press(bob, A)  # meant to begin it
    assert (states(t)[-1], notices(t)) == ((1, "running"), refused)
    press(bob, A)
    press(bob, A)
    assert (states(t)[-1], notices(t)) == ((1, "running"), [])
    t.wait(SECOND)
    press(ann, B)
    for button in (A, B):
        press(bob, button)
        assert now(t).state == "confirm", "bob has not seen the question"
    assert "state confirm for less than 1 s; press again if you mean that state" in t.last(Notice).text
    assert "(3 presses)" in t.last(Notice).text
    t.wait(SECOND)
    press(bob, A)
    press(ann, A)
    assert (states(t)[-1], notices(t)) == ((1, "failure"), [(ann.id, "episode_state")])
    t.wait(SECOND)
    press(ann, A)
    assert states(t)[-1] == (2, "countdown")


def test_a_press_that_is_denied_says_what_a_request_would() -> None:
    t, ann, *_ = meet()
    ann.does(EStop())
    press(ann, A)
    assert notices(t) == [(ann.id, "estop")]
    assert t.last(Notice).text == "ann: the session is stopped; clear the e-stop first"


def test_a_countdown_has_bounds() -> None:
    _, ann, *_ = meet()
    assert ann.denied(Episode(1, "start", countdown_ns=61 * SECOND)) == "invalid"


def test_a_task_must_fit_the_scene() -> None:
    for task in (
        msgspec.structs.replace(TASK, robots=("moon",)),
        msgspec.structs.replace(PLACED, objects=(ObjectRange("moon", (0, 0), (0, 0)),)),
    ):
        with pytest.raises(ValueError, match="moon"):
            Authority(msgspec.structs.replace(CONFIG, task=task), (robot("left"), robot("right")), ())
    with pytest.raises(ValueError, match="your own loop"):
        Table(msgspec.structs.replace(CONFIG, task=PLACED, user_owned_loop=True))


def test_recordings_before_these_rules_replay_as_they_were() -> None:
    t, ann, *_ = meet(episode_rules=False, strict_episodes=False)
    assert ann.asks(Episode(1, "start", "stack")).ok
    assert t.since(EpisodeChanged) == [EpisodeChanged(1, "running", "stack", ann.id)]
    ann.does(Lost())
    assert states(t) == [(1, "running")]
    t.step(t.host(Episode(1, "rerecord")))
    assert states(t)[1:] == [(1, "discarded"), (2, "running")]
    t.step(t.host(Episode(1, "success")))
    assert states(t)[-1] == (2, "success")
    eve = t.operator(name="eve")
    eve.does(Acquire(5, ("right",), wait=True))
    t.step(t.host(SetRole(1, eve.id, "observer")))
    assert eve.replies() == [], "a request was not ended by another role"


def test_recordings_before_strict_episodes_replay_as_they_were() -> None:
    t, ann, bob, desk = meet(PLACED, strict_episodes=False)
    bob.does(Release(1))
    begin(bob)
    press(ann, A)
    assert (now(t).state, t.since(Notice)) == ("running", [])
    assert desk.asks(Control(1, "reset")).ok
    assert desk.asks(Episode(1, "take_over")).ok
    assert [e.state for e in t.since(EpisodeChanged)] == ["closing"]
    t.wait(5 * SECOND)
    press(ann, A, scene_epoch=2)
    t.wait(3 * SECOND)
    assert (now(t).number, now(t).state) == (16, "running")
