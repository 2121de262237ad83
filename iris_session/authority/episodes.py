"""Episodes of training data: countdown, recording, verdict, and the scene made ready for the next one.

    idle -> countdown -> running -> closing -> success, failure, discarded or unknown, which are idle again

One episode at a time. Holders of a robot of the task and directors start it; who does leads it. The leader, holders of
its robots and directors give the verdict; a discard is asked for twice. When its leader or a holder disconnects it
waits for that one, or for another leader, and then ends `unknown`, as it does at once when one of them says goodbye: an
episode without its people is no success, unless a director says so. While it closes, every robot holds. Places of
objects are drawn outside and come as an entry (`ObjectsPlaced`).
"""

from __future__ import annotations

from typing import Final

import msgspec

from iris_session.authority import engagement, session_control
from iris_session.authority.config import SECOND
from iris_session.authority.context import Context, build_value_denial, join_names
from iris_session.authority.state import HOST_ID, NO_CONNECTION, NO_REPLY, Participant, WarningState
from iris_session.protocol.client_messages import Episode, Sample
from iris_session.protocol.common import MAX_TEXT, Denial
from iris_session.protocol.entries import ObjectsPlaced
from iris_session.protocol.names import DenialReason, Device, EpisodeAction, EpisodeState, HoldReason, Role
from iris_session.protocol.server_messages import EpisodeChanged, Notice
from iris_session.protocol.specs import TaskSpec

#: Final state that each action ends an episode in.
VERDICTS: Final = {
    EpisodeAction.SUCCESS: EpisodeState.SUCCESS,
    EpisodeAction.FAILURE: EpisodeState.FAILURE,
    EpisodeAction.UNKNOWN: EpisodeState.UNKNOWN,
    EpisodeAction.DISCARD: EpisodeState.DISCARDED,
    EpisodeAction.RERECORD: EpisodeState.DISCARDED,
}
#: Actions that must be asked for twice.
_ASKED_TWICE: Final = (EpisodeAction.DISCARD, EpisodeAction.RERECORD)
_MAY_PLACE: Final = EpisodeState.OVER | {EpisodeState.COUNTDOWN}
MAX_COUNTDOWN_NS: Final = 60 * SECOND
#: Longest wait for the places of objects, and for the owner of a user loop to reset its world.
PLACEMENT_NS: Final = 5 * SECOND
OWNER_NS: Final = 30 * SECOND
#: A button that is pressed so soon after the state has changed was meant for the state before.
PRESS_NS: Final = SECOND
#: Bits of `Sample.buttons` (docs/protocol.md, section 6): A or X, and B or Y; and the devices whose buttons count.
LOWER: Final = 1 << 4
UPPER: Final = 1 << 5
_BUTTON_DEVICES: Final = (Device.CONTROLLER_LEFT, Device.CONTROLLER_RIGHT)


def create_first(task: TaskSpec | None) -> EpisodeChanged | None:
    """Return what is known before the first episode; `None` without a task."""
    return None if task is None else _describe(task, task.recorded, EpisodeState.IDLE)


def _describe(task: TaskSpec | None, number: int, state: str, successes: int | None = None) -> EpisodeChanged:
    if task is None:
        return EpisodeChanged(number, state, successes=successes or 0)
    done = task.successes if successes is None else successes
    return EpisodeChanged(
        number, state, task=task.name, instruction=task.instruction, wanted=task.wanted, successes=done
    )


def _set(ctx: Context, by: str, state: str, until_ns: int = 0, **changes: object) -> None:
    now = ctx.state.episode
    assert now is not None
    if state != now.state:
        ctx.state.episode_ns = ctx.now_ns
    episode = msgspec.structs.replace(now, state=state, participant=by, until_ns=until_ns, **changes)
    ctx.state.episode = episode
    ctx.emit(episode)


# --- requests ---


def control_episode(ctx: Context, p: Participant, m: Episode) -> None:
    """Process one action of a participant."""
    if not ctx.config.episode_rules:
        return session_control.mark_episode(ctx, p, m)
    denial = _act(ctx, p, m)
    return ctx.accept(p, m.request_id) if denial is None else ctx.deny(p, m.request_id, denial)


