"""The recorder process from the side of its parent: start, monitor, restart on the next part of the file, close."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import uuid
from pathlib import Path
from typing import IO, Final

import msgspec
import psutil

from iris_session.journal.errors import RecorderError
from iris_session.journal.messages import FAULT_PREFIX, RecorderConfig, RecorderStatus
from iris_session.recording.budget import LOW_SHARE, describe_used_budget
from iris_session.rrd.assets import NONE
from iris_session.rrd.paths import part_path
from iris_session.system.process import PIPE, ChildProcess, open_memory_file
from iris_session.system.supervised import SHORT_RESTART_DELAYS_NS, NoReport, SupervisedProcess, describe_exit

#: Signal by which a session tells its recorder to finish the file. SIGTERM may come from anybody.
FINISH_SIGNAL: Final = signal.SIGUSR1
#: Time limit of a start. It takes half a second on an idle machine.
START_S: Final = 60.0
#: Exit status of Python after an error that nothing has caught.
CRASHED: Final = 1
#: Maximum length [bytes] of the folder for temporary files; the rest is for our folder and socket names.
LONGEST_FOLDER: Final = 75
#: Length of the recorder's own words that is read.
LOG_BYTES: Final = 1 << 20
#: A recorder reports twice a second. It is not ended when it hangs: a slow disk would delay its successor too.
HANGING_NS: Final = 5_000_000_000
#: Time at the end for a successor that is just being started: a process more, unless the disk hangs.
CLOSING_S: Final = 5.0


class RecorderProcess:
    """Recorder process of the file `path`, started by exec, listening on sockets in a private temporary folder.

    It runs in a session of its own, so that Ctrl-C of a terminal reaches only the parent. After it has ended, `poll`
    begins the next part (`session.part2.rrd`); the feed sends it everything that was not written. After an error in
    our own code or Rerun's, which would come again, that part has only what verification needs.

    Attributes:
        journal_only: An error in drawing has ended a recorder: parts since then have no picture.
        starts: How many were started.
        hangs: The recorder has not reported for `HANGING_NS` though it has something to write.
        is_used_up: The budget of the recording is used up: the file is closed, and nothing more is recorded.
        budget_text: One line for people once the budget comes to its end; empty before, and without a budget.
    """

    def __init__(self, path: str | Path, origin_ns: int, *, record_assets: str = NONE, budget_bytes: int = 0) -> None:
        """Set what is recorded; nothing is started or written yet. See `RecorderConfig`."""
        self.path = str(path)
        self.part = 1
        self._origin_ns = origin_ns
        self._record_assets = record_assets
        self._budget_bytes = budget_bytes
        self.journal_only = self.hangs = self.is_used_up = False
        self.budget_text = ""
        # The path of a Unix socket has at most 107 bytes: some TMPDIR are too long for one.
        short = len(os.fsencode(tempfile.gettempdir())) <= LONGEST_FOLDER
        self._folder = tempfile.mkdtemp(prefix="iris-rec-", dir=None if short else "/tmp")
        self.feed_endpoint = f"ipc://{self._folder}/feed"
        self.samples_endpoint = f"ipc://{self._folder}/samples"
        self.media_endpoint = f"ipc://{self._folder}/media"
        self._recording_id = uuid.uuid4().hex
        #: What the newest recorder says, in memory, so that reading it waits for no disk.
        self._log: IO[bytes] | None = None
        self.starts = 0
        self._supervised = SupervisedProcess(
            "the recorder",
            self._spawn,
            NoReport,
            delays_ns=SHORT_RESTART_DELAYS_NS,
            describe_exit=self._note_exit,
        )

    @property
    def part_path(self) -> str:
        """The newest file of the recording."""
        part = self.part
        while os.path.exists(part_path(self.path, part + 1)):
            part += 1
        return part_path(self.path, part)

    @property
    def pid(self) -> int:
        """Process id of the recorder, 0 while there is none. From any thread."""
        return self._supervised.pid

    @property
    def alive(self) -> bool:
        """False before the start and after the process has ended. From any thread."""
        return bool(self.pid)

    @property
    def restarts(self) -> int:
        """Number of restarts."""
        return self._supervised.restarts

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
        """One line about why it has ended, or why one after the other has; empty while it runs."""
        process = self._supervised.process
        status = None if process is None else process.exit_status
        if self.is_used_up:
            return ""
        return f"the recorder {self._describe_exit(status)}" if status else self._supervised.failure

    def start(self) -> None:
        """Begin the recording and wait until the recorder writes.

        Raises `RecorderError`: permission denied, no space, or the file exists.
        """
        try:
            process = self._supervised.start_now()
        except OSError as error:
            self.close(0.0)
            raise RecorderError(f"the recorder cannot be started: {error.strerror or error}") from error
        try:
            answer = process.read_line(START_S).decode(errors="replace").strip()
        except TimeoutError:
            answer = f"the recorder did not start within {START_S:g} s: {self._read_reason()}"
        except EOFError:
            answer = f"the recorder ended as it started: {self._read_reason()}"
        if answer != "ready":
            self.close(0.0)
            raise RecorderError(answer.removeprefix("failed: "))

    def poll(self, now_ns: int, silence_ns: int = 0, status: RecorderStatus | None = None) -> list[str]:
        """Begin the next part when the recorder has ended. Never waits.

        Args:
            now_ns: Session time.
            silence_ns: How long it has not reported though it has something to write.
            status: Its last report. One that has used up the budget is not restarted.

        Returns:
            What is to be announced, one line each.
        """
        announcements = [] if status is None or not status.budget or self.is_used_up else self._watch_budget(status)
        if self.is_used_up:
            self.hangs = False
            return announcements
        announcements += self._supervised.poll(now_ns)
        hangs = silence_ns > HANGING_NS
        if hangs and not self.hangs:
            announcements.append("the recorder hangs: its rows wait in memory")
        self.hangs = hangs
        return announcements

    def _watch_budget(self, status: RecorderStatus) -> list[str]:
        """Return the announcement that the budget comes to its end, or is used up, once each."""
        if status.ended:
            self.is_used_up = True
            self.budget_text = describe_used_budget(status.budget)
            return [f"{self.budget_text}; the session goes on without it"]
        if status.budget_left >= LOW_SHARE * status.budget:
            return []
        is_new = not self.budget_text
        left = f"{status.budget_left / 1e6:,.1f} of {status.budget / 1e6:,.0f} MB"
        self.budget_text = f"{left} are left of the recording's budget"
        rest = "what the journal does not need is left out first, then the recording ends"
        return [f"{self.budget_text}: {rest}"] if is_new else []

    def list_warnings(self) -> list[str]:
        """Return the warning for status reports about the budget, if there is one."""
        return [self.budget_text] if self.budget_text else []

    def stop_restarts(self) -> None:
        """Begin no further part: the recorder that runs writes what is left."""
        self._supervised.stop_restarts(CLOSING_S)

    def close(self, timeout_s: float = 10.0) -> bool:
        """Finish the file. Return whether the process ended cleanly by itself. Close feed and front before."""
        status = self._supervised.close(0.0, exit_s=timeout_s, finish=FINISH_SIGNAL if timeout_s else 0)
        shutil.rmtree(self._folder, ignore_errors=True)
        if self._log is not None:
            self._log.close()
            self._log = None
        return status == 0

    def _spawn(self) -> ChildProcess:
        while self.starts and os.path.exists(part_path(self.path, self.part)):
            self.part += 1
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
        if self._log is not None:
            self._log.close()
        self._log = open_memory_file()
        process = ChildProcess(
            "iris_session.recording.process",
            config=msgspec.msgpack.encode(config),
            stdout=PIPE,
            stderr=self._log,
            environment=environment,
            own_session=True,
        )
        self.starts += 1
        return process

    def _note_exit(self, status: int) -> str:
        self.journal_only |= status == CRASHED
        return self._describe_exit(status)

    def _describe_exit(self, status: int) -> str:
        left_out = " (the next one leaves out the picture)" if status == CRASHED else ""
        return f"{describe_exit(status)}: {self._read_reason()}{left_out}"

    def _read_reason(self) -> str:
        """Return the recorder's last own line in its log, else the last line of the log."""
        data = b""
        if self._log is not None:
            log = self._log.fileno()
            data = os.pread(log, LOG_BYTES, max(0, os.fstat(log).st_size - LOG_BYTES))
        lines = data.decode(errors="replace").strip().splitlines()
        own = [line.removeprefix(FAULT_PREFIX) for line in lines if line.startswith(FAULT_PREFIX)]
        return (own or lines or ["no message"])[-1][:300]
