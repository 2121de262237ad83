"""The cameras of a session: their files and those of its model, processes, their keys, restart, end.

A camera file has a process of its own, all cameras of the model have one together. A file or a name that cannot be used
ends the session before it starts; a process that fails is started again, announced, and stops no step.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import msgspec
import mujoco

from iris_session.cloud.camera_file import CameraFileError, CloudSettings, load_camera_file
from iris_session.cloud.config import CameraReport, CameraStart, ProcessStart
from iris_session.cloud.model_camera import ModelCamera, PicturesStart, parse_model_camera
from iris_session.journal.rows import pack_model
from iris_session.link import Ports
from iris_session.physics.load import encode_model
from iris_session.protocol.media import MAX_STREAMS
from iris_session.security import KeyPair
from iris_session.session.config import SessionConfig
from iris_session.session.errors import StartError
from iris_session.session.web_page import find_connect_host, load_server_key, needs_encryption
from iris_session.system.extras import MissingExtraError, require_package
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
_PICTURES: Final = "model"


class SessionCameras:
    """The camera processes of one session. `model`: `None` for a world that MuJoCo does not simulate.

    Attributes:
        public_keys: Public keys (Z85) of the processes, which the front admits as cameras; none without encryption.

    Raises:
        StartError: A camera file cannot be used, the files do not go together, or the model lacks a camera.
    """

    def __init__(self, config: SessionConfig, model: mujoco.MjModel | None = None) -> None:
        self._config = config
        self._settings = load_camera_files(config.cameras)
        self._pictures = find_model_cameras(config.pictures, model, self._settings)
        self._model = model
        n = len(self._settings) + bool(self._pictures)
        self._keys = [KeyPair.generate() if needs_encryption(config) else None for _ in range(n)]
        self._processes: dict[str, SupervisedProcess[CameraReport]] = {}
        self._ending: list[SupervisedProcess[CameraReport]] = []  # of models that were replaced
        self._ports: Ports | None = None
        self._now_ns = 0
        self.public_keys = tuple(one.public for one in self._keys if one is not None)

    def start(self, ports: Ports) -> list[str]:
        """Let `poll` start the processes, with the front at `ports`. Return notes for people about what they show."""
        self._ports = ports
        for settings, key in zip(self._settings, self._keys, strict=False):
            start = CameraStart(**self._join(ports, key), settings=settings)
            self._add(
                settings.stream, f"the camera process of {settings.stream!r}", "iris_session.cloud.process", start
            )
        if self._pictures and self._model is not None:
            self._add_pictures(ports, pack_model(bytes(encode_model(self._model))))
        return [f"cameras: {', '.join(self._processes)}"] if self._processes else []

    def follow_model(self, packed_model: bytes) -> None:
        """Draw another model from now on, that of a scene that was loaded; what it lacks is a warning. Never waits."""
        old = self._processes.pop(_PICTURES, None)
        if old is not None and self._ports is not None:
            old.terminate()
            self._ending.append(old)
            self._add_pictures(self._ports, packed_model)

    def _join(self, ports: Ports, key: KeyPair | None) -> dict[str, Any]:
        """Return what a process needs to join the session."""
        keys = {} if key is None else {"public_key": key.public, "secret_key": key.secret}
        server_key = load_server_key(self._config) if keys else ""
        return {
            "host": find_connect_host(ports),
            "control_port": ports.control,
            "parent_pid": os.getpid(),
            "server_key": server_key,
            **keys,
        }

    def _add_pictures(self, ports: Ports, packed_model: bytes) -> None:
        start = PicturesStart(
            **self._join(ports, self._keys[-1]),
            cameras=self._pictures,
            packed_model=packed_model,
            plain=self._config.plain_pictures,
        )
        self._add(_PICTURES, "the process of pictures of the model", "iris_session.cameras.process", start)

    def _add(self, name: str, title: str, module: str, start: ProcessStart) -> None:
        spawn = partial(self._spawn, name, module, start)
        self._processes[name] = SupervisedProcess(title, spawn, CameraReport, hang_ns=HANG_NS)

    def _spawn(self, name: str, module: str, start: ProcessStart) -> ChildProcess:
        start = msgspec.structs.replace(start, known_fault=self._processes[name].fault)
        # Of a session of its own: Ctrl-C of a terminal reaches only the parent, and the scheduler groups it apart.
        return ChildProcess(module, config=msgspec.msgpack.encode(start), stdout=PIPE, own_session=True)

    def poll(self, now_ns: int) -> list[str]:
        """Start what was not started, and what has ended; return what is to be announced, a line each. Never waits."""
        self._now_ns = now_ns
        announcements = []
        for old in [one for one in self._ending if not one.pid]:
            old.close(0.0)
            self._ending.remove(old)
        for name, process in self._processes.items():
            if process.is_started:
                announcements += process.poll(now_ns)
            elif name != _PICTURES or not self._ending:  # the one before has their streams
                process.start(now_ns)
        return announcements

    def list_warnings(self) -> list[str]:
        """Return warnings for the status about processes that cannot say themselves what is wrong."""
        found = []
        for process in self._processes.values():
            silent_ns, starts = self._now_ns - process.last_ns, process.is_starting
            if process.failure:
                found.append(process.failure)
            elif process.pid and silent_ns > (SLOW_START_NS if starts else SILENT_NS):
                state = "starts, which takes long on a busy machine" if starts else "hangs"
                limit_s = process.limit_ns // SECOND
                found.append(f"{process.title} {state}: it is ended after {limit_s} s")
            elif process.report.warning:
                found.append(f"{process.title}: {process.report.warning}")
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
        for process in (*self._processes.values(), *self._ending):
            process.terminate()

    def close(self) -> None:
        """End the processes. May be called twice."""
        self.terminate()
        deadline_s = time.monotonic() + EXIT_S  # of all together
        for process in (*self._processes.values(), *self._ending):
            process.close(max(0.0, deadline_s - time.monotonic()))
        self._processes.clear()
        self._ending.clear()


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


def find_model_cameras(
    texts: Sequence[str], model: mujoco.MjModel | None, files: Sequence[CloudSettings] = ()
) -> tuple[ModelCamera, ...]:
    """Return the cameras of a model whose pictures are wanted, as `SessionConfig.pictures` names them.

    Raises:
        StartError: The model has no such camera, two have one name, another stream has it, or Pillow is missing.
    """
    cameras = tuple(map(parse_model_camera, texts))
    if not cameras:
        return ()
    if model is None:
        raise StartError("pictures are drawn of a MuJoCo model: this world has none")
    try:
        require_package("PIL", "pictures of the model's cameras")
    except MissingExtraError as error:
        raise StartError(str(error)) from None
    there_are = [model.camera(i).name for i in range(model.ncam)]
    taken = {name for settings in files for name in settings.list_streams()}
    if len(cameras) + len(taken) > MAX_STREAMS:
        raise StartError(f"{len(cameras) + len(taken)} streams of cameras, a session has at most {MAX_STREAMS}")
    for one in cameras:
        if one.camera not in there_are:
            known = ", ".join(filter(None, there_are)) or "none with a name"
            raise StartError(f"the model has no camera {one.camera!r}: it has {known}")
        if one.stream in taken:
            raise StartError(f"two cameras have a stream {one.stream!r}: give each once, and other names in the files")
        taken.add(one.stream)
    return cameras
