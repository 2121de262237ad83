"""Misuse: accepted where the meaning is clear, else an immediate one-line error that names the field."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from anchors.pose import PoseTuple
from iris_session.client import Client, ClientError, InvalidMessageError
from iris_session.client.arguments import to_names, to_text
from iris_session.client.core.outbox import encode_checked
from iris_session.client.fetched_scene import fetch_scene
from iris_session.protocol.client_messages import Acquire, EStop, Sample
from iris_session.protocol.codec import decode_client
from iris_session.protocol.common import Pose
from iris_session.protocol.names import FaultCode
from iris_session.protocol.server_messages import ProtocolFault
from tests.client.session import ClientSession

Join = Callable[..., Client]
HERE: PoseTuple = ((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))


class Unspeakable:
    def __str__(self) -> str:
        raise RuntimeError("no text")


@pytest.mark.parametrize("reason", [5, None, "x" * 5000, "\ud800", "\U0001f6d1" * 600, Unspeakable(), ["a", 1]])
def test_any_estop_reason_fits_the_protocol(reason: object) -> None:
    message = decode_client(encode_checked(EStop(to_text(reason)))).message
    assert isinstance(message, EStop)
    assert len(message.reason) <= 512


def assert_no_faults(client: Client) -> None:
    """Check that the front found no fault."""
    assert client.connection.counters.faults == {}


def test_invalid_requests_raise_at_once_and_name_the_field(session: ClientSession, join: Join) -> None:
    ann = join(role="director")
    calls: list[tuple[str, Callable[[], object]]] = [
        ("robots", lambda: ann.acquire([5])),  # type: ignore[list-item]
        ("robots", lambda: ann.acquire(5)),  # type: ignore[arg-type]
        ("ticks", lambda: ann.control("step", "ten")),  # type: ignore[arg-type]
        ("ticks", lambda: ann.control("step", -1)),
        ("text", lambda: ann.marker("x" * 600)),
        (r"robots\[0\]", lambda: ann.acquire(["x" * 65])),
        ("release", lambda: ann.release(["left"])),  # type: ignore[arg-type]
        ("text", lambda: ann.marker("\ud800")),
        ("T_world_tracking", lambda: ann.alignment.place("p1", (1.0, 2.0))),  # type: ignore[arg-type]
    ]
    sent, began_ns = ann.connection.counters.sent, session.now_ns
    for field, call in calls:
        with pytest.raises(InvalidMessageError, match=field) as raised:
            call()
        assert isinstance(raised.value, ClientError)
        assert isinstance(raised.value, ValueError)
        assert "\n" not in str(raised.value)
    assert session.now_ns == began_ns, "none of them waited"
    assert ann.connection.counters.sent == sent
    assert ann.acquire("left")[0].target == "left"


def test_invalid_samples_raise_at_once_and_name_the_field(session: ClientSession, join: Join) -> None:
    ann = join(devices="target")
    assert ann.connection.hello.devices == ("target",)
    bad: list[tuple[str, tuple[object, ...], dict[str, object]]] = [
        ("gripper", ("target", HERE), {"gripper": "closed"}),
        ("gripper", ("target", HERE), {"gripper": "5"}),
        ("gripper", ("target", HERE), {"gripper": True}),
        ("pose", ("target", "up"), {}),
        ("pose", ("target", [1, 2, 3, 1, 0, 0, 0]), {}),
        ("pose", ("target", np.zeros(7)), {}),
        ("pose", ("target", ((1, 2), (1, 0, 0, 0))), {}),
        ("pose", ("target", ((1, 2, None), (1, 0, 0, 0))), {}),
        ("twist", ("target",), {"twist": (1, 2, 3)}),
        ("q", ("joints",), {"q": ["a"]}),
        ("q", ("joints",), {"q": 5}),
        ("clutch", ("target", HERE), {"clutch": "yes"}),
        ("device", (5, HERE), {}),
        ("robots: .*lift.*left, right", ("target", HERE), {"robots": "lift"}),
        ("objects: .*axe.*hammer", ("target", HERE), {"objects": ["axe"]}),
    ]
    for text, arguments, fields in bad:
        with pytest.raises(InvalidMessageError, match=text) as raised:
            ann.send_sample(*arguments, **fields)  # type: ignore[arg-type]
        assert "\n" not in str(raised.value)
    ann.marker("after")
    assert not session.messages_of(Sample)
    assert_no_faults(ann)


def test_a_gripper_out_of_range_is_sent_counted_and_logged_once(join: Join, caplog: pytest.LogCaptureFixture) -> None:
    ann = join(devices="target")
    for gripper in (0.0, 1.0, 255.0, np.float32(-0.5)):
        assert ann.send_sample("target", HERE, gripper=gripper)
    assert ann.counters()["control"]["grippers_clipped"] == 2
    assert [record.name for record in caplog.records] == ["iris_session.client"]


def test_arrays_and_numpy_scalars_are_accepted(session: ClientSession, join: Join) -> None:
    ann = join(devices=("target", "joints"))
    p, q = np.array([0.1, 0.2, 0.3], dtype=np.float32), np.array([1, 0, 0, 0])
    assert ann.send_sample("target", (p, q), clutch=np.bool_(True), gripper=np.float32(0.5), buttons=np.int64(3))
    assert ann.send_sample("target", Pose(*HERE))
    sample = ann.make_sample("joints", q=np.array([0.5, 1.0]), qd=np.zeros(2))
    assert (sample.q, sample.qd) == ((0.5, 1.0), (0.0, 0.0))
    assert ann.make_sample("target", twist=np.arange(6)).twist == (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
    ann.alignment.observe("table", (p, q))
    assert ann.wait_for(lambda c: bool(session.messages_of(Sample)))
    taken = session.messages_of(Sample)[0]
    assert taken.pose is not None
    assert taken.pose.p == pytest.approx(HERE[0])
    assert (taken.clutch, taken.gripper, taken.buttons) == (True, 0.5, 3)
    assert_no_faults(ann)


def test_single_name_and_foreign_robots(session: ClientSession, join: Join) -> None:
    ann = join()
    assert ann.make_sample("target", HERE, robots="left").targets == ()
    assert ann.counters()["control"]["samples_without_lease"] == 1
    ann.acquire("left")
    assert [t.name for t in ann.make_sample("target", HERE, robots="left").targets] == ["left"]
    assert ann.counters()["control"]["samples_without_lease"] == 1
    assert to_names("robots", "left") == ("left",)
    assert to_names("robots", (n for n in ("a", "b"))) == ("a", "b")


def test_fault_ends_the_wait_for_an_answer(session: ClientSession, join: Join) -> None:
    ann = join()
    session.paused = True  # no answer arrives
    ann.connection.last_protocol_fault = ProtocolFault(FaultCode.MALFORMED, "an older one")
    fault = ProtocolFault(FaultCode.MALFORMED, "acquire: robots is wrong")
    at_ns = session.simulation.now_ns + 100_000_000
    send = session.sockets_of(ann).send_to_client
    session.simulation.call_at(at_ns, lambda: send(fault, ann.connection.connection_epoch))
    with pytest.raises(InvalidMessageError, match="acquire: robots"):
        ann.request(Acquire(0, ("left",)), timeout_s=30.0)
    assert session.simulation.now_ns < at_ns + 10_000_000


def test_stalled_or_dead_session_is_visible(session: ClientSession, join: Join) -> None:
    assert session.make_client().scene.data_age_ns() is None, "before the first state"
    ann = join(role="agent", devices="target")
    ann.acquire("left")
    assert ann.wait_for(lambda c: c.scene.state is not None and "left" in c.feedback)
    assert (ann.scene.data_age_ns() or 0) < 100_000_000
    session.paused = True
    ann.sleep(0.4)
    assert (ann.scene.data_age_ns() or 0) > 350_000_000
    assert ann.ready
    session.kill_front()
    assert ann.wait_for(lambda c: not c.ready)
    assert ann.feedback == {}
    before = ann.scene.data_age_ns()
    ann.sleep(0.05)
    assert (ann.scene.data_age_ns() or 0) >= (before or 0) + 49_000_000
    session.paused = False
    assert ann.wait_for(lambda c: c.ready and "left" in c.feedback)
    assert ann.wait_for(lambda c: (c.scene.data_age_ns() or 10**9) < 100_000_000)


@pytest.mark.parametrize("address", [7721, None, ("127.0.0.1", 7721), b"127.0.0.1:7721"])
def test_address_of_wrong_type_is_a_one_line_error(address: object) -> None:
    with pytest.raises(ClientError, match=r"address .*'127\.0\.0\.1:7721'") as raised:
        Client(address)  # type: ignore[arg-type]
    assert "\n" not in str(raised.value)


def test_invalid_hello_raises_at_construction() -> None:
    for settings in ({"name": 5}, {"devices": 5}, {"devices": [5]}, {"role": None, "name": "x"}):
        with pytest.raises(InvalidMessageError, match=r"name|role|devices"):
            Client("127.0.0.1:1", **settings)


@pytest.mark.parametrize("budget", ["QUEST_3", 100_000, None])
def test_invalid_budget_is_a_one_line_error(budget: object) -> None:
    client = Client("127.0.0.1:1", role="observer", name="screen")
    with pytest.raises(TypeError, match=r"^budget is .* QUEST_3"):
        fetch_scene(client, budget)  # type: ignore[arg-type]
    client.close()
