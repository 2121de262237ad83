"""Baseline of the machine: an empty loop at the session's rate that publishes frames of the session's size.

No physics, participants or codec: a loop at real-time priority and plain libzmq from PUB to SUB, on the machine and in
the run in which the session is measured. Where this is late, every session is late. It is the reference of `bench
state` and `bench input`.

    python -m iris_session.bench.baseline ADDRESS SOCKETS     one process of receivers
"""

from __future__ import annotations

import subprocess
import sys
import time
from array import array
from collections.abc import Sequence
from typing import Final

import numpy as np
import zmq
from numpy.typing import NDArray

from iris_session.bench.report import BenchError, compute_percentile
from iris_session.system.priority import freeze_garbage_collector, tick_priority
from iris_session.system.process import child_environment, module_command

PERIOD_NS: Final = 2_000_000
FRAME_NS: Final = round(1e9 / 60.0)
FRAME_BYTES: Final = 3_700  # 300 moving bodies
SECONDS: Final = 5.0
WARM_UP_NS: Final = 1_000_000_000
PER_PROCESS: Final = 4
_END: Final = -1
_JOIN_S: Final = 30.0


def measure_baseline(receivers: int, seconds: float = SECONDS) -> dict[str, float]:
    """Measure the baseline.

    Args:
        receivers: Number of receiving sockets.
        seconds: Length of the measured part.

    Returns:
        `bare_age_ms_*`: from sending to the receiving program; `bare_late_tick_share`, `bare_lateness_ms_p99`: of a
        loop of 2 ms that does nothing else.
    """
    with zmq.Context() as context, context.socket(zmq.XPUB) as socket:
        socket.setsockopt(zmq.LINGER, 1_000)
        socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        port = socket.bind_to_random_port("tcp://127.0.0.1")
        shares = [min(PER_PROCESS, receivers - i) for i in range(0, receivers, PER_PROCESS)]
        processes = [_start_receiver(f"tcp://127.0.0.1:{port}", n) for n in shares]
        try:
            for _ in range(receivers):
                if not socket.poll(round(_JOIN_S * 1e3)):
                    raise BenchError(f"the receivers of the reference did not join within {_JOIN_S:g} s")
                socket.recv()
            lateness = _run_loop(socket, seconds)
            socket.send(_encode_frame(_END))
            ages = np.concatenate([_read_ages(process) for process in processes])
        finally:
            for process in processes:
                process.kill()
                process.communicate()
    late = np.array(lateness) * 1e-6
    return {
        "bare_age_ms_p50": compute_percentile(ages, 50),
        "bare_age_ms_p99": compute_percentile(ages, 99),
        "bare_late_tick_share": round(float((late > PERIOD_NS * 1e-6).mean()), 6),
        "bare_lateness_ms_p99": compute_percentile(late, 99),
    }


def _start_receiver(address: str, sockets: int) -> subprocess.Popen[bytes]:
    command = module_command("iris_session.bench.baseline", address, str(sockets))
    return subprocess.Popen(command, stdout=subprocess.PIPE, env=child_environment(), process_group=0)


def _read_ages(process: subprocess.Popen[bytes]) -> NDArray[np.float64]:
    out, _ = process.communicate(timeout=_JOIN_S)
    ages = np.frombuffer(out, np.int64).astype(np.float64) * 1e-6
    if process.returncode or not len(ages):
        raise BenchError(f"a receiver of the reference failed with status {process.returncode}")
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


def _receive(address: str, sockets: int) -> array[int]:
    """Receive until the end frame. Return the ages [ns] of the frames of all sockets after the warm-up."""
    ages = array("q")
    with zmq.Context() as context:
        poller, first_ns = zmq.Poller(), 0
        for _ in range(sockets):
            socket = context.socket(zmq.SUB)
            socket.setsockopt(zmq.RCVHWM, 2)
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.SUBSCRIBE, b"")
            socket.connect(address)
            poller.register(socket, zmq.POLLIN)
        ready = poller.poll(round(_JOIN_S * 1e3))
        while ready:
            for socket, _ in ready:
                sent_ns = int.from_bytes(socket.recv()[:8], "little", signed=True)
                if sent_ns == _END:
                    context.destroy(linger=0)
                    return ages
                first_ns = first_ns or sent_ns
                if sent_ns - first_ns > WARM_UP_NS:
                    ages.append(time.monotonic_ns() - sent_ns)
            ready = poller.poll(round(_JOIN_S * 1e3))
        context.destroy(linger=0)
        return ages


def main(arguments: Sequence[str]) -> None:
    """Run one process of receivers and write the ages to standard output."""
    ages = _receive(arguments[0], int(arguments[1]))
    sys.stdout.buffer.write(ages.tobytes())


if __name__ == "__main__":
    main(sys.argv[1:])