def _act(ctx: Context, p: Participant, m: Episode) -> Denial | None:
    """Do what `m` asks for, or return why not."""
    if m.action not in EpisodeAction.ALL:
        return build_value_denial("action", m.action, EpisodeAction.ALL)
    if p.role not in Role.DRIVING:
        return Denial(DenialReason.ROLE, f"role {p.role} may not control episodes", "ask an operator or director")
    resets = m.action in (EpisodeAction.RESET, EpisodeAction.RERECORD)
    if resets and ctx.config.user_owned_loop and not ctx.state.owner_listens:
        return session_control.build_user_owned_denial(m.action)
    now = ctx.state.episode
    if now is None or now.state in EpisodeState.OVER:
        if m.action not in (EpisodeAction.START, EpisodeAction.RESET):
            return Denial(DenialReason.EPISODE_STATE, "no episode is running", "start one")
        if denial := _check_right_to_begin(ctx, p):
            return denial
        if m.action == EpisodeAction.START:
            return _start(ctx, p, m)
        if not ctx.config.user_owned_loop:
            session_control.reset_scene(ctx, p.id)
        return None
    if m.action in (EpisodeAction.START, EpisodeAction.RESET):
        advice = "end it with success, failure or discard"
        return Denial(DenialReason.EPISODE_STATE, f"episode {now.number} is in state {now.state}", advice)
    if m.action == EpisodeAction.TAKE_OVER:
        return _take_over(ctx, p, now)
    denial = _check_right(ctx, p, now)
    return denial or _end_by_request(ctx, p, now, m)


def _check_right_to_begin(ctx: Context, p: Participant) -> Denial | None:
    """Deny what only holders of a robot of the task and directors may do: it can let the robots of all others hold."""
    task = ctx.config.task
    wanted = task.robots if task is not None else ()
    if not ctx.config.strict_episodes or p.role == Role.DIRECTOR or _holds_robot(ctx, p, wanted):
        return None
    if not any(not wanted or name in wanted for name in ctx.state.robots):
        return None  # bare hands
    text = f"you hold no robot of the task: {join_names(wanted)}" if wanted else "you hold no robot"
    return Denial(DenialReason.NOT_HOLDER, text, "acquire one first, or ask its holder or a director")


def _check_right(ctx: Context, p: Participant, now: EpisodeChanged) -> Denial | None:
    """Deny what only the leader, holders of its robots and directors may do."""
    if now.led_by in ("", p.id) or p.role == Role.DIRECTOR or _holds_robot(ctx, p, now.robots):
        return None
    leader = ctx.state.participants.get(now.led_by)
    name = now.started_by_name if leader is None else leader.name
    text = f"episode {now.number} is led by {name}"
    return Denial(DenialReason.HELD, text, f"ask {name} or a director, or take it over", "", now.led_by, name)


def _holds_robot(ctx: Context, p: Participant, robots: tuple[str, ...]) -> bool:
    """Return whether `p` holds one of `robots`; empty: any robot."""
    leases = [lease for name, lease in ctx.state.robots.items() if not robots or name in robots]
    return any(g.participant == p.id for lease in leases for g in lease.grants)


def _has_all_holders(ctx: Context, now: EpisodeChanged) -> bool:
    """Return whether every holder of a robot of the episode is connected."""
    people = ctx.state.participants.values()
    return not any(p.connection == NO_CONNECTION and _holds_robot(ctx, p, now.robots) for p in people)


def find_next_number(ctx: Context) -> int:
    """Return the number of the episode that begins next: in a countdown its own; that of a cancelled or repeated one
    is used again.
    """
    now, again = ctx.state.episode, ctx.state.rerecording
    if now is None or again is not None:
        return 1 if again is None else again.number
    return now.number + (now.state not in (EpisodeState.COUNTDOWN, EpisodeState.CANCELLED))


def _start(ctx: Context, p: Participant, m: Episode) -> Denial | None:
    state = ctx.state
    countdown_ns = ctx.config.countdown_ns if m.countdown_ns is None else m.countdown_ns
    if state.estop:
        return Denial(DenialReason.ESTOP, "the session is stopped", "clear the e-stop first")
    if state.paused and not ctx.config.user_owned_loop:
        return Denial(DenialReason.EPISODE_STATE, "the session is paused", "resume it first")
    if not 0 <= countdown_ns <= MAX_COUNTDOWN_NS:
        text = f"a countdown of {countdown_ns / SECOND:g} s"
        return Denial(DenialReason.INVALID, text, f"give 0 to {MAX_COUNTDOWN_NS // SECOND} s")
    before, number = state.episode, find_next_number(ctx)
    now = _describe(ctx.config.task, number, EpisodeState.COUNTDOWN, None if before is None else before.successes)
    now = msgspec.structs.replace(now, label=m.label, started_by=p.id, started_by_name=p.name, led_by=p.id)
    _count_down(ctx, now, countdown_ns)
    return None


