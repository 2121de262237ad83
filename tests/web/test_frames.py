"""Frames of a WebSocket: counted from its bytes, however they come."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from iris_session.protocol.limits import TokenBucket
from iris_session.web import frames
from iris_session.web.frames import EXTRA_BURST, MESSAGE_BURST, FrameMeter

MESSAGE, FRAGMENT, END, PING, PONG = 0x82, 0x02, 0x80, 0x89, 0x8A


def make_frame(first: int, length: int, *, masked: bool = True) -> bytes:
    mark = 0x80 if masked else 0
    if length < 126:
        head = bytes((first, mark | length))
    elif length < 1 << 16:
        head = bytes((first, mark | 126)) + length.to_bytes(2, "big")
    else:
        head = bytes((first, mark | 127)) + length.to_bytes(8, "big")
    return head + bytes(4 * masked) + b"\x89" * length


def allow(_now_ns: int) -> bool:
    return True


class Counted(FrameMeter):
    """A meter that notes what it takes."""

    def __init__(self) -> None:
        super().__init__(allow, 0)
        self.taken: list[int] = []

    def _take(self, first: int, now_ns: int) -> bool:
        self.taken.append(first)
        return super()._take(first, now_ns)


@given(
    st.lists(
        st.tuples(
            st.sampled_from((MESSAGE, FRAGMENT, END, PING, 0x81)),
            st.sampled_from((0, 1, 125, 126, 300, 70_000)),
            st.booleans(),
        ),
        max_size=12,
    ),
    st.lists(st.integers(1, 70_000), max_size=40),
)
@example([(PING, 0, True), (MESSAGE, 130, True)], [1] * 150)
def test_frames_are_counted_however_their_bytes_come(sent: list[tuple[int, int, bool]], cuts: list[int]) -> None:
    data = b"".join(make_frame(first, length, masked=masked) for first, length, masked in sent)
    meter, at = Counted(), 0
    for cut in (*cuts, len(data)):
        assert meter.feed(data[at : at + cut], 0)
        at += cut
    assert meter.taken == [first for first, _, _ in sent]


@pytest.mark.parametrize("first", [PING, PONG, FRAGMENT, END, 0x00, 0x01, 0x88])
def test_what_is_no_whole_message_is_limited(first: int) -> None:
    meter = FrameMeter(allow, 0)
    frame = make_frame(first, 0)
    assert meter.feed(frame * EXTRA_BURST, 0)
    assert not meter.feed(frame, 0)
    assert meter.feed(make_frame(MESSAGE, 500), 0)
    seconds = [n * 1_000_000_000 for n in range(1, 60)]
    assert all(meter.feed(frame * int(frames.EXTRA_PER_S), now_ns) for now_ns in seconds)
    assert not meter.feed(frame * 1_000_000, seconds[-1])


def test_whole_messages_have_a_limit_of_their_own() -> None:
    meter = FrameMeter(allow, 0)
    assert meter.feed(make_frame(MESSAGE, 0) * MESSAGE_BURST, 0)
    assert not meter.feed(make_frame(MESSAGE, 0), 0)
    assert meter.feed(make_frame(PING, 0), 0)


def test_connections_of_a_network_share_a_limit() -> None:
    network = TokenBucket(1.0, 3)
    meters = [FrameMeter(network.take, 0) for _ in range(5)]
    assert [meter.feed(make_frame(PING, 0), 0) for meter in meters] == [True] * 3 + [False] * 2
    assert all(meter.feed(make_frame(MESSAGE, 9), 0) for meter in meters)
