"""Making and sending samples: mixin of `Client` that fills in epochs, versions, fencing tokens and `seq`."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Iterable
from typing import Any, Final

from iris_session.client.arguments import PoseLike, to_names, to_numbers, to_python_scalar, to_pose
from iris_session.client.core.connection import ClientConnection
from iris_session.client.errors import InvalidMessageError
from iris_session.protocol.client_messages import ClientMessage, Sample, Samples
from iris_session.protocol.common import Alignment, Target
from iris_session.protocol.names import SampleKind, TargetKind

#: Fields of `Sample` that are lists of numbers, and how many.
ARRAYS: Final[dict[str, int | None]] = {"q": None, "qd": None, "hand_joints": None, "twist": 6}


class Sampling:
    """Input of our devices."""

    connection: ClientConnection
    _lock: threading.RLock
    _seq: dict[str, int]

    @abstractmethod
    def send(self, message: ClientMessage) -> bool: ...

    @abstractmethod
    def session_now_ns(self) -> int: ...

    @property
    @abstractmethod
    def alignment(self) -> Alignment | None: ...

    def send_sample(self, device: str, pose: PoseLike | None = None, **fields: Any) -> bool:
        """Makes one sample of `device` with `make_sample` and sends it. False: dropped (no connection), and counted.

        Raises `InvalidMessageError` for values that the protocol does not take, in one line that names the field.
        """
        return self.send(self.make_sample(device, pose, **fields))

    def send_samples(self, samples: Iterable[Sample]) -> bool:
        """Sends samples of several devices (at most 8, from `make_sample`) as one message. False: dropped, counted.

        For devices that are sampled together: one packet instead of three, and a third of the work on both sides.
        """
        return self.send(Samples(tuple(samples)))

    def make_sample(
        self,
        device: str,
        pose: PoseLike | None = None,
        *,
        robots: str | Iterable[str] = (),
        objects: str | Iterable[str] = (),
        kind: str | None = None,
        capture_ns: int | None = None,
        tracking_epoch: int | None = None,
        **fields: Any,
    ) -> Sample:
        """A sample of `device` as of now; epochs, versions, tokens and `seq` are filled in.

        `pose`: `T_tracking_device`, `((x, y, z), (w, x, y, z))`. `robots`, `objects`: what it drives, one name or
        several; those that are not ours are left out (counter `samples_without_lease`), so the sample is mere presence
        when none is. `kind`: by default `joints` with `q`, `twist` with `twist`, else `pose`. `capture_ns`: session
        time of capture, default now. `fields`: the other fields of `Sample` (`clutch`, `gripper`, `q`, `twist`, ...);
        arrays are fine. Raises `InvalidMessageError`, also for robots and objects that the session does not have.
        """
        for name, length in ARRAYS.items():
            if fields.get(name) is not None:
                fields[name] = to_numbers(name, fields[name], length)
        if kind is None:
            kind = (
                SampleKind.JOINTS if fields.get("q") else SampleKind.TWIST if fields.get("twist") else SampleKind.POSE
            )
        fields = {name: to_python_scalar(value) for name, value in fields.items()}
        own_pose = None if pose is None else to_pose("pose", pose)
        with self._lock:
            targets = [*self._targets(robots, TargetKind.ROBOT), *self._targets(objects, TargetKind.OBJECT)]
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
                pose=own_pose,
                **fields,
            )

    def _targets(self, names: str | Iterable[str], kind: str) -> list[Target]:
        targets = []
        for name in to_names(f"{kind}s", names):
            token = self.connection.lease_version(name)
            if token is not None:
                targets.append(Target(name, token, kind))
                continue
            known = self._known(kind)
            if known and name not in known:
                raise InvalidMessageError(f"{kind}s: no {kind} {name!r} in this session, it has: {', '.join(known)}")
            self.connection.counters.samples_without_lease += 1
        return targets

    def _known(self, kind: str) -> list[str]:
        """Names of the robots or objects of the session; none before the first snapshot."""
        mirror = self.connection.mirror
        if kind == TargetKind.ROBOT:
            return list(mirror.robots)
        leased = [lease.target for lease in mirror.leases.values() if lease.kind == kind]
        return list(dict.fromkeys([*leased, *(body.name for body in mirror.bodies if body.object)]))
