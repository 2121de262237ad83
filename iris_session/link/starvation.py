"""Tells a process that hangs from one that gets no processor: only the first is worth replacing.

Its successor would get no processor either, take longer than the old one to answer, and cost everybody the connection.
Linux only; elsewhere, and for a process that is gone, nobody is starved.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

#: Of the time since the first look, a process that starves waited for a processor for at least so much.
_WAITED: Final = 0.5


class Starvation:
    """Whether the main thread of a process has been waiting for a processor since the first of some looks.

    `look` costs some 30 us: call it only when there is a reason. `clear` when the reason is gone.
    """

    def __init__(self) -> None:
        self._pid = 0
        self._first_ns = 0
        self._ran_ns = 0
        self._waited_ns = 0

    def clear(self) -> None:
        """The next look is the first."""
        self._pid = 0

    def look(self, pid: int, now_ns: int) -> bool:
        """True when it wants to run and mostly could not. The first look of a process only begins the count."""
        try:
            ran_ns, waited_ns = _times(pid)
            ready = _state(pid) == "R"
        except (OSError, ValueError, IndexError):
            return False
        if pid != self._pid:
            self._pid, self._first_ns, self._ran_ns, self._waited_ns = pid, now_ns, ran_ns, waited_ns
            return ready
        enough_ns = _WAITED * (now_ns - self._first_ns)
        # The kernel counts a wait when it ends: of one that goes on, only the state tells.
        return waited_ns - self._waited_ns >= enough_ns or (ready and ran_ns - self._ran_ns < enough_ns)


def _times(pid: int) -> tuple[int, int]:
    """Time on a processor and time ready without one [ns] (Documentation/scheduler/sched-stats.rst)."""
    ran, waited, _ = Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii").split()
    return int(ran), int(waited)


def _state(pid: int) -> str:
    """One letter (proc_pid_stat(5)): R running or ready, T stopped. It stands after the name, which holds anything."""
    return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[0]
