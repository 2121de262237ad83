"""Messages that wait for the session: turns of browsers, and which go ahead."""

from __future__ import annotations

import pytest

from iris_session.web.uplink import MAX_PER_BROWSER, MAX_WAITING, BrowserUplink


def drain(uplink: BrowserUplink) -> list[bytes]:
    taken = []
    while (message := uplink.peek()) is not None:
        taken.append(message)
        uplink.pop()
    assert len(uplink) == 0
    return taken


def push(uplink: BrowserUplink, name: str, kind: str, *, admitted: bool = True) -> str:
    return uplink.push(name, kind, f"{name}.{kind}".encode(), admitted=admitted)


def test_browsers_take_turns() -> None:
    uplink = BrowserUplink()
    for n in range(100):
        push(uplink, "loud", f"sample{n}")
    for n in range(3):
        push(uplink, "ann", f"sample{n}")
    order = drain(uplink)
    assert [order.index(b"ann.sample%d" % n) for n in range(3)] == [1, 3, 5]
    assert [one for one in order if one.startswith(b"loud")] == [b"loud.sample%d" % n for n in range(100)]


@pytest.mark.parametrize("kind", ["estop", "release", "heartbeat"])
def test_what_stops_goes_ahead_of_all_others(kind: str) -> None:
    uplink = BrowserUplink()
    for n in range(1500):
        push(uplink, f"loud{n % 20}", "sample")
    push(uplink, "stranger", kind, admitted=False)
    push(uplink, "ann", kind)
    order = drain(uplink)
    assert order[0] == f"ann.{kind}".encode()
    assert order.index(f"stranger.{kind}".encode()) > 20


def test_a_release_follows_what_its_browser_has_acquired() -> None:
    uplink = BrowserUplink()
    push(uplink, "bob", "acquire")
    for kind in ("acquire", "sample", "release", "sample", "estop"):
        push(uplink, "ann", kind)
    assert drain(uplink) == [b"ann.estop", b"ann.acquire", b"ann.sample", b"ann.release", b"bob.acquire", b"ann.sample"]


def test_who_sends_too_much_is_named_and_others_stop_nevertheless() -> None:
    uplink = BrowserUplink()
    excess = [push(uplink, "loud", "sample") for _ in range(MAX_PER_BROWSER + 1)]
    assert excess == [""] * MAX_PER_BROWSER + ["loud"]
    assert len(uplink) == 0
    for n in range(MAX_WAITING):
        assert not push(uplink, f"many{n % 10}", "sample")
    for _ in range(40):
        push(uplink, "many3", "sample")
    assert push(uplink, "ann", "estop") == ""
    assert uplink.peek() == b"ann.estop"
    assert len(uplink) <= MAX_WAITING


def test_the_stop_of_one_who_sends_too_much_arrives() -> None:
    uplink = BrowserUplink()
    push(uplink, "ann", "estop")
    assert [push(uplink, "ann", "heartbeat") for _ in range(MAX_PER_BROWSER)][-1] == "ann"
    assert drain(uplink)[0] == b"ann.estop"
    for _ in range(MAX_PER_BROWSER):
        push(uplink, "bob", "estop")
    assert push(uplink, "bob", "estop") == "bob"
    assert set(drain(uplink)) == {b"bob.estop"}
