"""Child processes that run a module of this package: start, configure, read, stop, and die with their parent.

`python -m` puts the working folder before everything else on the module path, so a `queue.py` or `zmq.py` of the user
there would be taken for the real one. A child searches only the Python installation, the user's PYTHONPATH, and the
folder of this package.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Final, Self

if TYPE_CHECKING:
    from importlib.metadata import Distribution

#: The folder that `iris_session` and `anchors` lie in.
ROOT: Final = Path(__file__).resolve().parents[2]
PIPE: Final = subprocess.PIPE
DEVNULL: Final = subprocess.DEVNULL
_DISTRIBUTION: Final = "iris-session"
_READ_BYTES: Final = 65536
_PR_SET_PDEATHSIG: Final = 1  # linux/prctl.h


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command line that runs a module with this interpreter, safe against files of the working folder."""
    return [sys.executable, "-P", "-m", module, *arguments]


def child_environment(**extra: str) -> dict[str, str]:
    """Return this process's environment with `extra`, for use with `module_command`.

    A package in a checkout that is not installed is found by PYTHONPATH. An empty part of PYTHONPATH means the working
    folder; it is left out, since `export PYTHONPATH=$PYTHONPATH:...` makes one unintentionally.
    """
    folders = [folder for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep) if folder]
    if not _is_installed():
        folders.insert(0, str(ROOT))
    path = {"PYTHONPATH": os.pathsep.join(folders)} if folders else {}
    rest = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return {**rest, **path, **extra}


@cache
def _is_installed() -> bool:
    """Return whether every process of this interpreter finds this very package."""
    import site
    from importlib import metadata  # imported here: it takes as long as all else in this module

    folders = [*site.getsitepackages(), site.getusersitepackages()]
    if any(Path(folder).resolve() == ROOT for folder in folders):
        return True
    return any(_is_editable_here(found) for found in metadata.distributions(name=_DISTRIBUTION))


def _is_editable_here(found: Distribution) -> bool:
    """Return whether this is an editable installation of the checkout that runs (PEP 610)."""
    import json

    origin = json.loads(found.read_text("direct_url.json") or "{}")
    return bool(origin.get("dir_info", {}).get("editable")) and origin.get("url") == ROOT.as_uri()


def take_stdout() -> int:
    """Return a descriptor of standard output for this process's own lines; what libraries print there goes to standard
    error from now on.
    """
    sys.stdout.flush()
    own = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return own


def open_memory_file() -> IO[bytes]:
    """Open a file without a name. Outside of Linux it lies on disk."""
    if not hasattr(os, "memfd_create"):
        return tempfile.TemporaryFile()
    fd = os.memfd_create("iris-session")
    os.fchmod(fd, 0o600)  # by default everybody may open it
    return os.fdopen(fd, "w+b")


