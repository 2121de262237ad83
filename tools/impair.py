"""Put an impaired link between a session and its clients, or measure the delay of the proxy itself.

    python tools/impair.py --link 127.0.0.2=busy-wifi          clients join at 127.0.0.2:7721, docs/evidence/links.md
    python tools/impair.py measure --clients 16 --json

`measure` sends what a session's state stream sends (60 messages of 3,700 bytes a second to each client) directly and
over a link of profile `none`, alternately, and prints the added delay.
"""

from __future__ import annotations

import argparse
import json
import random
import selectors
import socket
import struct
import sys
import time
from contextlib import ExitStack
from typing import Final

from iris_session.netsim import process as impairment_process
from iris_session.netsim.process import ImpairmentProcess

MESSAGE: Final = 3_700
HZ: Final = 60.0
ROUNDS: Final = 3
_STAMP: Final = struct.Struct("<q")


def one_way_ms(host: str, port: int, listening: socket.socket, clients: int, seconds: float) -> list[float]:
    """One-way delays [ms] of a stream to each of `clients` connections through `host`; both ends are here."""
    with ExitStack() as stack:
        receiving, sending = [], []
        for _ in range(clients):
            receiving.append(stack.enter_context(socket.create_connection((host, port))))
            sending.append(stack.enter_context(listening.accept()[0]))
        selector = stack.enter_context(selectors.DefaultSelector())
        for end in (*sending, *receiving):
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        buffers = {end.fileno(): bytearray() for end in receiving}
        for end in receiving:
            end.setblocking(False)
            selector.register(end, selectors.EVENT_READ, end)
        delays: list[float] = []
        rest = bytes(MESSAGE - _STAMP.size)
        # Like independent phases of a stream: every message of a round at a moment of its own within the period.
        start = time.monotonic()
        due = sorted((start + (k + random.random()) / HZ, i) for k in range(int(seconds * HZ)) for i in range(clients))
        while due or time.monotonic() - start < seconds + 0.2:
            wait = due[0][0] - time.monotonic() if due else 0.05
            for key, _ in selector.select(max(0.0, wait) if wait < 1e-3 else wait - 1e-3):
                buffer = buffers[key.fd]
                buffer += key.data.recv(65536)
                now = time.monotonic_ns()
                while len(buffer) >= MESSAGE:
                    delays.append((now - _STAMP.unpack_from(buffer)[0]) / 1e6)
                    del buffer[:MESSAGE]
            while due and due[0][0] <= time.monotonic():
                _, i = due.pop(0)
                sending[i].sendall(_STAMP.pack(time.monotonic_ns()) + rest)
        return delays


def measure(clients: int, seconds: float) -> dict[str, float]:
    """Quantiles of the one-way delay, directly and over the proxy [ms]."""
    direct: list[float] = []
    proxied: list[float] = []
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        with ImpairmentProcess({"127.0.0.2": "none"}, [port]):
            for _ in range(ROUNDS):
                direct += one_way_ms("127.0.0.1", port, listening, clients, seconds / ROUNDS)
                proxied += one_way_ms("127.0.0.2", port, listening, clients, seconds / ROUNDS)
    result: dict[str, float] = {"clients": clients, "messages": len(proxied)}
    for name, delays in (("direct", sorted(direct)), ("proxy", sorted(proxied))):
        for quantile in (50, 99):
            result[f"{name}_ms_p{quantile}"] = round(delays[len(delays) * quantile // 100], 3)
    for quantile in (50, 99):
        added = result[f"proxy_ms_p{quantile}"] - result[f"direct_ms_p{quantile}"]
        result[f"added_ms_p{quantile}"] = round(added, 3)
    return result


def main() -> int:
    if sys.argv[1:2] != ["measure"]:
        return impairment_process.main(prog="tools/impair.py", description=__doc__)
    parser = argparse.ArgumentParser(prog="tools/impair.py measure")
    parser.add_argument("--clients", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(sys.argv[2:])
    result = measure(options.clients, options.seconds)
    print(json.dumps(result) if options.json else "\n".join(f"{key:<18}{value}" for key, value in result.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
