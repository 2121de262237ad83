"""Supervision of the recorder process by its parent: start, monitor, restart on the next part of the file, close."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import uuid
from pathlib import Path
from typing import Final

import msgspec
import psutil

from iris_session.journal.errors import RecorderError
from iris_session.journal.messages import FAULT_PREFIX, RecorderConfig
from iris_session.rrd.assets import NONE
from iris_session.rrd.paths import part_path
from iris_session.system.process import PIPE, ChildProcess

#: Signal by which a session tells its recorder to finish the file. SIGTERM may come from anybody.
FINISH_SIGNAL: Final = signal.SIGUSR1
#: Time limit of a start. It takes half a second on an idle machine.
START_S: Final = 60.0
#: Exit status of Python after an error that nothing has caught.
CRASHED: Final = 1
#: Maximum length [bytes] of the folder for temporary files; the rest is for our folder and socket names.
LONGEST_FOLDER: Final = 75


class RecorderProcess:
    """Recorder process of the file `path`, started by exec, listening on sockets in a private temporary folder.

    It runs in a session of its own, so that Ctrl-C of a terminal reaches only the parent. After it has ended, `restart`
    begins the next part (`session.part2.rrd`); the feed sends it everything that was not written.
    """

    def __init__(self, path: str | Path, origin_ns: int, *, record_assets: str = NONE, budget_bytes: int = 0) -> None:
        """Set what is recorded; nothing is started or written yet. See `RecorderConfig`."""
        self.path = str(path)
        self.part = 0
        self._origin_ns = origin_ns
        self._record_assets = record_assets
        self._budget_bytes = budget_bytes
        #: An error in drawing has ended a recorder: parts since then have no picture.
        self.journal_only = False
        # The path of a Unix socket has at most 107 bytes: some TMPDIR are too long for one.
        short = len(os.fsencode(tempfile.gettempdir())) <= LONGEST_FOLDER
        self._folder = tempfile.mkdtemp(prefix="iris-rec-", dir=None if short else "/tmp")
        self.feed_endpoint = f"ipc://{self._folder}/feed"
        self.samples_endpoint = f"ipc://{self._folder}/samples"
        self.media_endpoint = f"ipc://{self._folder}/media"
        self._log = Path(self._folder) / "recorder.log"
        self._recording_id = uuid.uuid4().hex
        self._process: ChildProcess | None = None
        self.starts = 0

    @property
    def part_path(self) -> str:
        """The newest file of the recording."""
        part = max(1, self.part)
        while os.path.exists(part_path(self.path, part + 1)):
            part += 1
        return part_path(self.path, part)

    @property
    def pid(self) -> int:
        """Process id of the recorder, 0 if none was started. May be read while another thread restarts it."""
        process = self._process
        return 0 if process is None else process.pid

    @property
    def alive(self) -> bool:
        """False before the start and after the process has ended. May be read from another thread, like `pid`."""
        process = self._process
        return process is not None and process.is_running

    @property
    def cpu_s(self) -> float:
        """CPU time of the process so far [s], 0 if it has ended: on a busy machine a slow recorder differs by this
        from one that hangs."""
        try:
            times = psutil.Process(self.pid).cpu_times()
        except psutil.Error:
            return 0.0
        return float(times.user + times.system)

    @property
    def failure(self) -> str:
        """One line describing how the process ended, empty while it runs and after a clean end."""
        if self._process is None or not (code := self._process.exit_status):
            return ""
        how = f"killed by signal {-code}" if code < 0 else f"exit status {code}"
        left_out = " (the next one leaves out the picture)" if code == CRASHED else ""
        return f"the recorder ended ({how}): {_reason(self._log) or 'no message'}{left_out}"

    def start(self) -> None:
        """Begin the recording and wait until the recorder writes.

        Raises `RecorderError`: permission denied, no space, or the file exists.
        """
        self.part = 1
        try:
            self._spawn()
        except RecorderError:
            self.close(0.0)
            raise
        answer = self._answer()
        if answer != "ready":
            self.close(0.0)
            raise RecorderError(answer.removeprefix("failed: "))

    def restart(self) -> None:
        """Begin the next part without waiting for it: check `alive` and `failure` later, as after a crash.

        After an error in our own code or Rerun's, which would come again, it writes only what verification needs.
        Raises `RecorderError` if the process or its log cannot be created; it may be tried again.
        """
        self.journal_only |= self._end(0.0) == CRASHED
        while os.path.exists(part_path(self.path, self.part)):
            self.part += 1
        self._spawn()

    def close(self, timeout_s: float = 10.0) -> bool:
        """Finish the file. Return whether the process ended cleanly by itself. Close feed and front before."""
        status = self._end(timeout_s)
        shutil.rmtree(self._folder, ignore_errors=True)
        return status == 0

    def _spawn(self) -> None:
        try:
            self._try_spawn()
        except OSError as error:
            raise RecorderError(f"the recorder cannot be started: {error.strerror or error}") from error

    def _try_spawn(self) -> None:
        config = RecorderConfig(
            self.path,
            self.part,
            self._recording_id,
            self.feed_endpoint,
            self.samples_endpoint,
            self._origin_ns,
            os.getpid(),
            self.media_endpoint,
            self._record_assets,
            self._budget_bytes,
            self.journal_only,
        )
        # RERUN=off in a user's shell would silence the stream. Nothing is drawn here: MuJoCo need not load OpenGL.
        environment = {"RERUN": "on", "RUST_LOG": "error", "MUJOCO_GL": "disable"}
        with open(self._log, "ab") as log:
            self._process = ChildProcess(
                "iris_session.recording.process",
                config=msgspec.msgpack.encode(config),
                stdout=PIPE,
                stderr=log,
                environment=environment,
                own_session=True,
            )
        self.starts += 1

    def _answer(self) -> str:
        """Return the first line on standard output: `ready`, or the error."""
        process = self._process
        assert process is not None
        try:
            return process.read_line(START_S).decode(errors="replace").strip()
        except TimeoutError:
            what = f"did not start within {START_S:g} s"
        except EOFError:
            what = "ended as it started"
        return f"the recorder {what}: {_reason(self._log) or 'no message'}"

    def _end(self, timeout_s: float) -> int:
        """End the process. Return its exit status, 0 if there was none."""
        process, self._process = self._process, None
        if process is None:
            return 0
        if timeout_s:
            process.send_signal(FINISH_SIGNAL)
        return process.close(exit_s=timeout_s)


def _reason(log: Path) -> str:
    """Return the recorder's last own line in its log, else the last line of the log."""
    try:
        lines = log.read_text(errors="replace").strip().splitlines()
    except OSError:
        return ""
    own = [line.removeprefix(FAULT_PREFIX) for line in lines if line.startswith(FAULT_PREFIX)]
    return (own or lines or [""])[-1][:300]
