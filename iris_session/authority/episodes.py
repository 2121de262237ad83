"""Episodes of training data: start, end with a verdict, discard, record again, reset between them."""

from __future__ import annotations

from typing import Final

from iris_session.authority import stops
from iris_session.authority.context import Context
from iris_session.authority.state import Participant
from iris_session.protocol.client_messages import Episode
from iris_session.protocol.common import Denial
from iris_session.protocol.names import DenialReason, EpisodeAction, Role
from iris_session.protocol.server_messages import EpisodeChanged

RUNNING: Final = "running"
#: State in which each action ends a running episode.
VERDICTS: Final = {
    EpisodeAction.SUCCESS: "success",
    EpisodeAction.FAILURE: "failure",
    EpisodeAction.DISCARD: "discarded",
}


def episode(ctx: Context, p: Participant, m: Episode) -> None:
    """One action of anyone who may drive. `rerecord` discards, resets and starts the next number at once."""
    if m.action not in EpisodeAction.ALL:
        known = f"actions: {', '.join(sorted(EpisodeAction.ALL))}"
        return ctx.deny(p, m.request_id, Denial(DenialReason.UNKNOWN_VALUE, f"unknown action {m.action}", known))
    if p.role not in Role.DRIVING:
        denial = Denial(DenialReason.ROLE, f"role {p.role} may not control episodes", "ask an operator or director")
        return ctx.deny(p, m.request_id, denial)
    now = ctx.state.episode
    running = now is not None and now.state == RUNNING
    if m.action in (EpisodeAction.RESET, EpisodeAction.RERECORD) and ctx.config.user_owned_loop:
        return ctx.deny(p, m.request_id, stops.user_owned(m.action))
    if running == (m.action in (EpisodeAction.START, EpisodeAction.RESET)):
        text = "an episode is running" if running else "no episode is running"
        advice = "end it with success, failure or discard" if running else "start one"
        return ctx.deny(p, m.request_id, Denial(DenialReason.EPISODE_STATE, text, advice))
    number = now.number if now is not None else 0
    if m.action in VERDICTS:
        _change(ctx, EpisodeChanged(number, VERDICTS[m.action], m.label, p.id))
    if m.action == EpisodeAction.RERECORD:
        _change(ctx, EpisodeChanged(number, VERDICTS[EpisodeAction.DISCARD], m.label, p.id))
    if m.action in (EpisodeAction.RESET, EpisodeAction.RERECORD):
        stops.reset(ctx)
    if m.action in (EpisodeAction.START, EpisodeAction.RERECORD):
        _change(ctx, EpisodeChanged(number + 1, RUNNING, m.label, p.id))
    return ctx.accept(p, m.request_id)


def _change(ctx: Context, episode: EpisodeChanged) -> None:
    ctx.state.episode = episode
    ctx.emit(episode)
