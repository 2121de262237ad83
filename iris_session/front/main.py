"""The front process: `python -m iris_session.front.main`, with `FrontStart` on standard input."""

from __future__ import annotations

import gc
import logging
import shutil
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Final

import msgspec

from iris_session.front.loop import ENDED, ORPHANED, Front
from iris_session.link.config import FrontError, FrontStart
from iris_session.link.sockets import fit_limits, raise_descriptor_limit
from iris_session.system.log import configure_logging
from iris_session.system.process import die_with_parent, is_parent, wait_for_parent_exit

log = logging.getLogger(__name__)

#: Longest time for which another thread (assets, estimates) keeps the loop from running, without more to wait for.
SWITCH_S: Final = 0.0005


def main() -> int:
    """Serve one session. The exit status is 1 if the front cannot start; the authority was notified over the link."""
    configure_logging()
    start = msgspec.msgpack.decode(sys.stdin.buffer.read(), type=FrontStart)
    limits = fit_limits(start.config.limits, raise_descriptor_limit())
    if limits is not start.config.limits:
        text = "few file descriptors (ulimit -n): at most %d subscribers, and %d connections that have said nothing"
        log.warning(text, limits.subscribers, limits.unauthenticated)
        start = msgspec.structs.replace(start, config=msgspec.structs.replace(start.config, limits=limits))
    sys.setswitchinterval(SWITCH_S)
    try:
        front = Front(start)
    except FrontError:
        return 1

    def on_signal(number: int, _frame: FrameType | None) -> None:
        if number != signal.SIGHUP:
            front.end(ENDED)
        elif not is_parent(start.parent_pid):
            front.end(ORPHANED)

    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, on_signal)
    die_with_parent(signal.SIGHUP)
    # All objects made so far live as long as the process; the loop collects the rest when it is idle.
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        front.run()
    finally:
        front.close()
        if (front.cut_off or front.ended == ORPHANED) and wait_for_parent_exit(start.parent_pid):
            # The parent was killed, so the folder of the link is removed here.
            shutil.rmtree(Path(start.link_endpoint.removeprefix("ipc://")).parent, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
