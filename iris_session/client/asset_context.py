"""The ZeroMQ context of everything that this process fetches: its I/O thread has a lower priority than others, and the
hundreds of megabytes that pass through it do not delay state and control."""

from __future__ import annotations

import os
import threading

import zmq

from iris_session.system.priority import run_at_low_priority

_lock = threading.Lock()
_context: tuple[int, zmq.Context[zmq.Socket[bytes]]] | None = None


def asset_context() -> zmq.Context[zmq.Socket[bytes]]:
    """One per process; a forked child gets its own."""
    global _context  # noqa: PLW0603
    with _lock:
        if _context is None or _context[0] != os.getpid():
            _context = os.getpid(), run_at_low_priority(_opened)
        return _context[1]


def _opened() -> zmq.Context[zmq.Socket[bytes]]:
    made: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    made.socket(zmq.DEALER).close(linger=0)  # with the first socket libzmq starts its threads
    return made
