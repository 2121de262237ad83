"""Sockets: one context of assets per process, whose I/O thread has a lower priority."""

from __future__ import annotations

import subprocess
import sys

import pytest
import zmq

from iris_session.client import sockets
from iris_session.security import KeyPair

#: Threads of libzmq with a lower priority (proc_pid_stat(5), field 19); they set their names a moment after starting.
CODE = """
import os, time
from contextlib import suppress
from pathlib import Path
from iris_session.client.sockets import bulk_context
from iris_session.system.priority import LOW_PRIORITY_NICE

EXPECTED = min(19, os.getpriority(os.PRIO_PROCESS, 0) + LOW_PRIORITY_NICE)

def lower():
    found = 0
    for task in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError, FileNotFoundError):  # a thread that has just ended
            name, _, rest = (task / "stat").read_text().rpartition(")")
            found += "ZMQbg/IO" in name and int(rest.split()[16]) == EXPECTED
    return found

def check():
    assert lower() == 0
    assert bulk_context() is bulk_context()
    end = time.monotonic() + 30
    while lower() != 1:
        assert time.monotonic() < end
        time.sleep(0.001)

check()
child = os.fork()
if not child:
    check()
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
"""


@pytest.mark.skipif(sys.platform != "linux", reason="threads have a priority on Linux only")
def test_asset_thread_has_a_lower_priority_in_every_process() -> None:
    subprocess.run([sys.executable, "-c", CODE], check=True, timeout=90)


@pytest.mark.parametrize(("host", "ipv6"), [("10.0.0.1", 0), ("::1", 1), ("fe80::1%eth0", 1)])
def test_sockets_to_a_session_have_the_same_settings(host: str, ipv6: int) -> None:
    session, own = KeyPair.generate(), KeyPair.generate()
    curve = sockets.CurveKeys(session.public.encode(), own.public.encode(), own.secret.encode())
    with zmq.Context() as context, sockets.open_socket(context, zmq.DEALER, host, curve) as sock:
        assert sock.getsockopt(zmq.IPV6) == ipv6
        assert sock.getsockopt(zmq.MAXMSGSIZE) == sockets.MAX_MESSAGE_BYTES
        assert (sock.getsockopt(zmq.TCP_KEEPALIVE), sock.getsockopt(zmq.RECONNECT_IVL_MAX)) == (1, 500)
        assert sock.getsockopt(zmq.MECHANISM) == zmq.CURVE
    with zmq.Context() as context, sockets.open_socket(context, zmq.SUB, host, None) as sock:
        assert sock.getsockopt(zmq.MECHANISM) == zmq.NULL
