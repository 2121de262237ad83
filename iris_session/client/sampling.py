"""Making and sending samples: mixin of `Client` that fills in epochs, versions, fencing tokens and `seq`."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Iterable
from typing import Any

from anchors.pose import PoseTuple
from iris_session.client.connection import Connection
from iris_session.protocol.client_messages import ClientMessage, Sample
from iris_session.protocol.common import Alignment, Pose, Target
from iris_session.protocol.names import SampleKind


class Sampling:
    """Input of our devices."""

    connection: Connection
    _lock: threading.RLock
    _seq: dict[str, int]

    @abstractmethod
    def send(self, message: ClientMessage) -> bool: ...

    @abstractmethod
    def session_now_ns(self) -> int: ...

    @property
    @abstractmethod
    def alignment(self) -> Alignment | None: ...

    def send_sample(self, device: str, pose: PoseTuple | None = None, **fields: Any) -> bool:
        """Makes one sample of `device` with `make_sample` and sends it."""
        return self.send(self.make_sample(device, pose, **fields))

    def make_sample(
        self,
        device: str,
        pose: PoseTuple | None = None,
        *,
        robots: Iterable[str] = (),
        objects: Iterable[str] = (),
        kind: str = SampleKind.POSE,
        capture_ns: int | None = None,
        tracking_epoch: int | None = None,
        **fields: Any,
    ) -> Sample:
        """A sample of `device` as of now; epochs, versions, tokens and `seq` are filled in.

        `pose`: `T_tracking_device`. `robots`, `objects`: what it drives; those that are not ours are left out, so the
        sample is mere presence when none is. `capture_ns`: session time of capture, default now. `fields`: the other
        fields of `Sample` (`clutch`, `gripper`, `q`, `twist`, ...).
        """
        with self._lock:
            targets = [*self._targets(robots, "robot"), *self._targets(objects, "object")]
            seq = self._seq[device] = self._seq.get(device, 0) + 1
            alignment = self.alignment
            return Sample(
                device=device,
                kind=kind,
                seq=seq,
                capture_ns=self.session_now_ns() if capture_ns is None else capture_ns,
                scene_epoch=self.connection.mirror.scene_epoch,
                tracking_epoch=self.connection.tracking_epoch if tracking_epoch is None else tracking_epoch,
                alignment_version=0 if alignment is None else alignment.version,
                targets=tuple(targets),
                worn=fields.pop("worn", self.connection.worn),
                pose=None if pose is None else Pose(*pose),
                **fields,
            )

    def _targets(self, names: Iterable[str], kind: str) -> list[Target]:
        tokens = ((name, self.connection.lease_version(name)) for name in names)
        return [Target(name, token, kind) for name, token in tokens if token is not None]
