"""Child process that tests what Rerun can read of a file: `python -m iris_session.recording.probe`.

It is a process of its own because Rerun's decoder may abort on damaged bytes. `Prober` is the parent's side. A question
is a line of JSON on standard input (file names may hold any character): the kind of question and the path. Importing
Rerun takes longer than reading most files, so a child that has answered stays for the next `Prober`, for `IDLE_S`.
"""

from __future__ import annotations

import atexit
import json
import math
import os
import resource
import select
import sys
import time
import warnings
from contextlib import suppress
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Final, Self

from iris_session.system.process import DEVNULL, PIPE, ChildProcess

READABLE: Final = "readable"
RECORDINGS: Final = "recordings"
#: Address space for reading a file: as much, and a multiple of the size of the file [bytes].
MEMORY_BYTES: Final = 2 << 30
MEMORY_TIMES: Final = 4
#: Processor time for reading a file: as much [s], and the time at this speed, a twentieth of the usual one [bytes/s].
CPU_S: Final = 30.0
CPU_BYTES_PER_S: Final = 1e6
#: A child without a question for this long ends.
IDLE_S: Final = 5.0


class _Child:
    """The child process that answers questions."""

    def __init__(self) -> None:
        self._process = ChildProcess("iris_session.recording.probe", stdout=PIPE, stderr=DEVNULL)

    def ask(self, what: str, path: str | Path) -> str:
        """Return the answer; empty if the child has died, from this question or before."""
        with suppress(BrokenPipeError, EOFError):
            self._process.write(json.dumps([what, str(Path(path).absolute())]).encode() + b"\n")
            return self._process.read_line().decode().strip()
        return ""

    def end(self) -> None:
        self._process.close()


class _Spare:
    """Holder of at most one idle child for the next `Prober` of this process."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._child: _Child | None = None

    def pop_child(self) -> _Child | None:
        with self._lock:
            child, self._child = self._child, None
        return child

    def put_child(self, child: _Child) -> None:
        with self._lock:
            before, self._child = self._child, child
        if before is not None:
            before.end()

    def end(self) -> None:
        child = self.pop_child()
        if child is not None:
            child.end()

    def forget_child(self) -> None:
        """Discard the child in a fork of this process: a child answers only the process that started it."""
        self._lock, self._child = Lock(), None


_spare: Final = _Spare()
atexit.register(_spare.end)
os.register_at_fork(after_in_child=_spare.forget_child)


class Prober:
    """Ask a child process about files; if the child dies from a file, the file is not readable."""

    def __init__(self) -> None:
        self._child: _Child | None = None

    def is_readable(self, path: str | Path) -> bool:
        """Return whether every message of the first recording in `path` decodes."""
        return self._asked(READABLE, path) > 0

    def count_recordings(self, path: str | Path) -> int:
        """Return the number of recordings in `path`, 0 if unknown. Quick only for a file with an index."""
        return self._asked(RECORDINGS, path)

    def _asked(self, what: str, path: str | Path) -> int:
        earlier, self._child = self._child or _spare.pop_child(), None
        if earlier is not None:
            answer = earlier.ask(what, path)
            if answer:
                self._child = earlier
                return int(answer)
            earlier.end()  # died from this file, or ended before as idle: a new child decides
        child = _Child()
        answer = child.ask(what, path)
        if answer:
            self._child = child
        else:
            child.end()
        return int(answer or 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        child, self._child = self._child, None
        if child is not None and error is None:
            _spare.put_child(child)
        elif child is not None:  # it may still be writing an unread answer
            child.end()


def _bound(path: str) -> None:
    """Bound memory and processor time of the next answer: damaged messages may claim any size when decompressed.

    Beyond a bound this process dies, and the file is not readable. Systems without /proc have no bounds.
    """
    with suppress(OSError, ValueError, AttributeError):
        size = os.path.getsize(path)
        with open("/proc/self/statm", "rb") as file:
            used = int(file.read().split()[0]) * resource.getpagesize()
        memory = used + MEMORY_BYTES + MEMORY_TIMES * size
        cpu_s = math.ceil(time.process_time() + CPU_S + size / CPU_BYTES_PER_S)
        for kind, bound in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, cpu_s)):
            hard = resource.getrlimit(kind)[1]
            resource.setrlimit(kind, (bound if hard == resource.RLIM_INFINITY else min(bound, hard), hard))


def _answer(what: str, path: str) -> int:
    from rerun.chunk import RrdReader

    _bound(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a missing footer is normal: the recorder may have been killed
            if what == RECORDINGS:
                return len(RrdReader(path).recordings())
            for _ in RrdReader(path).stream():
                pass
    except BaseException:  # Rerun's panics are not an `Exception`; this process has no other task
        return 0
    return 1


def main() -> None:
    """Answer each question with a number on a line, until the input ends or is idle for `IDLE_S`."""
    asked = select.poll()
    asked.register(sys.stdin, select.POLLIN)
    while asked.poll(IDLE_S * 1e3) and (line := sys.stdin.readline()):
        print(_answer(*json.loads(line)), flush=True)


if __name__ == "__main__":
    main()
