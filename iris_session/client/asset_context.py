"""The ZeroMQ context of everything that this process fetches: its I/O thread has a lower priority than others, and the
hundreds of megabytes that pass through it do not delay state and control."""

from __future__ import annotations

import contextlib
import os
import threading
from typing import Final

import zmq

#: Added to the nice value of threads that fetch assets and look at them: a tenth of the weight. Not less, as those of
#: Python hold its lock for moments, and whoever polls then waits for them.
NICER: Final = 10

_lock = threading.Lock()
_context: tuple[int, zmq.Context[zmq.Socket[bytes]]] | None = None


def asset_context() -> zmq.Context[zmq.Socket[bytes]]:
    """One per process; a forked child gets its own."""
    with _lock:
        if _context is None or _context[0] != os.getpid():
            thread = threading.Thread(target=_make, name="iris-assets-open")
            thread.start()
            thread.join()
        assert _context is not None
        return _context[1]


def give_way() -> None:
    """Lowers the priority of the calling thread, where threads have one (Linux). It cannot be raised again."""
    with contextlib.suppress(OSError, AttributeError):
        nice = min(19, os.getpriority(os.PRIO_PROCESS, 0) + NICER)
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), nice)


def _make() -> None:
    """In a thread that ends: libzmq's threads are started with the first socket, and inherit its priority."""
    global _context  # noqa: PLW0603
    give_way()
    made: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    made.socket(zmq.DEALER).close(linger=0)
    _context = os.getpid(), made
