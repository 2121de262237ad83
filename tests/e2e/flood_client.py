"""One hostile client, as a process of its own: `python -m tests.e2e.flood_client KIND HOST CONTROL STATE SECONDS`.

Prints `flooding` once it has begun. Its rate is bounded, so that the session is tested and not the processor.
"""

from __future__ import annotations

import os
import random
import socket
import sys
import time
from collections.abc import Callable, Iterator

import msgspec
import zmq

from iris_session.protocol.client_messages import GetSnapshot, Hello, Sample, wrap_message
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.server_messages import Welcome

#: Messages or connections a second.
RATES = {
    "samples": 50_000, "snapshots": 20_000, "frames": 200, "hellos": 20_000, "subscriptions": 50_000,
    "connections": 500,
}  # fmt: skip
Send = Callable[[], None]


def encode_hello() -> bytes:
    return encode_client(wrap_message(Hello("observer", "Mallory", alignment="not_needed", secret=os.urandom(16))))


def connect_control(context: zmq.Context[zmq.Socket[bytes]], host: str, port: int) -> zmq.Socket[bytes]:
    one = context.socket(zmq.DEALER)
    one.linger = 0
    one.connect(f"tcp://{host}:{port}")
    return one


def join(one: zmq.Socket[bytes]) -> int:
    """Send hello and wait for the welcome. Return the connection epoch."""
    one.send(encode_hello())
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline:
        if one.poll(100) and isinstance(message := decode_server(one.recv_multipart()[0]).message, Welcome):
            return message.connection_epoch
    raise SystemExit("no welcome")


def generate_messages(kind: str, epoch: int) -> Iterator[bytes]:
    if kind == "frames":
        while True:
            yield bytes(1_000_000)
    if kind == "hellos":
        while True:
            yield encode_hello()
    if kind == "snapshots":
        while True:
            yield encode_client(wrap_message(GetSnapshot(1), epoch))
    sample = Sample("head", "pose", 1, 0, 1, 0, 0, pose=IDENTITY)
    seq = 0
    while True:
        seq += 1
        yield encode_client(wrap_message(msgspec.structs.replace(sample, seq=seq, clutch=seq % 2 == 0), epoch))


def make_sender(kind: str, host: str, port: int, state: int) -> Send:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    if kind == "connections":
        return lambda: socket.create_connection((host, port)).close()
    if kind == "subscriptions":
        sub = context.socket(zmq.XSUB)
        sub.linger = 0
        sub.connect(f"tcp://{host}:{state}")
        rng = random.Random(1)
        return lambda: sub.send(b"\x01" + rng.randbytes(900))
    one = connect_control(context, host, port)
    epoch = join(one) if kind in ("samples", "snapshots") else 0
    stream = generate_messages(kind, epoch)

    def send() -> None:
        try:
            one.send(next(stream), zmq.DONTWAIT)
        except zmq.Again:
            time.sleep(0.001)
        while one.poll(0):
            one.recv_multipart()

    return send


def main() -> None:
    os.nice(19)  # on one machine it must not compete for the processor
    kind, host, port, state, seconds = sys.argv[1], sys.argv[2], *map(int, sys.argv[3:5]), float(sys.argv[5])
    send = make_sender(kind, host, port, state)
    print("flooding", flush=True)
    began = time.monotonic()
    sent = 0
    while (now := time.monotonic()) < began + seconds:
        if sent < (now - began) * RATES[kind]:
            send()
            sent += 1
        else:
            time.sleep(0.0005)


if __name__ == "__main__":
    main()
