"""The hub: names, what waits for whom, tickets, limits, reasons to close."""

from __future__ import annotations

import pytest

from iris_session.protocol.client_messages import Bye, Disconnected, EStop, Heartbeat, Hello, Pair, wrap_message
from iris_session.protocol.codec import decode_client, decode_server, encode_client, encode_server
from iris_session.protocol.common import Message
from iris_session.protocol.server_messages import (
    ROBOT_STATES,
    TOPIC_ROBOTS,
    Endpoints,
    ProtocolFault,
    ServerEnvelope,
    Welcome,
)
from iris_session.web import wire
from iris_session.web.hub import MAX_IDENTITIES, SECOND, TICKET_BYTES, Browser, Hub, HubLimits


def make_hello(secret: int) -> bytes:
    hello = Hello("observer", "ann", secret=secret.to_bytes(32, "big"))
    return wire.encode_frames(wire.CONTROL, [encode_client(wrap_message(hello))])


HELLO = make_hello(0)
ESTOP = wire.encode_frames(wire.CONTROL, [encode_client(wrap_message(EStop(), 0))])
PAIR = wire.encode_frames(wire.CONTROL, [encode_client(wrap_message(Pair("ann", bytes(32), identity=bytes(32))))])
HEARTBEAT = wire.encode_frames(wire.CONTROL, [encode_client(wrap_message(Heartbeat(), 5))])


def open_browser(hub: Hub, n: int = 1) -> Browser:
    return open_from(hub, n, "10.0.0.1")


def open_from(hub: Hub, n: int, address: str) -> Browser:
    browser = hub.open_browser(n.to_bytes(6, "big"), address, 0)
    assert browser is not None
    return browser


def answer(hub: Hub, browser: Browser, message: Message, epoch: int = 5, *bulk: bytes, now_ns: int = 0) -> None:
    envelope = encode_server(ServerEnvelope(1, epoch, message))  # type: ignore[arg-type]
    assert hub.deliver([envelope, *bulk, browser.name.encode()], now_ns)


def welcome(hub: Hub, browser: Browser, epoch: int = 5, now_ns: int = 0, secret: int = 0) -> None:
    hub.receive(browser, make_hello(secret), now_ns)
    message = Welcome("s", "name", "live", "p1", epoch, "observer", b"t" * 16, False, 0, 1, 1, 1, Endpoints())
    answer(hub, browser, message, epoch, now_ns=now_ns)


def take(hub: Hub, browser: Browser) -> list[tuple[int, list[bytes]]]:
    found = []
    while (data := hub.take_message(browser) or hub.take_latest(browser)) is not None:
        channel, frames = wire.decode_frames(data)
        found.append((channel, [bytes(frame) for frame in frames]))
    return found


def test_each_browser_speaks_in_a_name_of_its_own() -> None:
    hub = Hub()
    names = set()
    for n in range(3):
        browser = open_browser(hub, n)
        envelope = hub.receive(browser, HELLO, 0)
        assert envelope is not None
        assert decode_client(envelope).on_behalf_of == browser.name
        names.add(browser.name)
    assert len(names) == 3
    assert hub.open_browser((0).to_bytes(6, "big"), "", 0) is None, "a name that is taken"


@pytest.mark.parametrize(
    ("data", "code", "drop"),
    [
        (b"", wire.CLOSE_NOT_ALLOWED, "web_malformed"),
        (wire.encode_frames(wire.STATE, [b"x"]), wire.CLOSE_NOT_ALLOWED, "web_malformed"),
        (wire.encode_frames(wire.CONTROL, [b"x", b"y"]), wire.CLOSE_NOT_ALLOWED, "web_malformed"),
        (wire.encode_frames(wire.CONTROL, [b"\x94\x01\x07\xa3bob\x80"]), wire.CLOSE_NOT_ALLOWED, "web_gateway_only"),
        (wire.encode_frames(wire.CONTROL, [b"\x94\x02\x07\xa0\x80"]), wire.CLOSE_VERSION, "web_version"),
    ],
)
def test_what_does_not_fit_closes_its_sender_only(data: bytes, code: int, drop: str) -> None:
    hub = Hub()
    bad, good = open_browser(hub, 1), open_browser(hub, 2)
    woken = []
    bad.wake = lambda: woken.append(True)
    assert hub.receive(bad, data, 0) is None
    assert bad.closing is not None
    assert bad.closing.code == code
    assert woken
    assert hub.drops.by_reason == {drop: 1}
    assert hub.receive(bad, HELLO, 0) is None, "nothing of it reaches the session any more"
    assert good.closing is None
    assert hub.receive(good, HELLO, 0) is not None


