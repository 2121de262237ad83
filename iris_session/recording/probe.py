"""`python -m iris_session.recording.probe`: says for each question on standard input what Rerun can read of a file.

In a process of its own because Rerun's decoder may abort on damaged bytes. `Prober` is the other side. A question is
a line of JSON, since names of files may hold anything: what is asked, and the path.
"""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from iris_session.system import children

READABLE: Final = "readable"
RECORDINGS: Final = "recordings"


class Prober:
    """Asks a child process about files; a child that dies over one means that the file is not readable."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[str] | None = None

    def readable(self, path: str | Path) -> bool:
        """True when every message of the first recording in `path` decodes."""
        return self._asked(READABLE, path) > 0

    def recordings(self, path: str | Path) -> int:
        """How many recordings are in `path`, 0 when that cannot be told. Quick only for a file with an index."""
        return self._asked(RECORDINGS, path)

    def _asked(self, what: str, path: str | Path) -> int:
        child = self._child or subprocess.Popen(
            children.command("iris_session.recording.probe"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=children.environment(),
            text=True,
        )
        self._child = child
        assert child.stdin is not None
        assert child.stdout is not None
        answer = ""
        with suppress(BrokenPipeError):  # it has died since the last question
            child.stdin.write(json.dumps([what, str(Path(path).absolute())]) + "\n")
            child.stdin.flush()
            answer = child.stdout.readline().strip()
        if not answer:
            self._end()
        return int(answer or 0)

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
                with suppress(BrokenPipeError):  # a question that it did not take
                    stream.close()


def _answer(what: str, path: str) -> int:
    from rerun.chunk import RrdReader

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a missing footer is normal: the recorder may have been killed
            if what == RECORDINGS:
                return len(RrdReader(path).recordings())
            for _ in RrdReader(path).stream():
                pass
    except BaseException:  # Rerun's panics are no `Exception`; this process has nothing else to do
        return 0
    return 1


def main() -> None:
    """Answers with a number, a line per question, until the input ends."""
    for line in sys.stdin:
        print(_answer(*json.loads(line)), flush=True)


if __name__ == "__main__":
    main()
