"""Baseline of the machine: an empty loop at the session's rate that publishes frames of the session's size.

No physics, participants or codec: a loop at real-time priority and plain libzmq from PUB to SUB, on the machine and in
the run in which the session is measured. Where this is late, every session is late. It is the reference of `bench
state` and `bench input`.
"""

from __future__ import annotations

import contextlib
import time
from typing import Final

import numpy as np
import zmq

from iris_session.bench.plugins import Plugin, PluginProcess
from iris_session.bench.report import BenchError, compute_percentile, summarize_percentiles
from iris_session.system.priority import freeze_garbage_collector, tick_priority

PERIOD_NS: Final = 2_000_000
FRAME_NS: Final = round(1e9 / 60.0)
FRAME_BYTES: Final = 3_700  # 300 moving bodies
WARM_UP_NS: Final = 1_000_000_000
PER_PROCESS: Final = 4
_END: Final = -1
RECEIVERS: Final = "iris_session.bench.baseline:Receivers"
_JOIN_S: Final = 30.0


def measure_baseline(receivers: int) -> dict[str, float]:
    """Measure the baseline with a number of receiving sockets.

    Returns:
        `bare_age_ms_*`: from sending to the receiving program; `bare_late_tick_share`, `bare_lateness_ms_p99`: of a
        loop of 2 ms that does nothing else.
    """
    with contextlib.ExitStack() as stack:
        context = stack.enter_context(zmq.Context())
        socket = stack.enter_context(context.socket(zmq.XPUB))
        socket.setsockopt(zmq.LINGER, 1_000)
        socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        port = socket.bind_to_random_port("tcp://127.0.0.1")
        shares = [min(PER_PROCESS, receivers - i) for i in range(0, receivers, PER_PROCESS)]
        address = f"tcp://127.0.0.1:{port}"
        workers = [stack.enter_context(PluginProcess(RECEIVERS, address, n)) for n in shares]
        for worker in workers:
            worker.send("receive")
        for _ in range(receivers):
            if not socket.poll(round(_JOIN_S * 1e3)):
                raise BenchError(f"the receivers of the reference did not join within {_JOIN_S:g} s")
            socket.recv()
        lateness = _run_loop(socket, 5.0)
        socket.send(_encode_frame(_END))
        ages = np.array([age_ns for worker in workers for age_ns in _read_ages(worker)]) * 1e-6
    late = np.array(lateness) * 1e-6
    return {
        **summarize_percentiles("bare_age_ms", ages),
        "bare_late_tick_share": round(float((late > PERIOD_NS * 1e-6).mean()), 6),
        "bare_lateness_ms_p99": compute_percentile(late, 99),
    }


def _read_ages(worker: PluginProcess) -> list[int]:
    worker.read(_JOIN_S)  # it is made
    ages: list[int] = worker.read(_JOIN_S)
    if not ages:
        raise BenchError("a receiver of the reference received nothing")
    return ages


def _run_loop(socket: zmq.Socket[bytes], seconds: float) -> list[int]:
    """Run the loop. Return the lateness [ns] of every tick; deadlines are start + k * period, as in a session."""
    lateness: list[int] = []
    with tick_priority(), freeze_garbage_collector():
        deadline = published = time.monotonic_ns() + PERIOD_NS
        end = deadline + round(seconds * 1e9)
        while deadline < end:
            time.sleep(max(0, deadline - time.monotonic_ns()) * 1e-9)
            now = time.monotonic_ns()
            if now >= published:
                socket.send(_encode_frame(now))
                published += FRAME_NS
            lateness.append(time.monotonic_ns() - deadline)
            deadline += PERIOD_NS
    return lateness


def _encode_frame(sent_ns: int) -> bytes:
    return sent_ns.to_bytes(8, "little", signed=True) + bytes(FRAME_BYTES - 8)


class Receivers(Plugin):
    """Sockets that receive frames."""

    def __init__(self, address: str, sockets: int) -> None:
        self._context = zmq.Context()
        self._poller = zmq.Poller()
        for _ in range(sockets):
            socket = self._context.socket(zmq.SUB)
            socket.setsockopt(zmq.RCVHWM, 2)
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.SUBSCRIBE, b"")
            socket.connect(address)
            self._poller.register(socket, zmq.POLLIN)

    def receive(self) -> list[int]:
        """Receive until the end frame. Return the ages [ns] of the frames of all sockets after the warm-up."""
        ages: list[int] = []
        first_ns = 0
        while ready := self._poller.poll(round(_JOIN_S * 1e3)):
            for socket, _ in ready:
                sent_ns = int.from_bytes(socket.recv()[:8], "little", signed=True)
                if sent_ns == _END:
                    return ages
                first_ns = first_ns or sent_ns
                if sent_ns - first_ns > WARM_UP_NS:
                    ages.append(time.monotonic_ns() - sent_ns)
        return ages

    def close(self) -> None:
        """Close the sockets."""
        self._context.destroy(linger=0)