def test_floods_close_their_sender() -> None:
    hub = Hub(HubLimits(messages_per_s=10.0, message_burst=5))
    browser = open_browser(hub)
    assert [hub.receive(browser, HEARTBEAT, 0) is not None for _ in range(6)] == [True] * 5 + [False]
    assert browser.closing is not None
    assert browser.closing.code == wire.CLOSE_LIMIT
    assert hub.drops.by_reason == {"web_flood": 1}
    slow = open_browser(hub, 2)
    assert all(hub.receive(slow, HEARTBEAT, n * SECOND // 10) is not None for n in range(100))
    large = Hub(HubLimits(bytes_per_s=1.0, byte_burst=len(HEARTBEAT)))
    browser = open_browser(large)
    assert large.receive(browser, HEARTBEAT, 0) is not None
    assert large.receive(browser, HEARTBEAT, 0) is None


def test_a_browser_without_a_welcome_may_say_little() -> None:
    hub = Hub(HubLimits(early_burst=2, early_shared_burst=1))
    browser, joined = open_from(hub, 1, "10.0.0.1"), open_from(hub, 2, "10.0.0.2")
    assert [hub.receive(browser, HELLO, 0) is not None for _ in range(4)] == [True] * 3 + [False]
    assert browser.closing is not None
    welcome(hub, joined)
    assert all(hub.receive(joined, HEARTBEAT, 0) for _ in range(100))
    assert [hub.receive(joined, HELLO, 0) is not None for _ in range(4)] == [True] * 3 + [False], (
        "nor many hellos later"
    )


def test_many_sockets_of_a_network_say_no_more_before_the_welcome_than_one() -> None:
    hub = Hub()
    n_sent = 0
    for n in range(96):
        browser = open_from(hub, n, f"2001:db8::{n:x}")
        for _ in range(200):
            n_sent += hub.receive(browser, HELLO, 0) is not None
    assert n_sent == hub.limits.early_burst + hub.limits.early_shared_burst
    honest = open_from(hub, 200, "10.0.0.9")
    assert hub.receive(honest, HELLO, 0) is not None, "one of another network joins meanwhile"


def test_pairing_attempts_of_one_network_are_limited() -> None:
    hub = Hub()
    first, typing = [open_from(hub, n, f"2001:db8::{n}") for n in range(2)], open_from(hub, 2, "10.0.0.1")
    assert all(hub.receive(first[n % 2], PAIR, 0) for n in range(20))
    assert all(hub.receive(typing, PAIR, n) for n in range(6)), "a person who mistypes a code"
    third = open_from(hub, 3, "2001:db8::3")
    assert hub.receive(third, HELLO, 0) is not None
    assert hub.receive(third, PAIR, 0) is None
    assert third.closing is not None
    assert third.closing.code == wire.CLOSE_LIMIT
    assert hub.drops.by_reason == {"web_pair_rate": 1}
    assert [browser.closing for browser in (*first, typing)] == [None] * 3
    assert hub.receive(first[0], PAIR, 31 * SECOND) is not None
    assert hub.receive(first[0], PAIR, 31 * SECOND) is None


def test_what_is_not_messagepack_is_answered_by_the_gateway() -> None:
    hub = Hub()
    browser = open_browser(hub)
    welcome(hub, browser)
    take(hub, browser)
    for _ in range(20):
        assert hub.receive(browser, wire.encode_frames(wire.CONTROL, [b"\x94\x01\x05\xa0\xc1"]), 0) is None
    answers = [decode_server(frames[0]) for _, frames in take(hub, browser)]
    assert 0 < len(answers) < 20, "at a bounded rate"
    assert answers[0].connection_epoch == 5
    assert isinstance(answers[0].message, ProtocolFault)
    assert answers[0].message.code == "malformed"
    assert hub.drops.by_reason == {"web_malformed": 20}
    assert browser.closing is None


def test_answers_reach_the_browser_that_they_name() -> None:
    hub = Hub()
    ann, bob = open_browser(hub, 1), open_browser(hub, 2)
    answer(hub, bob, ProtocolFault("rate", "text"), 3, b"bulk")
    assert take(hub, ann) == []
    ((channel, frames),) = take(hub, bob)
    assert channel == wire.CONTROL
    assert decode_server(frames[0]).message == ProtocolFault("rate", "text")
    assert frames[1:] == [b"bulk"]


def test_messages_of_the_gateway_itself_are_left_to_it() -> None:
    hub = Hub()
    open_browser(hub)
    envelope = encode_server(ServerEnvelope(1, 3, ProtocolFault("rate", "text")))
    assert not hub.deliver([envelope], 0)
    assert not hub.deliver([envelope, bytes(56)], 0), "a bulk frame"
    assert hub.deliver([envelope, b"web-ffffffffffff"], 0), "a browser that has closed"
    assert hub.drops.by_reason == {"web_unknown_name": 1}


def test_state_is_for_admitted_browsers_and_the_newest_only() -> None:
    hub = Hub()
    ann, stranger = open_browser(hub, 1), open_browser(hub, 2)
    welcome(hub, ann)
    take(hub, ann)
    for n in range(3):
        hub.publish([b"rigid", b"header", bytes((n,))])
        hub.publish([b"presence", bytes((n,))])
    assert take(hub, ann) == [(wire.STATE, [b"rigid", b"header", b"\2"]), (wire.STATE, [b"presence", b"\2"])]
    assert ann.superseded == 4
    assert take(hub, stranger) == []


def test_states_of_robots_are_for_browsers_that_ask_for_them() -> None:
    hub = Hub()
    ann, bob = open_browser(hub, 1), open_browser(hub, 2)
    for browser, secret in ((ann, 1), (bob, 2)):
        welcome(hub, browser, secret=secret)
    hello = Hello("observer", "bob", capabilities=(ROBOT_STATES,), secret=(2).to_bytes(32, "big"))
    hub.receive(bob, wire.encode_frames(wire.CONTROL, [encode_client(wrap_message(hello))]), 0)
    for browser in (ann, bob):
        take(hub, browser)
    hub.publish([TOPIC_ROBOTS, b"states"])
    assert take(hub, ann) == []
    assert take(hub, bob) == [(wire.STATE, [TOPIC_ROBOTS, b"states"])]


@pytest.mark.parametrize("code", ["dropped", "revoked", "hello", "session_ended"])
def test_no_state_after_the_session_has_let_a_browser_go(code: str) -> None:
    hub = Hub()
    browser = open_browser(hub)
    welcome(hub, browser)
    hub.issue_ticket(browser, bytes(TICKET_BYTES), 0)
    ticket = browser.ticket.decode()
    assert hub.find_ticket(ticket, 1) is browser
    answer(hub, browser, ProtocolFault(code, "text"))
    take(hub, browser)
    hub.publish([b"rigid", b"header", b"payload"])
    assert take(hub, browser) == []
    assert hub.find_ticket(ticket, 1) is None
    welcome(hub, browser, epoch=9)
    take(hub, browser)
    hub.publish([b"rigid", b"header", b"payload"])
    assert take(hub, browser), "it has said hello again"
    assert hub.find_ticket(ticket, 1) is None, "a ticket of the connection before"


def test_no_state_after_a_bye() -> None:
    hub = Hub()
    browser = open_browser(hub)
    welcome(hub, browser)
    take(hub, browser)
    bye = wire.encode_frames(wire.CONTROL, [encode_client(wrap_message(Bye(), 5))])
    assert hub.receive(browser, bye, 0) is not None
    hub.publish([b"rigid", b"header", b"payload"])
    assert take(hub, browser) == []
    assert hub.close_browser(browser) is None, "the session has no connection to lose"


def test_a_closed_socket_is_reported_as_lost() -> None:
    hub = Hub()
    silent, browser = open_browser(hub, 1), open_browser(hub, 2)
    assert hub.close_browser(silent) is None
    welcome(hub, browser)
    hub.issue_ticket(browser, bytes(TICKET_BYTES), 0)
    notification = hub.close_browser(browser)
    assert notification is not None
    envelope = decode_client(notification)
    assert (envelope.connection_epoch, envelope.on_behalf_of, envelope.message) == (5, browser.name, Disconnected())
    assert hub.find_ticket(browser.ticket.decode(), 1) is None
    assert len(hub) == 0


def test_a_lost_session_closes_all_and_reports_none() -> None:
    hub = Hub()
    browsers = [open_browser(hub, n) for n in range(3)]
    for browser in browsers:
        welcome(hub, browser)
    hub.close_all(wire.CLOSE_RESTART, "come again")
    assert [browser.closing.code for browser in browsers if browser.closing] == [1012] * 3
    assert [hub.close_browser(browser) for browser in browsers] == [None] * 3


def test_a_browser_that_reads_no_control_messages_is_closed() -> None:
    hub = Hub(HubLimits(queued_messages=3, queued_bytes=10_000, total_bytes=15_000))
    ann, bob = open_browser(hub, 1), open_browser(hub, 2)
    for _ in range(4):
        answer(hub, ann, ProtocolFault("rate", "text"))
    assert ann.closing is not None
    assert ann.closing.code == wire.CLOSE_TOO_SLOW
    assert ann.queued_bytes == 0
    answer(hub, bob, ProtocolFault("rate", "text"), 5, bytes(9000))
    assert bob.closing is None
    cid = open_browser(hub, 3)
    answer(hub, cid, ProtocolFault("rate", "text"), 5, bytes(7000))
    assert bob.closing is not None, "too much waits for all together, and most for this one"
    assert cid.closing is None
    assert len(take(hub, cid)) == 1
    assert hub.drops.by_reason == {"web_too_slow": 2}


def test_tickets_are_renewed_before_they_expire() -> None:
    limits = HubLimits(ticket_ns=100 * SECOND)
    hub = Hub(limits)
    browser = open_browser(hub)
    assert not hub.needs_ticket(browser, 0), "not before the welcome"
    welcome(hub, browser)
    assert hub.needs_ticket(browser, 0)
    hub.issue_ticket(browser, bytes(TICKET_BYTES), 0)
    first = browser.ticket.decode()
    channel, frames = take(hub, browser)[-1]
    message = wire.decode_gateway_message(frames[0])
    assert (channel, message) == (wire.GATEWAY, wire.Ticket(first, 100))
    assert not hub.needs_ticket(browser, 49 * SECOND)
    assert hub.needs_ticket(browser, 50 * SECOND)
    hub.issue_ticket(browser, b"\1" * TICKET_BYTES, 50 * SECOND)
    assert hub.find_ticket(first, 99 * SECOND) is browser
    assert hub.find_ticket(first, 100 * SECOND) is None
    assert hub.find_ticket(browser.ticket.decode(), 149 * SECOND) is browser
    hub.tick(200 * SECOND)
    assert hub.find_ticket("", 0) is hub.find_ticket("\ud800", 0) is None


def test_browsers_that_do_not_join_or_are_silent_are_closed() -> None:
    hub = Hub()
    talker, silent, alive = (open_browser(hub, n) for n in range(3))
    for browser in (silent, alive):
        welcome(hub, browser)
    for second in (10, 20):
        hub.receive(talker, HEARTBEAT, second * SECOND)
        hub.receive(alive, HEARTBEAT, second * SECOND)
        hub.tick(second * SECOND)
    assert [browser.closing is None for browser in (talker, silent, alive)] == [True, False, True]
    hub.tick(21 * SECOND)
    assert [browser.closing is None for browser in (talker, silent, alive)] == [False, False, True]
    assert hub.drops.by_reason == {"web_no_hello": 1, "web_silent": 1}


def test_a_full_hub_makes_room_only_by_those_that_have_not_joined() -> None:
    hub = Hub(HubLimits(browsers=4))
    joined, lone = open_browser(hub, 1), hub.open_browser((2).to_bytes(6, "big"), "10.0.0.2", 0)
    welcome(hub, joined)
    flood = [open_browser(hub, n) for n in (3, 4, 5, 6)]
    assert lone is not None
    assert [one.closing is None for one in (joined, lone, *flood)] == [True, True, False, False, True, True]
    assert flood[0].closing is not None
    assert flood[0].closing.code == wire.CLOSE_LIMIT
    hub.receive(flood[2], HELLO, 0)
    assert hub.close_browser(flood[2]) is not None
    for n in (7, 8):
        open_browser(hub, n)
    for browser in hub:
        welcome(hub, browser)
    assert hub.open_browser(b"\0\0\0\0\0\x09", "", 0) is None
    assert hub.drops.by_reason == {"web_evicted": 3, "web_full": 1}


def test_unknown_assets_are_limited_by_identity_and_media_sockets_by_browser() -> None:
    hub = Hub()
    ann, bob = open_browser(hub, 1), open_browser(hub, 2)
    for secret, browser in enumerate((ann, bob)):
        welcome(hub, browser, secret=secret)
        hub.issue_ticket(browser, bytes((secret,)) * TICKET_BYTES, 0)
    for n in range(10):
        hub.note_unknown_asset(bob, n * SECOND)
    for _ in range(100):
        hub.note_unknown_asset(ann, 0)
    assert ann.closing is not None
    assert ann.closing.code == wire.CLOSE_LIMIT
    assert hub.find_ticket(ann.ticket.decode(), 0) is None
    again = open_browser(hub, 3)
    welcome(hub, again)
    hub.note_unknown_asset(again, 0)
    assert again.closing is not None, "the same identity"
    assert bob.closing is None
    n_media = sum(hub.allow_media(bob, 10 * SECOND) for _ in range(100))
    assert 1 < n_media < 20
    assert hub.allow_media(bob, 20 * SECOND)


def test_a_stop_of_one_that_was_welcomed_before_arrives_whatever_its_neighbours_say() -> None:
    hub = Hub()
    ann = open_browser(hub, 1)
    welcome(hub, ann)
    hub.close_browser(ann)
    neighbours = [open_browser(hub, n) for n in range(2, 50)]
    for n in range(20):
        for secret, browser in enumerate(neighbours, 1):
            hub.receive(browser, ESTOP if n else make_hello(secret), 0)
    assert {browser.closing is None for browser in neighbours} == {False}
    again, stranger = open_browser(hub, 50), open_browser(hub, 51)
    assert hub.receive(stranger, make_hello(51), 0) is None
    assert hub.receive(again, HELLO, 0) is not None
    assert all(hub.receive(again, ESTOP, 0) is not None for _ in range(10))


def test_identities_that_were_welcomed_are_bounded() -> None:
    hub = Hub()
    for n in range(MAX_IDENTITIES + 2):
        browser = open_browser(hub, n)
        welcome(hub, browser, now_ns=n * SECOND, secret=n)
        assert browser.epoch
        hub.close_browser(browser)
    assert len(hub._welcomed) == MAX_IDENTITIES


def test_a_websocket_has_one_identity() -> None:
    hub = Hub()
    browser = open_browser(hub)
    assert all(hub.receive(browser, HELLO, 0) is not None for _ in range(2))
    assert hub.receive(browser, make_hello(1), 0) is None
    assert browser.closing is not None
    assert browser.closing.code == wire.CLOSE_NOT_ALLOWED
    assert hub.drops.by_reason == {"web_identity": 1}
