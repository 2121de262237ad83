"""Which robot a participant gets that names none."""

from __future__ import annotations

from iris_session.authority import Authority, AuthorityConfig
from iris_session.protocol.client_messages import Acquire, Bye, Release
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import Lost
from iris_session.protocol.server_messages import LeaseChanged

from .table import Person, Table, robot
from .test_roster import rejoin

ANY = Acquire(1)


def got(person: Person, message: Acquire = ANY) -> list[str]:
    reply = person.asks(message)
    assert reply.ok, reply.denial
    return [lease.target for lease in reply.leases]


def test_join_order_gives_the_first_free_robot() -> None:
    t = Table()
    anna, bert, carl = t.join(), t.join(), t.join()
    assert (got(anna), got(bert)) == (["left"], ["right"])
    assert carl.denied(ANY) == "held"
    carl.does(Acquire(2, wait=True))
    assert [e.lease.queue for e in t.since(LeaseChanged)] == [(carl.id,), (carl.id,)]
    bert.does(Release())
    assert carl.replies()[0].leases[0].target == "right"


def test_config_gives_a_name_its_robots_and_nobody_elses() -> None:
    t = Table(AuthorityConfig(policy="config", assignments={"anna": ("left", "right")}))
    anna, bert = t.join(name="anna"), t.join(name="bert")
    assert bert.denied(ANY) == "policy"
    assert bert.denied(Acquire(1, ("left",))) == "policy"
    assert t.join("director").acquire("left").ok
    assert anna.denied(ANY) == "held"
    t.step(t.persons[3].says(Release()))
    assert got(anna) == ["left", "right"]


def test_a_second_key_under_an_assigned_name_gets_nothing_while_the_first_is_here_or_in_grace() -> None:
    t = Table(AuthorityConfig(policy="config", assignments={"anna": ("left",)}))
    anna, mallory = t.join(name="anna"), t.join(name="anna")
    for _ in range(2):
        assert mallory.denied(ANY) == "policy"
        assert mallory.denied(Acquire(1, ("left",))) == "policy"
        assert "key:key2" in mallory.replies()[0].denial.advice  # type: ignore[union-attr]
        t.step(anna.says(Lost()))
    assert mallory.acquire("right").ok
    t.step(mallory.says(Release()))
    again = rejoin(t, anna)
    assert got(again) == ["left"]
    again.does(Bye())
    assert got(mallory) == ["left"], "who waits takes over the name when the first has left for good"


def test_a_name_taken_on_by_a_resume_is_not_ones_own() -> None:
    t = Table(AuthorityConfig(policy="config", assignments={"anna": ("left",)}))
    mallory, anna = t.join(name="mallory"), t.join(name="anna")
    again = rejoin(t, mallory, name="anna")
    assert again.denied(ANY) == "policy"
    assert got(anna) == ["left"]


def test_robots_assigned_to_a_key_are_its_own_whatever_its_name() -> None:
    t = Table(AuthorityConfig(policy="config", assignments={"key:key2": ("right",), "anna": ("left",)}))
    anna, bert = t.join(name="anna"), t.join(name="anna")
    assert got(bert) == ["right"]
    assert anna.denied(Acquire(1, ("right",))) == "policy"
    assert got(anna) == ["left"]


def test_a_name_that_looks_like_a_key_is_no_key() -> None:
    t = Table(AuthorityConfig(policy="config", assignments={"key:key9": ("right",)}))
    mallory = t.join(name="key:key9")
    assert mallory.denied(ANY) == "policy"
    assert mallory.denied(Acquire(1, ("right",))) == "policy"


def test_director_policy_leaves_it_to_directors() -> None:
    t = Table(AuthorityConfig(policy="director"))
    anna = t.join()
    assert anna.denied(ANY) == "policy"
    assert anna.denied(Acquire(1, ("left",))) == "policy"
    assert got(t.join("director")) == ["left"]


def test_nearest_to_the_head() -> None:
    t = Table(AuthorityConfig(policy="nearest"), robots=(robot("left"), robot("right"), robot("third")))
    anna = t.join()
    assert anna.denied(ANY) == "unaligned"
    anna = t.operator()
    anna.sends(device="head", pose=Pose((0.3, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)))
    assert got(anna) == ["third"]
    assert got(anna) == ["right"]
    assert got(t.join("agent", alignment="not_needed")) == ["left"]


def test_no_robots_at_all() -> None:
    t = Table()

    t.authority = Authority(AuthorityConfig(), (), ())
    assert t.join().denied(ANY) == "unknown_target"
