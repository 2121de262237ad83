"""What a session's own process gives to everybody beside the scene: media streams."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping

from iris_session.protocol.names import MediaEncoding
from iris_session.session.processes import SessionProcesses
from iris_session.session.stepper import Stepper


class Publishing:
    """Part of `Session`."""

    clock: Callable[[], int]
    _stepper: Stepper | None

    @abstractmethod
    def _live(self) -> SessionProcesses: ...

    def publish_media(
        self,
        stream: str,
        frames: bytes | Mapping[str, bytes],
        *,
        capture_ns: int | None = None,
        encoding: str = MediaEncoding.BYTES,
    ) -> bool:
        """Hands in the newest frame of a media stream, for every client that subscribed to it. From any thread.

        `frames`: its bytes, or bytes by class: `full`, and coarser ones as `half` and `quarter`. For a class that is
        not given, clients get every second or fourth frame of the next better one. `capture_ns`: session time of its
        capture, as of `session.clock()` (default: now). `encoding`: what the bytes are, for those who read them.

        False: the frame is dropped, because the front takes nothing now or the session is being closed. Raises
        `ValueError` for a name that no stream can have, or that of what bends in the scene, other classes, or more than
        8 MiB.
        """
        processes = self._live()
        if stream in processes.own_streams():
            raise ValueError(f"stream {stream!r} carries the vertices of a deformable of the scene: take another name")
        front = processes.front
        if front is None:  # the session is being closed
            return False
        last = None if self._stepper is None else self._stepper.last
        epoch = 0 if last is None else last.decision.scene_epoch
        return front.publish_media(stream, frames, self.clock() if capture_ns is None else capture_ns, epoch, encoding)