def _count_down(ctx: Context, now: EpisodeChanged, countdown_ns: int) -> None:
    """Begin the episode `now` after a countdown; one whose objects are placed at the end of a step at the earliest."""
    ctx.state.episode = now
    if countdown_ns or _places_objects(ctx):
        until_ns = ctx.now_ns + countdown_ns
        _set(ctx, now.led_by or HOST_ID, EpisodeState.COUNTDOWN, until_ns, started_ns=0, robots=())
    else:
        _run(ctx, now)


def _places_objects(ctx: Context) -> bool:
    task = ctx.config.task
    return ctx.config.strict_episodes and task is not None and bool(task.objects)


def _run(ctx: Context, now: EpisodeChanged) -> None:
    by, task = now.led_by or HOST_ID, ctx.config.task
    held = tuple(name for name, lease in ctx.state.robots.items() if lease.grants)
    robots = task.robots if task is not None and task.robots else held
    _set(ctx, by, EpisodeState.RUNNING, started_ns=ctx.now_ns, robots=robots[:32])


def _take_over(ctx: Context, p: Participant, now: EpisodeChanged) -> Denial | None:
    """Let `p` lead: a director at any time, others once the leader is disconnected or does not wear the headset."""
    if ctx.config.strict_episodes and now.verdict:
        return _build_verdict_denial(now)
    leader = ctx.state.participants.get(now.led_by)
    is_there = leader is not None and leader.worn and leader.connection != NO_CONNECTION
    if leader is not None and is_there and p is not leader and p.role != Role.DIRECTOR:
        text = f"episode {now.number} is led by {leader.name}, who is there"
        return Denial(DenialReason.HELD, text, f"ask {leader.name} or a director", "", leader.id, leader.name)
    if now.state == EpisodeState.LEFT:
        _set(ctx, p.id, EpisodeState.RUNNING, led_by=p.id)
    else:
        _set(ctx, p.id, now.state, now.until_ns, led_by=p.id)
    return None


def _build_verdict_denial(now: EpisodeChanged) -> Denial:
    text = f"episode {now.number} has its verdict: {now.verdict}"
    return Denial(DenialReason.EPISODE_STATE, text, "wait until the scene is ready")


def _end_by_request(ctx: Context, p: Participant, now: EpisodeChanged, m: Episode) -> Denial | None:
    action = m.action
    if now.state == EpisodeState.COUNTDOWN:
        if action != EpisodeAction.DISCARD:
            return Denial(DenialReason.EPISODE_STATE, f"episode {now.number} has not begun", "discard cancels it")
        _set(ctx, p.id, EpisodeState.CANCELLED)
        return None
    if now.verdict:
        return _build_verdict_denial(now)
    leader = ctx.state.participants.get(now.led_by)
    is_led = not now.led_by or (leader is not None and leader.connection != NO_CONNECTION)
    if now.state == EpisodeState.LEFT and not is_led:
        return Denial(DenialReason.EPISODE_STATE, f"the leader of episode {now.number} has left", "take it over first")
    if action == EpisodeAction.SUCCESS and p.role != Role.DIRECTOR and not _has_all_holders(ctx, now):
        text = f"the holder of a robot of episode {now.number} is disconnected"
        return Denial(DenialReason.EPISODE_STATE, text, "wait for it, give another verdict, or ask a director")
    if ctx.state.estop and action == EpisodeAction.SUCCESS:
        return Denial(DenialReason.ESTOP, "the session is stopped", "clear the e-stop first, or give another verdict")
    if m.label:
        ctx.state.episode = now = msgspec.structs.replace(now, label=m.label)
    if action == EpisodeAction.STOP:
        if now.state == EpisodeState.CLOSING:
            return Denial(DenialReason.EPISODE_STATE, f"episode {now.number} is stopped", "give its verdict")
        _close(ctx, p.id, "", ctx.now_ns + ctx.config.verdict_ns)
    elif action in _ASKED_TWICE and now.state == EpisodeState.RUNNING:
        _set(ctx, p.id, EpisodeState.CONFIRM, ctx.now_ns + ctx.config.confirm_ns)
    else:
        _end(ctx, p.id, VERDICTS[action], again=p if action == EpisodeAction.RERECORD else None)
    return None


# --- ends ---


