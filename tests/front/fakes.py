"""A context of a front without sockets, and parts that do nothing, for tests of single parts."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from iris_session.alignment.service import AlignmentService
from iris_session.front.audit import AuditTrail
from iris_session.front.coalescer import Coalescer
from iris_session.front.connection_guard import ConnectionGuard
from iris_session.front.connections import ConnectionTable, ControlSender
from iris_session.front.context import FrontContext
from iris_session.front.key_budgets import KeyBudgets
from iris_session.front.status import StatusService
from iris_session.link import FrontConfig, Ports, SceneInfo
from iris_session.protocol.limits import Drops
from iris_session.protocol.status import AssetsReport, MediaStreamReport
from iris_session.security.keyring import Keyring
from iris_session.security.resume_tokens import ResumeTokens


def make_context(
    control: Any,
    now_ns: Callable[[], int],
    config: FrontConfig | None = None,
    keyring: Keyring | None = None,
    publisher: Any = None,
    max_tokens: int = 8,
) -> FrontContext:
    """Make a context. `control`: socket that gets what is sent to clients, or an outbox in its place."""
    config = config or FrontConfig()
    drops, connections = Drops(), ConnectionTable()
    coalescer = Coalescer(config.limits, drops)
    audit = AuditTrail(coalescer.offer)
    return FrontContext(
        config=config,
        ports=Ports("127.0.0.1", 1, 2),
        keyring=keyring or Keyring(),
        now_ns=now_ns,
        drops=drops,
        connections=connections,
        outbox=control if hasattr(control, "send_to_route") else ControlSender(control, config.limits, drops),
        coalescer=coalescer,
        audit=audit,
        guard=ConnectionGuard(connections, drops, audit, config.limits),
        budgets=KeyBudgets(config.limits, coalescer.offer),
        tokens=ResumeTokens(max_tokens),
        publisher=publisher or FakePublisher(),
    )


def make_alignment(context: FrontContext) -> AlignmentService:
    return AlignmentService(context.coalescer.offer, context.drops, anchors=context.config.anchors)


def make_status(context: FrontContext, alignment: AlignmentService) -> StatusService:
    channel: Any = FakeChannel()
    return StatusService(context, channel, channel, alignment)


class FakePublisher:
    """In place of the sender of state."""

    scene = SceneInfo("")

    def replace_socket(self, state: object) -> None: ...


class FakeChannel:
    """In place of the services of media and of assets."""

    def sync_clients(self) -> None: ...

    def report_streams(self) -> tuple[MediaStreamReport, ...]:
        return ()

    def report_participant(self, _number: int) -> dict[str, Any]:
        return {}

    def report(self) -> AssetsReport | None:
        return None


def put(root: Path, data: bytes) -> str:
    """Store an asset. Return its address."""
    address = hashlib.sha256(data).hexdigest()
    path = root / address[:2] / address
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return address
