"""Warnings to the wearer of a headset about its alignment: not too often, and what was left out is counted."""

from __future__ import annotations

from iris_session.authority.context import Context
from iris_session.authority.state import Participant, Warned
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.server_messages import Notice


def warn(ctx: Context, p: Participant, kind: str, text: str, *, same: str) -> None:
    """Tells the wearer, at most once per `warning_ns` and kind; what was left out meanwhile is counted in the next one.

    `text` empty: all is well now. `same`: what stays equal in warnings that need not be said again.
    """
    w = p.warnings.get(kind)
    if w is None:
        if not text:
            return
        w = p.warnings[kind] = Warned(said_ns=ctx.now_ns - ctx.config.warning_ns)
    now = same if text else ""
    changed, w.seen = now != w.seen, now
    if not now:
        w.said = ""
    elif now != w.said and ctx.now_ns - w.said_ns < ctx.config.warning_ns:
        w.left_out += changed
    elif now != w.said:
        more = f" ({w.left_out} more of these meanwhile)" if w.left_out else ""
        ctx.emit(Notice("warning", text[: MAX_TEXT - len(more)] + more, p.id))
        w.said, w.said_ns, w.left_out = now, ctx.now_ns, 0


def inform(ctx: Context, p: Participant, text: str) -> None:
    """Something the wearer should know, without a fault."""
    ctx.emit(Notice("info", text[:MAX_TEXT], p.id))