def _close(ctx: Context, by: str, verdict: str, until_ns: int) -> None:
    """Let every robot hold until the episode is over."""
    _set(ctx, by, EpisodeState.CLOSING, until_ns, verdict=verdict)
    engagement.rearm_all(ctx, HoldReason.EPISODE)


def _end(ctx: Context, by: str, verdict: str, again: Participant | None = None) -> None:
    """End the episode with a verdict; the scene is made ready where the task, or a repetition, wants that."""
    task, now = ctx.config.task, ctx.state.episode
    assert now is not None
    is_owned = ctx.config.user_owned_loop
    is_placed = task is not None and bool(task.objects) and not is_owned
    if again is not None:
        ctx.state.rerecording = now
    if verdict == EpisodeState.SUCCESS:
        ctx.state.episode = msgspec.structs.replace(now, successes=now.successes + 1)
    if is_placed:
        _close(ctx, by, verdict, ctx.now_ns + PLACEMENT_NS)
    elif is_owned and again is not None:
        _close(ctx, by, verdict, ctx.now_ns + OWNER_NS)
    else:
        if not is_owned and (again is not None or (task is not None and task.reset)):
            session_control.reset_scene(ctx, by)
            _close(ctx, by, verdict, ctx.now_ns)
        _finish(ctx, by, verdict)


def _finish(ctx: Context, by: str, verdict: str, *, may_repeat: bool = True) -> None:
    """The episode is over. Count down to the same number again where that was asked for."""
    _set(ctx, by, verdict, verdict="")
    before, ctx.state.rerecording = ctx.state.rerecording, None
    if before is None or not may_repeat or ctx.state.estop:
        return
    leader = ctx.state.participants.get(before.led_by)
    if not before.led_by or (leader is not None and leader.connection != NO_CONNECTION):
        _count_down(ctx, before, ctx.config.countdown_ns)


def end_unknown(ctx: Context, by: str = HOST_ID) -> None:
    """End an episode that is recorded, or waits for its verdict, without one; cancel a countdown."""
    now = ctx.state.episode
    if now is None or now.state in EpisodeState.OVER or now.verdict or not ctx.config.episode_rules:
        return
    if now.state == EpisodeState.COUNTDOWN:
        _set(ctx, by, EpisodeState.CANCELLED)
    else:
        _end(ctx, by, EpisodeState.UNKNOWN)


def note_leaving(ctx: Context, p: Participant, cause: str) -> None:
    """Note that `p` disconnects (`lost`), says goodbye (`left`), or is removed. Call it before its leases end.

    A leader without a robot that says goodbye, such as a command of the terminal, leaves the episode to the others.
    """
    now = ctx.state.episode
    if now is None or now.state in EpisodeState.OVER or not ctx.config.episode_rules:
        return
    if ctx.config.strict_episodes and now.verdict:
        return
    leads = now.led_by == p.id
    is_needed = now.state in EpisodeState.RECORDED and (leads or _holds_robot(ctx, p, now.robots))
    if cause == "lost" and is_needed:
        if now.state != EpisodeState.LEFT:
            _set(ctx, p.id, EpisodeState.LEFT, ctx.now_ns + ctx.config.takeover_ns)
    elif leads and cause == "left" and not _holds_robot(ctx, p, now.robots):
        _set(ctx, p.id, now.state, now.until_ns, led_by="")
    elif leads or is_needed:
        end_unknown(ctx, p.id)


def note_return(ctx: Context, p: Participant) -> None:
    """Note that `p` is connected again: the episode goes on once its leader and the holders of its robots are."""
    now = ctx.state.episode
    if now is None or now.state != EpisodeState.LEFT:
        return
    leader = ctx.state.participants.get(now.led_by)
    is_led = not now.led_by or (leader is not None and leader.connection != NO_CONNECTION)
    if is_led and _has_all_holders(ctx, now):
        _set(ctx, p.id, EpisodeState.RUNNING)


