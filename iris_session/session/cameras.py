"""The cameras of a session: their files, a process for each, its key, restart, end.

A file that cannot be used ends the session before it starts; a process that fails is started again, announced, and
stops no step.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from iris_session.cloud.camera_file import CameraFileError, CloudSettings, load_camera_file
from iris_session.cloud.config import CameraReport, CameraStart
from iris_session.link import Ports
from iris_session.protocol.media import MAX_STREAMS
from iris_session.security import KeyPair
from iris_session.session.config import SessionConfig
from iris_session.session.errors import StartError
from iris_session.session.web_page import find_connect_host, load_server_key, needs_encryption
from iris_session.system.process import PIPE, ChildProcess
from iris_session.system.supervised import SupervisedProcess

SECOND: Final = 1_000_000_000
#: A process that has made a cloud and then does not report for this long is ended; it reports once a second. One that
#: starts is given longer.
HANG_NS: Final = 10 * SECOND
#: A silence that is reported.
SILENT_NS: Final = 3 * SECOND
#: A start that is reported: alone on a machine it takes a second or two, the first one ten.
SLOW_START_NS: Final = 10 * SECOND
#: Time for the processes to leave their devices at the end.
EXIT_S: Final = 1.0
#: Of the drops of a camera process, those that a session reports: frames that are replaced by newer ones, as at every
#: camera that is faster than its stream, are none.
REPORTED_DROPS: Final = frozenset({"send", "join", "pose", "unusable", "cells", "failed"})
_MODULE: Final = "iris_session.cloud.process"


class SessionCameras:
    """The camera processes of one session.

    Args:
        config: Settings of the session.

    Attributes:
        public_keys: Public keys (Z85) of the processes, which the front admits as cameras; none without encryption.

    Raises:
        StartError: A camera file cannot be used, or the files do not go together.
    """

    def __init__(self, config: SessionConfig) -> None:
        self._config = config
        self._settings = load_camera_files(config.cameras)
        encrypted = bool(self._settings) and needs_encryption(config)
        self._keys = [KeyPair.generate() if encrypted else None for _ in self._settings]
        self._processes: dict[str, SupervisedProcess[CameraReport]] = {}
        self._now_ns = 0
        self.public_keys = tuple(one.public for one in self._keys if one is not None)

    def start(self, ports: Ports) -> list[str]:
        """Let `poll` start the processes. Return notes for people about what they show.

        Args:
            ports: Of the front, which listens.
        """
        server_key = load_server_key(self._config) if self.public_keys else ""
        for settings, key in zip(self._settings, self._keys, strict=True):
            start = CameraStart(
                settings,
                find_connect_host(ports),
                ports.control,
                server_key,
                "" if key is None else key.public,
                "" if key is None else key.secret,
                os.getpid(),
            )
            title = f"the camera process of {settings.stream!r}"
            self._processes[settings.stream] = SupervisedProcess(
                title,
                partial(self._spawn, start),
                CameraReport,
                hang_ns=HANG_NS,
            )
        return [f"cameras: {', '.join(self._processes)}"] if self._processes else []

    def _spawn(self, start: CameraStart) -> ChildProcess:
        start = msgspec.structs.replace(start, known_fault=self._processes[start.settings.stream].fault)
        # Of a session of its own: Ctrl-C of a terminal reaches only the parent, and the scheduler groups it apart.
        return ChildProcess(_MODULE, config=msgspec.msgpack.encode(start), stdout=PIPE, own_session=True)

    def poll(self, now_ns: int) -> list[str]:
        """Start what was not started, and what has ended; return what is to be announced, a line each. Never waits."""
        self._now_ns = now_ns
        announcements = []
        for process in self._processes.values():
            if process.is_started:
                announcements += process.poll(now_ns)
            else:
                process.start(now_ns)
        return announcements

    def list_warnings(self) -> list[str]:
        """Return warnings for the status about processes that cannot say themselves what is wrong."""
        found = []
        for stream, process in self._processes.items():
            silent_ns, starts = self._now_ns - process.last_ns, process.is_starting
            if process.failure:
                found.append(process.failure)
            elif process.pid and silent_ns > (SLOW_START_NS if starts else SILENT_NS):
                state = "starts, which takes long on a busy machine" if starts else "hangs"
                limit_s = process.limit_ns // SECOND
                found.append(f"the camera process of {stream!r} {state}: it is ended after {limit_s} s")
            elif process.report.warning:
                found.append(f"cameras of {stream!r}: {process.report.warning}")
        return found

    @property
    def restarts(self) -> int:
        """Restarts of all processes."""
        return sum(process.restarts for process in self._processes.values())

    @property
    def pids(self) -> tuple[int, ...]:
        """Process ids of those that run."""
        return tuple(process.pid for process in self._processes.values() if process.pid)

    @property
    def drops(self) -> dict[str, int]:
        """Frames that were left out, by reason: those that were meant to be shown."""
        counts: Counter[str] = Counter()
        for process in self._processes.values():
            counts.update({f"camera_{reason}": n for reason, n in process.drops.items() if reason in REPORTED_DROPS})
        return dict(counts)

    def terminate(self) -> None:
        """Ask the processes to end, before `close` waits for them."""
        for process in self._processes.values():
            process.terminate()

    def close(self) -> None:
        """End the processes. May be called twice."""
        self.terminate()
        deadline_s = time.monotonic() + EXIT_S  # of all together
        for process in self._processes.values():
            process.close(max(0.0, deadline_s - time.monotonic()))
        self._processes.clear()


def load_camera_files(paths: Sequence[str | Path]) -> tuple[CloudSettings, ...]:
    """Read camera files that go together.

    Raises:
        StartError: One cannot be used, two have a stream of one name, or there are too many streams.
    """
    found: list[CloudSettings] = []
    owners: dict[str, str] = {}
    for path in paths:
        try:
            settings = load_camera_file(path)
        except CameraFileError as error:
            raise StartError(str(error)) from None
        for name in settings.list_streams():
            if name in owners:
                raise StartError(
                    f"two camera files have a stream {name!r}: {owners[name]} and {path}; give one of them another "
                    "`stream`"
                )
            owners[name] = str(path)
        found.append(settings)
    if len(owners) > MAX_STREAMS:
        raise StartError(
            f"the camera files have {len(owners)} streams, a session has at most {MAX_STREAMS}: with picture_hz = 0 a "
            "file has one"
        )
    return tuple(found)
