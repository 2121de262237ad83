"""`python -m iris_session.recording.probe`: says for each path on standard input whether Rerun can decode the file.

In a process of its own because Rerun's decoder may abort on damaged bytes. `Prober` is the other side.
"""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path
from types import TracebackType
from typing import Self


class Prober:
    """Asks a child process about files; a child that dies over one means that the file is not readable."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[str] | None = None

    def readable(self, path: str | Path) -> bool:
        """True when every message of the recording in `path` decodes."""
        child = self._child or subprocess.Popen(
            [sys.executable, "-m", "iris_session.recording.probe"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self._child = child
        assert child.stdin is not None
        assert child.stdout is not None
        child.stdin.write(f"{Path(path).absolute()}\n")
        child.stdin.flush()
        answer = child.stdout.readline().strip()
        if not answer:
            self._end()
        return answer == "yes"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def _end(self) -> None:
        child, self._child = self._child, None
        if child is None:
            return
        child.kill()
        child.wait()
        for stream in (child.stdin, child.stdout):
            if stream is not None:
                stream.close()


def _decodes(path: str) -> bool:
    from rerun.chunk import RrdReader

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a missing footer is normal: the recorder may have been killed
            for _ in RrdReader(path).stream():
                pass
    except BaseException:  # Rerun's panics are no `Exception`; this process has nothing else to do
        return False
    return True


def main() -> None:
    """Answers `yes` or `no`, a line per path, until the input ends."""
    for line in sys.stdin:
        print("yes" if _decodes(line.rstrip("\n")) else "no", flush=True)


if __name__ == "__main__":
    main()