def advance_episode(ctx: Context) -> None:
    """Let time pass: ends of countdowns, questions and waits. A reset by a director ends what is recorded, but not an
    episode that began in this step: it begins with the reset scene. A countdown waits for the objects of a reset scene.
    """
    now = ctx.state.episode
    if now is None or now.state in EpisodeState.OVER or not ctx.config.episode_rules:
        return
    is_due = ctx.now_ns >= now.until_ns
    if now.state == EpisodeState.COUNTDOWN:
        if ctx.state.estop or (ctx.state.paused and not ctx.config.user_owned_loop):
            _set(ctx, HOST_ID, EpisodeState.CANCELLED)
        elif is_due:
            has_objects = not _places_objects(ctx) or ctx.state.placed_epoch == ctx.state.scene_epoch
            if has_objects or ctx.now_ns >= now.until_ns + PLACEMENT_NS:
                _run(ctx, now)
    elif now.state in EpisodeState.RECORDED and ctx.reset and now.started_ns < ctx.now_ns:
        end_unknown(ctx)
    elif now.state == EpisodeState.CONFIRM and is_due:
        _set(ctx, HOST_ID, EpisodeState.RUNNING)
    elif now.state == EpisodeState.LEFT and is_due:
        end_unknown(ctx)
    elif now.state == EpisodeState.CLOSING and is_due:
        if now.verdict:
            _finish(ctx, HOST_ID, now.verdict, may_repeat=False)
        else:
            end_unknown(ctx)


def place_objects(ctx: Context, m: ObjectsPlaced) -> None:
    """Reset the scene with the objects at the places of `m`, which the core reads from the entry; end the closing.

    Nothing is placed while an episode is recorded, or its verdict is missing.
    """
    now = ctx.state.episode
    if now is not None and now.state not in _MAY_PLACE and not now.verdict:
        return
    session_control.reset_scene(ctx, HOST_ID)
    ctx.state.placed_epoch = ctx.state.scene_epoch
    if now is not None and now.verdict:
        _finish(ctx, now.participant, now.verdict)


def complete_reset(ctx: Context) -> None:
    """The owner of a user loop has reset its world: what waited for that ends."""
    now = ctx.state.episode
    if not ctx.config.episode_rules:
        session_control.start_rerecording(ctx)
    elif now is not None and now.verdict:
        _finish(ctx, now.participant, now.verdict)


# --- buttons ---


def press_buttons(ctx: Context, p: Participant, s: Sample, before: int) -> None:
    """Act on the buttons of a controller that are pressed in `s` and were not in the sample before: of holders only.

    Lower (A, X): start; success; failure while it is asked whether to discard. Upper (B, Y): discard; cancel.
    """
    pressed = s.buttons & ~before
    if not pressed & (LOWER | UPPER) or s.device not in _BUTTON_DEVICES:
        return
    if not ctx.config.episode_rules or p.role not in Role.DRIVING or not ctx.list_leases(p):
        return
    now = ctx.state.episode
    is_over = now is None or now.state in EpisodeState.OVER
    action: str = EpisodeAction.DISCARD
    if pressed & LOWER and is_over:
        action = EpisodeAction.START
    elif pressed & LOWER:
        assert now is not None
        action = EpisodeAction.FAILURE if now.state == EpisodeState.CONFIRM else EpisodeAction.SUCCESS
    elif is_over:
        return
    denial = _check_press(ctx, p, pressed) or _act(ctx, p, Episode(NO_REPLY, action))
    if denial is not None and ctx.config.strict_episodes:
        _report_denied_press(ctx, p, denial)


def _check_press(ctx: Context, p: Participant, pressed: int) -> Denial | None:
    """Deny a press that was meant for the state before: so soon the lower button ends and begins nothing, and only the
    one who asked whether to discard answers that.
    """
    now = ctx.state.episode
    if now is None:
        return None
    if ctx.config.strict_episodes:
        is_soon = ctx.now_ns - ctx.state.episode_ns < PRESS_NS
        is_meant = now.participant == p.id if now.state == EpisodeState.CONFIRM else not pressed & LOWER
    else:
        is_soon = now.state == EpisodeState.RUNNING and ctx.now_ns - now.started_ns < PRESS_NS
        is_meant = not pressed & LOWER
    if is_meant or not is_soon:
        return None
    text = f"episode {now.number} has been in state {now.state} for less than {PRESS_NS / SECOND:g} s"
    return Denial(DenialReason.EPISODE_STATE, text, "press again if you mean that state")


def _report_denied_press(ctx: Context, p: Participant, denial: Denial) -> None:
    """Tell who pressed a button why it did nothing, at most once a second: a press has no reply."""
    w = p.warnings.setdefault("button", WarningState(said_ns=ctx.now_ns - PRESS_NS))
    w.left_out += 1
    if ctx.now_ns - w.said_ns >= PRESS_NS:
        n = "" if w.left_out == 1 else f" ({w.left_out} presses)"
        ctx.emit(Notice("warning", f"{p.name}: {denial.message}; {denial.advice}{n}"[:MAX_TEXT], p.id, denial.reason))
        w.said_ns, w.left_out = ctx.now_ns, 0
