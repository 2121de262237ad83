"""Pending bytes of a TCP connection in both directions: against real sockets, plain and encrypted."""

from __future__ import annotations

import time

import pytest
import zmq

from iris_session.link.tcp_guard import TrafficCounter

#: Greeting and handshake, both ways, and what the other end says of itself.
HANDSHAKE = 2000


def settled(traffic: TrafficCounter, descriptor: int, above: int, below: int) -> int:
    """Return the pending bytes once they are within bounds: acknowledgements take their time."""
    deadline = time.monotonic() + 30.0
    while not above <= (held := traffic.pending_bytes(descriptor)) <= below:
        assert time.monotonic() < deadline, held
        time.sleep(0.005)
    return held


@pytest.mark.parametrize("curve", [False, True])
def test_pending_bytes_are_exact_except_for_the_handshake(curve: bool) -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    router, dealer = context.socket(zmq.ROUTER), context.socket(zmq.DEALER)
    router.linger = dealer.linger = 0
    router.rcvhwm, dealer.rcvhwm, router.sndhwm = 8, 1, 0
    dealer.setsockopt(zmq.RCVBUF, 4096)
    if curve:
        public, secret = zmq.curve_keypair()
        router.curve_server, router.curve_secretkey = True, secret
        dealer.curve_serverkey, (dealer.curve_publickey, dealer.curve_secretkey) = public, zmq.curve_keypair()
    dealer.connect(f"tcp://127.0.0.1:{router.bind_to_random_port('tcp://127.0.0.1')}")
    traffic = TrafficCounter(curve=curve)
    descriptor = -1

    def take(n: int) -> bytes:
        nonlocal descriptor
        for _ in range(n):
            assert router.poll(30_000)
            route = router.recv()
            frame = router.recv(copy=False)
            descriptor = int(frame.get(zmq.SRCFD))
            traffic.count_received(descriptor, len(frame.buffer))
        return route

    for size in (0, 1, 200, 223, 255, 256, 5000):
        for _ in range(20):
            dealer.send(bytes(size))
        route = take(20)
    settled(traffic, descriptor, 0, HANDSHAKE)
    for _ in range(30):
        dealer.send(bytes(10_000))
    settled(traffic, descriptor, 60_000, 30 * 10_100 + HANDSHAKE)  # what no buffer of the system took is not counted
    take(30)
    settled(traffic, descriptor, 0, HANDSHAKE)

    for _ in range(1000):
        message = (b"x" * 10_000, b"y" * 100)
        router.send_multipart((route, *message))
        traffic.count_sent(descriptor, message)
    assert traffic.pending_bytes(descriptor) > 2_000_000
    for _ in range(1000):
        assert dealer.poll(30_000)
        dealer.recv_multipart()
    settled(traffic, descriptor, 0, HANDSHAKE)
    traffic.reset(descriptor)
    context.destroy(linger=0)
    assert traffic.pending_bytes(descriptor) == 0, "gone"
