"""Samples with the numbers that fence them: epochs, versions, fencing tokens and `seq`."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import Any

from iris_session.client.core.connection import ClientConnection
from iris_session.client.errors import InvalidMessageError
from iris_session.protocol.client_messages import Sample
from iris_session.protocol.common import Pose, Target
from iris_session.protocol.names import SampleKind, TargetKind

_log = logging.getLogger("iris_session.client")


class SampleBuilder:
    """Makes samples of one connection. `seq` counts per device, over all connections."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._seq: dict[str, int] = {}

    def make_sample(
        self,
        device: str,
        pose: Pose | None,
        *,
        capture_ns: int,
        robots: Iterable[str] = (),
        objects: Iterable[str] = (),
        kind: str | None = None,
        tracking_epoch: int | None = None,
        **fields: Any,
    ) -> Sample:
        """Make a sample; see `Client.make_sample`.

        Robots and objects that are not ours are left out and counted. Raises `InvalidMessageError` for those that the
        session does not have.
        """
        connection = self._connection
        gripper = fields.get("gripper")
        if isinstance(gripper, int | float) and not 0.0 <= gripper <= 1.0:
            connection.counters.grippers_clipped += 1
            if connection.counters.grippers_clipped == 1:
                _log.warning("gripper %g is not between 0 (open) and 1 (closed): the session clips it", gripper)
        if kind is None:
            kind = (
                SampleKind.JOINTS if fields.get("q") else SampleKind.TWIST if fields.get("twist") else SampleKind.POSE
            )
        targets = [*self._held_targets(robots, TargetKind.ROBOT), *self._held_targets(objects, TargetKind.OBJECT)]
        seq = self._seq[device] = self._seq.get(device, 0) + 1
        alignment = connection.mirror.find_alignment(connection.participant_id)
        return Sample(
            device=device,
            kind=kind,
            seq=seq,
            capture_ns=capture_ns,
            scene_epoch=connection.mirror.scene_epoch,
            tracking_epoch=connection.tracking_epoch if tracking_epoch is None else tracking_epoch,
            alignment_version=0 if alignment is None else alignment.version,
            targets=tuple(targets),
            worn=fields.pop("worn", connection.worn),
            pose=pose,
            **fields,
        )

    def _held_targets(self, names: Iterable[str], kind: str) -> list[Target]:
        targets = []
        for name in names:
            token = self._connection.lease_version(name)
            if token is not None:
                targets.append(Target(name, token, kind))
                continue
            known = self._known_names(kind)
            if known and name not in known:
                raise InvalidMessageError(f"{kind}s: no {kind} {name!r} in this session, it has: {', '.join(known)}")
            self._connection.counters.samples_without_lease += 1
        return targets

    def _known_names(self, kind: str) -> list[str]:
        """Return the names of the session's robots or objects; none before the first snapshot."""
        mirror = self._connection.mirror
        if kind == TargetKind.ROBOT:
            return list(mirror.robots)
        leased = [lease.target for lease in mirror.leases.values() if lease.kind == kind]
        return list(dict.fromkeys([*leased, *(body.name for body in mirror.bodies if body.object)]))
