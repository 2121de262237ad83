"""What the holder of a robot feels and reads: command in force, contact force, limits, rejected samples."""

from __future__ import annotations

import math
from collections.abc import Sequence

from iris_session.authority.context import Context
from iris_session.authority.state import FeedbackState
from iris_session.protocol.names import CommandKind, HoldReason
from iris_session.protocol.server_messages import Feedback
from iris_session.protocol.steps import Command


def report(ctx: Context, commands: Sequence[Command]) -> None:
    """Sends feedback on change, at most once per `feedback_ns` and robot."""
    for command in commands:
        state = ctx.state.feedback.get(command.robot)
        if state is None:
            state = ctx.state.feedback[command.robot] = FeedbackState()
        if ctx.now_ns >= state.due_ns:
            state.due_ns = ctx.now_ns + ctx.config.feedback_ns
            _report_robot(ctx, command, state)


def _report_robot(ctx: Context, command: Command, state: FeedbackState) -> None:
    lease = ctx.state.robots[command.robot]
    holders = [g.participant for g in lease.grants]
    for participant in [name for name in state.sent if name not in holders]:
        del state.sent[participant]
    if not holders:
        return
    step = ctx.config.contact_step_n
    force = ctx.view.gripper_force(command.robot)
    contact_n = round(force / step) * step if math.isfinite(force) else 0.0  # not finite: physics that diverged
    limits: tuple[str, ...] = next((c.limits for c in ctx.control if c.robot == command.robot), ())
    for name in dict.fromkeys(holders):
        p = ctx.state.participants[name]
        kind, reason = command.kind, command.hold_reason
        if lease.override and name != lease.override:
            kind, reason = CommandKind.HOLD, HoldReason.INTERVENTION  # what moves it is not what this agent says
        message = Feedback(command.robot, kind, reason, contact_n, limits, dict(p.rejected))
        if state.sent.get(name) != message:
            state.sent[name] = message
            ctx.send(p, message)
