"""Sockets: one context of assets per process, whose I/O thread has a lower priority."""

from __future__ import annotations

import subprocess
import sys

import pytest

#: Threads of libzmq with a lower priority (proc_pid_stat(5), field 19); they set their names a moment after starting.
CODE = """
import os, time
from pathlib import Path
from iris_session.client.sockets import asset_context
from iris_session.system.priority import LOW_PRIORITY_NICE

def lower():
    stats = [(task / "stat").read_text().rpartition(")") for task in Path("/proc/self/task").iterdir()]
    return sum("ZMQbg/IO" in name and int(rest.split()[16]) == LOW_PRIORITY_NICE for name, _, rest in stats)

def check():
    assert lower() == 0
    assert asset_context() is asset_context()
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