class ChildProcess:
    """A process that runs a module of this package.

        child = ChildProcess("iris_session.front.main", config=encoded, own_session=True)
        ...
        child.close(exit_s=2.0, terminate_s=0.2)

    `pid`, `is_running` and `exit_status` may be used from any thread, the rest from one at a time.

    Attributes:
        inherited: Descriptors of the parent that the child keeps, under the same numbers; set by subclasses.
    """

    inherited: Sequence[int] = ()

    def __init__(
        self,
        module: str,
        arguments: Sequence[str] = (),
        *,
        config: bytes | None = None,
        stdout: int | IO[Any] | None = None,
        stderr: int | IO[Any] | None = None,
        environment: Mapping[str, str] | None = None,
        own_session: bool = False,
        own_group: bool = False,
    ) -> None:
        """Start the process.

        Args:
            module: Name of the module to run, as for `python -m`.
            arguments: Its command line arguments.
            config: Content of its standard input, as a file in memory: unlike a pipe, it holds any size, so the parent
                never waits for a child that does not read, and unlike a file on disk, it needs no free space there.
                `None` makes a pipe, for `write`.
            stdout: `PIPE` to read lines, an open file, or `None` to share the parent's.
            stderr: As `stdout`, or `DEVNULL`.
            environment: Variables beside those of this process.
            own_session: Run in a session of its own, so that Ctrl-C of a terminal reaches only the parent.
            own_group: Run in a process group of its own, for the same. The scheduler groups by session, not by this.

        Raises:
            OSError: No process or memory can be had.
        """
        with nullcontext() if config is None else open_memory_file() as file:
            if file is not None and config is not None:
                file.write(config)
                file.seek(0)
            self._process = subprocess.Popen(
                module_command(module, *arguments),
                stdin=PIPE if file is None else file,
                stdout=stdout,
                stderr=stderr,
                env=child_environment(**(environment or {})),
                start_new_session=own_session,
                process_group=0 if own_group else None,
                pass_fds=tuple(self.inherited),
                bufsize=0,
            )
        self._rest = b""

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    @property
    def exit_status(self) -> int | None:
        """Exit status, negative signal number, or `None` while the process runs."""
        return self._process.poll()

    @property
    def stdin_fd(self) -> int:
        """Descriptor of the pipe to its standard input."""
        assert self._process.stdin is not None, "standard input is no pipe"
        return self._process.stdin.fileno()

    def write(self, data: bytes) -> None:
        """Write to standard input, waiting until the pipe takes it. Raises `OSError` when the child closed it."""
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(self.stdin_fd, rest) :]

    def close_stdin(self) -> None:
        """Close the pipe to standard input: the child reads the end of its input."""
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):
                self._process.stdin.close()

    def read_line(self, timeout_s: float | None = None) -> bytes:
        """Return the next line of standard output without its end.

        Raises:
            EOFError: The child closed its standard output before the end of a line.
            TimeoutError: No line within `timeout_s` seconds; what came of it stays for the next call.
        """
        fd = self._stdout_fd()
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        ready = select.poll()  # `select.select` takes no descriptor above 1023
        ready.register(fd, select.POLLIN)
        while b"\n" not in self._rest:
            left_ms = None if deadline is None else max(0.0, deadline - time.monotonic()) * 1e3
            if not ready.poll(left_ms):
                raise TimeoutError(f"process {self.pid} wrote no line within {timeout_s:g} s")
            data = os.read(fd, _READ_BYTES)
            if not data:
                raise EOFError(f"process {self.pid} closed its standard output")
            self._rest += data
        line, _, self._rest = self._rest.partition(b"\n")
        return line

    def read_available_lines(self) -> list[bytes]:
        """Return the lines of standard output that are complete by now, without waiting."""
        if self._process.stdout is None or self._process.stdout.closed:
            return []
        fd = self._stdout_fd()
        ready = select.poll()
        ready.register(fd, select.POLLIN)
        while ready.poll(0) and (data := os.read(fd, _READ_BYTES)):
            self._rest += data
        *lines, self._rest = self._rest.split(b"\n")
        return lines

    def read_stderr(self) -> str:
        """Return the rest of standard error, waiting for its end."""
        assert self._process.stderr is not None, "standard error is no pipe"
        text: bytes = self._process.stderr.read()
        return text.decode(errors="replace")

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait for the end; return the exit status, `None` when the process still runs after `timeout_s` seconds."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def send_signal(self, number: int) -> None:
        """Send a signal, unless the process has ended."""
        self._process.send_signal(number)

    def kill(self) -> int:
        """Kill the process and wait for its end."""
        self._process.kill()
        return self._process.wait()

    def stop(self, *, exit_s: float = 0.0, terminate_s: float = 0.0) -> int:
        """End the process and return its exit status. Output stays readable until `close`.

        Args:
            exit_s: Seconds to wait for the process to exit by itself, after its standard input was closed.
            terminate_s: Seconds to wait after SIGTERM before the process is killed; 0 kills at once.
        """
        self.close_stdin()
        if (status := self.wait(exit_s)) is not None:
            return status
        if terminate_s:
            self._process.terminate()
            if (status := self.wait(terminate_s)) is not None:
                return status
        return self.kill()

    def close(self, *, exit_s: float = 0.0, terminate_s: float = 0.0) -> int:
        """End the process as `stop` does, and close its pipes. May be called twice."""
        status = self.stop(exit_s=exit_s, terminate_s=terminate_s)
        for pipe in (self._process.stdout, self._process.stderr):
            if pipe is not None:
                pipe.close()
        return status

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _stdout_fd(self) -> int:
        assert self._process.stdout is not None, "standard output is no pipe"
        return self._process.stdout.fileno()


def is_parent(pid: int) -> bool:
    """Return whether the process `pid`, which started this one, still exists."""
    return os.getppid() == pid


def wait_for_parent_exit(pid: int, timeout_s: float = 0.5) -> bool:
    """Return whether the parent exits within `timeout_s` seconds: a killed one closes its sockets before it ends."""
    deadline = time.monotonic() + timeout_s
    while is_parent(pid) and time.monotonic() < deadline:
        time.sleep(0.01)
    return not is_parent(pid)


def die_with_parent(number: signal.Signals) -> None:
    """Ask the kernel (Linux) to send this process signal `number` when its parent dies.

    The kernel means the *thread* that started this process, so the handler has to check `is_parent`. On other systems
    the parent can only be polled.
    """
    if sys.platform != "linux":
        return
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_PDEATHSIG, int(number), 0, 0, 0)
